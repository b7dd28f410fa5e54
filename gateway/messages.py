"""Our values as ROS 2 messages: one pure function per message, from what we know to what others can open.

Rules. Units and frames are those of REP-103 and REP-105: SI, x forward, y left, z up; "odom" is the world as
the robot knows it, "base_link" the robot, and every sensor has a frame of its own name. A header's stamp is
the time of the measurement or belief, not of the writing. What a message cannot say is left out, never made
up. No value here raises: what does not fit a field is cut to its range.

`Types` are the message classes by name, as a typestore has them; nothing here imports one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np
import numpy.typing as npt

from brain.belief import Estimate, MapView, Pose
from brain.perception.mount import Mount
from gateway.tick import Note
from protocols.wire import CanFrame
from protocols.words import SECOND, Fix, Goal, Imu, LaserScan, Nanos


class Message(Protocol):
    """An instance of one of the `Types`."""

    @property
    def __msgtype__(self) -> str:
        """Its name: package/msg/Name."""
        ...


Types = Mapping[str, Callable[..., Message]]
Floats = npt.NDArray[np.float64]

WORLD, BASE = "odom", "base_link"
FLOAT32_MAX = 3.4028234663852886e38
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
    """builtin_interfaces/Time; seconds are int32 there."""
    seconds, rest = divmod(t, SECOND)
    return types["builtin_interfaces/msg/Time"](sec=max(-(2**31), min(2**31 - 1, seconds)), nanosec=rest)


def header(types: Types, t: Nanos, frame: str) -> Message:
    """std_msgs/Header."""
    return types["std_msgs/msg/Header"](stamp=stamp(types, t), frame_id=frame)


def can_frame(types: Types, t: Nanos, bus: str, frame: CanFrame) -> Message:
    """can_msgs/Frame, or ros2_socketcan_msgs/FdFrame of an FD frame; the header's frame is the bus."""
    if frame.fd:
        return types[FD_FRAME](
            header=header(types, t, bus),
            id=frame.id,
            is_extended=frame.extended,
            is_error=False,
            len=min(64, len(frame.data)),
            data=np.frombuffer(frame.data[:64], np.uint8),
        )
    return types[CAN_FRAME](
        header=header(types, t, bus),
        id=frame.id,
        is_rtr=frame.remote,
        is_extended=frame.extended,
        is_error=False,
        dlc=min(8, len(frame.data)),
        data=np.frombuffer(frame.data[:8].ljust(8, b"\0"), np.uint8),
    )


# -- where the robot is ------------------------------------------------------------------------


def odometry(types: Types, estimate: Estimate) -> Message:
    """nav_msgs/Odometry of the filter's estimate; z, roll and pitch are zero and certain, the twist has no
    covariance."""
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = estimate.covariance
    return _odometry(
        types, estimate.t, estimate.pose, estimate.linear, estimate.angular, covariance.reshape(36)
    )


def dead_reckoning(types: Types, t: Nanos, pose: Pose) -> Message:
    """nav_msgs/Odometry of the wheels alone; neither twist nor covariance."""
    return _odometry(types, t, pose, 0.0, 0.0, np.zeros(36))


def _odometry(
    types: Types, t: Nanos, pose: Pose, linear: float, angular: float, covariance: Floats
) -> Message:
    twist = types["geometry_msgs/msg/Twist"](
        linear=_vector(types, linear, 0.0, 0.0), angular=_vector(types, 0.0, 0.0, angular)
    )
    return types["nav_msgs/msg/Odometry"](
        header=header(types, t, WORLD),
        child_frame_id=BASE,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=_pose(types, pose), covariance=covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
    )


def base_transform(types: Types, estimate: Estimate) -> Message:
    """tf2_msgs/TFMessage: where base_link stands in odom."""
    pose = estimate.pose
    return _transforms(
        types, [_transform(types, estimate.t, WORLD, BASE, (pose.x, pose.y, 0.0), yaw_quaternion(pose.yaw))]
    )


