"""The brain's settings, and changing one of them at run time.

Rules. Frozen dataclasses with defaults, in SI; each validates itself. A change names a number by its dotted
key, as in the robot file below [brain]; times are in milliseconds there, with `_ms` in the name. No change
widens what the robot file allows: `AT_RUN_TIME` states in which direction each number may go from there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from math import isfinite
from typing import Literal, TypeAlias, TypeVar

from brain.bodies.body import Base, Body
from brain.bodies.limbs import Abilities, abilities, limbs, with_limb
from brain.control.pursuit import PursuitSettings
from brain.health import HealthSettings
from brain.other_brain import Chosen
from brain.perception.perception import PerceptionSettings
from brain.perception.saved_map import SavedMap
from brain.planning.behaviours import BehaviourSettings
from brain.planning.costmap import PlannerSettings
from brain.planning.stop_zone import StopSettings
from protocols.bounds import Invalid, Settings
from protocols.bounds import keys as keys_in_file
from protocols.messages import MILLISECOND


@dataclass(frozen=True, slots=True)
class BrainSettings:
    """The body, and the settings of perception, planning and control."""

    body: Body
    """In the robot file its name; its own table, below [brain], has that name."""
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)
    planner: PlannerSettings = field(default_factory=PlannerSettings)
    behaviour: BehaviourSettings = field(default_factory=BehaviourSettings)
    pursuit: PursuitSettings = field(default_factory=PursuitSettings)
    stop: StopSettings = field(default_factory=StopSettings)
    health: HealthSettings = field(default_factory=HealthSettings)
    other: Chosen | None = None
    """Who makes the commands in our brain's place: in the robot file its name, `kind`, and its own table"""
    saved: SavedMap | None = None
    """The map that it begins in: in the robot file the table [map]"""

    def __post_init__(self) -> None:
        radius = self.base.radius if self.base is not None else 0.0
        reach = radius + self.planner.margin + self.planner.comfort
        cells = reach / self.perception.map.resolution
        if cells > MAX_REACH:
            text = f"the footprint's radius, margin and comfort are {reach:g} m, {cells:.0f} cells of the map"
            raise Invalid(("planner", f"planner: {text}; expected at most {MAX_REACH}"))

    @property
    def base(self) -> Base | None:
        """What drives; None if nothing does."""
        return next((b for one in limbs(self.body).values() if (b := one.body.as_base) is not None), None)

    def abilities(self, motors: Iterable[str]) -> Abilities:
        """Return what a robot with these motors can do."""
        return abilities(self.body, tuple(motors))


S = TypeVar("S", bound=Settings)

MAX_REACH = 100
"""Cells about an obstacle that the costmap treats differently: bounds its work, with the map's size."""

Direction: TypeAlias = Literal["at most", "at least", "free"]

AT_RUN_TIME: tuple[tuple[Direction, str, str], ...] = (
    (
        "at least",
        "distances from obstacles, the cost of unknown ground, caution after trouble: they only get larger",
        (
            "planner.margin planner.comfort planner.dislike planner.unknown_multiplier health.recover_ms "
            "pursuit.obstacle_distance stop.gap stop.turn_gap stop.latency_ms stop.walk stop.doubt"
        ),
    ),
    (
        "at most",
        "limits, speeds, and shares of them: less is more cautious",
        (
            "body.max_linear body.max_lateral body.max_angular body.max_wheel_speed planner.escape "
            "planner.slack planner.unknown_is_free health.slow pursuit.braking pursuit.creep "
            "pursuit.lateral_acceleration pursuit.corner pursuit.obstacle_speed stop.blind_speed "
            "stop.hidden_speed "
            "behaviour.back behaviour.tries"
        ),
    ),
    (
        "at most",
        "times and shares of timeouts, after which something is noticed or ended: timeouts only get shorter",
        (
            "health.slow_age health.stand_age health.give_up_ms health.window_ms health.rejected_slow "
            "health.rejected_stop health.contradicted_ms health.too_long_ms health.too_often "
            "planner.period_ms planner.drive_timeout_ms planner.patience_ms pursuit.idle_after_ms "
            "behaviour.crossing_ms"
        ),
    ),
    (
        "at most",
        "the work of a step, and of a search",
        "planner.expansions_per_step planner.expansions_per_search",
    ),
    (
        "free",
        "how a path is followed: every value within its bounds keeps the limits",
        (
            "pursuit.period_ms pursuit.latency_ms pursuit.lookahead_time pursuit.lookahead_min "
            "pursuit.lookahead_max pursuit.turn_from pursuit.turn_until pursuit.turn_gain pursuit.tolerance "
            "pursuit.yaw_tolerance planner.explore_ms planner.reverse planner.switch behaviour.look_after_ms "
            "behaviour.look behaviour.stuck_after_ms"
        ),
    ),
)
"""How a number may differ from the robot file's at run time, why, and which. It may always be changed back.

"body" stands for a limb's own table. All others are fixed at the start: geometry and perception, since a
change would invalidate the present estimate and map; the body's accelerations, since more is rougher than the
file allows, and less makes every stop longer."""


def keys(settings: Settings, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield every number of a settings dataclass: its dotted key and its value, as in the robot file."""
    for key, one in keys_in_file(type(settings)).items():
        value = getattr(settings, one.name)
        if isinstance(value, Body):
            for limb, own in limbs(value).items():
                yield from keys(own.body, f"{limb}.")
        elif hasattr(value, "__dataclass_fields__"):
            yield from keys(value, f"{prefix}{one.name}.")
        elif isinstance(value, int | float):
            yield f"{prefix}{key}", value if key == one.name else value / MILLISECOND


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
    table, _, name = key.partition(".")
    limb = limbs(settings.body).get(table)
    path = key if limb is None else f"body.{name}"
    direction = next((kind for kind, _, names in AT_RUN_TIME if path in names.split()), "fixed")
    if direction == "fixed":
        return settings, f"{key} is fixed at the start: change it in the robot file"
    if not isfinite(value):
        return settings, f"{key} must be a finite number, not {value}"
    now, limit = known[key], in_file[key]
    if isinstance(now, bool) and value not in (0.0, 1.0):
        return settings, f"{key} must be 0 or 1, not {value:g}"
    if isinstance(now, int) and not float(value).is_integer():
        return settings, f"{key} must be an integer, not {value:g}"
    try:
        if limb is None:
            after = _replaced(settings, path.split("."), type(now)(value))
        else:
            changed_limb = _replaced(limb.body, name.split("."), type(now)(value))
            after = replace(settings, body=with_limb(settings.body, table, changed_limb))
    except OverflowError:
        return settings, f"{key} is out of every bound: {value:g}"
    except ValueError as error:
        return settings, f"{key}: {error}"
    if (direction == "at most" and value > limit) or (direction == "at least" and value < limit):
        return settings, f"{key} must be {direction} {limit:g}, the value in the robot file, not {value:g}"
    return after, ""


def _replaced(settings: S, path: list[str], value: float) -> S:
    name, *rest = path
    if rest:
        return replace(settings, **{name: _replaced(getattr(settings, name), rest, value)})
    field = keys_in_file(type(settings))[name].name
    return replace(settings, **{field: value if field == name else round(value * MILLISECOND)})
