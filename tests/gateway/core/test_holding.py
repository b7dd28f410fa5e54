"""Loads: Hold with the torque that has carried them, and a brain that fails while it carries one."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest

from gateway.core.joint import Joint, JointSettings
from gateway.core.limits import Limits
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Mode
from protocols.plugin import Range
from tests.gateway.core.test_joint import spec

MS = MILLISECOND
LIMITS = Limits(10.0, 100.0, 5.0, (-2.0, 2.0))


def carrying(
    command: Command, *, takes_torque: bool = True, unattended: Literal["held", "released"] = "released"
) -> Joint:
    settings = JointSettings(
        LIMITS, gear=10.0, sign=-1, stop_action="hold", on_command_timeout="hold", unattended=unattended
    )
    ranges = {"Hold.torque": Range(-1.0, 1.0, 1e-3)} if takes_torque else {}
    made = Joint("a", settings, replace(spec(), ranges=ranges))
    made.on_event(msg.State("a", 0, Mode.ARMED))
    made.on_event(msg.Feedback("a", 0, 0.0, 0.0))
    made.command(1 * MS, command, stopped=False)
    return made


@pytest.mark.parametrize(
    ("command", "torque"),
    [
        (msg.Impedance("a", 0.0, 0.0, 3.0, 20.0, 1.0), 3.0),
        (msg.Position("a", 0.0, 0.0, 3.0), 3.0),
        (msg.Impedance("a", 0.0, 0.0, 9.0, 0.0, 0.0), 5.0),  # its limit
        (msg.Torque("a", 3.0), 0.0),  # what turns a wheel carries nothing
        (msg.Velocity("a", 0.0, 3.0), 0.0),
    ],
)
@pytest.mark.parametrize("why", ["stop", "silent brain"])
def test_it_holds_with_the_torque_that_carried_the_load(command: Command, torque: float, why: str) -> None:
    made = carrying(command)
    stopped = why == "stop"
    for step in range(1, 60):
        now = 1 * MS + step * 5 * MS
        made.on_event(msg.Feedback("a", now, 0.0, 0.0))
        out = made.command(now, None, stopped)
    assert out == msg.Hold("a", -torque / 10.0)  # at the device's shaft


def test_a_device_that_takes_no_torque_with_hold_is_given_none() -> None:
    made = carrying(msg.Position("a", 0.0, 0.0, 3.0), takes_torque=False)
    assert made.command(6 * MS, None, stopped=True) == msg.Hold("a")


def test_at_the_end_a_load_is_held_or_let_go_as_the_file_says() -> None:
    held = carrying(msg.Position("a", 0.0, 0.0, 3.0), unattended="held")
    released = carrying(msg.Position("a", 0.0, 0.0, 3.0), unattended="released")
    for made, last in ((held, msg.Hold("a", -0.3)), (released, msg.Idle("a"))):
        assert made.command(6 * MS, None, stopped=True) == msg.Hold("a", -0.3)
        assert made.command(11 * MS, None, stopped=True, last=True) == last


def test_a_hold_that_is_not_finite_is_refused() -> None:
    made = carrying(msg.Position("a", 0.0))
    made.command(6 * MS, msg.Hold("a", float("nan")), stopped=False)
    assert "not finite" in made.refused
