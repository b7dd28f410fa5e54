"""Arming, set-points and stops beside vectors: which bytes go out while the device says which."""

from __future__ import annotations

from math import tau

import pytest

from protocols import messages as msg
from protocols.frames import BusState
from protocols.messages import Command, Request
from tests.protocols.moteus.test_vectors import AT, VECTORS, Talk
from tests.protocols.moteus.test_vectors_heard import reported, talk

# -- arming, set-points and stops --------------------------------------------------------------------

MOVE = "01000a0f20"


def command(it: Talk, word: Command) -> str:
    """The first frame that goes out, without its question."""
    return it.say(word)[0].data.hex()


@pytest.mark.parametrize(
    ("word", "first", "then"),
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
def test_arming_as_in_vectors(word: Command, first: str, then: str) -> None:
    it = talk()
    for vector in ("reply_stopped", "reply_stopped", "reply_enabling", "reply_enabling"):
        assert command(it, word).startswith(first)
        it.handle(VECTORS[vector])
    assert command(it, word).startswith(first)
    it.handle(AT)
    assert command(it, word).startswith(then)
    it.handle(AT)
    assert command(it, word).startswith(then)


def test_a_hold_stays_where_the_vector_had_it_first() -> None:
    it = Talk().running()
    held = MOVE + "0000803e" + "00000000" * 2
    assert command(it, msg.Hold("left")).startswith(held)
    it.handle(AT.replace("0000803e", "0000003f", 1))
    assert command(it, msg.Hold("left")).startswith(held)
    it.say(msg.Position("left", tau))
    assert command(it, msg.Hold("left")).startswith(MOVE + "0000003f" + "00000000" * 2)
    it.handle(AT)
    it.say(msg.Idle("left"))
    assert command(it, msg.Hold("left")).startswith(held)


def test_a_velocity_starts_at_the_shaft_after_anything_else_beside_vectors() -> None:
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
            it.say(msg.Velocity("left", tau))
            it.handle(AT)
        assert command(it, msg.Velocity("left", tau)).startswith(free)
        it.say(other)
        it.handle(AT)
        for _ in range(3):
            assert command(it, msg.Velocity("left", tau)).startswith(placed)
            it.handle(AT)
        assert command(it, msg.Velocity("left", tau)).startswith(free)
    it.driver.bus(it.now, BusState.FULL)
    assert command(it, msg.Velocity("left", tau)).startswith(placed)


def stops(it: Talk, steps: int, word: Command | Request, *, hears: str = "") -> list[int]:
    """In which steps of 5 ms a stop goes out."""
    found = []
    for at in range(steps):
        sent = it.say(word)
        found += [at for f in sent if f.data[:3] == b"\x01\x00\x00"]
        if hears:
            it.handle(VECTORS[hears])
    return found


def test_stops_are_repeated_until_vectors_confirm_them() -> None:
    it = Talk().running()
    it.say(msg.Hold("left"))
    assert stops(it, 20, msg.Idle("left")) == [0, 4, 8, 12, 16]
    assert stops(it, 9, msg.Idle("left"), hears="reply_stopped") == [0]
    it = Talk().running()
    assert stops(it, 9, msg.Idle("left")) == []  # nobody has commanded it
    it.say(msg.Hold("left"))
    it.say(msg.Idle("left"))
    it.handle(VECTORS["reply_timeout"])
    assert stops(it, 20, msg.Idle("left")) == []
    it = Talk().running()
    it.say(msg.Hold("left"))
    it.say(msg.Idle("left"))
    it.driver.bus(it.now, BusState.FULL)
    assert stops(it, 3, msg.Idle("left")) == [0]


def test_idle_lets_go_of_a_device_in_timeout_as_the_vector_says() -> None:
    it = Talk().running()
    it.say(msg.Hold("left"))
    reported(it, "reply_timeout")
    assert stops(it, 9, msg.Idle("left"), hears="reply_timeout") == []
    it.say(msg.ClearFault("left"))
    assert len(reported(it, "reply_stopped")) >= 2
    assert stops(it, 9, msg.Idle("left"), hears="reply_stopped") == []
    assert it.say(msg.Zero("left"))[0].data[:3] == b"\x0d\xb1\x02"  # it is not ours any more
