"""One bus, motor or sensor of the robot file → its object, or None with its mistakes added.

Rules. Every part of a section is checked, whatever is wrong with the others: its place on a bus, the options
and settings of its protocol, the settings of its joint or its mounting.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias

from brain.perception.mount import Mount
from gateway.config.errors import Key, Mistakes, shown, unknown
from gateway.config.schema import build
from gateway.core.joint import JointSettings
from gateway.core.limits import Limits
from gateway.core.robot import (
    ADAPTERS,
    CLASSIC_ADAPTERS,
    LATENCY,
    TRANSMIT_QUEUE,
    TWIN,
    USB_NAME,
    BusSettings,
    Motor,
    Sensor,
)
from gateway.vision.live import LiveCamera
from protocols.bounds import Bounds, Duration, keys
from protocols.frames import OF_BYTES, IdMask
from protocols.messages import MILLISECOND, SECOND
from protocols.plugin import Device, Plugin, Spec, UnknownProtocol

Find: TypeAlias = Callable[[str], Plugin]
"""A protocol by its name; raises UnknownProtocol."""
Table: TypeAlias = dict[str, Any]


@dataclass(frozen=True, slots=True)
class BusKeys:
    """The keys of a bus."""

    kind: Literal["can", "canfd", "serial", "i2c", "camera"]
    """What kind of wire"""
    interface: str
    """INTERFACE:CHANNEL, such as "socketcan:can0" or "serial:/dev/ttyUSB0"; "twin": the world as a bus"""
    bitrate: Annotated[int, Bounds(5_000, 1_000_000)] = 0
    """bit/s of a CAN bus; of CAN FD, of its arbitration; of I²C"""
    data_bitrate: Annotated[int, Bounds(5_000, 20_000_000)] = 0
    """bit/s of the data of CAN FD"""
    baudrate: Annotated[int, Bounds(300, 50_000_000)] = 0
    """bit/s of a serial line"""
    receive_filter: Literal["all", "own"] = "all"
    """"own": only what our devices send or are sent, and what their drivers decode of others"""
    transmit_queue: Annotated[int, Bounds(1, 10_000)] = TRANSMIT_QUEUE
    """CAN frames that may wait, here and in the kernel"""
    shared_bus: Literal["unknown", "acknowledged"] = "unknown"
    """Whether the consequences of several protocols on one bus are known (gateway.config.validate)."""
    echo: Literal["auto", "yes", "no"] = "auto"
    """Whether what is sent on a serial line comes back"""
    rs485: Literal["off", "rts_high", "rts_low"] = "off"
    """The kernel switches the direction by RTS: its level while sending"""
    dtr: Literal["on", "off"] = "on"
    """Its level while the port is open"""
    latency: Annotated[Duration, Bounds(0, 100)] = LATENCY
    """What port and machine take both ways: an answer is waited for so much longer"""
    camera: LiveCamera | None = None
    """Of a camera: its pictures, and what is looked for in them"""
    turnaround: Annotated[Duration, Bounds(0, 20)] = 0
    """From the end of an answer to the next frame: a device must have let go of the wire"""


@dataclass(frozen=True, slots=True)
class ConnectionKeys:
    """The keys that a motor and a sensor share."""

    protocol: str
    """A name of `gateway protocols`"""
    bus: str
    """The NAME of a table [buses.NAME]"""
    address: Annotated[int, Bounds(0, 2**32 - 1)]
    """The device's id on its bus, as its protocol numbers them"""
    options: dict[str, Any] = field(default_factory=dict)
    """What the driver should do: the protocol's own"""
    settings: dict[str, Any] = field(default_factory=dict)
    """What is configured on the device: the protocol's own, for its twin and `gateway motor diff`"""
    real: bool = False
    """It is there, while every device that is not real is simulated"""


@dataclass(frozen=True, slots=True)
class SensorKeys:
    """The further keys of a sensor."""

    mount: Mount = field(default_factory=Mount)
    """Where it is on the robot"""
    timeout: Annotated[Duration, Bounds(1, 5000)] = 500 * MILLISECOND
    """Age at which its readings count as lost"""
    late: Annotated[Duration, Bounds(0, 500)] = 0
    """By so much its readings are stamped later than they were made; `gateway calibrate base` measures it"""
    gyro_scale: Annotated[float, Bounds(0.5, 2.0)] = 1.0
    """What its gyro reads for each rad/s; `gateway calibrate base` measures it"""


