"""The frequent ROS 2 messages, encoded to bytes (CDR, little endian) directly from the gateway's values.

Rules. Units, frames and stamps as in `gateway.recording.ros_messages`, which makes the rare ones. Encoded by
`struct`, because this runs at every step: a general serialiser costs several times as much. A test compares
every message with the general serialiser, byte for byte. Nothing here raises: a value that does not fit its
field is clamped.

The part of a message before its numbers (stamp, names) has a length that depends on the names only, so one
`struct.Struct` per message and name describes the whole; `Layouts` caches them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Estimate, Pose
from protocols.frames import CanFrame
from protocols.messages import SECOND, Imu, LaserScan, Nanos

WORLD, BASE = "odom", "base_link"
"""REP-105: the frames of the odometry and of the robot."""
FLOAT32_MAX = 3.4028234663852886e38

_ENCAPSULATION = b"\x00\x01\x00\x00"
_CAN = "I4B8s"
_FD = "I3BxI"
_IMU = "37d"
_ODOMETRY = "85d"
_TRANSFORM = "7d"
_SCAN = "7fI"
_NO_COVARIANCE = (0.0,) * 36
_NO_COVARIANCE_3 = (0.0,) * 9
_NOT_MEASURED_3 = (-1.0, *_NO_COVARIANCE_3[1:])
_NO_INTENSITIES = bytes(4)
_U32 = struct.Struct("<I")


def clock(t: Nanos) -> tuple[int, int]:
    """Return builtin_interfaces/Time: seconds (int32 there) and nanoseconds."""
    seconds, rest = divmod(t, SECOND)
    return max(-(2**31), min(2**31 - 1, seconds)), rest


def float32(value: float) -> float:
    """Clamp to the range of float32, so that packing cannot overflow."""
    return max(-FLOAT32_MAX, min(FLOAT32_MAX, value))


@dataclass(slots=True)
class Layouts:
    """Cache of `struct` layouts, by the numbers and names of a message. Belongs to one `Views`."""

    _known: dict[tuple[str, tuple[str, ...]], struct.Struct] = field(default_factory=dict)

    def stamped(self, numbers: str, *names: str, many: bool = False) -> struct.Struct:
        """Return the layout: encapsulation, (with `many`, a sequence's count,) stamp, strings, numbers."""
        key = (numbers, names)
        layout = self._known.get(key)
        if layout is None:
            layout = self._known[key] = _layout(numbers, names, many)
        return layout


def _layout(numbers: str, names: Sequence[str], many: bool) -> struct.Struct:
    """Build a layout. The encapsulation does not count for alignment."""
    at = 12 if many else 8
    form = "<4sIiI" if many else "<4siI"
    for name in names:
        size = len(name.encode(errors="backslashreplace")) + 1
        form += f"{-at % 4}xI{size}s"
        at += -at % 4 + 4 + size
    widest = 8 if "d" in numbers else 4
    return struct.Struct(f"{form}{-at % widest}x{numbers}")


def _name(name: str) -> tuple[int, bytes]:
    """Return size and bytes for `struct`, which pads with the terminating zero."""
    data = name.encode(errors="backslashreplace")
    return len(data) + 1, data


def can_frame(layouts: Layouts, t: Nanos, bus: str, frame: CanFrame) -> bytes:
    """Encode can_msgs/Frame of a classic frame; the header's frame is the bus."""
    data = frame.data[:8]
    length = frame.requested if frame.remote else len(data)
    head = (frame.id & 0xFFFFFFFF, frame.remote, frame.extended, 0, length)
    return layouts.stamped(_CAN, bus).pack(_ENCAPSULATION, *clock(t), *_name(bus), *head, data)


def fd_frame(layouts: Layouts, t: Nanos, bus: str, frame: CanFrame) -> bytes:
    """Encode ros2_socketcan_msgs/FdFrame of an FD frame; the header's frame is the bus."""
    data = frame.data[:64]
    size = len(data)
    head = (frame.id & 0xFFFFFFFF, frame.extended, 0, size, size)
    return layouts.stamped(_FD, bus).pack(_ENCAPSULATION, *clock(t), *_name(bus), *head) + data


def odometry(layouts: Layouts, estimate: Estimate) -> bytes:
    """Encode nav_msgs/Odometry of the filter's estimate; z, roll and pitch are zero with zero variance, the
    twist has no covariance."""
    (xx, xy, xa), (yx, yy, ya), (ax, ay, aa) = estimate.covariance.tolist()
    none = (0.0, 0.0, 0.0)
    covariance = (xx, xy, *none, xa, yx, yy, *none, ya, *(0.0,) * 18, ax, ay, *none, aa)
    return _odometry(layouts, estimate.t, estimate.pose, estimate.linear, estimate.angular, covariance)


def dead_reckoning(layouts: Layouts, t: Nanos, pose: Pose) -> bytes:
    """Encode nav_msgs/Odometry of the wheels alone; neither twist nor covariance."""
    return _odometry(layouts, t, pose, 0.0, 0.0, _NO_COVARIANCE)


def _odometry(
    layouts: Layouts, t: Nanos, pose: Pose, linear: float, angular: float, covariance: Sequence[float]
) -> bytes:
    return layouts.stamped(_ODOMETRY, WORLD, BASE).pack(
        _ENCAPSULATION, *clock(t), *_name(WORLD), *_name(BASE),
        pose.x, pose.y, 0.0, 0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2), *covariance,
        linear, 0.0, 0.0, 0.0, 0.0, angular, *_NO_COVARIANCE,
    )  # fmt: skip


