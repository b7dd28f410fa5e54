"""Shortest paths of a car that drives forward and backward, on arcs of one radius and straight lines.

Source: Reeds and Shepp, "Optimal paths for a car that goes both forwards and backwards", Pacific Journal of
Mathematics 145 (1990): the words are its formulas 8.1 to 8.11. Each is solved for the pose as it is, with
time reversed, mirrored, and both; those that are not symmetric also from their other end. All solutions are
computed for many poses at once. Within a computation the radius is 1 and the start is the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import cos, pi, sin
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose

Angles: TypeAlias = tuple[Floats, ...]
"""Signed length of each part of a word [rad, radii], NaN where the word leads not there."""
TINY = 1e-9
"""rad, radii: a part that is negative by less is 0."""
HALF = pi / 2.0


class Arc(NamedTuple):
    """A part of a path: constant curvature [1/m, left positive], signed distance [m, backward negative]."""

    curvature: float
    distance: float


def lengths(x: Floats, y: Floats, yaw: Floats, radius: float) -> Floats:
    """Return the length [m] of the shortest path from the origin to each pose [m, m, rad]."""
    return _shortest(_solutions(x / radius, y / radius, yaw), len(x)) * radius


def words(start: Pose, end: Pose, radius: float) -> list[tuple[Arc, ...]]:
    """Return every path that a word gives from one pose to another, the shortest first."""
    return words_to(start, (end,), radius, 1)[0]


def words_to(start: Pose, ends: Sequence[Pose], radius: float, most: int) -> list[list[tuple[Arc, ...]]]:
    """Return the same to each of the ends that are reached soonest, at most so many of them."""
    c, s = cos(start.yaw), sin(start.yaw)
    dx, dy, yaw = np.array([(end.x - start.x, end.y - start.y, end.yaw - start.yaw) for end in ends]).T
    solutions = _solutions((c * dx + s * dy) / radius, (c * dy - s * dx) / radius, yaw)
    soonest = np.argsort(_shortest(solutions, len(ends)), kind="stable")[:most]
    found: list[list[tuple[float, int, tuple[Arc, ...]]]] = [[] for _ in soonest]
    for letters, order, solved in solutions:
        for variant, each in enumerate(np.stack(solved, axis=-1)[:, soonest].tolist()):
            flipped, mirrored = variant & 1, variant & 2
            sign, turn = (-radius if flipped else radius), (-1.0 if mirrored else 1.0)
            for ways, angles in zip(found, each, strict=True):
                if angles[0] != angles[0]:  # not a number: no solution
                    continue
                parts = tuple(
                    Arc(turn * CURVATURE[letter] / radius, sign * angle)
                    for letter, angle in zip(letters, angles, strict=True)
                    if abs(angle) > TINY
                )
                ways.append((sum(abs(part.distance) for part in parts), len(ways), parts[::order]))
    return [[parts for _, _, parts in sorted(ways, key=lambda one: one[:2])] for ways in found]


def poses(start: Pose, parts: tuple[Arc, ...], spacing: float) -> tuple[Floats, list[int]]:
    """Return poses along a path (n × 3), from its start to its end, at most `spacing` [m] apart; and the
    gear, 1 or -1, of each step between two of them."""
    x, y, yaw = start.x, start.y, start.yaw
    found, gears = [np.array([[x, y, yaw]])], list[int]()
    for curvature, distance in parts:
        count = max(1, int(np.ceil(abs(distance) / spacing - TINY)))
        far = distance * np.arange(1, count + 1) / count
        half = curvature * far / 2.0
        chord = far * np.sinc(half / pi)
        steps = np.stack(
            [x + chord * np.cos(yaw + half), y + chord * np.sin(yaw + half), yaw + 2.0 * half], axis=1
        )
        found.append(steps)
        gears += [1 if distance > 0.0 else -1] * count
        x, y, yaw = steps[-1].tolist()
    return np.concatenate(found), gears


CURVATURE = {"L": 1.0, "S": 0.0, "R": -1.0}


def _shortest(solutions: Sequence[tuple[str, int, Angles]], count: int) -> Floats:
    """Return the length of the shortest word to each pose [radii]."""
    best = np.full(count, np.inf)
    for _, _, solved in solutions:
        best = np.fmin(best, np.fmin.reduce(sum(map(np.abs, solved)), axis=0))
    return best


def _solutions(x: Floats, y: Floats, yaw: Floats) -> list[tuple[str, int, Angles]]:
    """Return for each word its letters, whether it is driven from its end (-1), and its parts' lengths: by
    variant (bit 0: time reversed, bit 1: mirrored), then by pose."""
    c, s = np.cos(yaw), np.sin(yaw)
    solved: list[tuple[str, int, Angles]] = []
    for order, ahead, left in ((1, x, y), (-1, x * c + y * s, x * s - y * c)):
        x4, y4, yaw4 = (
            np.stack([value, flip * value, mirror * value, flip * mirror * value])
            for value, flip, mirror in ((ahead, -1.0, 1.0), (left, 1.0, -1.0), (yaw, -1.0, -1.0))
        )
        sin4, cos4 = np.sin(yaw4), np.cos(yaw4)
        same, other = (x4 - sin4, y4 - 1.0 + cos4), (x4 + sin4, y4 - 1.0 - cos4)
        for letters, symmetric, solve in WORDS:
            if order == 1 or not symmetric:
                to = same if letters[0] == letters[-1] else other
                with np.errstate(invalid="ignore"):
                    solved.append((letters, order, solve(*to, yaw4)))
    return solved


def _mod(angle: Floats) -> Floats:
    """Return the same angle within ± pi."""
    wrapped: Floats = angle - 2.0 * pi * np.round(angle / (2.0 * pi))
    return wrapped


def _if(valid: npt.NDArray[np.bool_], *parts: Floats | float) -> Angles:
    """Return the parts' lengths, NaN where not valid."""
    return tuple(np.where(valid, part, np.nan) for part in parts)


