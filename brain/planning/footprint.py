"""The robot's outline on a map: where it fits, with its heading, among the occupied cells.

Rules. Where the circle that contains the outline fits, every heading does; where not even the largest circle
inside of it does, none does: both are read off the levels. Between them, the middle of each occupied cell
must be farther than half a cell from the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, ceil, cos, dist, floor, hypot, sin

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from brain.planning.costmap import NEAR, OCCUPIED, UNKNOWN, Costmap, Mask
from brain.planning.polyline import Point
from brain.planning.snapshot import Ground

MOST_POINTS = 20_000
"""Pairs of a pose and a cell about it that are looked at together: bounds the memory."""


@dataclass(frozen=True, slots=True)
class Shape:
    """What planning knows of a body."""

    inner: float
    """m: radius of the largest circle about the origin inside of the outline"""
    outer: float
    """m: of the smallest that contains it"""
    corners: tuple[Point, ...] | None = None
    """m, of the outline, counter-clockwise; None: a circle"""
    turning_radius: float = 0.0
    """m, of the tightest way; 0: it turns on the spot"""

    @classmethod
    def of(cls, body: Base) -> Shape:
        """Return the shape of a body."""
        if body.footprint is None:
            return cls(body.radius, body.radius, None, body.turning_radius)
        outer = max(hypot(*corner) for corner in body.footprint)
        return cls(body.inner_radius, outer, body.footprint, body.turning_radius)

    @classmethod
    def circle(cls, radius: float) -> Shape:
        """Return a circle [m] that turns on the spot."""
        return cls(radius, radius)


class Footprint:
    """The outline, for maps of one resolution. Constant."""

    def __init__(self, shape: Shape, resolution: float) -> None:
        self.shape = shape
        corners = np.array(shape.corners or ((0.0, 0.0),))
        edges = np.roll(corners, -1, axis=0) - corners
        long = np.maximum(np.hypot(edges[:, 0], edges[:, 1]), 1e-12)
        self._normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / long[:, None]
        self._offsets: Floats = (self._normals * corners).sum(axis=1) + 0.5 * resolution
        reach = ceil((shape.outer + 0.5 * resolution) / resolution + 0.5)
        side = np.arange(-reach, reach + 1)
        rows, columns = (each.reshape(-1) for each in np.meshgrid(side, side, indexing="ij"))
        close = np.hypot(rows, columns) * resolution <= shape.outer + 1.5 * resolution
        self._rows, self._columns = rows[close], columns[close]

    @property
    def cells(self) -> int:
        """How many cells about a pose are looked at."""
        return len(self._rows)

    def collides(self, ground: Ground, x: Floats, y: Floats, yaw: Floats) -> Mask:
        """Return at which poses [m, m, rad] the outline meets an obstacle."""
        rows, columns = (np.floor(at / ground.resolution).astype(np.int64) for at in (y, x))
        level = ground.levels(rows, columns) % UNKNOWN
        hit: Mask = level < NEAR
        if self.shape.corners is None:
            return hit
        unsure = np.flatnonzero(~hit & (level < ground.wide))
        most = max(1, MOST_POINTS // self.cells)
        for first in range(0, len(unsure), most):
            some = unsure[first : first + most]
            hit[some] = self._meets(ground, rows[some], columns[some], x[some], y[some], yaw[some])
        return hit

    def _meets(
        self,
        ground: Ground,
        rows: np.ndarray[tuple[int], np.dtype[np.int64]],
        columns: np.ndarray[tuple[int], np.dtype[np.int64]],
        x: Floats,
        y: Floats,
        yaw: Floats,
    ) -> Mask:
        """Return at which poses an occupied cell's middle is less than half a cell from the outline."""
        around_rows, around_columns = rows[:, None] + self._rows, columns[:, None] + self._columns
        levels = ground.levels(around_rows.reshape(-1), around_columns.reshape(-1))
        pose, cell = np.nonzero((levels == OCCUPIED).reshape(around_rows.shape))
        dx = (around_columns[pose, cell] + 0.5) * ground.resolution - x[pose]
        dy = (around_rows[pose, cell] + 0.5) * ground.resolution - y[pose]
        c, s = np.cos(yaw[pose]), np.sin(yaw[pose])
        ahead, left = c * dx + s * dy, c * dy - s * dx
        outside = np.multiply.outer(self._normals[:, 0], ahead) + np.multiply.outer(self._normals[:, 1], left)
        within = (outside < self._offsets[:, None]).all(axis=0)
        met: Mask = np.bincount(pose, within, len(x)) > 0.0
        return met

    def clearance(self, costmap: Costmap, pose: Pose, most: float) -> float:
        """Return the distance [m] from the outline to the nearest occupied cell, as far as the levels of the
        map resolve it; where not every heading fits, from the outline itself, from 0 to `most`."""
        rough = costmap.clearance(pose.x, pose.y)
        if not 0.0 < rough <= costmap.resolution or self.shape.corners is None:
            return rough
        reach = ceil((self.shape.outer + most) / costmap.resolution) + 1
        rows, columns = (each.reshape(-1) for each in np.indices((2 * reach + 1, 2 * reach + 1)) - reach)
        rows += floor(pose.y / costmap.resolution)
        columns += floor(pose.x / costmap.resolution)
        occupied = np.flatnonzero(costmap.levels(rows, columns) == OCCUPIED)
        dx = (columns[occupied] + 0.5) * costmap.resolution - pose.x
        dy = (rows[occupied] + 0.5) * costmap.resolution - pose.y
        c, s = cos(pose.yaw), sin(pose.yaw)
        beyond = self._normals @ np.stack([c * dx + s * dy, c * dy - s * dx]) - self._offsets[:, None]
        return max(0.0, float(beyond.max(axis=0).min(initial=most)))

    def turn_fits(self, ground: Ground, at: Point, before: float, after: float) -> bool:
        """Return whether it can turn on the spot from one heading to another [rad], the shorter way."""
        turn = np.remainder(after - before + np.pi, 2.0 * np.pi) - np.pi
        yaw = before + turn * np.linspace(0.0, 1.0, 2 + int(abs(turn) / TURN_STEP))
        return not self.collides(ground, np.full(len(yaw), at[0]), np.full(len(yaw), at[1]), yaw).any()

    def line_fits(self, ground: Ground, start: Point, end: Point) -> bool:
        """Return whether it can drive straight from a point to another."""
        count = 2 + int(dist(start, end) / ground.resolution)
        x, y = (np.linspace(a, b, count) for a, b in zip(start, end, strict=True))
        yaw = np.full(count, atan2(end[1] - start[1], end[0] - start[0]))
        return not self.collides(ground, x, y, yaw).any()

    def fits_either_way(self, ground: Ground, start: Point, end: Point) -> bool:
        """Return whether it can drive straight from a point to another, forward or backward."""
        circle = self.shape.corners is None
        return circle or self.line_fits(ground, start, end) or self.line_fits(ground, end, start)

    def way_fits(self, ground: Ground, points: Sequence[Point], headings: Sequence[float]) -> bool:
        """Return whether it can take each of these places with its heading [rad]."""
        x, y = np.array(points).T
        return not self.collides(ground, x, y, np.array(headings)).any()


TURN_STEP = 0.1
"""rad between two headings of a turn on the spot that are looked at"""
