"""Scan matching: the robot's pose from a scan and the map, line to line, by Gauss-Newton.

Rules. For each of a bounded number of a scan's surfaces, evenly spread along them, the nearest line of the
map that faces the same way is searched; the surface's distance across that line is the residual: sliding
along a wall costs nothing. The pose with the least robust sum of squares is searched from the filter's
prediction, in a bounded number of steps; the search distance starts as wide as the prediction is uncertain.
The covariance comes from the lines used and from how well they fit; a direction that hardly any of them holds
is left open, as in a bare corridor: the scatter of the lines' own directions would else pass for a
constraint. Where too little of the scan lies on known lines there is no match: an ordinary result (None).
Sources: Chen and Medioni 1992 (point to plane); Censi 2008 (point to line, PLICP).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, rotated, to_world
from brain.perception.lines import PER_CELL, TURN
from brain.perception.map import Map
from protocols.bounds import Bounds, check, ordered

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Parameters of scan matching."""

    surfaces: Annotated[int, Bounds(10, 500)] = 100
    """Largest number of surfaces of a scan that are used"""
    steps: Annotated[int, Bounds(1, 20)] = 8
    """Gauss-Newton steps, at most"""
    reach: Annotated[float, Bounds(0.01, 1.0, "m")] = 0.1
    """m: search distance to each side for the map's line, where the prediction is good"""
    widest: Annotated[float, Bounds(0.01, 1.0, "m")] = 0.5
    """m: largest search distance, where the prediction is poor"""
    sigma: Annotated[float, Bounds(1e-3, 1.0, "m")] = 0.02
    """m: distance of surfaces from lines beyond twice which they count less (Cauchy)"""
    least: Annotated[int, Bounds(3, 500)] = 15
    """Least number of surfaces on lines"""
    overlap: Annotated[float, Bounds(0.01, 1.0)] = 0.25
    """Least share of lines among the surfaces that are on a line or in free cells"""
    hold: Annotated[float, Bounds(1e-6, 1.0)] = 0.02
    """A direction is observable if at least this share of the surfaces holds it"""
    floor: Annotated[float, Bounds(1e-5, 1.0, "m")] = 0.0004
    """m: error of the map's lines, even drawn from exact poses: it does not average out on the spot"""
    floor_yaw: Annotated[float, Bounds(1e-5, 1.0, "rad")] = 0.00025

    def __post_init__(self) -> None:
        check(self)
        ordered(self, "reach", "widest")


@dataclass(frozen=True, slots=True)
class MatchShares:
    """A scan compared with the classes of the map's cells: shares of its hits."""

    fit: float
    """Of those in known ground: beside occupied cells"""
    denied: float
    """Of those in known ground: in free cells"""
    known: float
    """In known ground"""
    crossed: float
    """Not beside occupied cells, but behind some: what appears hides walls, it is not seen through them"""


@dataclass(frozen=True, slots=True)
class Match:
    """Result of matching a scan."""

    pose: Pose
    noise: Floats
    """3 × 3 covariance of x, y, yaw about where the map's lines place the robot"""
    shared: Floats
    """3 × 3 covariance of those lines at the robot: from the poses that drew them, and in any map"""


SMALL = 0.01
"""m, rad: after a smaller step, the surfaces keep their lines"""
OPEN = 1e4
"""Variance [m², rad²] of a direction that no line holds."""
CORRELATED = 1.4
"""Neighbouring surfaces share hits and lines: this many of them carry the information of one."""
FACING = round(math.radians(50.0) / TURN)
"""Largest angle between a surface and a line that may be it"""
MAX_AWAY = 20
"""Cells about a surface in which its line is searched, at most"""
EXAMINED = 120
"""Hits of a scan that are compared with the map's classes, at most"""
FITTING = 0.85
"""Of a scan of which a larger share fits, no rays are followed."""
ALONG = 200
"""Points on a ray at which it is compared with the map, at most"""
SHORT_OF = 0.2
"""m before a ray's end, from where on the cells are those of its own hit"""


def _window(away: int) -> Indices:
    """Return cells (2 × n: columns, rows) to search, nearest first: all within 3, farther only along 16 rays.
    A straight line that passes within the distance meets some of them."""
    near = range(-min(away, 3), min(away, 3) + 1)
    cells = {(column, row) for column in near for row in near}
    for ray in range(16):
        c, s = math.cos(ray * math.pi / 8.0), math.sin(ray * math.pi / 8.0)
        cells |= {(round(c * far), round(s * far)) for far in range(4, away + 1)}
    return np.array(sorted(cells, key=lambda cell: (math.hypot(*cell), cell)), dtype=np.int64).T


