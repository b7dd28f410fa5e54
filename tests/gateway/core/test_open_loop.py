"""A joint whose device reports nothing: it goes by what it was told, and says so."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from gateway.config import load_robot
from gateway.core.joint import Joint
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from protocols.messages import MILLISECOND, Drive, Feedback, Idle, Mode, Nanos, State, Velocity
from tests.distributions import ROOT

STEP: Nanos = 5 * MILLISECOND
ROBOT = load_robot(str(ROOT / "fixtures" / "robots" / "diffbot_sabertooth.toml"))
MOTOR = ROBOT.motors["right"]
"""It is mounted the other way round."""


def given(joint: Joint, wanted: Velocity | None, count: int, *, stopped: bool = False) -> Iterator[float]:
    """The velocities at the joint that it sends, step by step; its driver says that it is armed once it was
    commanded."""
    for _ in range(count):
        now = joint._out_at + STEP
        out = joint.command(now, wanted, stopped)
        if not isinstance(out, Idle) and not joint.armed:
            joint.on_event(State(joint.name, now, Mode.ARMED, "open loop: as told"))
        yield getattr(joint.sent, "velocity", 0.0)


def armed(velocity: float) -> Joint:
    """A joint that has been told to turn for a second."""
    joint = Joint("right", MOTOR.joint, MOTOR.spec)
    joint.on_event(State("right", 0, Mode.READY, "open loop: at rest"))
    assert list(given(joint, Velocity("right", velocity), 200))[-1] == pytest.approx(velocity)
    return joint


def test_it_is_armed_without_a_report_and_loses_no_feedback() -> None:
    joint = armed(3.0)
    assert not joint.faults
    assert joint.feedback_age(joint._out_at) is None
    assert not joint.feedback_lost(joint._out_at)
    assert joint.feedback == Feedback("right", 0)  # nothing of it is measured


def test_it_presumes_what_it_was_told_within_the_limits() -> None:
    joint = armed(3.0)
    now = joint._out_at + STEP
    presumed = joint.presumed(now)
    assert presumed is not None
    assert presumed.velocity == pytest.approx(3.0)
    assert presumed.position == pytest.approx(3.0 * 1.0, abs=0.2)
    later = joint.presumed(now + 10_000 * MILLISECOND)
    assert later is not None
    assert later.position == pytest.approx(
        presumed.position, abs=3.0 * 0.11
    )  # no longer than a command is good


def test_a_stop_ramps_down_what_it_is_told_then_idle() -> None:
    joint = armed(6.0)
    told = list(given(joint, None, 100, stopped=True))
    ramp = [each for each in told if each > 0.0]
    assert ramp == sorted(ramp, reverse=True)
    assert 10 <= len(ramp) <= 40  # 6 rad/s at 60 rad/s² take 100 ms
    assert isinstance(joint.sent, Idle)


def test_the_brain_is_given_it_and_the_recording_is_not() -> None:
    gateway = Gateway(replace(ROBOT))
    events: list[object] = []
    for at in range(1, 400):
        now = at * STEP
        outputs = gateway.step(now, Inputs((), (), (Drive(0.2, 0.0),) if at > 300 else ()))
        events += outputs.events
    assert not [each for each in events if isinstance(each, Feedback)]
    assert gateway.belief().estimate is not None  # of the wheels' presumed angles: no sensor has reported
    assert {each.mode for each in events if isinstance(each, State)} == {Mode.READY}


def test_a_joint_with_feedback_presumes_nothing() -> None:
    robot = load_robot(str(ROOT / "fixtures" / "robots" / "diffbot_roboclaw.toml"))
    motor = robot.motors["left"]
    assert Joint("left", motor.joint, motor.spec).presumed(1) is None
