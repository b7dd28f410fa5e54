"""A drive's own units ↔ SI at the device's shaft, from its encoder, gear, feed, factors and unit objects.

Rules. The *device's shaft* is the drive's "driving shaft": behind the gear of object 6091. Positions are
whole user units: what 60A8 names (parts of a turn, or encoder increments through the gear), else 6092 of them
per turn of that shaft, else encoder increments. Velocities are what 60A9 names (most drives default to rpm),
else position units per second times 6096. A drive that has neither, or has two that contradict each other,
has no known unit of velocity: that is never guessed. Accelerations are what 60AA names, else velocity units
per second times 6097. Torques are per mille of the motor's rated torque (6076, mN·m), which the gear
multiplies; currents per mille of its rated current (6075, mA). A value that does not fit its object is a
ValueError: nothing is clamped, nothing wraps.

Source: CiA 402-2 608F, 6091, 6092, 6096, 6097, 60A8 to 60AA; codes of units: CiA 303-2, as in the manuals of
Nanotec PD6-C, Synapticon Somanet and Maxon EPOS4; direction of 6096: manual of Kollmorgen AKD2G.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocols.canopen.objects import Key, Type
from protocols.cia402 import objects as o

ANGLES: Mapping[int, float] = {
    0x10: math.tau,
    0x41: 360.0,
    0x42: 360.0 * 60,
    0x43: 360.0 * 3600,
    0xB4: 1.0,
}
"""Radian, degree, minute and second of arc, turn: how many are a turn, by their code."""
INCREMENTS = 0xB5
RPM = 0xC0
TIMES: Mapping[int, float] = {0x03: 1.0, 0x47: 60.0, 0x48: 3600.0}
"""Second, minute, hour [s]."""
SQUARE_SECOND = 0x57


@dataclass(frozen=True, slots=True)
class Units:
    """The units of one drive."""

    per_turn: float
    """Position units per turn of the device's shaft."""
    velocity_per_turn: float = 0.0
    """Velocity units per turn of the device's shaft and second; 0: not known."""
    acceleration_per_turn: float = 0.0
    """Acceleration units per turn of the device's shaft and second squared; 0: not known."""
    gear: float = 1.0
    """Turns of the motor per turn of the device's shaft."""
    rated_torque: float = 0.0
    """N·m of the motor; 0: not known."""
    rated_current: float = 0.0
    """A; 0: not known."""
    doubt: str = field(default="", compare=False)
    """Why the unit of velocity is not known."""

    def __deepcopy__(self, _: dict[int, object]) -> Units:
        return self

    def position(self, value: int) -> float:
        """Convert a position (6064 and the like) to rad."""
        return value * math.tau / self.per_turn

    def velocity(self, value: int) -> float:
        """Convert a velocity (606C …) to rad/s. ZeroDivisionError if its unit is not known."""
        return value * math.tau / self.velocity_per_turn

    def acceleration(self, value: int) -> float:
        """Convert an acceleration (6083 …) to rad/s². ZeroDivisionError if its unit is not known."""
        return value * math.tau / self.acceleration_per_turn

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
        """Convert rad/s to a velocity (60FF …). ValueError if it does not fit, or the unit is not known."""
        if not self.velocity_per_turn:
            raise ValueError(self.doubt)
        return _whole(radians * self.velocity_per_turn / math.tau, Type.I32)

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
    o.POSITION_UNIT,
    o.VELOCITY_UNIT,
    o.VELOCITY_NUMERATOR,
    o.VELOCITY_DIVISOR,
    o.ACCELERATION_UNIT,
    o.ACCELERATION_NUMERATOR,
    o.ACCELERATION_DIVISOR,
    o.RATED_TORQUE,
    o.RATED_CURRENT,
)
"""The objects that units are computed from; each may be missing."""


def units_of(
    read: Mapping[Key, int],
    counts_per_turn: float = 0.0,
    velocity_per_turn: float = 0.0,
    rated_torque: float = 0.0,
) -> Units | str:
    """Compute the units from the objects of READ that the drive has, or return why they are not known.

    The numbers are the user's own, for what the drive does not define, or defines wrongly; `rated_torque`
    [N·m] counts only without 6076. A missing 6091 is 1:1."""
    encoder = _ratio(read, o.ENCODER_INCREMENTS, o.ENCODER_REVOLUTIONS)
    gear = _ratio(read, o.GEAR_MOTOR, o.GEAR_SHAFT) or 1.0
    increments = encoder * gear
    named = _per_turn(read.get(o.POSITION_UNIT, 0), increments)
    per_turn = counts_per_turn or named or _ratio(read, o.FEED, o.FEED_SHAFT) or increments
    if not per_turn:
        return "its units are unknown: 608F, 6091, 6092, 60A8 do not define them; set counts_per_turn"
    velocity, doubt = velocity_per_turn, ""
    if not velocity:
        velocity, doubt = _velocity(read, per_turn, increments)
    return Units(
        per_turn,
        velocity,
        _acceleration(read, velocity, increments),
        gear,
        read.get(o.RATED_TORQUE, 0) / 1000.0 or rated_torque,
        read.get(o.RATED_CURRENT, 0) / 1000.0,
        doubt,
    )


def _velocity(read: Mapping[Key, int], per_turn: float, increments: float) -> tuple[float, str]:
    """Return (velocity units per turn and second, ""), or (0, why they are not known)."""
    unit, factor = read.get(o.VELOCITY_UNIT, 0), _ratio(read, o.VELOCITY_NUMERATOR, o.VELOCITY_DIVISOR)
    named = _per_turn(unit, increments) * TIMES.get(unit >> 8 & 0xFF, 0.0)
    remedy = "; set velocity_per_turn under options (60 for rpm)"
    if unit and not named:
        return 0.0, f"its unit of velocity (60A9 = {unit:08X}) is not known here{remedy}"
    if not unit and not factor:
        return 0.0, f"it does not define its unit of velocity (60A9, 6096){remedy}"
    if named and factor not in (0.0, 1.0) and not math.isclose(named, per_turn * factor, rel_tol=1e-3):
        return 0.0, f"60A9 ({unit:08X}) and 6096 ({factor:g}) contradict each other{remedy}"
    return named or per_turn * factor, ""


def _acceleration(read: Mapping[Key, int], velocity: float, increments: float) -> float:
    """Return acceleration units per turn and second squared; 0: not known."""
    unit = read.get(o.ACCELERATION_UNIT, 0)
    if not unit:
        return velocity * (_ratio(read, o.ACCELERATION_NUMERATOR, o.ACCELERATION_DIVISOR) or 1.0)
    time = unit >> 8 & 0xFF
    if unit >> 16 & 0xFF == RPM:
        return 60.0 * 10.0 ** -_exponent(unit) * TIMES.get(time, 0.0)
    return _per_turn(unit, increments) * (time == SQUARE_SECOND)


def _per_turn(unit: int, increments: float) -> float:
    """Return how many of the angles that a unit names are a turn; 0: it names none."""
    code = unit >> 16 & 0xFF
    return (increments if code == INCREMENTS else ANGLES.get(code, 0.0)) * 10.0 ** -_exponent(unit)


def _exponent(unit: int) -> int:
    """Return the power of ten of a unit's prefix, -128 to 127."""
    return (unit >> 24 ^ 0x80) - 0x80


def _ratio(read: Mapping[Key, int], above: Key, below: Key) -> float:
    """Return the ratio of two objects; 0 if one is missing or zero. A missing divisor counts as 1."""
    numerator, divisor = read.get(above, 0), read.get(below, 1)
    return numerator / divisor if numerator > 0 and divisor > 0 else 0.0
