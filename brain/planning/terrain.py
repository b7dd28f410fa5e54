"""The ground of a base: the costmap that it plans on, and its footprint there."""

from __future__ import annotations

from math import cos, sin

from brain.belief import Pose
from brain.bodies.body import Base
from brain.planning.costmap import NEAR, TILE_WORK, UNKNOWN, Costmap, Map, PlannerSettings
from brain.planning.footprint import Footprint, Shape
from brain.planning.polyline import Point
from brain.planning.snapshot import is_blocked

TILES_PER_STEP = 2
"""Changed tiles of the costmap that a step draws."""


class Terrain:
    """The ground of one base. State is plain data."""

    def __init__(self, body: Base, settings: PlannerSettings, resolution: float) -> None:
        self._made_for = body, settings
        shape = Shape.of(body)
        self.footprint = Footprint(shape, resolution)
        self.costmap = Costmap(resolution, shape.inner, settings, shape.outer, body.max_linear)

    def is_for(self, body: Base, settings: PlannerSettings) -> bool:
        """True if it was made for these."""
        return self._made_for == (body, settings)

    def update(self, grid: Map, here: Point) -> int:
        """Draw what has changed in the map; return the work that this took."""
        return TILE_WORK * self.costmap.update(grid, here, TILES_PER_STEP)

    def clearance(self, pose: Pose, most: float) -> float:
        """Return the distance [m] from the footprint to the nearest obstacle of the map; more than `most`
        may be `most`."""
        return self.footprint.clearance(self.costmap, pose, most)

    def has_room_behind(self, here: Point, yaw: float, back: float) -> bool:
        """Return whether the robot fits `back` m behind where it is, on known ground."""
        behind = here[0] - back * cos(yaw), here[1] - back * sin(yaw)
        known = self.costmap.level_at(*behind) < UNKNOWN
        return known and not is_blocked(self.costmap, here, behind, NEAR)
