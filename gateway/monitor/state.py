"""What is known of a bus, its devices and its ids by listening; `gateway.monitor.decoder` fills it in.

Rules. Positions, velocities and torques are at the joint's output shaft, as everywhere above a driver.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from gateway.core.joint import Joint
from gateway.core.robot import BusSettings
from gateway.monitor.candidates import Party
from gateway.monitor.rate import Rate
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import Command, Event, Fault, Fix, Imu, LaserScan, Nanos, Request

Measured: TypeAlias = Imu | LaserScan | Fix
Told: TypeAlias = Command | Request
Id: TypeAlias = tuple[str, bool, bool, int]
"""Bus, whether extended, whether a remote frame, and the id."""


@dataclass(slots=True)
class Seen:
    """What is known of one device."""

    party: Party
    joint: Joint | None
    """Its newest feedback and mode; None: a sensor."""
    says: dict[str, Rate] = field(default_factory=dict)
    """What has been made of its messages, by the kind of word."""
    received_at: Nanos | None = None
    measured: Measured | None = None
    faults: dict[tuple[int, str], Fault] = field(default_factory=dict)
    past: dict[tuple[int, str], Fault] = field(default_factory=dict)
    """Faults that it had."""
    command: Command | None = None
    """What it was last told and would obey."""
    commanded_at: Nanos | None = None
    commands: Rate | None = None
    extended: bool | None = None
    """Whether its ids are extended ones; None: not known, or not on CAN."""

    @property
    def weight(self) -> int:
        """How often a language has made sense of it; that it complains is none."""
        return sum(rate.total for kind, rate in self.says.items() if kind != Fault.__name__)

    @property
    def merit(self) -> float:
        """How much sense these options make: less if they make the device complain."""
        return self.weight / (1 + len(self.faults))

    def silent(self, now: Nanos) -> bool:
        """Whether what it last said is too old."""
        return self.received_at is None or now - self.received_at > self.party.silent_after


@dataclass(slots=True)
class SeenId:
    """An id on a CAN bus."""

    rate: Rate
    last: CanFrame
    at: Nanos
    kinds: dict[str, None] = field(default_factory=dict)
    """Of the words that have come from it."""
    could_be: dict[str, None] = field(default_factory=dict)
    """Devices, not found, that a language would make of it."""


@dataclass(slots=True)
class SeenBus:
    """One bus."""

    settings: BusSettings
    packets: Rate
    busy: Rate
    """ns on the wire, at most."""
    state: BusState = BusState.UP
    trouble: str = ""
    """Why it is not listened to."""


@dataclass(frozen=True, slots=True)
class Heard:
    """What one packet means."""

    packet: Packet
    direction: Literal["from", "to", ""]
    """Whether it comes from a device or goes to one; "" if nobody knows."""
    said: tuple[Event, ...] = ()
    reported: tuple[Told, ...] = ()
    """What devices would obey."""
    guessed: tuple[Event, ...] = ()
    """What it would mean if it came from a device that has not been found."""
    names: tuple[str, ...] = ()
    """The devices whose id it has."""


def about(word: Event | Told) -> str:
    """The device that a word is about; "" if it is about none."""
    return str(getattr(word, "motor", "") or getattr(word, "sensor", "") or getattr(word, "name", ""))


def at_joint(word: Told, ratio: float) -> Told:
    """A word of the device's shaft at the joint's output shaft: one turn there is `ratio` turns here."""
    factors = {
        "position": 1.0 / ratio,
        "velocity": 1.0 / ratio,
        "torque": ratio,
        "stiffness": ratio * ratio,
        "damping": ratio * ratio,
    }
    changes = {name: getattr(word, name) * by for name, by in factors.items() if hasattr(word, name)}
    return replace(word, **changes) if changes and isinstance(word, Command) else word
