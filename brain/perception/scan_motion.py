"""The motion that two scans show, without a map: point to line, neighbours by bearing (Censi 2008, PLICP)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from brain.belief import Floats
from brain.perception.body_scan import BodyScan
from brain.perception.track import Motion
from protocols.messages import Nanos

BEAMS = 120
"""Largest number of beams of a scan that are compared, evenly chosen."""
LEAST = 20
"""Least number of them on lines of the reference; fewer show no motion."""
ON_LINE = 0.1
"""m: a point this near to a line of the reference lies on it."""
NO_LINE = 1e9
"""m: distance from where the reference has no line."""
DAMPING = 1e-3 * np.eye(3)


class Shown(NamedTuple):
    """What two scans show."""

    motion: Motion
    fit: float
    """Share of the rays' ends on lines, of those that meet one,"""
    hidden: float
    """and share of those before their line: something stands there"""
    inverse: Floats
    """3 × 3: covariance of x, y, turn, for points with a variance of 1;"""
    variance: float
    """m², and theirs"""

    def spread(self) -> tuple[float, float]:
        """Return the standard deviations along and across the mean heading, for points with one of 1."""
        c, s = math.cos(self.motion.turn / 2.0), math.sin(self.motion.turn / 2.0)
        (xx, xy, _), (_, yy, _), _ = self.inverse.tolist()
        cross = 2.0 * c * s * xy
        return math.sqrt(c * c * xx + s * s * yy + cross), math.sqrt(s * s * xx + c * c * yy - cross)


class ReferenceScan:
    """A scan's surfaces. Plain data."""

    def __init__(self, t: Nanos, scan: BodyScan) -> None:
        self.t, self._origin = t, scan.origin
        self.apart = 0.0, 0.0, 0.0
        """By how much the motion to the newest scan differed from what was integrated: m, m, rad"""
        bearings, count = scan.bearings, len(scan.bearings)
        self._first = float(bearings[0])
        last = float(bearings[-1]) - self._first
        half = last / max(count - 1, 1) / 2.0
        self._edges = np.empty(count + 1)
        """rad after the first bearing, at which the next beam is nearer; behind the last none is, until the
        first is again."""
        self._edges[:-2] = (bearings[1:] + bearings[:-1]) / 2.0 - self._first
        self._edges[-2:] = last + half, max(last + half, 2.0 * math.pi - half)
        self._lines = np.zeros((3, count + 2))
        """Of each beam's surface: its normal, and the normal's product with a point of it."""
        self._lines[2] = NO_LINE
        line, normals = scan.straight, scan.normals[scan.straight]
        self._lines[0, :count][line], self._lines[1, :count][line] = normals.T
        self._lines[2, :count][line] = np.einsum("ij,ij->i", normals, scan.middles[line])
        self._lines[:, -1] = self._lines[:, 0]

    def keep(self, shown: Motion, integrated: Motion) -> None:
        """Keep by how much a motion that a scan showed differs from what was integrated."""
        x, y, turn = shown.x, shown.y, shown.turn
        self.apart = x - integrated.x, y - integrated.y, turn - integrated.turn

    def motion(self, scan: BodyScan, guess: Motion) -> Shown | None:
        """Return the motion since the reference that a scan shows, searched from a guess; None if too few of
        its rays' ends meet a line. Ends without a hit show no motion, but must not lie behind lines."""
        x, y, turn = guess.x, guess.y, guess.turn
        read = np.flatnonzero(scan.ranges)
        read = read[:: max(1, math.ceil(len(read) / BEAMS))]
        (px, py), hit = scan.ends[read].T, scan.hit[read]
        J = np.empty((4, len(px)))
        for gate in (0.8, 0.4, 0.3, 0.3, 0.3):
            c, s = math.cos(turn), math.sin(turn)
            arm_x, arm_y = c * px - s * py, s * px + c * py
            bearing = np.arctan2(arm_y + (y - self._origin[1]), arm_x + (x - self._origin[0]))
            beam = self._edges.searchsorted((bearing - self._first) % (2.0 * math.pi))
            J[0], J[1], past = self._lines.take(beam, axis=1)
            nx, ny = J[0], J[1]
            np.subtract(ny * arm_x, nx * arm_y, out=J[2])
            off = np.add(nx * (arm_x + x), ny * (arm_y + y), out=J[3])
            off -= past
            size = np.abs(off)
            lined = int(np.count_nonzero(size < NO_LINE / 2.0))
            if lined < LEAST:
                return None
            weight = (hit & (size < gate)) / (1.0 + 400.0 * (off * off))
            M = (J * weight) @ J.T
            inverse: Floats = np.linalg.inv(M[:3, :3] + DAMPING)
            dx, dy, dturn = (inverse @ M[:3, 3]).tolist()
            x, y, turn = x - dx, y - dy, turn - dturn
            if max(abs(dx), abs(dy), abs(dturn)) < 2e-3:
                break
        variance = float(M[3, 3]) / max(float(weight.sum()), 1.0)
        fit, hidden = np.count_nonzero(size < ON_LINE) / lined, np.count_nonzero(off > ON_LINE) / lined
        return Shown(Motion(x, y, turn, turn), fit, hidden, inverse, variance)
