"""What must hold between the sections of a robot file, each valid by itself; and what to warn the user of.

Rules. Each check adds its own mistakes and leaves the others to the rest; sections that are invalid by
themselves are not among those given.

On a CAN bus nothing is addressed: a device obeys every frame with an id that it listens to, whatever it was
meant for. So two protocols may share no id, in either direction: a command would be obeyed by another device
(0x080 addresses a whole bus in one protocol, and is a node's own in another), a report be taken for a command
or for the report of another device, and two devices that send the same id at once destroy each other's
frames. An 11-bit id and a 29-bit one of the same number are two ids. What devices of one protocol are sent,
and whose reports its driver tells apart, is its own matter; but none may obey what another one reports.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations, permutations
from math import inf

from brain.bodies.body import Body
from brain.bodies.limbs import abilities
from brain.settings import BrainSettings
from gateway.config.errors import Key, Mistakes, shown, unknown
from gateway.core.robot import TWIN, BagTopics, BusDevice, BusSettings, Motor, Robot, Sensor, by_protocol
from protocols import sensors
from protocols.frames import IdMask, id_matches, overlap
from protocols.messages import MILLISECOND, Nanos, Position, Scan, Velocity
from protocols.plugin import FeedbackKind, Spec

HOUR = 3600.0
RANGES = "LaserScan.ranges"
"""What a sensor measures that sees obstacles (`Spec.ranges`)"""
"""s: a joint that gets to the end of its device's positions later, at full speed, is not warned of."""
STALLED_PERIODS = 4
"""Of the robot: a loop that stands for less is late."""
NUMBERED = re.compile(r"socketcan:can[0-9]+|[a-z-]+:/dev/tty(USB|ACM)[0-9]+(@.*)?")
"""Interfaces that the machine numbers in the order in which it finds them."""
_CARRIES = {"can": ("can", "canfd"), "canfd": ("canfd",)}
"""Kinds of bus that carry a device's frames: a classic CAN device also works on a CAN FD bus;
others have a kind of their own."""


def check_devices(
    buses: Mapping[str, BusSettings],
    motors: Mapping[str, Motor],
    sensors: Mapping[str, Sensor],
    period: Nanos,
    mistakes: Mistakes,
) -> None:
    """Check devices against their buses, against each other, and a joint's settings against its device."""
    placed: list[tuple[Key, BusDevice]] = [
        *((("motors", name), motor) for name, motor in motors.items()),
        *((("sensors", name), sensor) for name, sensor in sensors.items()),
    ]
    for at, device in placed:
        bus = buses.get(device.bus)
        carriers = _CARRIES.get(device.spec.bus, (device.spec.bus,))
        if bus and bus.kind not in carriers:
            kinds = " or ".join(carriers)
            text = f"{device.plugin.name} needs a bus of kind {kinds}, and {bus.name!r} is {bus.kind}"
            mistakes.add((*at, "bus"), text)
    for (before, first), (at, second) in combinations(placed, 2):
        if first.bus == second.bus:
            _check_pair(first, at, second, mistakes)
            _check_line(before, first, second, mistakes)
            _check_line(at, second, first, mistakes)
    for bus_name in dict.fromkeys(device.bus for _, device in placed):
        _check_drivers(bus_name, [device for _, device in placed if device.bus == bus_name], mistakes)
    for name, motor in motors.items():
        _check_motor(("motors", name), motor, period, mistakes)


def check_interfaces(buses: Mapping[str, BusSettings], above: Key, mistakes: Mistakes) -> None:
    """Check that no two buses have one interface. `above`: the table of the buses."""
    used: dict[str, str] = {}
    for name, bus in buses.items():
        kind, _, channel = bus.interface.partition(":")
        port = channel.partition("@")[0]
        place = port if port.startswith(("/", "usb-")) else f"{kind}:{channel}"
        if bus.interface == TWIN:
            continue
        if place in used:
            text = f"found {shown(bus.interface)}, which is the interface of {used[place]!r} too"
            mistakes.add((*above, name, "interface"), f"{text}; expected one of its own")
        used.setdefault(place, name)


