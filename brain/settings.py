"""The brain's settings, whole, and how one of them changes while it runs.

Rules. Frozen dataclasses with defaults, in SI; each checks itself. A change names a number by its dotted
key, as in the robot file below [brain]; times are in milliseconds there, with `_ms` in the name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, dataclass, field, fields, replace
from difflib import get_close_matches
from math import isfinite
from typing import Any, ClassVar, Literal, Protocol, TypeVar

from brain.bodies.differential import Differential
from brain.bodies.joints import Joints
from brain.control.pursuit import PursuitSettings
from brain.health import HealthSettings
from brain.perception.perception import PerceptionSettings
from brain.planning.survey import PlannerSettings
from protocols.messages import MILLISECOND


@dataclass(frozen=True, slots=True)
class BrainSettings:
    """Which body, and how the three systems are set. The body's own table must be there."""

    body: Literal["differential", "joints"] = "joints"
    differential: Differential | None = None
    joints: Joints | None = None
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    pursuit: PursuitSettings = field(default_factory=PursuitSettings)
    health: HealthSettings = field(default_factory=HealthSettings)


class Settings(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


S = TypeVar("S", bound=Settings)

AT_START = (
    "perception.",
    "differential.wheel_radius",
    "differential.wheel_separation",
    "differential.radius",
)
"""Keys that hold as the robot file has them: a change would make wrong what is believed."""
LOWER = "differential.max_"
"""Limits of the body: while it runs they may be lowered, and raised again up to what the robot file has."""


def keys(settings: Settings, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every number below a dataclass: its dotted key and its value, as in the robot file."""
    for one in fields(settings):
        value = getattr(settings, one.name)
        if hasattr(value, "__dataclass_fields__"):
            yield from keys(value, f"{prefix}{one.name}.")
        elif "Nanos" in str(one.type):
            yield f"{prefix}{one.name}_ms", value / MILLISECOND
        elif isinstance(value, int | float):
            yield f"{prefix}{one.name}", value


def changed(
    settings: BrainSettings, key: str, value: float, file: BrainSettings
) -> tuple[BrainSettings, str]:
    """The settings with one number changed, and ""; or the same as before, and why not.

    `file` are the settings as the robot file has them."""
    known = dict(keys(settings))
    if key not in known:
        near = get_close_matches(key, known, 3, 0.5)
        hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"there are {', '.join(known)}"
        return settings, f"there is no setting {key!r}; {hint}"
    if key.startswith(AT_START):
        return settings, f"{key} counts from the start on: change it in the robot file"
    if not isfinite(value):
        return settings, f"{key} must be a finite number, not {value}"
    if key.startswith(LOWER) and value > dict(keys(file))[key]:
        most = dict(keys(file))[key]
        return settings, f"{key} must not be more than {most:g}, as the robot file has it, but is {value:g}"
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
