"""Slamtec's lidars RPLIDAR A1, A2, A3, S and C on a serial line (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.messages import SECOND
from protocols.plugin import Device, FeedbackKind, Plugin, Range, Spec, Written
from protocols.rplidar import table
from protocols.rplidar.driver import RplidarAdapter
from protocols.rplidar.options import MODELS, Options, Settings
from protocols.rplidar.twin import RplidarDecoder, RplidarTwin
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor
from protocols.toolkit.serial import messages_in

__all__ = ["plugin"]

PERIOD = SECOND
"""Of the slowest turn"""


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the names of the requests in a frame; else those of what a lidar tells without a checksum."""
    if not isinstance(frame, bytes):
        return ()
    found, whole = messages_in(table.REQUESTS, frame)
    if found and whole:
        return tuple(table.NAMES[each[0]] for each in found)
    if len(frame) >= table.HEAD and table.answer_size(frame[: table.HEAD]) == len(frame):
        return (table.ANSWERS[frame[6]][0] if frame[6] in table.ANSWERS else "descriptor",)
    nodes = range(0, len(frame) - table.NODE_BYTES + 1, table.NODE_BYTES)
    if len(nodes) * table.NODE_BYTES == len(frame) and all(table.is_node(frame, at) for at in nodes):
        return ("node",) * len(nodes)
    return ()


UNPROTECTED = frozenset(
    {
        *(name for code, name in table.NAMES.items() if not code & 0x80),
        *(name for name, _ in table.ANSWERS.values()),
        "descriptor",
        "node",
    }
)


def read_only(frame: Frame) -> bool:
    """True if a frame consists of requests that only ask."""
    found, whole = messages_in(table.REQUESTS, frame)
    return whole and bool(found) and all(table.NAMES[each[0]].startswith(table.READS) for each in found)


def _set_up(options: Options) -> Written:
    if not options.start:
        return {}
    scan: Written = (
        {"SCAN": (1.0,)} if options.scan == "standard" else {"EXPRESS_SCAN": (float(options.mode),)}
    )
    return {**scan, "SET_MOTOR_PWM": (float(options.pwm), 0.0)} if options.motor == "pwm" else scan


def spec(device: Device) -> Spec:
    """Return the contract of a lidar. Raises ValueError for an address or a line that it cannot have."""
    options: Options = device.options
    rate = MODELS[options.model].baudrate
    if device.line_rate not in (0, rate):
        text = f"{device.name}: {options.model} has {rate} baud, not {device.line_rate}"
        raise Invalid(("bus", text))
    common = {"read_only": read_only, "unprotected": UNPROTECTED, "scales": {"model": "it tells its number"}}
    if not options.start:
        text = "it is sent nothing, so it does not scan: start = true has it do so"
        return serial_sensor(device, {}, PERIOD, feedback=FeedbackKind.NONE, caution=text, **common)
    ranges = {"LaserScan.ranges": Range(0.0, options.farthest, 0.001)}
    return serial_sensor(device, ranges, PERIOD, faults=table.FAULTS, set_up=_set_up(options), **common)


plugin = Plugin(
    name=table.NAME,
    title="Slamtec lidars RPLIDAR A1, A2, A3, S1 to S3, C1 by UART: asked, then a scan of each turn",
    trust="bytes both ways: rplidar-roboticia 0.9.5, pyrplidar 0.1.2, Slamtec/rplidar_sdk@99478e5. None met",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(RplidarAdapter, spec),
    decoder=RplidarDecoder,
    twin=RplidarTwin,
    messages=messages,
    vectors=("protocols.rplidar", "vectors.json"),
)