def base_transform(layouts: Layouts, estimate: Estimate) -> bytes:
    """Encode tf2_msgs/TFMessage: base_link in odom."""
    pose = estimate.pose
    return layouts.stamped(_TRANSFORM, WORLD, BASE, many=True).pack(
        _ENCAPSULATION, 1, *clock(estimate.t), *_name(WORLD), *_name(BASE),
        pose.x, pose.y, 0.0, 0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2),
    )  # fmt: skip


def imu(layouts: Layouts, event: Imu) -> bytes:
    """Encode sensor_msgs/Imu; a covariance that starts with -1 marks an orientation not measured."""
    known = event.orientation is not None
    return layouts.stamped(_IMU, event.sensor).pack(
        _ENCAPSULATION, *clock(event.t), *_name(event.sensor),
        *(event.orientation or (0.0, 0.0, 0.0, 1.0)), *(_NO_COVARIANCE_3 if known else _NOT_MEASURED_3),
        *event.angular_velocity, *_NO_COVARIANCE_3, *event.linear_acceleration, *_NO_COVARIANCE_3,
    )  # fmt: skip


def laser_scan(layouts: Layouts, scan: LaserScan) -> bytes:
    """Encode sensor_msgs/LaserScan: no hit is +inf (REP-117); no reading stays below range_min.

    `scan_time` is 0, since one message does not have the time between scans."""
    ranges = np.array(scan.ranges, np.float64)
    ranges[ranges >= scan.range_max] = np.inf
    with np.errstate(over="ignore"):
        ranges32 = ranges.astype("<f4")
    steps = max(0, len(scan.ranges) - 1)
    last = scan.angle_min + steps * scan.angle_increment
    between = scan.duration / SECOND / max(1, steps)
    head = layouts.stamped(_SCAN, scan.sensor).pack(
        _ENCAPSULATION, *clock(scan.t), *_name(scan.sensor),
        float32(scan.angle_min), float32(last), float32(scan.angle_increment), float32(between), 0.0,
        float32(scan.range_min), float32(scan.range_max), len(ranges32),
    )  # fmt: skip
    return head + ranges32.tobytes() + _NO_INTENSITIES


def joint_state(t: Nanos, joints: Mapping[str, tuple[float | None, float | None, float | None]]) -> bytes:
    """Encode sensor_msgs/JointState of (position, velocity, effort) by joint, at the output shafts.

    A quantity that no joint measures is an empty array; one that some do not measure is NaN there."""
    out = bytearray(struct.pack("<4siIIsxxxI", _ENCAPSULATION, *clock(t), 1, b"", len(joints)))
    for name in joints:
        size, data = _name(name)
        out += bytes(-len(out) % 4) + _U32.pack(size) + data + b"\0"
    for quantity in range(3):
        _doubles(out, [measured[quantity] for measured in joints.values()])
    return bytes(out)


def _doubles(out: bytearray, values: Sequence[float | None]) -> None:
    out += bytes(-len(out) % 4)
    known = [math.nan if v is None else v for v in values] if any(v is not None for v in values) else []
    out += _U32.pack(len(known))
    if known:
        out += bytes((4 - len(out)) % 8) + struct.pack(f"<{len(known)}d", *known)
