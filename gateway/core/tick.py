"""A tick: all that went into one step of the gateway, and all that came out. Values only.

A recording is the list of ticks; replay maps `Gateway.step` over their inputs and compares outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from protocols.frames import BusState, Packet
from protocols.messages import Event, Instruction, Nanos


@dataclass(frozen=True, slots=True)
class Inputs:
    """What one step takes in, in the order in which it is taken in."""

    states: tuple[tuple[str, BusState], ...] = ()
    """Changes of buses, by name of the bus."""
    packets: tuple[Packet, ...] = ()
    instructions: tuple[Instruction, ...] = ()
    """What a person or a tool asked for."""


@dataclass(frozen=True, slots=True)
class Note:
    """A sentence for a person: what happened, where, what to do."""

    level: Literal["info", "warning", "error"]
    about: str
    """A motor, a sensor, a bus, "brain" or "operator"."""
    text: str


@dataclass(frozen=True, slots=True)
class Outputs:
    """What one step gives out."""

    packets: tuple[Packet, ...] = ()
    """To be written, in order; every t is the step's now."""
    events: tuple[Event, ...] = ()
    """What the drivers heard, at the joints' output shafts: what the brain was told."""
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True, slots=True)
class Tick:
    """One step of the gateway."""

    number: int
    now: Nanos
    inputs: Inputs
    outputs: Outputs
