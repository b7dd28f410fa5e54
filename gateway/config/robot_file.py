"""The robot file → a Robot: the one place that decides what a robot consists of.

Rules. A wrong file raises `ConfigError` with every mistake at once, before anything moves; a valid one
gives a `Robot`, which is values only. Nothing can be switched off: limits, timeouts and rates are
positive finite numbers. The settings of a protocol, a joint or the brain are typed by their own
dataclasses, so this file knows none of them by name. Files are TOML (toml.io, version 1.0.0).

    name, rate_hz, world, plant, seed   the robot; `world` is the simulated world behind the twins, `plant`
                                        what the robot truly is in it
    real                                the devices that are there, while all others are simulated
    [buses.NAME]                        kind, interface, bitrate and data_bitrate, or baudrate,
                                        receive_filter, transmit_queue, shared_bus
    [motors.NAME]                       protocol, bus, address, and a joint's settings (gateway.core.joint)
    [motors.NAME.limits]                velocity, acceleration, torque, position, jerk
    [motors.NAME.loop]                  gateway.core.torque_loop.LoopSettings: reached by torque
    [motors.NAME.options]               what the driver should do: the protocol's own
    [motors.NAME.settings]              what is configured on the device: the protocol's own, for its twin
    [sensors.NAME]                      protocol, bus, address, mount, timeout_ms, options, settings
    urdf                                links and joints (gateway.config.urdf); [files] has its text (.files)
    [map]                               gateway.config.map_file.MapKeys: a map in which it begins; likewise
    [defaults.motors] …                 defaults for every motor (bus, sensor)
    [brain]                             brain.settings.BrainSettings; [brain.BODY] is the body's own; `kind`
                                        names a brain of another distribution, [brain.KIND] is its own
    [limbs.NAME]                        of a robot of several: body, mounted_on, at, the body's own keys
    [ros]                               gateway.core.robot.RosSettings: names in ROS 2's graph
    [bag]                               gateway.core.robot.BagTopics: the topics of a foreign bag
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from brain import doors, other_brain
from brain.bodies import bare
from brain.bodies.body import Body
from brain.bodies.limbs import BodyAsLimb, LimbPlace, Limbs
from brain.other_brain import Chosen
from brain.settings import BrainSettings
from gateway.config import bodies, resources, validate
from gateway.config.errors import Key, Mistakes, shown, unknown
from gateway.config.files import fill, unpacked, with_files
from gateway.config.map_file import MapKeys, files_of, saved_map
from gateway.config.recorded import FOR_RECORDINGS, completed, is_recorded
from gateway.config.schema import build
from gateway.config.sections import Find, Table, check_interface, own_ids, read_bus, read_motor, read_sensor
from gateway.config.text import read_text, read_toml
from gateway.config.urdf import Description
from gateway.core.robot import (
    STALL_TIMEOUT,
    TWIN,
    BagTopics,
    BusDevice,
    BusSettings,
    Motor,
    Robot,
    RosSettings,
    Sensor,
)
from gateway.errors import UserError
from protocols import plugin
from protocols.bounds import Bounds, Duration, Invalid, keys
from protocols.messages import SECOND

GROUPS = ("buses", "motors", "sensors")
SECTIONS = (*GROUPS, "defaults", "brain", "limbs", "ros", "map", "bag", "files")
NAME = "[A-Za-z_][A-Za-z0-9_]{0,63}"
EXPECTED_NAME = "expected a name of letters, digits and _ that begins with no digit"
LOWEST_RATE, HIGHEST_RATE = 10.0, 1000.0
"""Steps per second."""
TIMES = 8
"""The usual size of a file that a robot file may have with those that it names"""
MAX_NAMED = 256
"""Buses, motors or sensors of a robot."""
BESIDE = "_twins"
"""Ends the name of the simulated bus of the devices that are not real, where others of their bus are."""
_FILES: tuple[tuple[str, Literal["worlds", "plants"]], ...] = (("world", "worlds"), ("plant", "plants"))
"""Keys that name another file, and its kind."""
RESERVED = ("all", "brain", "operator", "scan")
"""Names with another meaning in an operator's commands or as the source of a note."""


