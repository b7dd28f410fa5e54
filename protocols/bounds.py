"""What a setting may be, stated where it is declared: `gear: Annotated[float, Bounds(1e-3, 1e4)] = 1.0`.

Rules. Every number of every dataclass that a file fills has a lower and an upper bound, generous, and such
that the work of a step is bounded at every combination that they allow. A time is a `Duration`: nanoseconds
here, milliseconds in a file and in its bounds. `gateway.config.schema` reads them from the type hints, and so
does `check`, which a dataclass calls in `__post_init__`: then what is made in code, or changed at run time,
keeps them as well. What is wrong with several fields together is `Invalid`, which names the one it means.
A subclass that declares a field anew states its bounds anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import Field, dataclass, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Protocol, TypeAlias, get_args, get_origin, get_type_hints

from protocols.messages import MILLISECOND, Nanos


@dataclass(frozen=True, slots=True)
class Bounds:
    """The least and the most value of a number, in the unit of its field (milliseconds of a `Duration`)."""

    least: float
    most: float
    unit: str = ""
    nan: str = ""
    """What NaN means, if it is permitted in code; a file holds finite numbers."""

    def admit(self, value: float) -> bool:
        """True if the value is within the bounds."""
        return self.least <= value <= self.most or (bool(self.nan) and value != value)

    def __str__(self) -> str:
        """Return the bounds as they follow "a finite number": "from 1 to 2000 rad"."""
        return f"from {_shown(self.least)} to {_shown(self.most)} {self.unit}".rstrip()


def _shown(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.10g}"


class _Milliseconds:
    """Marks a time, by its type hint."""


Duration: TypeAlias = Annotated[Nanos, _Milliseconds]
"""A span of time in a dataclass that a file fills: under its name with `_ms` there."""


class _Named:
    """Marks the name of a text file, by its type hint."""


FileText: TypeAlias = Annotated[str, _Named]
"""The name of a text file beside the robot file. Whoever reads the robot file puts the text behind it, from
the next line on, and keeps it in the recording: nothing below opens a file (`named_text`)."""


def named_text(value: str) -> tuple[str, str]:
    """Return the name of a file, and its text; "": it has not been read."""
    name, _, text = value.partition("\n")
    return name, text


def names_file(hint: object) -> bool:
    """True for a hint of the name of a text file."""
    return _Named in getattr(hint, "__metadata__", ())


class Settings(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Wrong: TypeAlias = tuple[str, str]
"""A field (below it keys of the file, after dots) and a sentence: what is wrong with it; "": nothing is."""


class Invalid(ValueError):
    """Settings that cannot be, with all that is wrong."""

    def __init__(self, *wrong: Wrong) -> None:
        super().__init__(*wrong)
        self.wrong = wrong

    def __str__(self) -> str:
        return "; ".join(text for _, text in self.wrong)


hints: Callable[[type], Mapping[str, object]] = cache(lambda kind: get_type_hints(kind, include_extras=True))
"""The type hints of a dataclass, by field."""


def is_duration(hint: object) -> bool:
    """True for a hint of a time; it may be optional, and have bounds."""
    return _Milliseconds in getattr(hint, "__metadata__", ()) or any(map(is_duration, get_args(hint)))


def keys(kind: type[Settings]) -> dict[str, Field[Any]]:
    """Return the fields of a dataclass by the key under which each is written in a file."""
    hint = hints(kind)
    return {
        f"{one.name}_ms" if is_duration(hint[one.name]) else one.name: one for one in fields(kind) if one.init
    }


def bounds_of(hint: object) -> Bounds | None:
    """Return the bounds of a number by its hint, which may be optional."""
    stated = (one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Bounds))
    return next(stated, None) or next(filter(None, map(bounds_of, get_args(hint))), None)


def check(settings: Settings, *others: Wrong) -> None:
    """Raise Invalid with every number that is out of its bounds, and `others`. None passes: it means that a
    field is left to its default."""
    wrong = [
        (name, text)
        for name, hint in hints(type(settings)).items()
        if name in settings.__dataclass_fields__
        for text in _objections(name, hint, getattr(settings, name))
    ]
    if wrong := [*wrong, *(each for each in others if each[1])]:
        raise Invalid(*wrong)


def ordered(settings: Settings, less: str, more: str) -> None:
    """Raise Invalid if the second of two numbers is less than the first."""
    if getattr(settings, more) < getattr(settings, less):
        raise Invalid((more, f"{more} must not be less than {less}, {getattr(settings, less):g}"))


def _objections(name: str, hint: object, value: object) -> Iterator[str]:
    """Yield what is wrong with a number, or with each of a tuple."""
    if isinstance(value, tuple) and get_origin(hint) is tuple:
        each = get_args(hint)
        for one, of in zip(value, each[:1] * len(value) if Ellipsis in each else each, strict=False):
            yield from _objections(name, of, one)
    elif isinstance(value, int | float) and (bounds := bounds_of(hint)) is not None:
        shown, unit = (value / MILLISECOND, " ms") if is_duration(hint) else (value, "")
        if not bounds.admit(shown):
            yield f"{name} must be {bounds}{unit}, not {_shown(shown)}"
