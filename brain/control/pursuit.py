"""Regulated pure pursuit: steer at the point one lookahead distance ahead on the path.

Rules. The lookahead point lies on the path, at the lookahead distance from the robot, beyond the point of the
path nearest to it; the robot steers on the circle through itself and that point which is tangent to its
heading (Coulter 1992, CMU-RI-TR-92-01). The distance grows with the speed, within bounds. The speed is
lowered in bends, near obstacles and before the end (Macenski et al. 2023, arXiv 2305.20026). Where the path
lies too far to the side, the robot first turns on the spot. For the lookahead point the path is extended
straight beyond its end, so steering stays calm there.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot, sin, sqrt

from brain.belief import Pose
from brain.bodies.differential import wrap
from brain.checks import ordered, within
from brain.control.profile import REST, Twist
from brain.planning.polyline import Point, Polyline
from protocols.messages import MILLISECOND, SECOND, Nanos


@dataclass(frozen=True, slots=True)
class PursuitSettings:
    """Parameters of path following, SI."""

    period: Nanos = 20 * MILLISECOND
    """Period of the commands."""
    lookahead_time: float = 1.0
    """s; the lookahead distance is the speed times this,"""
    lookahead_min: float = 0.25
    """m, but at least this"""
    lookahead_max: float = 1.0
    """m, and at most this"""
    lateral_acceleration: float = 0.5
    """m/s², in bends"""
    turn_from: float = 0.8
    """rad: bearing of the lookahead point from which on the robot turns on the spot,"""
    turn_until: float = 0.1
    """rad: until the bearing is below this"""
    turn_gain: float = 3.0
    """rad/s per rad of heading error, on the spot"""
    obstacle_distance: float = 0.3
    """m between footprint and obstacle, below which the speed is lowered,"""
    obstacle_speed: float = 0.3
    """down to this share of the largest at no distance"""
    braking: float = 0.6
    """Share of the largest deceleration that is used to brake before the end of the path."""
    creep: float = 0.04
    """m/s, the lowest speed before the end"""
    tolerance: float = 0.05
    """m: the goal is reached within this, by the estimate"""
    yaw_tolerance: float = 0.05
    """rad, if the goal has a yaw"""
    idle_after: Nanos = SECOND
    """After this time at rest with nothing to do, the motors are disarmed."""

    def __post_init__(self) -> None:
        within(
            self,
            period=(1.0, 100.0),
            lookahead_time=(0.01, 10.0, "s"),
            lookahead_min=(0.01, 10.0, "m"),
            lookahead_max=(0.01, 10.0, "m"),
            lateral_acceleration=(0.01, 20.0, "m/s²"),
            turn_from=(0.01, 3.2, "rad"),
            turn_until=(0.001, 3.2, "rad"),
            turn_gain=(0.01, 50.0),
            obstacle_distance=(0.01, 10.0, "m"),
            obstacle_speed=(0.01, 1.0),
            braking=(0.05, 1.0),
            creep=(1e-3, 0.5, "m/s"),
            tolerance=(1e-3, 1.0, "m"),
            yaw_tolerance=(1e-3, 3.2, "rad"),
            idle_after=(10.0, 60_000.0),
        )
        ordered(self, "lookahead_min", "lookahead_max")
        if self.turn_until >= self.turn_from:
            raise ValueError(f"turn_until must be less than turn_from, {self.turn_from}")


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits of the base at this moment."""

    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    linear_acceleration: float
    """m/s²"""
    angular_acceleration: float
    """rad/s²"""


class Pursuit:
    """Path follower. State: the path, the progress along it, whether the robot turns on the spot."""

    def __init__(self) -> None:
        self.path: Polyline | None = None
        self.yaw: float | None = None
        self.along = 0.0
        """m of the path already covered"""
        self.turning = False
        self.at_end = False
        """Within tolerance of the end: only the final turn is left."""
        self.arrived = False
        """At rest at the end, in the wanted yaw."""
        self.lookahead: Point | None = None
        """Point last steered at, for tests."""

    def follow(self, points: tuple[Point, ...], yaw: float | None = None) -> None:
        """Follow a new path (at least one point), ending in this yaw if given."""
        self.path, self.yaw = Polyline(points), yaw
        self.along, self.at_end, self.arrived, self.lookahead = 0.0, False, False, None

    def drop(self) -> None:
        """Forget the path."""
        self.path, self.yaw, self.lookahead = None, None, None
        self.turning, self.at_end, self.arrived = False, False, False

    def step(
        self, pose: Pose, previous: Twist, bounds: Bounds, clearance: float, settings: PursuitSettings
    ) -> Twist:
        """Return the wanted twist, before acceleration limits; rest if there is no path, or at its end.

        `clearance` [m] is the distance between the footprint and the nearest obstacle."""
        if self.path is None:
            return REST
        position = (pose.x, pose.y)
        window = max(1.0, 2.0 * settings.lookahead_max)
        self.along, _ = self.path.project(position, self.along, self.along + window)
        end = self.path.points[-1]
        distance = hypot(end[0] - pose.x, end[1] - pose.y)
        self.arrived = False
        # Hysteresis: drifting off a little during the final turn must not send the robot back.
        self.at_end = distance <= settings.tolerance * (2.0 if self.at_end else 1.0)
        if self.at_end:
            return self._final_turn(pose, previous, bounds, settings)
        remaining = max(self.path.length - self.along, 0.0)
        lookahead = min(
            max(abs(previous.linear) * settings.lookahead_time, settings.lookahead_min),
            settings.lookahead_max,
        )
        # Past the end, or beside it, steer at the end itself.
        target = (
            self.path.points[-1]
            if remaining <= settings.tolerance
            else self.path.ahead((pose.x, pose.y), self.along, lookahead)
        )
        self.lookahead = target
        bearing = wrap(atan2(target[1] - pose.y, target[0] - pose.x) - pose.yaw)
        if abs(bearing) > (settings.turn_until if self.turning else settings.turn_from):
            self.turning = True
            return self._on_the_spot(bearing, previous, bounds, settings)
        self.turning = False
        curvature = 2.0 * sin(bearing) / max(hypot(target[0] - pose.x, target[1] - pose.y), 1e-6)
        distance_left = max(remaining, distance if remaining <= settings.tolerance else 0.0)
        speed = self._speed(curvature, distance_left, clearance, bounds, settings)
        return Twist(speed, curvature * speed)

    def _speed(
        self,
        curvature: float,
        distance_left: float,
        clearance: float,
        bounds: Bounds,
        settings: PursuitSettings,
    ) -> float:
        speed = bounds.linear
        if abs(curvature) > 1e-6:
            speed = min(
                speed, sqrt(settings.lateral_acceleration / abs(curvature)), bounds.angular / abs(curvature)
            )
        if clearance < settings.obstacle_distance:
            share = max(clearance, 0.0) / settings.obstacle_distance
            speed = min(
                speed, bounds.linear * (settings.obstacle_speed + (1.0 - settings.obstacle_speed) * share)
            )
        braking = sqrt(2.0 * settings.braking * bounds.linear_acceleration * distance_left)
        return min(max(min(speed, braking), settings.creep), bounds.linear)

    def _final_turn(self, pose: Pose, previous: Twist, bounds: Bounds, settings: PursuitSettings) -> Twist:
        error = 0.0 if self.yaw is None else wrap(self.yaw - pose.yaw)
        if abs(error) > settings.yaw_tolerance:
            return self._on_the_spot(error, previous, bounds, settings)
        self.turning = False
        self.arrived = abs(previous.linear) < settings.creep and abs(previous.angular) < 0.1
        return REST

    def _on_the_spot(self, error: float, previous: Twist, bounds: Bounds, settings: PursuitSettings) -> Twist:
        """Brake first, then turn, slowly enough to be able to stop at the wanted heading."""
        if abs(previous.linear) > settings.creep:
            return REST
        braking = sqrt(2.0 * settings.braking * bounds.angular_acceleration * abs(error))
        rate = min(settings.turn_gain * abs(error), braking, bounds.angular)
        return Twist(0.0, rate if error > 0.0 else -rate)
