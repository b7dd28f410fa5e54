"""Differences in words: between commands, events, settings, environments and ROS 2 messages.

Rules. Pure functions from two values to text. Numbers are shown with as many digits as it takes to see that
they differ, and with their unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import zip_longest

import numpy as np

from gateway.config.errors import Mistakes
from gateway.config.text import read_toml
from gateway.core.message_text import escaped, message_text
from gateway.errors import ConfigError
from protocols.messages import Message

_DIGITS = (4, 6, 9, 17)
_NOTHING = object()


def message_texts(recorded: Sequence[Message], now: Sequence[Message]) -> tuple[str, str]:
    """Return both lists of messages as text, with as many digits as it takes to tell them apart."""
    one = two = ""
    for digits in _DIGITS:
        one = "; ".join(message_text(message, digits) for message in recorded)
        two = "; ".join(message_text(message, digits) for message in now)
        if one != two:
            break
    return one, two


_SIDES = ("recorded", "now")


def settings(recorded: str, now: str, sides: tuple[str, str] = _SIDES) -> list[str]:
    """Return the keys in which two robot files differ, with both values; [] if they mean the same."""
    if recorded == now:
        return []
    files = zip(sides, (recorded, now), strict=True)
    try:
        one, two = (read_toml(text, Mistakes(side, text)) for side, text in files)
    except ConfigError as error:
        return [f"the two files differ, and one of them cannot be read: {error}"]
    return mappings(flat(one), flat(two), sides)


def mappings(
    recorded: Mapping[str, object], now: Mapping[str, object], sides: tuple[str, str] = _SIDES
) -> list[str]:
    """Return the entries in which two mappings differ, with both values, sorted by key."""
    return [
        f"{escaped(key)}: {_shown(recorded, key)} {sides[0]}, {_shown(now, key)} {sides[1]}"
        for key in sorted({**recorded, **now})
        if key not in recorded
        or key not in now
        or (type(recorded[key]), recorded[key]) != (type(now[key]), now[key])
    ]


def _shown(values: Mapping[str, object], key: str) -> str:
    return repr(values[key]) if key in values else "nothing"


def flat(table: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Return a TOML table with dotted keys; an array of tables by index, or by name where they have one."""
    found: dict[str, object] = {}
    for key, value in table.items():
        dotted = f"{prefix}{key}"
        if isinstance(value, dict):
            found |= flat(value, f"{dotted}.")
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for i, item in enumerate(value):
                found |= flat(item, f"{dotted}[{item.get('name', i)}].")
        else:
            found[dotted] = value
    return found


def first_field(recorded: object, now: object) -> str:
    """Return the first field that differs: `pose.pose.position.x: 1.25 recorded, 1.26 now`."""
    for path, one, two in _leaves(recorded, now, ""):
        same = one == two or (one != one and two != two)  # NaN equals NaN here
        if not same:
            one_text, two_text = ("nothing" if value is _NOTHING else repr(value) for value in (one, two))
            return f"{path}: {one_text} recorded, {two_text} now"
    return "no field differs: only the padding between them"


def _leaves(one: object, two: object, path: str) -> Iterator[tuple[str, object, object]]:
    if is_dataclass(one) and type(one) is type(two):
        for field in fields(one):
            if field.name != "__msgtype__":
                name = f"{path}.{field.name}" if path else field.name
                yield from _leaves(getattr(one, field.name), getattr(two, field.name), name)
    elif isinstance(one, list | np.ndarray) and isinstance(two, list | np.ndarray):
        plain = [v.tolist() if isinstance(v, np.ndarray) else v for v in (one, two)]
        for i, (a, b) in enumerate(zip_longest(*plain, fillvalue=_NOTHING)):
            yield from _leaves(a, b, f"{path}[{i}]")
    else:
        yield path, one, two
