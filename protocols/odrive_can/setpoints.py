"""Commands → control mode and input, the same in both firmware lines. Pure functions; turns, turns/s, N·m."""

from __future__ import annotations

from typing import TypeAlias

from protocols.messages import Command, Position, Torque, Velocity
from protocols.odrive_can.codec import turns
from protocols.odrive_can.messages import ControlMode, SetInputPos, SetInputTorque, SetInputVel

Input: TypeAlias = SetInputPos | SetInputVel | SetInputTorque


def setpoint(command: Command, hold: float) -> tuple[ControlMode, Input]:
    """The control mode and input of a command; `hold` is where Hold holds."""
    match command:
        case Position(_, position, velocity, torque):
            return ControlMode.POSITION, SetInputPos(turns(position), turns(velocity), torque)
        case Velocity(_, velocity, torque):
            return ControlMode.VELOCITY, SetInputVel(turns(velocity), torque)
        case Torque(_, torque):
            return ControlMode.TORQUE, SetInputTorque(torque)
    return ControlMode.POSITION, SetInputPos(hold, 0.0, 0.0)


def standstill(mode: ControlMode, position: float) -> Input:
    """The input that does not move a shaft at this position."""
    if mode == ControlMode.POSITION:
        return SetInputPos(position, 0.0, 0.0)
    return SetInputVel(0.0, 0.0) if mode == ControlMode.VELOCITY else SetInputTorque(0.0)
