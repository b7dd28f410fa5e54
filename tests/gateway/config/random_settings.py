"""A robot file with some random numbers, and random `set`s: refused in words, or the robot runs."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from math import isfinite
from random import Random
from typing import Any

from brain.settings import AT_RUN_TIME, keys
from gateway.config import parse_robot, resources
from gateway.core.robot import Robot
from gateway.errors import ConfigError
from protocols.messages import Goal, Position, Set
from tests.gateway.rig import Rig, notes_in

RUN = 0.5
"""s of the robot's time, of which the first half waits for its sources."""
OTHERS = ("cia402", "damiao", "mixed", "moteus", "zlac8015d")
ROBOTS = ("bench", "diffbot", *(f"diffbot_{protocol}" for protocol in OTHERS))
RUN_TIME = {f"brain.{key}" for _, _, names in AT_RUN_TIME for key in names.split()}


@cache
def _robot(name: str) -> tuple[Robot, dict[str, object]]:
    """Return a shipped robot, and its file as dotted keys."""
    text = resources.find("robots", name).read_text(encoding="utf-8")
    return parse_robot(text), dict(_flat(tomllib.loads(text)))


def _flat(table: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _numbers(name: str) -> dict[str, float]:
    """Return every number that the file of a robot has, or could have in its brain, options and settings."""
    robot, file = _robot(name)
    found = {key: value for key, value in file.items() if isinstance(value, int | float)}
    found |= {f"brain.{key}": value for key, value in keys(robot.brain)}
    for motor in robot.motors.values() if name != "bench" else ():
        found |= {
            f"motors.{motor.name}.{part}.{field.name}": number
            for part in ("options", "settings")
            for field in fields(getattr(motor.device, part))
            if isinstance(number := getattr(getattr(motor.device, part), field.name), int | float)
            and isfinite(number)
        }
    return found


def value(random: Random, usual: float) -> float:
    """Return a number near the usual one, or of any size, sign and type."""
    size = float(f"{random.uniform(1, 10)}e{random.randint(-324, 307)}")
    near = type(usual)(usual * 10.0 ** random.uniform(-1.0, 1.0))
    return random.choice(
        (
            *(near, near, near, near, round(near), round(near)),
            random.choice((0, 0.0, -0.0, 1, 5e-324, -usual, 1e308, -1e308)),
            random.randint(-(2**63), 2**63 - 1) >> random.randint(0, 62),
            random.choice((size, -size)),
        )
    )


def run(seed: str) -> str:
    """Run one case; return "ran", or why the file is refused. Raises whatever the robot raises."""
    random = Random(seed)
    name = random.choice(ROBOTS)
    usual = _numbers(name)
    file = dict(_robot(name)[1])
    for key in random.sample(sorted(usual), random.randint(1, 3)):
        file[key] = value(random, usual[key])
    text = "\n".join(f"{key} = {json.dumps(one)}" for key, one in file.items())
    try:
        rig = Rig(text)
    except ConfigError as error:
        return f"refused: {error}"
    rig.run(RUN / 2)
    settable = {key: number for key, number in usual.items() if ".limits." in key or key in RUN_TIME}
    asked = [
        Set(
            key.removeprefix("motors.").replace("defaults.motors.", "left."),
            float(value(random, settable[key])),
        )
        for key in random.sample(sorted(settable), 3)
    ]
    task = Position("left", 5.0) if name == "bench" else Goal(1.0, 0.5)
    ticks = rig.run(RUN / 2, task, *asked)
    assert sum(" = " in note.text or "refused" in note.text for note in notes_in(ticks, "operator")) == 3
    rig.leave()
    return "ran"