_STAND_IN = JointSettings(
    Limits(1.0, 1.0, 1.0), command_timeout=3600 * SECOND, feedback_timeout=3600 * SECOND
)
"""Instead of invalid settings of a joint, so that its device is still checked against the others."""
_RATES = {
    "can": ("bitrate",),
    "canfd": ("bitrate", "data_bitrate"),
    "serial": ("baudrate",),
    "i2c": ("bitrate",),
    "camera": (),
}


_NAMED = {"serial": "a serial bus", "i2c": "an I²C bus", "camera": "a camera"}
USB: int = 480_000_000
"""bit/s of a camera's USB 2.0: in the world, what it saw takes no time on it"""


def read_bus(name: str, table: Table, mistakes: Mistakes) -> BusSettings | None:
    """Read one bus; its devices, and its receive filter (`own_ids`), are added later."""
    at = ("buses", name)
    made = build(BusKeys, table, at, mistakes)
    kind, interface = table.get("kind"), table.get("interface")
    if not isinstance(kind, str) or kind not in _RATES:
        return None
    for rate in ("bitrate", "data_bitrate", "baudrate"):
        if rate in _RATES[kind] and rate not in table:
            mistakes.add((*at, rate), "missing; expected an integer: bits per second")
        elif rate not in _RATES[kind] and rate in table:
            wanted = " and ".join(_RATES[kind]) or "none"
            mistakes.add((*at, rate), f"a bus of kind {kind!r} has no {rate}; expected {wanted}")
    if isinstance(interface, str):
        check_interface(interface, kind, at, mistakes)
    if made is None:
        return None
    if made.kind == "canfd" and 0 < made.data_bitrate < made.bitrate:
        text = f"found {made.data_bitrate}, expected at least the bitrate of {made.bitrate}"
        mistakes.add((*at, "data_bitrate"), text)
    if made.receive_filter == "own" and kind in OF_BYTES:
        text = f"{_NAMED[kind]} has no ids to filter; expected no key 'receive_filter'"
        mistakes.add((*at, "receive_filter"), text)
    if "transmit_queue" in table and kind in OF_BYTES:
        text = f"{_NAMED[kind]} has no queue of CAN frames; expected no key 'transmit_queue'"
        mistakes.add((*at, "transmit_queue"), text)
    for key in ("echo", "rs485", "dtr", "latency_ms", "turnaround_ms") if kind != "serial" else ():
        if key in table:
            mistakes.add((*at, key), f"a bus of kind {kind!r} is no serial line; expected no key {key!r}")
    if made.camera is not None and kind != "camera":
        mistakes.add((*at, "camera"), f"a bus of kind {kind!r} is no camera; expected no key 'camera'")
    if made.camera is None and kind == "camera" and made.interface != TWIN:
        text = "missing; expected a table: what its pictures are like, and what is looked for (detectors)"
        mistakes.add((*at, "camera"), text)
    own_rate = {"i2c": made.bitrate, "camera": USB}
    rates = made.bitrate, made.data_bitrate, own_rate.get(made.kind, made.baudrate)
    acknowledged = made.shared_bus == "acknowledged"
    return BusSettings(
        name,
        made.kind,
        made.interface,
        *rates,
        transmit_queue=made.transmit_queue,
        acknowledged=acknowledged,
        echo=made.echo,
        rs485=made.rs485,
        dtr=made.dtr,
        latency=made.latency,
        turnaround=made.turnaround,
        camera=made.camera,
    )


def own_ids(specs: Collection[Spec]) -> tuple[IdMask, ...]:
    """Return the receive filter "own": what the devices of a bus send, what their drivers understand of
    others, and what another host would send to them. Empty if nothing is expected: then everything is
    received."""
    if not any(spec.expects or spec.receives_also for spec in specs):
        return ()
    return tuple(sorted({ids for spec in specs for ids in (*spec.expects, *spec.receives_also, *spec.sends)}))


_EXAMPLES = {"serial": "serial:/dev/ttyUSB0", "i2c": "i2c:/dev/i2c-1", "camera": "camera:/dev/video0"}


