"""The robot file → a Robot: the composition root. Read here, and nowhere else, what a robot is made of.

Rules. A wrong file raises `ConfigError` with every mistake at once, before anything moves; a right one
gives a `Robot`, which is values only. Nothing can be switched off: limits, timeouts and rates are
positive finite numbers. What a protocol, a joint or the brain can be told is typed by their own
dataclasses, so this file knows no setting of theirs by name. Files are TOML (toml.io, version 1.0.0).

    name, rate_hz, world, seed          the robot; `world` is what stands behind the twins
    [buses.NAME]                        kind, interface, bitrate and data_bitrate, or baudrate; receive_filter, shared_bus
    [motors.NAME]                       protocol, bus, address, and a joint's settings (gateway.core.joint)
    [motors.NAME.limits]                velocity, acceleration, torque, position
    [motors.NAME.options]               what our driver should do: the protocol's own
    [motors.NAME.settings]              what is configured on the device: the protocol's own, for its twin
    [sensors.NAME]                      protocol, bus, address, mount, timeout_ms, options, settings
    [defaults.motors] …                 what every motor (bus, sensor) has that does not say otherwise
    [brain]                             brain.brain.BrainSettings
    [bag]                               gateway.core.robot.BagTopics: what the topics of a foreign bag are
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

from brain.settings import BrainSettings
from gateway.config import resources, validate
from gateway.config.describe import describe
from gateway.config.errors import Mistakes, shown, unknown
from gateway.config.schema import build, positive
from gateway.config.sections import Find, Table, check_interface, only_own, read_bus, read_motor, read_sensor
from gateway.config.validate import cautions, check_bag
from gateway.core.robot import BagTopics, BusSettings, Motor, Robot, Sensor
from gateway.errors import UserError
from protocols import plugin
from protocols.messages import SECOND
from protocols.plugin import Device, Plugin

__all__ = [
    "BusSettings",
    "Motor",
    "Robot",
    "Sensor",
    "cautions",
    "describe",
    "devices",
    
    
    "with_interfaces",
]

GROUPS = ("buses", "motors", "sensors")
SECTIONS = (*GROUPS, "defaults", "brain", "bag")
RESERVED = ("all", "brain", "operator", "scan")
"""Names that stand for something else in what an operator says or a note is about."""


@dataclass(frozen=True, slots=True)
class _Top:
    name: str
    rate_hz: float = 200.0
    world: str | None = None
    seed: int = 0


# -- what others call --------------------------------------------------------------------------


def load_robot(path: Path, find: Find = plugin.load) -> Robot:
    """Read a robot file. Raises ConfigError with every mistake in it, or that it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        mistakes = Mistakes(str(path), "")
        mistakes.add((), f"cannot be read: {error}")
        raise mistakes.error() from error
    return parse_robot(text, str(path), find, with_world=True)


def parse_robot(
    text: str, name: str = "robot.toml", find: Find = plugin.load, *, with_world: bool = False
) -> Robot:
    """A robot from the text of its file; `name` is the file's in mistakes, `find` knows the protocols.

    Whether its world is there is only looked at `with_world`: a replay needs none."""
    mistakes = Mistakes(name, text)
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"line (\d+)", str(error))
        mistakes.add((), f"not TOML: {error}", int(place[1]) if place else 0)
        raise mistakes.error() from error
    defaults = _section(table, "defaults", mistakes, GROUPS)
    groups = {group: _group(table, group, defaults.get(group, {}), mistakes) for group in GROUPS}
    top = build(_Top, table, (), mistakes, also=SECTIONS)
    _check_top(table, mistakes)
    if with_world:
        _check_world(table.get("world"), mistakes)

    known = tuple(groups["buses"])
    buses = {n: bus for n, t in groups["buses"].items() if (bus := read_bus(n, t, mistakes))}
    motors = {n: m for n, t in groups["motors"].items() if (m := read_motor(n, t, known, find, mistakes))}
    sensors = {n: s for n, t in groups["sensors"].items() if (s := read_sensor(n, t, known, find, mistakes))}
    if "brain" not in table:
        mistakes.add(("brain",), "missing; expected a table [brain] that says which body")
    brain = build(BrainSettings, table.get("brain", {}), ("brain",), mistakes)
    bag = build(BagTopics, table["bag"], ("bag",), mistakes) if "bag" in table else None

    period = round(SECOND / top.rate_hz) if top and top.rate_hz > 0 else 0
    validate.check_devices(buses, motors, sensors, period, mistakes)
    validate.check_brain(table.get("brain"), tuple(groups["motors"]), tuple(groups["sensors"]), mistakes)
    for n, bus in buses.items():
        specs = [m.spec for m in motors.values() if m.bus == n] + [
            s.spec for s in sensors.values() if s.bus == n
        ]
        buses[n] = replace(bus, receive_filter=only_own(groups["buses"][n], specs))
    if bag is not None and brain is not None:
        check_bag(bag, brain.body, tuple(groups["sensors"]), mistakes)
    mistakes.check()
    if top is None or brain is None:
        raise AssertionError("a part is missing, and no mistake was told")
    return Robot(top.name, text, period, top.world, top.seed, buses, motors, sensors, brain, bag)


