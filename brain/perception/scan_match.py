"""Scan matching: the robot's pose from a scan and the map, point to line, by Gauss-Newton.

Rules. For each hit of a scan the map's cells around it are examined; where their hits lie on a line, the
point's distance from that line is the residual: sliding along a wall costs nothing. The pose with the least
sum of squares is searched from the filter's prediction, in a bounded number of steps on a bounded number of
beams (work is counted in operations). The covariance comes from the same lines: in a bare corridor it is
large along the corridor, and the match does not correct the filter in that direction. Where too little of
the scan lies on known lines there is no match, which is an ordinary result (None), not a failure.
Sources: Chen and Medioni 1992 (point to plane); Censi 2008 (point to line, PLICP).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import wrap
from brain.checks import ordered, within
from brain.perception.grid import Grid, normalised
from brain.perception.mount import BodyScan, to_world


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Parameters of scan matching."""

    beams: int = 120
    """Largest number of hits of a scan that are used, evenly chosen"""
    steps: int = 6
    """Gauss-Newton steps, at most"""
    reach: float = 0.15
    """m: search distance to each side for the map's line, where the prediction is good"""
    widest: float = 0.4
    """m: largest search distance, where the prediction is poor"""
    sigma: float = 0.03
    """m: standard deviation of hits from the map's lines (lidar, rounding, corners)"""
    straight: float = 0.15
    """Cells form a line if their variance across it is below this share of the variance along it"""
    least: int = 20
    """Least number of points on lines"""
    overlap: float = 0.4
    """Least share of the points used that lie on lines"""
    misfit: float = 0.3
    """A scan with more than this share of its hits in free cells contradicts the map"""
    hold: float = 0.02
    """A direction is observable if at least this share of the points constrains it"""
    floor: float = 0.015
    """m: least standard deviation of a match (the map itself is no better)"""
    floor_yaw: float = 0.006
    """rad"""

    def __post_init__(self) -> None:
        within(
            self,
            beams=(10, 500),
            steps=(1, 20),
            reach=(0.01, 1.0, "m"),
            widest=(0.01, 1.0, "m"),
            sigma=(1e-3, 1.0, "m"),
            straight=(1e-3, 1.0),
            least=(3, 500),
            overlap=(0.01, 1.0),
            misfit=(0.01, 1.0),
            hold=(1e-6, 1.0),
            floor=(1e-4, 1.0, "m"),
            floor_yaw=(1e-4, 1.0, "rad"),
        )
        ordered(self, "reach", "widest")


@dataclass(frozen=True, slots=True)
class Match:
    """Result of matching a scan."""

    pose: Pose
    noise: Floats
    """3 × 3 covariance of x, y, yaw"""


def match(
    grid: Grid, scan: BodyScan, predicted: Pose, settings: MatchSettings, sigma: float = 0.0
) -> Match | None:
    """Return the pose near the predicted one at which the scan fits the map; None if too little of it does.

    `sigma` [m]: standard deviation of the prediction. Lines are first searched as far away as that
    requires, then, from the improved pose, nearby."""
    hits = np.flatnonzero(scan.hit)
    points = scan.ends[hits[:: max(1, math.ceil(len(hits) / settings.beams))]]
    reach = min(max(3.0 * sigma, settings.reach), settings.widest)
    pose = predicted
    for _ in range(settings.steps):
        equations = _equations(grid, points, scan.origin, pose, reach, settings)
        if equations is None:
            return None
        gradient, covariance, _ = equations
        step = -covariance @ gradient
        pose = Pose(pose.x + float(step[0]), pose.y + float(step[1]), wrap(pose.yaw + float(step[2])))
        if reach == settings.reach and np.abs(step).max() < 1e-4:
            break
        reach = max(settings.reach, reach / 2.0)
    final = _equations(grid, points, scan.origin, pose, settings.reach, settings)
    if final is None:
        return None
    _, covariance, unobservable = final
    floor = np.diag([settings.floor**2, settings.floor**2, settings.floor_yaw**2])
    return Match(pose, covariance + unobservable * UNOBSERVABLE + floor)


def contradicts_map(grid: Grid, scan: BodyScan, pose: Pose, settings: MatchSettings) -> bool:
    """True if the scan, taken at this pose, contradicts the map: too many hits in free cells.

    (In a new place hits lie in unknown cells: that is no contradiction.)"""
    cells = grid.cells(to_world(scan.ends[scan.hit], pose))
    inside = np.all((cells >= 0) & (cells < (grid.columns, grid.rows)), axis=1)
    if not inside.any():
        return False
    values = grid.log_odds[cells[inside, 1], cells[inside, 0]]
    return float(np.mean(values < 0.0)) > settings.misfit


