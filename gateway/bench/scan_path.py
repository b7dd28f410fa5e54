"""The path of one lidar by its scans: each placed among the scans before.

Rules. Nothing of the robot is known but what a predictor says, and that only says where to search: at first
that the lidar moves on as it did, later the calibrated wheels. Poses are of the lidar itself, level, in the
frame of its first scan; where a scan does not fit, a new part begins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, to_body
from brain.perception.keyframes import Keyframes, KeyframeSettings, Placed
from brain.perception.mount import Mount
from gateway.bench.wheel_path import after, seen_from
from protocols.messages import SECOND, LaserScan, Nanos

SETTINGS = KeyframeSettings(count=40, surfaces=200)
FITS, STRAY = 0.45, 8
"""Share of a scan on the scans before from which on it is placed; scans in a row that are not, after which a
new part begins"""
LOOSE = np.diag([0.06, 0.06, 0.12]) ** 2
"""m, rad: how well it is known where to search"""
LAG: Nanos = 350_000_000
"""Time over which the lidar's own speed is a mean"""

Predict: TypeAlias = Callable[[Floats, float], Floats | None]
"""From times and an end [s]: poses of the lidar then, in its frame at the end (n × 3); None: not known."""


@dataclass(slots=True)
class ScanPath:
    """One lidar's path."""

    mount: Mount
    """Of it only roll and pitch count."""
    began: Nanos
    predict: Predict | None = None
    t: list[float] = field(default_factory=list)
    """s after `began`: the scans' ends"""
    poses: list[tuple[float, float, float]] = field(default_factory=list)
    """m, m, rad; yaw is not wrapped"""
    noises: list[Floats] = field(default_factory=list)
    """3 × 3 each"""
    parts: list[int] = field(default_factory=list)
    taken: int = 0
    """Scans that came"""
    _frames: Keyframes = field(default_factory=lambda: Keyframes(SETTINGS))
    _level: Mount = field(init=False)
    _part: int = 0
    _strays: int = 0

    def __post_init__(self) -> None:
        self._level = replace(self.mount, x=0.0, y=0.0, yaw=0.0)

    def take(self, scan: LaserScan) -> None:
        """Place the next scan."""
        end = (scan.t + max(scan.duration, 0) - self.began) / SECOND
        if self.t and end <= self.t[-1]:
            return
        self.taken += 1
        body = to_body(scan, self._level, SETTINGS.farthest, self._swept(scan, end))
        if not self.t or self._strays >= STRAY:
            self._begin(end, body)
            return
        guess = self._guess(end)
        placed = self._frames.place(body, guess, LOOSE)
        if placed is None or placed.share < FITS:
            self._strays += 1
            return
        self._strays = 0
        self._keep(end, placed, body)

    def _begin(self, end: float, body: BodyScan) -> None:
        self._frames = Keyframes(SETTINGS)
        self._frames.add(Pose(0.0, 0.0, 0.0), np.zeros((3, 3)), body, body.hit, 0.0)
        if not len(self._frames):
            return
        self._part, self._strays = self._part + 1, 0
        self.t.append(end)
        self.poses.append((0.0, 0.0, 0.0))
        self.noises.append(np.diag([1e-6, 1e-6, 1e-6]))
        self.parts.append(self._part)

    def _keep(self, end: float, placed: Placed, body: BodyScan) -> None:
        pose = placed.pose
        yaw = self.poses[-1][2] + wrap(pose.yaw - self.poses[-1][2])
        self.t.append(end)
        self.poses.append((pose.x, pose.y, yaw))
        self.noises.append(placed.noise)
        self.parts.append(self._part)
        if self._frames.wants(pose, placed.share):
            self._frames.add(pose, np.zeros((3, 3)), body, body.hit, 0.0)
            self._frames.kept.pop(self._frames.count - 1 - SETTINGS.count, None)  # beyond the local map

    def _velocity(self) -> Floats:
        """Return the mean motion per second of the newest scans, in the lidar's frame."""
        first = len(self.t) - 1
        while first > 0 and self.parts[first - 1] == self._part and self.t[-1] - self.t[first] < LAG / SECOND:
            first -= 1
        span = self.t[-1] - self.t[first] if self.t else 0.0
        if span <= 0.0:
            return np.zeros(3)
        motion = seen_from(np.array(self.poses[first]), np.array(self.poses[-1]))
        half = np.array([0.0, 0.0, -motion[2] / 2.0])
        motion = after(half, motion)  # along the mean heading
        motion[2] -= half[2]
        return motion / span

    def _ahead(self, times: Floats, end: float) -> Floats:
        """Return poses at times in the frame at the end: as predicted, or moving on as before."""
        if self.predict is not None and (known := self.predict(times, end)) is not None:
            return known
        return (times - end)[:, None] * self._velocity()

    def _swept(self, scan: LaserScan, end: float) -> Floats | None:
        """Return where the lidar is at each beam, in its frame at the scan's end."""
        if not scan.duration:
            return None
        count = len(scan.ranges)
        first = (scan.t - self.began) / SECOND
        times = first + scan.duration / SECOND * np.arange(count) / max(count - 1, 1)
        return self._ahead(times, end)

    def _guess(self, end: float) -> Pose:
        before = self._ahead(np.array([self.t[-1]]), end)[0]
        back = seen_from(before, np.zeros(3))
        x, y, yaw = after(np.array(self.poses[-1]), back).tolist()
        return Pose(x, y, wrap(yaw))