WINDOWS = [_window(away) for away in range(MAX_AWAY + 1)]


def match(chart: Map, scan: BodyScan, predicted: Pose, sigma: float, settings: MatchSettings) -> Match | None:
    """Return the pose near the predicted one at which the scan fits the map; None if too little of it does.

    `sigma` [m]: standard deviation of the prediction. Lines are first searched as far away as that
    requires, then, from the improved pose, nearby."""
    chart.recenter(*scan.place(predicted))
    chosen = _spread(scan, settings.surfaces)
    if len(chosen) < settings.least:
        return None
    points, normals = scan.middles[chosen], scan.normals[chosen]
    directions = np.arctan2(normals[:, 1], normals[:, 0])
    reach, pose = min(max(3.0 * sigma, settings.reach), settings.widest), predicted
    pairs = None
    for _ in range(settings.steps):
        pairs = _paired(chart, points, directions, pose, reach, settings)
        if pairs is None:
            return None
        change, _ = _solved(pairs, pose, settings)
        pose = Pose(pose.x + float(change[0]), pose.y + float(change[1]), wrap(pose.yaw + float(change[2])))
        if reach == settings.reach and float(np.abs(change).max()) < SMALL:
            break
        reach = max(settings.reach, reach / 1.5)
    assert pairs is not None  # there is at least one step
    change, covariance = _solved(pairs, pose, settings)
    pose = Pose(pose.x + float(change[0]), pose.y + float(change[1]), wrap(pose.yaw + float(change[2])))
    floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
    # The lines' own error is new to the filter, and the same again at each scan from the same place.
    shared = _shared(chart, pairs.anchors, pose) + floor
    return Match(pose, covariance + floor, shared)


def examine(chart: Map, scan: BodyScan, pose: Pose) -> MatchShares:
    """Return how a scan taken at this pose compares with the classes of the map's cells.

    (In a new place hits lie in unknown cells: that is no contradiction.)"""
    hits = np.flatnonzero(scan.hit)
    hits = hits[:: math.ceil(len(hits) / EXAMINED) or 1]
    if not len(hits):
        return MatchShares(0.0, 0.0, 0.0, 0.0)
    place, ends = scan.place(pose), to_world(scan.ends[hits], pose)
    chart.recenter(*place)
    cells = chart.cells(ends)
    beside = WINDOWS[1]
    values = chart.values(cells[:, 0, None] + beside[0], cells[:, 1, None] + beside[1])
    occupied = (values > 0).any(axis=1)
    free = ~occupied & (values[:, 0] < 0)
    fits, denied = int(np.count_nonzero(occupied)), int(np.count_nonzero(free))
    known, crossed = max(fits + denied, 1), 0.0
    if fits < FITTING * len(hits):
        crossed = _crossing(chart, np.array(place), ends[~occupied]) / len(hits)
    return MatchShares(fits / known, denied / known, (fits + denied) / len(hits), crossed)


def _crossing(chart: Map, origin: Floats, ends: Floats) -> int:
    """Return how many rays pass through occupied cells before they end."""
    rays = ends - origin
    lengths = np.sqrt(np.sum(rays * rays, axis=1))
    count = min(math.ceil(float(lengths.max()) / chart.resolution), ALONG)
    parts = (np.arange(count) + 0.5) / count
    parts = parts * np.maximum(1.0 - SHORT_OF / lengths, 0.0)[:, None]
    points = origin + rays[:, None, :] * parts[:, :, None]
    cells = chart.cells(points.reshape(-1, 2))
    crossed = (chart.values(cells[:, 0], cells[:, 1]) > 0).reshape(len(ends), count).any(axis=1)
    return int(np.count_nonzero(crossed))


def _spread(scan: BodyScan, most: int) -> Indices:
    """Return surfaces of a scan, evenly spread along them."""
    found = np.flatnonzero(scan.straight)
    if len(found) <= most:
        return found
    x, y = scan.middles[found].T
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    length = np.minimum(np.sqrt(dx * dx + dy * dy), 0.5).cumsum()
    number = np.floor(length * (most / (length[-1] + 1e-9)))
    chosen = np.ones(len(found), dtype=np.bool_)
    chosen[1] = number[0] > 0.0
    np.not_equal(number[1:], number[:-1], out=chosen[2:])
    return found[chosen]


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Surfaces of a scan and the map's lines that they may be, n each."""

    points: Floats
    """m, in the robot's frame"""
    normals: Floats
    """2 × n"""
    offsets: Floats
    """m: the product of the normal with each of the line's points"""
    anchors: Indices


