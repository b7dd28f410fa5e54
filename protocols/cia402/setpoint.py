"""Commands → mode of operation and set-points in the drive's own units. Pure functions.

Rules. A set-point is a whole set of values: what a mode does not use is zero, except the target position,
which stays where it is. What does not fit the drive's integers is a ValueError, and is never sent.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

from protocols.cia402 import objects as o
from protocols.cia402.objects import Key
from protocols.cia402.profile import CYCLIC, Mode
from protocols.cia402.startup import DeviceProfile
from protocols.cia402.units import Units
from protocols.messages import Command, Hold, Position, Torque, Velocity

Values: TypeAlias = dict[Key, int]
POSITION_MODES = (Mode.CSP, Mode.PP)
VELOCITY_MODES = (Mode.CSV, Mode.PV)
TORQUE_MODES = (Mode.CST, Mode.PT)
TARGET_OF: dict[Mode, Key] = {
    **dict.fromkeys(POSITION_MODES, o.TARGET_POSITION),
    **dict.fromkeys(VELOCITY_MODES, o.TARGET_VELOCITY),
    **dict.fromkeys(TORQUE_MODES, o.TARGET_TORQUE),
}
"""The set-point of each mode."""
_FAMILIES: dict[type[Command], tuple[tuple[Mode, Mode], ...]] = {
    Position: (POSITION_MODES,),
    Velocity: (VELOCITY_MODES,),
    Torque: (TORQUE_MODES,),
    Hold: (POSITION_MODES, VELOCITY_MODES),
}
"""The (cyclic, profile) modes that can do a command. Hold is a position, or without a position mode
standstill."""


def mode_for(command: Command, profile: DeviceProfile, prefer: Literal["cyclic", "profile"]) -> Mode | None:
    """Return the mode in which the device can do a command; None if it has none."""
    for pair in _FAMILIES.get(type(command), ()):
        found = profile.mode(*(pair if prefer == "cyclic" else pair[::-1]))
        if found is not None:
            return found
    return None


def values_of(command: Command, mode: Mode, units: Units, hold: int) -> Values:
    """Return the set-points of a command in a mode. `hold`: the target position if the command has none.

    Feed-forwards are objects of the cyclic modes: a profile mode generates its own."""
    if mode not in CYCLIC and isinstance(command, Position | Velocity):
        command = replace(command, torque=0.0)
        command = replace(command, velocity=0.0) if isinstance(command, Position) else command
    match command:
        case Position(_, position, velocity, torque):
            target, offset = units.to_position(position), units.to_velocity(velocity)
            return _values(target, velocity_offset=offset, torque_offset=_torque(units, torque))
        case Velocity(_, velocity, torque):
            target = units.to_velocity(velocity)
            return _values(hold, velocity=target, torque_offset=_torque(units, torque))
        case Torque(_, torque):
            return _values(hold, torque=units.to_torque(torque))
    return standstill(hold)


def standstill(position: int) -> Values:
    """Return set-points that do not move a shaft at this position, in any mode."""
    return _values(position)


def _torque(units: Units, torque: float) -> int:
    return units.to_torque(torque) if torque else 0


def _values(
    position: int, velocity_offset: int = 0, velocity: int = 0, torque: int = 0, torque_offset: int = 0
) -> Values:
    return {
        o.TARGET_POSITION: position,
        o.VELOCITY_OFFSET: velocity_offset,
        o.TARGET_VELOCITY: velocity,
        o.TARGET_TORQUE: torque,
        o.TORQUE_OFFSET: torque_offset,
    }
