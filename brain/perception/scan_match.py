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
from brain.perception.grid import Grid
from brain.perception.mount import Sweep, place


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """How scans are matched against the map."""

    beams: int = 120
    """How many hits of a scan are looked at, at most, evenly chosen"""
    steps: int = 6
    """Gauss-Newton steps, at most"""
    reach: int = 2
    """Cells to each side in which the map's line is looked for"""
    sigma: float = 0.03
    """m: how far hits lie from the map's lines where all is well (lidar, rounding, corners)"""
    straight: float = 0.1
    """The cells about a point are a line if their spread across it is less than this part of that along"""
    least: int = 20
    """Points that must lie on lines"""
    overlap: float = 0.4
    """Share of the points looked at that must lie on lines"""
    floor: float = 0.01
    """m: no match is believed to be better than this (the map itself is no better)"""
    floor_yaw: float = 0.004
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


def match(grid: Grid, sweep: Sweep, guess: Pose, settings: MatchSettings) -> Match | None:
    """The pose near the guess at which the scan lies best on the map; None if too little of it does."""
    hits = np.flatnonzero(sweep.hit)
    chosen = hits[:: max(1, math.ceil(len(hits) / settings.beams))]
    points = sweep.ends[chosen]
    pose = guess
    for _ in range(settings.steps):
        step = _step(grid, points, pose, settings)
        if step is None:
            return None
        dx, dy, turn = (float(d) for d in step[0])
        pose = Pose(pose.x + dx, pose.y + dy, wrap(pose.yaw + turn))
        if abs(dx) + abs(dy) < 1e-4 and abs(turn) < 1e-4:
            break
    last = _step(grid, points, pose, settings)
    if last is None:
        return None
    _, information, count, spread = last
    floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
    noise = np.asarray(np.linalg.inv(information + _FAINT) + floor, dtype=np.float64)
    return Match(pose, noise, count, spread)


_FAINT = np.diag([1.0, 1.0, 1.0])
"""Information of a guess good to 1 m and 1 rad: keeps the equations solvable along a bare wall."""
SHARED = 4.0
"""Neighbouring points see the same cells: so many of them tell as much as one alone."""


def _step(
    grid: Grid, points: Floats, pose: Pose, settings: MatchSettings
) -> tuple[Floats, Floats, int, float] | None:
    """One Gauss-Newton step: (dx, dy, turn), the information 3 × 3, the points used, their spread."""
    placed = place(points, pose)
    lines = _lines(grid, placed, settings)
    count = int(np.count_nonzero(lines.found))
    if count < max(settings.least, settings.overlap * len(points)):
        return None
    placed, normals = placed[lines.found], lines.normals[lines.found]
    away = np.sum(normals * (placed - lines.centers[lines.found]), axis=1)
    arm = placed - (pose.x, pose.y)
    lever = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
    J = np.column_stack([normals, lever])
    weight = 1.0 / np.maximum(1.0, np.abs(away) / (2.0 * settings.sigma))  # Huber
    weighted = J * (weight / (SHARED * settings.sigma**2))[:, None]
    information = weighted.T @ J
    wanted = np.linalg.solve(information + _FAINT, -(weighted.T @ away))
    return wanted, information, count, float(np.sqrt(np.mean(away * away)))


def _lines(grid: Grid, placed: Floats, settings: MatchSettings) -> _Lines:
    """The line through the means of the occupied cells about each point, where they are one."""
    span = np.arange(-settings.reach, settings.reach + 1)
    cells = grid.cells(placed)
    edge = np.array([grid.columns, grid.rows]) - 1 - settings.reach
    within = np.all((cells >= settings.reach) & (cells <= edge), axis=1)
    cells = np.clip(cells, settings.reach, edge)
    window = (span[:, None] * grid.columns + span[None, :]).reshape(-1)
    index = (cells[:, 1] * grid.columns + cells[:, 0])[:, None] + window[None, :]
    known = (grid.hits[index] > 0).astype(np.float64)
    number = known.sum(axis=1)
    some = np.maximum(number, 1.0)
    away = grid.means[index] - placed[:, None, :]
    mean = (away * known[:, :, None]).sum(axis=1) / some[:, None]
    spread = (away - mean[:, None, :]) * known[:, :, None]
    xx = (spread[:, :, 0] ** 2).sum(axis=1) / some
    yy = (spread[:, :, 1] ** 2).sum(axis=1) / some
    xy = (spread[:, :, 0] * spread[:, :, 1]).sum(axis=1) / some
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    root = np.sqrt(((xx - yy) / 2.0) ** 2 + xy**2)
    half = (xx + yy) / 2.0
    straight = (half - root) < settings.straight * (half + root)
    normals = np.column_stack([-np.sin(along), np.cos(along)])
    return _Lines(placed + mean, normals, within & (number >= 3) & straight)
