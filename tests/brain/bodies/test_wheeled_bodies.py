"""What holds for every body on wheels: one row of the table each.

Oracles: scipy's matrix exponential for the motion, the velocity of each wheel's hub for what it rolls, finite
differences for derivatives, Monte Carlo for the covariance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from brain.belief import Pose
from brain.bodies.ackermann import Ackermann
from brain.bodies.body import Base
from brain.bodies.differential import Differential
from brain.bodies.mecanum import Mecanum
from brain.bodies.omni import Omni
from brain.bodies.plane import Twist, arc
from brain.bodies.skid_steer import SkidSteer
from brain.bodies.swerve import Swerve
from brain.bodies.tracked import Tracked
from brain.bodies.wheels import nearest
from protocols import messages as msg

LIMITS: dict[str, Any] = {
    "wheel_radius": 0.05,
    "radius": 0.4,
    "max_linear": 1.0,
    "max_angular": 2.0,
    "max_linear_acceleration": 1.0,
    "max_angular_acceleration": 4.0,
}
THREE = tuple((0.2 * math.cos(a), 0.2 * math.sin(a)) for a in (0.5, 2.6, 4.7))
SQUARE = ((0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15))
CAR = Ackermann(steering=("sl", "sr"), drive=("l", "r"), wheelbase=0.5, wheel_separation=0.3, **LIMITS)
SWERVE = Swerve(drive=("d0", "d1", "d2", "d3"), steering=("s0", "s1", "s2", "s3"), places=SQUARE, **LIMITS)
MECANUM = Mecanum(
    front_left="fl",
    front_right="fr",
    rear_left="rl",
    rear_right="rr",
    wheelbase=0.4,
    wheel_separation=0.3,
    **LIMITS,
)
BODIES: dict[str, Base] = {
    "differential": Differential(left="l", right="r", wheel_separation=0.3, **LIMITS),
    "tracked": Tracked(left="l", right="r", effective_separation=0.5, **LIMITS),
    "skid_steer": SkidSteer(left=("a", "b"), right=("c", "d"), effective_separation=0.5, **LIMITS),
    "mecanum": MECANUM,
    "omni of three": Omni(
        wheels=("a", "b", "c"),
        places=THREE,
        directions=tuple(a + math.pi / 2 for a in (0.5, 2.6, 4.7)),
        **LIMITS,
    ),
    "omni of four": Omni(
        wheels=("a", "b", "c", "d"), places=SQUARE, directions=(2.3, 0.8, -2.3, -0.8), roller=0.2, **LIMITS
    ),
    "ackermann": CAR,
    "ackermann with a linkage": replace(CAR, steering=("s",), drive=("d",)),
    "ackermann, narrow in front": replace(CAR, steering_separation=0.2, drive=("d",)),
    "swerve": SWERVE,
    "swerve of two": replace(SWERVE, drive=("d", "e"), steering=("s", "t"), places=((0.2, 0.0), (-0.2, 0.1))),
    "swerve that steers by 100 degrees": replace(SWERVE, max_steering=1.75),
}
each_body = pytest.mark.parametrize("name", BODIES)


def able(body: Base, rng: np.random.Generator) -> Twist:
    """A twist that the body can drive."""
    linear, angular, lateral = rng.uniform(-1.0, 1.0, 3)
    return body.limit(Twist(linear, 2.0 * angular, lateral if body.moves_sideways else 0.0))


def driven(body: Base, twist: Twist, duration: float) -> tuple[list[float], list[float]]:
    """Joint positions before and after: wheels steered from the start, and turning at constant speed."""
    steered = [0.0 if one.position is None else one.position for one in body.inverse(twist, (None,) * 99)]
    setpoints = body.inverse(twist, steered)
    return steered, [p + duration * (one.velocity or 0.0) for p, one in zip(steered, setpoints, strict=True)]


def exponential(twist: Twist, duration: float) -> np.ndarray[Any, Any]:
    """The pose as a matrix, by scipy."""
    v, w, u = twist.linear, twist.angular, twist.lateral
    return np.asarray(scipy.linalg.expm(np.array([[0.0, -w, v], [w, 0.0, u], [0.0, 0.0, 0.0]]) * duration))


@each_body
def test_wheels_that_turn_as_told_move_the_base_by_the_exponential_of_its_twist(name: str) -> None:
    body, rng = BODIES[name], np.random.default_rng(1)
    for _ in range(40):
        twist, duration = able(body, rng), rng.uniform(0.1, 3.0)
        travel = body.travel(*driven(body, twist, duration))
        end = arc(Pose(0.0, 0.0, 0.0), travel.distance, travel.turn, travel.sideways)
        wanted = exponential(twist, duration)
        assert (end.x, end.y) == pytest.approx((wanted[0, 2], wanted[1, 2]), abs=1e-9)
        assert math.cos(end.yaw) == pytest.approx(wanted[0, 0], abs=1e-9)
        assert math.sin(end.yaw) == pytest.approx(wanted[1, 0], abs=1e-9)
        there = np.array(
            [[math.cos(0.7), -math.sin(0.7), 3.0], [math.sin(0.7), math.cos(0.7), -2.0], [0, 0, 1]]
        )
        end, wanted = arc(Pose(3.0, -2.0, 0.7), travel.distance, travel.turn, travel.sideways), there @ wanted
        assert (end.x, end.y) == pytest.approx((wanted[0, 2], wanted[1, 2]), abs=1e-9)


ON_THE_FLOOR: dict[str, tuple[list[tuple[float, float, float | None, float]], float]] = {
    "mecanum": (
        [(0.2, 0.15, 0.0, 1.0), (0.2, -0.15, 0.0, -1.0), (-0.2, 0.15, 0.0, -1.0), (-0.2, -0.15, 0.0, 1.0)],
        math.pi / 4,
    ),
    "omni of three": (
        [(x, y, a + math.pi / 2, 1.0) for (x, y), a in zip(THREE, (0.5, 2.6, 4.7), strict=True)],
        0.0,
    ),
    "swerve": ([(x, y, None, 1.0) for x, y in SQUARE], 0.0),
}


@pytest.mark.parametrize("name", ON_THE_FLOOR)
def test_what_a_wheel_rolls_is_how_its_hub_moves_over_the_floor(name: str) -> None:
    """Each hub moves by a sum of rolling and of motion in the rollers' free direction: along an omni
    wheel's axle; of Mecanum wheels by 45 degrees, towards the middle of the base."""
    body, rng = BODIES[name], np.random.default_rng(2)
    wheels, roller = ON_THE_FLOOR[name]
    for _ in range(10):
        twist = able(body, rng)
        before, after = driven(body, twist, 1.0)
        yaws = twist.angular * (np.arange(400) + 0.5) / 400
        for index, (x, y, direction, side) in enumerate(wheels):
            along = before[len(wheels) + index] if direction is None else direction
            free = along + math.pi / 2 - side * roller
            vx, vy = twist.linear - twist.angular * y, twist.lateral + twist.angular * x
            velocities = np.array(
                [np.cos(yaws) * vx - np.sin(yaws) * vy, np.sin(yaws) * vx + np.cos(yaws) * vy]
            )
            axes = np.array([[np.cos(yaws + a), np.sin(yaws + a)] for a in (along, free)]).transpose(2, 1, 0)
            rolled, across = np.linalg.solve(axes, velocities.T[..., None])[..., 0].mean(axis=0)
            if direction is None:
                assert across == pytest.approx(0.0, abs=1e-9)  # a module never scrubs
            assert rolled == pytest.approx(0.05 * (after[index] - before[index]), abs=1e-9)


