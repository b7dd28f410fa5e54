"""MIT-type actuators: every command is five numbers, torque + stiffness·Δposition + damping·Δvelocity.

Rules. Torque has no gains, Velocity the options' damping alone, Position and Hold both of the options'
gains; all else is Impedance. Commands of the same numbers are the same to the device: `Gains.canonical` is
what the `Spec` declares, so that the contract does not tell them apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from protocols import messages as msg
from protocols.messages import Command
from protocols.plugin import Range
from protocols.toolkit.table import Row

NUMBERS = ("position", "velocity", "torque", "stiffness", "damping")


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of Position, Hold and Velocity, as the row `row` of a table encodes them."""

    stiffness: float
    """N·m/rad"""
    damping: float
    """N·m·s/rad"""
    row: Row

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
        return msg.Impedance(motor, held or 0.0, 0.0, 0.0, self.stiffness, self.damping)

    def command(self, motor: str, numbers: Mapping[str, float]) -> Command:
        """Return the plainest command that five numbers are."""
        position, velocity, torque, stiffness, damping = (numbers[name] for name in NUMBERS)
        if self._equal("stiffness", stiffness, 0.0):
            if self._equal("damping", damping, 0.0):
                return msg.Torque(motor, torque)
            if self._equal("damping", damping, self.damping):
                return msg.Velocity(motor, velocity, torque)
        elif self._equal("stiffness", stiffness, self.stiffness) and self._equal(
            "damping", damping, self.damping
        ):
            return msg.Position(motor, position, velocity, torque)
        return msg.Impedance(motor, position, velocity, torque, stiffness, damping)

    def canonical(self, command: Command) -> Command:
        """Return the plainest command of the same numbers, as `Spec.canonical` does."""
        if not isinstance(command, msg.Impedance):
            return command
        return self.command(command.motor, {name: getattr(command, name) for name in NUMBERS})

    def _equal(self, name: str, one: float, other: float) -> bool:
        return abs(one - other) < self.row.field(name).step

    def ranges(self) -> dict[str, Range]:
        """Return the ranges of all commands, as in `Spec.ranges`."""
        spans = {name: self.row.field(name).range() for name in NUMBERS}
        carried = {
            "Position": NUMBERS[:3],
            "Velocity": NUMBERS[1:3],
            "Torque": NUMBERS[2:3],
            "Impedance": NUMBERS,
        }
        return {f"{kind}.{name}": spans[name] for kind, names in carried.items() for name in names}
