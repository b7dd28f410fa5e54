"""Following a path with a base whose motion lags behind its commands: errors, times, limits."""

from __future__ import annotations

from dataclasses import replace
from math import atan2, cos, hypot, inf, pi, sin

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import REST, Twist, wrap
from brain.control import track
from brain.control.pursuit import Pursuit, PursuitSettings
from brain.planning.polyline import Point
from gateway.config import load_robot
from tests.brain.control.ride import Path, Ride, acceleration, jerk, off
from tests.brain.helpers import BODY

Points = tuple[Point, ...]
SETTINGS = PursuitSettings()
CORNER: Points = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0))


def circle(radius: float, share: float = 0.9) -> Points:
    angles = np.linspace(0.0, 2.0 * pi * share, 120)
    return tuple((radius * sin(a), radius * (1.0 - cos(a))) for a in angles.tolist())


def begun(points: Points, **ride: object) -> Ride:
    (ax, ay), (bx, by) = points[:2]
    made = Ride(BODY, Pose(ax, ay, atan2(by - ay, bx - ax)), **ride)  # type: ignore[arg-type]  # settings, lag
    made.follow(Path(points))
    return made


PATHS: dict[str, tuple[Points, float]] = {
    "straight": (((0.0, 0.0), (3.0, 0.0)), 3.0 / 0.6 + 0.75),
    "corner of 90°": (CORNER, 4.0 / 0.6 + 0.75 + 1.28),  # turning on the spot takes no less
    "corner of 45°": (((0.0, 0.0), (2.0, 0.0), (3.4, 1.4)), 3.98 / 0.6 + 0.75),
    "two corners": (((0.0, 0.0), (1.0, 0.0), (1.5, 0.5), (2.5, 0.5), (3.0, 0.0), (4.0, 0.0)), 8.1),
    "hairpin": (((0.0, 0.0), (2.0, 0.0), (0.0, 0.1)), 4.0 / 0.6 + 1.5 + 2.07),
    "circle of 0.6 m": (circle(0.6), 1.2 * pi * 0.9 / 0.55 + 0.75),
    "circle of 2 m": (circle(2.0), 4.0 * pi * 0.9 / 0.6 + 0.75),
}


@pytest.mark.parametrize(("points", "bound"), PATHS.values(), ids=list(PATHS))
def test_a_path_is_held_in_little_more_than_the_least_time(points: Points, bound: float) -> None:
    ride = begun(points, lag=0.06)
    assert ride.run(30.0)
    away = off(ride.track, points)
    assert float(np.sqrt((away**2).mean())) < 0.015
    assert away.max() < 0.04
    assert hypot(ride.pose.x - points[-1][0], ride.pose.y - points[-1][1]) < 0.01
    assert len(ride.track) * 0.02 < 1.2 * bound
    speeds = [twist.linear for twist in ride.commanded]
    assert jerk(speeds) <= BODY.max_linear_jerk * 1.001
    assert acceleration(speeds) <= BODY.max_linear_acceleration * 1.001
    turns = [twist.angular for twist in ride.commanded]
    assert acceleration(turns) <= BODY.max_angular_acceleration * 1.001
    assert jerk(turns) <= BODY.max_angular_jerk * 1.45  # what the arc needs, and what corrects it
    assert max(map(abs, turns)) <= BODY.max_angular + 1e-9
    assert max(speeds) <= BODY.max_linear + 1e-9


def test_backward_is_driven_as_forward_and_the_gear_changes_at_rest() -> None:
    points: Points = ((0.0, 0.0), (1.5, 0.0), (1.0, 0.0), (0.3, 0.4))
    ride = Ride(BODY, Pose(0.0, 0.0, 0.0))
    ride.follow(Path(points, gears=(1, -1, -1)))
    assert ride.run(20.0)
    assert off(ride.track, points).max() < 0.04
    assert min(twist.linear for twist in ride.commanded) < -0.25
    assert abs(wrap(ride.pose.yaw - atan2(-0.4, 0.7))) < 0.1
    shift = next(i for i, twist in enumerate(ride.commanded) if twist.linear < 0.0)
    assert abs(ride.commanded[shift - 1].linear) < 0.02