@each_body
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    """Of joints that do not agree either: wheels slip."""
    body, rng = BODIES[name], np.random.default_rng(3)
    count, step = len(body.joints), 1e-6
    for _ in range(20):
        before = rng.uniform(-0.5, 0.5, count).tolist()
        after = (np.array(before) + rng.uniform(-0.5, 0.5, count)).tolist()
        travel = body.travel(before, after)
        for joint in range(count):
            more, less = list(after), list(after)
            more[joint] += step
            less[joint] -= step
            ahead, behind = body.travel(before, more), body.travel(before, less)
            slopes = [(a - b) / (2 * step) for a, b in zip(ahead[:3], behind[:3], strict=True)]
            assert [by[joint] for by in travel[3:]] == pytest.approx(slopes, abs=1e-8)


@each_body
def test_the_covariance_by_the_derivatives_is_that_of_noisy_encoders(name: str) -> None:
    body, rng = BODIES[name], np.random.default_rng(4)
    before, after = driven(body, able(body, rng), 0.5)
    sigma, count = 0.002, len(body.joints)
    by = np.array(body.travel(before, after)[3:])
    noisy = np.array(after) + sigma * rng.standard_normal((1500, count))
    sample = np.cov(np.array([body.travel(before, row)[:3] for row in noisy.tolist()]).T)
    scale = np.sqrt(np.maximum(np.diag(sample), 1e-18))
    assert sample / np.outer(scale, scale) == pytest.approx(
        sigma**2 * by @ by.T / np.outer(scale, scale), abs=0.15
    )


