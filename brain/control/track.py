"""A path as it is driven: a smooth curve with its curvature, and the speed allowed at each of its places.

Rules. A path is cut into runs where the direction of travel changes, and where a corner is too sharp to be
rounded; the base stands between two runs. Within a run corners are rounded by a moving average over the
length (a triangular window: a cubic B-spline on a straight corner), as wide as keeps the curve within
`corner` of the path; its ends stay where they are. The speed is limited by the base, by the curvature (its
angular speed, the acceleration to the side), by the change of the curvature (angular acceleration), and, from
the end back to the beginning, by what can be braked. Built for as much of the path as `longest`, with at most
MAX_SAMPLES places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, ceil, cos, hypot, inf, sin, sqrt

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.bodies.plane import Twist, wrap
from brain.planning.polyline import Point, Polyline

SPACING, MAX_SAMPLES = 0.02, 3000
"""m between two places of a run, or more where there would be too many"""
WIDEST, NARROWEST = 0.5, 0.04
"""m, half the window of the average"""
WIDENING = 0.3
"""By how much the window widens per length"""
CONSTANT = 0.3
"""m about a corner in which the window is the same"""
CORNER, LEAST_SHARE = 0.5, 0.15
"""rad of a corner for which all of `corner` may be used, and the share of it for any less"""
SHARPEST = 2.0
"""rad: a corner that turns more is not rounded by what turns on the spot"""
SHARE = 0.8
"""Of the angular acceleration for the curvature's change: the rest is left to correct errors"""


@dataclass(frozen=True, slots=True)
class TrackPlace:
    """One place on a run."""

    x: float
    y: float
    heading: float
    """rad, of the way there"""
    curvature: float
    """1/m, to the left"""
    speed: float
    """m/s, allowed"""
    facing: float | None
    """rad, of the base, if the path says so"""


class TrackRun:
    """A part of a path that is driven in one go. Immutable."""

    def __init__(
        self, points: Floats, gear: int, facing: Floats | None, speed: Floats, begin: float, length: float
    ) -> None:
        """`points` at equal distances of the path, of which the run is so long a part from `begin` on [m]."""
        self.gear = gear
        """1: forward, -1: backward"""
        self._path: Floats = np.linspace(begin, begin + length, points.shape[1])
        steps = np.hypot(*np.diff(points, axis=1))
        self.at: Floats = np.concatenate(([0.0], np.cumsum(steps)))
        """m along the run, of each place"""
        self.x, self.y = points
        self.facing, self.speed = facing, speed
        self.heading, self.curvature = _shape(points, self.at)

    @property
    def length(self) -> float:
        """m"""
        return float(self.at[-1])

    @property
    def end(self) -> Point:
        """Its last place [m]."""
        return float(self.x[-1]), float(self.y[-1])

    def place(self, along: float) -> TrackPlace:
        """Return the place at this length [m]."""
        along = min(max(along, 0.0), self.length)
        i = min(max(int(np.searchsorted(self.at, along, "right")) - 1, 0), len(self.at) - 2)
        span = float(self.at[i + 1] - self.at[i])
        share = (along - float(self.at[i])) / span if span > 0.0 else 0.0
        pairs = (self.x, self.y, self.heading, self.curvature, self.speed)
        x, y, heading, curvature, speed = (float(v[i] + share * (v[i + 1] - v[i])) for v in pairs)
        facing = None if self.facing is None else float(self.facing[i])
        return TrackPlace(x, y, heading, curvature, speed, facing)

    def on_path(self, along: float) -> float:
        """Return the length along the path [m] at this length of the run [m]."""
        return float(np.interp(along, self.at, self._path))

    def along(self, on_path: float) -> float:
        """Return the length of the run [m] at this length along the path [m]."""
        return float(np.interp(on_path, self._path, self.at))

    def nearest(self, x: float, y: float, low: float, high: float) -> float:
        """Return the length [m] of the nearest place between two lengths."""
        i, j = np.searchsorted(self.at, (low, high)).tolist()
        i, j = max(i - 1, 0), min(j + 1, len(self.at))
        away = (self.x[i:j] - x) ** 2 + (self.y[i:j] - y) ** 2
        k = i + int(away.argmin())
        c, s = cos(float(self.heading[k])), sin(float(self.heading[k]))
        off = (x - float(self.x[k])) * c + (y - float(self.y[k])) * s
        return min(max(float(self.at[k]) + off, low), high, self.length)


