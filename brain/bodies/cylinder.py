"""A cylinder that moves a hinge: the third side of a triangle whose other sides turn about the hinge."""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, cos, pi, sin, sqrt
from typing import Annotated, Literal

from protocols.bounds import Bounds, Invalid, check

FLAT = 0.05
"""rad from a triangle that is flat: there a cylinder has no lever"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cylinder:
    """Where it is mounted. The angle between its mounts, seen from the hinge, is `angle` where the joint is
    at 0, and changes with it (sign 1) or against it (−1)."""

    base: Annotated[float, Bounds(0.01, 20.0, "m")]
    """m from the hinge to the mount that stands still"""
    rod: Annotated[float, Bounds(0.01, 20.0, "m")]
    """m from the hinge to the mount that moves with the joint"""
    angle: Annotated[float, Bounds(-6.3, 6.3, "rad")]
    """rad between the two where the joint is at 0"""
    sign: Literal[1, -1] = 1
    """1: a positive joint angle extends it"""

    def __post_init__(self) -> None:
        check(self)

    def check_range(self, low: float, high: float) -> None:
        """Raise Invalid if the triangle is flat anywhere within a joint's range [rad]."""
        seen = sorted(self.angle + self.sign * each for each in (low, high))
        if not FLAT <= seen[0] <= seen[1] <= pi - FLAT:
            text = f"seen from the hinge its mounts are {seen[0]:.3g} to {seen[1]:.3g} rad apart within the "
            raise Invalid(("angle", f"{text}joint's range; expected {FLAT:g} to {pi - FLAT:.3g}"))

    def length(self, position: float) -> float:
        """Return its length [m] at a joint angle [rad]."""
        apart = self.angle + self.sign * position
        return sqrt(self.base**2 + self.rod**2 - 2.0 * self.base * self.rod * cos(apart))

    def lever(self, position: float) -> float:
        """Return how much its length changes with the joint angle [m/rad]: of a force, the torque."""
        apart = self.angle + self.sign * position
        return self.sign * self.base * self.rod * sin(apart) / self.length(position)

    def position(self, length: float) -> float:
        """Return the joint angle [rad] at a length [m]; the nearest one, if none has that length."""
        ratio = (self.base**2 + self.rod**2 - length**2) / (2.0 * self.base * self.rod)
        return self.sign * (acos(max(-1.0, min(1.0, ratio))) - self.angle)
