"""A robot as the robot file describes it. Values only; `gateway.config` makes them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from gateway.core.joint import JointSettings
from protocols.messages import Nanos
from protocols.plugin import Device, Plugin, Spec

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
    receive_filter: tuple[tuple[int, int], ...] = ()
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
class BagTopics:
    """The table [bag]: what the topics of a recording made elsewhere (a ROS bag) are on this robot."""

    odometry: str
    """nav_msgs/Odometry: its twist is what the wheels did."""
    sensors: dict[str, str] = field(default_factory=dict)
    """A sensor of this robot, and its topic: sensor_msgs/Imu."""
    truth: str = ""
    """sensor_msgs/NavSatFix: what the believed path is judged by; never an input. "" if there is none."""

    def parts(self) -> Iterator[tuple[str, str]]:
        """Each topic and its part, as the key that names it: "odometry", "sensors.imu", "truth"."""
        yield self.odometry, "odometry"
        yield from ((topic, f"sensors.{sensor}") for sensor, topic in self.sensors.items())
        if self.truth:
            yield self.truth, "truth"


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