@dataclass(frozen=True, slots=True)
class TopKeys:
    """The keys before all tables."""

    name: str
    """Letters, digits, _ and -; recordings and sockets are called by it"""
    rate_hz: Annotated[float, Bounds(LOWEST_RATE, HIGHEST_RATE, "steps per second")] = 200.0
    """Steps per second"""
    world: str | None = None
    """The simulated world behind the twins: a name that ships, or a path from this file"""
    plant: str | None = None
    """What the robot truly is in its world: a name that ships, or a path from this file"""
    urdf: str | None = None
    """Links and joints: a path from this file. Limits, mounts and geometry are taken from it"""
    seed: Annotated[int, Bounds(0, 2**32 - 1)] = 0
    """Of all noise of twins and world"""
    stall_timeout: Annotated[Duration, Bounds(100, 2000)] = STALL_TIMEOUT
    """How long the loop may stand before the watchdog process sends the stop action."""
    real: tuple[str, ...] = ()
    """Motors and sensors that are there, while all others are simulated; as `real = true` of each"""


def load_robot(
    robot: str | Path,
    find: Find = plugin.load,
    *,
    recorded: bool = False,
    real: Sequence[str] = (),
    saved_map: str = "",
    start: tuple[float, float, float] | None = None,
) -> Robot:
    """Read a robot file.

    Args:
        robot: its path, or the name of one that ships with the gateway ("diffbot").
        find: returns a protocol plugin by its name; by default those that are installed.
        recorded: whether it may be the file of a recording, which has no bus and cannot be run.
        real: as the file's key of this name, in its place; (): the file's.
        saved_map: the file of a map in which it begins, as that of the table [map]; "": the file's.
        start: where it is in it: m, m, rad; None: it looks for its place.

    Returns:
        Robot: everything that the file describes; nothing is opened yet.

    Raises:
        ConfigError: the file is wrong or cannot be read; every mistake in it.
        UserError: neither a file nor a shipped name.
    """
    path = resources.find("robots", robot) if isinstance(robot, str) else robot
    mistakes = Mistakes(str(path), "")
    text = read_text(path)
    if saved_map:
        text = _with_map(text, Path(saved_map), start, mistakes)
    text = with_files(text, path, mistakes, find)
    mistakes.check()
    return parse_robot(text, str(path), find, file=path, recorded=recorded, real=real)


def _with_map(text: str, file: Path, start: tuple[float, float, float] | None, mistakes: Mistakes) -> str:
    """Return the text of a robot file with a table [map]."""
    if "map" in read_toml(text, mistakes):
        raise mistakes.fatal(f"--map {file}: the file has a table [map]; expected one of both")
    lines = [f"file = {json.dumps(str(file.absolute()))}"]
    if start is not None:
        x, y, yaw = start
        lines.append(f"start = {{ x = {x!r}, y = {y!r}, yaw = {yaw!r} }}")
    return "\n".join([text.rstrip(), "", "[map]", *lines, ""])


