"""Checks of settings, for `__post_init__`. Every message begins with the field's name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, fields
from math import isfinite
from typing import Any, ClassVar, Protocol


class Settings(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def finite(settings: Settings, *names: str) -> None:
    """Raise ValueError unless these numbers (default: all) are finite."""
    _require(settings, names, "must be finite", lambda _: True)


def positive(settings: Settings, *names: str) -> None:
    """Raise ValueError unless these numbers (default: all) are finite and above 0."""
    _require(settings, names, "must be above 0", lambda value: value > 0)


def not_negative(settings: Settings, *names: str) -> None:
    """Raise ValueError unless these numbers (default: all) are finite and at least 0."""
    _require(settings, names, "must not be negative", lambda value: value >= 0)


def shares(settings: Settings, *names: str) -> None:
    """Raise ValueError unless these numbers are at most 1."""
    _require(settings, names, "is a share: at most 1", lambda value: value <= 1)


def _require(settings: Settings, names: tuple[str, ...], bound: str, holds: Callable[[float], bool]) -> None:
    for name in names or [field.name for field in fields(settings)]:
        value = getattr(settings, name)
        if isinstance(value, int | float) and not (isfinite(value) and holds(value)):
            raise ValueError(f"{name} {bound}, not {value!r}")
