"""A robot as text, for `gateway check`: what its file says, and its cautions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from math import inf
from textwrap import fill

from brain.bodies.limbs import BodyAsLimb, LimbPlace, limbs
from gateway.config.validate import cautions
from gateway.core.robot import TWIN, BusDevice, BusSettings, Motor, Robot, Sensor
from protocols.frames import IdMask
from protocols.messages import MILLISECOND, SECOND
from protocols.plugin import FeedbackKind

ALL_NUMBERS = 0x1FFF_FFFF
"""The bits of an id without that of its format."""
FRAME_BITS = 125
"""Bits of a classic CAN frame with 8 data bytes and an 11-bit id: 111 with its gap, and some stuffing."""
FD_BITS = 32, 100
"""Bits of such a frame of CAN FD with bit rate switching: at the bus's bit rate, and at that of its data."""

STOOD_IN = "what its file leaves out of the body is stood in for, and cancels"
WIDTH = 120
"""Columns in which a caution is wrapped."""
IF_IT_DIES = "what stops it if the gateway dies or hangs"


def describe(robot: Robot) -> str:
    """Describe a robot in words, as `gateway check` prints it.

    Args:
        robot: what `load_robot` returned.

    Returns:
        str: buses, motors, sensors and brain as tables, what stops its motors if we die, and every caution.
    """
    world = f"world {robot.world}, seed {robot.seed}" if robot.world else "no world"
    blocks = [
        f"{robot.name}: {SECOND / robot.period:g} steps per second, {world}",
        _table(
            "bus", "kind", "rate", "interface", "load", rows=[_bus(robot, b) for b in robot.buses.values()]
        ),
        _table("motor", *_MOTOR_HEADS, rows=[_motor(m) for m in robot.motors.values()]),
        _table("limits", *_LIMIT_HEADS, rows=[_limits(m) for m in robot.motors.values()]),
    ]
    if robot.recorded:
        blocks = [f"{robot.name}: how a recording is read; it has no bus, and cannot be run", STOOD_IN]
    if robot.sensors:
        blocks.append(_table("sensor", *_SENSOR_HEADS, rows=[_sensor(s) for s in robot.sensors.values()]))
    blocks.append(_brain(robot))
    if robot.bag is not None:
        blocks.append(_table("bag", "topic", rows=[[name, topic] for topic, name in robot.bag.parts()]))
    if robot.motors:
        stopped = [[name, _stopped_by(robot, motor)] for name, motor in robot.motors.items()]
        blocks.append(_table("motor", IF_IT_DIES, rows=stopped))
    notes = cautions(robot)
    wrapped = [fill(note, WIDTH, initial_indent="  ", subsequent_indent="    ") for note in notes]
    blocks.append("\n".join(["cautions:", *wrapped]) if notes else "no cautions")
    return "\n\n".join(blocks)


def if_it_dies(robot: Robot) -> list[str]:
    """Return what stops the motors of a robot if its gateway dies or hangs, a line each for those alike."""
    alike: dict[str, list[str]] = {}
    for name, motor in robot.motors.items():
        alike.setdefault(_stopped_by(robot, motor), []).append(name)
    return [f"{', '.join(names)}: {what}" for what, names in alike.items()]


def _stopped_by(robot: Robot, motor: Motor) -> str:
    bus, watchdog = robot.buses[motor.bus], motor.spec.watchdog
    means = []
    if watchdog.enabled and watchdog.timeout is not None:
        means.append(f"its own watchdog after {watchdog.timeout / MILLISECOND:g} ms")
    if bus.shareable:
        limit = f"{robot.stall_timeout / MILLISECOND:g} ms"
        means.append(f"the watchdog process at once, or after {limit} if it hangs")
    if means:
        return "; ".join(means)
    if bus.interface == TWIN:
        return "NOTHING, unless its bus can be shared (socketcan): its own watchdog is off"
    return f"NOTHING: its own watchdog is off, and {bus.interface} cannot be shared"


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
_SENSOR_HEADS = ("protocol", "bus", "address", "mounted at", "yaw", "timeout")


