"""Scans and clouds of points, of a bag or a log → a planar lidar's scan, or why it is not used.

Rules. A reading that is not finite, or beyond the largest range, is "nothing there"; one below the smallest
range is none at all. Beams go counter-clockwise: those of a lidar that turns clockwise are put in order. Of
several echoes of a beam the nearest counts. Of a cloud one ring is taken, or a band of heights in the lidar's
frame, and of that the nearest point in each direction.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from brain.belief import Floats
from gateway.core.robot import CloudSlice
from gateway.rosbag.carmen import NEAREST, CarmenScan
from protocols.messages import SECOND, LaserScan, Nanos

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__LaserScan as RosScan
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__MultiEchoLaserScan as RosEchoes
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as RosCloud

DIRECTIONS = 720
"""Beams of a scan made of a cloud."""
MOST_BEAMS = 10_000
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Types of a field (sensor_msgs/PointField.msg)."""
ROUNDED = 1e-4
"""Share by which a full turn may be exceeded: angles are of single precision."""
FARTHEST = 100.0
"""m: the largest range of a scan made of a cloud, which names none."""


def of_laser(sensor: str, t: Nanos, message: RosScan) -> LaserScan | str:
    """Return the scan of sensor_msgs/LaserScan."""
    return _planar(sensor, t, message, np.asarray(message.ranges, dtype=np.float64))


def of_echoes(sensor: str, t: Nanos, message: RosEchoes) -> LaserScan | str:
    """Return the nearest echoes of sensor_msgs/MultiEchoLaserScan."""
    least = float(message.range_min)
    echoes = (np.asarray(one.echoes, dtype=np.float64) for one in message.ranges)
    near = (min((e for e in one.tolist() if e >= least), default=math.inf) for one in echoes)
    return _planar(sensor, t, message, np.array(list(near)))


def _planar(sensor: str, t: Nanos, message: RosScan | RosEchoes, ranges: Floats) -> LaserScan | str:
    least, most = float(message.range_min), float(message.range_max)
    first, step = float(message.angle_min), float(message.angle_increment)
    numbers = (first, step, least, float(message.time_increment))
    if not all(map(math.isfinite, numbers)) or not most > 0.0 or not step:
        return "not a scan: its angles or limits are no numbers"
    if not 0 < len(ranges) <= MOST_BEAMS:
        return f"{len(ranges)} beams"
    most = min(most, 1e4)
    below = np.isneginf(ranges) | (np.isfinite(ranges) & (ranges < least))
    ranges = np.where(np.isfinite(ranges) & (ranges < most), ranges, most)
    ranges[below] = min(0.0, least)
    duration = round(float(message.time_increment) * (len(ranges) - 1) * SECOND)
    if abs(duration) > SECOND:
        duration = 0  # of no lidar: the time of a whole scan, in the place of a beam's
    if step < 0.0:
        first, step, ranges = first + step * (len(ranges) - 1), -step, ranges[::-1]
        t, duration = t + duration, -duration  # what was measured first is the last beam now
    whole = 2.0 * math.pi / max(len(ranges) - 1, 1)
    if whole < step < whole * (1.0 + ROUNDED):
        step = whole
    return LaserScan(sensor, t, first, step, least, most, tuple(ranges.tolist()), duration)


def of_log(sensor: str, message: CarmenScan) -> LaserScan:
    """Return the scan of a line of a log."""
    most = message.range_max
    ranges = tuple(min(one, most) if math.isfinite(one) else most for one in message.ranges)
    return LaserScan(sensor, message.t, message.angle_min, message.angle_increment, NEAREST, most, ranges)


def of_cloud(sensor: str, t: Nanos, message: RosCloud, part: CloudSlice | None) -> LaserScan | str:
    """Return a slice of sensor_msgs/PointCloud2 as a scan."""
    points = _columns(message)
    if isinstance(points, str):
        return points
    x, y, z = (points[name].astype(np.float64) for name in ("x", "y", "z"))
    kept = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    if part is None and "ring" in points:
        part = CloudSlice(ring=_level(points["ring"], x, y, z, kept))
    part = part or CloudSlice()
    if part.ring is None:
        kept &= (z >= part.low) & (z <= part.high)
    elif "ring" not in points:
        return f"its points have no field 'ring', of which {part.ring} is wanted: {', '.join(points)}"
    else:
        kept &= points["ring"] == part.ring
    distance = np.hypot(x, y)
    kept &= distance > 0.0
    angles = np.arctan2(y[kept], x[kept])
    step = 2.0 * math.pi / DIRECTIONS
    sectors = np.floor((angles + math.pi) / step).astype(np.int64) % DIRECTIONS
    nearest = np.full(DIRECTIONS, FARTHEST)
    np.minimum.at(nearest, sectors, distance[kept])
    first = -math.pi + step / 2.0
    return LaserScan(sensor, t, first, step, NEAREST, FARTHEST, tuple(nearest.tolist()))


def _columns(message: RosCloud) -> dict[str, Any] | str:
    """Return the fields of a cloud's points by name, or what is wrong with them."""
    order = ">" if message.is_bigendian else "<"
    step, count = int(message.point_step), int(message.width) * int(message.height)
    fields = {one.name: one for one in message.fields if one.datatype in NUMBERS}
    if not {"x", "y", "z"} <= fields.keys():
        return f"its points have no x, y and z, but {', '.join(fields) or 'nothing'}"
    sizes = {name: np.dtype(NUMBERS[one.datatype]).itemsize for name, one in fields.items()}
    data = np.asarray(message.data, dtype=np.uint8)
    if step < max(one.offset + sizes[name] for name, one in fields.items()) or len(data) < step * count:
        return "not a cloud: its data are shorter than it says"
    rows = data[: step * count].reshape(count, step)
    return {
        name: np.ascontiguousarray(rows[:, one.offset : one.offset + sizes[name]]).view(
            order + NUMBERS[one.datatype]
        )[:, 0]
        for name, one in fields.items()
        if name in ("x", "y", "z", "ring")
    }


def _level(ring: Any, x: Floats, y: Floats, z: Floats, kept: Any) -> int:  # noqa: ANN401 -- arrays of any type
    """Return the number of the ring that is nearest to level."""
    if not kept.any():
        return 0
    rise = np.abs(np.arctan2(z, np.hypot(x, y)))
    numbers = np.unique(ring[kept])
    means = [float(np.median(rise[kept & (ring == one)])) for one in numbers]
    return int(numbers[int(np.argmin(means))])
