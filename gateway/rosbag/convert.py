"""Conversion of one message to a reading, or the reason why it is not used; by its role and its type.

The types of ROS 1 and ROS 2 are alike (common_interfaces: nav_msgs, sensor_msgs, geometry_msgs); types that
are in neither stand in the recording itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

from brain.belief import Pose
from gateway.core.robot import BagTopics, Car, CloudSlice
from gateway.rosbag import scans
from gateway.rosbag.carmen import POSE_TYPE, SCAN_TYPE, CarmenPose, CarmenScan
from gateway.rosbag.frames import TF_TYPES
from gateway.rosbag.motion import JointsReading, OdometryReading
from protocols.messages import SECOND, Fix, Imu, LaserScan, Measurement, Nanos, PoseReading

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Pose as RosPose
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as RosQuaternion
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as RosVector
    from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Odometry as RosOdometry
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as RosImu
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__JointState as RosJoints
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__NavSatFix as RosFix

UNUSED = 1e6
"""A variance from here on marks an axis that is not measured, by convention of base drivers."""
NOT_MEASURED = -1.0
"""In the first field of a covariance: the message has no such measurement (sensor_msgs/Imu.msg)."""


class TruePose(NamedTuple):
    """Where the robot truly was."""

    t: Nanos
    pose: Pose


Truth: TypeAlias = Fix | TruePose
Reading: TypeAlias = OdometryReading | JointsReading | Measurement | TruePose


class Context(NamedTuple):
    """What a conversion has to know beside the message."""

    sensor: str
    """Its name on this robot"""
    joints: tuple[str, ...]
    topics: BagTopics


ODOMETRY, TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistStamped"
TWIST_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
JOINTS = "sensor_msgs/msg/JointState"
IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
POSE, POSE_COVARIANCE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
PLACED = "geometry_msgs/msg/TransformStamped"
SCAN, ECHOES = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
STEEPEST = 1.5
"""rad: no car steers farther."""
LARGE = (SCAN, ECHOES, CLOUD, SCAN_TYPE)
"""Of these a recording may hold more than fits into memory."""


class Converter:
    """Converts messages, in the order of writing: a position of the steering counts until the next one."""

    def __init__(self, topics: BagTopics, joints: tuple[str, ...], types: Mapping[str, str]) -> None:
        """`types`: of each topic's messages."""
        self._topics, self._joints, self._types = topics, joints, types
        self._steering: float | None = None

    def take(self, topic: str, role: str, message: Any) -> Reading | str | None:  # noqa: ANN401
        """Return a reading, or why there is none; None: it only explains others."""
        kind, _, sensor = role.partition(".")
        if isinstance(message, str):
            return message
        car = self._topics.car
        if car is not None and kind == "car":
            position = number(message, car.position)
            if isinstance(position, str):
                return position
            self._steering = position
            return None
        reading: Reading | str
        if car is not None and kind == "odometry":
            reading = _car(message, car, self._steering)
        else:
            known = CONVERSIONS[kind][self._types[topic]]
            reading = known(message, Context(sensor, self._joints, self._topics))
        return reading if isinstance(reading, str) or reading.t > 0 else "no stamp"


def scan(sensor: str, kind: str, message: Any, part: CloudSlice | None) -> LaserScan | str:  # noqa: ANN401
    """Return a scan, or why there is none."""
    if isinstance(message, str):
        return message
    if kind == SCAN_TYPE:
        made: LaserScan | str = scans.of_log(sensor, cast(CarmenScan, message))
    elif kind == SCAN:
        made = scans.of_laser(sensor, stamp(message), message)
    elif kind == ECHOES:
        made = scans.of_echoes(sensor, stamp(message), message)
    else:
        made = scans.of_cloud(sensor, stamp(message), message, part)
    return made if isinstance(made, str) or made.t > 0 else "no stamp"