def parse_robot(
    text: str,
    name: str = "robot.toml",
    find: Find = plugin.load,
    *,
    file: Path | None = None,
    recorded: bool = False,
    real: Sequence[str] = (),
) -> Robot:
    """Make a robot from the text of its file.

    Args:
        text: TOML.
        name: the file's name in mistakes.
        find: returns a protocol plugin by its name.
        file: where it is: its world and plant must exist, and their paths count from its folder. None: a
            replay, which needs none.
        recorded: as of `load_robot`.
        real: likewise.

    Returns:
        Robot: everything that the text describes.

    Raises:
        ConfigError: every mistake in the text.
    """
    find = cache(find)  # it takes milliseconds
    mistakes = Mistakes(name, text)
    table = read_toml(text, mistakes, TIMES if "\n[files]\n" in text else 1)
    if is_recorded(table):
        if not recorded:
            raise mistakes.fatal(FOR_RECORDINGS)
        return _recorded(table, text, mistakes)
    if real:
        if "real" in table:
            raise mistakes.fatal(f"--real {','.join(real)}: the file has a key 'real'; expected one of both")
        table["real"] = [*real]
        text = f"real = {json.dumps([*real])}\n{text}"  # a replay needs it
    defaults = _section(table, "defaults", mistakes, GROUPS)
    groups = {group: _group(table, group, defaults.get(group, {}), mistakes) for group in GROUPS}
    described = Description(table, mistakes)
    if described.broken:
        raise mistakes.error()  # what it lacks would be reported for every motor
    moved = described.motors(groups["motors"])
    described.sensors(groups["sensors"])
    fill(table, groups["motors"] | groups["sensors"], find)
    for key, kind in _FILES:
        try:
            if file is not None and isinstance(other := table.get(key), str):
                table[key] = resources.beside(other, file)
                resources.find(kind, table[key])
        except UserError as error:
            mistakes.add((key,), str(error))
    top = build(TopKeys, table, (), mistakes, also=SECTIONS)
    robot_name = table.get("name")
    if isinstance(robot_name, str) and not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", robot_name):
        mistakes.add(("name",), f"found {shown(robot_name)}, expected letters, digits, _ and -")

    known = {n: read_bus(n, t, mistakes) for n, t in groups["buses"].items()}
    buses = {n: bus for n, bus in known.items() if bus}
    motors = {n: m for n, t in groups["motors"].items() if (m := read_motor(n, t, known, find, mistakes))}
    sensors = {n: s for n, t in groups["sensors"].items() if (s := read_sensor(n, t, known, find, mistakes))}
    flagged = [name for group in GROUPS[1:] for name, t in groups[group].items() if t.get("real") is True]
    if there := [*(top.real if top else ()), *flagged]:
        _simulate_others(there, buses, motors, sensors, mistakes)
    devices: list[BusDevice] = [*motors.values(), *sensors.values()]
    for n, bus in buses.items():
        specs = tuple(one.spec for one in devices if one.bus == n)
        own = own_ids(specs) if groups["buses"].get(n, {}).get("receive_filter") == "own" else ()
        buses[n] = replace(bus, receive_filter=own, devices=specs)
    limb_tables = _section(table, "limbs", mistakes) if "limbs" in table else None
    if "brain" not in table and limb_tables is None:
        mistakes.add(("brain",), "missing; expected a table [brain] that names the body")
    motor_names, sensor_names = tuple(groups["motors"]), tuple(groups["sensors"])
    complete = partial(described.body, joints=moved)
    brain = _brain(table.get("brain", {}), limb_tables, motor_names, sensor_names, complete, mistakes)
    bag = build(BagTopics, table["bag"], ("bag",), mistakes) if "bag" in table else None
    ros = build(RosSettings, table.get("ros", {}), ("ros",), mistakes)
    if "map" in table and brain is not None:
        brain = _in_map(brain, table, mistakes)

    period = round(SECOND / top.rate_hz) if top else 0
    validate.check_interfaces(buses, ("buses",), mistakes)
    validate.check_devices(buses, motors, sensors, period, mistakes)
    if top is not None:
        validate.check_stall_timeout(top.stall_timeout, period, mistakes)
    if bag is not None and brain is not None:
        validate.check_bag(bag, brain, sensor_names, mistakes)
    mistakes.check()
    if top is None or brain is None:
        raise AssertionError("a section is missing, and no mistake was added")
    folder = "" if file is None or top.urdf is None else str((file.parent / top.urdf).parent)
    return Robot(
        name=top.name,
        text=text,
        period=period,
        world=top.world,
        seed=top.seed,
        buses=buses,
        motors=motors,
        sensors=sensors,
        brain=brain,
        bag=bag,
        plant=top.plant,
        stall_timeout=top.stall_timeout,
        ros=ros or RosSettings(),
        description=described.text,
        described=moved,
        folder=folder,
        real=tuple(dict.fromkeys(there)),
    )