@each_body
def test_limit_keeps_the_direction_of_motion_and_every_limit(name: str) -> None:
    rng = np.random.default_rng(5)
    for fastest in (None, 6.0):
        body = replace(BODIES[name], max_wheel_speed=fastest)  # type: ignore[call-arg]  # every one has it
        for _ in range(60):
            wanted = Twist(*rng.uniform(-4.0, 4.0, 3))
            got = body.limit(wanted)
            assert math.hypot(got.linear, got.lateral) <= 1.0 + 1e-9
            assert abs(got.angular) <= 2.0 + 1e-9
            for one, most in zip(body.inverse(got, (None,) * 99), body.top_speeds, strict=True):
                assert abs(one.velocity or 0.0) <= most * (1 + 1e-9)
            assert body.limit(got) == pytest.approx(got)
            possible = wanted if body.moves_sideways else wanted._replace(lateral=0.0)
            if abs(wanted.angular) * body.turning_radius <= abs(wanted.linear):
                share = max(got.speed / possible.speed, abs(got.angular / possible.angular))
                assert got == pytest.approx(possible.scaled(share), abs=1e-9)
                assert 0.0 < share <= 1.0
            else:  # the tightest curve instead
                assert abs(got.linear) == pytest.approx(abs(got.angular) * body.turning_radius)


@each_body
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_limit_refuses_what_is_not_finite(name: str, bad: float) -> None:
    for twist in (Twist(bad, 0.0), Twist(0.0, bad), Twist(0.1, 0.0, bad)):
        with pytest.raises(ValueError, match="must be finite"):
            BODIES[name].limit(twist)


@each_body
def test_the_largest_wheel_speed_follows_from_the_largest_speeds(name: str) -> None:
    """It is needed: some twist within the limits reaches it to 5 %; and enough, by the test above."""
    body, rng = BODIES[name], np.random.default_rng(6)
    top, most = [one for one in body.top_speeds if one < math.inf], 0.0
    for _ in range(600):
        angle, turn = rng.uniform(0.0, 2 * math.pi), rng.choice([-2.0, 2.0])
        if body.turning_radius > 0.0 or not body.moves_sideways:
            angle = 0.0
        twist = Twist(math.cos(angle), float(turn), math.sin(angle))
        if body.turning_radius > 0.0:
            twist = Twist(1.0, math.copysign(1.0 / max(body.turning_radius, 0.5), turn))
        most = max(most, *(abs(one.velocity or 0.0) for one in body.inverse(twist, (None,) * 99)))
    assert most == pytest.approx(max(top), rel=0.05)


@each_body
def test_joints_motors_and_lists_have_one_order(name: str) -> None:
    body = BODIES[name]
    named = [getattr(body, key) for key in body.motor_keys()]
    flat = [one for names in named for one in ([names] if isinstance(names, str) else names)]
    assert list(body.joints) == flat
    assert len(body.joints) == len(body.top_speeds) == len(body.rolling)
    first = body.motor_keys()[0]
    value = getattr(body, first)
    nameless: dict[str, Any] = {first: "" if isinstance(value, str) else ("",) * len(value)}
    with pytest.raises(ValueError, match="must name motors"):
        replace(body, **nameless)


# -- published anchors ---------------------------------------------------------------------------------


