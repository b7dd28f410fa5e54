"""What an axis is sent over any transport: mode and inputs of a command; what forbids a restart; and how a
procedure has ended."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from protocols import messages as msg
from protocols.messages import Command, Event, Nanos
from protocols.odrive_can import errors
from protocols.odrive_can.table import IDLE, ControlMode
from protocols.toolkit.host import Host, Own
from protocols.toolkit.motor_driver import Pending
from protocols.toolkit.table import Values

COMMANDS: frozenset[type[Command]] = frozenset({msg.Idle, msg.Hold, msg.Position, msg.Velocity, msg.Torque})
MODES: Mapping[type[Command], ControlMode] = {
    msg.Velocity: ControlMode.VELOCITY,
    msg.Torque: ControlMode.TORQUE,
}
"""By command; of all others it is position control."""


def refusal(command: Command) -> str:
    """Return why an axis cannot take a command at all, "" if it can."""
    return "the device has no impedance control" if isinstance(command, msg.Impedance) else ""


def control_mode(command: Command) -> ControlMode:
    """Return the mode of a command."""
    return MODES.get(type(command), ControlMode.POSITION)


def inputs(command: Command, held: float | None) -> tuple[str, Values]:
    """Return the message of a set-point over CAN, and its numbers in turns; of Hold: at `held` [rad]."""
    match command:
        case msg.Velocity(_, velocity, torque):
            return "Set_Input_Vel", {"Input_Vel": velocity / math.tau, "Input_Torque_FF": torque}
        case msg.Torque(_, torque):
            return "Set_Input_Torque", {"Input_Torque": torque}
        case msg.Position(_, position, velocity, torque):
            turns = {"Input_Pos": position / math.tau, "Vel_FF": velocity / math.tau}
            return "Set_Input_Pos", turns | {"Torque_FF": torque}
    return "Set_Input_Pos", {"Input_Pos": (held or 0.0) / math.tau, "Vel_FF": 0.0, "Torque_FF": 0.0}


def armed_of(hosts: Iterable[Host[Own]]) -> str:
    """Return the first of these that is, or may be, armed; "" if none is."""
    return next((each.name for each in hosts if each.running), "")


HEARTBEATS = 2
"""Reports of its state since a request, until one is sure to be from after it."""


def outcome(
    t: Nanos, pending: Pending[Own], state: int, result: int, text: str, *, faulty: bool
) -> Event | None:
    """Return how a procedure ended, once it ran, or a report is sure to be from after its request; else None.

    Args:
        t: the time of the report [ns].
        pending: the request; `notes` has "ran" when the procedure has begun.
        state: that of the axis.
        result: that of its last procedure; SUCCESS where the firmware has none.
        text: what its state and its errors are called.
        faulty: whether it has any.
    """
    notes = pending.notes
    if state != IDLE or result == errors.BUSY:
        notes["ran"] = True
        return None
    notes["beats"] = notes.get("beats", 0) + 1
    certain = notes["beats"] >= HEARTBEATS and (faulty or result not in errors.INCONCLUSIVE)
    if not (notes.get("ran") or certain):
        return None
    if result == errors.SUCCESS and not faulty:
        return pending.done(t, "it has ended")
    return pending.refuse(t, text)