def mount_transforms(types: Types, t: Nanos, mounts: Mapping[str, Mount]) -> Message:
    """tf2_msgs/TFMessage for /tf_static: how each sensor sits on base_link."""
    return _transforms(
        types,
        [
            _transform(
                types,
                t,
                BASE,
                name,
                (mount.x, mount.y, mount.z),
                quaternion(mount.yaw, mount.pitch, mount.roll),
            )
            for name, mount in mounts.items()
        ],
    )


def _transforms(types: Types, transforms: list[Message]) -> Message:
    return types["tf2_msgs/msg/TFMessage"](transforms=transforms)


def _transform(
    types: Types,
    t: Nanos,
    parent: str,
    child: str,
    at: tuple[float, float, float],
    turned: tuple[float, float, float, float],
) -> Message:
    return types["geometry_msgs/msg/TransformStamped"](
        header=header(types, t, parent),
        child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=_vector(types, *at), rotation=_quaternion(types, turned)
        ),
    )


def path(types: Types, t: Nanos, points: Sequence[tuple[float, float]]) -> Message:
    """nav_msgs/Path in odom; each pose looks along the path to the next."""
    yaws = [math.atan2(y2 - y1, x2 - x1) for (x1, y1), (x2, y2) in pairwise(points)]
    yaws += yaws[-1:] or [0.0]
    poses = [_pose_stamped(types, t, Pose(x, y, yaw)) for (x, y), yaw in zip(points, yaws, strict=False)]
    return types["nav_msgs/msg/Path"](header=header(types, t, WORLD), poses=poses)


def goal_pose(types: Types, t: Nanos, goal: Goal) -> Message:
    """geometry_msgs/PoseStamped; a goal without a yaw looks along x."""
    return _pose_stamped(types, t, Pose(goal.x, goal.y, goal.yaw or 0.0))


def occupancy(types: Types, t: Nanos, view: MapView) -> Message:
    """nav_msgs/OccupancyGrid: percent, row by row from the lower left; -1 (unknown) where log-odds are 0."""
    rows, columns = view.log_odds.shape
    odds = view.log_odds.astype(np.float64)
    percent = np.rint(50.0 + 50.0 * np.tanh(0.5 * odds)).astype(np.int8)
    percent[view.log_odds == 0.0] = -1
    return types["nav_msgs/msg/OccupancyGrid"](
        header=header(types, t, WORLD),
        info=types["nav_msgs/msg/MapMetaData"](
            map_load_time=stamp(types, t),
            resolution=float32(view.resolution),
            width=columns,
            height=rows,
            origin=_pose(types, Pose(view.origin_x, view.origin_y, 0.0)),
        ),
        data=percent.reshape(-1),
    )


# -- what the sensors and motors said ----------------------------------------------------------


def laser_scan(types: Types, scan: LaserScan) -> Message:
    """sensor_msgs/LaserScan: nothing hit is +inf (REP-117); no reading stays as it is, below range_min."""
    ranges = np.array(scan.ranges, np.float64)
    ranges[ranges >= scan.range_max] = np.inf
    with np.errstate(over="ignore"):
        ranges32 = ranges.astype(np.float32)
    return types["sensor_msgs/msg/LaserScan"](
        header=header(types, scan.t, scan.sensor),
        angle_min=float32(scan.angle_min),
        angle_max=float32(scan.angle_min + max(0, len(scan.ranges) - 1) * scan.angle_increment),
        angle_increment=float32(scan.angle_increment),
        time_increment=0.0,
        scan_time=0.0,
        range_min=float32(scan.range_min),
        range_max=float32(scan.range_max),
        ranges=ranges32,
        intensities=np.zeros(0, np.float32),
    )