@pytest.mark.parametrize(("name", "yaw"), [("mecanum", None), ("omni", 0.0), ("swerve", -1.5)])
def test_what_moves_sideways_turns_on_its_way_and_stays_on_its_path(name: str, yaw: float | None) -> None:
    ride = Ride(base(name), Pose(0.0, 0.0, 0.0))
    ride.follow(Path(CORNER), yaw)
    assert ride.run(9.0)
    assert off(ride.track, CORNER).max() < 0.03
    assert hypot(ride.pose.x - 2.0, ride.pose.y - 2.0) < 0.01
    assert yaw is None or abs(wrap(ride.pose.yaw - yaw)) <= SETTINGS.yaw_tolerance
    assert any(abs(twist.lateral) > 0.1 for twist in ride.commanded)
    moving = [twist for twist in ride.commanded if twist.speed > 0.1]
    assert (
        max(abs(twist.angular) * ride.body.radius - twist.speed for twist in moving) < 0.1
    )  # no module is passed


def test_what_faces_a_way_by_its_path_faces_it() -> None:
    ride = Ride(base("mecanum"), Pose(0.0, 0.0, 0.0))
    ride.follow(Path(((0.0, 0.0), (0.0, 2.0)), headings=(0.0, 0.0)))
    assert ride.run(9.0)
    assert max(abs(pose.yaw) for pose in ride.track) < 0.01


def test_what_steers_as_a_car_follows_its_curves_with_its_gears_and_never_turns_tighter() -> None:
    car = base("ackermann")
    radius = 1.15 * car.turning_radius
    angles = np.linspace(0.0, 0.5 * pi, 40).tolist()
    there = [(1.0 + radius * sin(a), radius * (1.0 - cos(a))) for a in angles]
    back = [(there[-1][0] + radius * (1.0 - cos(a)), there[-1][1] - radius * sin(a)) for a in angles[1:30]]
    points = ((0.0, 0.0), *there, *back)
    gears = (*[1] * len(there), *[-1] * len(back))
    ride = Ride(car, Pose(0.0, 0.0, 0.0))
    ride.follow(Path(points, gears=gears))
    assert ride.run(30.0)
    assert not ride.motion.pursuit.missed
    assert off(ride.track, points).max() < 0.03
    tight = [abs(t.angular) * car.turning_radius - abs(t.linear) for t in ride.commanded]
    assert max(tight) < 1e-3


def base(name: str) -> Base:
    body = load_robot(name).brain.body
    assert isinstance(body, Base)
    return body


@pytest.mark.parametrize("yaw", [-3.0, 0.7])
def test_a_base_at_rest_turns_to_its_path_first(yaw: float) -> None:
    """The usual defect takes the heading as 0: then only one of these would arrive."""
    points: Points = ((0.0, 0.0), (2.0, 0.0))
    ride = Ride(BODY, Pose(0.0, 0.0, yaw))
    ride.follow(Path(points))
    assert ride.run(20.0)
    assert off(ride.track, points).max() < 0.02
    first = next(twist for twist in ride.commanded if twist.angular != 0.0)
    assert first.angular * yaw <= 0.0


def test_brakes_before_it_turns_on_the_spot() -> None:
    ride = begun(((0.0, 0.0), (3.0, 0.0)))
    ride.run(1.5)
    assert ride.twist.linear > 0.5
    ride.follow(Path(((ride.pose.x, 0.0), (-3.0, 0.0))))
    ride.commanded.clear()
    ride.run(2.0)
    assert all(abs(t.angular) < 1e-9 or abs(t.linear) < 0.05 for t in ride.commanded)


