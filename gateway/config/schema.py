"""A TOML file → tables → frozen dataclasses, by their type hints alone: all mistakes are collected.

Rules. Strict: "5" is not 5, true is not 1, 1.5 is no integer, a number must be finite and an integer fit into
64 bits; an integer may stand for a float. A key without a field is a mistake. A field annotated `Nanos` is
written in milliseconds, under its name with `_ms`. A hint may be annotated with `Bounds` and with a unit (a
string). A ValueError of `__post_init__` ("; " between several texts) is reported at the field that it names.
So a new setting in any of the dataclasses needs no change here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from math import isfinite
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from gateway.config.errors import Key, Mistakes, is_int64, shown, unknown
from gateway.core.bounds import Bounds
from protocols.messages import MILLISECOND
from protocols.suggest import did_you_mean

T = TypeVar("T")


class _Milliseconds:
    """The hint of a time: a number of milliseconds in the file, which becomes nanoseconds."""


MAX_NAMED = 500
"""Keys of a table whose keys are names: walls, shafts."""
NOTHING: Mapping[str, object] = MappingProxyType({})
_INVALID = object()
"""Instead of a value that does not fit its hint."""
_STAND_INS: dict[object, object] = {float: 1.0, int: 1, str: "x", bool: False}
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


def keys(kind: type) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass by the key under which each is written in the file."""
    return {f"{one.name}_ms" if _is_time(one) else one.name: one for one in fields(kind) if one.init}


def _is_time(field: Field[Any]) -> bool:
    return "Nanos" in str(field.type)


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
    hints = get_type_hints(kind, include_extras=True)
    values: dict[str, object] = dict(given)
    for key, field in own.items():
        hint = hints[field.name]
        if _is_time(field):
            bounds = (one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Bounds))
            in_ms = (Bounds(one.least / MILLISECOND, one.most / MILLISECOND) for one in bounds)
            hint = Annotated[_Milliseconds, "milliseconds", *in_ms]
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

    It raises at the first invalid field. That field is then given its default or a stand-in, and the next
    call shows the next one.
    """
    own = {field.name: (key, field) for key, field in keys(kind).items()}
    hints = get_type_hints(kind)
    wrong = {name for name, value in values.items() if value is _INVALID}
    while True:
        for name in wrong:
            values.pop(name, None)
            if _is_required(own[name][1]):
                if _bare(hints[name]) not in _STAND_INS:
                    return None
                values[name] = _STAND_INS[_bare(hints[name])]
        try:
            made: object = kind(**values)
        except (ValueError, ArithmeticError) as error:
            before = len(wrong)
            for sentence in str(error).split("; "):
                name = next((one for one in re.findall(r"\w+", sentence) if one in own), "")
                if name not in wrong:
                    mistakes.add((*at, own[name][0]) if name else at, sentence)
                    wrong.add(name)
            if "" in wrong or len(wrong) == before:
                return None
        else:
            return None if wrong else made


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
        made = _converted(args[0], value)
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
    if hint in (float, _Milliseconds) and isinstance(value, int | float) and not isinstance(value, bool):
        if isinstance(value, int) and not is_int64(value):
            return _INVALID
        if hint is float:
            return float(value) if isfinite(value) else _INVALID
        nanos = value * MILLISECOND
        return round(nanos) if isfinite(nanos) and is_int64(round(nanos)) else _INVALID
    if hint is Any or (type(value) is hint and (not isinstance(value, int) or is_int64(value))):
        return value
    return _INVALID


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
    _Milliseconds: "a finite number",
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
