"""A map from before, in which a robot begins: cells of its own map, and the surfaces of the walls in them.

Rules. What was saved are cells, occupied or free to some degree, at a resolution and an origin of their own;
here they become log-odds of the robot's own cells. Of the same resolution, and unturned, they are the same
cells. Of finer ones the occupied win: no wall is lost. A wall's surface is found from the occupied cells
beside free ground: a line through those about it that face the same free side. Where both sides are free, the
cells stand in turn for one side and the other. It never changes, so a copy of it is itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.perception.lines import TILE
from brain.perception.saved_keyframes import SavedKeyframes
from brain.perception.tiles import UNIT
from protocols.bounds import Bounds, Invalid, check

Values = npt.NDArray[np.int8]
"""Log-odds in steps of `UNIT`, rows from the lowest y on"""
Percents = npt.NDArray[np.int8]
"""How sure a cell is occupied, 0 to 100 %; -1: not known. As nav_msgs/OccupancyGrid has it"""

MOST_CELLS = 1 << 24
"""Of a map, in its own cells and in the robot's"""
BESIDE, ABOUT = 2, 3
"""Cells about one in which free ground shows its side, and in which others make its line"""
LEAST, ROUGH, SIDED = 4, 0.4, 1.0
"""Cells that make a line; their variance across it [cells²], at most; and how much more free ground there
must be on one side, for it to be the only one"""
SQUARE = 4.0
"""m: side of the squares by which surfaces are found"""


@dataclass(frozen=True, slots=True)
class Start:
    """Where the robot is when it begins, in the frame "map"."""

    x: Annotated[float, Bounds(-10_000.0, 10_000.0, "m")] = 0.0
    y: Annotated[float, Bounds(-10_000.0, 10_000.0, "m")] = 0.0
    yaw: Annotated[float, Bounds(-2.0 * math.pi, 2.0 * math.pi, "rad")] = 0.0
    sigma: Annotated[float, Bounds(0.001, 5.0, "m")] = 0.25
    """m: standard deviation along x and y,"""
    sigma_yaw: Annotated[float, Bounds(0.001, math.pi, "rad")] = 0.26
    """and of yaw"""

    def __post_init__(self) -> None:
        check(self)

    @property
    def pose(self) -> Pose:
        """Where."""
        return Pose(self.x, self.y, self.yaw)

    @property
    def covariance(self) -> Floats:
        """How surely, 3 × 3."""
        return np.diag([self.sigma**2, self.sigma**2, self.sigma_yaw**2])


class Drawing(NamedTuple):
    """What was saved."""

    percents: Percents
    """Rows from the lowest on"""
    resolution: float
    """m per cell"""
    origin: tuple[float, float, float]
    """m, m, rad: the lower left corner of the first cell, and how the rows are turned"""


class Walls(NamedTuple):
    """The surfaces of occupied cells, n each."""

    columns: npt.NDArray[np.int64]
    """Of the robot's map; so are the rows"""
    rows: npt.NDArray[np.int64]
    offsets: Floats
    """Cells from the middle of the cell to the surface, along the normal"""
    normals: Floats
    """n × 2, to the free side"""


class SavedMap:
    """The map that a robot begins in.

    Args:
        drawing: what was saved.
        resolution: m per cell of the robot's map,
        low: and log-odds of its cells, at least,
        high: and at most.
        start: where the robot is in it; None: it looks for its place.
        remark: what a person should look at, or "".
        keyframes: of which it was drawn, if they were saved, too.
    """

    def __init__(
        self,
        drawing: Drawing,
        resolution: float,
        low: float,
        high: float,
        start: Start | None = None,
        remark: str = "",
        keyframes: SavedKeyframes | None = None,
    ) -> None:
        """Raises Invalid if it has too many cells, or none that is known."""
        self.resolution, self.start, self.remark = resolution, start, remark
        self.keyframes = keyframes
        percents, corner = _laid(drawing, resolution)
        odds = np.clip(percents, 1, 99) / 100.0
        log_odds = np.where(percents == 100, high, np.where(percents == 0, low, np.log(odds / (1.0 - odds))))
        values = np.rint(np.clip(log_odds, low, high) / UNIT) * (percents >= 0)
        self._values: Values = values.astype(np.int8)
        self._corner = corner
        if not self._values.any():
            raise Invalid(("", "no cell of it is occupied or free: there is nothing to begin in"))
        self.walls = _walls(self._values, corner)
        self._surfaces = _squares(self.walls, resolution)
        self.variance = (0.5 * resolution) ** 2
        """m², of where its walls are"""

    def __deepcopy__(self, memo: object) -> SavedMap:
        return self

    @property
    def text(self) -> str:
        """Its size, and what is known of it, in words."""
        height, width = (side * self.resolution for side in self._values.shape)
        shares = [100.0 * float(np.mean(kind)) for kind in (self._values > 0, self._values < 0)]
        text = f"{width:.1f} m x {height:.1f} m, {shares[0]:.1f} % occupied, {shares[1]:.1f} % free"
        return text if self.keyframes is None else f"{text}, {len(self.keyframes.kept)} keyframes"

    def tiles(self) -> Iterator[tuple[tuple[int, int], Values]]:
        """Yield row, column and values of each tile in which something is known."""
        (row, column), (high, wide) = self._corner, self._values.shape
        bottom, left = row % TILE, column % TILE
        top, right = -(bottom + high) % TILE, -(left + wide) % TILE
        whole = np.pad(self._values, ((bottom, top), (left, right)))
        parts = whole.reshape(whole.shape[0] // TILE, TILE, whole.shape[1] // TILE, TILE).swapaxes(1, 2)
        for at in np.argwhere(parts.any(axis=(2, 3))).tolist():
            yield (row // TILE + at[0], column // TILE + at[1]), parts[at[0], at[1]]

    def near(self, x: float, y: float, far: float) -> tuple[Floats, Floats]:
        """Return points [m] and normals of its walls within a distance of a position, n × 2 each."""
        keys, points, normals = self._surfaces
        low, high, left, right = (math.floor(edge / SQUARE) for edge in (y - far, y + far, x - far, x + far))
        rows = np.arange(low, high + 1) << 24
        starts = np.searchsorted(keys, rows + left, "left").tolist()
        ends = np.searchsorted(keys, rows + right, "right").tolist()
        some = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])
        some = some[np.hypot(*(points[some] - (x, y)).T) < far]
        return points[some], normals[some]


