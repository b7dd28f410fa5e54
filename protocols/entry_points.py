"""What installed distributions offer by entry points: protocols, kinds of sensors, bodies, skills, brains.

Rules. Nothing is imported. A distribution whose entry points cannot be read hides no other's, and is named.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, distributions, entry_points
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

OURS = "motor-gateway"
"""The distribution that this project is."""


class Unreadable(NamedTuple):
    """A distribution whose entry points cannot be read."""

    distribution: str
    reason: str


class Offered(NamedTuple):
    """The entry points of a group."""

    points: tuple[EntryPoint, ...]
    """By name, and those of one name by their distribution"""
    unreadable: tuple[Unreadable, ...]
    """Which distributions may offer more"""


def offered(group: str) -> Offered:
    """Return the entry points of a group. Takes some ten milliseconds where something was installed since."""
    return _search(group, tuple(map(_state, sys.path)))


def _state(entry: str) -> tuple[str, int]:
    """Return a folder on the path, and when something in it was last installed or removed; 0 if never."""
    try:
        return entry, Path(entry or ".").stat().st_mtime_ns
    except OSError:
        return entry, 0


@lru_cache(maxsize=32)
def _search(group: str, _path: tuple[tuple[str, int], ...]) -> Offered:
    unreadable: list[Unreadable] = []
    try:
        points = list(entry_points(group=group))
    except Exception:  # noqa: BLE001 -- one ill-formed file spoils the call for all: so one by one
        points, unreadable = _one_by_one(group)
    points.sort(key=lambda point: point.name)
    ordered: list[EntryPoint] = []
    for _, same in groupby(points, key=lambda point: point.name):
        alike = list(same)  # an owner's metadata have to be parsed: only where two have one name
        ordered += sorted(alike, key=owner) if len(alike) > 1 else alike
    return Offered(tuple(ordered), tuple(unreadable))


def _one_by_one(group: str) -> tuple[list[EntryPoint], list[Unreadable]]:
    points: list[EntryPoint] = []
    unreadable: list[Unreadable] = []
    seen = set[str]()
    for distribution in distributions():
        name = _name(distribution)
        try:
            own = distribution.entry_points.select(group=group)
        except Exception as error:  # noqa: BLE001 -- whatever is wrong with it
            unreadable.append(Unreadable(name, f"its entry points cannot be read: {error}"))
            continue
        points += own if name not in seen else ()
        seen.add(name)
    return points, unreadable


@lru_cache(maxsize=256)
def _name(distribution: Distribution) -> str:
    return distribution.name or "?"


def owner(point: EntryPoint) -> str:
    """Return the distribution that an entry point belongs to."""
    return _name(point.dist) if point.dist else "?"


def is_ours(point: EntryPoint) -> bool:
    """Return whether it belongs to this project's distribution."""
    return owner(point) == OURS


def version(point: EntryPoint) -> str:
    """Return the version of its distribution."""
    return point.dist.version if point.dist else "?"