def _bus(robot: Robot, bus: BusSettings) -> list[str]:
    rate = f"{bus.baudrate or bus.bitrate} bit/s"
    if bus.data_bitrate:
        rate += f", data {bus.data_bitrate} bit/s"
    return [bus.name, bus.kind, rate, bus.interface, _load(robot, bus)]


def _load(robot: Robot, bus: BusSettings) -> str:
    """Return the least load of a CAN bus: a command per step and a report per period, per motor."""
    if bus.carries_bytes:
        return "-"
    slow, fast = FD_BITS
    seconds = {
        "can": FRAME_BITS / bus.bitrate,
        "canfd": slow / bus.bitrate + fast / (bus.data_bitrate or bus.bitrate),
    }
    busy = 0.0
    for spec in (motor.spec for motor in robot.motors.values() if motor.bus == bus.name):
        reports = spec.feedback is not FeedbackKind.NONE and spec.feedback_period > 0
        frames = SECOND / robot.period + (SECOND / spec.feedback_period if reports else 0)
        busy += frames * seconds[spec.bus]
    return f"at least {100 * busy:.0f} %"


def _motor(motor: Motor) -> list[str]:
    spec, watchdog = motor.spec, motor.spec.watchdog
    timeout = "none"
    if watchdog.timeout is not None:
        timeout = f"{watchdog.timeout / MILLISECOND:g} ms" if watchdog.enabled else "off"
    reports = f"{spec.feedback}, {spec.feedback_period / MILLISECOND:g} ms"
    if spec.feedback is FeedbackKind.NONE:
        reports = "nothing"
    return [*_connection(motor), _ids(spec.sends), _ids(spec.expects), reports, timeout]


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
    return [*_connection(sensor), place, turned, f"{sensor.timeout / MILLISECOND:g} ms"]


def _connection(device: BusDevice) -> list[str]:
    return [device.name, device.plugin.name, device.bus, str(device.device.address)]


def _ids(ids: Sequence[IdMask]) -> str:
    """Return the ids from the lowest to the highest, and their number; of 11 bits, if the format is open."""
    if not ids:
        return "-"
    low = min(number & ALL_NUMBERS for number, _ in ids)
    high = max((number | _open(number, mask)) & ALL_NUMBERS for number, mask in ids)
    count = sum(1 << _open(number, mask).bit_count() for number, mask in ids)
    return f"0x{low:X}" if low == high else f"{count} of 0x{low:X}…0x{high:X}"


def _open(number: int, mask: int) -> int:
    """Return the bits of an id that its mask leaves open."""
    most = 0x7FF if number <= 0x7FF else ALL_NUMBERS
    return most & ~mask


def _brain(robot: Robot) -> str:
    parts = limbs(robot.brain.body)
    heads = {name: f"limb {name}" if len(parts) > 1 else "body" for name in parts}
    lines = [f"limbs: {', '.join(parts)}"] if len(parts) > 1 else []
    if (other := robot.brain.other) is not None:
        lines.append(f"commands by the brain {other.kind.name!r} of {other.maker}: {other.settings}")
    if (saved := robot.brain.saved) is not None:
        lines += [f"begins in a map of {saved.text}", *filter(None, [saved.remark])]
    return "\n".join([*lines, *(line for name, limb in parts.items() for line in _limb(heads[name], limb))])


def _limb(head: str, limb: BodyAsLimb) -> list[str]:
    body, at = limb.body, limb.at
    lines = [f"{head}: {body.kind}"]
    if limb.mounted_on:
        lines.append(f"  on {limb.mounted_on}")
    if at != LimbPlace():
        lines.append(f"  at {at.x:g}, {at.y:g}, {at.z:g} m, yaw {at.yaw:g} rad")
    for field in fields(body):
        value = getattr(body, field.name)
        if isinstance(value, dict):
            lines += [f"  {field.name}.{key} = {one}" for key, one in value.items() if one != key]
        elif value is not None:
            text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
            own = "\n" in text  # a text of its own: a URDF
            lines.append(f"  {field.name} = {f'{len(text.splitlines())} lines' if own else text}")
    return lines


def _table(*heads: str, rows: Sequence[Sequence[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) for row in (heads, *rows)]
    return "\n".join(line.rstrip() for line in lines)
