"""Every number that a file or `set` can fill has a lower and an upper bound, also one added tomorrow."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import pytest

from brain.bodies.differential import Differential
from brain.settings import AT_RUN_TIME, BrainSettings, changed, keys
from gateway.config.bodies import load_body, names
from gateway.config.errors import Mistakes
from gateway.config.robot_file import TopKeys
from gateway.config.schema import build
from gateway.config.sections import BusKeys, ConnectionKeys, SensorKeys
from gateway.core.joint import JointSettings
from gateway.sim.files import BenchFile, SceneFile
from gateway.sim.load import PLANTS
from protocols.bounds import keys as keys_in_file
from protocols.plugin import load_all

ROBOTS = Path(__file__).resolve().parents[3] / "fixtures/robots"
PLUGINS = load_all()[0]
ROOTS = (
    *(
        BrainSettings,
        TopKeys,
        BusKeys,
        ConnectionKeys,
        SensorKeys,
        JointSettings,
        BenchFile,
        SceneFile,
        *PLANTS.values(),
    ),
    *(kind for plugin in PLUGINS for kind in (plugin.options, plugin.settings)),
    *map(load_body, names()),
)
UNBOUNDED = {
    "protocols.j1939_valve.options.Options.name",
    "protocols.plain.twin.Settings.serial",
    "protocols.vesc_uart.options.Settings.serial_number",
}
"""Identifiers and names, of 64 and of 96 bits: they may be huge."""


def _examples() -> dict[str, dict[str, Any]]:
    """Return a table of each dataclass that is checked only if complete: bodies by robot files."""
    files = [tomllib.loads(path.read_text()) for path in sorted(ROBOTS.glob("*.toml"))]
    brains = [file["brain"] for file in files if "limbs" not in file]
    zone = {"corners": [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], "kind": "slow", "speed": 1.0}
    bodies = {load_body(brain["body"]).__name__: brain[brain["body"]] for brain in brains}
    return {**bodies, "Zone": zone}


EXAMPLES = _examples()


def dataclasses_in(hint: Any) -> Iterator[type]:
    """Yield each dataclass that a type hint contains, and those in its fields."""
    if isinstance(hint, type) and is_dataclass(hint):
        yield hint
        for one in get_type_hints(hint).values():
            yield from dataclasses_in(one)
    for one in get_args(hint):
        yield from dataclasses_in(one)


def numbers_in(hint: Any, huge: float) -> Iterator[object]:
    """Yield a huge value of each number that a hint permits, as it stands in a file."""
    if get_origin(hint) is Annotated:
        yield from numbers_in(get_args(hint)[0], huge)
    elif get_origin(hint) is tuple:
        args = [one for one in get_args(hint) if one is not Ellipsis]
        for value in numbers_in(args[0], huge):
            yield [value] * len(args)
    elif hint in (float, int):
        yield huge if hint is float else int(huge / 1e300 * 2**62)
    elif get_origin(hint) is not dict and not isinstance(hint, type):
        for one in get_args(hint):
            yield from numbers_in(one, huge) if one is not NoneType else ()


def unbounded(kind: type) -> list[str]:
    """Return the numbers of a dataclass that accept a huge value, of either sign."""
    found = []
    hints = get_type_hints(kind, include_extras=True)
    for key, field in keys_in_file(kind).items():
        for huge in (1e300, -1e300):
            for value in numbers_in(hints[field.name], huge):
                mistakes = Mistakes("f", "")
                build(kind, {**EXAMPLES.get(kind.__name__, {}), key: value}, (), mistakes)
                if not any(one.key == key for one in mistakes.error().mistakes):
                    found.append(f"{kind.__module__}.{kind.__qualname__}.{field.name}")
    return found


KINDS = list(dict.fromkeys(kind for root in ROOTS for kind in dataclasses_in(root)))


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_every_number_in_a_file_has_bounds_on_both_sides(kind: type) -> None:
    assert set(unbounded(kind)) <= UNBOUNDED


@dataclass
class Careless:
    """Has a number without bounds."""

    name: str = ""
    gain: float = 1.0


def test_a_number_without_bounds_is_found() -> None:
    assert len(KINDS) > 40
    assert unbounded(Careless) == [f"{__name__}.Careless.gain"] * 2


BASE = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.25,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
    max_wheel_speed=20.0,
    max_lateral=0.5,
)
SETTINGS = BrainSettings(BASE)
KEYS = dict(keys(SETTINGS))


@pytest.mark.parametrize("value", [1e300, -1e300, 1e308, -1e308])
def test_set_keeps_the_bounds(value: float) -> None:
    accepted = [key for key in KEYS if not changed(SETTINGS, key, value, SETTINGS)[1]]
    assert accepted == []


def test_set_never_widens_what_the_file_allows_and_may_go_back() -> None:
    directions = {
        key.replace("body.", f"{BASE.kind}."): direction
        for direction, _, names in AT_RUN_TIME
        for key in names.split()
    }
    assert directions.keys() <= KEYS.keys()
    for key, in_file in KEYS.items():
        direction = directions.get(key)
        less, more = (
            changed(SETTINGS, key, value, SETTINGS)
            for value in ((0, 1) if in_file in (0, 1) else (in_file * 0.97, in_file * 1.03))
        )
        if direction in (None, "at most"):
            assert more[0] == SETTINGS, key
        if direction in (None, "at least"):
            assert less[0] == SETTINGS, key
        for after, _ in (less, more):
            assert changed(after, key, in_file, SETTINGS)[0] == SETTINGS, key
