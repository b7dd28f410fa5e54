"""From the occupancy grid to the costmap that a plan is made on, as the settings have it.

Rules. Everything here is a pure function of the grid as it is now. What is near to an obstacle is decided by
the middles of cells, which is what the margin beside the footprint's radius is for.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import dist, isfinite

import numpy as np

from brain.planning.costmap import Costmap, Map, Mask, build, origin
from brain.planning.line import Point
from protocols.messages import MILLISECOND, SECOND, Nanos


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """How the planner plans and when the mission asks it to. SI."""

    expansions_per_step: int = 1000
    """A* expansions in one step of the brain: about 2 µs each."""
    margin: float = 0.05
    """m, kept between the footprint and what is occupied, beyond the footprint's radius"""
    comfort: float = 0.4
    """m, the distance within which being near to obstacles costs more"""
    dislike: float = 3.0
    """How much more a metre next to an obstacle costs than one far from any."""
    unknown_multiplier: float = 1.2
    """What a metre through unknown ground is guessed to cost, where nothing known leads to the goal.
    The larger, the longer the search."""
    unknown_is_free: bool = False
    """Plan through unknown ground as if it were free. For open ground only."""
    escape: float = 0.5
    """m, how far the start may lie from the nearest place that fits the footprint"""
    slack: float = 0.1
    """m, how far a goal too close to an obstacle is moved to a place that fits"""
    period: Nanos = 250 * MILLISECOND
    """Between two looks at the map: is the path still free, does a better one show?"""
    explore: Nanos = 500 * MILLISECOND
    """While nothing known leads to the goal: between two plans."""
    patience: Nanos = 8 * SECOND
    """Without any path to a goal for so long, the goal is given up."""
    drive_timeout: Nanos = 500 * MILLISECOND
    """A Drive that is not repeated for so long ends: a lost operator means stop."""

    def __post_init__(self) -> None:
        for name in ("margin", "comfort", "dislike", "slack"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("expansions_per_step", "escape", "period", "explore", "patience", "drive_timeout"):
            if not (isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name} must be more than 0, not {getattr(self, name)}")
        if not (isfinite(self.unknown_multiplier) and self.unknown_multiplier >= 1.0):
            raise ValueError(f"unknown_multiplier must be 1 or more, not {self.unknown_multiplier}")


def survey(
    grid: Map,
    radius: float,
    settings: PlannerSettings,
    *,
    standing: Point,
    given_up: tuple[Point, ...] = (),
) -> Costmap:
    """The costmap of the grid as it is now, for a footprint circle of this radius [m].

    Unknown ground under the robot is free: it stands there. Unknown ground about the places `given_up`,
    which stayed unknown when seen from near, counts as blocked."""
    resolution, corner = grid.resolution, origin(grid)
    blocked, unknown = grid.blocked(radius + settings.margin), grid.unknown
    unknown = unknown & ~_disc(unknown.shape, corner, resolution, standing, radius)
    for place in given_up:
        blocked = blocked | (unknown & _disc(unknown.shape, corner, resolution, place, radius))
    return build(
        blocked,
        unknown,
        resolution=resolution,
        origin=corner,
        comfort=settings.comfort,
        dislike=settings.dislike,
        unknown_multiplier=settings.unknown_multiplier,
        unknown_is_free=settings.unknown_is_free,
    )


def nearest(
    costmap: Costmap, place: Point, within: float, lowest: int, seen_through: Costmap | None = None
) -> int | None:
    """The nearest cell of at least this level; with `seen_through`, on a straight line free in that map."""
    rows = len(costmap.level) // costmap.stride
    level = np.frombuffer(costmap.level, np.uint8).reshape(rows, costmap.stride)
    near = _disc((rows - 2, costmap.stride - 2), costmap.origin, costmap.resolution, place, within)
    row, column = np.nonzero((level[1:-1, 1:-1] >= lowest) & near)
    cells = [int(c) for c in (row + 1) * costmap.stride + column + 1]
    for _, cell in sorted((dist(place, costmap.centre(cell)), cell) for cell in cells):
        if seen_through is None or not seen_through.is_blocked(place, costmap.centre(cell)):
            return cell
    return None


def _disc(shape: tuple[int, ...], corner: Point, resolution: float, centre: Point, radius: float) -> Mask:
    x = corner[0] + (np.arange(shape[1]) + 0.5) * resolution - centre[0]
    y = corner[1] + (np.arange(shape[0]) + 0.5) * resolution - centre[1]
    inside: Mask = x[None, :] ** 2 + y[:, None] ** 2 <= radius**2
    return inside