def _simulate_others(
    real: Sequence[str],
    buses: dict[str, BusSettings],
    motors: dict[str, Motor],
    sensors: dict[str, Sensor],
    mistakes: Mistakes,
) -> None:
    """Put every device that is not real on a simulated bus: on its own, or beside it where others are real.

    So what is sent to a simulated device is on no wire, and no wire carries what two worlds say."""
    devices: dict[str, BusDevice] = {**motors, **sensors}
    for name in real:
        if name not in devices:
            mistakes.add(("real",), unknown("device", name, devices))
    wired = {one.bus for name, one in devices.items() if name in real}
    for name, bus in list(buses.items()):
        if name not in wired:
            buses[name] = replace(bus, interface=TWIN)
    for name, one in devices.items():
        if name in real or one.bus not in wired:
            continue
        beside = f"{one.bus}{BESIDE}"
        if one.bus in buses:
            buses.setdefault(beside, replace(buses[one.bus], name=beside, interface=TWIN))
        if isinstance(one, Motor):
            motors[name] = replace(one, bus=beside)
        else:
            sensors[name] = replace(one, bus=beside)


def _recorded(table: Table, text: str, mistakes: Mistakes) -> Robot:
    """Make a robot from the file of a recording."""
    table, joints = completed(table, mistakes)
    top = build(TopKeys, table, (), mistakes, also=SECTIONS)
    if "brain" not in table:
        mistakes.add(
            ("brain",), f'missing; expected body = "NAME" before all tables: {", ".join(bodies.names())}'
        )
    brain = _brain(table["brain"], None, joints, (), _as_it_is, mistakes) if "brain" in table else None
    bag = build(BagTopics, table["bag"], ("bag",), mistakes)
    if bag is not None and brain is not None:
        validate.check_bag(bag, brain, None, mistakes)
    mistakes.check()
    if top is None or brain is None:
        raise AssertionError("a section is missing, and no mistake was added")
    return Robot(top.name, text, round(SECOND / top.rate_hz), None, top.seed, {}, {}, {}, brain, bag)


def _as_it_is(_: type[Body], table: object, __: Key) -> object:
    return table


def with_motor_alone(robot: Robot, motor: str, most: float) -> Robot:
    """Return the robot as one bare joint on its bus.

    Args:
        robot: whose motor.
        motor: its name, which the robot has.
        most: its limit of velocity [rad/s], within that of the robot file.
    """
    settings = robot.motors[motor]
    joint = replace(settings.joint, limits=replace(settings.joint.limits, velocity=most))
    return replace(
        robot,
        world=robot.world if robot.brain.body.bare else None,
        buses={settings.bus: robot.buses[settings.bus]},
        motors={motor: replace(settings, joint=joint)},
        sensors={},
        brain=replace(robot.brain, body=bare([motor]), other=None),
    )


def with_interfaces(robot: Robot, interfaces: Mapping[str, str]) -> Robot:
    """Return the robot with some of its buses on other interfaces.

    Args:
        robot: whose buses.
        interfaces: by name of the bus: {"can0": "socketcan:vcan0", "sensors": "serial:/dev/ttyUSB0"}.

    Returns:
        Robot: the same but for these interfaces.

    Raises:
        ConfigError: a bus that the robot does not have, or what is not INTERFACE:CHANNEL.
    """
    mistakes = Mistakes("--bus", "")
    buses = dict(robot.buses)
    for name, interface in interfaces.items():
        if name not in buses:
            mistakes.add((), unknown("bus", name, buses))
            continue
        buses[name] = replace(buses[name], interface=interface)
        check_interface(interface, buses[name].kind, (name,), mistakes)
    validate.check_interfaces(buses, (), mistakes)
    mistakes.check()
    return replace(robot, buses=buses)


# -- sections ----------------------------------------------------------------------------------


Complete: TypeAlias = Callable[[type[Body], object, Key], object]
"""Returns a body's table, there in the file, with what a URDF says."""


