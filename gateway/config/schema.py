"""A table of the robot file → a dataclass, by its annotations alone. Every mistake is told, none raised.

Rules. Strict: "5" is not 5, 1.5 is no integer, a number must be finite; an integer may stand for a float.
A key that no field has is a mistake. A field annotated `Nanos` is written in milliseconds, under its
name with `_ms`. What `__post_init__` says in a ValueError ("; " between several) is told at the field
that it names. So a new setting in any of the dataclasses needs no change here.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass, replace
from enum import Enum
from types import GenericAlias, NoneType, UnionType
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, Union, get_args, get_origin, get_type_hints

from gateway.config.errors import Key, Mistakes, shown, unknown
from protocols.messages import MILLISECOND

T = TypeVar("T")


def written(field: Field[Any]) -> str:
    """The key under which a field stands in the file."""
    return f"{field.name}_ms" if "Nanos" in str(field.type) else field.name


def keys(kind: type) -> tuple[str, ...]:
    """The keys that a table of this dataclass may have."""
    return tuple(written(field) for field in fields(kind) if field.init)


def build(kind: type[T], table: object, at: Key, mistakes: Mistakes, also: Sequence[str] = ()) -> T | None:
    """The dataclass `kind` from a table of the file, or None with its mistakes told.

    `also` are keys of the same table that somebody else reads.
    """
    from pydantic import ConfigDict, PydanticUserError, TypeAdapter, ValidationError

    if not isinstance(table, dict):
        mistakes.add(at, f"found {shown(table)}, expected a table")
        return None
    before = len(mistakes)
    own = {key: value for key, value in table.items() if key not in also}
    plain = _in_nanos(kind, own, at, mistakes)
    strict = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    try:
        alone: Any = GenericAlias(tuple, (kind,))  # a dataclass itself would not take our configuration
        adapter: TypeAdapter[tuple[T]] = TypeAdapter(alone, config=strict)
    except (PydanticUserError, NameError, TypeError) as error:
        mistakes.add(at, f"{kind.__module__}.{kind.__qualname__} cannot be filled from a file: {error}")
        return None
    replaced: set[Loc] = set()
    for _ in range(MOST_ROUNDS):
        try:
            made = adapter.validate_json(json.dumps([plain], default=lambda _: {}))[0]
        except ValidationError as error:
            rows = error.errors(include_url=False)
        else:
            return made if len(mistakes) == before else None
        complaints = [_Error(row["type"], row["loc"][1:], row["msg"], row.get("ctx", {})) for row in rows]
        wrong = [one for said in complaints for one in _fields_of(kind, said) if one[0] not in replaced]
        for place, said in wrong:
            _report(kind, own, at, place, said, also, mistakes)
        replaced |= {place for place, _ in wrong}
        if not wrong or not all(_replace(kind, plain, place, said) for place, said in wrong):
            break
    return None


MOST_ROUNDS = 20
"""How often a table is looked at: a `__post_init__` tells only of the first field that is wrong."""


Loc: TypeAlias = tuple[int | str, ...]
"""Where something stands below a table, by the names of fields."""


@dataclass(frozen=True, slots=True)
class _Error:
    """One of pydantic's errors."""

    kind: str
    loc: Loc
    message: str
    context: Mapping[str, Any]


def _fields_of(kind: type, error: _Error) -> list[tuple[Loc, _Error]]:
    """The fields that an error is about: what a `__post_init__` said is split by the fields that it names."""
    if error.kind != "value_error":
        place = error.loc[: len(_walk(kind, error.loc)[0])]  # not which item of an array, nor of a union
        inside = place != error.loc
        return [(place, replace(error, kind="inside") if inside else error)]
    hint = _bare(_walk(kind, error.loc)[1])
    split: list[tuple[Loc, _Error]] = []
    for sentence in str(error.context.get("error", error.message)).split("; "):
        place = (*error.loc, *_fields_named(sentence, hint)[:1])
        split.append((place, _Error(error.kind, place, sentence, {})))
    return split


def _replace(kind: type, plain: dict[str, Any], place: Loc, error: _Error) -> bool:
    """Take what is wrong away, or put a default or a plain value there, so that the next complaint shows."""
    *above, name = place or ("",)
    inner: Any = plain
    for step in above:
        inner = inner.get(step) if isinstance(inner, dict) else None
    if not isinstance(inner, dict) or not isinstance(name, str):
        return False
    if inner.pop(name, None) is not None and error.kind == "unexpected_keyword_argument":
        return True
    around = _bare(_walk(kind, tuple(above))[1])
    field = next((one for one in fields(around) if one.name == name), None) if is_dataclass(around) else None
    if field is None:
        return False
    if field.default is MISSING and field.default_factory is MISSING:
        hint = _bare(get_type_hints(around)[name])
        if hint not in _HARMLESS:
            return False
        inner[name] = _HARMLESS[hint]
    return True


_HARMLESS: dict[object, object] = {float: 1.0, int: 1, str: "x", bool: False}


def positive(table: object, at: Key, names: Iterable[str], mistakes: Mistakes) -> None:
    """Tell of each of these keys that is a number but not greater than zero."""
    if not isinstance(table, Mapping):
        return
    for name in names:
        value = table.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool) and value <= 0:
            mistakes.add((*at, name), f"found {shown(value)}, expected a number greater than 0")


