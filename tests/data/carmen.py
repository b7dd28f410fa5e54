"""Logs of the CARMEN toolkit: planar odometry and lidar, and relations between poses that people verified.

Source: Freiburg SLAM evaluation, Radish. A line `ODOM x y theta …` has the odometry's pose, a line
`FLASER n r1 … rn x y theta odom_x odom_y odom_theta stamp …` a scan of half a turn.
"""

from __future__ import annotations

import bz2
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import sinc, wrap
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, LaserScan, Nanos
from tests.brain.bodies.kinematics import speeds

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.1,
    wheel_separation=0.4,
    radius=0.3,
    max_linear=20.0,
    max_angular=50.0,
    max_linear_acceleration=2.0,
    max_angular_acceleration=6.0,
)
"""Stands for both robots: only its kinematics are used, forth and back, so that its figures cancel."""
MOST_RANGE = 40.0
"""m; a longer reading is none"""


def events(path: Path) -> Iterator[Event]:
    """Yield the log in order of time: feedback of two wheels that would have made the odometry, and scans."""
    rows = []
    with bz2.open(path, "rt") as log:
        for line in log:
            fields = line.split()
            if fields and fields[0] in ("ODOM", "FLASER"):
                stamp = float(fields[-3])
                rows.append((round(stamp * SECOND), fields))
    rows.sort(key=lambda row: row[0])
    left = right = 0.0
    before: Pose | None = None
    last: Nanos = -1
    for t, fields in rows:
        at = 1 if fields[0] == "ODOM" else 2 + int(fields[1]) + 3
        pose = Pose(*map(float, fields[at : at + 3]))
        if before is not None:
            turned = speeds(BODY, *arc_between(before, pose))
            left, right = left + turned[0], right + turned[1]
        before = pose
        if t > last:
            yield Feedback("left", t, left)
            yield Feedback("right", t, right)
            last = t
        if fields[0] == "FLASER":
            count = int(fields[1])
            ranges = tuple(float(r) if float(r) < MOST_RANGE else MOST_RANGE for r in fields[2 : 2 + count])
            yield LaserScan("lidar", t, -math.pi / 2, math.pi / (count - 1), 0.05, MOST_RANGE, ranges)


def arc_between(a: Pose, b: Pose) -> tuple[float, float]:
    """Return length [m] and turn [rad] of the arc whose chord is the way from a to b, forward or backward."""
    turn = wrap(b.yaw - a.yaw)
    chord, heading = math.hypot(b.x - a.x, b.y - a.y), a.yaw + turn / 2.0
    ahead = math.cos(heading) * (b.x - a.x) + math.sin(heading) * (b.y - a.y)
    return math.copysign(chord, ahead) / sinc(turn / 2.0), turn


@dataclass(frozen=True)
class Relations:
    """Mean and median error of a path against the verified relations."""

    mean: float
    """m"""
    median: float
    mean_turn: float
    """degrees"""


def against_relations(path: Path, times: Sequence[Nanos], poses: Sequence[Pose]) -> Relations:
    """Compare the poses at these times with a file of relations `t1 t2 x y z roll pitch yaw`."""
    apart, turned = [], []
    for line in path.read_text().splitlines():
        first, second, x, y, _, _, _, yaw = map(float, line.split())
        a, b = (
            poses[max(bisect_right(times, round(t * SECOND) + MILLISECOND) - 1, 0)] for t in (first, second)
        )
        c, s = math.cos(a.yaw), math.sin(a.yaw)
        dx, dy = b.x - a.x, b.y - a.y
        apart.append(math.hypot(c * dx + s * dy - x, c * dy - s * dx - y))
        turned.append(abs(wrap(b.yaw - a.yaw - yaw)))
    apart.sort()
    return Relations(sum(apart) / len(apart), apart[len(apart) // 2], math.degrees(sum(turned) / len(turned)))
