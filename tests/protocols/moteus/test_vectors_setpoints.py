"""Arming, set-points and stops: the bytes that are sent for the bytes that are received."""

from __future__ import annotations

from math import tau

import pytest

from protocols import messages as msg
from protocols.frames import BusState
from protocols.messages import Command, Request
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_requests import reported, talk

# -- arming, set-points and stops --------------------------------------------------------------------

MOVE = "01000a0f20"


def command(it: Talk, message: Command) -> str:
    """The first frame that goes out, without its question."""
    return it.send(message)[0].data.hex()


@pytest.mark.parametrize(
    ("message", "first", "then"),
    [
        (msg.Hold("left"), MOVE + "0000803e" + "00000000" * 2, MOVE + "0000803e" + "00000000" * 2),
        (msg.Position("left", tau, -tau, 0.5), MOVE + "0000803e" + "00000000" * 2,
         MOVE + "0000803f" + "000080bf" + "0000003f"),
        (msg.Velocity("left", tau, 0.5), MOVE + "0000803e" + "00000000" * 2,
         MOVE + "0000c07f" + "0000803f" + "0000003f"),
        (msg.Torque("left", 0.5), "01000a0c0520" + "0000803e" + "00000000" * 4,
         "01000a0c0520" + "0000803e" + "00000000" + "0000003f" + "00000000" * 2),
    ],
)  # fmt: skip
def test_arming(message: Command, first: str, then: str) -> None:
    it = talk()
    for vector in ("reply_stopped", "reply_stopped", "reply_enabling", "reply_enabling"):
        assert command(it, message).startswith(first)
        it.handle(VECTORS[vector])
    assert command(it, message).startswith(first)
    it.handle(AT)
    assert command(it, message).startswith(then)
    it.handle(AT)
    assert command(it, message).startswith(then)


def test_a_hold_stays_at_the_position_of_the_first_hold() -> None:
    it = Talk().running()
    held = MOVE + "0000803e" + "00000000" * 2
    assert command(it, msg.Hold("left")).startswith(held)
    it.handle(AT.replace("0000803e", "0000003f", 1))
    assert command(it, msg.Hold("left")).startswith(held)
    it.send(msg.Position("left", tau))
    assert command(it, msg.Hold("left")).startswith(MOVE + "0000003f" + "00000000" * 2)
    it.handle(AT)
    it.send(msg.Idle("left"))
    assert command(it, msg.Hold("left")).startswith(held)


def test_a_velocity_starts_at_the_shaft_after_anything_else() -> None:
    placed, free = MOVE + "0000803e" + "0000803f", MOVE + "0000c07f" + "0000803f"
    others: tuple[Command, ...] = (
        msg.Hold("left"),
        msg.Position("left", 1.0),
        msg.Torque("left", 0.5),
        msg.Idle("left"),
    )
    for other in others:
        it = Talk().running()
        for _ in range(5):
            it.send(msg.Velocity("left", tau))
            it.handle(AT)
        assert command(it, msg.Velocity("left", tau)).startswith(free)
        it.send(other)
        it.handle(AT)
        for _ in range(9):  # a start that may have been lost counts for nothing
            assert command(it, msg.Velocity("left", tau)).startswith(placed)
        for _ in range(3):
            assert command(it, msg.Velocity("left", tau)).startswith(placed)
            it.handle(AT)
        assert command(it, msg.Velocity("left", tau)).startswith(free)
    it.driver.bus(it.now, BusState.FULL)
    assert command(it, msg.Velocity("left", tau)).startswith(placed)


def stops(it: Talk, steps: int, message: Command | Request, *, reply: str = "") -> list[int]:
    """In which steps of 5 ms a stop goes out."""
    found = []
    for at in range(steps):
        sent = it.send(message)
        found += [at for f in sent if f.data[:3] == b"\x01\x00\x00"]
        if reply:
            it.handle(VECTORS[reply])
    return found


def test_stops_are_repeated_until_vectors_confirm_them() -> None:
    it = Talk().running()
    it.send(msg.Hold("left"))
    assert stops(it, 20, msg.Idle("left")) == [0, 4, 8, 12, 16]
    assert stops(it, 9, msg.Idle("left"), reply="reply_stopped") == [0]
    it = Talk().running()
    assert stops(it, 9, msg.Idle("left")) == []  # it was not commanded
    it.send(msg.Hold("left"))
    it.send(msg.Idle("left"))
    it.handle(VECTORS["reply_timeout"])
    assert stops(it, 20, msg.Idle("left")) == []
    it = Talk().running()
    it.send(msg.Hold("left"))
    it.send(msg.Idle("left"))
    it.driver.bus(it.now, BusState.FULL)
    assert stops(it, 3, msg.Idle("left")) == [0]


def test_idle_sends_no_stop_in_timeout() -> None:
    it = Talk().running()
    it.send(msg.Hold("left"))
    reported(it, "reply_timeout")
    assert stops(it, 9, msg.Idle("left"), reply="reply_timeout") == []
    it.send(msg.ClearFault("left"))
    assert len(reported(it, "reply_stopped")) >= 2
    assert stops(it, 9, msg.Idle("left"), reply="reply_stopped") == []
    assert it.send(msg.Zero("left"))[0].data[:3] == b"\x0d\xb1\x02"  # it is not ours any more
