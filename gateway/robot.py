"""A robot as the robot file describes it. Values only; `gateway.config` makes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from gateway.joint import JointSettings
from gateway.topics import BagTopics
from protocols.plugin import Device, Plugin, Spec
from protocols.words import Nanos

if TYPE_CHECKING:
    from brain.perception.mount import Mount
    from brain.settings import BrainSettings

TWIN = "twin"
"""The interface of a bus that is no wire: the world with its twins."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """One bus of the robot."""

    name: str
    kind: Literal["can", "canfd", "serial"]
    interface: str
    """What it is reached by: "socketcan:can0", "serial:/dev/ttyUSB0", or "twin"."""
    bitrate: int = 0
    """bit/s of a CAN bus, in the arbitration phase; 0 on a serial line."""
    data_bitrate: int = 0
    """bit/s in the data phase of CAN FD; 0 elsewhere."""
    baudrate: int = 0
    """bit/s of a serial line; 0 on a CAN bus."""
    heard: tuple[tuple[int, int], ...] = ()
    """Which CAN ids are let in, as (id, mask): those whose masked bits are these. (): everything."""
    acknowledged: bool = False
    """Whether somebody has said that he knows what it means for languages to share this bus."""


@dataclass(frozen=True, slots=True)
class Motor:
    """One motor and the joint it drives."""

    name: str
    bus: str
    plugin: Plugin
    device: Device
    spec: Spec
    joint: JointSettings


@dataclass(frozen=True, slots=True)
class Sensor:
    """One sensor and where it is mounted."""

    name: str
    bus: str
    plugin: Plugin
    device: Device
    spec: Spec
    mount: Mount
    timeout: Nanos
    """Silence after which its measurements are too old; the brain goes slow and stands at shares of it."""


@dataclass(frozen=True, slots=True)
class Robot:
    """The whole of a robot file."""

    name: str
    text: str
    """The file itself: what a recording carries, and what a replay is built from."""
    period: Nanos
    """Between two steps."""
    world: str | None
    """What stands behind the twins: a shipped world's name or a file's path."""
    seed: int
    buses: dict[str, BusSettings]
    motors: dict[str, Motor]
    sensors: dict[str, Sensor]
    brain: BrainSettings
    bag: BagTopics | None = None
    """What the topics of somebody else's bag are; None if the file says nothing of that."""
