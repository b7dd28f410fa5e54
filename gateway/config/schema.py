"""A TOML file → tables → frozen dataclasses, by their type hints alone: all mistakes are collected.

Rules. Strict: "5" is not 5, true is not 1, 1.5 is no integer, a number must be finite and an integer fit into
64 bits; an integer may stand for a float. A key without a field is a mistake. A field annotated `Nanos` is
written in milliseconds, under its name with `_ms`. A hint may be annotated with `Bounds` and with a unit (a
string). A ValueError of `__post_init__` ("; " between several texts) is reported at the field that it names.
So a new setting in any of the dataclasses needs no change here.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from math import isfinite
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from gateway.config.errors import INT64, Key, Mistakes, shown, unknown
from gateway.core.bounds import Bounds
from protocols.messages import MILLISECOND
from protocols.suggest import did_you_mean

T = TypeVar("T")
_MAX_DEPTH = 32
"""Tables and arrays inside each other; valid files need 5."""
_INVALID = object()
"""Instead of a value that does not fit its hint."""
_STAND_INS: dict[object, object] = {float: 1.0, int: 1, str: "x", bool: False}
"""Instead of a required value that is missing or invalid, for `__post_init__` to check the other fields."""


def read_toml(text: str, mistakes: Mistakes) -> dict[str, Any]:
    """Return the file as a table. Raises ConfigError if it is not TOML or nested too deeply."""
    try:
        table = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        place = re.search(r"line (\d+)", str(error))
        mistakes.add((), f"not TOML: {error}", int(place[1]) if place else 0)
        raise mistakes.error() from error
    except RecursionError as error:
        mistakes.add((), "tables or arrays are nested too deeply")
        raise mistakes.error() from error
    level: list[object] = [table]
    for _ in range(_MAX_DEPTH):
        level = [one for inner in level for one in _items(inner)]
    if level:
        mistakes.add((), "tables or arrays are nested too deeply")
        raise mistakes.error()
    return table


def _items(value: object) -> list[object]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


def build(kind: type[T], table: object, at: Key, mistakes: Mistakes, also: Sequence[str] = ()) -> T | None:
    """Build the dataclass `kind` from a table of the file; None if mistakes were added.

    `also` are further keys of this table, which belong to another dataclass.
    """
    if not isinstance(table, dict):
        mistakes.add(at, f"found {shown(table)}, expected a table")
        return None
    try:
        return cast(T | None, _build(kind, table, at, mistakes, also))
    except (TypeError, NameError) as error:
        mistakes.add(at, f"{kind.__module__}.{kind.__qualname__} cannot be filled from a file: {error}")
        return None


def keys(kind: type) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass by the key under which each is written in the file."""
    return {f"{one.name}_ms" if _is_time(one) else one.name: one for one in fields(kind) if one.init}


def _is_time(field: Field[Any]) -> bool:
    return "Nanos" in str(field.type)


def _build(
    kind: type[Any], table: dict[str, Any], at: Key, mistakes: Mistakes, also: Sequence[str]
) -> object:
    own, hints = keys(kind), get_type_hints(kind, include_extras=True)
    values: dict[str, object] = {}
    wrong: set[str] = set()
    for key, field in own.items():
        hint = hints[field.name]
        if _is_time(field):
            hint = Annotated[float, "milliseconds", *getattr(hint, "__metadata__", ())]
        if key in table:
            value = _field_value(hint, table[key], (*at, key), mistakes)
            if value is not _INVALID and _is_time(field):
                value = _nanos(table[key], (*at, key), mistakes)
        elif field.default is MISSING and field.default_factory is MISSING:
            mistakes.add((*at, key), f"missing; expected {wanted(hint)}")
            value = _INVALID
        else:
            continue
        if value is _INVALID:
            wrong.add(field.name)
        else:
            values[field.name] = value
    strange = [key for key in table if key not in own and key not in also]
    for key in strange:
        if f"{key}_ms" in own:
            mistakes.add((*at, key), f"unknown key; did you mean '{key}_ms' (milliseconds)?")
        else:
            mistakes.add((*at, key), unknown("key", key, [*own, *also]))
    made = _construct(kind, values, wrong, at, mistakes)
    return None if wrong or strange else made


