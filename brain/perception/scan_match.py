"""Where the robot stands, from how a scan lies on the map: point to line, by Gauss-Newton.

Rules of this file. Each hit of a scan looks at the map's cells about it; where their hits lie on a
line, the point's distance from that line counts, and nothing else does: sliding along a wall costs
nothing. The pose that makes these distances least is sought from the filter's guess, in a
bounded number of steps on a bounded number of beams (work is counted in operations). The
covariance comes from the same lines: in a bare corridor it is wide along the corridor, and the filter
takes nothing from the match in that direction. Where too little of the scan lies on known lines
there is no match, and that is an ordinary answer (None), not a failure.
Sources: Chen and Medioni 1992 (point to plane); Censi 2008 (point to line, PLICP).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import wrap
from brain.perception.grid import Grid, unit
from brain.perception.mount import Sweep, place


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """How scans are matched against the map."""

    beams: int = 120
    """How many hits of a scan are looked at, at most, evenly chosen"""
    steps: int = 6
    """Gauss-Newton steps, at most"""
    reach: float = 0.15
    """m to each side in which the map's line is looked for, where the guess is good"""
    widest: float = 0.4
    """m: the same, at most, where the guess is poor"""
    sigma: float = 0.03
    """m: how far hits lie from the map's lines where all is well (lidar, rounding, corners)"""
    straight: float = 0.15
    """The cells about a point are a line if their spread across it is less than this part of that along"""
    least: int = 20
    """Points that must lie on lines"""
    overlap: float = 0.4
    """Share of the points looked at that must lie on lines"""
    misfit: float = 0.3
    """A scan of which more than this share ends where the map is free does not fit"""
    hold: float = 0.02
    """Share of the points that must hold the scan in a direction for it to be known in that direction"""
    floor: float = 0.015
    """m: no match is believed to be better than this (the map itself is no better)"""
    floor_yaw: float = 0.006
    """rad"""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value) or value <= 0:
                raise ValueError(f"{field.name} must be above 0, not {value!r}")
        if self.overlap > 1.0:
            raise ValueError(f"overlap is a share up to 1, not {self.overlap!r}")


@dataclass(frozen=True, slots=True)
class Match:
    """A pose at which the scan lies on the map."""

    pose: Pose
    noise: Floats
    """3 × 3 covariance of x, y, yaw"""
    points: int
    """How many hits lay on known lines"""
    spread: float
    """m: root mean square of their distances from the lines"""


@dataclass(frozen=True, slots=True)
class _Lines:
    """For each point: a point on its line, the line's normal, and whether there is a line."""

    centers: Floats
    normals: Floats
    found: npt.NDArray[np.bool_]


def match(grid: Grid, sweep: Sweep, guess: Pose, settings: MatchSettings, sigma: float = 0.0) -> Match | None:
    """The pose near the guess at which the scan lies best on the map; None if too little of it does.

    `sigma` [m]: how far off the guess may be (one standard deviation). Lines are first looked for
    as far away as that asks, and then, from the better pose, near by."""
    hits = np.flatnonzero(sweep.hit)
    points = sweep.ends[hits[:: max(1, math.ceil(len(hits) / settings.beams))]]
    reach = min(max(3.0 * sigma, settings.reach), settings.widest)
    pose = guess
    for _ in range(settings.steps):
        equations = _equations(grid, points, sweep.origin, pose, reach, settings)
        if equations is None:
            return None
        step = -equations.known @ equations.pull
        pose = Pose(pose.x + float(step[0]), pose.y + float(step[1]), wrap(pose.yaw + float(step[2])))
        if reach == settings.reach and np.abs(step).max() < 1e-4:
            break
        reach = max(settings.reach, reach / 2.0)
    final = _equations(grid, points, sweep.origin, pose, settings.reach, settings)
    if final is None:
        return None
    floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
    return Match(pose, final.known + final.unknown * UNKNOWN + floor, final.points, final.spread)


def misfits(grid: Grid, sweep: Sweep, pose: Pose, settings: MatchSettings) -> bool:
    """Whether the scan, taken at the pose, contradicts the map: too many hits where it is free. (In a
    new place hits lie on what is unknown: that is no contradiction.)"""
    cells = grid.cells(place(sweep.ends[sweep.hit], pose))
    inside = np.all((cells >= 0) & (cells < (grid.columns, grid.rows)), axis=1)
    if not inside.any():
        return False
    values = grid.log_odds[cells[inside, 1], cells[inside, 0]]
    return float(np.mean(values < 0.0)) > settings.misfit


