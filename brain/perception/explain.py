"""What, if it was wrong, would make wheels, gyro and scans differ as they do: named once it is certain.

Rules. The comparisons of `motion_check` are kept, the newest of each reference, and those with the present
one: bounded. An explanation is one number that makes all of them agree (a factor on the wheels' way or turn,
a direction of the lidar, a time), or a sign. It is told if the comparisons reject that nothing is wrong, and
agree with one another about the number; once told it stays. Slipping wheels do not agree with what they did
before, and are not explained.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from brain.belief import Floats
from brain.perception.scan_motion import Shown
from brain.perception.track import Motion
from protocols.messages import SECOND

KEPT, PRESENT = 24, 24
"""Comparisons that are kept, and of the present reference"""
WAY, TURN = 0.08, 0.12
"""m and rad that the wheels (or scans) must have shown, all comparisons together (root of the squares)"""
FEWEST = 3
"""Comparisons with such motion"""
FACTOR = 1.3
"""Factor on way or turn from which on it is named"""
SKEWED = math.radians(35.0)
"""rad by which a lidar looks elsewhere, from which on it is named here; less is `mounting`'s"""
SPINS = 2.0
"""rad per m ahead that a base turns with a wheel of the wrong sign, at least"""
DELAYS = tuple(round(delay * SECOND) for delay in (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4))
"""Times by which scans may be stamped late that are tried,"""
LATE, BETTER = 0.04, 0.3
"""s from which on they are named, and by which share of the misfit that must leave at most"""
SCATTER = 0.25
"""Share of what is shown by which single comparisons may miss an explanation (root of the squares)"""
NOISE_WAY, NOISE_TURN = 0.012, 0.012
"""m, rad: of a comparison, beside that of the match"""
GYRO = "the gyro turns against wheels and scans: it is mounted upside down (roll = 3.1416 in its mount)"
MIRRORED = (
    "its scans turn against wheels and gyro: it is mirrored: upside down (roll = 3.1416 in its "
    "mount), or its "
    "beams are counted the other way"
)


class Compared(NamedTuple):
    """One comparison."""

    way: float
    """m ahead by the wheels; so is the next, by the scans"""
    along: float
    aside: float
    """m to the left by the scans"""
    turn: float
    """rad by the wheels,"""
    shown: float
    """by the scans,"""
    gyro: float
    """and by the gyro; not a number: there is none"""
    noise: float
    """m, of the match"""
    span: float
    """s"""
    earlier: tuple[float, ...]
    """rad by the wheels between times that are earlier by `DELAYS`; not a number where that is not known"""


