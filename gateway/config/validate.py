"""What must hold between the parts of a robot file, each right by itself; and what a person must be told.

Rules. Each check tells its own mistakes and leaves the others to the rest; parts that were wrong by
themselves are not among those given.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Literal

from brain.settings import BrainSettings
from gateway.config.errors import Key, Mistakes, shown, unknown
from gateway.config.schema import positive
from gateway.config.sharing import Part, clash, mixed
from gateway.core.robot import BagTopics, BusSettings, Motor, Robot, Sensor
from protocols.messages import MILLISECOND, Nanos, Velocity
from protocols.plugin import FeedbackKind

_CARRIES = {"can": ("can", "canfd"), "canfd": ("canfd",), "serial": ("serial",)}
"""Which kinds of bus carry a device's wires: a classic CAN device may stand on a CAN FD bus."""


def check_limits(limits: object, at: Key, mistakes: Mistakes) -> None:
    """Every limit of a joint is greater than zero, and the lowest position is below the highest."""
    positive(limits, at, ("velocity", "acceleration", "torque"), mistakes)
    position = limits.get("position") if isinstance(limits, Mapping) else None
    match position:
        case [int() | float() as low, int() | float() as high] if low >= high:
            mistakes.add((*at, "position"), f"found [{low}, {high}], expected the lowest first")


def check_devices(
    buses: Mapping[str, BusSettings],
    motors: Mapping[str, Motor],
    sensors: Mapping[str, Sensor],
    period: Nanos,
    mistakes: Mistakes,
) -> None:
    """Devices against their buses, against each other, and a joint's settings against its device."""
    parts: list[tuple[Key, Part]] = [
        *((("motors", name), motor) for name, motor in motors.items()),
        *((("sensors", name), sensor) for name, sensor in sensors.items()),
    ]
    for at, part in parts:
        bus = buses.get(part.bus)
        if bus and bus.kind not in _CARRIES[part.spec.bus]:
            kinds = " or ".join(_CARRIES[part.spec.bus])
            said = f"{part.plugin.name} needs a bus of kind {kinds}, and {bus.name!r} is {bus.kind}"
            mistakes.add((*at, "bus"), said)
    for (_, first), (at, second) in combinations(parts, 2):
        if first.bus == second.bus:
            _check_pair(first, at, second, mistakes)
    _check_together([part for _, part in parts], mistakes)
    for name, motor in motors.items():
        _check_motor(("motors", name), motor, period, mistakes)


def _check_together(parts: Sequence[Part], mistakes: Mistakes) -> None:
    """What one driver says of its devices on a bus together: options that are the bus's own must agree."""
    groups: dict[tuple[str, str], list[Part]] = {}
    for part in parts:
        groups.setdefault((part.bus, part.plugin.name), []).append(part)
    for (bus, language), group in groups.items():
        devices = [part.device for part in group]
        if len({device.address for device in devices}) < len(devices):
            continue  # told already, one by one
        try:
            group[0].plugin.driver(devices)
        except Exception as error:  # noqa: BLE001 -- a third party's driver may raise anything
            kind = (
                ""
                if isinstance(error, ValueError)
                else f" is broken: its driver raises {type(error).__name__}"
            )
            mistakes.add(("buses", bus), f"{language}{kind}: {error}")


def _check_pair(first: Part, at: Key, second: Part, mistakes: Mistakes) -> None:
    """Two devices on one bus do not answer to the same address, nor use each other's ids."""
    if first.plugin.name == second.plugin.name:
        if first.device.address == second.device.address:
            said = f"{first.name!r} has address {first.device.address} on bus {first.bus!r} too"
            mistakes.add((*at, "address"), f"{said}; expected an address of its own")
        return
    if said := clash(first, second):
        remedy = "expected another address or bus, or an option that moves its ids"
        mistakes.add((*at, "address"), f"{said}; {remedy}")


def _check_motor(at: Key, motor: Motor, period: Nanos, mistakes: Mistakes) -> None:
    joint, spec = motor.joint, motor.spec
    if joint.stop_action == "hold" and not spec.holds_unattended:  # a silent brain's Hold is fed by the joint
        why = "with nobody feeding it, the device lets go of its load (its watchdog)"
        mistakes.add((*at, "stop_action"), f'found "hold", expected "idle": {why}')
    if joint.stop_action == "brake" and Velocity not in spec.commands:
        mistakes.add(
            (*at, "stop_action"), 'found "brake", expected "idle": the device takes no velocity to brake by'
        )
    if spec.feedback is not FeedbackKind.NONE:
        reports = ("the device reports", spec.feedback_period)
        _check_longer((*at, "feedback_timeout_ms"), joint.feedback_timeout, reports, mistakes)
    _check_longer((*at, "command_timeout_ms"), joint.command_timeout, ("the robot steps", period), mistakes)


def _check_longer(at: Key, timeout: Nanos, cycle: tuple[str, Nanos], mistakes: Mistakes) -> None:
    """A timeout is longer than the cycle of what it waits for."""
    what, period = cycle
    if 0 < timeout <= period:
        every = f"{what} every {period / MILLISECOND:g} ms"
        mistakes.add(at, f"found {timeout / MILLISECOND:g} ms, but {every}; expected more than that")


