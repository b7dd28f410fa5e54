"""Kinds of sensors: what is known of each stands in one table, ours in a file each, others' in packages.

A kind of a third party is found by one entry point in its pyproject.toml:

    [project.entry-points."motor_gateway.sensors"]
    acme_range = "their_package:RANGE"

Its readings are recorded, replayed, shown, and watched over by the brain's health as those of ours. Nothing
of it is called in a step but its message's constructor; what is broken is left out, and named. A kind may say
nothing of what perception makes of it: that is the brain's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint

from protocols.entry_points import Unreadable, offered, owner, version
from protocols.messages import Measurement
from protocols.sensors import fix, imu, laser_scan, marker, pose_reading, shaft_reading
from protocols.sensors.kind import Quantity, RosView, SensorKind, mistake, reading_text, shaped

__all__ = [
    "OURS",
    "Kinds",
    "Quantity",
    "RosView",
    "SensorKind",
    "kinds",
    "reading_text",
    "shaped",
    "versions",
]

GROUP = "motor_gateway.sensors"
OURS = (imu.KIND, laser_scan.KIND, fix.KIND, pose_reading.KIND, marker.KIND, shaft_reading.KIND)


@dataclass(frozen=True, slots=True)
class Kinds:
    """The kinds of sensors of this machine."""

    by_type: Mapping[type[Measurement], SensorKind]
    """Ours first, then others' by their names."""
    broken: Mapping[str, str]
    """By name: why a kind that is installed is left out."""
    unreadable: tuple[Unreadable, ...] = ()
    """Distributions that may have some."""

    @property
    def strangers(self) -> tuple[SensorKind, ...]:
        """Those that are not ours."""
        return tuple(self.by_type.values())[len(OURS) :]

    @property
    def left_out(self) -> tuple[str, ...]:
        """What is broken, in words."""
        kinds = [f"the kind of sensor {name!r} is left out: {why}" for name, why in self.broken.items()]
        return (
            *kinds,
            *(f"of {each.distribution} no kind of sensor is used: {each.reason}" for each in self.unreadable),
        )


@cache
def kinds() -> Kinds:
    """Return the kinds that are installed. Read once: what runs is what was there then."""
    found = {kind.message: kind for kind in OURS}
    points, unreadable = offered(GROUP)
    broken: dict[str, str] = {}
    for point in points:
        loaded = _load(point)
        if isinstance(loaded, str):
            broken[point.name] = loaded
        elif loaded.name in broken or any(_alike(loaded, other) for other in found.values()):
            broken[point.name] = "another kind has its name, or its message's"
        else:
            found[loaded.message] = loaded
    return Kinds(found, broken, unreadable)


def versions() -> dict[str, str]:
    """Return distribution and version of each kind that is not ours, by its name, without importing it."""
    return {point.name: f"{owner(point)} {version(point)}" for point in offered(GROUP).points}


def _load(point: EntryPoint) -> SensorKind | str:
    """Load a kind, and try it; return why that is impossible."""
    try:
        kind = point.load()
        wrong = mistake(kind, point.name)
    except KeyboardInterrupt:  # a person's, who wants to leave
        raise
    except BaseException as error:  # noqa: BLE001 -- a third party's module may raise anything, SystemExit too
        wrong = f"{type(error).__name__}: {error}"
    return wrong or kind


def _alike(one: SensorKind, other: SensorKind) -> bool:
    return one.name == other.name or one.message.__name__ == other.message.__name__
