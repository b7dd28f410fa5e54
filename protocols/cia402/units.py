"""A drive's own units ↔ SI at the device's shaft, from its encoder, gear and feed objects.

Rules. The *device's shaft* is the drive's "driving shaft": behind the gear of object 6091. Positions are
whole user units: 6092 of them per turn of that shaft, or encoder increments through the gear if a drive has
no feed constant. Velocities are user units per second, accelerations per second squared. Torques are
per mille of the motor's rated torque (6076, mN·m), which the gear multiplies; currents per mille of its
rated current (6075, mA). A value that does not fit its object is a ValueError: nothing is clamped, nothing
wraps.

Source: CiA 402-2 "position encoder resolution" (608F), "gear ratio" (6091), "feed constant" (6092).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.cia402 import objects as o
from protocols.cia402.objects import Key, Type


@dataclass(frozen=True, slots=True)
class Units:
    """The units of one drive."""

    per_turn: float
    """User units of position per turn of the device's shaft."""
    gear: float = 1.0
    """Turns of the motor per turn of the device's shaft."""
    rated_torque: float = 0.0
    """N·m of the motor; 0: not known."""
    rated_current: float = 0.0
    """A; 0: not known."""

    def __deepcopy__(self, _: dict[int, object]) -> Units:
        return self

    def position(self, value: int) -> float:
        """Convert a position (6064 and the like) to rad."""
        return value * math.tau / self.per_turn

    def velocity(self, value: int) -> float:
        """Convert a velocity (606C …) to rad/s; also an acceleration (6083 …) to rad/s²."""
        return value * math.tau / self.per_turn

    def torque(self, value: int) -> float:
        """Convert a torque (6077 …) to N·m at the device's shaft."""
        return value * self.rated_torque * self.gear / 1000.0

    def current(self, value: int) -> float:
        """Convert a current (6078) to A."""
        return value * self.rated_current / 1000.0

    def to_position(self, radians: float) -> int:
        """Convert rad to a position (607A …). ValueError if it does not fit."""
        return _whole(radians * self.per_turn / math.tau, Type.I32)

    def to_velocity(self, radians: float) -> int:
        """Convert rad/s to a velocity (60FF …). ValueError if it does not fit."""
        return _whole(radians * self.per_turn / math.tau, Type.I32)

    def to_torque(self, torque: float) -> int:
        """Convert N·m at the device's shaft to a torque (6071 …). ValueError if it does not fit, or 6076 is
        unknown."""
        if self.rated_torque <= 0.0:
            raise ValueError("the drive's rated torque is not known")
        return _whole(torque * 1000.0 / (self.rated_torque * self.gear), Type.I16)


def _whole(value: float, type_: Type) -> int:
    if not math.isfinite(value):
        raise ValueError(f"{value} is not finite: it is never sent")
    whole = round(value)
    if not type_.low <= whole <= type_.high:
        raise ValueError(f"{whole} does not fit into {type_.name}")
    return whole


READ: tuple[Key, ...] = (
    o.ENCODER_INCREMENTS,
    o.ENCODER_REVOLUTIONS,
    o.GEAR_MOTOR,
    o.GEAR_SHAFT,
    o.FEED,
    o.FEED_SHAFT,
    o.RATED_TORQUE,
    o.RATED_CURRENT,
)
"""The objects that units are computed from; each may be missing."""


def units_of(read: Mapping[Key, int]) -> Units | None:
    """Compute the units from the objects of READ that the drive has; None if they do not suffice.

    A missing 6091 is 1:1. A missing or zero 6092 means encoder increments; then 608F must be there."""
    encoder = _ratio(read, o.ENCODER_INCREMENTS, o.ENCODER_REVOLUTIONS)
    gear = _ratio(read, o.GEAR_MOTOR, o.GEAR_SHAFT) or 1.0
    feed = _ratio(read, o.FEED, o.FEED_SHAFT)
    per_turn = feed or (encoder * gear if encoder else None)
    if not per_turn:
        return None
    torque = read.get(o.RATED_TORQUE, 0) / 1000.0
    return Units(per_turn, gear, torque, read.get(o.RATED_CURRENT, 0) / 1000.0)


def _ratio(read: Mapping[Key, int], above: Key, below: Key) -> float | None:
    """Return the ratio of two objects; None if one is missing or zero. A missing divisor counts as 1."""
    numerator, divisor = read.get(above, 0), read.get(below, 1)
    return numerator / divisor if numerator > 0 and divisor > 0 else None
