"""A robot as its robot file describes it: values only, made by `gateway.config`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

from gateway.core.joint import JointSettings
from gateway.vision.detectors import Detectors
from protocols.frames import IdMask
from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import Device, Plugin, Spec

if TYPE_CHECKING:
    from brain.perception.mount import Mount
    from brain.settings import BrainSettings

TWIN = "twin"
"""The interface of a simulated bus: the world with the twins of its devices."""
TRANSMIT_QUEUE = 100
"""CAN frames: more than robots send in a step. (The kernel's own `txqueuelen` of a CAN interface is 10.)"""
CLASSIC_ADAPTERS = ("dm-serial",)
"""Interfaces that carry classic CAN only."""
KERNEL = '"socketcan:can0", since Linux has a driver for it (`ip link` lists its name)'
ADAPTERS = {
    "candle": KERNEL,
    "candlelight": KERNEL,
    "gs_usb": KERNEL,
    "peak": KERNEL,
    "canable": '"slcan:/dev/ttyACM0", or with the firmware candleLight "socketcan:can0"',
    "waveshare": '"seeedstudio:/dev/ttyUSB0" for its USB-CAN-A, "socketcan:can0" for its boards on SPI',
}
"""What people call the interface of an adapter, and what it is called here."""
LATENCY: Nanos = 2 * MILLISECOND
"""Of a serial port on USB, both ways: a frame of the bus each (1 ms), where it has no timer of its own."""
SHAREABLE = ("socketcan", "udp_multicast")
"""Interfaces that several processes of a machine can use at once; a port is one process's alone."""
USB_NAME = re.compile(r"usb-([0-9A-Fa-f]{4}):([0-9A-Fa-f]{4}):([^/@]+)(/[0-9]+)?")
"""An adapter in place of its port or interface: vendor, product, serial number; of channels, which."""
STALL_TIMEOUT: Nanos = 500 * MILLISECOND
"""How long the loop may stand, if the robot file does not say."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """One bus of the robot."""

    name: str
    kind: Literal["can", "canfd", "serial"]
    interface: str
    """Interface and channel: "socketcan:can0", "serial:/dev/ttyUSB0", or "twin"."""
    bitrate: int = 0
    """bit/s of a CAN bus, in the arbitration phase; 0 on a serial line."""
    data_bitrate: int = 0
    """bit/s in the data phase of CAN FD; 0 elsewhere."""
    baudrate: int = 0
    """bit/s of a serial line; 0 on a CAN bus."""
    receive_filter: tuple[IdMask, ...] = ()
    """CAN ids to receive. (): all."""
    transmit_queue: int = TRANSMIT_QUEUE
    """CAN frames that the interface's transmit queue should hold, and a simulated one holds."""
    acknowledged: bool = False
    """Whether the robot file acknowledges what it means for several protocols to share this bus."""
    devices: tuple[Spec, ...] = ()
    """The specs of what is on it."""
    echo: Literal["auto", "yes", "no"] = "auto"
    """Of a serial line: whether what is sent comes back. "auto": it is found out."""
    rs485: Literal["off", "rts_high", "rts_low"] = "off"
    """Of a serial line: whether the kernel switches its direction by RTS, and its level while sending."""
    dtr: Literal["on", "off"] = "on"
    """Of a serial line: the level of DTR while it is open. With "off" it is on from when it is closed."""
    latency: Nanos = LATENCY
    """Of a serial line: what port and machine take both ways. An answer is waited for so much longer."""
    turnaround: Nanos = 0
    """Of a serial line: from the end of an answer to the next frame."""

    @property
    def line(self) -> Literal["free", "asked", "half-duplex"]:
        """How its devices share a serial line (`Spec.line`)."""
        kinds = {one.line for one in self.devices}
        return "half-duplex" if "half-duplex" in kinds else "asked" if "asked" in kinds else "free"

    @property
    def shareable(self) -> bool:
        """Whether another process of this machine can send on it, too."""
        return self.interface.partition(":")[0] in SHAREABLE


@dataclass(frozen=True, slots=True)
class Motor:
    """One motor and the joint it drives."""

    name: str
    bus: str
    plugin: Plugin
    device: Device
    spec: Spec
    assumed: tuple[str, ...]
    """Scales that neither the robot file states nor the device reports: "options.pole_pairs = 7"."""
    joint: JointSettings


@dataclass(frozen=True, slots=True)
class Sensor:
    """One sensor and where it is mounted."""

    name: str
    bus: str
    plugin: Plugin
    device: Device
    spec: Spec
    assumed: tuple[str, ...]
    """As of a motor."""
    mount: Mount
    """In the robot's frame: m, rad."""
    timeout: Nanos
    """Age at which its measurements are too old; the brain slows down and stands at fractions of it."""


BusDevice: TypeAlias = Motor | Sensor
"""A device with an address on a bus."""


def by_protocol(devices: Iterable[BusDevice]) -> list[tuple[Plugin, list[BusDevice]]]:
    """Group devices by protocol; one driver serves each group of a bus. Keeps the order."""
    groups: dict[str, list[BusDevice]] = {}
    for device in devices:
        groups.setdefault(device.plugin.name, []).append(device)
    return [(group[0].plugin, group) for group in groups.values()]


@dataclass(frozen=True, slots=True)
class BagCamera:
    """The topics of a camera, and what is looked for in its images."""

    image: str
    """sensor_msgs/Image"""
    info: str
    """sensor_msgs/CameraInfo"""
    detectors: Detectors


@dataclass(frozen=True, slots=True)
class BagTopics:
    """The table [bag]: what the topics of a recording made elsewhere (a ROS bag) are on this robot."""

    odometry: str
    """nav_msgs/Odometry: its twist is taken as the motion of the wheels."""
    sensors: dict[str, str] = field(default_factory=dict)
    """Topic by sensor of this robot: sensor_msgs/Imu."""
    truth: str = ""
    """sensor_msgs/NavSatFix: the reference for the estimated path; never an input. "" if there is none."""
    cameras: dict[str, BagCamera] = field(default_factory=dict)
    """By sensor of this robot."""

    def parts(self) -> Iterator[tuple[str, str]]:
        """Yield each topic with the key that names it: "odometry", "sensors.imu", "cameras.eye.image" …"""
        yield self.odometry, "odometry"
        yield from ((topic, f"sensors.{sensor}") for sensor, topic in self.sensors.items())
        for sensor, camera in self.cameras.items():
            yield camera.image, f"cameras.{sensor}.image"
            yield camera.info, f"cameras.{sensor}.info"
        if self.truth:
            yield self.truth, "truth"


@dataclass(frozen=True, slots=True)
class Robot:
    """A complete robot file."""

    name: str
    text: str
    """The file itself: a recording carries it, and a replay is built from it."""
    period: Nanos
    """Time between two steps."""
    world: str | None
    """The simulated world behind the twins: a shipped world's name or a file's path."""
    seed: int
    """Seed of the simulated world."""
    buses: dict[str, BusSettings]
    motors: dict[str, Motor]
    sensors: dict[str, Sensor]
    brain: BrainSettings
    bag: BagTopics | None = None
    """Topics of a foreign bag; None if the file has no table [bag]."""
    plant: str | None = None
    """What the robot truly is in a simulated scene: a shipped plant's name or a file's path."""
    stall_timeout: Nanos = STALL_TIMEOUT
    """How long the loop may stand before the watchdog process sends the stop action."""

    def devices(self) -> list[BusDevice]:
        """Return all devices, in the order of the file: motors first, then sensors."""
        return [*self.motors.values(), *self.sensors.values()]

    def devices_on(self, bus: str) -> list[BusDevice]:
        """Return the devices on a bus, in the order of `devices`."""
        return [device for device in self.devices() if device.bus == bus]

    def by_protocol(self, bus: str) -> list[tuple[Plugin, list[Device]]]:
        """Return the devices on a bus, grouped by protocol, as a driver or a decoder takes them."""
        groups = by_protocol(self.devices_on(bus))
        return [(plugin, [one.device for one in group]) for plugin, group in groups]
