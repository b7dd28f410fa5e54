"""The motion that scans alone show, of a recording in which nothing else says how the base moved.

Rules. Each scan is placed among the newest keyframes (`brain.perception.keyframes`), searched from where the
speed between the two before it would have led; it is as uncertain as a base or a person accelerates. A scan
that shows no place leaves the speed as it was, for a second at most. The poses are the odometry then: what
perception makes of the scans it makes as with wheels.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import Twist, arc
from brain.perception.body_scan import to_body
from brain.perception.keyframes import Keyframes, KeyframeSettings
from brain.perception.mount import Mount
from gateway.rosbag.motion import OdometryReading, between
from protocols.messages import SECOND, LaserScan, Nanos, seconds

AT_LEAST = 0.01, 0.02
"""m, rad: standard deviations of what is predicted for the next scan,"""
ACCELERATION = 3.0, 6.0
"""m/s², rad/s²: and more, by what the speed may change until then"""
COASTS: Nanos = SECOND
"""So long the speed is believed without a scan that shows it"""
USED = 0.3
"""Share of a scan on the keyframes, below which it shows no place"""
USUAL, BURST, PAUSE = 25, 4, 2.5
"""Newest scans whose times tell how far they usually are apart: the median over so many; and how many of
those are a pause"""
STILL = Twist(0.0, 0.0, 0.0)


def by_scans(
    scans: Iterable[LaserScan], mounts: dict[str, Mount], settings: KeyframeSettings
) -> Iterator[OdometryReading]:
    """Yield where the base was at the end of each scan, in order, from where it was at the first; with the
    speed from the one before."""
    keyframes, pose, twist = Keyframes(settings), Pose(0.0, 0.0, 0.0), STILL
    times: deque[Nanos] = deque(maxlen=USUAL)
    t = shown = 0
    for one in scans:
        end = one.t + max(one.duration, 0)
        if t and end <= t:
            continue
        times.append(end)
        dt = _spent(times) if t else 0.0
        scan = to_body(one, mounts[one.sensor], settings.farthest, _sweep(one, twist))
        if end - shown > COASTS:  # who has gone too far to be found begins anew
            twist = STILL
            keyframes.forget_local()
        predicted = arc(pose, twist.linear * dt, twist.angular * dt, twist.lateral * dt)
        changed = 0.5 * min(dt, 0.5) ** 2
        far, wide = (least + changed * a for least, a in zip(AT_LEAST, ACCELERATION, strict=True))
        noise = np.diag([far * far, far * far, wide * wide])
        placed = keyframes.place(scan, predicted, noise)
        known = placed is not None and placed.share > USED
        there = placed.pose if placed is not None and known else predicted
        if known:
            ahead, turn, aside = between(pose, there, sideways=True)
            twist, shown = Twist(ahead / dt, turn / dt, aside / dt), end
        pose, t, share = there, end, placed.share if placed is not None else 0.0
        next_one = (known or not len(keyframes)) and keyframes.wants(pose, share)
        if next_one and keyframes.add(pose, noise, scan, scan.hit, 0.0):
            shown = end
        yield OdometryReading(end, twist.linear, twist.angular, pose, twist.lateral)


def _spent(times: deque[Nanos]) -> float:
    """Return the time between the newest two scans [s]: lidars turn evenly, and stamps come in bursts. Only a
    pause counts by its stamps."""
    t = np.array(times, dtype=np.float64) - times[0]
    over = min(BURST, len(t) - 1)
    usual = float(np.median(t[over:] - t[:-over])) / over / SECOND
    newest = float(t[-1] - t[-2]) / SECOND
    return usual if newest < PAUSE * usual else newest


def _sweep(scan: LaserScan, twist: Twist) -> Floats | None:
    """Return the base's pose at each beam's time, in its frame at the end, at a constant speed: n × 3."""
    if not scan.duration:
        return None
    early = np.linspace(-1.0, 0.0, len(scan.ranges)) * abs(seconds(scan.duration))
    early = early if scan.duration > 0 else early[::-1]
    return np.column_stack([early * twist.linear, early * twist.lateral, early * twist.angular])
