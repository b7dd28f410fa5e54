from __future__ import annotations

import math

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.plane import arc, wrap
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GateResult, WheelAngle
from brain.perception.filter_settings import FilterSettings
from protocols.messages import SECOND, Nanos, seconds
from tests.brain.perception.rolling import BODY, MS

RESOLUTION = FilterSettings().resolution


def angles(t: Nanos) -> tuple[float, float]:
    """Wheels' angles of a winding drive of 30 m in a minute: speeds and directions change all the time."""
    s = seconds(t)
    return (
        10.0 * s + 4.0 * math.sin(0.9 * s) - 3.0 * math.sin(0.37 * s),
        10.0 * s - 4.0 * math.sin(0.7 * s) + 1.5 * math.sin(1.3 * s),
    )


def rounded(angle: float) -> float:
    return math.floor(angle / RESOLUTION) * RESOLUTION


def reckoned(stamps: list[Nanos]) -> Pose:
    """Dead reckoning by exact arcs between stamps."""
    pose, before = Pose(0.0, 0.0, 0.0), angles(stamps[0])
    for t in stamps[1:]:
        now = angles(t)
        pose = arc(pose, *BODY.travel(before, now)[:2])
        before = now
    return pose


def close(pose: Pose, other: Pose) -> bool:
    """Within 1 mm and 0.01 degrees."""
    apart = math.hypot(pose.x - other.x, pose.y - other.y)
    return apart < 1e-3 and abs(wrap(pose.yaw - other.yaw)) < math.radians(0.01)


def believed(belief: Filter, t: Nanos) -> Pose:
    found = belief.at(t)
    assert found is not None
    return found[0]


@pytest.mark.parametrize("every", [5, 10, 20, 50, 100, 250])
def test_wheels_alone_are_dead_reckoning(every: int) -> None:
    belief, stamps = Filter(BODY, FilterSettings()), list(range(0, 60 * SECOND + 1, every * MS))
    for t in stamps:
        for motor, angle in zip(("left", "right"), angles(t), strict=True):
            belief.observe([WheelAngle(motor, t, rounded(angle))])
    assert belief.t == stamps[-1]
    assert close(believed(belief, stamps[-1]), reckoned(stamps))
    assert close(Pose(*belief.state.raw), reckoned(stamps))


@pytest.mark.parametrize(("every", "apart"), [(10, 3), (10, 7), (20, 9)])
def test_stamps_that_differ_cost_nothing(every: int, apart: int) -> None:
    """The right wheel's stamps lie between those of the left: the angle in between is interpolated."""
    belief, stamps = Filter(BODY, FilterSettings()), list(range(0, 60 * SECOND + 1, every * MS))
    for t in stamps:
        belief.observe([WheelAngle("left", t, rounded(angles(t)[0]))])
        belief.observe([WheelAngle("right", t + apart * MS, rounded(angles(t + apart * MS)[1]))])
    assert belief.t is not None
    assert belief.t >= stamps[-1] - 4 * MS
    assert close(believed(belief, belief.t), reckoned(list(range(apart * MS, belief.t + 1, MS))))


@pytest.mark.parametrize("seed", range(3))
def test_lost_reports_lose_no_motion(seed: int) -> None:
    """Half of the reports get lost, at random: the wheels have turned what they have turned."""
    random = np.random.Generator(np.random.PCG64(seed))
    belief = Filter(BODY, FilterSettings())
    for t in range(0, 10 * SECOND + 1, 10 * MS):
        for motor, angle in zip(("left", "right"), angles(t), strict=True):
            if random.random() < 0.5 or t % (10 * SECOND) == 0:
                belief.observe([WheelAngle(motor, t, angle)])
    expected = [b - a for a, b in zip(angles(0), angles(10 * SECOND), strict=True)]
    assert belief.state.travelled[0] == pytest.approx(0.025 * sum(expected), abs=1e-9)
    assert belief.state.x[2] == pytest.approx(0.05 / 0.22 * (expected[1] - expected[0]), abs=1e-9)


@pytest.mark.parametrize("silent", ["left", "right"])
def test_a_silent_wheel_loses_no_motion(silent: str) -> None:
    belief = Filter(BODY, FilterSettings())
    other = "right" if silent == "left" else "left"
    belief.observe([WheelAngle("left", 0, 0.0), WheelAngle("right", 0, 0.0)])
    for t in range(10 * MS, SECOND + 1, 10 * MS):
        belief.observe([WheelAngle(other, t, seconds(t))])
    assert belief.t == 0
    belief.observe([WheelAngle(silent, SECOND, 1.0)])
    assert belief.t == SECOND
    assert belief.state.x[:3] == pytest.approx((0.05, 0.0, 0.0), abs=1e-12)


def test_a_jump_is_a_new_zero() -> None:
    """A device that was reset counts from 0 again: the robot stays where it is, and goes on from there."""
    belief = Filter(BODY, FilterSettings())
    results = []
    for t in range(0, SECOND, 10 * MS):
        turned = seconds(t)
        for motor, zero in (("left", 40.0 if t >= SECOND // 2 else 0.0), ("right", 0.0)):
            results += [j.result for j in belief.observe([WheelAngle(motor, t, turned - zero)])]
    assert results == [GateResult.JUMPED]
    assert belief.t == 990 * MS
    assert belief.state.x[0] == pytest.approx(0.05 * 0.98, abs=1e-9)  # one travel is lost
    assert belief.state.x[2] == pytest.approx(0.0, abs=1e-12)


def test_the_fastest_wheel_does_not_jump() -> None:
    belief = Filter(BODY, FilterSettings())
    for t in range(0, SECOND, 10 * MS):
        angle = BODY.top_speeds[0] * seconds(t)
        assert not belief.observe([WheelAngle("left", t, angle), WheelAngle("right", t, angle)])


def test_two_values_for_one_time_are_reported() -> None:
    belief = Filter(BODY, FilterSettings())
    belief.observe([WheelAngle("left", 0, 0.0), WheelAngle("right", 0, 0.0)])
    (judged,) = belief.observe([WheelAngle("right", 0, 0.1)])
    assert (judged.source, judged.result) == ("right", GateResult.CONFLICT)
    assert not belief.observe([WheelAngle("right", 0, 0.1)])  # the same again