def _csc_same(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.1: L+ S+ L+"""
    t, u = np.arctan2(eta, xi), np.hypot(xi, eta)
    v = _mod(yaw - t)
    return _if((t >= -TINY) & (v >= -TINY), t, u, v)


def _csc_other(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.2: L+ S+ R+"""
    u = np.sqrt(xi * xi + eta * eta - 4.0)
    t = _mod(np.arctan2(eta, xi) + np.arctan2(2.0, u))
    v = _mod(t - yaw)
    return _if((t >= -TINY) & (v >= -TINY), t, u, v)


def _ccc(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.3, 8.4: L+ R- L±"""
    u = -2.0 * np.arcsin(np.hypot(xi, eta) / 4.0)
    t = _mod(np.arctan2(eta, xi) + u / 2.0 + pi)
    return _if(t >= -TINY, t, u, _mod(yaw - t + u))


def _outer(u: Floats, v: Floats, xi: Floats, eta: Floats, yaw: Floats) -> tuple[Floats, Floats]:
    """Return the first and the last angle of a word of four arcs (tau and omega of section 8)."""
    delta = _mod(u - v)
    a, b = np.sin(u) - np.sin(delta), np.cos(u) - np.cos(delta) - 1.0
    t = np.arctan2(eta * a - xi * b, xi * a + eta * b)
    back = 2.0 * (np.cos(delta) - np.cos(v) - np.cos(u)) + 3.0 < 0.0
    tau = _mod(t + pi * back)
    return tau, _mod(tau - u + v - yaw)


def _cccc_cusp_in_middle(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.7: L+ Ru+ Lu- R-"""
    u = np.arccos(0.25 * (2.0 + np.hypot(xi, eta)))
    t, v = _outer(u, -u, xi, eta, yaw)
    return _if((t >= -TINY) & (v <= TINY), t, u, -u, v)


def _cccc_two_cusps(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.8: L+ Ru- Lu- R+"""
    rho = (20.0 - xi * xi - eta * eta) / 16.0
    u = -np.arccos(np.where(rho < 0.0, np.nan, rho))
    t, v = _outer(u, u, xi, eta, yaw)
    return _if((t >= -TINY) & (v >= -TINY), t, u, u, v)


def _ccsc_same(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.9: L+ R-(pi/2) S- L-"""
    r = np.sqrt(xi * xi + eta * eta - 4.0)
    t = _mod(np.arctan2(eta, xi) + np.arctan2(r, -2.0))
    v = _mod(yaw - HALF - t)
    return _if((t >= -TINY) & (r >= 2.0 - TINY) & (v <= TINY), t, -HALF, 2.0 - r, v)


def _ccsc_other(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.10: L+ R-(pi/2) S- R-"""
    rho, t = np.hypot(xi, eta), np.arctan2(xi, -eta)
    v = _mod(t + HALF - yaw)
    return _if((t >= -TINY) & (rho >= 2.0 - TINY) & (v <= TINY), t, -HALF, 2.0 - rho, v)


def _ccscc(xi: Floats, eta: Floats, yaw: Floats) -> Angles:
    """8.11: L+ R-(pi/2) S- L-(pi/2) R+"""
    u = 4.0 - np.sqrt(xi * xi + eta * eta - 4.0)
    t = _mod(np.arctan2((4.0 - u) * xi - 2.0 * eta, -2.0 * xi + (u - 4.0) * eta))
    v = _mod(t - yaw)
    return _if((t >= -TINY) & (u <= TINY) & (v >= -TINY), t, -HALF, u, -HALF, v)


WORDS: tuple[tuple[str, bool, Callable[[Floats, Floats, Floats], Angles]], ...] = (
    ("LSL", True, _csc_same),
    ("LSR", True, _csc_other),
    ("LRL", False, _ccc),
    ("LRLR", True, _cccc_cusp_in_middle),
    ("LRLR", True, _cccc_two_cusps),
    ("LRSL", False, _ccsc_same),
    ("LRSR", False, _ccsc_other),
    ("LRSLR", True, _ccscc),
)
"""Letters, whether the word read from its end is one of the same kind, and its solution."""