def test_mecanum_by_the_exponential_has_no_integration_error() -> None:
    """v = 1, vy = 0.5 m/s, w = 1 rad/s for 90 degrees, a path of 1.76 m: with the end
    heading ros2_controllers is 40 mm off at 20 Hz."""
    twist, quarter = Twist(1.0, 1.0, 0.5), math.pi / 2
    pose = Pose(0.0, 0.0, 0.0)
    body = replace(MECANUM, max_linear=2.0)
    before, after = driven(body, twist, quarter / 32)
    for _ in range(32):
        travel = body.travel(before, after)
        pose = arc(pose, travel.distance, travel.turn, travel.sideways)
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((1.0 - 0.5, 1.0 + 0.5, quarter), abs=1e-12)


def test_mecanum_wheels_turn_as_in_the_textbook() -> None:
    """(v - vy - (lx + ly) w) / r of the front left wheel, and the others by its symmetries: Lynch and Park
    2017, equation 13.10; mecanum_drive_controller of ros2_controllers has the same."""
    v, w, u, arm = 0.3, 0.7, -0.2, (0.4 + 0.3) / 2
    wanted = (v - u - arm * w, v + u + arm * w, v + u - arm * w, v - u + arm * w)
    speeds = [one.velocity for one in MECANUM.inverse(Twist(v, w, u))]
    assert speeds == pytest.approx([speed / 0.05 for speed in wanted])


@pytest.mark.parametrize(
    ("steering", "drive"),
    [(("s",), ("d",)), (("s",), ("l", "r")), (("sl", "sr"), ("d",)), (("sl", "sr"), ("l", "r"))],
)
def test_ackermann_odometry_agrees_with_ros2_controllers(
    steering: tuple[str, ...], drive: tuple[str, ...]
) -> None:
    """test_steering_odometry.cpp @03e511c: r = w = b = 1, 1 rad/s, steered by 0.1 rad, for 0.1 s give 1 m/s,
    0.1 rad/s, x 0.1, heading 0.01, to 0.001: `bicycle_odometry` and `ackermann_odometry`. The latter lets two
    wheels turn alike in a curve and ignores what that means; here they turn as in the curve."""
    body = replace(CAR, steering=steering, drive=drive, wheel_radius=1.0, wheelbase=1.0, wheel_separation=1.0)
    angles = (0.1,) * len(steering)
    rolled = (0.1,) if len(drive) == 1 else (0.095, 0.105)
    travel = body.travel((*angles, *(0.0,) * len(drive)), (*angles, *rolled))
    assert travel.distance / 0.1 == pytest.approx(1.0, abs=1e-3)
    assert travel.turn / 0.1 == pytest.approx(0.1, abs=1e-3)
    end = arc(Pose(0.0, 0.0, 0.0), travel.distance, travel.turn)
    assert (end.x, end.yaw) == pytest.approx((0.1, 0.01), abs=1e-3)


def test_the_inner_front_wheel_steers_more() -> None:
    """cot(outer) - cot(inner) = track / wheelbase: Ackermann's condition (Gillespie 1992, equation 6-1)."""
    setpoints = CAR.inverse(Twist(1.0, 0.8), (None,) * 4)
    left, right = setpoints[0].position, setpoints[1].position
    assert left is not None
    assert right is not None
    assert left > right > 0.0
    assert 1 / math.tan(right) - 1 / math.tan(left) == pytest.approx(0.3 / 0.5)


@pytest.mark.parametrize("body", [CAR, replace(CAR, steering=("s",)), replace(CAR, steering_separation=0.1)])
def test_the_turning_radius_is_where_a_steering_joint_is_at_its_limit(body: Ackermann) -> None:
    for side in (-1.0, 1.0):
        for way in (-1.0, 1.0):
            tight = Twist(way, side / body.turning_radius)
            angles = [one.position for one in body.inverse(tight, (None,) * 9) if one.position is not None]
            assert max(map(abs, angles)) == pytest.approx(0.6)
            assert all(angle * side * way > 0.0 for angle in angles)  # forward or backward, the same way
    assert body.limit(Twist(0.0, 1.0)) == Twist(0.0, 0.0)


