"""MIT-type actuators: every command is five numbers, torque + stiffness·Δposition + damping·Δvelocity.

Rules. Torque has no gains, Velocity the options' damping alone, Position and Hold both of the options'
gains; all else is Impedance. Commands of the same numbers are the same to the device: the `Spec` declares
that by `ImpedanceGains.canonical`, so that the contract does not tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

from protocols import messages as msg
from protocols.frames import CanFrame
from protocols.messages import Command
from protocols.plugin import Range
from protocols.toolkit.table import Field, Row, Table, Values, const, span

NUMBERS = ("position", "velocity", "torque", "stiffness", "damping")
COMMANDS: frozenset[type[Command]] = frozenset(
    {msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque, msg.Impedance}
)
"""What all these actuators can do."""
KP_MAX, KD_MAX = 500.0, 5.0
"""N·m/rad and N·m·s/rad at the ends of the ranges of most makes."""


def numbers(
    position: float,
    velocity: float,
    torque: float,
    stiffness: float = KP_MAX,
    damping: float = KD_MAX,
    *,
    bits: int = 12,
    floor: bool = True,
) -> tuple[list[Field], list[Field]]:
    """Return the fields of a set-point, the torque behind the gains, and those of what is measured: position,
    velocity and torque.

    Args:
        position, velocity, torque: both ends of each range [rad, rad/s, N·m].
        stiffness, damping: ends of the gains, from 0.
        bits: of each field but the position, which has 16.
        floor: they are rounded down, as most makers' code does.
    """
    ends = ("position", 16, position), ("velocity", bits, velocity), ("torque", bits, torque)
    where, speed, push = (span(name, size, -end, end, floor=floor) for name, size, end in ends)
    gains = span("stiffness", bits, 0.0, stiffness), span("damping", bits, 0.0, damping)
    measured = [span(name, size, -end, end, floor=floor, measured=True) for name, size, end in ends]
    return [where, speed, *gains, push], measured


def words(id_fields: tuple[Field, ...], last: Mapping[str, int]) -> list[Row]:
    """Return the messages that are a last byte after seven of FF, by name: on the id of set-points."""
    return [Row(n, id_fields, (const((1 << 56) - 1, 56), const(b)), order="big") for n, b in last.items()]


def encoded(
    encode: Callable[..., CanFrame], address: int, goal: msg.Impedance, others: Collection[bytes] = ()
) -> CanFrame:
    """Return the frame of a set-point; a step of position beside it, if its data are among `others`: those
    that mean something else."""
    p, v, t, kp, kd = goal.position, goal.velocity, goal.torque, goal.stiffness, goal.damping
    frame = encode(address, position=p, velocity=v, torque=t, stiffness=kp, damping=kd)
    return frame if frame.data not in others else CanFrame(frame.id, b"\xff\xfe" + frame.data[2:])


def commanded(motor: str, values: Values) -> msg.Impedance:
    """Return what a set-point of these numbers commands a motor."""
    position, velocity, torque = values["position"], values["velocity"], values["torque"]
    return msg.Impedance(motor, position, velocity, torque, values["stiffness"], values["damping"])


@dataclass(frozen=True)
class ImpedanceGains:
    """ImpedanceGains of Position, Hold and Velocity, as the row `row` of a table encodes them."""

    stiffness: float
    """N·m/rad"""
    damping: float
    """N·m·s/rad"""
    row: Row

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """Lowest and highest position."""
        return self.row.field("position").ends()

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
        low, high = self._ends
        if held is None or not low <= held <= high:  # a spring would pull it to zero, or to an end
            return msg.Impedance(motor, 0.0, 0.0, torque, 0.0, self.damping)
        return msg.Impedance(motor, held, 0.0, torque, self.stiffness, self.damping)

    def canonical(self, command: Command) -> Command:
        """Return the plainest command of the same numbers, as `Spec.canonical` does."""
        if not isinstance(command, msg.Impedance):
            return command
        motor, velocity, torque = command.motor, command.velocity, command.torque
        step, fine = self._steps  # gains are the same if they are encoded so
        as_damped = abs(command.damping - self.damping) < fine
        if abs(command.stiffness) < step:
            if abs(command.damping) < fine:
                return msg.Torque(motor, torque)
            if as_damped:
                return msg.Velocity(motor, velocity, torque)
        if as_damped and abs(command.stiffness - self.stiffness) < step:
            return msg.Position(motor, command.position, velocity, torque)
        return command

    def of_spec(self) -> dict[str, Any]:
        """Return the fields of a `Spec` that these gains are."""
        return {"canonical": self.canonical, "gains": (self.stiffness, self.damping)}

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


@cache
def gains_of(table: Table, row: str, stiffness: float, damping: float) -> ImpedanceGains:
    """Return the gains of Position, Hold and Velocity, for set-points of this row."""
    return ImpedanceGains(stiffness, damping, table.row(row))