def stamp(message: Any) -> Nanos:  # noqa: ANN401 -- of every type with a header
    """Return the time of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


# -- how the base moved --------------------------------------------------------------------------


def _odometry(message: RosOdometry, context: Context) -> OdometryReading | str:
    twist, place = message.twist, message.pose.pose
    variances = float(twist.covariance[0]), float(twist.covariance[35])
    if any(variance >= UNUSED for variance in variances) and context.topics.motion != "pose":
        return "twist not measured"
    yaw = _yaw(place.orientation)
    lateral = twist.twist.linear.y if float(twist.covariance[7]) < UNUSED else 0.0
    moved: tuple[float, ...] = (twist.twist.linear.x, twist.twist.angular.z)
    if context.topics.motion == "pose":
        moved, lateral = (0.0, 0.0), 0.0
    numbers = (*moved, place.position.x, place.position.y, yaw)
    if not all(math.isfinite(number) for number in (*numbers, lateral)):
        return "not finite"
    return OdometryReading(stamp(message), moved[0], moved[1], Pose(*numbers[2:]), lateral)


def _twist(message: Any, _: Context) -> OdometryReading | str:  # noqa: ANN401 -- with a covariance or without
    twist = message.twist if hasattr(message.twist, "linear") else message.twist.twist
    numbers = (twist.linear.x, twist.angular.z, twist.linear.y)
    if not all(map(math.isfinite, numbers)):
        return "not finite"
    return OdometryReading(stamp(message), numbers[0], numbers[1], Pose(0.0, 0.0, 0.0), numbers[2])


def _joints(message: RosJoints, context: Context) -> JointsReading | str:
    at = {name: i for i, name in enumerate(message.name)}
    if lacking := [name for name in context.joints if name not in at]:
        return f"without the joint {lacking[0]!r} (it has {', '.join(at) or 'none'})"
    if len(message.position) < len(at):
        return "positions of joints not measured"
    angles = tuple(float(message.position[at[name]]) for name in context.joints)
    return JointsReading(stamp(message), angles) if all(map(math.isfinite, angles)) else "not finite"


def _car(message: Any, car: Car, position: float | None) -> OdometryReading | str:  # noqa: ANN401 -- of any type
    if car.steering and position is None:
        return "before the first position of its steering"
    speed = number(message, car.speed)
    if isinstance(speed, str):
        return speed
    angle = (position - car.middle) / car.per_angle if position is not None else 0.0
    speed /= car.per_speed
    turn = speed * math.tan(min(max(angle, -STEEPEST), STEEPEST)) / car.wheelbase
    return OdometryReading(stamp(message), speed, turn, Pose(0.0, 0.0, 0.0))


def number(message: Any, path: str) -> float | str:  # noqa: ANN401 -- of any type
    """Return the number in a dotted field of a message, or why there is none."""
    found = message
    for name in path.split("."):
        if not hasattr(found, name):
            fields = [one for one in getattr(found, "__dataclass_fields__", {}) if not one.startswith("_")]
            return f"no field {name!r} of {path!r} (it has {', '.join(fields) or 'none'})"
        found = getattr(found, name)
    if isinstance(found, bool) or not isinstance(found, int | float):
        return f"{path!r} is no number"
    return float(found) if math.isfinite(found) else "not finite"


def _logged(message: CarmenPose, _: Context) -> OdometryReading | str:
    known = all(map(math.isfinite, (message.pose.x, message.pose.y, message.pose.yaw)))
    return OdometryReading(message.t, 0.0, 0.0, message.pose) if known else "not finite"


# -- sensors -------------------------------------------------------------------------------------


def _imu(message: RosImu, context: Context) -> Imu | str:
    if float(message.angular_velocity_covariance[0]) == NOT_MEASURED:
        return "angular velocity not measured"
    rate, acceleration = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    if not all(math.isfinite(number) for number in (*rate, *acceleration)):
        return "not finite"
    q = message.orientation
    orientation = (q.x, q.y, q.z, q.w)
    measured = float(message.orientation_covariance[0]) != NOT_MEASURED and any(orientation)
    known = measured and all(map(math.isfinite, orientation))
    return Imu(context.sensor, stamp(message), rate, acceleration, orientation if known else None)


def _fix(message: RosFix, context: Context) -> Fix | str:
    if message.status.status < 0:
        return "no fix"
    if not (abs(message.latitude) <= 90.0 and math.isfinite(message.longitude)):
        return "not on the earth"
    variance = (float(message.position_covariance[0]) + float(message.position_covariance[4])) / 2.0
    known = message.position_covariance_type != 0 and math.isfinite(variance)
    altitude = message.altitude if math.isfinite(message.altitude) else None
    place = message.latitude, message.longitude, altitude
    name = context.sensor or message.header.frame_id
    return Fix(name, stamp(message), *place, variance if known else None)


def _pose_reading(message: Any, context: Context) -> PoseReading | str:  # noqa: ANN401 -- with a covariance
    place = _place(message.pose.pose)
    if place is None:
        return "not finite"
    covariance = message.pose.covariance
    known = [float(one) for one in ((covariance[0] + covariance[7]) / 2.0, covariance[35])]
    variance, turned = (one if math.isfinite(one) and one > 0.0 else None for one in known)
    return PoseReading(context.sensor, stamp(message), place.x, place.y, place.yaw, variance, turned)


# -- truth ---------------------------------------------------------------------------------------


def _true_pose(message: Any, _: Context) -> TruePose | str:  # noqa: ANN401 -- with a covariance or without
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    place = _place(pose)
    return "not finite" if place is None else TruePose(stamp(message), place)


def _true_transform(message: Any, _: Context) -> TruePose | str:  # noqa: ANN401
    at, yaw = message.transform.translation, _yaw(message.transform.rotation)
    known = all(map(math.isfinite, (at.x, at.y, yaw)))
    return TruePose(stamp(message), Pose(at.x, at.y, yaw)) if known else "not finite"


def _true_logged(message: CarmenPose, _: Context) -> TruePose | str:
    known = all(map(math.isfinite, (message.pose.x, message.pose.y, message.pose.yaw)))
    return TruePose(message.t, message.pose) if known else "not finite"


def _place(pose: RosPose) -> Pose | None:
    numbers = (pose.position.x, pose.position.y, _yaw(pose.orientation))
    return Pose(*numbers) if all(map(math.isfinite, numbers)) else None


def _vector(vector: RosVector) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _yaw(q: RosQuaternion) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


CONVERSIONS: dict[str, dict[str, Callable[[Any, Context], Reading | str]]] = {
    "odometry": {
        ODOMETRY: _odometry,
        TWIST: _twist,
        TWIST_COVARIANCE: _twist,
        JOINTS: _joints,
        POSE_TYPE: _logged,
    },
    "sensors": {IMU: _imu, FIX: _fix, POSE_COVARIANCE: _pose_reading},
    "truth": {
        FIX: _fix,
        POSE: _true_pose,
        POSE_COVARIANCE: _true_pose,
        ODOMETRY: _true_pose,
        PLACED: _true_transform,
        POSE_TYPE: _true_logged,
    },
}
TYPES: dict[str, tuple[str, ...]] = {
    "odometry": (*CONVERSIONS["odometry"], *TF_TYPES),
    "sensors": (*CONVERSIONS["sensors"], *LARGE),
    "truth": (*CONVERSIONS["truth"], *TF_TYPES),
    "image": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "info": ("sensor_msgs/msg/CameraInfo",),
}
"""Message types of each role: by its first word, or of a camera by its last."""