def _brain(
    table: object,
    limb_tables: Mapping[str, Table] | None,
    motors: tuple[str, ...],
    sensors: tuple[str, ...],
    complete: Complete,
    mistakes: Mistakes,
) -> BrainSettings | None:
    """Read the table [brain]: the body's name, the body's own table of that name, and the settings; or, of a
    robot of several limbs, the settings alone."""
    if not isinstance(table, dict):
        mistakes.add(("brain",), f"found {shown(table)}, expected a table")
        return None
    name = table.get("body")
    body: Body | None = None
    if limb_tables is not None:
        if "body" in table:
            mistakes.add(("brain", "body"), "the file has limbs, which are its bodies; expected no such key")
        body = _limbs(limb_tables, motors, sensors, complete, mistakes)
    elif (kind := _kind(table, "body", ("brain", "body"), mistakes)) is not None:
        if kind.kind not in table:
            mistakes.add(("brain", kind.kind), f"missing; the body {name!r} expects this table")
        else:
            at = ("brain", kind.kind)
            body = build(kind, complete(kind, table[kind.kind], at), at, mistakes)
            validate.check_body(kind, table[kind.kind], at, motors, sensors, mistakes)
    other = _other_brain(table, motors, mistakes)
    also = ["body", *([str(name)] if body else [str(name), *bodies.names()])]  # its table may be right
    also += ["kind", str(table["kind"])] if "kind" in table else []
    given = {"body": body or bare(["x"]), "other": other, "saved": None}
    settings = build(BrainSettings, table, ("brain",), mistakes, also, given)
    return settings if body else None


def _in_map(brain: BrainSettings, table: Table, mistakes: Mistakes) -> BrainSettings:
    """Return the brain's settings with the map of the table [map]."""
    named = build(MapKeys, table["map"], ("map",), mistakes)
    if brain.base is None or brain.other is not None:
        mistakes.add(
            ("map",), "what is in a map is a base, of this project's own brain; expected no such table"
        )
    if named is None:
        return brain
    files = table.get("files", {})
    text = files.get(named.file) if isinstance(files, dict) else None
    if not isinstance(text, str):
        missing = f"there is no text of {named.file!r} in [files]; it comes there by loading the file"
        mistakes.add(("map", "file"), missing)
        return brain
    there = {name: one for name in files_of(text) if isinstance(one := files.get(name), str)}
    parts = {name: unpacked(one) for name, one in there.items()}
    try:
        return replace(brain, saved=saved_map(text, parts, brain.perception.map, named.start))
    except Invalid as error:
        for _, sentence in error.wrong:
            mistakes.add(("map", "file"), f"{Path(named.file).name}: {sentence}")
    return brain


def _other_brain(table: Table, motors: tuple[str, ...], mistakes: Mistakes) -> Chosen | None:
    """Read who makes the commands in place of our brain, if the table names one."""
    if "kind" not in table:
        return None
    name, at = table["kind"], ("brain", "kind")
    if (
        not isinstance(name, str)
        or name in keys(BrainSettings)
        or name in (table.get("body"), "body", "kind")
    ):
        mistakes.add(at, f"found {shown(name)}, expected the name of a brain that is installed")
        return None
    try:
        kind, maker = other_brain.load(name)
    except doors.NotFound as error:
        ours = "; leave it out for this project's own brain"
        mistakes.add(at, f"{unknown('brain', name, error.known)}{error.unread}{ours}")
        return None
    except doors.Broken as error:
        mistakes.add(at, str(error))
        return None
    settings: object = build(kind.settings, table.get(name, {}), ("brain", name), mistakes)
    if settings is None:
        return None
    try:
        kind.make(settings, motors)
    except Exception as error:  # noqa: BLE001 -- another's brain may raise anything
        kind_of_error = "" if isinstance(error, ValueError) else f"it is broken: {type(error).__name__}: "
        mistakes.add(("brain", name), f"{kind_of_error}{error}")
    return Chosen(kind, settings, maker)