def devices(robot: Robot, bus: str) -> list[tuple[Plugin, Device]]:
    """The devices on a bus, in the order of the file: motors first, then sensors."""
    parts: list[Motor | Sensor] = [*robot.motors.values(), *robot.sensors.values()]
    return [(part.plugin, part.device) for part in parts if part.bus == bus]


def with_interfaces(robot: Robot, interfaces: Mapping[str, str]) -> Robot:
    """The robot with some of its buses on other interfaces: {"can0": "socketcan:vcan0"}.

    Raises ConfigError for buses that the robot does not have and for what is not INTERFACE:CHANNEL.
    """
    mistakes = Mistakes("--bus", "")
    buses = dict(robot.buses)
    for name, interface in interfaces.items():
        if name not in buses:
            mistakes.add((), unknown("bus", name, buses))
            continue
        buses[name] = replace(buses[name], interface=interface)
        check_interface(interface, buses[name].kind, (name,), mistakes)
    mistakes.check()
    return replace(robot, buses=buses)


# -- parts of the file -------------------------------------------------------------------------


def _section(table: Table, name: str, mistakes: Mistakes, known: tuple[str, ...] = ()) -> dict[str, Table]:
    """A table of tables; whatever is none of these is told and left out."""
    section = table.get(name, {})
    if not isinstance(section, dict):
        mistakes.add((name,), f"found {shown(section)}, expected tables: [{name}.NAME]")
        return {}
    for key, value in section.items():
        if known and key not in known:
            mistakes.add((name, key), unknown("key", key, known))
        elif not isinstance(value, dict):
            mistakes.add((name, key), f"found {shown(value)}, expected a table [{name}.{key}]")
    return {key: value for key, value in section.items() if isinstance(value, dict)}


def _group(table: Table, group: str, defaults: Table, mistakes: Mistakes) -> dict[str, Table]:
    """The buses, motors or sensors by name, each with the defaults of its group."""
    named = _section(table, group, mistakes)
    if not named and group != "sensors":
        mistakes.add((group,), f"missing; expected at least one table [{group}.NAME]")
    for name in named:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            mistakes.add((group, name), "expected a name of letters, digits and _ that begins with no digit")
        if name in RESERVED:
            mistakes.add((group, name), f"{name!r} has a meaning of its own; expected another name")
        if group == "sensors" and name in table.get("motors", {}):
            mistakes.add((group, name), f"a motor is called {name!r} too; expected another name")
    return {name: _merged(defaults, own) for name, own in named.items()}


def _merged(defaults: Table, own: Table) -> Table:
    """A table with what it does not say taken from the defaults, all the way down."""
    merged = dict(defaults)
    for key, value in own.items():
        below = merged.get(key)
        merged[key] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _check_top(table: Table, mistakes: Mistakes) -> None:
    positive(table, (), ("rate_hz",), mistakes)
    rate, name, seed = table.get("rate_hz"), table.get("name"), table.get("seed")
    if isinstance(rate, int | float) and 2000 < rate < inf:
        mistakes.add(("rate_hz",), f"found {shown(rate)}, expected at most 2000 steps per second")
    if isinstance(name, str) and not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        mistakes.add(("name",), f"found {shown(name)}, expected letters, digits, _ and -")
    if isinstance(seed, int) and not 0 <= seed < 2**63:
        mistakes.add(("seed",), f"found {shown(seed)}, expected an integer from 0 to 2**63 - 1")


def _check_world(world: object, mistakes: Mistakes) -> None:
    if isinstance(world, str):
        try:
            resources.find("worlds", world)
        except UserError as error:
            mistakes.add(("world",), str(error))
