"""The brain's settings, and changing one of them at run time.

Rules. Frozen dataclasses with defaults, in SI; each validates itself. A change names a number by its dotted
key, as in the robot file below [brain]; times are in milliseconds there, with `_ms` in the name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from math import isfinite
from typing import Literal, TypeVar

from brain.bodies.differential import Differential
from brain.bodies.joints import Joints
from brain.checks import Settings
from brain.control.pursuit import PursuitSettings
from brain.health import HealthSettings
from brain.perception.perception import PerceptionSettings
from brain.planning.costmap import PlannerSettings
from protocols.messages import MILLISECOND


@dataclass(frozen=True, slots=True)
class BrainSettings:
    """The body, and the settings of perception, planning and control. The body's own table is required."""

    body: Literal["differential", "joints"] = "joints"
    differential: Differential | None = None
    joints: Joints | None = None
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    pursuit: PursuitSettings = field(default_factory=PursuitSettings)
    health: HealthSettings = field(default_factory=HealthSettings)


S = TypeVar("S", bound=Settings)

FIXED_AT_START = (
    "perception.",
    "differential.wheel_radius",
    "differential.wheel_separation",
    "differential.radius",
)
"""Keys that keep the robot file's value: a change would invalidate the present estimate and map."""
LIMITS = "differential.max_"
"""Limits of the body: at run time they may be lowered, and raised again up to the robot file's value."""


def keys(settings: Settings, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number of a settings dataclass: its dotted key and its value, as in the robot file."""
    for one in fields(settings):
        value = getattr(settings, one.name)
        if hasattr(value, "__dataclass_fields__"):
            yield from keys(value, f"{prefix}{one.name}.")
        elif "Nanos" in str(one.type):
            yield f"{prefix}{one.name}_ms", value / MILLISECOND
        elif isinstance(value, int | float):
            yield f"{prefix}{one.name}", value


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return "did you mean …?" with up to three similar names; "" if none is similar."""
    near = get_close_matches(name, list(known), 3, 0.5)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else ""


def changed(
    settings: BrainSettings, key: str, value: float, file: BrainSettings
) -> tuple[BrainSettings, str]:
    """Return the settings with one number changed, and ""; or the same settings, and why not.

    `file` holds the settings of the robot file."""
    known, in_file = dict(keys(settings)), dict(keys(file))
    if key not in known:
        hint = suggestion(key, known) or f"there are {', '.join(known)}"
        return settings, f"there is no setting {key!r}; {hint}"
    if key.startswith(FIXED_AT_START):
        return settings, f"{key} is fixed at the start: change it in the robot file"
    if not isfinite(value):
        return settings, f"{key} must be a finite number, not {value}"
    if key.startswith(LIMITS) and value > in_file[key]:
        return settings, f"{key} must be at most {in_file[key]:g}, the value in the robot file, not {value:g}"
    now = known[key]
    if isinstance(now, bool) and value not in (0.0, 1.0):
        return settings, f"{key} must be 0 or 1, not {value:g}"
    if isinstance(now, int) and not float(value).is_integer():
        return settings, f"{key} must be an integer, not {value:g}"
    try:
        return _replaced(settings, key.split("."), type(now)(value)), ""
    except ValueError as error:
        return settings, f"{key}: {error}"


def _replaced(settings: S, path: list[str], value: float) -> S:
    name, *rest = path
    if rest:
        return replace(settings, **{name: _replaced(getattr(settings, name), rest, value)})
    if not hasattr(settings, name):
        return replace(settings, **{name.removesuffix("_ms"): round(value * MILLISECOND)})
    return replace(settings, **{name: value})
