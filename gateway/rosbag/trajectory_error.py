"""Absolute trajectory error (ATE): positions on the earth, alignment, error.

Rules. Pure functions of arrays, one row per time: m in a plane. A path begins anywhere and in any direction,
so it is aligned to the truth by the rotation and translation (SE(2), no scale) with the least sum of squares
(Umeyama 1991, without its scale); the remaining error is the ATE.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from brain.belief import Floats
from protocols.messages import Fix

SEMI_MAJOR = 6_378_137.0
"""m; with FLATTENING the ellipsoid of WGS 84 (NGA.STND.0036, table 3.1)"""
FLATTENING = 1.0 / 298.257223563
MIN_PAIRS = 3
"""Least number of positions to evaluate a path: two can always be aligned in direction."""


def east_north(fixes: Sequence[Fix]) -> Floats:
    """Return the fixes (n × 2: m east, m north) in the tangent plane at the first one.

    Heights are left out: the least accurate coordinate would only add noise."""
    latitude, longitude = np.radians([[f.latitude, f.longitude] for f in fixes]).T
    square = FLATTENING * (2.0 - FLATTENING)
    normal = SEMI_MAJOR / np.sqrt(1.0 - square * np.sin(latitude) ** 2)
    x = normal * np.cos(latitude) * np.cos(longitude)
    y = normal * np.cos(latitude) * np.sin(longitude)
    z = normal * (1.0 - square) * np.sin(latitude)
    x, y, z = x - x[0], y - y[0], z - z[0]
    sp, cp = math.sin(latitude[0]), math.cos(latitude[0])
    sl, cl = math.sin(longitude[0]), math.cos(longitude[0])
    return np.column_stack((-sl * x + cl * y, -sp * cl * x - sp * sl * y + cp * z))


@dataclass(frozen=True, slots=True)
class PathError:
    """Distance between a path and the truth after alignment [m]."""

    count: int
    """Positions compared."""
    rms: float
    median: float
    largest: float


def path_error(path: Floats, truth: Floats) -> PathError:
    """Return the ATE of a path (n × 2) against the truth (n × 2) [m].

    Raises ValueError for too few positions to align, or for values that are not finite."""
    if path.shape != truth.shape or len(path) < MIN_PAIRS:
        raise ValueError(f"{len(path)} positions against {len(truth)}: at least {MIN_PAIRS} pairs are needed")
    if not (np.isfinite(path).all() and np.isfinite(truth).all()):
        raise ValueError("a position is not finite")
    difference = truth - aligned(path, truth)
    distances = np.hypot(difference[:, 0], difference[:, 1])
    rms = math.sqrt(float((distances**2).sum()) / len(distances))
    return PathError(len(path), rms, float(np.median(distances)), float(distances.max()))


def aligned(path: Floats, truth: Floats) -> Floats:
    """Return the path (n × 2), rotated and translated to best fit the truth."""
    centre, goal = path.sum(axis=0) / len(path), truth.sum(axis=0) / len(truth)
    a, b = path - centre, truth - goal
    turn = math.atan2(
        float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()),
        float((a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]).sum()),
    )
    c, s = math.cos(turn), math.sin(turn)
    turned: Floats = a @ np.array([[c, s], [-s, c]]) + goal
    return turned


def spread(path: Floats) -> float:
    """Return the largest distance of a point from the centre of all [m]."""
    offset = path - path.sum(axis=0) / len(path)
    return float(np.hypot(offset[:, 0], offset[:, 1]).max())
