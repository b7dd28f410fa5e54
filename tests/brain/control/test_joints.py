"""Targets of bare joints."""

from __future__ import annotations

from brain.control.joints import Targets
from protocols.messages import Hold, Idle, Position, Torque, Velocity


def test_idle_until_asked_and_kept_until_told_otherwise() -> None:
    targets = Targets(["a", "b"])
    assert targets.commands() == (Idle("a"), Idle("b"))
    assert targets.ask(Velocity("b", 2.0)) == ""
    for _ in range(1000):
        assert targets.commands() == (Idle("a"), Velocity("b", 2.0))
    targets.ask(Torque("b", 0.1))
    targets.ask(Position("a", 1.0))
    assert targets.commands() == (Position("a", 1.0), Torque("b", 0.1))
    targets.ask(Idle("a"))
    assert targets.wanted() == ("b",)


def test_each_motor_has_one_command_in_the_order_of_the_file() -> None:
    targets = Targets(["z", "a", "m"])
    targets.ask(Hold("m"))
    assert [command.motor for command in targets.commands()] == ["z", "a", "m"]


def test_dropping_ends_a_target() -> None:
    targets = Targets(["a"])
    targets.ask(Velocity("a", 1.0))
    assert targets.drop("a")
    assert not targets.drop("a")
    assert targets.commands() == (Idle("a"),)


def test_an_unknown_motor_is_refused_with_the_nearest_name() -> None:
    why = Targets(["left", "right"]).ask(Idle("rigth"))
    assert why == "there is no motor 'rigth'; there are left, right; did you mean 'right'?"
