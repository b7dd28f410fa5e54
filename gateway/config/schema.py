"""A TOML file → tables → frozen dataclasses, by their type hints alone: all mistakes are collected.

Rules. Strict: "5" is not 5, true is not 1, 1.5 is no integer, a number must be finite and an integer fit into
64 bits; an integer may stand for a float. A key without a field is a mistake. A `Duration` is written in
milliseconds, under its name with `_ms`. A number is within its `Bounds`. What `__post_init__` objects to is
reported at the field that its `Invalid` names; any other ValueError of it at the table. So a new setting in
any of the dataclasses needs no change here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, is_dataclass
from enum import Enum
from math import inf, isfinite
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

from gateway.config.errors import Key, Mistakes, is_int64, shown, unknown
from protocols.bounds import Bounds, Invalid, bounds_of, hints, is_duration, keys
from protocols.messages import MILLISECOND
from protocols.suggest import did_you_mean

T = TypeVar("T")


MAX_NAMED = 500
"""Keys of a table whose keys are names: walls, shafts."""
NOTHING: Mapping[str, object] = MappingProxyType({})
_INVALID = object()
"""Instead of a value that does not fit its hint."""
_STAND_INS: dict[object, Any] = {float: 1.0, int: 1, str: "x", bool: False}
"""Instead of a required value that is missing or invalid, for `__post_init__` to check the other fields."""


def build(
    kind: type[T],
    table: object,
    at: Key,
    mistakes: Mistakes,
    also: Sequence[str] = (),
    given: Mapping[str, object] = NOTHING,
) -> T | None:
    """Build the dataclass `kind` from a table of the file; None if mistakes were added.

    `also` are further keys of this table, which belong to another dataclass. `given` are values of fields
    that are not in the file.
    """
    if not isinstance(table, dict):
        mistakes.add(at, f"found {shown(table)}, expected a table")
        return None
    try:
        return cast(T | None, _build(kind, table, at, mistakes, also, given))
    except (TypeError, NameError) as error:
        mistakes.add(at, f"{kind.__module__}.{kind.__qualname__} cannot be filled from a file: {error}")
        return None


def _is_required(field: Field[Any]) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _build(
    kind: type[Any],
    table: dict[str, Any],
    at: Key,
    mistakes: Mistakes,
    also: Sequence[str] = (),
    given: Mapping[str, object] = NOTHING,
) -> object:
    own = {key: field for key, field in keys(kind).items() if field.name not in given}
    values: dict[str, object] = dict(given)
    for key, field in own.items():
        hint = hints(kind)[field.name]
        if key in table:
            values[field.name] = _field_value(hint, table[key], (*at, key), mistakes)
        elif _is_required(field):
            mistakes.add((*at, key), f"missing; expected {wanted(hint)}")
            values[field.name] = _INVALID
    strange = [key for key in table if key not in own and key not in also]
    for key in strange:
        if mistakes.full:
            break
        if f"{key}_ms" in own:
            mistakes.add((*at, key), f"unknown key; did you mean '{key}_ms' (milliseconds)?")
        else:
            mistakes.add((*at, key), unknown("key", key, [*own, *also]))
    made = _construct(kind, values, at, mistakes)
    return None if strange else made


def _construct(kind: type[Any], values: dict[str, object], at: Key, mistakes: Mistakes) -> object:
    """Call the dataclass, and report what its `__post_init__` objects to; None if a value is invalid.

    A field that is invalid is then given its default or a stand-in, and the next call may show the next one.
    """
    own = {field.name: (key, field) for key, field in keys(kind).items()}
    wrong = {name for name, value in values.items() if value is _INVALID}
    while True:
        for name in wrong:
            values.pop(name, None)
            if _is_required(own[name][1]):
                if (stand_in := _stand_in(hints(kind)[name])) is None:
                    return None
                values[name] = stand_in
        try:
            made: object = kind(**values)
        except Invalid as error:
            found = [(key.split("."), text) for key, text in error.wrong]
            more = [(name, below, text) for (name, *below), text in found if name not in wrong]
            for name, below, text in more:
                mistakes.add((*at, *filter(None, (own[name][0] if name in own else name, *below))), text)
            wrong |= {name for name, *_ in more}
            if not more or not wrong <= own.keys():
                return None
        except (ValueError, ArithmeticError) as error:
            mistakes.add(at, str(error))
            return None
        else:
            return None if wrong else made


def _stand_in(hint: object) -> object:
    """Return a value for a hint, within its bounds; None if there is none."""
    value, bounds = _STAND_INS.get(_bare(hint)), bounds_of(hint)
    return type(value)(min(max(value, bounds.least), bounds.most)) if bounds and value is not None else value


def _field_value(hint: object, value: object, at: Key, mistakes: Mistakes) -> object:
    """Return the value that a field gets, or _INVALID with its mistakes added."""
    bare = _bare(hint)
    if isinstance(bare, type) and is_dataclass(bare) and isinstance(value, dict):
        made = _build(bare, value, at, mistakes)
        return _INVALID if made is None else made
    if get_origin(bare) is dict and isinstance(value, dict):
        if len(value) > MAX_NAMED:
            mistakes.add(at, f"found {len(value)} keys, expected at most {MAX_NAMED}")
            return _INVALID
        inner = get_args(bare)[1]
        made = {key: _field_value(inner, one, (*at, key), mistakes) for key, one in value.items()}
        return _INVALID if any(one is _INVALID for one in made.values()) else made
    made = _converted(hint, value)
    if made is _INVALID:
        names = [one for one in get_args(bare) if isinstance(one, str)]
        mistakes.add(at, f"found {shown(value)}, expected {wanted(hint)}{did_you_mean(value, names)}")
    return made


def _converted(hint: object, value: object) -> object:
    """Return the value as its hint wants it, or _INVALID. Types must be the very same: a bool is no int."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        made = _nanoseconds(value) if is_duration(hint) else _converted(args[0], value)
        bounds = (one for one in args[1:] if isinstance(one, Bounds))
        return made if made is _INVALID or all(one.admit(cast(float, value)) for one in bounds) else _INVALID
    if origin in (Union, UnionType):
        tried = (_converted(one, value) for one in args if one is not NoneType)
        return next((made for made in tried if made is not _INVALID), _INVALID)
    if origin is tuple:
        items = value if isinstance(value, list) else [_INVALID]
        each = args[:1] * len(items) if Ellipsis in args else args
        made_items = tuple(map(_converted, each, items))
        return _INVALID if _INVALID in made_items or len(each) != len(items) else made_items
    if origin is dict or is_dataclass(hint):
        fits = isinstance(value, dict)
        return _field_value(hint, value, (), Mistakes("", "")) if fits else _INVALID
    if origin is Literal:
        return value if any(type(value) is type(one) and value == one for one in args) else _INVALID
    if isinstance(hint, type) and issubclass(hint, Enum):
        return next((one for one in hint if type(value) is type(one.value) and value == one.value), _INVALID)
    if hint is float and type(value) is int:
        return float(value) if is_int64(value) else _INVALID
    if hint is float and type(value) is float:
        return value if isfinite(value) else _INVALID
    if hint is Any or (type(value) is hint and (not isinstance(value, int) or is_int64(value))):
        return value
    return _INVALID


