"""Following a path: the speed allowed on it, and the curvature that leads back to it.

Rules. The path is driven run by run (`brain.control.track`). The base is compared with the place of the run
nearest to where it will be when a command takes effect. What cannot move sideways steers by the curvature of
the run there, and by its errors: to the side, e, and in heading, h, so that both vanish within the lookahead
distance L (Samson 1995, "Control of chained systems", with the distance in place of time):

    curvature = k cos h / (1 - k e) - e sinc(h) / L² - 2 sin(h) / L        with sinc(h) = sin(h) / h

What moves sideways corrects its place by its velocity, and turns on its way. A base that turns on the spot
does so where its heading is too far off: at rest for any larger error, on its way for a large one only. It
ends at rest within the tolerance of the goal, with the yaw that is wanted. Backward the base is led by its
rear: the same law with the yaw turned by half a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, cbrt, cos, hypot, pi, sin, sqrt
from typing import Annotated

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.base_profile import JERK, clamp
from brain.bodies.body import Base
from brain.bodies.plane import REST, Twist, arc, wrap
from brain.control.track import TrackPlace, TrackRun, longest, runs
from brain.planning.polyline import Point
from protocols.bounds import Bounds, Duration, Invalid, check, ordered
from protocols.messages import MILLISECOND, SECOND, seconds


@dataclass(frozen=True, slots=True)
class PursuitSettings:
    """Parameters of path following, SI."""

    given: bool = False
    """Another program controls: it drives (ROS 2's `cmd_vel`) along the paths that are planned to the goals;
    without it the base stands."""
    period: Annotated[Duration, Bounds(1.0, 100.0)] = 20 * MILLISECOND
    """Period of the commands."""
    latency: Annotated[Duration, Bounds(0.0, 500.0)] = 40 * MILLISECOND
    """From a command to the motion that it causes"""
    lookahead_time: Annotated[float, Bounds(0.01, 10.0, "s")] = 0.5
    """s; the distance in which errors vanish is the speed times this,"""
    lookahead_min: Annotated[float, Bounds(0.01, 10.0, "m")] = 0.2
    """m, but at least this"""
    lookahead_max: Annotated[float, Bounds(0.01, 10.0, "m")] = 1.0
    """m, and at most this"""
    corner: Annotated[float, Bounds(1e-3, 1.0, "m")] = 0.03
    """m, by which a corner of a path may be cut"""
    lateral_acceleration: Annotated[float, Bounds(0.01, 20.0, "m/s²")] = 0.5
    """m/s², in bends"""
    turn_from: Annotated[float, Bounds(0.01, 3.2, "rad")] = 0.8
    """rad: error of the heading from which on the robot stops and turns on the spot,"""
    turn_until: Annotated[float, Bounds(0.001, 3.2, "rad")] = 0.1
    """rad: until the error is below this; at rest it turns for more than twice this"""
    turn_gain: Annotated[float, Bounds(0.01, 50.0)] = 4.0
    """rad/s per rad of heading error, on the spot"""
    obstacle_distance: Annotated[float, Bounds(0.01, 10.0, "m")] = 0.15
    """m between footprint and obstacle, below which the speed is lowered,"""
    obstacle_speed: Annotated[float, Bounds(0.01, 1.0)] = 0.4
    """down to this share of the largest at no distance"""
    braking: Annotated[float, Bounds(0.05, 1.0)] = 0.8
    """Share of the largest deceleration that is used to brake before bends and the end of the path."""
    creep: Annotated[float, Bounds(1e-3, 0.5, "m/s")] = 0.04
    """m/s, the lowest speed before the end"""
    tolerance: Annotated[float, Bounds(1e-3, 1.0, "m")] = 0.05
    """m: the goal is reached within this, by the estimate"""
    yaw_tolerance: Annotated[float, Bounds(1e-3, 3.2, "rad")] = 0.05
    """rad, if the goal has a yaw"""
    idle_after: Annotated[Duration, Bounds(10.0, 60_000.0)] = SECOND
    """After this time at rest with nothing to do, the motors are disarmed."""

    def __post_init__(self) -> None:
        check(self)
        ordered(self, "lookahead_min", "lookahead_max")
        if self.turn_until >= self.turn_from:
            raise Invalid(("turn_until", f"turn_until must be less than turn_from, {self.turn_from}"))


BEHIND = 1.0
"""m behind the base from where on the runs of a long path are made anew: what was made round there stays"""
STEADY = 0.02
"""m/s, and rad/s over the footprint's radius: slower is at rest"""
EXACT = 0.004
"""m before its end where a run is done"""
APPROACH = 6.0
"""1/s: speed per distance left, at the very end"""
ASIDE = 2.0
"""1/s: speed to the side per error, of what moves sideways"""
TURNS_AHEAD = 1.0
"""m before its end, and its radius for each rad: there what moves sideways begins to take the goal's yaw"""
MISSED_YAW = 3.0
"""Times the tolerance that a base that cannot turn on the spot may be off at the end"""


@dataclass(frozen=True, slots=True)
class GivenPath:
    """A path as it was given, of any length."""

    points: Sequence[Point]
    headings: Sequence[float] | None
    gears: Sequence[int] | None
    slow: Callable[[float, float], float] | None

    def lengths(self) -> Floats:
        """Return the length along the path of each point [m]."""
        steps = np.hypot(*np.diff(np.array(self.points).reshape(-1, 2), axis=0).T)
        return np.concatenate(([0.0], np.cumsum(steps)))

    def part(self, low: float, high: float) -> tuple[GivenPath, float]:
        """Return the part between two lengths [m], and where it begins: with headings, at a point before."""
        at = self.lengths()
        if low <= 0.0 and high >= at[-1]:
            return self, 0.0
        first = min(int(np.searchsorted(at, low, "right")) - 1, len(at) - 2)
        last = max(int(np.searchsorted(at, high)), first + 1)
        last = min(last, len(at) - 1)
        points = list(self.points[first : last + 1])
        if self.headings is None:
            ends = np.clip((low, high), at[first], at[last])
            x, y = (np.interp(ends, at, [point[i] for point in self.points]).tolist() for i in (0, 1))
            points[0], points[-1] = (x[0], y[0]), (x[1], y[1])
        headings = None if self.headings is None else self.headings[first : last + 1]
        gears = None if self.gears is None else self.gears[first:last]
        return GivenPath(points, headings, gears, self.slow), low if headings is None else float(at[first])


class Pursuit:
    """Path follower. State: the runs of the path, the one driven, and how far; plain data."""

    def __init__(self) -> None:
        self.runs: tuple[TrackRun, ...] = ()
        self.end: Point | None = None
        """Of the path; None without one."""
        self.yaw: float | None = None
        self.index, self.along = 0, 0.0
        """The run that is driven, and how far it is [m]."""
        self.turning = False
        self.arrived = False
        """At rest at the end, in the wanted yaw."""
        self.missed = ""
        """Why the end cannot be reached on this path any more; "" while it can"""
        self.error = 0.0
        """m to the left of the path, of the pose by which it is steered"""
        self._begun = False
        self._path = GivenPath(((0.0, 0.0),), None, None, None)
        self._from, self._whole = 0.0, 0.0
        """m along the path, where the runs begin, and its end"""

    def follow(
        self,
        points: Sequence[Point],
        yaw: float | None,
        body: Base,
        settings: PursuitSettings,
        headings: Sequence[float] | None = None,
        gears: Sequence[int] | None = None,
        slow: Callable[[float, float], float] | None = None,
    ) -> None:
        """Follow a new path (at least one point), ending in this yaw if given.

        `slow`: the largest speed [m/s] at a place [m, m]."""
        self._path = GivenPath(tuple(points), headings, gears, slow)
        self._whole = float(self._path.lengths()[-1])
        self._build(0.0, body, settings)
        self.end, self.yaw = points[-1], yaw
        self.index, self.along, self.turning, self._begun = 0, 0.0, False, False
        self.arrived, self.missed, self.error = False, "", 0.0

    def drop(self) -> None:
        """Forget the path."""
        self.runs, self.end, self.yaw, self.turning = (), None, None, False
        self.arrived, self.missed = False, ""

    def step(
        self, pose: Pose, previous: Twist, share: float, clearance: float, body: Base, s: PursuitSettings
    ) -> Twist:
        """Return the wanted twist, before limits of acceleration; rest if there is no path, or at its end.

        `share`: of the largest speeds, that is allowed; `clearance`: m from the footprint to the nearest
        obstacle."""
        self.arrived = False
        if self.end is None or share <= 0.0:
            return REST
        soon = arc(
            pose, *(v * seconds(s.latency) for v in (previous.linear, previous.angular, previous.lateral))
        )
        rests = previous.speed < STEADY
        if self.index < len(self.runs):
            self._go_on(body, s)
            run = self.runs[self.index]
            if clearance < s.obstacle_distance:
                near = max(clearance, 0.0) / s.obstacle_distance
                share *= s.obstacle_speed + (1.0 - s.obstacle_speed) * near
            twist = self._along(run, soon, rests, previous, share, body, s)
            if twist is not None:
                return twist
            if not rests:
                return REST
            self.index, self.along, self._begun = self.index + 1, 0.0, False
            return REST if self.index < len(self.runs) else self._at_end(soon, previous, share, body, s)
        return self._at_end(soon, previous, share, body, s)

    def _build(self, begin: float, body: Base, s: PursuitSettings) -> None:
        """Make the runs of the path from this length [m] on, or a little before."""
        part, self._from = self._path.part(begin, begin + longest(body))
        self.runs = runs(
            part.points,
            part.headings,
            part.gears,
            body,
            s.corner,
            s.braking,
            s.lateral_acceleration,
            part.slow,
        )

    def _go_on(self, body: Base, s: PursuitSettings) -> None:
        """Make the runs anew where the base is, once half of a part of a long path is driven."""
        run, most = self.runs[self.index], longest(body)
        passed = self._from + run.on_path(self.along)
        if passed < self._from + most / 2.0 or self._from + most >= self._whole:
            return
        self._build(max(passed - BEHIND, self._from + run.on_path(0.0)), body, s)
        self.index, self.along = 0, self.runs[0].along(passed - self._from)

    def _along(
        self,
        run: TrackRun,
        pose: Pose,
        rests: bool,
        previous: Twist,
        share: float,
        body: Base,
        s: PursuitSettings,
    ) -> Twist | None:
        """Return the twist on a run; None at its end."""
        reach = max(0.5, 2.0 * s.lookahead_max)
        self.along = run.nearest(
            pose.x, pose.y, self.along if not self._begun else self.along - 0.1, self.along + reach
        )
        self._begun = True
        place = run.place(self.along)
        c, si = cos(place.heading), sin(place.heading)
        dx, dy = pose.x - place.x, pose.y - place.y
        left = run.length - self.along
        self.error = c * dy - si * dx
        if left <= 1e-6:
            left = -(c * dx + si * dy)
        if left <= EXACT:
            return None
        ahead = run.place(self.along + previous.speed * _lead(body, s))
        allowed = max(share * ahead.speed, min(s.creep, share * body.max_linear))
        speed = min(allowed, max(APPROACH * left, s.creep))
        if body.moves_sideways:
            return self._sideways(run, place, ahead, pose, speed, left, previous, share, body, s)
        travelling = pose.yaw if run.gear > 0 else wrap(pose.yaw + pi)
        lookahead = min(max(previous.speed * s.lookahead_time, s.lookahead_min), s.lookahead_max)
        heading = wrap(travelling - place.heading)
        if body.turning_radius == 0.0:
            wanted = (
                place.heading - atan2(self.error, lookahead)
                if abs(self.error) > s.tolerance
                else place.heading
            )
            off = wrap(wanted - travelling)
            limit = s.turn_until if self.turning else 2.0 * s.turn_until if rests else s.turn_from
            self.turning = abs(off) > limit
            if self.turning:
                return self._on_the_spot(off, previous, share, body, s)
        bend = run.place(self.along + previous.speed * _turn_lead(body)).curvature
        curvature = steered(bend, self.error, heading, lookahead)
        most = 1.0 / body.turning_radius if body.turning_radius > 0.0 else 2.0 / s.lookahead_min
        most = max(most, abs(bend) if body.turning_radius == 0.0 else 0.0)
        curvature = min(max(curvature, -most), most)
        return Twist(run.gear * speed, curvature * speed)

    def _sideways(
        self,
        run: TrackRun,
        place: TrackPlace,
        ahead: TrackPlace,
        pose: Pose,
        speed: float,
        left: float,
        previous: Twist,
        share: float,
        body: Base,
        s: PursuitSettings,
    ) -> Twist:
        """Return the twist of a base that keeps to its path in any heading.

        It turns about no place within its radius: wheels there that steer would turn round at once."""
        c, si = cos(ahead.heading), sin(ahead.heading)
        back = min(max(-ASIDE * self.error, -0.5 * body.max_linear), 0.5 * body.max_linear)
        vx, vy = speed * c - back * si, speed * si + back * c
        if place.facing is not None:
            wanted = place.facing
        elif self.yaw is not None and left < TURNS_AHEAD + body.radius * abs(wrap(self.yaw - pose.yaw)):
            wanted = self.yaw
        else:
            along = place.heading if run.gear > 0 else place.heading + pi
            wanted = along if left > s.lookahead_min else pose.yaw
        rate = clamp(self._rate(wrap(wanted - pose.yaw), share, body, s), previous.speed / body.radius)
        cy, sy = cos(pose.yaw), sin(pose.yaw)
        return Twist(cy * vx + sy * vy, rate, cy * vy - sy * vx)

    def _at_end(self, pose: Pose, previous: Twist, share: float, body: Base, s: PursuitSettings) -> Twist:
        """At the end of the last run: turn to the goal's yaw; if the end is missed, go there once more."""
        assert self.end is not None
        away = hypot(self.end[0] - pose.x, self.end[1] - pose.y)
        error = 0.0 if self.yaw is None else wrap(self.yaw - pose.yaw)
        rests = previous.speed < STEADY
        if away > s.tolerance * (2.0 if self.turning else 1.0):
            if not rests:
                return REST
            if body.turning_radius > 0.0:
                self.missed = f"it ended {away:.2f} m from the end of its path"
                return REST
            self.runs = runs(
                ((pose.x, pose.y), self.end), None, None, body, s.corner, s.braking, s.lateral_acceleration
            )
            self.index, self.along, self._begun, self.turning = 0, 0.0, False, False
            return REST
        if body.turning_radius > 0.0:
            if abs(error) > MISSED_YAW * s.yaw_tolerance:
                self.missed = f"it ended with its yaw {error:.2f} rad off"
                return REST
            error = 0.0
        self.turning = abs(error) > s.yaw_tolerance * (0.5 if self.turning else 1.0)
        if self.turning:
            return self._on_the_spot(error, previous, share, body, s)
        self.arrived = rests and abs(previous.angular) < 0.1
        return REST

    def _on_the_spot(
        self, error: float, previous: Twist, share: float, body: Base, s: PursuitSettings
    ) -> Twist:
        """Brake first, then turn, slowly enough to be able to stop at the wanted heading."""
        return REST if previous.speed > STEADY else Twist(0.0, self._rate(error, share, body, s))

    @staticmethod
    def _rate(error: float, share: float, body: Base, s: PursuitSettings) -> float:
        # With little jerk it must brake more gently, and correct more slowly.
        gentle = min(
            body.max_angular_acceleration, 0.45 * sqrt(JERK * body.max_angular_jerk * body.max_angular)
        )
        gain = min(s.turn_gain, 1.3 * cbrt(JERK * body.max_angular_jerk))
        braking = sqrt(2.0 * s.braking * gentle * abs(error))
        rate = min(gain * abs(error), braking, share * body.max_angular)
        return rate if error > 0.0 else -rate


def _lead(body: Base, s: PursuitSettings) -> float:
    """Return by how much earlier [s] a change must be wanted, since the jerk is limited."""
    return s.braking * body.max_linear_acceleration / (2.0 * body.max_linear_jerk)


def _turn_lead(body: Base) -> float:
    """Return the same of a change of the curvature [s]."""
    return body.max_angular_acceleration / (2.0 * body.max_angular_jerk) + 0.02


def steered(curvature: float, error: float, heading: float, lookahead: float) -> float:
    """Return the curvature [1/m] with which errors to the left [m, rad] vanish within the lookahead [m]."""
    straight = sin(heading) / heading if abs(heading) > 1e-6 else 1.0
    room = max(1.0 - curvature * error, 0.3)
    follow = curvature * cos(heading) / room
    return follow - error * straight / lookahead**2 - 2.0 * sin(heading) / lookahead