def _check_pair(first: BusDevice, at: Key, second: BusDevice, mistakes: Mistakes) -> None:
    """Check that two devices on one bus have different addresses, and do not use each other's ids."""
    if first.plugin.name == second.plugin.name and first.device.address == second.device.address:
        text = f"{first.name!r} has address {first.device.address} on bus {first.bus!r} too"
        mistakes.add((*at, "address"), f"{text}; expected an address of its own")
    elif text := id_conflict(first, second):
        remedy = "expected another address or bus, or an option that moves its ids"
        mistakes.add((*at, "address"), f"{text}; {remedy}")


def _check_line(at: Key, device: BusDevice, other: BusDevice, mistakes: Mistakes) -> None:
    """Check that a device does not send unasked on a line on which another one speaks only when asked."""
    unasked = device.spec.line == "free" and device.spec.feedback is not FeedbackKind.NONE
    if device.spec.bus == "serial" and unasked and other.spec.line != "free":
        text = f"{device.plugin.name} sends unasked, and would garble the answers of {other.name!r}"
        text += f" ({other.plugin.name}) on bus {device.bus!r}; expected a line of its own"
        mistakes.add((*at, "bus"), text)


def _check_drivers(bus: str, devices: Sequence[BusDevice], mistakes: Mistakes) -> None:
    """Check what each driver requires of its devices on a bus together: options of the bus must agree."""
    for plugin, group in by_protocol(devices):
        if len({one.device.address for one in group}) < len(group):
            continue  # reported by _check_pair
        try:
            plugin.driver([one.device for one in group])
        except ValueError as error:
            mistakes.add(("buses", bus), f"{plugin.name}: {error}")
        except Exception as error:  # noqa: BLE001 -- a third party's driver may raise anything
            text = f"{plugin.name} is broken: its driver raises {type(error).__name__}: {error}"
            mistakes.add(("buses", bus), text)


def _check_motor(at: Key, motor: Motor, period: Nanos, mistakes: Mistakes) -> None:
    joint, spec = motor.joint, motor.spec
    lets_go = not spec.holds_unattended and joint.unattended == "held"
    if joint.stop_action == "hold" and lets_go:  # at exit, nothing feeds Hold any more
        why = "without commands from its host, the device lets go of its load (its watchdog)"
        known = 'or unattended = "released" if that is known, and safe'
        mistakes.add((*at, "stop_action"), f'found "hold", expected "idle": {why}; {known}')
    if joint.stop_action == "brake" and Velocity not in joint.commands(spec):
        why = "the device takes no velocity to brake by"
        mistakes.add((*at, "stop_action"), f'found "brake", expected "idle": {why}')
    if joint.serial and not (spec.tells_serial and Scan in spec.requests):
        why = (
            "scans are switched off"
            if spec.tells_serial
            else f"with these options no {motor.plugin.name} tells it"
        )
        mistakes.add((*at, "serial"), f"found {shown(joint.serial)}, but it cannot be read: {why}")
    for kind, ramp in spec.ramps.items():
        turns = kind is Position and joint.limits.position is None  # it is commanded no positions
        if kind in joint.commands(spec) and not turns and joint.limits.acceleration * joint.gear > ramp:
            text = f"found {joint.limits.acceleration:g}, but the device's own ramp of {kind.__name__} is "
            text += f"{ramp:.4g} rad/s² at its own shaft; expected at most {ramp / joint.gear:.4g}"
            mistakes.add((*at, "limits", "acceleration"), f"{text}, or an option that makes its ramp steeper")
    timeouts = [("command_timeout_ms", joint.command_timeout, "the robot steps", period)]
    if spec.feedback is not FeedbackKind.NONE:
        reports = spec.feedback_period
        timeouts.append(("feedback_timeout_ms", joint.feedback_timeout, "the device reports", reports))
    for key, timeout, what, cycle in timeouts:
        if timeout <= cycle:
            every = f"{what} every {cycle / MILLISECOND:g} ms"
            mistakes.add(
                (*at, key), f"found {timeout / MILLISECOND:g} ms, but {every}; expected more than that"
            )


