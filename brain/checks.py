"""Checks of messages and tasks: that their numbers are finite, and what a robot could do."""

from __future__ import annotations

from dataclasses import fields
from math import isfinite

from protocols.bounds import Settings, hints


def not_finite(message: Settings) -> str:
    """Return which field of a message holds no finite number where one belongs; "" if none does."""
    for field in fields(message):
        value, hint = getattr(message, field.name), hints(type(message))[field.name]
        if hint not in (float, float | None) or (value is None and hint is not float):
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
            return f"its {field.name} is {value!r}, and must be a finite number"
    return ""


MOST = 1e6
"""Of any number of a task: rad, rad/s, N·m, m, m/s."""


def objection(task: Settings) -> str:
    """Return which number of a task is beyond what any robot could do; "" if none is."""
    for field in fields(task):
        value = getattr(task, field.name)
        if isinstance(value, int | float) and not abs(value) <= MOST:  # nor is NaN
            return f"its {field.name} must be from {-MOST:.10g} to {MOST:.10g}, not {value:g}"
    return ""