def check_interface(interface: str, kind: str, at: Key, mistakes: Mistakes) -> None:
    """Check that it is "twin", or INTERFACE:CHANNEL with an interface that fits the kind of bus."""
    if interface == TWIN:
        return
    driver, colon, channel = interface.partition(":")
    example = _EXAMPLES.get(kind, "socketcan:can0")
    if not (driver and colon and channel):
        wanted = f'expected "{TWIN}" or INTERFACE:CHANNEL, such as "{example}"'
        mistakes.add((*at, "interface"), f"found {shown(interface)}, {wanted}")
    elif driver in ADAPTERS:
        mistakes.add((*at, "interface"), f"found {shown(interface)}, expected {ADAPTERS[driver]}")
    elif kind == "serial" and driver != "serial":
        mistakes.add((*at, "interface"), f'found {shown(interface)}, expected "serial:PORT" on a serial bus')
    elif kind in _EXAMPLES and driver != kind:
        wanted = f'expected "{kind}:PATH", such as "{example}"'
        mistakes.add((*at, "interface"), f"found {shown(interface)}, {wanted}")
    elif channel.startswith("usb-") and not USB_NAME.fullmatch(channel.partition("@")[0]):
        wanted = "usb-VENDOR:PRODUCT:SERIAL, such as usb-0483:5740:3A5F, and of several channels /0, /1 …"
        mistakes.add((*at, "interface"), f"found {shown(interface)}, expected {wanted}")
    elif kind == "canfd" and driver in CLASSIC_ADAPTERS:
        text = f"found {shown(interface)}, which carries classic CAN only; expected a bus of kind 'can'"
        mistakes.add((*at, "interface"), text)


def read_motor(
    name: str, table: Table, buses: Mapping[str, BusSettings | None], find: Find, mistakes: Mistakes
) -> Motor | None:
    """Read one motor; `buses` are those of the file."""
    at = ("motors", name)
    gear = () if "gear" in table else (f"gear = {_STAND_IN.gear:g}",)
    connected = _connected(at, table, buses, find, "motor", mistakes, gear)
    joint = build(JointSettings, table, at, mistakes, also=tuple(keys(ConnectionKeys)))
    return Motor(name, *connected, joint or _STAND_IN) if connected else None


def read_sensor(
    name: str, table: Table, buses: Mapping[str, BusSettings | None], find: Find, mistakes: Mistakes
) -> Sensor | None:
    """Read one sensor; `buses` are those of the file."""
    at = ("sensors", name)
    connected = _connected(at, table, buses, find, "sensor", mistakes)
    mounting = build(SensorKeys, table, at, mistakes, also=tuple(keys(ConnectionKeys))) or SensorKeys()
    if connected is None:
        return None
    made = Sensor(name, *connected, mounting.mount, mounting.timeout, mounting.late, mounting.gyro_scale)
    if "gyro_scale" in table and "Imu.angular_velocity" not in made.spec.ranges:
        what = f"{made.plugin.name!r} measures no rate of turn here"
        mistakes.add((*at, "gyro_scale"), f"{what}; expected no key 'gyro_scale'")
    return made


def _connected(
    at: Key,
    table: Table,
    buses: Mapping[str, BusSettings | None],
    find: Find,
    kind: Literal["motor", "sensor"],
    mistakes: Mistakes,
    assumed: tuple[str, ...] = (),
) -> tuple[str, Plugin, Device, Spec, tuple[str, ...]] | None:
    """Read what a motor and a sensor share: bus, protocol, device with options and settings, spec, and the
    scales that are assumed, beside those given."""
    own = {key: value for key, value in table.items() if key in keys(ConnectionKeys)}
    connection = build(ConnectionKeys, own, at, mistakes)
    name, bus = table.get("protocol"), table.get("bus")
    if isinstance(bus, str) and bus not in buses:
        mistakes.add((*at, "bus"), unknown("bus", bus, buses))
    if not isinstance(name, str):
        return None
    try:
        protocol = find(name)
    except UnknownProtocol as error:
        mistakes.add((*at, "protocol"), str(error))
        return None
    options: object = build(protocol.options, table.get("options", {}), (*at, "options"), mistakes)
    settings: object = build(protocol.settings, table.get("settings", {}), (*at, "settings"), mistakes)
    if connection is None or options is None or settings is None:
        return None
    line = buses.get(bus) if isinstance(bus, str) else None
    line_rate = line.baudrate if line else 0
    device = Device(at[-1], connection.address, options, settings, line_rate)
    try:
        spec = protocol.spec(device)
    except ValueError as error:
        mistakes.invalid(at, error)
        return None
    except Exception as error:  # noqa: BLE001 -- a third party's spec may raise anything
        text = f"protocol {name!r} is broken: its spec raises {type(error).__name__}: {error}"
        mistakes.add((*at, "protocol"), text)
        return None
    if spec.kind != kind:
        mistakes.add((*at, "protocol"), f"{name!r} is the protocol of a {spec.kind} here, expected a {kind}")
        return None
    untold = [name for name, known_by in spec.scales.items() if not (known_by or name in connection.options)]
    assumed += tuple(f"options.{name} = {shown(getattr(options, name))}" for name in untold)
    return connection.bus, protocol, device, spec, assumed
