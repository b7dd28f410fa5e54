"""What a person writes, in a mission file or to an operator's prompt, as values.

Rules. Strict: true is no number, a number is finite and within bounds. What is none raises `InvalidError`:
of a file's value the text is what was expected, of a word a sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite, radians
from typing import Any, Literal, TypeAlias

Read: TypeAlias = Callable[[object], object]
"""The value of a key → what a step needs; raises InvalidError."""
Given: TypeAlias = Mapping[str, Any]
"""What was read, by key."""


class InvalidError(ValueError):
    """A value that is not what its key, or its argument, needs."""


# -- values of a file ----------------------------------------------------------------------------


def number(value: object) -> float:
    """Return a number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e6:
        raise InvalidError("a number, up to a million")
    return float(value)


def degrees(value: object) -> float:
    """Return an angle in degrees as rad."""
    return radians(number(value))


def whole(value: object) -> int:
    """Return a whole number, at least 0."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 1_000_000:
        raise InvalidError("a whole number, at least 0")
    return value


def name(value: object) -> str:
    """Return a name."""
    if not isinstance(value, str) or not value:
        raise InvalidError("a name")
    return value


def flag(value: object) -> bool:
    """Return true or false."""
    if not isinstance(value, bool):
        raise InvalidError("true or false")
    return value


def several(count: int, of: Callable[[object], float] = number) -> Callable[[object], tuple[float, ...]]:
    """Return what reads an array of so many numbers."""

    def read(value: object) -> tuple[float, ...]:
        try:
            if isinstance(value, list) and len(value) == count:
                return tuple(of(each) for each in value)
        except InvalidError:
            pass
        raise InvalidError(f"{count} numbers")

    return read


# -- words ---------------------------------------------------------------------------------------


def number_of(word: str) -> float:
    """Return the number that a word is."""
    try:
        value = float(word)
    except ValueError:
        raise InvalidError(f"{word!r} is not a number") from None
    if not isfinite(value):
        raise InvalidError(f"{word!r} is not a finite number")
    return value


def angle_of(word: str, unit: Literal["deg", "rad"] = "deg") -> float:
    """Return an angle [rad]; `unit` is the unit of a bare number."""
    suffix = word[-3:] if word.endswith(("deg", "rad")) else ""
    value = number_of(word.removesuffix(suffix))
    return radians(value) if (suffix or unit) == "deg" else value


def integer_of(word: str, base: Literal[10, 16] = 10) -> int:
    """Return the integer of 64 bits that a word is."""
    try:
        value = int(word, base)
    except ValueError:
        raise InvalidError(f"{word!r} is not a{' hexadecimal' if base == 16 else 'n'} integer") from None
    if not 0 <= value < 1 << 64:
        raise InvalidError(f"{word!r} is {'negative' if value < 0 else 'longer than 64 bits'}")
    return value


def quantity_of(word: str, units: tuple[str, ...]) -> float:
    """Return a number with one of these units, or without."""
    unit = next((unit for unit in units if word.endswith(unit)), "")
    return number_of(word.removesuffix(unit))


def joined(words: list[str]) -> list[str]:
    """Return the words with each unit joined to its number: "3 s" → "3s"."""
    found: list[str] = []
    for word in words:
        if found and word in ("m", "s", "m/s", "deg", "rad"):
            found[-1] += word
        else:
            found.append(word)
    return found
