"""Logs of the CARMEN toolkit: planar odometry and lidar, and relations between poses that people verified.

Source: Freiburg SLAM evaluation, Radish. A line `ODOM x y theta …` has the odometry's pose, a line
`FLASER n r1 … rn x y theta odom_x odom_y odom_theta stamp …` a scan of half a turn from the right: the rays
are whole degrees apart, so that of 180 the last one is a degree short of the left.
"""

from __future__ import annotations

import bz2
import math
from collections.abc import Iterator
from pathlib import Path

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import sinc, wrap
from brain.perception.filter_settings import FilterSettings
from brain.perception.perception import PerceptionSettings
from protocols.messages import SECOND, Event, Feedback, LaserScan, Nanos
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
SETTINGS = PerceptionSettings(FilterSettings(jump_margin=10.0))
"""The defaults; what stamps in bursts, up to 0.9 s late, make of a speed is no jump of the wheels."""
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
            yield LaserScan("lidar", t, -math.pi / 2, math.pi / count, 0.05, MOST_RANGE, ranges)


def arc_between(a: Pose, b: Pose) -> tuple[float, float]:
    """Return length [m] and turn [rad] of the arc whose chord is the way from a to b, forward or backward."""
    turn = wrap(b.yaw - a.yaw)
    chord, heading = math.hypot(b.x - a.x, b.y - a.y), a.yaw + turn / 2.0
    ahead = math.cos(heading) * (b.x - a.x) + math.sin(heading) * (b.y - a.y)
    return math.copysign(chord, ahead) / sinc(turn / 2.0), turn