_MOTORS = {"differential": ("left", "right"), "joints": ("motors",)}
"""Where a body's table names its motors."""


def check_brain(brain: object, motors: Sequence[str], sensors: Sequence[str], mistakes: Mistakes) -> None:
    """The body's own table is there, and the motors that it names too. `brain` is as in the file."""
    if not isinstance(brain, Mapping):
        return
    body = brain.get("body", BrainSettings().body)
    if not isinstance(body, str) or body not in _MOTORS:
        return
    table = brain.get(body)
    if table is None:
        mistakes.add(("brain", body), f"missing; the body {body!r} expects this table")
    if not isinstance(table, Mapping):
        return
    for key in _MOTORS[body]:
        key_path, found = ("brain", body, key), table.get(key, [])
        for name in found if isinstance(found, list) else [found]:
            if isinstance(name, str) and name not in motors:
                said = f"{name!r} is a sensor; there is " + ", ".join(motors)
                mistakes.add(key_path, said if name in sensors else unknown("motor", name, motors))


def cautions(robot: Robot) -> list[str]:
    """What a person must be told at every start, until the robot file acknowledges it."""
    parts: list[Part] = [*robot.motors.values(), *robot.sensors.values()]
    reported = [f"{part.name}: {part.spec.watchdog.note}" for part in parts if part.spec.watchdog.note]
    for motor in robot.motors.values():
        reported.extend(_beyond(motor))
    return reported + mixed(robot.buses, parts) + _too_fast(robot) + _always_late(robot) + _unused(robot)


def _too_fast(robot: Robot) -> list[str]:
    """Wheels that their joints will not let turn as fast as the body's own limits ask for."""
    body = robot.brain.differential
    if robot.brain.body != "differential" or body is None:
        return []
    return [
        f"{name}: its limit of {robot.motors[name].joint.limits.velocity:g} rad/s is below the "
        f"{body.wheel_speed:.3g} rad/s that max_linear and max_angular together need; the base will turn wide"
        for name in (body.left, body.right)
        if robot.motors[name].joint.limits.velocity < body.wheel_speed
    ]


def _always_late(robot: Robot) -> list[str]:
    """Motors that report so seldom that the brain finds every report too old before the next."""
    body, health = robot.brain.differential, robot.brain.health
    wheels = (body.left, body.right) if robot.brain.body == "differential" and body is not None else ()
    reported: list[str] = []
    for motor in robot.motors.values():
        what, share = "its target is dropped", health.stand_age
        if motor.name in wheels:
            what, share = "the base goes slow", health.slow_age
        limit, period = round(share * motor.joint.feedback_timeout), motor.spec.feedback_period
        if motor.spec.feedback is not FeedbackKind.NONE and limit <= period:
            reported.append(
                f"{motor.name}: {what} when its feedback is older than {limit / MILLISECOND:g} ms, {share:g} "
                f"of its feedback_timeout_ms; the device reports every {period / MILLISECOND:g} ms only"
            )
    return reported


def _unused(robot: Robot) -> list[str]:
    """Sensors whose measurements, and so their timeouts, nobody uses."""
    if robot.brain.body != "joints":
        return []
    return [
        f"{name}: bare joints use no sensor; it is recorded, and its silence goes unnoticed"
        for name in robot.sensors
    ]


def _beyond(motor: Motor) -> list[str]:
    """Limits at the joint that its device cannot be told."""
    reported: list[str] = []
    limits, gear = motor.joint.limits, motor.joint.gear
    for word, limit, unit in (
        ("Velocity.velocity", limits.velocity * gear, "rad/s"),
        ("Torque.torque", limits.torque / gear, "N·m"),
    ):
        able = motor.spec.ranges.get(word)
        if able and limit > able.high:
            quantity = word.split(".")[1]
            reported.append(
                f"{motor.name}: its limit of {quantity} is {limit:g} {unit} at the device's shaft, but the "
                f"device can be told at most {able.high:g}; commands beyond that are refused"
            )
    return reported


def check_bag(
    bag: BagTopics, body: Literal["differential", "joints"], sensors: Collection[str], mistakes: Mistakes
) -> None:
    """The table against the rest of the robot file."""
    if body != "differential":
        said = f"a bag moves a base on wheels, and the body is {body!r}; expected no such table"
        mistakes.add(("bag",), said)
    for sensor in bag.sensors:
        if sensor not in sensors:
            mistakes.add(("bag", "sensors", sensor), unknown("sensor", sensor, sensors))
    played: dict[str, str] = {}
    for topic, part in bag.parts():
        key = ("bag", *part.split("."))
        if not topic.startswith("/"):
            mistakes.add(key, f'found {shown(topic)}, expected a topic: it begins with "/"')
        elif topic in played:
            mistakes.add(key, f"found {shown(topic)}, which is {played[topic]} too; expected another topic")
        played.setdefault(topic, part)
