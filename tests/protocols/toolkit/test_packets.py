"""Messages on a serial line, declared as those on CAN are."""

from __future__ import annotations

import pytest

from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import Framing, inverted_sum8
from protocols.toolkit.table import Row, const, sint, uint


def body(head: bytes) -> int | None:
    return head[3] - 1 if head[3] >= 2 else None


PACKETS = Packets(
    (
        Row("goal", (uint("address"), const(3)), (sint("position"),)),
        Row("ping", (uint("address"), const(1)), (), read_only=True),
    ),
    Framing(b"\xff\xff", 4, body, inverted_sum8, 1, covers=2),
    lambda address, function, data: bytes((0xFF, 0xFF, address, len(data) + 2, function)) + data,
    lambda message: (message[2], message[4], message[5:]) if len(message) > 4 else None,
)
GOAL, PING = bytes.fromhex("ffff0504039cff58"), bytes.fromhex("ffff010201fb")


def test_a_message_has_the_same_bytes_both_ways() -> None:
    assert PACKETS.encode("goal", 5, position=-100) == GOAL
    assert PACKETS.encode("ping", 1) == PING
    decoded = PACKETS.decode(GOAL[:-1], "to_device")
    assert decoded is not None
    assert (decoded.name, decoded.address, decoded.values) == ("goal", 5, {"position": -100})
    assert PACKETS.decode(GOAL[:-1], "from_device") is None


def test_names_are_those_of_whole_messages() -> None:
    assert PACKETS.names(PING + GOAL) == ("ping", "goal")
    assert PACKETS.names(GOAL[:-1]) == ()


def test_read_only_is_what_holds_nothing_else() -> None:
    assert PACKETS.read_only(PING * 2)
    assert not PACKETS.read_only(PING + GOAL)
    assert not PACKETS.read_only(PING + b"\0")


def test_what_is_not_finite_is_not_sent() -> None:
    with pytest.raises(ValueError, match="not finite"):
        PACKETS.encode("goal", 5, position=float("nan"))
