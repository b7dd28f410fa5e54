"""A place made of an occupancy grid: what is occupied in it stands there, as fixed boxes.

Rules. Cells that are occupied side by side in a row are one box, and rows in which the same columns are
occupied are one. What is not known is free: a simulated lidar sees what the recorded one saw, and no more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import MapView, Pose
from gateway.errors import UserError
from gateway.sim.files import Box, SceneFile, Start

HEIGHT = 2.0
"""m of what stands there: above every lidar of a robot on the ground"""
MOST_BOXES = 5_000
"""More would take minutes to simulate a second."""
SURE = 0.62
"""Log-odds from which on a cell is taken as occupied: a probability of 0.65, as `gateway map` writes it"""

Bools = npt.NDArray[np.bool_]


class Grid(NamedTuple):
    """Which cells are occupied."""

    occupied: Bools
    """Rows from the lowest on"""
    resolution: float
    """m per cell"""
    origin: tuple[float, float, float]
    """m, m, rad: the lower left corner of the first cell, and how the rows are turned"""


def grid_of(view: MapView) -> Grid:
    """Return the occupied cells of a robot's map."""
    return Grid(view.log_odds > SURE, view.resolution, (view.origin_x, view.origin_y, 0.0))


def place_of(grid: Grid, name: str, start: Pose, clear: float = 0.0) -> SceneFile:
    """Return the place that a grid shows.

    Args:
        grid: its occupied cells.
        name: for reports.
        start: where the robot begins; within `clear` [m] of it nothing stands.
        clear: m

    Raises:
        UserError: nothing is occupied, or so much that it cannot be simulated.
    """
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)

    def at(along: float, up: float) -> tuple[float, float]:
        along, up = along * grid.resolution, up * grid.resolution
        return x + c * along - s * up, y + s * along + c * up

    occupied = grid.occupied.copy()
    rows, columns = np.nonzero(occupied)
    dx, dy = (start.x - x) / grid.resolution, (start.y - y) / grid.resolution
    away = np.hypot(columns + 0.5 - (c * dx + s * dy), rows + 0.5 - (c * dy - s * dx))
    near = away < clear / grid.resolution
    occupied[rows[near], columns[near]] = False
    found = list(rectangles(occupied))
    if not 1 <= len(found) <= MOST_BOXES:
        text = f"{len(found)} boxes stand in it; expected 1 to {MOST_BOXES}: map it with larger cells"
        raise UserError(f"{name}: {text}" if found else f"{name}: nothing is occupied in it: it is no world")
    boxes = {}
    for row, column, high, wide in found:
        middle = at(column + wide / 2.0, row + high / 2.0)
        size = (wide * grid.resolution, high * grid.resolution, HEIGHT)
        boxes[f"{row}_{column}"] = Box(*middle, size, yaw)
    return SceneFile("scene", name, Start(start.x, start.y, start.yaw), boxes=boxes)


def rectangles(occupied: Bools) -> Iterator[tuple[int, int, int, int]]:
    """Yield row, column, rows and columns of rectangles that cover the occupied cells, each once."""
    going: dict[tuple[int, int], int] = {}
    """First row by the columns from, and to, of those that may go on"""
    for row, cells in enumerate([*occupied, np.zeros(occupied.shape[1], dtype=np.bool_)]):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], cells, [False]]))).tolist()
        runs = list(zip(edges[::2], edges[1::2], strict=True))
        for run in [each for each in going if each not in runs]:
            first = going.pop(run)
            yield first, run[0], row - first, run[1] - run[0]
        for run in runs:
            going.setdefault(run, row)
