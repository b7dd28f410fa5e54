"""A base on two tracks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from brain.bodies.skid_steer import TwoSides


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked(TwoSides):
    """Skid steer with one motor on each side. `wheel_radius` is how far a track runs per rad of its motor's
    joint: that of the sprocket's pitch circle."""

    kind: ClassVar[str] = "tracked"
    left: str
    """Motor of the left track,"""
    right: str
    """and of the right one."""

    @property
    def sides(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Both tracks."""
        return (self.left,), (self.right,)
