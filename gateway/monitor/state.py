"""What is known of buses, devices and ids by listening; `gateway.monitor.decoder` fills it in. Plain data.

Rules. Positions, velocities and torques are at the joint's output shaft, as everywhere above a driver.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from gateway.core.joint import Joint
from gateway.core.robot import BusSettings
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import SECOND, Command, Event, Fault, Measurement, Nanos, Obeyed
from protocols.plugin import CommandDecoder, Driver, Spec

CanId: TypeAlias = tuple[str, bool, bool, int]
"""Bus, whether extended, whether a remote frame, and the id."""
Place: TypeAlias = tuple[str, str, int]
"""Bus, protocol and address."""

SLICES = 20
"""Number of steps in which the window of a rate slides."""


class Rate:
    """The amount per second over a sliding window; or, if that is None, over the whole time since `began`."""

    def __init__(self, began: Nanos, window: Nanos | None) -> None:
        self.total = 0
        self._began = began
        self._window = window
        self._recent: deque[tuple[Nanos, int]] = deque()
        self._in_window = 0

    def add(self, t: Nanos, amount: int = 1) -> None:
        """Add an amount at a time; one that comes late counts as of the newest."""
        self.total += amount
        if self._window is None:
            return
        self._in_window += amount
        start = t - t % (self._window // SLICES)
        if self._recent and self._recent[-1][0] >= start:
            last, before = self._recent[-1]
            self._recent[-1] = (last, before + amount)
        else:
            self._recent.append((start, amount))
            self._discard(t, self._window)

    def per_second(self, now: Nanos) -> float:
        """Return the rate up to now."""
        amount, span = self.total, now - self._began
        if self._window is not None:
            self._discard(now, self._window)
            amount, span = self._in_window, min(span, self._window)
        return amount * SECOND / span if span > 0 else 0.0

    def _discard(self, now: Nanos, window: Nanos) -> None:
        while self._recent and self._recent[0][0] <= now - window:
            self._in_window -= self._recent.popleft()[1]


@dataclass(slots=True, eq=False)
class ProtocolVariant:
    """One protocol with one set of options on one bus, and the devices that it may have.

    The driver decodes what devices send, the decoder what they are sent. Neither is ever asked to send."""

    bus: str
    protocol: str
    driver: Driver
    decoder: CommandDecoder
    devices: dict[str, DeviceRecord] = field(default_factory=dict)
    """By the name in messages."""


@dataclass(slots=True, eq=False)
class DeviceRecord:
    """A device that is on a bus, or may be, and what is known of it."""

    name: str
    variant: ProtocolVariant = field(repr=False)
    address: int
    spec: Spec
    joint: Joint | None
    """Its newest feedback and mode; None: a sensor."""
    timeout: Nanos
    """Age of its last message after which it counts as silent."""
    kinds: dict[str, Rate] = field(default_factory=dict)
    """Rates of its events, by kind."""
    received_at: Nanos | None = None
    measurement: Measurement | None = None
    faults: dict[tuple[int, str], Fault] = field(default_factory=dict)
    past_faults: dict[tuple[int, str], Fault] = field(default_factory=dict)
    command: Command | None = None
    """The last one that it was sent and would obey."""
    commanded_at: Nanos | None = None
    commands: Rate | None = None

    @property
    def place(self) -> Place:
        """Where it is; the same in all variants of its protocol."""
        return self.variant.bus, self.variant.protocol, self.address

    @property
    def ratio(self) -> float:
        """Turns of the device's shaft per turn of the joint, with its sign."""
        return self.joint.settings.gear * self.joint.settings.sign if self.joint else 1.0

    @property
    def weight(self) -> int:
        """Number of decoded events; faults do not count."""
        return sum(rate.total for kind, rate in self.kinds.items() if kind != Fault.__name__)

    @property
    def merit(self) -> float:
        """Plausibility of the variant's options for this device: less if they yield faults."""
        return self.weight / (1 + len(self.faults))

    def silent(self, now: Nanos) -> bool:
        """True if its last message is older than its timeout."""
        return self.received_at is None or now - self.received_at > self.timeout


@dataclass(slots=True)
class IdRecord:
    """What is known of an id on a CAN bus."""

    rate: Rate
    last: CanFrame
    received_at: Nanos
    kinds: dict[str, None] = field(default_factory=dict)
    """Of the events decoded from it, in order of appearance."""
    could_be: dict[str, None] = field(default_factory=dict)
    """Names of devices, not found yet, that some protocol would decode it to."""


@dataclass(slots=True)
class BusRecord:
    """What is known of one bus."""

    settings: BusSettings
    packets: Rate
    busy: Rate
    """ns of transmission time, at most."""
    state: BusState = BusState.UP
    left_out: bool = False
    """It could not be opened."""


@dataclass(slots=True)
class DecodedPacket:
    """What one packet means."""

    packet: Packet
    direction: Literal["from", "to", ""] = ""
    """Whether a device sent or receives it; "" if that is not known."""
    events: list[Event] = field(default_factory=list)
    commands: list[Obeyed] = field(default_factory=list)
    """Commands and requests that devices would obey."""
    guesses: list[Event] = field(default_factory=list)
    """Events, if it was sent by a device that has not been found yet."""
    names: tuple[str, ...] = ()
    """The devices to which its id belongs."""
    failures: list[str] = field(default_factory=list)
    """What plugins raised of it."""
