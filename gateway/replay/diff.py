"""Two of a kind side by side, in words: commands and events, settings, machines, messages.

Rules. Pure functions from two values to sentences. Numbers are shown with as many digits as it takes to see
that they differ, and with their unit.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from itertools import zip_longest

import numpy as np

from protocols.messages import Message

UNITS = {
    "position": "rad",
    "velocity": "rad/s",
    "torque": "N·m",
    "stiffness": "N·m/rad",
    "damping": "N·m·s/rad",
    "current": "A",
    "voltage": "V",
    "temperature": "°C",
    "linear": "m/s",
    "angular": "rad/s",
    "x": "m",
    "y": "m",
    "yaw": "rad",
    "angular_velocity": "rad/s",
    "linear_acceleration": "m/s²",
}
_NAMES = ("motor", "sensor", "bus", "name")
_DIGITS = (4, 6, 9, 17)
_NOTHING = object()
_LIST = 8
"""Values of a long tuple that are shown."""


# -- words -------------------------------------------------------------------------------------


def say(word: Message, digits: int = 4) -> str:
    """`left: Velocity 3.142 rad/s`: whom it is about, its kind, and the fields that say something."""
    names = [f.name for f in fields(word)]
    own = next((name for name in _NAMES if name in names), None)
    kind = type(word).__name__
    parts = []
    for field in fields(word):
        value = getattr(word, field.name)
        if (
            field.name in (own, "t")
            or value is None
            or (field.default is not MISSING and value == field.default)
        ):
            continue
        label = "" if field.name == kind.lower() else f"{field.name} "
        unit = f" {UNITS[field.name]}" if field.name in UNITS else ""
        parts.append(f"{label}{_value(value, digits)}{unit}")
    about = f"{getattr(word, own)}: " if own and getattr(word, own) else ""
    return f"{about}{kind} {', '.join(parts)}".rstrip()


def _value(value: object, digits: int) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    if isinstance(value, tuple):
        more = f", … {len(value)} in all" if len(value) > _LIST else ""
        return f"({', '.join(_value(v, digits) for v in value[:_LIST])}{more})"
    return str(value)


def contrast(recorded: Sequence[Message], now: Sequence[Message]) -> tuple[str, str]:
    """Both lists of words, with as many digits as it takes to tell them apart."""
    one = two = ""
    for digits in _DIGITS:
        one = "; ".join(say(word, digits) for word in recorded)
        two = "; ".join(say(word, digits) for word in now)
        if one != two:
            break
    return one, two


# -- settings and machines ---------------------------------------------------------------------


def settings(recorded: str, now: str) -> list[str]:
    """Which keys of two robot files differ, each with both values; [] if the files mean the same."""
    if recorded == now:
        return []
    try:
        return mappings(_flat(tomllib.loads(recorded)), _flat(tomllib.loads(now)))
    except tomllib.TOMLDecodeError as error:
        return [f"the two files differ, and one of them cannot be read: {error}"]


def mappings(recorded: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """Which entries of two mappings differ, each with both values, sorted by key."""
    return [
        f"{key}: {_shown(recorded, key)} recorded, {_shown(now, key)} now"
        for key in sorted({**recorded, **now})
        if key not in recorded
        or key not in now
        or (type(recorded[key]), recorded[key]) != (type(now[key]), now[key])
    ]


def _shown(values: Mapping[str, object], key: str) -> str:
    return repr(values[key]) if key in values else "nothing"


def _flat(table: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """A TOML table as dotted keys; an array of tables by place, or by name where its tables have one."""
    flat: dict[str, object] = {}
    for key, value in table.items():
        dotted = f"{prefix}{key}"
        if isinstance(value, dict):
            flat |= _flat(value, f"{dotted}.")
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            for i, item in enumerate(value):
                flat |= _flat(item, f"{dotted}[{item.get('name', i)}].")
        else:
            flat[dotted] = value
    return flat


# -- messages ----------------------------------------------------------------------------------


def first_field(recorded: object, now: object) -> str:
    """The first field in which two messages differ: `pose.pose.position.x: 1.25 recorded, 1.26 now`."""
    for path, one, two in _leaves(recorded, now, ""):
        same = one == two or (one != one and two != two)  # NaN is a value like any other here
        if not same:
            return f"{path}: {_leaf(one)} recorded, {_leaf(two)} now"
    return "no field differs: only the bytes between them"


def _leaf(value: object) -> str:
    return "nothing" if value is _NOTHING else repr(value)


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
