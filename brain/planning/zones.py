"""Zones of the map that an operator draws: where the robot must not go, and where it goes slowly.

Rules. A zone is a polygon in the frame of the map. Out of a keep-out zone stays the whole robot, whatever its
heading; if it stands in one it may leave it. In a slow zone the origin is no faster than the zone's speed,
and a metre costs as much more as the time that it takes. Zones are drawn tile by tile, each once. They do not
belong to the map of what is occupied: paths are planned around them, and the stop zone does not know them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt

from brain.belief import Floats
from brain.planning.polyline import Point
from protocols.bounds import Bounds, Invalid, check

MOST_ZONES, MOST_CORNERS = 20, 50
FARTHEST = 10_000.0
"""m from the map's origin to a corner"""
Marks = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Zone:
    """One zone."""

    corners: tuple[tuple[float, float], ...]
    """m, in order, either way round"""
    kind: Literal["keep_out", "slow"]
    """Whether it is not entered, or driven through slowly"""
    speed: Annotated[float, Bounds(0.01, 20.0, "m/s")] | None = None
    """m/s at most, of a slow zone"""

    def __post_init__(self) -> None:
        check(self)
        if not 3 <= len(self.corners) <= MOST_CORNERS:
            raise Invalid(
                ("corners", f"a zone has from 3 to {MOST_CORNERS} corners, not {len(self.corners)}")
            )
        if not all(abs(value) <= FARTHEST for corner in self.corners for value in corner):
            raise Invalid(("corners", f"corners must be within {FARTHEST:g} m"))
        if (self.kind == "slow") != (self.speed is not None):
            raise Invalid(("speed", "speed belongs to a slow zone, and only there"))

    def contains(self, x: float, y: float) -> bool:
        """Return whether a place [m] is inside."""
        return bool(self.distances(np.array([x]), np.array([y]))[0] <= 0.0)

    def distances(self, x: Floats, y: Floats) -> Floats:
        """Return how far outside each place is [m]; 0 inside."""
        inside = np.zeros(x.shape, np.bool_)
        best = np.full(x.shape, inf)
        for (ax, ay), (bx, by) in pairwise((*self.corners, self.corners[0])):
            ux, uy = bx - ax, by - ay
            along = ((x - ax) * ux + (y - ay) * uy) / max(ux * ux + uy * uy, 1e-12)
            along = np.clip(along, 0.0, 1.0)
            best = np.minimum(best, np.hypot(x - ax - along * ux, y - ay - along * uy))
            if ay != by:
                inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * ux / uy)
        best[inside] = 0.0
        return best


class Zones:
    """The zones on a grid, and the limits of speed. State: the tiles that were drawn."""

    def __init__(
        self, zones: Mapping[str, Zone], resolution: float, outer: float, tile: int, fastest: float
    ) -> None:
        """`outer` [m]: radius of a circle that contains the robot; `tile`: cells along a side of a tile;
        `fastest` [m/s]: speed without a limit."""
        self._zones, self._resolution, self._outer, self._tile = list(zones.values()), resolution, outer, tile
        self.prices = [max(1.0, fastest / zone.speed) if zone.speed else inf for zone in self._zones]
        """Of each zone, how much more a metre costs there; infinite where it must not go"""
        self._drawn: dict[tuple[int, int], Marks | None] = {}

    def marks(self, tile: tuple[int, int]) -> Marks | None:
        """Return for each cell of a tile the zone that it is in, counted from 1, of several the dearest; 0:
        none. None: there is no zone in the whole tile."""
        if not self._zones:
            return None
        if tile not in self._drawn:
            self._drawn[tile] = self._draw(tile)
        return self._drawn[tile]

    def _draw(self, tile: tuple[int, int]) -> Marks | None:
        side, cell = self._tile * self._resolution, self._resolution
        low_y, low_x = tile[0] * side, tile[1] * side
        middles = (np.arange(self._tile) + 0.5) * cell
        x, y = np.meshgrid(low_x + middles, low_y + middles)
        marks: Marks = np.zeros((self._tile, self._tile), np.uint8)
        for number in sorted(range(len(self._zones)), key=lambda one: self.prices[one]):
            zone, reach = self._zones[number], self.reach(number)
            xs, ys = zip(*zone.corners, strict=True)
            if (
                max(xs) + reach >= low_x
                and min(xs) - reach <= low_x + side
                and max(ys) + reach >= low_y
                and min(ys) - reach <= low_y + side
            ):
                marks[zone.distances(x, y) <= reach] = number + 1
        return marks if marks.any() else None

    def reach(self, number: int) -> float:
        """Return how far beyond its edge a zone counts [m]."""
        return self._outer if self.prices[number] == inf else 0.0

    def holding(self, here: Point) -> set[int]:
        """Return the keep-out zones that the robot is in."""
        x, y = np.array([here[0]]), np.array([here[1]])
        margin = 2.0 * self._resolution
        return {
            number
            for number, zone in enumerate(self._zones)
            if self.prices[number] == inf and zone.distances(x, y)[0] <= self.reach(number) + margin
        }

    def limit(self, x: float, y: float) -> float:
        """Return the largest speed at a place [m/s]; infinite outside of all slow zones."""
        return min((one.speed for one in self._zones if one.speed and one.contains(x, y)), default=inf)