def check_stall_timeout(timeout: Nanos, period: Nanos, mistakes: Mistakes) -> None:
    """Check that a loop that is late by a few periods does not count as standing."""
    if timeout < STALLED_PERIODS * period:
        least = f"{STALLED_PERIODS} periods of the robot, {STALLED_PERIODS * period / MILLISECOND:g} ms"
        text = f"found {timeout / MILLISECOND:g} ms, expected at least {least}"
        mistakes.add(("stall_timeout_ms",), text)


def check_body(
    kind: type[Body],
    table: object,
    at: Key,
    motors: Sequence[str],
    sensors: Sequence[str],
    mistakes: Mistakes,
) -> None:
    """Check that the motors exist that a body's table names. `table` is as in the file, there `at`."""
    if not isinstance(table, Mapping):
        return
    for key in kind.motor_keys():
        for name in _strings(table.get(key)):
            if name not in motors:
                sensor = f"{name!r} is a sensor; there is {', '.join(motors)}"
                text = sensor if name in sensors else unknown("motor", name, motors)
                mistakes.add((*at, key), text)


def _strings(value: object) -> list[str]:
    """Return the names in a value of the file: itself, those of a list, or the keys of a table."""
    if isinstance(value, dict):
        return list(value)
    if isinstance(value, list):
        return [text for one in value for text in _strings(one)]
    return [value] if isinstance(value, str) else []


def check_bag(
    bag: BagTopics, brain: BrainSettings, sensors: Collection[str] | None, mistakes: Mistakes
) -> None:
    """Check the table [bag] against the rest of the robot file. `sensors`: None if they are those that it
    names itself."""
    if brain.base is None:
        text = f"a bag moves a base, and the body is {brain.body.kind!r}; expected no such table"
        mistakes.add(("bag",), text)
    if not bag.odometry and not bag.sensors:
        text = "missing; expected a topic, or under sensors a lidar whose scans show how the base moved"
        mistakes.add(("bag", "odometry"), text)
    for group, named in (("sensors", bag.sensors), ("cameras", bag.cameras)):
        for sensor in named:
            if sensors is not None and sensor not in sensors:
                mistakes.add(("bag", group, sensor), unknown("sensor", sensor, sensors))
    for group, placed in (("mounts", bag.mounts), ("clouds", bag.clouds)):
        for name in placed:
            if sensors is not None and group == "mounts":
                mistakes.add(("bag", group, name), f"where it is, mount says under [sensors.{name}]")
            elif name not in bag.sensors and name not in bag.cameras:
                mistakes.add(("bag", group, name), unknown("sensor", name, [*bag.sensors, *bag.cameras]))
    used: dict[str, str] = {}
    for topic, name in bag.parts():
        key = ("bag", *name.split("."))
        if not topic.startswith("/") and (sensors is not None or not topic):
            mistakes.add(key, f'found {shown(topic)}, expected a topic: it begins with "/"')
        elif topic in used:
            mistakes.add(key, f"found {shown(topic)}, which is {used[topic]} too; expected another topic")
        used.setdefault(topic, name)


# -- cautions ----------------------------------------------------------------------------------


def cautions(robot: Robot) -> list[str]:
    """Return what the user must be warned of at every start, until the robot file acknowledges it."""
    notes = [f"{one.name}: {one.spec.watchdog.note}" for one in robot.devices() if one.spec.watchdog.note]
    notes += [f"{one.name}: {one.spec.caution}" for one in robot.devices() if one.spec.caution]
    notes += [text for one in robot.devices() for text in _assumed_scales(one)]
    notes += sensors.kinds().left_out if robot.sensors else ()
    notes += [text for motor in robot.motors.values() for text in _falling_load(motor)]
    notes += [text for motor in robot.motors.values() for text in _out_of_range(motor)]
    notes += [text for motor in robot.motors.values() for text in _past_feedback(motor)]
    for bus in robot.buses.values():
        if not bus.carries_bytes and not bus.acknowledged:
            here = robot.devices_on(bus.name)
            notes += [*_fd_beside_classic(bus.name, here), *_mistakable_reports(here)]
    return [
        *notes,
        *_exchangeable(robot),
        *_slow_joints(robot),
        *_feedback_always_late(robot),
        *_unused_sensors(robot),
        *_blind_base(robot),
    ]


