"""Regulated pure pursuit, on ideal wheels."""

from __future__ import annotations

from dataclasses import replace
from math import atan2, cos, hypot, inf, pi, sin

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.differential import arc, wrap
from brain.control.profile import REST, Twist, approach
from brain.control.pursuit import Bounds, Pursuit, PursuitSettings
from brain.planning.polyline import Point, Polyline

BOUNDS = Bounds(0.6, 2.0, 0.8, 4.0)
SETTINGS = PursuitSettings()


class Ride:
    """An ideal base, at 50 Hz."""

    def __init__(
        self, points: tuple[Point, ...], pose: Pose, yaw: float | None = None, bounds: Bounds = BOUNDS
    ) -> None:
        self.pursuit, self.pose, self.twist, self.bounds = Pursuit(), pose, REST, bounds
        self.pursuit.follow(points, yaw)
        self.track: list[tuple[Pose, Twist]] = []

    def run(self, span: float, settings: PursuitSettings = SETTINGS, clearance: float = inf) -> bool:
        for _ in range(round(span / 0.02)):
            wanted = self.pursuit.step(self.pose, self.twist, self.bounds, clearance, settings)
            assert abs(wanted.linear) <= self.bounds.linear + 1e-12
            assert abs(wanted.angular) <= self.bounds.angular + 1e-12
            self.twist = approach(
                self.twist, wanted, 0.02, self.bounds.linear_acceleration, self.bounds.angular_acceleration
            )
            self.pose = arc(self.pose, self.twist.linear * 0.02, self.twist.angular * 0.02)
            self.track.append((self.pose, self.twist))
            if self.pursuit.arrived:
                return True
        return False

    def off(self, points: tuple[Point, ...]) -> float:
        """The largest distance from the path."""
        line = Polyline(points)
        return max(line.project((pose.x, pose.y))[1] for pose, _ in self.track)


def circle(radius: float, share: float = 0.9) -> tuple[Point, ...]:
    angles = np.linspace(0.0, 2.0 * pi * share, 120)
    return tuple((radius * sin(a), radius * (1.0 - cos(a))) for a in angles.tolist())


@pytest.mark.parametrize("radius", [0.6, 1.0, 2.0])
def test_a_circle_is_tracked(radius: float) -> None:
    ride = Ride(circle(radius), Pose(0.0, 0.0, 0.0))
    assert ride.run(60.0)
    # A chord as long as the lookahead cuts its arc by L² / (8 R).
    assert ride.off(circle(radius)) < 0.01 + 0.6**2 / (8.0 * radius)


def test_steers_at_the_point_a_lookahead_away_and_not_at_the_last() -> None:
    points = ((0.0, 0.0), (1.0, 0.0), (1.0, 5.0), (-3.0, 5.0))
    ride = Ride(points, Pose(0.1, 0.05, 0.2))
    ride.twist = Twist(0.5, 0.0)
    wanted = ride.pursuit.step(ride.pose, ride.twist, BOUNDS, inf, SETTINGS)
    at = ride.pursuit.lookahead
    assert at is not None
    distance = hypot(at[0] - 0.1, at[1] - 0.05)
    assert distance == pytest.approx(0.5 * SETTINGS.lookahead_time)
    assert at[1] == 0.0
    bearing = atan2(at[1] - 0.05, at[0] - 0.1) - 0.2
    assert wanted.angular == pytest.approx(wanted.linear * 2.0 * sin(bearing) / distance)


@pytest.mark.parametrize(("speed", "distance"), [(0.0, 0.25), (0.4, 0.4), (0.6, 0.6), (5.0, 1.0)])
def test_the_lookahead_grows_with_the_speed_within_bounds(speed: float, distance: float) -> None:
    ride = Ride(((0.0, 0.0), (9.0, 0.0)), Pose(0.0, 0.0, 0.0))
    ride.pursuit.step(ride.pose, Twist(speed, 0.0), BOUNDS, inf, SETTINGS)
    assert ride.pursuit.lookahead == pytest.approx((distance, 0.0))


@pytest.mark.parametrize("yaw", [-3.0, -1.5, 0.0, 0.7, 2.2])
def test_control_uses_the_estimated_heading(yaw: float) -> None:
    """The usual defect takes the heading as 0: then only one of these would arrive."""
    ride = Ride(((0.0, 0.0), (2.0, 0.0)), Pose(0.0, 0.0, yaw))
    assert ride.run(20.0)
    assert hypot(ride.pose.x - 2.0, ride.pose.y) <= SETTINGS.tolerance
    first = next(twist for _, twist in ride.track if twist.angular != 0.0) if yaw else REST
    assert first.angular * yaw <= 0.0


def test_turns_on_the_spot_where_the_way_is_behind() -> None:
    ride = Ride(((0.0, 0.0), (-2.0, 0.0)), Pose(0.0, 0.0, 0.1))
    assert ride.run(20.0)
    turning = [pose for pose, twist in ride.track if abs(wrap(pose.yaw - pi)) > SETTINGS.turn_from]
    assert turning
    assert max(hypot(p.x, p.y) for p in turning) < 1e-9


def test_brakes_before_it_turns_on_the_spot() -> None:
    ride = Ride(((0.0, 0.0), (3.0, 0.0)), Pose(0.0, 0.0, 0.0))
    ride.run(1.5)
    assert ride.twist.linear > 0.5
    ride.pursuit.follow(((ride.pose.x, 0.0), (-3.0, 0.0)))
    ride.track.clear()
    ride.run(2.0)
    assert all(abs(t.angular) < 1e-9 or abs(t.linear) < 2 * SETTINGS.creep for _, t in ride.track)


