"""Poses and twists in the plane: the exponential map of SE(2), in closed form.

Frames: x forward, y to the left, yaw counter-clockwise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from brain.belief import Pose


class Twist(NamedTuple):
    """Motion of a base in its own frame: m/s forward, rad/s to the left, m/s to the left."""

    linear: float = 0.0
    angular: float = 0.0
    lateral: float = 0.0

    def scaled(self, share: float) -> Twist:
        """Return the twist on the same arc at this share of its speed."""
        return Twist(self.linear * share, self.angular * share, self.lateral * share)

    @property
    def speed(self) -> float:
        """Speed of the origin [m/s], at least 0."""
        return math.hypot(self.linear, self.lateral)


REST = Twist()


class Commanded(NamedTuple):
    """A twist, and its rate of change [m/s², rad/s²]."""

    twist: Twist = REST
    rate: Twist = REST

    @property
    def growth(self) -> float:
        """The part of the rate that keeps to the arc, as a share of the twist per second."""
        linear, angular, lateral = self.twist
        rate = self.rate
        if linear or lateral:
            return (linear * rate.linear + lateral * rate.lateral) / (linear * linear + lateral * lateral)
        return rate.angular / angular if angular else 0.0


def wrap(angle: float) -> float:
    """Return the same direction in (-pi, pi] [rad]."""
    turned = math.remainder(angle, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned


def sinc(half: float) -> float:
    """Return sin(h) / h, and 1 at 0: the length of a chord over that of its arc, for half the turn [rad]."""
    if abs(half) < 1e-4:
        return 1.0 - half * half / 6.0
    return math.sin(half) / half


def arc(pose: Pose, distance: float, turn: float, sideways: float = 0.0) -> Pose:
    """Return the pose after a motion of constant twist: this far forward and to the left in the moving frame
    [m], turned by this [rad]. Exact: the exponential map of SE(2) (Lynch and Park 2017, section 3.3.3)."""
    half = turn / 2.0
    chord, heading = sinc(half), pose.yaw + half
    c, s = chord * math.cos(heading), chord * math.sin(heading)
    x, y = pose.x + c * distance - s * sideways, pose.y + s * distance + c * sideways
    return Pose(x, y, wrap(pose.yaw + turn))


def motion(start: Pose, end: Pose) -> tuple[float, float, float]:
    """Return the constant twist of unit time from one pose to another: distance, turn, sideways, as `arc`
    takes them; the inverse of `arc` for turns below pi."""
    turn = wrap(end.yaw - start.yaw)
    half = turn / 2.0
    dx, dy, heading = end.x - start.x, end.y - start.y, start.yaw + half
    chord = sinc(half)
    c, s = math.cos(heading) / chord, math.sin(heading) / chord
    return c * dx + s * dy, turn, c * dy - s * dx


def moved(start: Pose, by: Pose) -> Pose:
    """Return the pose that lies at `by` in the frame of `start`."""
    c, s = math.cos(start.yaw), math.sin(start.yaw)
    return Pose(start.x + c * by.x - s * by.y, start.y + s * by.x + c * by.y, wrap(start.yaw + by.yaw))


def frame_of(there: Pose, here: Pose) -> Pose:
    """Return the pose of a frame in another one, of a pose that is `here` in it and `there` in the other."""
    yaw = wrap(there.yaw - here.yaw)
    c, s = math.cos(yaw), math.sin(yaw)
    return Pose(there.x - c * here.x + s * here.y, there.y - s * here.x - c * here.y, yaw)


def seen_from(start: Pose, pose: Pose) -> Pose:
    """Return a pose in the frame of another one: the inverse of `moved`."""
    c, s = math.cos(start.yaw), math.sin(start.yaw)
    dx, dy = pose.x - start.x, pose.y - start.y
    return Pose(c * dx + s * dy, c * dy - s * dx, wrap(pose.yaw - start.yaw))