def runs(
    points: Sequence[Point],
    headings: Sequence[float] | None,
    gears: Sequence[int] | None,
    body: Base,
    corner: float,
    braking: float,
    lateral_acceleration: float,
    slow: Callable[[float, float], float] | None = None,
) -> tuple[TrackRun, ...]:
    """Return the runs of a path; none if it has no length.

    `corner`: m, by which a corner may be cut; `braking`: share of the largest deceleration that is used;
    `slow`: m/s, the largest speed at a place."""
    parts = _parts(points, headings, gears, body)
    total = sum(_length(part) for part, _, _ in parts)
    spacing = max(SPACING, total / MAX_SAMPLES)
    made, begin = list[TrackRun](), 0.0
    for part, gear, facing in parts:
        line = Polyline(tuple(part))
        begin += line.length
        if line.length < 1e-3:
            continue
        count = max(ceil(line.length / spacing), 4) + 1
        along = np.linspace(0.0, line.length, count)
        curve = _rounded(_sampled(line, along), line.length / (count - 1), corner)
        speed = _speeds(curve, body, braking, lateral_acceleration, slow)
        facings = _facing(line, part, facing, along)
        made.append(TrackRun(curve, gear, facings, speed, begin - line.length, line.length))
    return tuple(made)


def longest(body: Base) -> float:
    """Return the length of a path [m] of which runs are made at once: as much as has places at the usual
    distances, or what is needed to brake, and as much again."""
    return max(SPACING * MAX_SAMPLES, 4.0 * body.max_linear**2 / body.max_linear_acceleration)


# -- private --------------------------------------------------------------------------------------

_Part = tuple[list[Point], int, list[float] | None]


def _length(points: Sequence[Point]) -> float:
    return sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points))


def _parts(
    points: Sequence[Point], headings: Sequence[float] | None, gears: Sequence[int] | None, body: Base
) -> list[_Part]:
    """Cut a path where the gear changes, and at its sharpest corners."""
    done: list[_Part] = []
    begin = 0
    for i in range(1, len(points)):
        last = i == len(points) - 1
        shifts = gears is not None and not last and gears[i] != gears[i - 1]
        sharp = not last and body.turning_radius == 0.0 and _corner(points, i) > SHARPEST
        if last or shifts or sharp:
            facing = None if headings is None else list(headings[begin : i + 1])
            done.append((list(points[begin : i + 1]), 1 if gears is None else gears[i - 1], facing))
            begin = i
    return done


def _corner(points: Sequence[Point], i: int) -> float:
    (ax, ay), (bx, by), (cx, cy) = points[i - 1 : i + 2]
    if (ax, ay) == (bx, by) or (bx, by) == (cx, cy):
        return 0.0
    return abs(wrap(atan2(cy - by, cx - bx) - atan2(by - ay, bx - ax)))


def _sampled(line: Polyline, along: Floats) -> Floats:
    points = np.array(line.points).T
    at = np.array(line.at)
    return np.stack([np.interp(along, at, points[0]), np.interp(along, at, points[1])])


def _facing(line: Polyline, part: list[Point], facing: list[float] | None, along: Floats) -> Floats | None:
    if facing is None:
        return None
    steps = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(part)]
    at = np.concatenate(([0.0], np.cumsum(steps)))
    turned: Floats = np.interp(along * float(at[-1]) / line.length, at, np.unwrap(facing))
    return turned


