"""Checks of settings, for `__post_init__`, and of tasks. A setting's message begins with the field's name.

Rules. Every number of every settings dataclass has a lower and an upper bound, stated once, in that call: the
robot file and `set` both refuse what lies beyond. Bounds are generous, and such that the work of a step is
bounded at every combination that they allow.
"""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any, ClassVar, Protocol, TypeAlias

from protocols.messages import MILLISECOND

Range: TypeAlias = tuple[float, float] | tuple[float, float, str]
"""Least and most, and a unit for the message. Of a `Nanos` field: in ms, as in the robot file."""


class Settings(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def within(settings: Settings, **ranges: Range) -> None:
    """Raise ValueError unless each of these fields is finite and from its least to its most value.

    None passes: it means that a field is left to its default."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if field.name not in ranges or value is None:
            continue
        low, high, *units = ranges[field.name]
        if "Nanos" in str(field.type):
            value, units = value / MILLISECOND, ["ms"]
        if not low <= value <= high:  # NaN is not, either
            unit = f" {units[0]}" if units else ""
            raise ValueError(f"{field.name} must be from {low:.10g} to {high:.10g}{unit}, not {value:g}")


def ordered(settings: Settings, less: str, more: str) -> None:
    """Raise ValueError if the second of two numbers is less than the first."""
    if getattr(settings, more) < getattr(settings, less):
        raise ValueError(f"{more} must not be less than {less}, {getattr(settings, less):g}")


MOST = 1e6
"""Of any number of a task: rad, rad/s, N·m, m, m/s."""


def objection(task: Settings) -> str:
    """Return which number of a task is beyond what any robot could do; "" if none is."""
    for field in fields(task):
        value = getattr(task, field.name)
        if isinstance(value, int | float) and not abs(value) <= MOST:  # nor is NaN
            return f"its {field.name} must be from {-MOST:.10g} to {MOST:.10g}, not {value:g}"
    return ""