# -- steering ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", [CAR, SWERVE])
def test_at_rest_the_steering_stays(body: Base) -> None:
    commands, _ = body.actuate(Twist(), (0.3,) * len(body.joints), 0.02, None)
    for command, rolling in zip(commands, body.rolling, strict=True):
        assert command == (msg.Velocity(command.motor, 0.0) if rolling else msg.Hold(command.motor))


@pytest.mark.parametrize(
    ("direction", "present", "most", "wanted"),
    [
        (0.0, 0.0, None, (0.0, False)),
        (math.pi, 0.1, None, (0.0, True)),
        (0.2, 6.3, None, (0.2 + 2 * math.pi, False)),
        (-1.5, 1.5, None, (math.pi - 1.5, True)),
        (-1.5, 1.5, 1.6, (-1.5, False)),
        (3.0, 0.0, 0.6, (3.0 - math.pi, True)),
        (1.0, 0.0, 0.6, (0.6, False)),
    ],
)
def test_a_wheel_steers_the_shortest_way(
    direction: float, present: float, most: float | None, wanted: tuple[float, bool]
) -> None:
    assert nearest(direction, present, most) == pytest.approx(wanted)


def test_a_wheel_is_driven_by_what_lies_in_its_direction() -> None:
    for angle in (0.0, 0.5, 1.0, 1.5, 2.0, 3.0):
        commands, _ = SWERVE.actuate(Twist(0.0, 0.0, 1.0), (angle,) * 8, 0.02, None)
        rolled = [one.velocity for one in commands if isinstance(one, msg.Velocity)]
        assert rolled == pytest.approx([math.sin(angle) / SWERVE.wheel_radius] * 4)


def test_a_wheel_is_steered_for_the_twist_when_it_will_be_there() -> None:
    """A module that comes to rest and then rolls to the left: it steers before it stands."""
    before, now = Twist(0.02, 0.0, 0.0), Twist(0.01, 0.0, 0.01)
    _, memory = SWERVE.actuate(before, (0.0,) * 8, 0.02, None)
    commands, _ = SWERVE.actuate(now, (0.0,) * 8, 0.02, memory)
    steps = SWERVE.steering_lag / 0.02
    wanted = math.atan2(0.01 + steps * 0.01, 0.01 - steps * 0.01)
    assert isinstance(commands[4], msg.Position)
    assert commands[4].position == pytest.approx(math.remainder(wanted, math.pi))


def test_the_direction_of_a_wheel_that_hardly_rolls_matters_little() -> None:
    """A module near the centre of rotation is not waited for."""
    body = replace(SWERVE, places=((0.3, 0.0), (0.003, 0.0), (-0.3, 0.0), (0.0, 0.3)))
    twist = Twist(0.0, 1.0)
    setpoints = body.inverse(twist, (None,) * 8)
    positions = [one.position or 0.0 for one in setpoints]
    positions[5] += math.pi / 2
    assert body.readiness(twist, positions) == pytest.approx(0.9999)
    positions[4] += math.pi / 2
    assert body.readiness(twist, positions) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("body", "change", "message"),
    [
        (CAR, {"steering": ("a", "b", "c")}, "steering must name one motor, or the left and the right one"),
        (CAR, {"drive": ()}, "drive must name one motor"),
        (CAR, {"max_steering": 1.6}, "max_steering must be from 0.05 to 1.5"),
        (SWERVE, {"places": SQUARE[:3]}, "places must be those of the wheels"),
        (SWERVE, {"places": ((99.0, 0.0), *SQUARE[1:])}, "within 10 m"),
        (SWERVE, {"steering": ("a", "b")}, "as many motors as drive"),
        (SWERVE, {"max_steering": 1.0}, "max_steering must be from 1.5"),
        (BODIES["omni of three"], {"directions": (0.0, 1.0)}, "directions must be those of the 3 wheels"),
        (BODIES["omni of three"], {"directions": (0.0, 0.0, 0.0)}, "do not determine how the base moves"),
        (BODIES["omni of three"], {"directions": (0.0, 1.0, math.nan)}, "directions must be from"),
        (BODIES["skid_steer"], {"left": ()}, "do not determine how the base moves"),
    ],
)
def test_what_is_no_base_is_refused(body: Base, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(body, **change)