def _paired(
    chart: Map, points: Floats, directions: Floats, pose: Pose, reach: float, settings: MatchSettings
) -> _Pairs | None:
    """Return the nearest line to each surface (its direction: that of the normal) that faces its way; None if
    too few of the surfaces have one."""
    columns, rows = chart.cells(to_world(points, pose)).T
    window = WINDOWS[min(math.ceil(reach / chart.resolution - 1e-9), MAX_AWAY)]
    lines = chart.lines_at(columns[:, None] + window[0], rows[:, None] + window[1])
    facing = np.rint((directions + pose.yaw) / TURN).astype(np.int64).astype(np.int16)
    apart = (lines["angle"] - (facing - np.int16(FACING))[:, None]).view(np.uint16)
    valid = (lines["scans"] > 0) & (apart < 2 * FACING)
    which = valid.argmax(axis=1)
    on_line = valid[np.arange(len(points)), which] & chart.inside(columns, rows)
    found = np.flatnonzero(on_line)
    known = np.count_nonzero(on_line | (chart.values(columns, rows) < 0))
    if len(found) < max(settings.least, settings.overlap * known):
        return None
    which = which[found]
    lines = lines[found, which]
    angle = lines["angle"] * TURN
    nx, ny = np.cos(angle), np.sin(angle)
    x, y = columns[found] + window[0, which] + 0.5, rows[found] + window[1, which] + 0.5
    offsets = (x * nx + y * ny + lines["offset"] / PER_CELL) * chart.resolution
    return _Pairs(points[found], np.array([nx, ny]), offsets, lines["anchor"])


def _solved(pairs: _Pairs, pose: Pose, settings: MatchSettings) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step in x [m], y [m], yaw [rad] from a pose, and the covariance (3 × 3)."""
    arm = rotated(pairs.points, pose.yaw)
    (nx, ny), (x, y) = pairs.normals, arm.T
    distance = nx * (x + pose.x) + ny * (y + pose.y) - pairs.offsets
    J = np.array([nx, ny, ny * x - nx * y])
    sigma = max(settings.sigma, float(np.abs(distance).sum()) / len(distance))
    weight = 1.0 / (1.0 + (distance * (0.5 / sigma)) ** 2)
    weighted = J * weight
    total = float(weight.sum())
    variance = settings.floor**2 + float(np.vdot(distance, distance)) / len(distance)
    length = max(math.sqrt(float(np.vdot(arm, arm)) / len(arm)), 0.1)
    inverse, left_open = inverted(weighted @ J.T, length, settings.hold * total)
    step = -inverse @ (weighted @ distance)
    return step, CORRELATED * variance * inverse + OPEN * left_open


def inverted(information: Floats, length: float, least: float) -> tuple[Floats, Floats]:
    """Return the inverse in the directions with at least this information, and the projection on the others.
    To compare metres with radians, a turn counts by how far it moves points at `length` [m]."""
    scale = np.array([1.0, 1.0, 1.0 / length])
    values, vectors = np.linalg.eigh(information * scale * scale[:, None])
    directions = vectors * scale[:, None]
    held = values >= least
    inverse: Floats = (directions[:, held] / values[held]) @ directions[:, held].T
    left: Floats = directions[:, ~held] @ directions[:, ~held].T
    return inverse, left


def _shared(chart: Map, anchors: Indices, pose: Pose) -> Floats:
    """Return the mean covariance of anchors, moved to a pose: an anchor's turn displaces it by the lever."""
    covariances = chart.lines.covariances[anchors]
    by_turn = covariances[:, :, 2]
    lever = np.zeros((len(anchors), 3))
    lever[:, 0] = chart.lines.poses[anchors, 1] - pose.y
    lever[:, 1] = pose.x - chart.lines.poses[anchors, 0]
    moved = lever.T @ (by_turn + 0.5 * by_turn[:, 2:] * lever) / len(anchors)
    shared: Floats = covariances.mean(axis=0) + moved + moved.T
    return shared