class Explanation:
    """Of one lidar against the wheels. Plain data."""

    def __init__(self, name: str) -> None:
        self.name, self.told = name, ""
        self._kept: deque[Compared] = deque(maxlen=KEPT)
        self._present: deque[Compared] = deque(maxlen=PRESENT)

    def add(
        self,
        wheels: Motion,
        shown: Shown,
        gyro: Motion | None,
        span: float,
        earlier: tuple[float, ...],
        *,
        keep: bool,
    ) -> str:
        """Take a comparison over a span [s]; `keep`: the last of its reference. Return what is told for the
        first time."""
        (way, _), (along, aside) = wheels.ahead(), shown.motion.ahead()
        turned = math.nan if gyro is None else gyro.turn
        noise = math.sqrt(shown.variance) * max(shown.spread())
        one = Compared(way, along, aside, wheels.turn, shown.motion.turn, turned, noise, span, earlier)
        self._present.append(one)
        found = "" if self.told else self._named([*self._kept, *self._present])
        self.told = self.told or found
        if keep:
            if abs(way) > WAY / 4.0 or abs(wheels.turn) > TURN / 4.0 or abs(shown.motion.turn) > TURN / 4.0:
                self._kept.append(one)
            self._present.clear()
        return found

    def begin(self) -> None:
        """Forget the present reference: it was lost."""
        self._present.clear()

    def _named(self, compared: Sequence[Compared]) -> str:
        way, along, aside, turn, shown, gyro, noise, span = np.array([one[:8] for one in compared]).T
        if found := self._spins(way, along, aside, turn, shown) or self._turns(turn, shown, gyro, way):
            return found
        earlier = np.array([one.earlier for one in compared])
        return self._ways(way, along, aside, turn, noise, span) or self._late(shown, earlier)

    def _spins(self, way: Floats, along: Floats, aside: Floats, turn: Floats, shown: Floats) -> str:
        """One wheel rolls backward: it turns on the spot where its wheels say a way, and the reverse."""
        if not _enough(way, WAY) or not _enough(shown, TURN):
            return ""
        (per_metre, _), fits = _fit(np.column_stack([way, turn]), shown)
        rolled = float(np.hypot(along, aside) @ np.abs(way)) / float(way @ way)
        if not fits or abs(per_metre) < SPINS or rolled > 0.6:
            return ""
        side = "left" if per_metre > 0.0 else "right"
        return (
            f"the base turns where its wheels say straight ahead: the {side} wheel rolls backward: "
            "change its sign in the robot file"
        )

    def _turns(self, turn: Floats, shown: Floats, gyro: Floats, way: Floats) -> str:
        """Turns to the other side, or by a factor."""
        known = ~np.isnan(gyro)
        if not _enough(turn, TURN):
            return ""
        columns = np.column_stack([turn, way])
        (by_wheels, _), fits = _fit(columns, shown)
        of_gyro = math.nan
        if _enough(turn[known], TURN):
            (of_gyro, _), gyro_fits = _fit(np.column_stack([turn[known], way[known]]), gyro[known])
            if gyro_fits and of_gyro < -0.5 and by_wheels > 0.5:
                return GYRO
        if not fits:
            return ""
        if by_wheels < -0.5:
            if of_gyro > 0.5:
                return f"{self.name}: {MIRRORED}"
            swapped = "left and right are swapped, or both wheels roll backward"
            if of_gyro < -0.5:
                return f"the base turns against its wheels: {swapped}"
            return f"scans turn against the wheels: {self.name} is mirrored (upside down), or {swapped}"
        agree = math.isnan(of_gyro) or abs(of_gyro - by_wheels) < 0.25 * abs(by_wheels)
        if agree and _ratio(by_wheels) > FACTOR + 3.0 * _ratio(by_wheels) * _unsure(columns):
            return self._wide(by_wheels, turn, shown)
        return ""

    def _wide(self, factor: float, turn: Floats, shown: Floats) -> str:
        at = int(np.abs(turn).argmax())
        return (
            f"the wheels say {math.degrees(turn[at]):.0f}°, the scans {math.degrees(shown[at]):.0f}°: "
            "the wheels "
            f"turn the base {factor:.2g} times as far as stated: see wheel_separation (or "
            "effective_separation), then wheel_radius"
        )

    def _ways(
        self, way: Floats, along: Floats, aside: Floats, turn: Floats, noise: Floats, span: Floats
    ) -> str:
        """A way in another direction, or of another length."""
        straight = np.abs(turn) < 0.5
        if not _enough(way[straight], WAY):
            return ""
        way, along, aside, noise, span = (one[straight] for one in (way, along, aside, noise, span))
        weight = float(way @ way)
        ahead, left = float(along @ way) / weight, float(aside @ way) / weight
        factor, off = math.hypot(ahead, left), -math.atan2(left, ahead)
        missed = math.hypot(
            float(np.linalg.norm(along - ahead * way)), float(np.linalg.norm(aside - left * way))
        )
        size = math.sqrt(weight)
        sigma = (NOISE_WAY + float(noise.max())) / max(float(np.abs(way).max()), 1e-9)
        if missed > SCATTER * max(factor, 0.3) * size or sigma > 0.25:
            return ""
        if abs(off) > SKEWED and _ratio(factor) < 2.5:
            about = 90.0 * round(math.degrees(off) / 90.0)
            turned = about if about and abs(math.degrees(off) - about) < 20.0 else math.degrees(off)
            return (
                f"{self.name}: its scans show ways in another direction than the wheels: it is turned "
                f"by {turned:+.0f}° "
                "against its mount in the robot file"
            )
        if abs(off) < SKEWED and factor > 0.05 and _ratio(factor) > FACTOR + 3.0 * sigma:
            at = int(np.abs(way).argmax())
            seconds = max(float(span[at]), 1e-3)
            large = factor < 1.0
            return (
                f"the wheels say {abs(way[at]) / seconds:.2f} m/s, the scans "
                f"{math.hypot(along[at], aside[at]) / seconds:.2f}: "
                f"wheel radius about {_ratio(factor):.1f} times too {'large' if large else 'small'} "
                "in the robot "
                f"file{', or they slip' if large else ''}"
            )
        return ""

    def _late(self, shown: Floats, earlier: Floats) -> str:
        """Scans that show the turns that the wheels have shown before."""
        known = ~np.isnan(earlier).any(axis=1)
        if not _enough(shown[known], TURN):
            return ""
        misfits = ((earlier[known] - shown[known, None]) ** 2).sum(axis=0)
        best = int(misfits.argmin())
        if not 0 < best < len(DELAYS) - 1:
            return ""
        delays = np.array(DELAYS[best - 1 : best + 2]) / SECOND
        curve = np.polyfit(delays, misfits[best - 1 : best + 2], 2)
        behind = float(-curve[1] / (2.0 * curve[0]))
        now, noise = float(misfits[DELAYS.index(0)]), NOISE_TURN**2 * np.count_nonzero(known)
        least = max(float(np.polyval(curve, behind)), 0.0)
        if abs(behind) < LATE or least + noise > BETTER * now:
            return ""
        return f"{self.name}: its scans are stamped {1e3 * behind:+.0f} ms late against the wheels"


def _enough(values: Floats, least: float) -> bool:
    return bool(
        np.count_nonzero(np.abs(values) > least / 4.0) >= FEWEST
        and float(values @ values) > least * least
        and float(np.abs(values).max()) > 0.8 * least
    )


def _fit(columns: Floats, values: Floats, scatter: float = SCATTER) -> tuple[Floats, bool]:
    """Return the factors by least squares, and whether what is left is little of the values."""
    normal = columns.T @ columns + 1e-6 * np.eye(columns.shape[1])
    found: Floats = np.asarray(np.linalg.solve(normal, columns.T @ values), dtype=np.float64)
    left = float(np.linalg.norm(values - columns @ found))
    noise = NOISE_TURN * math.sqrt(len(values))
    return found, left < scatter * float(np.linalg.norm(values)) + noise


def _unsure(columns: Floats) -> float:
    """Return the standard deviation of the first factor, by the noise of the comparisons."""
    normal = columns.T @ columns + 1e-6 * np.eye(columns.shape[1])
    return NOISE_TURN * math.sqrt(float(np.linalg.inv(normal)[0, 0]))


def _ratio(factor: float) -> float:
    return max(abs(factor), 1.0 / max(abs(factor), 1e-6))
