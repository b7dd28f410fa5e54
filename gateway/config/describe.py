"""A robot in words, for `gateway check`: what was understood of its file, and what to be careful about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from math import inf

from gateway.config.validate import cautions
from gateway.core.robot import BusSettings, Motor, Robot, Sensor
from protocols.messages import MILLISECOND, SECOND
from protocols.plugin import FeedbackKind

FRAME_BITS = 125
"""Of a classic CAN frame with 8 data bytes and an 11-bit id: 111 with its gap, and some stuffing."""
FD_BITS = 32, 100
"""Of such a frame of CAN FD, with its bit rate switched: at the bus's bit rate, and at that of its data."""


def describe(robot: Robot) -> str:
    """Buses, motors, sensors and brain as tables, and every caution."""
    world = f"world {robot.world}, seed {robot.seed}" if robot.world else "no world"
    blocks = [
        f"{robot.name}: {SECOND / robot.period:g} steps per second, {world}",
        _table(
            "bus", "kind", "rate", "interface", "load", rows=[_bus(robot, b) for b in robot.buses.values()]
        ),
        _table("motor", *_MOTOR_HEADS, rows=[_motor(m) for m in robot.motors.values()]),
        _table("limits", *_LIMIT_HEADS, rows=[_limits(m) for m in robot.motors.values()]),
    ]
    if robot.sensors:
        blocks.append(_table("sensor", *_SENSOR_HEADS, rows=[_sensor(s) for s in robot.sensors.values()]))
    blocks.append(_brain(robot))
    if robot.bag is not None:
        blocks.append(_table("bag", "topic", rows=[[part, topic] for topic, part in robot.bag.parts()]))
    reported = cautions(robot)
    blocks.append(
        "\n".join(["be careful:", *(f"  {text}" for text in reported)]) if reported else "no cautions"
    )
    return "\n\n".join(blocks)


_MOTOR_HEADS = ("protocol", "bus", "address", "ids sent", "ids expected", "reports", "device's watchdog")
_LIMIT_HEADS = (
    "velocity",
    "acceleration",
    "torque",
    "position",
    "gear",
    "sign",
    "on command timeout",
    "stop action",
    "on fault",
)
_SENSOR_HEADS = ("protocol", "bus", "address", "mounted at", "yaw", "too old after")


def _bus(robot: Robot, bus: BusSettings) -> list[str]:
    rate = f"{bus.baudrate or bus.bitrate} bit/s"
    if bus.data_bitrate:
        rate += f", data {bus.data_bitrate} bit/s"
    return [bus.name, bus.kind, rate, bus.interface, _load(robot, bus)]


def _load(robot: Robot, bus: BusSettings) -> str:
    """The least that a CAN bus carries: a command per step and a report per period, per motor."""
    if bus.kind == "serial":
        return "-"
    busy = 0.0
    for motor in robot.motors.values():
        if motor.bus == bus.name:
            reported = motor.spec.feedback is not FeedbackKind.NONE and motor.spec.feedback_period > 0
            frames = SECOND / robot.period + (SECOND / motor.spec.feedback_period if reported else 0)
            busy += frames * _least_time(bus, fd=motor.spec.bus == "canfd")
    return f"at least {100 * busy:.0f} %"


def _least_time(bus: BusSettings, *, fd: bool) -> float:
    """Seconds of a frame of 8 bytes."""
    if not fd:
        return FRAME_BITS / bus.bitrate
    slow, fast = FD_BITS
    return slow / bus.bitrate + fast / (bus.data_bitrate or bus.bitrate)


def _motor(motor: Motor) -> list[str]:
    spec, watchdog = motor.spec, motor.spec.watchdog
    if watchdog.timeout is None:
        guard = "none"
    else:
        guard = f"{watchdog.timeout / MILLISECOND:g} ms" if watchdog.enabled else "off"
    reported = spec.feedback is not FeedbackKind.NONE
    reports = f"{spec.feedback}, {spec.feedback_period / MILLISECOND:g} ms" if reported else "nothing"
    return [*_wiring(motor), _ids(spec.sends), _ids(spec.expects), reports, guard]


def _limits(motor: Motor) -> list[str]:
    joint, limits = motor.joint, motor.joint.limits
    low, high = limits.position or (-inf, inf)
    return [
        motor.name,
        f"{limits.velocity:g} rad/s",
        f"{limits.acceleration:g} rad/s²",
        f"{limits.torque:g} N·m",
        f"{low:g} to {high:g} rad" if limits.position else "free",
        f"{joint.gear:g}",
        f"{joint.sign:+d}",
        f"{joint.on_command_timeout} after {joint.command_timeout / MILLISECOND:g} ms",
        joint.stop_action,
        f"{joint.on_fault} after {joint.feedback_timeout / MILLISECOND:g} ms",
    ]


def _sensor(sensor: Sensor) -> list[str]:
    mount = sensor.mount
    place = f"{mount.x:g}, {mount.y:g}, {mount.z:g} m"
    turned = f"{mount.yaw:g} rad"
    if mount.pitch or mount.roll:
        turned += f", pitch {mount.pitch:g}, roll {mount.roll:g}"
    return [*_wiring(sensor), place, turned, f"{sensor.timeout / MILLISECOND:g} ms"]


def _wiring(part: Motor | Sensor) -> list[str]:
    return [part.name, part.plugin.name, part.bus, str(part.device.address)]


def _ids(ids: frozenset[int]) -> str:
    if not ids:
        return "-"
    low, high = min(ids), max(ids)
    return f"0x{low:X}" if low == high else f"{len(ids)} of 0x{low:X}…0x{high:X}"


def _brain(robot: Robot) -> str:
    body = robot.brain.differential if robot.brain.body == "differential" else robot.brain.joints
    named = [(field.name, getattr(body, field.name)) for field in fields(body)] if body else []
    rows = [f"  {name} = {_value(value)}" for name, value in named if value is not None]
    return "\n".join([f"body: {robot.brain.body}", *rows])


def _value(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _table(*heads: str, rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) for row in (heads, *rows)]
    return "\n".join(line.rstrip() for line in lines)