def test_a_bend_is_driven_with_no_more_than_the_acceleration_to_the_side() -> None:
    slowest = []
    for limit in (0.5, 0.1):
        ride = begun(circle(0.8), settings=replace(SETTINGS, lateral_acceleration=limit))
        assert ride.run(60.0)
        assert max(abs(t.linear * t.angular) for t in ride.commanded) < 1.3 * limit
        slowest.append(min(t.linear for t in ride.commanded[100:200]))
    assert slowest[1] < 0.75 * slowest[0]


def test_at_high_speed_the_path_is_held() -> None:
    body = replace(
        BODY,
        max_linear=2.5,
        max_angular=4.0,
        max_linear_acceleration=2.0,
        max_angular_acceleration=8.0,
        max_wheel_speed=None,
    )
    points: Points = ((0.0, 0.0), (6.0, 0.0), (9.0, 3.0), (9.0, 9.0))
    ride = Ride(body, Pose(0.0, 0.3, 0.3), SETTINGS)
    ride.follow(Path(points))
    assert ride.run(30.0)
    assert max(t.linear for t in ride.commanded) > 2.0
    assert off(ride.track[250:], points).max() < 0.08


@pytest.mark.parametrize(
    ("points", "pose", "yaw"),
    [
        *((((0.0, 0.0), (1.0, 0.5)), Pose(0.0, 0.0, 0.0), yaw) for yaw in (-2.5, 3.1)),
        (((0.0, 0.0), (1.0, 0.0)), Pose(1.3, 0.1, 0.0), None),  # past its end
        (((0.5, 0.0),), Pose(0.0, 0.0, 0.0), None),  # a path of one point
    ],
)
def test_ends_at_the_last_point_in_the_yaw_wanted(points: Points, pose: Pose, yaw: float | None) -> None:
    ride = Ride(BODY, pose)
    ride.follow(Path(points), yaw)
    assert ride.run(30.0)
    assert hypot(ride.pose.x - points[-1][0], ride.pose.y - points[-1][1]) <= SETTINGS.tolerance
    assert yaw is None or abs(wrap(ride.pose.yaw - yaw)) <= SETTINGS.yaw_tolerance


def test_slows_down_near_obstacles_and_where_it_is_told_to() -> None:
    near, far, zone = (begun(((0.0, 0.0), (3.0, 0.0))) for _ in range(3))
    near.run(2.0, clearance=0.0)
    far.run(2.0, clearance=SETTINGS.obstacle_distance)
    assert near.twist.linear == pytest.approx(SETTINGS.obstacle_speed * BODY.max_linear, rel=0.01)
    assert far.twist.linear == pytest.approx(BODY.max_linear, rel=0.01)
    zone.motion.follow(zone.path, None, lambda x, _: 0.15 if 1.0 < x < 2.0 else inf)
    assert zone.run(20.0)
    inside = [t.linear for p, t in zip(zone.track, zone.commanded, strict=True) if 1.05 < p.x < 1.95]
    assert max(inside) < 0.16
    assert max(t.linear for t in zone.commanded) > 0.5


def test_thrown_off_its_path_it_still_arrives() -> None:
    random = np.random.Generator(np.random.PCG64(11))
    ride = begun(CORNER)
    for _ in range(4):
        ride.run(1.0)
        x, y, turn = random.uniform((-0.15, -0.15, -1.0), (0.15, 0.15, 1.0)).tolist()
        ride.pose = Pose(ride.pose.x + x, ride.pose.y + y, wrap(ride.pose.yaw + turn))
    assert ride.run(30.0)
    assert hypot(ride.pose.x - 2.0, ride.pose.y - 2.0) <= SETTINGS.tolerance


def test_noise_of_the_pose_does_not_shake_it() -> None:
    random, points = np.random.Generator(np.random.PCG64(12)), PATHS["two corners"][0]
    ride = begun(points)
    noise = random.normal(0.0, (0.005, 0.005, 0.003), (1500, 3)).tolist()
    ride.seen = lambda pose: Pose(*(v + n for v, n in zip(vars_of(pose), noise.pop(), strict=True)))
    assert ride.run(20.0)
    assert off(ride.track, points).max() < 0.05