UNKNOWN = 1e4
"""Variance [m², rad²] of a direction in which nothing holds the scan."""
SHARED = 4.0
"""Neighbouring points see the same cells: so many of them tell as much as one alone."""


@dataclass(frozen=True, slots=True)
class _Equations:
    """The least-squares problem about a pose, in x [m], y [m], yaw [rad]."""

    pull: Floats
    """3: gradient of half the squared distances, each over its variance"""
    known: Floats
    """3 × 3: the inverse of the information, in the directions that are held"""
    unknown: Floats
    """3 × 3: the projection on the others"""
    points: int
    spread: float


def _equations(
    grid: Grid, points: Floats, origin: tuple[float, float], pose: Pose, reach: float, settings: MatchSettings
) -> _Equations | None:
    placed = place(points, pose)
    towards = unit(place(np.array([origin]), pose) - placed)
    lines = _lines(grid, placed, towards, reach, settings)
    count = int(np.count_nonzero(lines.found))
    if count < max(settings.least, settings.overlap * len(points)):
        return None
    placed, normals = placed[lines.found], lines.normals[lines.found]
    away = np.sum(normals * (placed - lines.centers[lines.found]), axis=1)
    arm = placed - (pose.x, pose.y)
    lever = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
    J = np.column_stack([normals, lever])
    spread = float(np.sqrt(np.mean(away * away)))
    sigma = max(settings.sigma, spread)
    trust = 1.0 / (SHARED * sigma**2)
    weight = trust / np.maximum(1.0, np.abs(away) / (2.0 * sigma))  # Huber
    weighted = J * weight[:, None]
    length = max(float(np.sqrt(np.mean(np.sum(arm * arm, axis=1)))), 0.1)
    known, unknown = _held(weighted.T @ J, length, settings.hold * trust * count)
    return _Equations(weighted.T @ away, known, unknown, count, spread)


def _held(information: Floats, length: float, least: float) -> tuple[Floats, Floats]:
    """The covariance in the directions of which at least so much is known, and the projection on
    the others. To compare metres with radians, a turn counts by how far it moves things at `length`."""
    scale = np.array([1.0, 1.0, 1.0 / length])
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    directions = vectors * scale[:, None]
    held = values >= least
    known = (directions[:, held] / values[held]) @ directions[:, held].T
    unknown = directions[:, ~held] @ directions[:, ~held].T
    return np.asarray(known, dtype=np.float64), np.asarray(unknown, dtype=np.float64)


def _lines(grid: Grid, placed: Floats, towards: Floats, reach: float, settings: MatchSettings) -> _Lines:
    """The line through the means of the occupied cells about each point, where they are one.

    Only cells seen from the same side count: a thin wall has two faces, and they are two lines."""
    cells_away = max(1, math.ceil(reach / grid.resolution - 1e-9))
    span = np.arange(-cells_away, cells_away + 1)
    cells = grid.cells(placed)
    edge = np.array([grid.columns, grid.rows]) - 1 - cells_away
    within = np.all((cells >= cells_away) & (cells <= edge), axis=1)
    cells = np.clip(cells, cells_away, edge)
    window = (span[:, None] * grid.columns + span[None, :]).reshape(-1)
    index = (cells[:, 1] * grid.columns + cells[:, 0])[:, None] + window[None, :]
    facing = grid.facing[:, 0][index] * towards[:, 0, None] + grid.facing[:, 1][index] * towards[:, 1, None]
    weight = np.where(facing > 0.0, grid.hits[index], 0).astype(np.float64)
    number = np.count_nonzero(weight, axis=1)
    total = np.maximum(weight.sum(axis=1), 1.0)
    dx = grid.means[:, 0][index] - placed[:, 0, None]
    dy = grid.means[:, 1][index] - placed[:, 1, None]
    mean_x, mean_y = (weight * dx).sum(axis=1) / total, (weight * dy).sum(axis=1) / total
    xx = (weight * dx * dx).sum(axis=1) / total - mean_x * mean_x
    yy = (weight * dy * dy).sum(axis=1) / total - mean_y * mean_y
    xy = (weight * dx * dy).sum(axis=1) / total - mean_x * mean_y
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    root = np.sqrt(((xx - yy) / 2.0) ** 2 + xy**2)
    half = (xx + yy) / 2.0
    straight = (half - root) < settings.straight * (half + root)
    normals = np.column_stack([-np.sin(along), np.cos(along)])
    return _Lines(placed + np.column_stack([mean_x, mean_y]), normals, within & (number >= 3) & straight)