def _blind_base(robot: Robot) -> list[str]:
    """A base that drives, and no sensor by which it could stop before anything."""
    base = abilities(robot.brain.body, list(robot.motors)).base
    if base is None or any(RANGES in one.spec.ranges for one in robot.sensors.values()):
        return []
    have = f"only {', '.join(robot.sensors)}" if robot.sensors else "none at all"
    text = f"no sensor sees obstacles (it has {have}): the base drives into whatever is in its way"
    return [f"{robot.name}: {text}; a lidar, or a person who watches it with a stop at hand"]


def _exchangeable(robot: Robot) -> list[str]:
    """Buses with equal devices, whose adapters the machine may number otherwise after the next start."""
    numbered = [bus for bus in robot.buses.values() if NUMBERED.fullmatch(bus.interface)]
    notes: list[str] = []
    for one, other in combinations(numbered, 2):
        here, there = robot.devices_on(one.name), robot.devices_on(other.name)
        if any(isinstance(each, Motor) and each.joint.serial for each in (*here, *there)):
            continue  # that device is not found then
        if _places(here) & _places(there):
            text = f"{one.interface} and {other.interface} may change places at the next start"
            remedy = "name them by serial number (usb-VENDOR:PRODUCT:SERIAL), or demand a device's (serial)"
            notes.append(f"{one.name}, {other.name}: {text}, and have equal devices: {remedy}")
    return notes


def _places(devices: Sequence[BusDevice]) -> set[tuple[str, int]]:
    return {(each.plugin.name, each.device.address) for each in devices}


def _assumed_scales(device: BusDevice) -> list[str]:
    """Numbers that decide how fast or how strong it is, and that nobody has stated."""
    if not device.assumed:
        return []
    are, them = ("are", "them") if len(device.assumed) > 1 else ("is", "it")
    what = f"{', '.join(device.assumed)} {are} assumed"
    return [f"{device.name}: {what}, and all that is measured and commanded hangs on {them}: state {them}"]


def _falling_load(motor: Motor) -> list[str]:
    """A joint with an end of travel, whose load falls at a stop or after the run; a wheel has no such end."""
    joint = motor.joint
    if joint.limits.position is None or motor.spec.holds_idle:
        return []
    if joint.stop_action != "hold" and joint.unattended == "held":
        when = f'by stop_action = "{joint.stop_action}" nothing holds its load at a stop and after the run'
        return [
            f'{motor.name}: {when}: it falls; "hold", or unattended = "released" if that is known, and safe'
        ]
    notes: list[str] = []
    if joint.stop_action == "hold" and joint.on_command_timeout == "idle":
        when = 'when its commands end its load falls, by on_command_timeout = "idle"'
        notes.append(f'{motor.name}: it holds at a stop, but {when}; "hold" there, too')
    if joint.stop_action == "hold" and joint.unattended == "released" and not joint.lets_down(motor.spec):
        notes.append(f"{motor.name}: its device cannot let a load down: after the run what it holds falls")
    return notes


def _slow_joints(robot: Robot) -> list[str]:
    """Joints of a base whose limits are below what the body's own limits need."""
    base = robot.brain.base
    driven = base is not None and not robot.recorded
    needed = zip(base.joints, base.top_speeds, strict=True) if base is not None and driven else ()
    return [
        f"{name}: its limit of {limit:g} rad/s is below the {speed:.3g} rad/s that "
        "max_linear and max_angular together need; the base will turn wide"
        for name, speed in needed
        if (limit := robot.motors[name].joint.limits.velocity) < speed < inf
    ]


