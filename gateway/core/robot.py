"""A robot as its robot file describes it: values only, made by `gateway.config`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from brain.perception.mount import Mount
from gateway.core.joint import JointSettings
from gateway.vision.detectors import Detectors
from gateway.vision.live import LiveCamera
from protocols.bounds import Bounds, Duration, Invalid, check
from protocols.frames import OF_BYTES, IdMask
from protocols.messages import MILLISECOND, Imu, Measurement, Nanos
from protocols.plugin import Device, Plugin, Spec

if TYPE_CHECKING:
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
    kind: Literal["can", "canfd", "serial", "i2c", "camera"]
    interface: str
    """Interface and channel: "socketcan:can0", "serial:/dev/ttyUSB0", or "twin"."""
    bitrate: int = 0
    """bit/s of a CAN bus, in the arbitration phase; 0 on a serial line."""
    data_bitrate: int = 0
    """bit/s in the data phase of CAN FD; 0 elsewhere."""
    baudrate: int = 0
    """bit/s of a serial line, of I²C, or of a camera's USB; 0 on a CAN bus."""
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
    camera: LiveCamera | None = None
    """Of a camera: its pictures, and what is looked for in them."""

    @property
    def carries_bytes(self) -> bool:
        """Whether its frames are bytes: of all but a CAN bus."""
        return self.kind in OF_BYTES

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
    late: Nanos = 0
    """By so much its measurements are stamped later than they were made."""
    gyro_scale: float = 1.0
    """What its gyro reads for each rad/s."""

    @property
    def errs(self) -> bool:
        """Whether the file states an error of it."""
        return bool(self.late) or self.gyro_scale != 1.0

    def corrected(self, reading: Measurement) -> Measurement:
        """Return what it has reported without the errors that the file states."""
        return _scaled(replace(reading, t=reading.t - self.late), 1.0 / self.gyro_scale)

    def reported(self, true: Measurement) -> Measurement:
        """Return what it reports of a true reading."""
        return _scaled(replace(true, t=true.t + self.late), self.gyro_scale)


def _scaled(reading: Measurement, scale: float) -> Measurement:
    """Return a reading with its rates of turn, if it has any, times a factor."""
    if not isinstance(reading, Imu) or scale == 1.0:
        return reading
    x, y, z = reading.angular_velocity
    return replace(reading, angular_velocity=(x * scale, y * scale, z * scale))


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
    """sensor_msgs/Image, or CompressedImage"""
    info: str
    """sensor_msgs/CameraInfo"""
    detectors: Detectors


@dataclass(frozen=True, slots=True)
class CloudSlice:
    """What of a cloud of points is taken for the scan of a planar lidar."""

    ring: Annotated[int, Bounds(0, 1023)] | None = None
    """The points with this number in their field "ring"; None: those of the band"""
    low: Annotated[float, Bounds(-10.0, 10.0, "m")] = -0.1
    """m above the lidar, in its frame,"""
    high: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.1

    def __post_init__(self) -> None:
        check(self)
        if self.high <= self.low:
            raise ValueError(f"high must be above low, and {self.high:g} m is not above {self.low:g} m")


@dataclass(frozen=True, slots=True)
class Car:
    """A car of which the speed of its motor and the position of its steering servo were recorded, in units of
    their own: the scales that its telemetry leaves out.

    The defaults are those of the F1TENTH car (f1tenth/f1tenth_system:f1tenth_stack/config)."""

    speed: str = "state.speed"
    """The field of the odometry's messages, of any type, that grows with its speed"""
    per_speed: Annotated[float, Bounds(-1e6, 1e6)] = 4614.0
    """By so much for 1 m/s forward: here electrical revolutions per minute"""
    steering: str = ""
    """Topic of its steering, of any type with a number; "": it drives straight on"""
    position: str = "data"
    """The field of those messages that is its steering's position"""
    middle: Annotated[float, Bounds(-1e3, 1e3)] = 0.5304
    """The position with which it drives straight on"""
    per_angle: Annotated[float, Bounds(-1e3, 1e3)] = -1.2135
    """Change of that for 1 rad to the left"""
    wheelbase: Annotated[float, Bounds(0.01, 10.0, "m")] = 0.25

    def __post_init__(self) -> None:
        check(self)
        if not (self.per_speed and self.per_angle):
            raise ValueError("per_speed and per_angle must not be 0")


