"""The footprint as a convex polygon that moves along an arc, and when it meets the first of many points.

Seen from the robot, a point that rests moves on a circle about the centre of the robot's turn; the time of
the first contact is that of the circle's first intersection with an edge that leads. Motion straight on, in
any direction, is a turn about a centre far away. The polygon grows by moving its edges outward, so its
corners stay corners.
"""

from __future__ import annotations

from math import copysign, inf, pi

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.bodies.plane import Twist

TOUCH = 1e-6
"""m: a point within the gap is taken to be this far from the grown footprint."""
STRAIGHT = 1e-6
"""rad/m: least curvature computed with"""
GRAZING = 1e-5
"""Least share of its speed with which an edge that leads moves outward"""


class Outline:
    """The footprint's edges. Constant."""

    def __init__(self, body: Base) -> None:
        self.corners = np.array(body.outline)
        self._next = np.arange(1, len(self.corners) + 1) % len(self.corners)
        edges = self.corners[self._next] - self.corners
        self._normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        self._normals /= np.linalg.norm(edges, axis=1)[:, None]
        self._offsets: Floats = (self._normals * self.corners).sum(axis=1)
        before = np.roll(self._normals, 1, axis=0)
        opening = 1.0 + (before * self._normals).sum(axis=1)
        self._mitres: Floats = (before + self._normals) / np.maximum(opening, 0.1)[:, None]
        """Motion of the corners per metre by which all edges are moved outward"""
        self.longest = float(np.linalg.norm(self._mitres, axis=1).max())
        """Farthest that a corner moves per metre"""
        self._levers: Floats = np.stack([self._normals[:, 1], -self._normals[:, 0]], axis=1)
        """Outward speed of an edge's point per metre of its position and rad/s of turn"""
        self._box: Floats = np.abs(self.corners).max(axis=0)
        self.radius = float(np.linalg.norm(self.corners, axis=1).max())
        self._deepest = -0.5 * float(self._offsets.min())

    def distances(self, points: Floats) -> Floats:
        """Return how far the edges must be moved outward until they meet each point (2 × n) [m]."""
        most: Floats = (self._normals @ points - self._offsets[:, None]).max(axis=0)
        return most

    def contact(self, points: Floats, twist: Twist, gap: float) -> tuple[float, float]:
        """Return the time [s] at this twist until the footprint, grown by the gap, meets a point (2 × n), and
        that gap [m]: less than `gap` if a point is nearer already. Points deep inside are ignored."""
        x, y = points
        box = self._box + gap * self.longest
        close = (np.abs(x) < box[0]) & (np.abs(y) < box[1])
        grown = gap
        if close.any():
            distances = self.distances(points[:, close])
            deep = distances < self._deepest
            grown = min(gap, float(distances[~deep].min(initial=inf)) - TOUCH)
            far = ~close
            far[np.flatnonzero(close)[~deep]] = True
            x, y = points[:, far]
        angular = copysign(max(abs(twist.angular), STRAIGHT * twist.speed), twist.angular)
        center = np.array([-twist.lateral / angular, twist.linear / angular])
        ahead = self.corners + grown * self._mitres
        x, y = x - center[0], y - center[1]
        radii = x * x + y * y
        inner = max(float((self._normals @ center - self._offsets).max()) - grown, 0.0)
        outer = ((ahead - center) ** 2).sum(axis=1)
        swept = (radii >= inner * inner) & (radii <= outer.max())
        if not swept.any():
            return inf, grown
        after, levers = ahead[self._next], angular * self._levers
        turning = np.maximum((levers * ahead).sum(axis=1), (levers * after).sum(axis=1))
        outward = self._normals @ (twist.linear, twist.lateral) + turning
        leads = outward > GRAZING * (twist.speed + abs(angular) * self.radius)
        begin, end = ahead[leads] - center, after[leads] - center
        return _first(x[swept], y[swept], radii[swept], begin, end, angular), grown


def _first(x: Floats, y: Floats, radii: Floats, begin: Floats, end: Floats, angular: float) -> float:
    """Return the time [s] until the first point (with its squared distance from the centre of the turn) is on
    one of the edges; inf if none ever is. All places are from that centre."""
    ax, ay = begin[:, 0], begin[:, 1]
    dx, dy = end[:, 0] - ax, end[:, 1] - ay
    dd, ad = dx * dx + dy * dy, ax * dx + ay * dy
    x, y = x[:, None], y[:, None]
    inside = ad * ad - dd * (ax * ax + ay * ay - radii[:, None])
    root = np.sqrt(np.maximum(inside, 0.0))
    along = np.stack([-ad - root, -ad + root]) / dd
    hit_x, hit_y = ax + along * dx, ay + along * dy
    turn = np.arctan2(x * hit_y - y * hit_x, x * hit_x + y * hit_y)
    turn = np.mod(-copysign(1.0, angular) * turn, 2.0 * pi)
    turn[(inside < 0.0) | (along < 0.0) | (along > 1.0)] = inf
    return float(turn.min(initial=inf)) / abs(angular)
