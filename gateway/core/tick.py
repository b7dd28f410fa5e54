"""A tick: everything that went into one step of the gateway, and everything that came out. Values only.

A recording is the list of ticks; replay maps `Gateway.step` over their inputs and compares the outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.frames import BusState, Packet
from protocols.messages import SECOND, Event, Instruction, Nanos


@dataclass(frozen=True, slots=True)
class Inputs:
    """The inputs of one step, in the order in which it processes them."""

    states: tuple[tuple[str, BusState], ...] = ()
    """State changes of buses, as (bus, state)."""
    packets: tuple[Packet, ...] = ()
    """Frames received, with their receive times."""
    instructions: tuple[Instruction, ...] = ()
    """Requests, tasks and commands of an operator or a tool."""


@dataclass(frozen=True, slots=True)
class Note:
    """A message for the operator: what happened, where, what to do."""

    level: Literal["info", "warning", "error"]
    source: str
    """A motor, a sensor, a bus, "scan", "brain" or "operator"."""
    text: str


@dataclass(frozen=True, slots=True)
class Outputs:
    """The outputs of one step."""

    packets: tuple[Packet, ...] = ()
    """Frames to send, in order; every t is the step's now."""
    events: tuple[Event, ...] = ()
    """What the drivers decoded and the brain received, at the joints' output shafts."""
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, slots=True)
class Tick:
    """One step of the gateway."""

    number: int
    now: Nanos
    inputs: Inputs
    outputs: Outputs

    @property
    def seconds(self) -> float:
        """The time of the step in s, on the session's clock."""
        return self.now / SECOND
