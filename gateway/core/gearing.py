"""Gear and sign: commands at the device's shaft, feedback at the output shaft. A value and its functions."""

from __future__ import annotations

from dataclasses import dataclass

from protocols import messages as msg
from protocols.messages import Command


@dataclass(frozen=True, slots=True)
class Gearing:
    """Between a joint and its device."""

    ratio: float
    """Turns of the device's shaft per turn of the joint; negative: reversed"""
    feeds_velocity: bool
    """Whether Position takes the velocity on the way; else the device follows the position alone."""
    feeds_torque: bool
    """Likewise a torque: else its own loop must find what the load takes."""

    def at_device(self, out: Command) -> Command:
        """Return a command of the joint at the device's shaft."""
        ratio = self.ratio
        match out:
            case msg.Velocity(motor, velocity, torque):
                return msg.Velocity(motor, velocity * ratio, torque / ratio)
            case msg.Position(motor, position, velocity, torque):
                ahead = velocity * ratio if self.feeds_velocity else 0.0
                return msg.Position(motor, position * ratio, ahead, torque / ratio * self.feeds_torque)
            case msg.Torque(motor, torque):
                return msg.Torque(motor, torque / ratio)
            case msg.Hold(motor, torque) if torque:
                return msg.Hold(motor, torque / ratio)
            case msg.Impedance(motor, position, velocity, torque, stiffness, damping):
                square = ratio * ratio
                return msg.Impedance(
                    motor,
                    position * ratio,
                    velocity * ratio,
                    torque / ratio,
                    stiffness / square,
                    damping / square,
                )
        return out

    def at_output(self, event: msg.Feedback) -> msg.Feedback | None:
        """Return what a device reports at the output shaft; None if a value of it is not finite."""
        ratio, position, velocity, torque = self.ratio, event.position, event.velocity, event.torque
        current, voltage, temperature = event.current, event.voltage, event.temperature
        for value in (position, velocity, torque, current, voltage, temperature):
            if value is not None and value - value != 0.0:  # infinities and NaN less themselves are NaN
                return None
        position = None if position is None else position / ratio
        velocity = None if velocity is None else velocity / ratio
        torque = None if torque is None else torque * ratio
        return msg.Feedback(event.motor, event.t, position, velocity, torque, current, voltage, temperature)