def _nanoseconds(value: object) -> object:
    """Return the time of a number of milliseconds, or _INVALID."""
    number = _converted(float, value)
    nanos = number * MILLISECOND if isinstance(number, float) else inf
    return round(nanos) if isfinite(nanos) and is_int64(round(nanos)) else _INVALID


def _bare(hint: object) -> object:
    """Return a hint without Annotated and without None."""
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        rest = [one for one in get_args(hint) if one is not NoneType]
        return _bare(rest[0]) if len(rest) == 1 else hint
    return hint


_SIMPLE = {
    float: "a finite number",
    int: "an integer",
    str: "a string",
    bool: "true or false",
}


def wanted(hint: object) -> str:
    """Return what a field takes: "a finite number", "'idle' or 'hold'", "an array of 2 finite numbers".

    Raises TypeError for a hint that no file can fill.
    """
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        what = "a finite number of milliseconds" if is_duration(hint) else wanted(args[0])
        return "".join([what, *(f" {one}" for one in args[1:] if isinstance(one, Bounds))])
    if hint in _SIMPLE:
        return _SIMPLE[hint]
    if origin is Literal:
        return " or ".join(repr(one) for one in args)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return " or ".join(repr(one.value) for one in hint)
    if origin in (Union, UnionType):
        return " or ".join(wanted(one) for one in args if one is not NoneType)
    if origin is tuple:
        each = re.sub("^an? ", "", wanted(args[0]))
        items = re.sub(r"\b(number|integer|string|array|table)\b", r"\1s", each, count=1)
        return f"an array of {items}" if Ellipsis in args else f"an array of {len(args)} {items}"
    if origin is dict or is_dataclass(hint):
        return "a table"
    raise TypeError(f"no value of a file is a {hint!r}")