def _feedback_always_late(robot: Robot) -> list[str]:
    """Motors whose feedback period is longer than the age at which the brain takes feedback for too old."""
    wheels, health = robot.brain.abilities(robot.motors).wheels, robot.brain.health
    notes: list[str] = []
    for motor in robot.motors.values():
        what, share = "its target is dropped", health.stand_age
        if motor.name in wheels:
            what, share = "the base goes slow", health.slow_age
        limit, period = round(share * motor.joint.feedback_timeout), motor.spec.feedback_period
        if motor.spec.feedback is not FeedbackKind.NONE and limit <= period:
            notes.append(
                f"{motor.name}: {what} when its feedback is older than {limit / MILLISECOND:g} ms, {share:g} "
                f"of its feedback_timeout_ms; the device reports every {period / MILLISECOND:g} ms only"
            )
    return notes


def _unused_sensors(robot: Robot) -> list[str]:
    """Sensors whose measurements and timeouts are not used."""
    text = "bare joints use no sensor; it is recorded, and a loss of its measurements goes unnoticed"
    return [f"{name}: {text}" for name in robot.sensors] if robot.brain.base is None else []


def _out_of_range(motor: Motor) -> list[str]:
    """Limits of the joint that are beyond the range of the device's commands."""
    notes: list[str] = []
    limits, gear = motor.joint.limits, motor.joint.gear
    for field, limit, unit in (
        ("Velocity.velocity", limits.velocity * gear, "rad/s"),
        ("Torque.torque", limits.torque / gear, "N·m"),
    ):
        able = motor.spec.ranges.get(field)
        if able and limit > able.high:
            quantity = field.split(".")[1]
            notes.append(
                f"{motor.name}: its limit of {quantity} is {limit:g} {unit} at the device's shaft, but the "
                f"device can be commanded at most {able.high:g}; commands beyond that are refused"
            )
    able = motor.spec.ranges.get("Position.position")
    if able and limits.position is not None:
        ends = sorted(each * gear * motor.joint.sign for each in limits.position)
        if ends[0] < able.low - able.resolution or ends[1] > able.high + able.resolution:
            notes.append(
                f"{motor.name}: its limits of position are [{ends[0]:.4g}, {ends[1]:.4g}] rad at the device's"
                f" shaft, but the device can be commanded from {able.low:.4g} to {able.high:.4g} only; "
                "commands beyond that are refused"
            )
    return notes


def _past_feedback(motor: Motor) -> list[str]:
    """A joint that can turn past the positions that its device can report: there it has none."""
    joint, able = motor.joint, motor.spec.ranges.get("Feedback.position")
    most = min(-able.low, able.high) if able else inf
    limits, speed = joint.limits.position, joint.limits.velocity * joint.gear
    if limits is not None and able is not None:
        ends = [each * joint.gear * joint.sign for each in limits]
        if able.low <= min(ends) and max(ends) <= able.high:
            return []
    if limits is not None:
        farthest = max(map(abs, limits)) * joint.gear
        where, passes = f"its limits of position reach {farthest:g} rad", farthest > most
        remedy = "narrow its limits of position"
    else:
        where, passes = (
            f"without limits of position it gets there in {most / speed:.3g} s",
            most < HOUR * speed,
        )
        remedy = "give it limits of position"
    if not passes:
        return []
    reports = f"its device reports at most {most:g} rad at its own shaft, and no position beyond"
    return [f"{motor.name}: {reports}; {where}: {remedy}, or widen the range on the device"]


# -- several protocols on one bus --------------------------------------------------------------

MAX_LISTED = 4
"""Ids of one kind that a sentence lists."""


