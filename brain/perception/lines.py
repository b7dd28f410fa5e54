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
SIDE, BITS = 16, 4
"""Cells along a block's sides, and its logarithm"""
GROWTH = 64
"""Blocks by which their memory grows"""
MAX_ANCHORS = 16_384
"""Then the oldest is replaced"""
NEW_ANCHOR = 0.3
"""m and rad that the robot moves between two anchors"""
FEW = 0.06
"""Share of a scan's surfaces that is not worth drawing: strays in a place that is known"""


class Lines:
    """Lines and anchors, for an extent whose sides are powers of two."""

    def __init__(self, rows: int, columns: int) -> None:
        self._blocks = np.zeros((rows // SIDE, columns // SIDE), dtype=np.int64)
        """First line of each block of cells; 0: those of the first block, which stays empty"""
        self._lines: Records = np.zeros(SIDE * SIDE, dtype=LINE)
        self._unused: list[int] = []
        self._most = self._blocks.size * 3 // 8
        """Blocks; with more, further cells have no lines."""
        self.poses = np.zeros((MAX_ANCHORS, 3))
        """Anchors: pose of the robot [m, m, rad]"""
        self.covariances = np.zeros((MAX_ANCHORS, 3, 3))
        """Anchors: covariance of that pose"""
        self._anchors = 0

    def at(self, columns: Indices, rows: Indices) -> Records:
        """Return the lines of cells, given by numbers of any shape; they are taken modulo the extent."""
        lines: Records = self._lines.take(self._places(columns, rows))
        return lines

    def _places(self, columns: Indices, rows: Indices) -> Indices:
        down, across = self._blocks.shape
        block = ((rows >> BITS) & (down - 1)) * across + ((columns >> BITS) & (across - 1))
        places: Indices = self._blocks.take(block)
        places += ((rows & (SIDE - 1)) << BITS) + (columns & (SIDE - 1))
        return places

    def draw(
        self,
        columns: Indices,
        rows: Indices,
        points: Floats,
        normals: Floats,
        pose: Pose,
        covariance: Floats,
    ) -> None:
        """Add the surfaces [cells] that a scan hit in cells, where these still take them."""
        wanted = np.flatnonzero(self.at(columns, rows)["scans"] < MAX_SCANS)
        if len(wanted) < FEW * len(columns):
            return
        columns, rows, normals = columns[wanted], rows[wanted], normals[wanted]
        offsets = np.sum((points[wanted] - np.column_stack([columns, rows]) - 0.5) * normals, axis=1)
        _, first, which = np.unique((rows << 32) + columns, return_index=True, return_inverse=True)
        columns, rows = columns[first], rows[first]
        number = np.bincount(which)
        nx, ny, offset = (
            np.bincount(which, weights=w) / number for w in (normals[:, 0], normals[:, 1], offsets)
        )
        self._allocate(columns, rows)
        places = self._places(columns, rows)
        lines = self._lines[places]
        scans, angle = lines["scans"], lines["angle"] * TURN
        c, s = np.cos(angle), np.sin(angle)
        kept = (
            ((scans == 0) | (nx * c + ny * s > 0.0)) & (np.abs(offset) < MAX_OFFSET) & (places >= SIDE * SIDE)
        )
        angle = np.arctan2(scans * s + ny, scans * c + nx)
        lines["angle"] = np.rint(angle / TURN).astype(np.int64).astype(np.int16)
        offset = (scans * (lines["offset"] / PER_CELL) + offset) / (scans + 1)
        lines["offset"] = np.rint(np.clip(offset, -MAX_OFFSET, MAX_OFFSET) * PER_CELL)
        new = scans == 0
        lines["anchor"][new] = self._anchor(pose, covariance)
        lines["scans"] += 1
        self._lines[places[kept]] = lines[kept]

    def forget(self, columns: Indices, rows: Indices) -> None:
        """Remove the lines of cells."""
        places = self._places(columns, rows)
        self._lines[places[places >= SIDE * SIDE]] = 0

    def drop(self, rows: slice, columns: slice, tile: int) -> None:
        """Remove the lines of tiles, by where they are in memory."""
        per = tile // SIDE
        size = self._blocks.shape
        blocks = self._blocks.reshape(size[0] // per, per, size[1] // per, per)[rows, :, columns]
        drawn = blocks > 0
        used = blocks[drawn]
        self._lines.reshape(-1, SIDE * SIDE)[used // SIDE**2] = 0
        self._unused += used.tolist()
        blocks[drawn] = 0

    def _allocate(self, columns: Indices, rows: Indices) -> None:
        """Make room for the lines of cells."""
        down, across = self._blocks.shape
        rows, columns = (rows >> BITS) & (down - 1), (columns >> BITS) & (across - 1)
        missing = self._blocks[rows, columns] == 0
        for row, column in sorted(set(zip(rows[missing].tolist(), columns[missing].tolist(), strict=True))):
            if not self._unused:
                have = len(self._lines) // SIDE**2
                more = min(GROWTH, self._most - have)
                if more <= 0:
                    return
                self._lines.resize((have + more) * SIDE**2, refcheck=False)
                self._unused = [SIDE**2 * block for block in range(have + more - 1, have - 1, -1)]
            self._blocks[row, column] = self._unused.pop()

    def _anchor(self, pose: Pose, covariance: Floats) -> int:
        """Return the anchor of cells drawn from a pose: the last one if it is near."""
        last = (self._anchors - 1) % MAX_ANCHORS
        x, y, yaw = self.poses[last]
        moved = max(math.hypot(pose.x - x, pose.y - y), abs(wrap(pose.yaw - yaw)))
        if self._anchors and moved < NEW_ANCHOR:
            return last
        new = self._anchors % MAX_ANCHORS
        self.poses[new] = pose.x, pose.y, pose.yaw
        self.covariances[new] = covariance
        self._anchors += 1
        return new