def _kind(table: Table, key: str, at: Key, mistakes: Mistakes) -> type[Body] | None:
    """Return the class of the body that a table names."""
    name = table.get(key)
    if not isinstance(name, str):
        found = f"found {shown(name)}" if key in table else "missing"
        mistakes.add(at, f"{found}; expected the name of a body: {', '.join(bodies.names())}")
        return None
    try:
        return bodies.load_body(name)
    except UserError as error:
        mistakes.add(at, str(error))
        return None


@dataclass(frozen=True, slots=True)
class LimbKeys:
    """The keys of a limb beside those of its body."""

    body: str
    """Its own keys stand beside this one"""
    mounted_on: str = ""
    """The limb that carries this one; "": the ground"""
    at: LimbPlace = field(default_factory=LimbPlace)
    """Where it is on that"""


def _limbs(
    tables: Mapping[str, Table],
    motors: tuple[str, ...],
    sensors: tuple[str, ...],
    complete: Complete,
    mistakes: Mistakes,
) -> Limbs | None:
    """Read the tables [limbs.NAME]."""
    found: dict[str, BodyAsLimb] = {}
    settings = [one.name for one in fields(BrainSettings)]
    for name, table in tables.items():
        at = ("limbs", name)
        if not re.fullmatch(NAME, name) or name in settings:
            text = f"a setting of the brain is called {name!r}; expected another name"
            mistakes.add(at, text if name in settings else EXPECTED_NAME)
        kind = _kind(table, "body", (*at, "body"), mistakes)
        mounting = {key: value for key, value in table.items() if key in keys(LimbKeys)}
        own = {key: value for key, value in table.items() if key not in mounting}
        mounted = build(LimbKeys, mounting, at, mistakes)
        if kind is None:
            continue
        body = build(kind, complete(kind, own, at), at, mistakes)
        validate.check_body(kind, own, at, motors, sensors, mistakes)
        if body is not None and mounted is not None:
            found[name] = BodyAsLimb(body, mounted.mounted_on, mounted.at)
    if len(found) < len(tables):
        return None
    try:
        return Limbs(limbs=found)
    except ValueError as error:
        mistakes.invalid(("limbs",), error)
        return None


def _section(table: Table, name: str, mistakes: Mistakes, known: tuple[str, ...] = ()) -> dict[str, Table]:
    """Return a table of tables; what is none of these is a mistake and left out."""
    section = table.get(name, {})
    if not isinstance(section, dict):
        mistakes.add((name,), f"found {shown(section)}, expected tables: [{name}.NAME]")
        return {}
    if len(section) > MAX_NAMED:
        mistakes.add((name,), f"found {len(section)} tables, expected at most {MAX_NAMED}")
        raise mistakes.error()  # what names those beyond would be wrong as well
    for key, value in section.items():
        if known and key not in known:
            mistakes.add((name, key), unknown("key", key, known))
        elif not isinstance(value, dict):
            mistakes.add((name, key), f"found {shown(value)}, expected a table [{name}.{key}]")
    return {key: value for key, value in section.items() if isinstance(value, dict)}


def _group(table: Table, group: str, defaults: Table, mistakes: Mistakes) -> dict[str, Table]:
    """Return the buses, motors or sensors by name, each with the defaults of its group."""
    named = _section(table, group, mistakes)
    if not named and group != "sensors":
        mistakes.add((group,), f"missing; expected at least one table [{group}.NAME]")
    for name in named:
        if not re.fullmatch(NAME, name):
            mistakes.add((group, name), EXPECTED_NAME)
        if name in RESERVED:
            mistakes.add((group, name), f"{name!r} has a meaning of its own; expected another name")
        if group == "sensors" and name in table.get("motors", {}):
            mistakes.add((group, name), f"a motor is called {name!r} too; expected another name")
    return {name: _merged(defaults, own) for name, own in named.items()}


def _merged(defaults: Table, own: Table) -> Table:
    """Return a table with its missing keys taken from the defaults, at every depth."""
    merged = dict(defaults)
    for key, value in own.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged
