"""Regulated pure pursuit: steer at the point a look-ahead distance ahead on the path.

Rules. The look-ahead point lies on the path, at the look-ahead distance from the robot, beyond the place
of the path that is nearest to it; the robot steers on the circle through itself and that point, which is
tangent to its heading (Coulter 1992, CMU-RI-TR-92-01). The distance grows with the speed, within bounds.
The speed is lowered in bends, near obstacles and before the end (Macenski et al. 2023, arXiv 2305.20026).
Where the way ahead lies too far to the side, the robot first turns on the spot. Headings are the estimate's.
Beyond its end the path goes straight on for the look-ahead point's sake, so steering stays calm there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import atan2, hypot, isfinite, sin, sqrt

from brain.belief import Pose
from brain.bodies.differential import wrap
from brain.control.profile import REST, Twist
from brain.planning.line import Line, Point
from protocols.messages import MILLISECOND, SECOND, Nanos


@dataclass(frozen=True, slots=True)
class PursuitSettings:
    """How a path is followed. SI."""

    period: Nanos = 20 * MILLISECOND
    """Between two commands."""
    lookahead_time: float = 1.0
    """s; the look-ahead distance is the speed times this,"""
    lookahead_min: float = 0.25
    """m, but at least this"""
    lookahead_max: float = 1.0
    """m, and at most this"""
    lateral_acceleration: float = 0.5
    """m/s², in bends"""
    turn_from: float = 0.8
    """rad to the look-ahead point from which on the robot turns on the spot,"""
    turn_until: float = 0.1
    """rad, until it is as near as this"""
    turn_gain: float = 3.0
    """rad/s per rad of heading error, on the spot"""
    obstacle_distance: float = 0.3
    """m between the footprint and an obstacle below which the speed is lowered,"""
    obstacle_speed: float = 0.3
    """down to this share of the largest, where they all but touch"""
    braking: float = 0.6
    """Share of the largest deceleration that is planned with before the end of the path."""
    creep: float = 0.04
    """m/s, the lowest speed that is asked for before the end"""
    tolerance: float = 0.05
    """m: the goal is reached within this, as the estimate has it"""
    yaw_tolerance: float = 0.05
    """rad, where a goal has a yaw"""
    idle_after: Nanos = SECOND
    """At rest for so long with nothing to do, the motors are let go."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"{field.name} must be more than 0, not {value}")
        if self.lookahead_max < self.lookahead_min:
            raise ValueError(f"lookahead_max must not be less than lookahead_min, {self.lookahead_min}")
        if self.turn_until >= self.turn_from:
            raise ValueError(f"turn_until must be less than turn_from, {self.turn_from}")
        for name in ("obstacle_speed", "braking"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"{name} is a share: at most 1, not {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the base may do at this moment."""

    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    linear_acceleration: float
    """m/s²"""
    angular_acceleration: float
    """rad/s²"""


class Pursuit:
    """Follows one path after another. State: the path, how far it has come, whether it turns."""

    def __init__(self) -> None:
        self.line: Line | None = None
        self.yaw: float | None = None
        self.along = 0.0
        """m of the path that lie behind"""
        self.turning = False
        self.at_end = False
        """Near enough to the end to have only the last turn before it."""
        self.arrived = False
        """At rest at the end, in the yaw wanted."""
        self.lookahead: Point | None = None
        """Where it steered at last, for pictures and tests."""

    def follow(self, points: tuple[Point, ...], yaw: float | None = None) -> None:
        """Take up a new path (at least one point), and the yaw to end with."""
        self.line, self.yaw = Line(points), yaw
        self.along, self.at_end, self.arrived, self.lookahead = 0.0, False, False, None

    def drop(self) -> None:
        """There is no path any more."""
        self.line, self.yaw, self.lookahead = None, None, None
        self.turning, self.at_end, self.arrived = False, False, False

    def step(
        self, pose: Pose, previous: Twist, bounds: Bounds, clearance: float, settings: PursuitSettings
    ) -> Twist:
        """The twist wanted now, before acceleration limits; rest where there is no path, or at its end.

        `clearance` [m] is what lies between the footprint and the nearest obstacle."""
        if self.line is None:
            return REST
        place = (pose.x, pose.y)
        window = max(1.0, 2.0 * settings.lookahead_max)
        self.along, _ = self.line.project(place, self.along, self.along + window)
        end = self.line.points[-1]
        distance = hypot(end[0] - pose.x, end[1] - pose.y)
        self.arrived = False
        # Having come near enough, a turn on the spot that carries it off a little does not send it back.
        self.at_end = distance <= settings.tolerance * (2.0 if self.at_end else 1.0)
        if self.at_end:
            return self._final_turn(pose, previous, bounds, settings)
        return self._drive(pose, previous, bounds, clearance, distance, settings)

    def _drive(
        self,
        pose: Pose,
        previous: Twist,
        bounds: Bounds,
        clearance: float,
        distance: float,
        settings: PursuitSettings,
    ) -> Twist:
        assert self.line is not None
        remaining = max(self.line.length - self.along, 0.0)
        reach = min(
            max(abs(previous.linear) * settings.lookahead_time, settings.lookahead_min),
            settings.lookahead_max,
        )
        # Past the end, or beside it, only the end itself is left to steer at.
        target = (
            self.line.points[-1]
            if remaining <= settings.tolerance
            else self.line.ahead((pose.x, pose.y), self.along, reach)
        )
        self.lookahead = target
        bearing = wrap(atan2(target[1] - pose.y, target[0] - pose.x) - pose.yaw)
        if abs(bearing) > (settings.turn_until if self.turning else settings.turn_from):
            self.turning = True
            return self._on_the_spot(bearing, previous, bounds, settings)
        self.turning = False
        curvature = 2.0 * sin(bearing) / max(hypot(target[0] - pose.x, target[1] - pose.y), 1e-6)
        to_go = max(remaining, distance if remaining <= settings.tolerance else 0.0)
        speed = self._speed(curvature, to_go, clearance, bounds, settings)
        return Twist(speed, curvature * speed)

    def _speed(
        self, curvature: float, to_go: float, clearance: float, bounds: Bounds, settings: PursuitSettings
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
        braking = sqrt(2.0 * settings.braking * bounds.linear_acceleration * to_go)
        return min(max(min(speed, braking), settings.creep), bounds.linear)

    def _final_turn(self, pose: Pose, previous: Twist, bounds: Bounds, settings: PursuitSettings) -> Twist:
        error = 0.0 if self.yaw is None else wrap(self.yaw - pose.yaw)
        if abs(error) > settings.yaw_tolerance:
            return self._on_the_spot(error, previous, bounds, settings)
        self.turning = False
        self.arrived = abs(previous.linear) < settings.creep and abs(previous.angular) < 0.1
        return REST

    def _on_the_spot(self, error: float, previous: Twist, bounds: Bounds, settings: PursuitSettings) -> Twist:
        """Brake first, then turn; slow enough to be able to stop at the wanted heading."""
        if abs(previous.linear) > settings.creep:
            return REST
        braking = sqrt(2.0 * settings.braking * bounds.angular_acceleration * abs(error))
        rate = min(settings.turn_gain * abs(error), braking, bounds.angular)
        return Twist(0.0, rate if error > 0.0 else -rate)
