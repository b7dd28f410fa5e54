"""MIT-type actuators: every command is five numbers, torque + stiffness·Δposition + damping·Δvelocity.

Rules. Torque has no gains, Velocity the options' damping alone, Position and Hold both of the options'
gains; all else is Impedance. Commands of the same numbers are the same to the device: the `Spec` declares
that by `ImpedanceGains.canonical`, so that the contract does not tell them apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from protocols import messages as msg
from protocols.messages import Command
from protocols.plugin import Range
from protocols.toolkit.table import Row

NUMBERS = ("position", "velocity", "torque", "stiffness", "damping")


@dataclass(frozen=True)
class ImpedanceGains:
    """ImpedanceGains of Position, Hold and Velocity, as the row `row` of a table encodes them."""

    stiffness: float
    """N·m/rad"""
    damping: float
    """N·m·s/rad"""
    row: Row

    @cached_property
    def _steps(self) -> tuple[float, float]:
        """Values of one count of both."""
        return self.row.field("stiffness").step, self.row.field("damping").step

    def impedance(self, command: Command, held: float | None) -> msg.Impedance:
        """Return a command as five numbers; Hold is at `held` [rad]."""
        motor = command.motor
        match command:
            case msg.Position(_, position, velocity, torque):
                return msg.Impedance(motor, position, velocity, torque, self.stiffness, self.damping)
            case msg.Velocity(_, velocity, torque):
                return msg.Impedance(motor, 0.0, velocity, torque, 0.0, self.damping)
            case msg.Torque(_, torque):
                return msg.Impedance(motor, 0.0, 0.0, torque, 0.0, 0.0)
            case msg.Impedance():
                return command
        torque = getattr(command, "torque", 0.0)  # of Hold
        low, high = self.row.field("position").ends()
        if held is None or not low <= held <= high:  # a spring would pull it to zero, or to an end
            return msg.Impedance(motor, 0.0, 0.0, torque, 0.0, self.damping)
        return msg.Impedance(motor, held, 0.0, torque, self.stiffness, self.damping)

    def canonical(self, command: Command) -> Command:
        """Return the plainest command of the same numbers, as `Spec.canonical` does."""
        if not isinstance(command, msg.Impedance):
            return command
        motor, velocity, torque = command.motor, command.velocity, command.torque
        if self._is(command, 0.0, 0.0):
            return msg.Torque(motor, torque)
        if self._is(command, 0.0, self.damping):
            return msg.Velocity(motor, velocity, torque)
        if self._is(command, self.stiffness, self.damping):
            return msg.Position(motor, command.position, velocity, torque)
        return command

    def _is(self, command: msg.Impedance, stiffness: float, damping: float) -> bool:
        """True if a command's gains are these, as they are encoded."""
        steps = self._steps
        return abs(command.stiffness - stiffness) < steps[0] and abs(command.damping - damping) < steps[1]

    def ranges(self) -> dict[str, Range]:
        """Return the ranges of all commands, as in `Spec.ranges`."""
        spans = {name: self.row.field(name).range() for name in NUMBERS}
        carried = {
            "Position": NUMBERS[:3],
            "Velocity": NUMBERS[1:3],
            "Torque": NUMBERS[2:3],
            "Hold": NUMBERS[2:3],
            "Impedance": NUMBERS,
        }
        return {f"{kind}.{name}": spans[name] for kind, names in carried.items() for name in names}