UNOBSERVABLE = 1e4
"""Variance [m², rad²] of a direction that no line constrains."""
CORRELATED = 4.0
"""Neighbouring points use the same cells: this many of them carry the information of one."""


def _equations(
    grid: Grid, points: Floats, origin: tuple[float, float], pose: Pose, reach: float, settings: MatchSettings
) -> tuple[Floats, Floats, Floats] | None:
    """Linearise the least-squares problem about a pose, in x [m], y [m], yaw [rad]; None if too few lines.

    Return the gradient of half the sum of squared distances, each over its variance (3); the inverse of the
    information in the observable directions (3 × 3); and the projection on the other directions (3 × 3)."""
    world = to_world(points, pose)
    towards = normalised(to_world(np.array([origin]), pose) - world)
    centers, normals, found = _lines(grid, world, towards, reach, settings)
    count = int(np.count_nonzero(found))
    if count < max(settings.least, settings.overlap * len(points)):
        return None
    world, normals = world[found], normals[found]
    distance = np.sum(normals * (world - centers[found]), axis=1)
    arm = world - (pose.x, pose.y)
    lever = normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]
    J = np.column_stack([normals, lever])
    spread = float(np.sqrt(np.mean(distance * distance)))
    sigma = max(settings.sigma, spread)
    information = 1.0 / (CORRELATED * sigma**2)
    weight = information / np.maximum(1.0, np.abs(distance) / (2.0 * sigma))  # Huber
    weighted = J * weight[:, None]
    length = max(float(np.sqrt(np.mean(np.sum(arm * arm, axis=1)))), 0.1)
    covariance, unobservable = _inverted(weighted.T @ J, length, settings.hold * information * count)
    return weighted.T @ distance, covariance, unobservable


def _inverted(information: Floats, length: float, least: float) -> tuple[Floats, Floats]:
    """Return the covariance in the directions with at least this information, and the projection on the
    others. To compare metres with radians, a turn counts by how far it moves points at `length` [m]."""
    scale = np.array([1.0, 1.0, 1.0 / length])
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    directions = vectors * scale[:, None]
    observable = values >= least
    covariance = (directions[:, observable] / values[observable]) @ directions[:, observable].T
    unobservable = directions[:, ~observable] @ directions[:, ~observable].T
    return np.asarray(covariance, dtype=np.float64), np.asarray(unobservable, dtype=np.float64)


def _lines(
    grid: Grid, world: Floats, towards: Floats, reach: float, settings: MatchSettings
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """Return the line through the means of the occupied cells around each point, where they form one: a point
    on it, its normal, and whether there is a line.

    Only cells seen from the same side count: a thin wall has two faces, and they are two lines."""
    cells_away = max(1, math.ceil(reach / grid.resolution - 1e-9))
    span = np.arange(-cells_away, cells_away + 1)
    cells = grid.cells(world)
    edge = np.array([grid.columns, grid.rows]) - 1 - cells_away
    within = np.all((cells >= cells_away) & (cells <= edge), axis=1)
    cells = np.clip(cells, cells_away, edge)
    window = (span[:, None] * grid.columns + span[None, :]).reshape(-1)
    index = (cells[:, 1] * grid.columns + cells[:, 0])[:, None] + window[None, :]
    facing = grid.facing[:, 0][index] * towards[:, 0, None] + grid.facing[:, 1][index] * towards[:, 1, None]
    weight = np.where(facing > 0.0, grid.hits[index], 0).astype(np.float64)
    number = np.count_nonzero(weight, axis=1)
    total = np.maximum(weight.sum(axis=1), 1.0)
    dx = grid.means[:, 0][index] - world[:, 0, None]
    dy = grid.means[:, 1][index] - world[:, 1, None]
    mean_x, mean_y = (weight * dx).sum(axis=1) / total, (weight * dy).sum(axis=1) / total
    xx = (weight * dx * dx).sum(axis=1) / total - mean_x * mean_x
    yy = (weight * dy * dy).sum(axis=1) / total - mean_y * mean_y
    xy = (weight * dx * dy).sum(axis=1) / total - mean_x * mean_y
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    root = np.sqrt(((xx - yy) / 2.0) ** 2 + xy**2)
    half = (xx + yy) / 2.0
    straight = (half - root) < settings.straight * (half + root)
    normals = np.column_stack([-np.sin(along), np.cos(along)])
    centers = world + np.column_stack([mean_x, mean_y])
    return centers, normals, within & (number >= 3) & straight