def vars_of(pose: Pose) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw


def test_without_a_path_or_where_nothing_may_be_driven_it_rests() -> None:
    pursuit = Pursuit()
    assert pursuit.step(Pose(0, 0, 0), REST, 1.0, inf, BODY, SETTINGS) == REST
    for yaw in (0.0, 2.0):
        pursuit.follow(((0.0, 0.0), (2.0, 0.5)), None, BODY, SETTINGS)
        assert pursuit.step(Pose(0, 0, yaw), Twist(0.3), 0.0, inf, BODY, SETTINGS) == REST
    pursuit.drop()
    assert pursuit.step(Pose(0, 0, 0), REST, 1.0, inf, BODY, SETTINGS) == REST


def test_what_cannot_turn_on_the_spot_tells_that_it_has_missed_the_end() -> None:
    ride = Ride(base("ackermann"), Pose(0.0, 0.0, 0.0))
    ride.follow(Path(((0.0, 0.0), (1.5, 0.0))), yaw=1.5)
    assert not ride.run(8.0)
    assert ride.motion.pursuit.missed == "it ended with its yaw 1.50 rad off"
    assert ride.motion.twist == REST


@pytest.mark.parametrize("angular_jerk", [5.0, 20.0, 500.0])
def test_turns_on_the_spot_end_whatever_the_jerk_is(angular_jerk: float) -> None:
    ride = Ride(replace(BODY, max_angular_jerk=angular_jerk), Pose(0.0, 0.0, 0.1))
    ride.follow(Path(((0.0, 0.0), (-1.0, 0.0))), yaw=1.0)
    assert ride.run(20.0)
    assert abs(wrap(ride.pose.yaw - 1.0)) <= SETTINGS.yaw_tolerance


def zigzag(legs: int) -> Points:
    """Legs of 3 m, and corners of a right angle."""
    return tuple((3.0 * ((i + 1) // 2), 3.0 * (i // 2)) for i in range(legs + 1))


def test_a_path_of_kilometres_is_held_as_one_of_metres() -> None:
    """It is made round at places as near to each other, since only a part of it is looked at."""
    pursuit = Pursuit()
    for legs in (10, 2000):
        pursuit.follow(points := zigzag(legs), None, BODY, SETTINGS)
        run = pursuit.runs[0]
        places = (run.place(float(along)) for along in np.arange(0.0, 25.0, 0.05))
        near = [Pose(place.x, place.y, 0.0) for place in places]
        assert off(near, points).max() < 1.1 * SETTINGS.corner
        assert len(run.at) <= 3001
    assert pursuit.end == points[-1]


def test_a_long_path_is_driven_part_by_part_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if it were driven as one, also where it turns back and where it goes backward."""
    points: Points = (*zigzag(3), (9.0, 3.0), (6.0, 3.0), (3.0, 3.0))
    gears = (1, 1, 1, 1, -1, -1)
    rides = []
    for share in (1, 10):
        with monkeypatch.context() as patch:
            patch.setattr(track, "MAX_SAMPLES", 3000 // share)
            ride = Ride(BODY, Pose(0.0, 0.0, 0.0))
            ride.follow(Path(points, gears=gears))
            assert len(ride.motion.pursuit.runs) == (2 if share == 1 else 1)
            assert ride.run(60.0)
        rides.append(ride)
    whole, parts = rides
    assert off(parts.track, points).max() < 0.04
    assert hypot(parts.pose.x - 3.0, parts.pose.y - 3.0) < 0.01
    assert abs(len(parts.track) - len(whole.track)) < 5
    assert min(twist.linear for twist in parts.commanded) < -0.5
    speeds = [twist.linear for twist in parts.commanded]
    assert jerk(speeds) <= BODY.max_linear_jerk * 1.001
