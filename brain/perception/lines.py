"""The lines of the map's occupied cells: where, in a cell, the surface runs that was hit there.

Rules. A line has a unit normal, to the side from which the surface was seen, and an offset from the cell's
centre along it. Both are means over the first scans that hit the cell, whose surfaces they are (see
`BodyScan`): later ones are matched to them. A cell seen from two sides keeps the one it was first seen from.
Each cell also remembers the anchor of its first scan: pose and covariance of the robot then. Lines are
few: they are kept in blocks of 16 × 16 cells, only where there are any, of 8 bytes a cell.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap

Indices = npt.NDArray[np.int64]

LINE = np.dtype([("angle", np.int16), ("offset", np.int16), ("scans", np.uint16), ("anchor", np.uint16)])
"""Direction of the normal [TURN]; offset [cells / PER_CELL]; scans in both means, 0: no line; its anchor"""
Records = npt.NDArray[np.void]

TURN = 2.0 * math.pi / 65536.0
"""rad"""
PER_CELL, MAX_OFFSET = 8192.0, 3.9
"""Steps per cell; cells"""
MAX_SCANS = 10
"""In a cell's means: the first ones"""
TILE = 64
"""Cells along a tile's sides"""
AREA = TILE * TILE
SIDE, BITS = 16, 4
"""Cells along a block's sides, and its logarithm"""
BLOCK = (SIDE - 1) * (TILE + 1)
"""Bits of a place that are within a block"""
GROWTH = 64
"""Blocks, and anchors, by which their memory grows"""
MAX_ANCHORS = 65_536
"""As an index has bits for: 20 km of ground never seen before. Then the oldest is replaced"""
NEW_ANCHOR = 0.3
"""m and rad that the robot moves between two anchors"""
FEW = 0.06
"""Share of a scan's surfaces that is not worth drawing: strays in a place that is known"""


class Lines:
    """Lines and anchors, by the places of cells (see `Tiles`); not those of the cells below `AREA`."""

    def __init__(self, tiles: int) -> None:
        """`tiles`: that there are at most."""
        self._starts = np.zeros(AREA // SIDE, dtype=np.int32)
        """First line of each SIDE cells in a row; 0: those of the first block, which stays empty"""
        self._lines: Records = np.zeros(SIDE * SIDE, dtype=LINE)
        self._unused: list[int] = []
        self._most = tiles * AREA // SIDE**2 * 3 // 8
        """Blocks; with more, further cells have no lines."""
        self.poses = np.zeros((GROWTH, 3))
        """Anchors: pose of the robot [m, m, rad]"""
        self.covariances = np.zeros((GROWTH, 3, 3))
        """Anchors: covariance of that pose"""
        self._anchors = 0

    def at(self, places: Indices) -> Records:
        """Return the lines of cells."""
        lines: Records = self._lines.take(self._numbers(places))
        return lines

    def _numbers(self, places: Indices) -> Indices:
        numbers: Indices = self._starts.take(places >> BITS) + (places & (SIDE - 1))
        return numbers

    def draw(self, places: Indices, points: Floats, normals: Floats, pose: Pose, covariance: Floats) -> None:
        """Add the surfaces that a scan hit in cells, where these still take them: a point of each [cells],
        from the middle of its cell, and its normal."""
        wanted = np.flatnonzero(self.at(places)["scans"] < MAX_SCANS)
        if len(wanted) < FEW * len(places):
            return
        normals = normals[wanted]
        offsets = np.sum(points[wanted] * normals, axis=1)
        places, which = np.unique(places[wanted], return_inverse=True)
        number = np.bincount(which)
        nx, ny, offset = (
            np.bincount(which, weights=w) / number for w in (normals[:, 0], normals[:, 1], offsets)
        )
        self._allocate(places)
        numbers = self._numbers(places)
        lines = self._lines[numbers]
        scans, angle = lines["scans"], lines["angle"] * TURN
        c, s = np.cos(angle), np.sin(angle)
        kept = ((scans == 0) | (nx * c + ny * s > 0.0)) & (np.abs(offset) < MAX_OFFSET)
        kept &= numbers >= SIDE * SIDE
        angle = np.arctan2(scans * s + ny, scans * c + nx)
        lines["angle"] = np.rint(angle / TURN).astype(np.int64).astype(np.int16)
        offset = (scans * (lines["offset"] / PER_CELL) + offset) / (scans + 1)
        lines["offset"] = np.rint(np.clip(offset, -MAX_OFFSET, MAX_OFFSET) * PER_CELL)
        new = scans == 0
        lines["anchor"][new] = self._anchor(pose, covariance)
        lines["scans"] += 1
        self._lines[numbers[kept]] = lines[kept]

    def forget(self, places: Indices) -> None:
        """Remove the lines of cells."""
        numbers = self._numbers(places)
        self._lines[numbers[numbers >= SIDE * SIDE]] = 0

    def drop(self, first: int) -> None:
        """Remove the lines of a tile, from the place of its first cell on."""
        starts = self._starts[first // SIDE : (first + AREA) // SIDE]
        used = np.unique(starts[starts > 0] // SIDE**2)
        self._lines.reshape(-1, SIDE * SIDE)[used] = 0
        self._unused += (used * SIDE**2).tolist()
        starts[:] = 0

    def extend(self, places: int) -> None:
        """Make room for cells up to a place."""
        self._starts.resize(places // SIDE, refcheck=False)

    def _allocate(self, places: Indices) -> None:
        """Make room for the lines of cells."""
        missing = places[self._starts.take(places >> BITS) == 0]
        for first in np.unique(missing & ~BLOCK).tolist():  # the first cells of blocks
            if not self._unused:
                have = len(self._lines) // SIDE**2
                more = min(GROWTH, self._most - have)
                if more <= 0:
                    return
                self._lines.resize((have + more) * SIDE**2, refcheck=False)
                self._unused = [SIDE**2 * block for block in range(have + more - 1, have - 1, -1)]
            start, row = self._unused.pop(), first // SIDE
            self._starts[row : row + TILE : TILE // SIDE] = np.arange(start, start + SIDE**2, SIDE)

    def _anchor(self, pose: Pose, covariance: Floats) -> int:
        """Return the anchor of cells drawn from a pose: the last one if it is near."""
        if self._anchors:
            last = (self._anchors - 1) % MAX_ANCHORS
            x, y, yaw = self.poses[last]
            if max(math.hypot(pose.x - x, pose.y - y), abs(wrap(pose.yaw - yaw))) < NEW_ANCHOR:
                return last
        new = self._anchors % MAX_ANCHORS
        if new >= len(self.poses):
            self.poses.resize((new + GROWTH, 3), refcheck=False)
            self.covariances.resize((new + GROWTH, 3, 3), refcheck=False)
        self.poses[new] = pose.x, pose.y, pose.yaw
        self.covariances[new] = covariance
        self._anchors += 1
        return new