def imu(types: Types, event: Imu) -> Message:
    """sensor_msgs/Imu; a covariance that starts with -1 marks an orientation that was not measured."""
    orientation_covariance = np.zeros(9)
    if event.orientation is None:
        orientation_covariance[0] = -1.0
    return types["sensor_msgs/msg/Imu"](
        header=header(types, event.t, event.sensor),
        orientation=_quaternion(types, event.orientation or (0.0, 0.0, 0.0, 1.0)),
        orientation_covariance=orientation_covariance,
        angular_velocity=_vector(types, *event.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(types, *event.linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def fix(types: Types, event: Fix) -> Message:
    """sensor_msgs/NavSatFix; an altitude that was not measured is NaN, as that message has it."""
    covariance = np.zeros(9)
    if event.variance is not None:
        covariance[0] = covariance[4] = event.variance
    return types["sensor_msgs/msg/NavSatFix"](
        header=header(types, event.t, event.sensor),
        status=types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=event.latitude,
        longitude=event.longitude,
        altitude=math.nan if event.altitude is None else event.altitude,
        position_covariance=covariance,
        position_covariance_type=0 if event.variance is None else 1,
    )


def joint_state(
    types: Types, t: Nanos, joints: Mapping[str, tuple[float | None, float | None, float | None]]
) -> Message:
    """sensor_msgs/JointState of (position, velocity, effort) by joint, at the output shafts.

    A quantity that no joint measures is an empty array; one that some do not measure is NaN there."""
    columns = [_column(values) for values in zip(*joints.values(), strict=True)]
    return types["sensor_msgs/msg/JointState"](
        header=header(types, t, ""),
        name=list(joints),
        position=columns[0],
        velocity=columns[1],
        effort=columns[2],
    )


def _column(values: Sequence[float | None]) -> Floats:
    if all(v is None for v in values):
        return np.zeros(0)
    return np.array([math.nan if v is None else v for v in values], np.float64)


# -- how it is ---------------------------------------------------------------------------------


def diagnostic_status(
    types: Types, level: int, name: str, message: str, values: Mapping[str, str]
) -> Message:
    """diagnostic_msgs/DiagnosticStatus; level 0 OK, 1 WARN, 2 ERROR, 3 STALE."""
    key_value = types["diagnostic_msgs/msg/KeyValue"]
    return types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=level,
        name=text(name),
        message=text(message),
        hardware_id="",
        values=[key_value(key=text(key), value=text(value)) for key, value in values.items()],
    )


def diagnostics(types: Types, t: Nanos, statuses: list[Message]) -> Message:
    """diagnostic_msgs/DiagnosticArray."""
    return types["diagnostic_msgs/msg/DiagnosticArray"](header=header(types, t, ""), status=statuses)


def log(types: Types, t: Nanos, note: Note) -> Message:
    """rcl_interfaces/Log: what a log panel shows."""
    return types["rcl_interfaces/msg/Log"](
        stamp=stamp(types, t),
        level=_LOG_LEVELS[note.level],
        name=text(note.about),
        msg=text(note.text),
        file="",
        function="",
        line=0,
    )


# -- small ones --------------------------------------------------------------------------------


def float32(value: float) -> float:
    """Cut to what float32 can hold, so that packing it cannot overflow."""
    return max(-FLOAT32_MAX, min(FLOAT32_MAX, value))


def text(said: str) -> str:
    """Fit for UTF-8: a lone surrogate (a stray byte on a terminal) becomes an escape."""
    return said if said.isascii() else said.encode(errors="backslashreplace").decode()


def yaw_quaternion(yaw: float) -> tuple[float, float, float, float]:
    """x, y, z, w of a turn about z."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


def quaternion(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """x, y, z, w of Rz(yaw) Ry(pitch) Rx(roll)."""
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _vector(types: Types, x: float, y: float, z: float) -> Message:
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def _quaternion(types: Types, q: tuple[float, float, float, float]) -> Message:
    return types["geometry_msgs/msg/Quaternion"](x=q[0], y=q[1], z=q[2], w=q[3])


def _pose(types: Types, pose: Pose) -> Message:
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=pose.x, y=pose.y, z=0.0),
        orientation=_quaternion(types, yaw_quaternion(pose.yaw)),
    )


def _pose_stamped(types: Types, t: Nanos, pose: Pose) -> Message:
    return types["geometry_msgs/msg/PoseStamped"](header=header(types, t, WORLD), pose=_pose(types, pose))
