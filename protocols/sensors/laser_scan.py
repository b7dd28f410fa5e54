"""Planar lidars: a revolution of ranges."""

from __future__ import annotations

import math

from protocols.messages import SECOND, LaserScan, Nanos
from protocols.sensors.kind import Content, Quantity, RosView, SensorKind


def _ros(scan: LaserScan) -> Content:
    """No hit is +inf (REP-117); no reading stays below range_min. `scan_time` is 0, since one message does
    not have the time between scans; of a lidar that turns clockwise `time_increment` is negative."""
    steps = max(0, len(scan.ranges) - 1)
    last = scan.angle_min + steps * scan.angle_increment
    between = scan.duration / SECOND / max(1, steps)
    head = scan.angle_min, last, scan.angle_increment, between, 0.0, scan.range_min, scan.range_max
    return head, ([math.inf if r >= scan.range_max else r for r in scan.ranges], ())


def _agrees(true: LaserScan, reported: LaserScan, error: float) -> bool:
    """Each beam has the range of a true one beside it, or lies between two of these on one surface; if it has
    none, a true one beside it is out of reach."""
    low, high = max(true.range_min, reported.range_min), min(true.range_max, reported.range_max)
    for at, found in enumerate(reported.ranges):
        angle = reported.angle_min + at * reported.angle_increment
        first = math.floor((angle - true.angle_min) / true.angle_increment)
        beside = [true.ranges[(first + k) % len(true.ranges)] for k in (-1, 0, 1, 2)]
        seen = [each for each in beside if low <= each < high]
        if found < reported.range_min or found >= reported.range_max:
            if all(low + error < each < high - error for each in beside):
                return False
        elif not seen or not min(seen) - error <= found <= max(seen) + error:
            return False
    return True


def _text(scan: LaserScan) -> str:
    valid = [r for r in scan.ranges if scan.range_min <= r < scan.range_max]
    nearest = f", the nearest at {min(valid):.3f} m" if valid else ""
    return f"{len(scan.ranges)} beams, {len(valid)} with an echo{nearest}"


def _sample(sensor: str, t: Nanos, count: int) -> LaserScan:
    ranges = tuple(2.0 + math.sin(0.37 * count + 0.1 * beam) for beam in range(36))
    return LaserScan(sensor, t, -math.pi, math.pi / 18, 0.1, 10.0, ranges, 1000 * (count % 7))


KIND = SensorKind(
    name="laser_scan",
    message=LaserScan,
    quantities={
        "angle_min": Quantity("rad", -1e3, 1e3),
        "angle_increment": Quantity("rad", -1e3, 1e3),
        "range_min": Quantity("m", 0.0, 1e6),
        "range_max": Quantity("m", 0.0, 1e6),
        "ranges": Quantity("m", 0.0, 1e6),
        "duration": Quantity("ns", -float(10 * SECOND), float(10 * SECOND)),
    },
    sample=_sample,
    text=_text,
    ros=RosView("/scan", "sensor_msgs/msg/LaserScan", "7f", _ros),
    code=78,
    agrees=_agrees,
    added=(0,),
)
