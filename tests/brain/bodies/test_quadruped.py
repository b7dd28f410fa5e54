"""Legs against finite differences, a gait whose feet do not slide, standing up, and odometry by the feet."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.leg import Leg, Point
from brain.bodies.plane import REST, Twist, arc
from brain.bodies.quadruped import GRAVITY, Quadruped
from brain.bodies.trot import CLOSE, OFFSETS, Foot, Gait, Rhythm
from protocols import messages as msg

NAMES = {
    key: (f"{leg}_hip", f"{leg}_thigh", f"{leg}_knee")
    for key, leg in (("front_left", "fl"), ("front_right", "fr"), ("rear_left", "rl"), ("rear_right", "rr"))
}
BODY = Quadruped(
    front_left=NAMES["front_left"],
    front_right=NAMES["front_right"],
    rear_left=NAMES["rear_left"],
    rear_right=NAMES["rear_right"],
    hip_x=0.18,
    hip_y=0.06,
    offset=0.08,
    thigh=0.2,
    shank=0.22,
    mass=10.5,
    height=0.28,
    stiffness=80.0,
    damping=4.0,
    radius=0.36,
    max_linear=0.4,
    max_angular=0.8,
    max_linear_acceleration=0.5,
    max_angular_acceleration=2.0,
)
LEG = Leg(0.08, 0.2, 0.22)
RHYTHM = Rhythm(0.4, 0.6, 0.05)
HOMES = ((0.18, 0.14), (0.18, -0.14), (-0.18, 0.14), (-0.18, -0.14))


def postures(seed: int, count: int) -> Iterator[Point]:
    """Yield angles at which the foot is below the hip."""
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    while count:
        hip, thigh, knee = rng.uniform((-0.8, -1.0, -2.6), (0.8, 2.0, -0.1)).tolist()
        if 0.2 * math.cos(thigh) + 0.22 * math.cos(thigh + knee) > 0.02:
            count -= 1
            yield hip, thigh, knee


# -- a leg ---------------------------------------------------------------------------------------------


def test_inverse_undoes_forward_and_the_jacobian_is_the_derivative() -> None:
    for angles in postures(1, 80):
        assert LEG.angles(LEG.foot(angles)) == pytest.approx(angles, abs=1e-7)
        columns = np.array(LEG.jacobian(angles))
        for index in range(3):
            step = np.zeros(3)
            step[index] = 1e-6
            ends = [LEG.foot((*(np.array(angles) + sign * step),)) for sign in (1.0, -1.0)]
            assert columns[index] == pytest.approx((np.array(ends[0]) - ends[1]) / 2e-6, abs=1e-8)
        velocity = columns.T @ (0.3, -2.0, 1.0)
        assert LEG.rates(angles, (*velocity.tolist(),)) == pytest.approx((0.3, -2.0, 1.0), abs=1e-7)


def test_knees_may_point_forward() -> None:
    forward = Leg(-0.08, 0.2, 0.22, bend=1.0)
    angles = forward.angles((0.05, -0.1, -0.3))
    assert angles[2] > 0.0
    assert forward.foot(angles) == pytest.approx((0.05, -0.1, -0.3), abs=1e-12)


@pytest.mark.parametrize("foot", [(0.0, 0.08, -9.0), (0.0, 0.0, 0.0), (0.0, 0.08, -0.42), (3.0, 0.0, 3.0)])
def test_out_of_reach_is_as_far_as_it_goes(foot: Point) -> None:
    angles = LEG.angles(foot)
    assert all(map(math.isfinite, (*angles, *LEG.rates(angles, (1.0, 1.0, 1.0)), *LEG.foot(angles))))
    if foot[2] < -1.0:
        x, y, z = LEG.foot(angles)
        assert (x, y) == pytest.approx((0.0, 0.08), abs=1e-9)
        assert z == pytest.approx(-0.42, abs=1e-3)


# -- the gait ------------------------------------------------------------------------------------------


def walk(twist: Twist, seed: int, times: int) -> Iterator[tuple[Gait, Pose, float]]:
    """Yield gait, true pose and step [s] of a walk in steps of various length."""
    print(f"seed {seed}")
    rng, pose = np.random.default_rng(seed), Pose(0.0, 0.0, 0.0)
    gait = Gait(tuple(Foot(home) for home in HOMES))
    for _ in range(times):
        dt = float(rng.choice([0.001, 0.005, 0.02, 0.037]))
        gait = RHYTHM.advanced(gait, HOMES, twist, dt)
        pose = arc(pose, twist.linear * dt, twist.angular * dt, twist.lateral * dt)
        yield gait, pose, dt


def seen(place: tuple[float, float], pose: Pose) -> tuple[float, float]:
    """Return a place of the world as seen from a pose."""
    x, y, c, s = place[0] - pose.x, place[1] - pose.y, math.cos(pose.yaw), math.sin(pose.yaw)
    return c * x + s * y, c * y - s * x


def after(twist: Twist, time: float) -> Pose:
    return arc(Pose(0.0, 0.0, 0.0), twist.linear * time, twist.angular * time, twist.lateral * time)


@pytest.mark.parametrize(
    "twist", [Twist(0.4), Twist(-0.2, 0.8, 0.1), Twist(0.0, -0.8), Twist(0.3, 0.5, -0.1)]
)
def test_feet_on_the_floor_do_not_slide(twist: Twist) -> None:
    """From its first step on, a foot is at home in the middle of its stance, and stays in the world."""
    stepped: set[int] = set()
    for gait, pose, _ in walk(twist, 2, 200):  # noqa: B007 - the last is looked at
        standing = [leg for leg in range(4) if RHYTHM.swing(gait, leg) is None]
        assert len(standing) in (2, 4)
        assert sum(RHYTHM.load(gait, leg) for leg in standing) > 0.0
        for leg, foot in enumerate(gait.feet):
            if leg not in standing:
                stepped.add(leg)
            elif leg in stepped:
                middle = ((gait.phase + OFFSETS[leg]) % 1.0 - 0.4 - 0.3) * RHYTHM.period
                assert foot.place == pytest.approx(seen(HOMES[leg], after(twist, middle)), abs=1e-9)
    assert math.hypot(pose.x, pose.y) + abs(pose.yaw) > 0.6


def test_a_foot_moves_smoothly() -> None:
    """Place, velocity and acceleration agree, also when it comes down and when the twist changes."""
    print("seed 3")
    rng, dt = np.random.default_rng(3), 1e-3
    gait, twist = Gait(tuple(Foot(home) for home in HOMES)), Twist(0.01)
    for step in range(450):
        if step % 10 == 0:
            change = rng.uniform(-1.0, 1.0, 3) * (0.005, 0.02, 0.005)
            twist = Twist(*(a + b for a, b in zip(twist, change.tolist(), strict=True)))
        last, gait = gait, RHYTHM.advanced(gait, HOMES, twist, dt)
        for leg in range(4):
            old, new = last.feet[leg], gait.feet[leg]
            mean = 0.5 * (np.array(old.velocity) + new.velocity)
            assert np.array(new.place) - old.place == pytest.approx(mean * dt, abs=2e-5)
            (low, down), (high, up) = RHYTHM.height(last, leg), RHYTHM.height(gait, leg)
            assert high - low == pytest.approx(0.5 * (down + up) * dt, abs=2e-5 if step else 1.0)
    speeds = [math.hypot(*foot.velocity) for foot in gait.feet]
    assert max(speeds) < 2.0


def test_it_stands_at_home_when_the_twist_ends() -> None:
    gait = [gait for gait, _, _ in walk(Twist(0.3, 0.6, 0.1), 4, 150)][-1]
    for _ in range(100):
        gait = RHYTHM.advanced(gait, HOMES, REST, 0.01)
    assert not gait.walking
    for foot, home in zip(gait.feet, HOMES, strict=True):
        assert foot.place == pytest.approx(home, abs=CLOSE)
    assert RHYTHM.advanced(gait, HOMES, REST, 0.01) == gait


# -- the body ------------------------------------------------------------------------------------------


def lying() -> list[float]:
    return [0.0, 1.4, -2.6] * 4


def commands(
    body: Quadruped, positions: list[float], twists: list[Twist], dt: float = 0.02
) -> Iterator[list[msg.Impedance]]:
    """Yield the commands of legs that are where they are commanded."""
    memory: Any = None
    for twist in twists:
        given, memory = body.actuate(twist, positions, dt, memory)
        springs = [one for one in given if isinstance(one, msg.Impedance)]
        assert [one.motor for one in springs] == list(body.joints)
        positions = [one.position for one in springs]
        yield springs


def test_it_folds_its_legs_rises_and_stands() -> None:
    rising = list(commands(BODY, lying(), [REST] * 200))
    depth = [-BODY.leg(0).foot((s[0].position, s[1].position, s[2].position))[2] for s in rising]
    assert depth[0] == pytest.approx(BODY.lying_height, abs=0.05)
    assert depth[-1] == pytest.approx(BODY.height, abs=1e-9)
    jumps = [abs(b.position - a.position) for old, new in pairwise(rising)
             for a, b in zip(old, new, strict=True)]  # fmt: skip
    assert max(jumps) < 0.12
    standing = rising[-1]
    assert [one.position for one in standing] == pytest.approx(
        [one.position for one in BODY.inverse(REST)], abs=1e-9
    )
    assert max(abs(one.velocity) for one in standing) == 0.0


def test_the_torques_carry_the_weight() -> None:
    """Power: what the joints give while the body is lifted is the weight fed forward, times the speed."""
    rising = list(commands(BODY, lying(), [REST] * 400, 0.005))
    folded = next(i for i, springs in enumerate(rising) if springs[2].torque != 0.0)
    for before, now in zip(rising[folded + 5 :], rising[folded + 6 : folded + 195], strict=False):
        low, high = (
            -BODY.leg(0).foot((s[0].position, s[1].position, s[2].position))[2] for s in (before, now)
        )
        power = sum(one.torque * one.velocity for one in now)
        share = now[2].torque / standing_knee(high)
        assert power == pytest.approx(share * BODY.mass * GRAVITY * (high - low) / 0.005, rel=0.1, abs=0.3)


def standing_knee(height: float) -> float:
    """Return the torque of a knee that carries a quarter of the weight at a height."""
    leg = BODY.leg(0)
    return -BODY.mass * GRAVITY / 4.0 * leg.jacobian(leg.angles((0.0, 0.08, -height)))[2][2]


def test_it_does_not_step_for_next_to_nothing() -> None:
    *_, before, standing = commands(BODY, lying(), [Twist(0.001, 0.005, 0.001)] * 200)
    assert before == standing


def test_without_positions_nothing_is_commanded() -> None:
    given, memory = BODY.actuate(Twist(0.3), [None] * 12, 0.02, None)
    assert memory is None
    assert all(isinstance(one, msg.Idle) for one in given)


def test_it_goes_on_from_a_copy_of_its_memory() -> None:
    memory: Any = None
    positions = lying()
    for _ in range(150):
        _, memory = BODY.actuate(Twist(0.3, 0.5), positions, 0.02, memory)
    assert BODY.actuate(Twist(0.1), positions, 0.02, copy.deepcopy(memory)) == BODY.actuate(
        Twist(0.1), positions, 0.02, memory
    )


@pytest.mark.parametrize("twist", [Twist(0.4), Twist(0.1, -0.6, 0.15)])
def test_odometry_of_commanded_legs_is_the_twist(twist: Twist) -> None:
    """Feet roll on the floor as they are commanded to, so the way by the joints is that of the twist."""
    walked = [[one.position for one in springs] for springs in commands(BODY, lying(), [twist] * 721, 0.005)]
    way = np.zeros(3)
    for before, now in pairwise(walked[560:]):  # two periods, after it has risen
        way += BODY.travel(before, now)[:3]
    wanted = np.array((twist.linear, twist.angular, twist.lateral)) * 0.005 * (len(walked) - 561)
    assert way == pytest.approx(wanted, rel=0.03, abs=0.01)


def test_travel_is_the_exact_motion_of_feet_that_stay() -> None:
    print("seed 5")
    rng = np.random.default_rng(5)
    body = replace(BODY, foot_radius=0.0)
    for _ in range(8):
        twist = Twist(*rng.uniform(-0.1, 0.1, 3).tolist())
        before: list[float] = []
        now: list[float] = []
        moved = after(twist, 1.0)
        for number, home in enumerate(HOMES):
            place = tuple((np.array(home) + rng.uniform(-0.05, 0.05, 2)).tolist())
            hip = math.copysign(0.18, home[0]), math.copysign(0.06, home[1])
            for angles, (x, y) in ((before, place), (now, seen(place, moved))):
                angles += body.leg(number).angles((x - hip[0], y - hip[1], -0.28))
        travel = body.travel(before, now)
        assert travel[:3] == pytest.approx((twist.linear, twist.angular, twist.lateral), abs=1e-12)
        slopes = np.array(travel[3:])
        for index in range(12):
            step = np.zeros(12)
            step[index] = 1e-6
            up, down = (body.travel(before, (now + sign * step).tolist())[:3] for sign in (1.0, -1.0))
            assert slopes[:, index] == pytest.approx(np.subtract(up, down) / 2e-6, abs=1e-6)


def test_what_it_cannot_be() -> None:
    with pytest.raises(ValueError, match="height must be"):
        replace(BODY, height=0.42)
    with pytest.raises(ValueError, match="another motor"):
        replace(BODY, rear_left=NAMES["front_left"])
    assert BODY.moves_sideways
    assert not BODY.rests_idle


def test_its_measures_come_from_a_urdf() -> None:
    text = (Path(__file__).parents[3] / "fixtures/robots/quadruped.urdf").read_text()
    joints = {name: name for names in NAMES.values() for name in names}
    table = {key: list(names) for key, names in NAMES.items()}
    found = Quadruped.from_urdf(text, joints, table)
    assert found.pop("mass") == pytest.approx(10.48)
    measures = {"hip_x": 0.18, "hip_y": 0.06, "offset": 0.08, "thigh": 0.2, "shank": 0.2, "foot_radius": 0.02}
    assert found == pytest.approx(measures)
    assert Quadruped.from_urdf(text, joints, {}) == {}
    with pytest.raises(ValueError, match="its legs differ"):
        Quadruped.from_urdf(text.replace('xyz="0 0 -0.2"', 'xyz="0 0 -0.21"', 1), joints, table)
    with pytest.raises(ValueError, match="'fl_hip' moves no joint"):
        Quadruped.from_urdf(text, {}, table)
    with pytest.raises(ValueError, match="are no leg"):
        Quadruped.from_urdf(text, joints | {"rr_hip": "rr_knee"}, table)
