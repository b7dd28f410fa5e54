"""A trot: where four feet are, in the plane of the body's frame, while the body follows a twist.

Rules. Two diagonal legs swing while the other two stand; between the swings all four do. A foot on the floor
moves against the twist, exactly (`plane.arc`): none is dragged. It comes down half a stance ahead of its
home, so that it is at home in the middle of the stance (Raibert 1986, Legged Robots That Balance, chapter 2).
In the air it follows the polynomial of fifth degree from where it is to there, in place, velocity and
acceleration; computed anew at every step, which changes nothing as long as the twist does not. State is plain
data; pure functions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

from brain.belief import Pose
from brain.bodies.plane import REST, Twist, arc

Plane: TypeAlias = tuple[float, float]

OFFSETS = (0.0, 0.5, 0.5, 0.0)
"""Of front left, front right, rear left, rear right: shares of the period."""
CLOSE = 1e-3
"""m: a foot that is as near to its home stands there."""
DECIDED = 0.25
"""Last share of a swing in which the twist no longer changes where the foot comes down."""
HERE = Pose(0.0, 0.0, 0.0)


class Foot(NamedTuple):
    """A foot's motion in the plane: m, m/s, m/s²."""

    place: Plane
    velocity: Plane = (0.0, 0.0)
    acceleration: Plane = (0.0, 0.0)
    aim: Plane | None = None
    """m, where it comes down; None: it stands"""


class Gait(NamedTuple):
    """What is remembered between two steps."""

    feet: tuple[Foot, ...]
    phase: float = 0.0
    """Share of the period, 0 at the beginning of the first swing"""
    walking: bool = False
    twist: Twist = REST


class Rhythm(NamedTuple):
    """How it steps."""

    period: float
    """s"""
    stance: float
    """Share of the period for which a foot is on the floor, at least a half"""
    lift: float
    """m"""

    def swing(self, gait: Gait, leg: int) -> float | None:
        """Return the share of its swing that a leg has done; None: it stands."""
        phase = (gait.phase + OFFSETS[leg]) % 1.0
        return phase / (1.0 - self.stance) if gait.walking and phase < 1.0 - self.stance else None

    def height(self, gait: Gait, leg: int) -> tuple[float, float]:
        """Return how high a foot is [m] and how fast it rises [m/s]: smooth up to its acceleration."""
        share = self.swing(gait, leg)
        if share is None:
            return 0.0, 0.0
        bell = share * (1.0 - share)
        rate = 192.0 * self.lift * bell * bell * (1.0 - 2.0 * share)
        return 64.0 * self.lift * bell**3, rate / ((1.0 - self.stance) * self.period)

    def load(self, gait: Gait, leg: int) -> float:
        """Return the share of the weight that a leg should carry, up to a factor: a pair takes it over from
        the other while both stand."""
        if not gait.walking:
            return 1.0
        phase, both = (gait.phase + OFFSETS[leg]) % 1.0 - (1.0 - self.stance), self.stance - 0.5
        if phase < 0.0:
            return 0.0
        return min(1.0, phase / both, (self.stance - phase) / both) if both > 1e-6 else 1.0

    def advanced(self, gait: Gait, homes: Sequence[Plane], twist: Twist, dt: float) -> Gait:
        """Return the gait dt [s] later, at this twist; it stands once all feet are at home."""
        if not gait.walking and twist == REST:
            return gait._replace(twist=REST)
        feet = tuple(
            self._stepped(foot, (gait.phase + OFFSETS[leg]) % 1.0, homes[leg], twist, dt)
            for leg, foot in enumerate(gait.feet)
        )
        after = Gait(feet, (gait.phase + dt / self.period) % 1.0, True, twist)
        if twist == REST and all(
            self.swing(after, leg) is None and math.dist(foot.place, homes[leg]) < CLOSE
            for leg, foot in enumerate(feet)
        ):
            return Gait(feet)
        return after

    def _stepped(self, foot: Foot, phase: float, home: Plane, twist: Twist, dt: float) -> Foot:
        """Return a foot dt [s] later, through as many swings and stances as that takes."""
        air, left = (1.0 - self.stance) * self.period, dt
        at = phase * self.period
        while left > 0.0:
            rest = (air if at < air else self.period) - at
            time = min(left, rest)
            if at < air:
                aim = foot.aim
                if aim is None or rest > DECIDED * air:
                    aim = _dragged(home, twist, 0.5 * self.stance * self.period)
                foot = _flown(foot, grounded(aim, twist), rest, time)
            else:
                foot = grounded(_dragged(foot.place, twist, -time), twist)
            at, left = (at + time) if time < rest else (air if at < air else 0.0), left - time
        return foot


def grounded(place: Plane, twist: Twist) -> Foot:
    """Return the motion of a foot that rests on the floor, seen from the body."""
    turn = twist.angular
    velocity = turn * place[1] - twist.linear, -turn * place[0] - twist.lateral
    return Foot(place, velocity, (turn * velocity[1], -turn * velocity[0]))


def _dragged(place: Plane, twist: Twist, time: float) -> Plane:
    """Return a place that moves with the body for a time [s], in the frame at the beginning."""
    end = arc(HERE, twist.linear * time, twist.angular * time, twist.lateral * time)
    c, s = math.cos(end.yaw), math.sin(end.yaw)
    return end.x + c * place[0] - s * place[1], end.y + s * place[0] + c * place[1]


def _flown(foot: Foot, end: Foot, rest: float, time: float) -> Foot:
    """Return a foot that has `rest` [s] to its touchdown, `time` later."""
    if time >= rest:
        return end
    x, y = (_quintic(foot, end, axis, rest, time / rest) for axis in (0, 1))
    return Foot((x[0], y[0]), (x[1], y[1]), (x[2], y[2]), end.place)


def _quintic(foot: Foot, end: Foot, axis: int, rest: float, share: float) -> tuple[float, float, float]:
    """Return place, velocity and acceleration after a share of the way, which takes `rest` [s]."""
    p, b, c = foot.place[axis], foot.velocity[axis] * rest, 0.5 * foot.acceleration[axis] * rest * rest
    way, speed = end.place[axis] - p - b - c, end.velocity[axis] * rest - b - 2.0 * c
    bend = end.acceleration[axis] * rest * rest - 2.0 * c
    d, e, f = (
        10.0 * way - 4.0 * speed + 0.5 * bend,
        7.0 * speed - 15.0 * way - bend,
        6.0 * way - 3.0 * speed + 0.5 * bend,
    )
    s = share
    place = p + s * (b + s * (c + s * (d + s * (e + s * f))))
    velocity = b + s * (2.0 * c + s * (3.0 * d + s * (4.0 * e + s * 5.0 * f)))
    acceleration = 2.0 * c + s * (6.0 * d + s * (12.0 * e + s * 20.0 * f))
    return place, velocity / rest, acceleration / (rest * rest)