def _in_nanos(kind: type, table: Mapping[str, object], at: Key, mistakes: Mistakes) -> dict[str, object]:
    """The table with the fields' own names, and nanoseconds for milliseconds."""
    hints = get_type_hints(kind)
    by_key = {written(field): field for field in fields(kind)}
    plain: dict[str, object] = {}
    for key, value in table.items():
        field = by_key.get(key)
        if field is None:
            if f"{key}_ms" in by_key:
                mistakes.add((*at, key), f"unknown key; did you mean '{key}_ms' (milliseconds)?")
            else:
                plain[key] = value
            continue
        inner = _dataclass_in(hints[field.name])
        if inner is not None and isinstance(value, dict):
            value = _in_nanos(inner, value, (*at, key), mistakes)
        elif key != field.name and isinstance(value, int | float) and math.isfinite(value):
            value = value if isinstance(value, bool) else round(value * MILLISECOND)
        plain[field.name] = value
    return plain


def _dataclass_in(hint: object) -> type | None:
    """The dataclass that a hint asks for, if it asks for one and nothing else."""
    hint = _bare(hint)
    return hint if isinstance(hint, type) and is_dataclass(hint) else None


def _bare(hint: object) -> object:
    """A hint without Annotated and without None."""
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        rest = [one for one in get_args(hint) if one is not NoneType]
        return _bare(rest[0]) if len(rest) == 1 else hint
    return hint


def _report(
    kind: type,
    table: Mapping[str, object],
    at: Key,
    place: Loc,
    error: _Error,
    also: Sequence[str],
    mistakes: Mistakes,
) -> None:
    """Put one of pydantic's errors into a sentence, at its key."""
    unexpected = error.kind == "unexpected_keyword_argument"
    below, hint, inside = _walk(kind, place[:-1] if unexpected else place)
    path = (*at, *below)
    if unexpected:
        name = str(place[-1])
        known = [*keys(inside), *(also if not below else ())] if inside else []
        mistakes.add((*path, name), unknown("key", name, known))
    elif error.kind == "missing":
        mistakes.add(path, f"missing; expected {wanted(hint)}")
    elif error.kind == "value_error":
        mistakes.add(path, error.message)
    else:
        value = _at(table, below)
        expected = wanted(hint) if hint is not None else error.message
        bounds = [f" {_BOUNDS[name]} {limit:g}" for name, limit in error.context.items() if name in _BOUNDS]
        mistakes.add(
            path, f"found {shown(value)}, expected {expected}{''.join(bounds)}{_nearest(value, hint)}"
        )


def _nearest(value: object, hint: object) -> str:
    """The nearest of the words that a field takes."""
    words = [one for one in get_args(_bare(hint)) if isinstance(one, str)]
    near = difflib.get_close_matches(value, words, 1) if isinstance(value, str) else []
    return f"; did you mean {near[0]!r}?" if near else ""


_BOUNDS = {"gt": "greater than", "ge": "of at least", "lt": "less than", "le": "of at most"}


def _walk(kind: type, loc: Sequence[int | str]) -> tuple[Key, Any, type | None]:
    """Where pydantic's location stands in the file, what is wanted there, and the dataclass it is in."""
    path: Key = ()
    hint: Any = kind
    inside: type | None = kind
    for step in loc:
        bare = _bare(hint)
        if isinstance(bare, type) and is_dataclass(bare):
            field = next((one for one in fields(bare) if one.name == step), None)
            path = (*path, written(field) if field else str(step))
            hint = get_type_hints(bare, include_extras=True)[field.name] if field else None
            inside = _dataclass_in(hint)
            if field and "Nanos" in str(field.type):
                hint = Annotated[float, "milliseconds"]
        elif get_origin(bare) is dict:
            path, hint = (*path, str(step)), get_args(bare)[1]
            inside = _dataclass_in(hint)
    return path, hint, inside


def _at(table: object, path: Key) -> object:
    """What stands in the file at a path below a table."""
    for part in path:
        table = table.get(part) if isinstance(table, Mapping) else table
    return table


def _fields_named(sentence: str, kind: object) -> list[str]:
    """The fields that a sentence names, in its order."""
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return []
    names = [field.name for field in fields(kind)]
    return [word for word in re.findall(r"\w+", sentence) if word in names]


_SIMPLE = {float: "a finite number", int: "an integer", str: "a string", bool: "true or false"}


def wanted(hint: object) -> str:
    """What a field takes, in words: "a finite number", "'idle' or 'hold'", "an array of 2 numbers"."""
    if get_origin(hint) is Annotated:
        unit = next((one for one in get_args(hint)[1:] if isinstance(one, str)), "")
        return wanted(get_args(hint)[0]) + (f" of {unit}" if unit else "")
    hint = _bare(hint)
    if hint in _SIMPLE:
        return _SIMPLE[hint]
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(repr(one) for one in args)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return " or ".join(repr(one.value) for one in hint)
    if origin in (Union, UnionType):
        return " or ".join(wanted(one) for one in args if one is not NoneType)
    if origin is tuple:
        each = wanted(args[0]).removeprefix("a ").removeprefix("an ") + "s"
        return f"an array of {each}" if Ellipsis in args else f"an array of {len(args)} {each}"
    return "a table"
