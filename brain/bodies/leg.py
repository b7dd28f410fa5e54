"""A leg of three joints, hip, thigh and knee: kinematics both ways, in closed form.

Rules. Frame: that of the body, x forward, y to the left, z up, with its origin at the leg's hip. The hip
turns about x; `offset` to its side is the leg's plane, in which thigh and knee turn about y. At angle 0 all
hangs straight down. The foot is a point. What is out of reach is put at the edge of the reach, so that
nothing here is ever singular.
"""

from __future__ import annotations

from math import acos, atan2, copysign, cos, pi, remainder, sin, sqrt
from typing import NamedTuple, TypeAlias

Point: TypeAlias = tuple[float, float, float]

BENT = 0.02
"""Least sine of the knee's angle: a leg is never straighter than this."""
HIGHEST = 1e-3
"""m: the foot is at least as far below the hip, in the leg's plane."""


class Leg(NamedTuple):
    """Its lengths [m]."""

    offset: float
    """From the hip's axis to the leg's plane, positive to the left"""
    thigh: float
    shank: float
    bend: float = -1.0
    """Sign of the knee's angle: -1 for knees that point backward"""

    def foot(self, angles: Point) -> Point:
        """Return where the foot is [m] for hip, thigh and knee [rad]."""
        hip, thigh, knee = angles
        x = -self.thigh * sin(thigh) - self.shank * sin(thigh + knee)
        z = -self.thigh * cos(thigh) - self.shank * cos(thigh + knee)
        c, s = cos(hip), sin(hip)
        return x, c * self.offset - s * z, s * self.offset + c * z

    def angles(self, foot: Point) -> Point:
        """Return hip, thigh and knee [rad] that put the foot there, or as far in its direction as it goes."""
        x, y, high = foot
        z = -sqrt(max(y * y + high * high - self.offset * self.offset, HIGHEST * HIGHEST))
        hip = remainder(atan2(high, y) - atan2(z, self.offset), 2.0 * pi)
        a, b = self.thigh, self.shank
        most = sqrt(1.0 - BENT * BENT)
        knee = acos(max(-most, min(most, (x * x + z * z - a * a - b * b) / (2.0 * a * b))))
        knee = copysign(knee, self.bend)
        thigh = atan2(-x, -z) - atan2(b * sin(knee), a + b * cos(knee))
        return hip, remainder(thigh, 2.0 * pi), knee

    def jacobian(self, angles: Point) -> tuple[Point, Point, Point]:
        """Return the derivative of the foot's place by each angle [m/rad]."""
        hip, thigh, knee = angles
        u, w = self.shank * sin(thigh + knee), self.shank * cos(thigh + knee)
        x, z = -self.thigh * sin(thigh) - u, -self.thigh * cos(thigh) - w
        c, s, out = cos(hip), sin(hip), self.offset
        return (0.0, -s * out - c * z, c * out - s * z), (z, s * x, -c * x), (-w, -s * u, c * u)

    def rates(self, angles: Point, velocity: Point) -> Point:
        """Return the rates of the angles [rad/s] that give the foot a velocity [m/s]: the Jacobian's inverse,
        by its own structure."""
        hip, thigh, knee = angles
        u, w = self.shank * sin(thigh + knee), self.shank * cos(thigh + knee)
        x, z = -self.thigh * sin(thigh) - u, -self.thigh * cos(thigh) - w
        c, s = cos(hip), sin(hip)
        forward, across = velocity[0], c * velocity[1] + s * velocity[2]
        turn = -across / min(z, -HIGHEST)
        along = c * velocity[2] - s * velocity[1] - self.offset * turn
        det = -self.thigh * self.shank * copysign(max(abs(sin(knee)), BENT), sin(knee))
        return turn, (u * forward + w * along) / det, (z * along + x * forward) / det