def _nanos(milliseconds: float, at: Key, mistakes: Mistakes) -> object:
    """Return a time in nanoseconds, or _INVALID if it does not fit into 64 bits."""
    if abs(milliseconds) < INT64.stop / MILLISECOND:
        return round(milliseconds * MILLISECOND)
    mistakes.add(at, f"found {shown(milliseconds)}, expected a time of less than 292 years")
    return _INVALID


def _construct(
    kind: type[Any], values: dict[str, object], wrong: set[str], at: Key, mistakes: Mistakes
) -> object:
    """Call the dataclass, and report what its `__post_init__` objects to.

    It raises at the first invalid field. That field is added to `wrong` and gets its default or a stand-in,
    and the next call shows the next one.
    """
    own = {field.name: (key, field) for key, field in keys(kind).items()}
    hints = get_type_hints(kind)
    while True:
        for name in wrong:
            field = own[name][1]
            values.pop(name, None)
            if field.default is MISSING and field.default_factory is MISSING:
                if _bare(hints[name]) not in _STAND_INS:
                    return None
                values[name] = _STAND_INS[_bare(hints[name])]
        try:
            return kind(**values)
        except (ValueError, ArithmeticError) as error:
            before = len(wrong)
            for sentence in str(error).split("; "):
                name = next((word for word in re.findall(r"\w+", sentence) if word in own), "")
                if name not in wrong:
                    mistakes.add((*at, own[name][0]) if name else at, sentence)
                    wrong.add(name)
            if "" in wrong or len(wrong) == before:
                return None


def _field_value(hint: object, value: object, at: Key, mistakes: Mistakes) -> object:
    """Return the value that a field gets, or _INVALID with its mistakes added."""
    bare = _bare(hint)
    if isinstance(bare, type) and is_dataclass(bare) and isinstance(value, dict):
        made = _build(bare, value, at, mistakes, ())
        return _INVALID if made is None else made
    if get_origin(bare) is dict and isinstance(value, dict):
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
        made = _converted(args[0], value)
        bounds = (one for one in args[1:] if isinstance(one, Bounds))
        return made if made is _INVALID or all(one.admit(cast(float, made)) for one in bounds) else _INVALID
    if origin in (Union, UnionType):
        tried = (_converted(one, value) for one in args if one is not NoneType)
        return next((made for made in tried if made is not _INVALID), _INVALID)
    if origin is tuple:
        return _converted_array(args, value)
    if origin is dict or is_dataclass(hint):
        fits = isinstance(value, dict)
        return _field_value(hint, value, (), Mistakes("", "")) if fits else _INVALID
    if origin is Literal:
        return value if any(type(value) is type(one) and value == one for one in args) else _INVALID
    if isinstance(hint, type) and issubclass(hint, Enum):
        return next((one for one in hint if type(value) is type(one.value) and value == one.value), _INVALID)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        fits = isfinite(value) if isinstance(value, float) else value in INT64
        return float(value) if fits else _INVALID
    if hint is Any or (type(value) is hint and (hint is not int or value in INT64)):
        return value
    return _INVALID


def _converted_array(args: tuple[Any, ...], value: object) -> object:
    """Return a tuple with these arguments of `tuple[...]` from an array of the file."""
    if not isinstance(value, list):
        return _INVALID
    hints = args[:1] * len(value) if Ellipsis in args else args
    made = tuple(map(_converted, hints, value))
    fits = len(hints) == len(value) and not any(one is _INVALID for one in made)
    return made if fits else _INVALID


def _bare(hint: object) -> object:
    """Return a hint without Annotated and without None."""
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        rest = [one for one in get_args(hint) if one is not NoneType]
        return _bare(rest[0]) if len(rest) == 1 else hint
    return hint


_SIMPLE = {float: "a finite number", int: "an integer", str: "a string", bool: "true or false"}


def wanted(hint: object) -> str:
    """Return what a field takes: "a finite number", "'idle' or 'hold'", "an array of 2 finite numbers".

    Raises TypeError for a hint that no file can fill.
    """
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        units = [f" of {one}" for one in args[1:] if isinstance(one, str)]
        bounds = [f" {one}" for one in args[1:] if isinstance(one, Bounds)]
        return "".join([wanted(args[0]), *units, *bounds])
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