def id_conflict(first: BusDevice, second: BusDevice) -> str:
    """Return what is wrong with the ids of two devices on one bus, from the side of the second; "" if nothing
    is."""
    ours, theirs, name = second.spec, first.spec, repr(first.name)
    alike = first.plugin.name == second.plugin.name
    common = _contained if alike else _shared
    kinds = [
        (common(_obeyed(ours), theirs.expects), f"it would obey what {name} reports there"),
        (common(_obeyed(theirs), ours.expects), f"{name} would obey what it reports there"),
    ]
    if not alike:
        obeyed, obeyed_there = _shared(_obeyed(ours), theirs.sends), _shared(_obeyed(theirs), ours.sends)
        kinds += [
            (_shared(obeyed, obeyed_there), "each would obey what the other is sent"),
            (obeyed, f"it would obey what {name} is sent"),
            (obeyed_there, f"{name} would obey what it is sent"),
            (_shared(ours.expects, theirs.expects), "both report there"),
        ]
    conflicts: list[str] = []
    seen: list[IdMask] = []
    for shared, why in kinds:
        if new := [ids for ids in shared if not any(_contains(known, ids) for known in seen)]:
            conflicts.append(f"{_list(new)} ({why})")
            seen += new
    if not conflicts:
        return ""
    return f"uses CAN ids of {name} ({first.plugin.name}) on bus {first.bus!r}: {'; '.join(conflicts)}"


def _fd_beside_classic(bus: str, devices: Sequence[BusDevice]) -> list[str]:
    """A controller without CAN FD answers each FD frame with an error frame (ISO 11898-1:2015, which calls
    one that does not "FD tolerant")."""
    classic, fd = ([one.name for one in devices if one.spec.bus == kind] for kind in ("can", "canfd"))
    if not (classic and fd):
        return []
    who = f"{', '.join(fd)} use{'s' * (len(fd) == 1)} CAN FD, and {', '.join(classic)} classic CAN only"
    need = f"the controller of {' and of '.join(classic)} must tolerate CAN FD, or it destroys every FD frame"
    return [f'{bus}: {who}; {need}. If so, write shared_bus = "acknowledged" under [buses.{bus}]']


def _mistakable_reports(devices: Sequence[BusDevice]) -> list[str]:
    """Reports that a driver of another protocol takes for those of a device that is not in the file."""
    notes: dict[tuple[str, str], str] = {}
    for listener, sender in permutations(devices, 2):
        key = listener.plugin.name, sender.name
        if listener.plugin.name == sender.plugin.name or key in notes:
            continue
        if taken := _shared(listener.spec.receives_also, sender.spec.expects):
            text = f"{listener.plugin.name} takes its frames on {_list(taken)} for messages of its own kind"
            remedy = f'an address of its own, or shared_bus = "acknowledged" under [buses.{sender.bus}]'
            notes[key] = f"{sender.name}: {text}, and a scan may find what is not there; {remedy}"
    return list(notes.values())


def _obeyed(spec: Spec) -> tuple[IdMask, ...]:
    """Return the ids that a device obeys."""
    return (*spec.sends, *spec.obeys_also)


def _shared(some: Iterable[IdMask], others: Sequence[IdMask]) -> list[IdMask]:
    """Return the ids that both contain, each once."""
    both = {(a[0] | b[0], a[1] | b[1]) for a in some for b in others if overlap(a, b)}
    return sorted(ids for ids in both if not any(ids != wider and _contains(wider, ids) for wider in both))


def _contained(some: Iterable[IdMask], others: Sequence[IdMask]) -> list[IdMask]:
    """Return those of the others that are among some, whatever data they carry: what depends on that is for
    the protocol to know."""
    wider = tuple(some)
    return [ids for ids in others if any(_contains(each, ids) for each in wider)]


def _contains(wider: IdMask, ids: IdMask) -> bool:
    return wider[1] & ~ids[1] == 0 and id_matches(wider, ids[0])


def _list(choices: Sequence[IdMask]) -> str:
    """Return ids as a text, those with open bits by their first and last."""
    texts: list[str] = []
    for number, mask in choices[:MAX_LISTED]:
        digits, most = (8, 0x1FFF_FFFF) if number > 0x7FF else (3, 0x7FF)
        low = number & most
        high = low | most & ~mask
        texts.append(f"0x{low:0{digits}X}" + (f"…0x{high:0{digits}X}" if high != low else ""))
    return ", ".join(texts) + (", …" if len(choices) > MAX_LISTED else "")