def _rounded(points: Floats, spacing: float, corner: float) -> Floats:
    """Return the moving average of places at equal distances, within `corner` of them [m]."""
    count = points.shape[1]
    taps = min(ceil(WIDEST / spacing), count - 1)
    if taps < 2:
        return points
    before = 2.0 * points[:, :1] - points[:, taps:0:-1]
    after = 2.0 * points[:, -1:] - points[:, -2 : -taps - 2 : -1]
    padded = np.concatenate([before, points, after], axis=1)
    offsets = np.arange(-taps, taps + 1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * taps + 1, axis=1)
    budget = _budget(points, spacing, corner)
    wide = np.full(count, WIDEST)
    along = spacing * np.arange(count)
    curve = points
    for _ in range(4):
        weights = np.maximum(1.0 - np.abs(offsets) * spacing / wide[:, None], 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        curve = np.einsum("dnk,nk->dn", windows, weights)
        off = np.hypot(*(curve - points))
        if not (off > budget).any():
            break
        wide = np.where(off > budget, wide * 0.95 * budget / np.maximum(off, 1e-9), wide)
        wide = _least_near(np.maximum(wide, NARROWEST), ceil(CONSTANT / spacing))
        forward = np.minimum.accumulate(wide - WIDENING * along) + WIDENING * along
        backward = np.minimum.accumulate((wide + WIDENING * along)[::-1])[::-1] - WIDENING * along
        wide = np.minimum(forward, backward)
    curve[:, 0], curve[:, -1] = points[:, 0], points[:, -1]
    return curve


def _budget(points: Floats, spacing: float, corner: float) -> Floats:
    """Return how far the curve may be off at each place [m]: less where the path itself is a curve."""
    steps = np.diff(points, axis=1)
    heading = np.unwrap(np.arctan2(steps[1], steps[0]))
    turn = np.concatenate(([0.0], np.abs(np.diff(heading)), [0.0]))
    # one corner lies between two samples, or on one of them
    pair: Floats = turn + np.concatenate((turn[1:], [0.0]))
    sharp = -_least_near(-np.minimum(pair / CORNER, 1.0), ceil(WIDEST / spacing))
    return corner * np.maximum(sharp, LEAST_SHARE)


def _least_near(values: Floats, reach: int) -> Floats:
    """Return the least of the values up to this many places away."""
    padded = np.concatenate([np.full(reach, np.inf), values, np.full(reach, np.inf)])
    least: Floats = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).min(axis=1)
    return least


def _shape(points: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return heading [rad] and curvature [1/m] at each place, by differences."""
    dx, dy = np.gradient(points[0], at), np.gradient(points[1], at)
    heading: Floats = np.unwrap(np.arctan2(dy, dx))
    curvature: Floats = np.gradient(heading, at)
    return heading, curvature


def _speeds(
    points: Floats,
    body: Base,
    braking: float,
    lateral_acceleration: float,
    slow: Callable[[float, float], float] | None,
) -> Floats:
    at = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))))
    _, curvature = _shape(points, at)
    change = np.abs(np.gradient(curvature, at))
    bend = np.maximum(np.abs(curvature), 1e-9)
    most = np.full(len(at), body.max_linear)
    most = np.minimum(most, np.sqrt(lateral_acceleration / bend))
    if not body.moves_sideways:
        most = np.minimum(most, body.max_angular / bend)
        most = np.minimum(most, np.sqrt(SHARE * body.max_angular_acceleration / np.maximum(change, 1e-9)))
        most = np.minimum(most, _by_wheels(curvature, body))
    if slow is not None:
        limits = [slow(x, y) for x, y in zip(points[0].tolist(), points[1].tolist(), strict=True)]
        most = np.minimum(most, limits)
    gentle = braking * min(body.max_linear_acceleration, 0.5 * sqrt(body.max_linear_jerk * body.max_linear))
    turning = body.max_angular_acceleration / bend if not body.moves_sideways else np.full(len(at), inf)
    deceleration = np.minimum(gentle, SHARE * turning).tolist()
    speed, steps = most.tolist(), np.diff(at).tolist()
    speed[-1] = 0.0
    for i in range(len(steps) - 1, -1, -1):
        speed[i] = min(speed[i], sqrt(speed[i + 1] ** 2 + 2.0 * deceleration[i] * steps[i]))
    return np.array(speed)


def _by_wheels(curvature: Floats, body: Base) -> Floats:
    """Return the speed at which the fastest wheel is at its limit, by curvature."""
    sharpest = max(float(np.abs(curvature).max()), 1e-3)
    table = np.linspace(-sharpest, sharpest, 33)
    speeds = [body.limit(Twist(body.max_linear, body.max_linear * k)).linear for k in table.tolist()]
    limited: Floats = np.interp(curvature, table, speeds)
    return limited
