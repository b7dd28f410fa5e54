"""Robots of two shipped files: the body of one on the motors of another.

Rules. What drives a wheel is taken from the language's file with its limits, and each two have buses of their
own; what steers stays as it is. Lidar and IMU are kept only where the motors report nothing. A pair that
ships is taken as it ships, but for its rate.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

from gateway.config import parse_robot, resources
from gateway.config.one_setting import with_setting
from gateway.config.robot_file import load_robot
from gateway.config.toml_text import shown
from gateway.core.robot import Robot
from gateway.recording.matrix import Levels
from protocols.plugin import FeedbackKind

Table: TypeAlias = dict[str, Any]
RATE = 100
"""Hz: half of what ships, and half as long to judge"""
OWN = ("name", "defaults", "rate_hz", "buses", "motors", "sensors")
"""Keys that are not the body's"""
INNER = ("limits", "options", "settings", "loop")
STEERS = "steer"
"""In the name of each motor that does"""


def robot_of(levels: Levels, language: str, body: str) -> Robot:
    """Return the robot that is to be recorded. Raises ConfigError where there is none."""
    ships = levels.ships.get(body, {}).get(language)
    if ships is not None:
        return parse_robot(with_setting(load_robot(ships).text, "rate_hz", RATE), ships)
    file = resources.find("robots", levels.bodies[body])
    motor = next(iter(load_robot(levels.languages[language]).motors.values()))
    blind = motor.spec.feedback is FeedbackKind.NONE
    tables = _read(levels.bodies[body]), _read(levels.languages[language])
    text = "\n".join(_lines(_combined(*tables, senses=blind)))
    return parse_robot(f'name = "{body}_{language}"\n{text}\n', f"{body}_{language}", file=file)


def _read(name: str) -> Table:
    return tomllib.loads(resources.find("robots", name).read_text("utf-8"))


def _combined(body: Table, language: Table, *, senses: bool) -> Table:
    """Return the body's table on the language's motors, and with its sensors if it `senses`."""
    motors, donors = _motors(body), [*_motors(language).values()][:2]
    buses: Table = {}
    for at, name in enumerate(name for name in motors if STEERS not in name):
        donor, pair = donors[at % 2], f"_{at // 2 + 1}"
        motors[name] = donor | {"bus": donor["bus"] + pair}
        buses[donor["bus"] + pair] = language["buses"][donor["bus"]]
    sensors = body["sensors"] if senses else {}
    kept = {one["bus"] for one in (*motors.values(), *sensors.values())}
    buses |= {name: bus for name, bus in body["buses"].items() if name in kept}
    rest = {key: one for key, one in body.items() if key not in OWN}
    return {"rate_hz": RATE} | rest | {"buses": buses, "motors": motors, "sensors": sensors}


def _motors(table: Table) -> Table:
    """Return the motors of a file, each with what is the default of all."""
    common = table.get("defaults", {}).get("motors", {})
    found: Table = {}
    for name, own in table["motors"].items():
        inner = {key: common.get(key, {}) | own.get(key, {}) for key in INNER if key in {**common, **own}}
        found[name] = {**common, **own, **inner}
    return found


def _lines(table: Table, at: str = "") -> Iterator[str]:
    """Yield a table as TOML, and the tables in it."""
    if at:
        yield f"[{at}]"
    yield from (f"{key} = {shown(one)}" for key, one in table.items() if not isinstance(one, dict))
    for key, one in table.items():
        if isinstance(one, dict):
            yield from _lines(one, f"{at}.{key}" if at else key)


def first_motor(robot: Robot, language: str) -> str:
    """Return the first motor of a language: what has the bad day."""
    return next(name for name, motor in robot.motors.items() if motor.plugin.name == language)


def file_of(folder: Path, language: str, body: str, bad_day: str) -> Path:
    """Return the file of a recording."""
    return folder / f"{language}_{body}_{bad_day}.mcap"