def _laid(drawing: Drawing, resolution: float) -> tuple[Percents, tuple[int, int]]:
    """Return what was saved in the robot's cells, and the row and column of the first. Raises Invalid."""
    source, own = drawing.percents, drawing.resolution
    (x, y, yaw), (high, wide) = drawing.origin, source.shape
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, s], [-s, c]])
    corners = (np.array([[0, 0], [wide, 0], [0, high], [wide, high]]) * own) @ turn + (x, y)
    edge = 1e-6  # of a cell, by which a decimal fraction may be off
    first = np.floor(corners.min(axis=0) / resolution + edge).astype(np.int64)
    size = np.ceil(corners.max(axis=0) / resolution - edge).astype(np.int64) - first
    if int(size[0]) * int(size[1]) > MOST_CELLS:
        text = f"it has {size[0]} x {size[1]} cells of {resolution:g} m"
        raise Invalid(("", f"{text}; expected at most {MOST_CELLS}"))
    columns, rows = np.meshgrid(*(np.arange(count) + 0.5 for count in size.tolist()))
    middles = np.column_stack([columns.ravel(), rows.ravel()]) + first
    at = np.floor(((middles * resolution - (x, y)) @ turn.T) / own).astype(np.int64)
    inside = ((at >= 0) & (at < (wide, high))).all(axis=1)
    laid: Percents = np.full(len(at), -1, dtype=np.int8)
    laid[inside] = source[at[inside, 1], at[inside, 0]]
    walls = np.argwhere(source > 50)
    cells = np.floor(((walls[:, ::-1] + 0.5) * own @ turn + (x, y)) / resolution).astype(np.int64) - first
    cells = np.clip(cells, 0, size - 1)
    np.maximum.at(laid, cells[:, 1] * size[0] + cells[:, 0], source[walls[:, 0], walls[:, 1]])
    return laid.reshape(size[1], size[0]), (int(first[1]), int(first[0]))


def _window(away: int) -> Iterator[tuple[int, int]]:
    for down in range(-away, away + 1):
        for right in range(-away, away + 1):
            yield down, right


def _walls(values: Values, corner: tuple[int, int]) -> Walls:
    """Return the surfaces of occupied cells beside free ones."""
    padded = np.pad(values, ABOUT)
    free = padded < 0
    by_free = np.zeros_like(free)
    for down, right in _window(1):
        by_free[1:-1, 1:-1] |= free[1 + down : len(free) - 1 + down, 1 + right : free.shape[1] - 1 + right]
    rows, columns = np.nonzero((padded > 0) & by_free)
    out = np.zeros((len(rows), 2))
    for down, right in _window(BESIDE):
        far = math.hypot(down, right) or 1.0
        out += free[rows + down, columns + right, None] * np.array([right / far, down / far])
    sided = np.hypot(*out.T) > SIDED
    numbers = np.full(padded.shape, -1, dtype=np.int64)
    numbers[rows, columns] = np.arange(len(rows))
    sums = np.zeros((6, len(rows)))
    for down, right in _window(ABOUT):
        other = numbers[rows + down, columns + right]
        same = (other >= 0) & (~sided | ~sided[other] | ((out * out[other]).sum(axis=1) > 0.0))
        moments = (1.0, right, down, right * right, right * down, down * down)
        sums += same * np.array(moments, dtype=np.float64)[:, None]
    count, x, y, xx, xy, yy = sums
    x, y = x / count, y / count
    xx, xy, yy = xx / count - x * x, xy / count - x * y, yy / count - y * y
    across = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normals = np.column_stack([-np.sin(angle), np.cos(angle)])
    facing = np.where(sided, np.sign((normals * out).sum(axis=1)), 1.0 - 2.0 * ((rows + columns) % 2))
    normals *= facing[:, None]
    straight = (count >= LEAST) & (across < ROUGH) & (facing != 0.0)
    offsets = normals[:, 0] * x + normals[:, 1] * y
    row, column = corner
    return Walls(
        (columns - ABOUT + column)[straight],
        (rows - ABOUT + row)[straight],
        offsets[straight],
        normals[straight],
    )


def _squares(walls: Walls, resolution: float) -> tuple[npt.NDArray[np.int64], Floats, Floats]:
    """Return half of the surfaces, sorted by squares: their keys (row, column), points and normals."""
    some = (walls.rows + walls.columns) // 2 % 2 == 0  # of both sides of walls that have two
    middles = np.column_stack([walls.columns, walls.rows])[some] + 0.5
    points = (middles + walls.normals[some] * walls.offsets[some, None]) * resolution
    columns, rows = np.floor(points / SQUARE).astype(np.int64).T
    keys = (rows << 24) + columns
    order = np.argsort(keys, kind="stable")
    return keys[order], points[order], walls.normals[some][order]
