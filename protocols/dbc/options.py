"""`Options` of the driver: which signals of a file command a motor and report it, and `Settings` of its twin.

Rules. A signal is named "MESSAGE.SIGNAL"; `{}` in it is the motor's address. Where a signal is given a value,
"MESSAGE.SIGNAL = VALUE", the value is the physical one, or the name that the file has for it. A message
without signals is named alone. What the file does not have is found by the spec, all mistakes at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from protocols.bounds import Bounds, FileText, check

Unit = Literal[
    "", "rad", "deg", "rev", "rad/s", "deg/s", "rev/s", "rpm", "N·m", "mN·m", "A", "mA", "V", "mV", "°C"
]
UNITS: dict[str, tuple[str, float]] = {
    "": ("", 1.0),
    "rad": ("position", 1.0),
    "deg": ("position", math.pi / 180.0),
    "rev": ("position", math.tau),
    "rad/s": ("velocity", 1.0),
    "deg/s": ("velocity", math.pi / 180.0),
    "rev/s": ("velocity", math.tau),
    "rpm": ("velocity", math.tau / 60.0),
    "N·m": ("torque", 1.0),
    "mN·m": ("torque", 1e-3),
    "A": ("current", 1.0),
    "mA": ("current", 1e-3),
    "V": ("voltage", 1.0),
    "mV": ("voltage", 1e-3),
    "°C": ("temperature", 1.0),
}
"""Of each unit: the quantity, and one of it in SI"""
MOST_SIGNALS = 32
"""Entries of a list"""


@dataclass(frozen=True, slots=True)
class Fed:
    """A signal that reports a quantity."""

    signal: str
    """ "MESSAGE.SIGNAL" """
    unit: Unit = ""
    """Of its physical value, whatever the file says: "" is SI, with `scale`"""
    scale: Annotated[float, Bounds(-1e9, 1e9)] = 1.0
    """Times its value; −1: it counts the other way. A torque in A has the torque constant here, unit "" """

    def __post_init__(self) -> None:
        check(self, ("scale", "scale is 0: every value would be the same" * (self.scale == 0.0)))


@dataclass(frozen=True, slots=True)
class Commanded(Fed):
    """A signal that commands a quantity."""

    beside: tuple[str, ...] = ()
    """Signals that go with it, such as a mode: "MESSAGE.SIGNAL = VALUE" """


@dataclass(frozen=True, slots=True)
class Told:
    """A signal that tells a state."""

    signal: str
    """ "MESSAGE.SIGNAL" """
    armed: tuple[str, ...]
    """Its values while the motor is powered"""
    ready: str = "0"
    """Its value while it is not, as the twin sends it; every other value but `armed` means it, too"""


@dataclass(frozen=True, slots=True)
class Faulty:
    """A signal that tells of faults."""

    signal: str
    """ "MESSAGE.SIGNAL" """
    none: str = "0"
    """Its value without a fault"""


@dataclass(frozen=True, slots=True)
class Feedback:
    """The signals that report."""

    position: Fed | None = None
    velocity: Fed | None = None
    torque: Fed | None = None
    current: Fed | None = None
    voltage: Fed | None = None
    temperature: Fed | None = None
    within_turn: bool = False
    """The position begins anew after each turn: turns are counted here"""
    state: Told | None = None
    """Without it the motor counts as armed while it is commanded"""
    fault: Faulty | None = None


@dataclass(frozen=True, slots=True)
class Options:
    """What a motor is commanded by, and what reports it."""

    file: FileText = ""
    """The file with the messages: DBC, KCD, SYM or ARXML, beside the robot file"""
    position: Commanded | None = None
    velocity: Commanded | None = None
    torque: Commanded | None = None
    enable: tuple[str, ...] = ()
    """What powers the motor: "MESSAGE.SIGNAL = VALUE". Sent with each command where it is in the same
    message, or nothing tells the state; else until the state is one of `armed`. (): commanding it does"""
    idle: tuple[str, ...] = ()
    """The safe command: what is sent when the motor is to be idle, at every stop and at the end"""
    clear: tuple[str, ...] = ()
    """What clears its faults; (): they pass by themselves, or cannot be cleared over this bus"""
    counters: tuple[str, ...] = ()
    """Signals that count the messages they are in, both ways: one that does not go on is not believed"""
    checksums: tuple[str, ...] = ()
    """ "MESSAGE.SIGNAL = KIND", both ways; KIND as in checksums.py"""
    feedback: Feedback = field(default_factory=Feedback)
    period_ms: Annotated[float, Bounds(1.0, 1000.0)] = 10.0
    """Of each message that is sent"""
    periods: tuple[str, ...] = ()
    """ "MESSAGE = MILLISECONDS" of those with another one"""
    feedback_ms: Annotated[float, Bounds(1.0, 1000.0)] = 10.0
    """Period of the motor's messages"""
    offline_ms: Annotated[float, Bounds(10.0, 10_000.0)] = 250.0
    """Time without one after which it is offline"""
    timeout_ms: Annotated[float, Bounds(0.0, 10_000.0)] = 0.0
    """Time without a command after which the device lets go by itself; 0: it does not"""
    watchdog: Literal["unknown", "acknowledged"] = "unknown"
    """"acknowledged": the author of the robot file knows that the device has no timeout."""

    def __deepcopy__(self, _: dict[int, object]) -> Options:
        return self

    def __post_init__(self) -> None:
        late = f"offline_ms ({self.offline_ms:g}) must be at least twice feedback_ms ({self.feedback_ms:g})"
        lists = ("enable", "idle", "clear", "counters", "checksums", "periods")
        check(
            self,
            ("offline_ms", late * (self.offline_ms < 2 * self.feedback_ms)),
            *(
                (name, f"more than {MOST_SIGNALS}")
                for name in lists
                if len(getattr(self, name)) > MOST_SIGNALS
            ),
        )


@dataclass(frozen=True, slots=True)
class Settings:
    """The motor in simulation."""

    torque: Annotated[float, Bounds(1e-3, 1e6)] = 10.0
    """N·m at most"""
    gain: Annotated[float, Bounds(0.0, 1e6)] = 0.3
    """N·m·s/rad of its loop for velocity"""
    torque_constant: Annotated[float, Bounds(1e-4, 1e3)] = 0.1
    """N·m/A"""
    voltage: Annotated[float, Bounds(1.0, 1000.0)] = 24.0
    temperature: Annotated[float, Bounds(-40.0, 150.0)] = 30.0
    """°C"""

    def __post_init__(self) -> None:
        check(self)
