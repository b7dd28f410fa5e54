"""How a lidar is mounted, by the direction of the motion that its scans show."""

from __future__ import annotations

import math

import numpy as np

from brain.belief import Floats
from brain.perception.scan_motion import Shown
from brain.perception.track import SLIP_SHARE, Motion

FADE = 5.0
"""m: what was seen of a mounting fades with the way driven (and turned, at 1 m per rad), to 1/e."""
YAW, PLACE = math.radians(0.8), 0.05
"""rad, m: smaller errors of a mounting are not named,"""
DRIVABLE_YAW, DRIVABLE_PLACE = math.radians(10.0), 0.3
"""and larger ones than these not driven with."""
KNOWN_YAW = math.radians(0.25)
"""rad: a yaw is corrected once its standard deviation is below this."""
BENT, STEERED = (0.25, 0.02), (0.01, 0.0)
"""Shares of what is across a way, and of it, by which its shape may be wrong; and with a gyro's turns."""
ASIDE = 0.001
"""m: standard deviation of a comparison beside its noise."""
PRIOR = np.diag([1.0, 1111.0, 1111.0, 0.0])
"""Information on a mounting before any motion: standard deviations of 1 rad and 0.03 m."""


class Mounting:
    """What the scans show of a lidar's true mounting against the robot file's. Plain data.

    A base on wheels that do not slip sideways moves along its mean heading. A lidar that stands by (yaw, x,
    y) otherwise than stated shows, over a way d and a turn w, aside = -yaw d + 2 sin(w/2) x, and along = d -
    2 sin(w/2) y: weighted least squares. Over a way e to the left, which its wheels show with all their slip,
    it shows yaw e along."""

    def __init__(self, any_way: bool = False) -> None:
        self._any_way = any_way
        """Whether the base moves sideways, too"""
        self.flaw = ""
        """How the mounting differs, once that is certain (3 sigma),"""
        self.drivable = True
        """and whether it can be driven with."""
        self._sums = PRIOR.copy()
        """Of the equations' outer products, 4 × 4: yaw, x, y, right side;"""
        self._number = 0.0
        """and how many they are. Both fade with the way."""
        self._corrected = 0.0
        """rad, of the yaw; the equations are about what is left."""

    def add(self, wheels: Motion, shown: Shown, keep: bool) -> float:
        """Judge by the motion that scans show, beside that of the wheels, whose way need be no arc; and keep
        it. Return the yaw [rad] by which the mounting of later scans is to be corrected: mostly 0."""
        turn = shown.motion.turn
        (way, across), (along, aside) = wheels.ahead(), shown.motion.ahead()
        lever, noise = 2.0 * math.sin(turn / 2.0), math.sqrt(shown.variance)
        bent, slip = BENT if wheels.heading == wheels.turn or self._any_way else STEERED
        bent = bent * (abs(turn * along) + 4.0 * abs(across)) + slip * abs(along)
        forward, sideways = shown.spread()
        forward = math.hypot(ASIDE, noise * forward, SLIP_SHARE * way)
        lags = SLIP_SHARE * across if self._any_way else 0.0
        sideways = math.hypot(ASIDE, noise * sideways, bent, lags)
        if self._any_way:
            forward = math.hypot(forward, BENT[1] * across)
        rows = np.array(
            [
                [-along / sideways, lever / sideways, 0.0, (aside - across) / sideways],
                [aside / forward if self._any_way else 0.0, 0.0, -lever / forward, (along - way) / forward],
            ]
        )
        far = math.hypot(way, across) if self._any_way else abs(way)
        kept = math.exp(-(far + abs(turn)) / FADE)
        sums, number = PRIOR + kept * (self._sums - PRIOR) + rows.T @ rows, kept * self._number + 1.0
        if keep:
            self._sums, self._number = sums, number
        return self._judge(sums, number)

    def _judge(self, sums: Floats, number: float) -> float:
        inverse = np.linalg.inv(sums[:3, :3])
        found = inverse @ sums[:3, 3]
        left = float(sums[3, 3] - found @ sums[:3, 3])
        inverse *= max((left + 3.0) / (number + 2.0), 1.0)  # larger if the equations disagree
        (off, x, y), (spread, *places) = found.tolist(), np.sqrt(np.diag(inverse)).tolist()
        yaw, certain = self._corrected + off, 0.0 if self.flaw else 3.0
        if spread < YAW < abs(yaw) - certain * spread:
            by = f"{math.degrees(yaw):+.1f}° (±{math.degrees(2.0 * spread):.1f}°)"
            self.drivable = abs(yaw) < DRIVABLE_YAW + 3.0 * spread
        elif any(s < PLACE < abs(at) - certain * s for at, s in zip((x, y), places, strict=True)):
            by = f"{x:+.2f} (±{2.0 * places[0]:.2f}) m ahead, {y:+.2f} (±{2.0 * places[1]:.2f}) m to the left"
            self.drivable = math.hypot(x, y) < DRIVABLE_PLACE + 3.0 * max(places)
        else:
            self.flaw, self.drivable = "", True
            return 0.0
        self.flaw = f"mounted {by} off what the robot file states"
        if not self.drivable or spread > KNOWN_YAW or abs(off) < YAW + 3.0 * spread:
            return 0.0
        before = self._corrected
        self._corrected = min(max(yaw, -DRIVABLE_YAW), DRIVABLE_YAW)
        shift = np.eye(4)
        shift[3, 0] = before - self._corrected
        self._sums, self._number = shift @ sums @ shift.T, number
        return self._corrected - before
