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
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Estimate, Pose
from brain.bodies.plane import frame_of
from protocols.frames import CanFrame
from protocols.messages import SECOND, Measurement, Nanos
from protocols.sensors import RosView

MAP, ODOM, BASE = "map", "odom", "base_link"
"""REP-105: the frames of the map, in which the robot's pose leaps when it is corrected; of the odometry, in
which it drifts; and of the robot."""
FLOAT32_MAX = 3.4028234663852886e38

_ENCAPSULATION = b"\x00\x01\x00\x00"
_CAN = "I4B8s"
_FD = "I3BI"
_ODOMETRY = "85d"
_POSE = "43d"
_TRANSFORM = "7d"
_NO_COVARIANCE = (0.0,) * 36
_U32 = struct.Struct("<I")
_NUMBERS = re.compile(r"(\d*)([bBhHiIqQfds])")


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
    _buses: dict[tuple[str, str], tuple[Callable[..., bytes], bytes]] = field(default_factory=dict)

    def of_bus(self, numbers: str, bus: str) -> tuple[Callable[..., bytes], bytes]:
        """Return how a stamped message with the name of a bus is packed, and that as it is packed."""
        known = self._buses.get((numbers, bus))
        if known is None:
            name = bus.encode(errors="backslashreplace") + b"\0"
            known = self._buses[numbers, bus] = self.stamped(numbers, bus).pack, name
        return known

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
    for count, letter in _NUMBERS.findall(numbers):
        width = struct.calcsize(f"<{letter}")
        form += f"{-at % width}x{count}{letter}"
        at += -at % width + width * int(count or 1)
    return struct.Struct(form)


def _name(name: str) -> tuple[int, bytes]:
    """Return size and bytes for `struct`, which pads with the terminating zero."""
    data = name.encode(errors="backslashreplace")
    return len(data) + 1, data


def can_frame(layouts: Layouts, t: Nanos, bus: str, frame: CanFrame) -> bytes:
    """Encode can_msgs/Frame of a classic frame; the header's frame is the bus."""
    data = frame.data[:8]
    length = frame.requested if frame.remote else len(data)
    pack, name = layouts.of_bus(_CAN, bus)
    seconds, rest = clock(t)
    number = frame.id & 0xFFFFFFFF
    return pack(
        _ENCAPSULATION, seconds, rest, len(name), name, number, frame.remote, frame.extended, 0, length, data
    )


def fd_frame(layouts: Layouts, t: Nanos, bus: str, frame: CanFrame) -> bytes:
    """Encode ros2_socketcan_msgs/FdFrame of an FD frame; the header's frame is the bus."""
    data = frame.data[:64]
    size = len(data)
    pack, name = layouts.of_bus(_FD, bus)
    seconds, rest = clock(t)
    number = frame.id & 0xFFFFFFFF
    head = pack(_ENCAPSULATION, seconds, rest, len(name), name, number, frame.extended, 0, size, size)
    return head + data


def odometry(layouts: Layouts, estimate: Estimate) -> bytes:
    """Encode nav_msgs/Odometry of the filter's estimate in odom; neither the pose nor the twist has a
    covariance there."""
    return _odometry(layouts, estimate.t, estimate.odom, estimate.linear, estimate.angular)


def pose_in_map(layouts: Layouts, estimate: Estimate) -> bytes:
    """Encode geometry_msgs/PoseWithCovarianceStamped of the filter's estimate in map; z, roll and pitch are
    zero with zero variance."""
    (xx, xy, xa), (yx, yy, ya), (ax, ay, aa) = estimate.covariance.tolist()
    none = (0.0, 0.0, 0.0)
    covariance = (xx, xy, *none, xa, yx, yy, *none, ya, *(0.0,) * 18, ax, ay, *none, aa)
    return layouts.stamped(_POSE, MAP).pack(
        _ENCAPSULATION, *clock(estimate.t), *_name(MAP), *_numbers(estimate.pose), *covariance
    )


def dead_reckoning(layouts: Layouts, t: Nanos, pose: Pose) -> bytes:
    """Encode nav_msgs/Odometry of the wheels alone; neither twist nor covariance."""
    return _odometry(layouts, t, pose, 0.0, 0.0)


def _odometry(layouts: Layouts, t: Nanos, pose: Pose, linear: float, angular: float) -> bytes:
    return layouts.stamped(_ODOMETRY, ODOM, BASE).pack(
        _ENCAPSULATION, *clock(t), *_name(ODOM), *_name(BASE), *_numbers(pose), *_NO_COVARIANCE,
        linear, 0.0, 0.0, 0.0, 0.0, angular, *_NO_COVARIANCE,
    )  # fmt: skip


def _numbers(pose: Pose) -> tuple[float, ...]:
    """Return position and quaternion."""
    return pose.x, pose.y, 0.0, 0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2)


def transforms(layouts: Layouts, estimate: Estimate) -> bytes:
    """Encode tf2_msgs/TFMessage: base_link in odom, and odom in map."""
    stamp = clock(estimate.t)
    base = layouts.stamped(_TRANSFORM, ODOM, BASE, many=True).pack(
        _ENCAPSULATION, 2, *stamp, *_name(ODOM), *_name(BASE), *_numbers(estimate.odom)
    )
    odom = layouts.stamped(_TRANSFORM, MAP, ODOM).pack(
        _ENCAPSULATION, *stamp, *_name(MAP), *_name(ODOM), *_numbers(frame_of(estimate.pose, estimate.odom))
    )
    return base + odom[len(_ENCAPSULATION) :]


def reading(layouts: Layouts, view: RosView, event: Measurement) -> bytes:
    """Encode a sensor's reading as its kind has it. Raises whatever a third party's view raises."""
    numbers, arrays = view.content(event)
    frame = view.frame or event.sensor
    layout, head = layouts.stamped(view.numbers, frame), (_ENCAPSULATION, *clock(event.t), *_name(frame))
    try:
        packed = layout.pack(*head, *numbers)
    except OverflowError:
        packed = layout.pack(*head, *map(float32, numbers))
    return packed + b"".join(_floats32(array, len(packed)) for array in arrays)


def _floats32(values: Sequence[float], at: int) -> bytes:
    """Encode a sequence of float32 after so many bytes, of which the encapsulation's do not matter."""
    with np.errstate(over="ignore"):
        return bytes(-at % 4) + _U32.pack(len(values)) + np.array(values, np.float64).astype("<f4").tobytes()


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