@dataclass(frozen=True, slots=True)
class BagTopics:
    """The table [bag]: what the topics of a recording made elsewhere (a ROS bag, a log) are on this robot."""

    odometry: str = ""
    """What says how the base moved: nav_msgs/Odometry, geometry_msgs/TwistStamped, sensor_msgs/JointState
    (the body's motors are called as its joints), /tf, a log's odometry, or with `car` any type. "": nothing
    does, and the scans are matched one by one"""
    sensors: dict[str, str] = field(default_factory=dict)
    """Topic by sensor: sensor_msgs/Imu, LaserScan, MultiEchoLaserScan, PointCloud2, NavSatFix,
    geometry_msgs/PoseWithCovarianceStamped, or a log's scans."""
    truth: str = ""
    """A topic of poses or fixes: the reference for the estimated path; never an input. "": there is none"""
    cameras: dict[str, BagCamera] = field(default_factory=dict)
    """By sensor of this robot."""
    motion: Literal["auto", "twist", "pose"] = "auto"
    """What of nav_msgs/Odometry is taken as the motion of the base; "auto": its twists, if they are filled
    in."""
    base_frame: str = ""
    """The robot's frame in /tf, from which the sensors' places are read; "": the odometry's child frame"""
    odometry_frames: tuple[str, str] | None = None
    """Where /tf is the odometry: the fixed frame, and the robot's"""
    truth_frames: tuple[str, str] | None = None
    """Where /tf is the truth: the fixed frame, and the robot's"""
    mounts: dict[str, Mount] = field(default_factory=dict)
    """Where sensors are, in a file that has no [sensors]; those left out are looked up in /tf"""
    clouds: dict[str, CloudSlice] = field(default_factory=dict)
    """By sensor"""
    car: Car | None = None
    """Where odometry is the telemetry of a motor"""

    def parts(self) -> Iterator[tuple[str, str]]:
        """Yield each topic with the key that names it: "odometry", "sensors.imu", "cameras.eye.image" …"""
        if self.odometry:
            yield self.odometry, "odometry"
        if self.car is not None and self.car.steering:
            yield self.car.steering, "car.steering"
        yield from ((topic, f"sensors.{sensor}") for sensor, topic in self.sensors.items())
        for sensor, camera in self.cameras.items():
            yield camera.image, f"cameras.{sensor}.image"
            yield camera.info, f"cameras.{sensor}.info"
        if self.truth:
            yield self.truth, "truth"


@dataclass(frozen=True, slots=True)
class RosSettings:
    """The table [ros]: how the robot is called in ROS 2's graph (gateway.ros)."""

    node: str = ""
    """Of our node; "": the robot's name"""
    namespace: str = ""
    """Before every name that is not remapped, as "/left"; "": none"""
    domain: Annotated[int, Bounds(0, 232)] = 0
    """DDS domain; the environment's ROS_DOMAIN_ID wins"""
    remap: dict[str, str] = field(default_factory=dict)
    """Whole names by those of our table: { "/scan" = "/front/scan" }"""
    cmd_vel_timeout: Annotated[Duration, Bounds(50, 5000)] = 500 * MILLISECOND
    """How long a command that is repeated holds after its last message"""

    def __post_init__(self) -> None:
        check(self)
        if self.node and not NODE.fullmatch(self.node):
            raise Invalid(("node", f"node is {self.node!r}, expected letters, digits and _, no digit first"))
        if self.namespace and not TOPIC.fullmatch(self.namespace):
            raise Invalid(("namespace", f'namespace is {self.namespace!r}, expected a name as "/left"'))
        if wrong := next((name for name in self.remap.values() if not TOPIC.fullmatch(name)), ""):
            raise Invalid(("remap", f'remap: {wrong!r} is no name of a topic, expected one as "/front/scan"'))


NODE = re.compile("[A-Za-z_][A-Za-z0-9_]{0,99}")
TOPIC = re.compile("(/[A-Za-z_][A-Za-z0-9_]{0,99}){1,16}")


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
    ros: RosSettings = field(default_factory=RosSettings)
    """How it is called in ROS 2's graph."""
    description: str = ""
    """The text of its URDF; "" if it has none."""
    described: Mapping[str, str] = field(default_factory=dict)
    """By motor: the joint of the URDF that it moves."""
    folder: str = ""
    """The path of the folder with its URDF, from which its meshes' names count; "": not known, as of a
    recording."""
    real: tuple[str, ...] = ()
    """The devices that are named as real, while all others are simulated; (): as the interfaces say."""

    @property
    def recorded(self) -> bool:
        """Whether it is known from recordings alone: it has no bus, and cannot be run."""
        return not self.buses

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
