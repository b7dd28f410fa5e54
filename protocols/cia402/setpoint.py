"""Commands → mode of operation and set-points in the drive's own units. Pure functions.

Rules. A set-point is a whole set of values: what a mode does not use is zero, but for the target position,
which stays where it is. What does not fit the drive's integers is a ValueError, and reaches no wire.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

from protocols.cia402 import objects as o
from protocols.cia402.objects import Key
from protocols.cia402.profile import CYCLIC, Mode
from protocols.cia402.startup import Known
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


def mode_for(command: Command, known: Known, prefer: Literal["cyclic", "profile"]) -> Mode | None:
    """The mode in which the device can do this; None if it has none.

    Hold is a position, and where the device has no position mode standing still."""
    match command:
        case Position():
            families = [POSITION_MODES]
        case Velocity():
            families = [VELOCITY_MODES]
        case Torque():
            families = [TORQUE_MODES]
        case Hold():
            families = [POSITION_MODES, VELOCITY_MODES]
        case _:
            return None
    for cyclic, profile in families:
        found = known.mode(*((cyclic, profile) if prefer == "cyclic" else (profile, cyclic)))
        if found is not None:
            return found
    return None


def values_of(command: Command, operation: Mode, units: Units, hold: int) -> Values:
    """The set-points of a command in a mode. `hold`: the target position where the command has none.

    Feed-forwards are objects of the cyclic modes: a profile mode makes its own."""
    if operation not in CYCLIC and isinstance(command, Position | Velocity):
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
    return _values(hold)


def standstill(position: int) -> Values:
    """Set-points that do not move a shaft at this position, in any mode."""
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
