"""The gateway's values as ROS 2 messages: one pure function per message.

Here are the rare ones, as objects for a general serialiser; frequent ones are in `gateway.recording.ros_cdr`.

Rules. Units and frames are those of REP-103 and REP-105: SI, x forward, y left, z up; "map" is the fixed
frame, in "odom" the robot never leaps, "base_link" is the robot, and every sensor has a frame of its own
name. A header's stamp is the time of the measurement or estimate, not of the writing. What a message type
cannot represent is left out, never invented. Nothing here raises: a value that does not fit its field is
clamped.

`Types` are the message classes by name, as in a typestore; nothing here imports one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from brain.belief import MapView, Pose
from brain.perception.mount import Mount
from gateway.core.tick import Note
from gateway.recording.ros_cdr import BASE, MAP, clock, float32
from protocols.messages import Goal, Nanos


class Message(Protocol):
    """An instance of one of the `Types`."""

    @property
    def __msgtype__(self) -> str:
        """Its name: package/msg/Name."""
        ...


Types = Mapping[str, Callable[..., Message]]
Floats = npt.NDArray[np.float64]

UNKNOWN = -1
"""A cell of an OccupancyGrid of which nothing is known."""
_LOG_LEVELS = {"info": 20, "warning": 30, "error": 40}

CAN_FRAME = "can_msgs/msg/Frame"
CAN_FRAME_DEFINITION = """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""
"""ros-industrial/ros_canopen@e11f6c7, can_msgs/msg/Frame.msg."""

FD_FRAME = "ros2_socketcan_msgs/msg/FdFrame"
FD_FRAME_DEFINITION = """\
std_msgs/Header header
uint32 id
bool is_extended
bool is_error
uint8 len
uint8[<=64] data
"""
"""autowarefoundation/ros2_socketcan@ef82344, ros2_socketcan_msgs/msg/FdFrame.msg."""


def stamp(types: Types, t: Nanos) -> Message:
    """Make builtin_interfaces/Time; seconds are int32 there."""
    seconds, rest = clock(t)
    return types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)


def header(types: Types, t: Nanos, frame: str) -> Message:
    """Make std_msgs/Header."""
    return types["std_msgs/msg/Header"](stamp=stamp(types, t), frame_id=frame)


# -- poses, path, map --------------------------------------------------------------------------


def mount_transforms(types: Types, t: Nanos, mounts: Mapping[str, Mount]) -> Message:
    """Make tf2_msgs/TFMessage for /tf_static: the mounting of each sensor on base_link."""
    transforms = [
        types["geometry_msgs/msg/TransformStamped"](
            header=header(types, t, BASE),
            child_frame_id=name,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](x=mount.x, y=mount.y, z=mount.z),
                rotation=_quaternion(types, *quaternion(mount.yaw, mount.pitch, mount.roll)),
            ),
        )
        for name, mount in mounts.items()
    ]
    return types["tf2_msgs/msg/TFMessage"](transforms=transforms)


def path(types: Types, t: Nanos, points: Sequence[tuple[float, float]]) -> Message:
    """Make nav_msgs/Path in map; each pose is directed to the next."""
    yaws = [math.atan2(y2 - y1, x2 - x1) for (x1, y1), (x2, y2) in pairwise(points)]
    yaws += yaws[-1:] or [0.0]
    poses = [_pose_stamped(types, t, Pose(x, y, yaw)) for (x, y), yaw in zip(points, yaws, strict=False)]
    return types["nav_msgs/msg/Path"](header=header(types, t, MAP), poses=poses)


def goal_pose(types: Types, t: Nanos, goal: Goal) -> Message:
    """Make geometry_msgs/PoseStamped; a goal without a yaw is directed along x."""
    return _pose_stamped(types, t, Pose(goal.x, goal.y, goal.yaw or 0.0))


def percent(log_odds: npt.NDArray[Any]) -> npt.NDArray[np.int8]:
    """Return the probability of being occupied, as an OccupancyGrid has it; unknown for log-odds 0."""
    log_odds = log_odds.astype(np.float32, copy=False)
    found = np.rint(50.0 + 50.0 * np.tanh(np.float32(0.5) * log_odds)).astype(np.int8)
    found[log_odds == 0.0] = UNKNOWN
    return found


def occupancy(types: Types, t: Nanos, view: MapView) -> Message:
    """Make nav_msgs/OccupancyGrid of a map."""
    return grid(types, t, view.resolution, (view.origin_x, view.origin_y), percent(view.log_odds))


def grid(
    types: Types, t: Nanos, resolution: float, origin: tuple[float, float], cells: npt.NDArray[np.int8]
) -> Message:
    """Make nav_msgs/OccupancyGrid: percent, row by row from the lower left."""
    rows, columns = cells.shape
    return types["nav_msgs/msg/OccupancyGrid"](
        header=header(types, t, MAP),
        info=types["nav_msgs/msg/MapMetaData"](
            map_load_time=stamp(types, t),
            resolution=float32(resolution),
            width=columns,
            height=rows,
            origin=_pose(types, Pose(*origin, 0.0)),
        ),
        data=cells.reshape(-1),
    )


def battery(types: Types, t: Nanos, volts: float) -> Message:
    """Make sensor_msgs/BatteryState of the voltage alone; what is not measured is NaN."""
    unknown = float("nan")
    nothing = np.empty(0, np.float32)
    return types["sensor_msgs/msg/BatteryState"](
        header=header(types, t, ""),
        voltage=float32(volts),
        temperature=unknown,
        current=unknown,
        charge=unknown,
        capacity=unknown,
        design_capacity=unknown,
        percentage=unknown,
        power_supply_status=0,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=nothing,
        cell_temperature=nothing,
        location="",
        serial_number="",
    )


# -- diagnostics -------------------------------------------------------------------------------


def diagnostic_status(
    types: Types, level: int, name: str, message: str, values: Mapping[str, str]
) -> Message:
    """Make diagnostic_msgs/DiagnosticStatus; level 0 OK, 1 WARN, 2 ERROR, 3 STALE."""
    key_value = types["diagnostic_msgs/msg/KeyValue"]
    return types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=level,
        name=text(name),
        message=text(message),
        hardware_id="",
        values=[key_value(key=text(key), value=text(value)) for key, value in values.items()],
    )


def diagnostics(types: Types, t: Nanos, statuses: list[Message]) -> Message:
    """Make diagnostic_msgs/DiagnosticArray."""
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=header(types, t, ""), status=statuses)


def log(types: Types, t: Nanos, note: Note) -> Message:
    """Make rcl_interfaces/Log, for a log panel."""
    return types["rcl_interfaces/msg/Log"](
        stamp=stamp(types, t),
        level=_LOG_LEVELS[note.level],
        name=text(note.source),
        msg=text(note.text),
        file="",
        function="",
        line=0,
    )


# -- parts -------------------------------------------------------------------------------------


def text(raw: str) -> str:
    """Return text that UTF-8 can encode: a lone surrogate (a stray byte of a terminal) becomes an escape."""
    return raw if raw.isascii() else raw.encode(errors="backslashreplace").decode()


def quaternion(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """Return x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _quaternion(types: Types, x: float, y: float, z: float, w: float) -> Message:
    return types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)


def _pose(types: Types, pose: Pose) -> Message:
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=pose.x, y=pose.y, z=0.0),
        orientation=_quaternion(types, 0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2)),
    )


def _pose_stamped(types: Types, t: Nanos, pose: Pose) -> Message:
    return types["geometry_msgs/msg/PoseStamped"](header=header(types, t, MAP), pose=_pose(types, pose))