def test_a_sharp_turn_is_driven_slowly_and_near_the_corner() -> None:
    points = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0))
    slowest = []
    for limit in (0.5, 0.15):
        ride = Ride(points, Pose(0.0, 0.0, 0.0))
        assert ride.run(30.0, replace(SETTINGS, lateral_acceleration=limit))
        assert ride.off(points) < 0.2
        assert max(abs(t.linear * t.angular) for _, t in ride.track) < 1.5 * limit  # braking takes its time
        slowest.append(min(t.linear for p, t in ride.track if hypot(p.x - 2.0, p.y) < 0.25))
    assert slowest[1] < 0.75 * slowest[0] < 0.75 * BOUNDS.linear


def test_a_hairpin_is_followed() -> None:
    points = ((0.0, 0.0), (2.0, 0.0), (0.0, 0.1))
    ride = Ride(points, Pose(0.0, 0.0, 0.0))
    assert ride.run(40.0)
    assert max(p.x for p, _ in ride.track) > 1.7
    assert hypot(ride.pose.x, ride.pose.y - 0.1) <= SETTINGS.tolerance


def test_at_high_speed_the_path_is_held() -> None:
    bounds = Bounds(2.5, 4.0, 2.0, 8.0)
    points = ((0.0, 0.0), (6.0, 0.0), (9.0, 3.0), (9.0, 9.0))
    ride = Ride(points, Pose(0.0, 0.3, 0.3), bounds=bounds)
    assert ride.run(30.0)
    assert max(t.linear for _, t in ride.track) > 2.0
    assert ride.off(points) < 0.35


def test_slows_down_before_the_goal_and_stops_within_the_tolerance() -> None:
    ride = Ride(((0.0, 0.0), (3.0, 0.0)), Pose(0.0, 0.0, 0.0))
    assert ride.run(20.0)
    assert hypot(ride.pose.x - 3.0, ride.pose.y) <= 0.08
    assert abs(ride.twist.linear) < 0.05
    braking = SETTINGS.braking * BOUNDS.linear_acceleration
    for pose, twist in ride.track:
        assert twist.linear <= (2.0 * braking * max(3.0 - pose.x, 0.0)) ** 0.5 + SETTINGS.creep + 0.03


@pytest.mark.parametrize(
    ("points", "pose", "yaw"),
    [
        *((((0.0, 0.0), (1.0, 0.5)), Pose(0.0, 0.0, 0.0), yaw) for yaw in (-2.5, 0.0, 1.57, 3.1)),
        (((0.0, 0.0), (1.0, 0.0)), Pose(1.3, 0.1, 0.0), None),  # past its end
        (((0.5, 0.0),), Pose(0.0, 0.0, 0.0), None),  # a path of one point
    ],
)
def test_ends_at_the_last_point_in_the_yaw_wanted(
    points: tuple[Point, ...], pose: Pose, yaw: float | None
) -> None:
    ride = Ride(points, pose, yaw)
    assert ride.run(30.0)
    assert hypot(ride.pose.x - points[-1][0], ride.pose.y - points[-1][1]) <= 0.08
    assert yaw is None or abs(wrap(ride.pose.yaw - yaw)) <= 0.08


def test_slows_down_near_obstacles() -> None:
    near, far = (Ride(((0.0, 0.0), (3.0, 0.0)), Pose(0.0, 0.0, 0.0)) for _ in range(2))
    near.run(2.0, clearance=0.0)
    far.run(2.0, clearance=SETTINGS.obstacle_distance)
    assert near.twist.linear == pytest.approx(SETTINGS.obstacle_speed * BOUNDS.linear)
    assert far.twist.linear == pytest.approx(BOUNDS.linear)


def test_thrown_off_its_path_it_still_arrives() -> None:
    rng = np.random.Generator(np.random.PCG64(11))
    for _ in range(10):
        ride = Ride(((0.0, 0.0), (2.0, 0.0), (2.0, 2.0)), Pose(0.0, 0.0, 0.0))
        for _ in range(4):
            ride.run(1.0)
            push = rng.uniform(-0.15, 0.15, 2)
            turn = float(rng.uniform(-1.0, 1.0))
            ride.pose = Pose(
                ride.pose.x + float(push[0]), ride.pose.y + float(push[1]), wrap(ride.pose.yaw + turn)
            )
        assert ride.run(30.0)
        assert hypot(ride.pose.x - 2.0, ride.pose.y - 2.0) <= 0.08


def test_without_a_path_it_rests() -> None:
    pursuit = Pursuit()
    assert pursuit.step(Pose(0, 0, 0), REST, BOUNDS, inf, SETTINGS) == REST
    pursuit.follow(((1.0, 0.0), (2.0, 0.0)))
    pursuit.drop()
    assert pursuit.step(Pose(0, 0, 0), REST, BOUNDS, inf, SETTINGS) == REST


def test_where_nothing_may_be_driven_it_rests() -> None:
    pursuit, none = Pursuit(), Bounds(0.0, 0.0, 0.8, 4.0)
    for yaw in (0.0, 2.0):
        pursuit.follow(((0.0, 0.0), (2.0, 0.5)))
        twist = pursuit.step(Pose(0, 0, yaw), REST, none, inf, SETTINGS)
        assert (abs(twist.linear), abs(twist.angular)) == (0.0, 0.0)
