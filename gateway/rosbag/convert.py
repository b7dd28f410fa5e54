"""Conversion of one ROS message to a reading, or the reason why it is not used.

Pure functions; the types of ROS 1 and ROS 2 are alike (common_interfaces: nav_msgs, sensor_msgs).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, cast

from brain.belief import Pose
from protocols.messages import SECOND, Fix, Imu, Measurement, Nanos

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as RosQuaternion
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as RosVector
    from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Odometry as RosOdometry
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Image as RosImage
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as RosImu
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__NavSatFix as RosFix

TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "sensors": "sensor_msgs/msg/Imu",
    "truth": "sensor_msgs/msg/NavSatFix",
    "image": "sensor_msgs/msg/Image",
    "info": "sensor_msgs/msg/CameraInfo",
}
"""Message type of each role: by its first word, or of a camera by its last."""

UNUSED = 1e6
"""A variance from here on marks an axis that is not measured, by convention of base drivers."""
NOT_MEASURED = -1.0
"""In the first field of a covariance: the message has no such measurement (sensor_msgs/Imu.msg)."""


@dataclass(frozen=True, slots=True)
class OdometryReading:
    """One odometry message."""

    t: Nanos
    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    pose: Pose
    lateral: float = 0.0
    """m/s to the left"""


Reading: TypeAlias = OdometryReading | Measurement


def converted(role: str, message: object) -> Reading | str:
    """Return a message as a reading, or why it is not used."""
    reading: Reading | str
    if role == "odometry":
        reading = _odometry(cast("RosOdometry", message))
    elif role == "truth":
        reading = _fix(cast("RosFix", message))
    else:
        reading = _imu(role.removeprefix("sensors."), cast("RosImu", message))
    return reading if isinstance(reading, str) or reading.t > 0 else "no stamp"


def stamp(message: RosOdometry | RosImu | RosFix | RosImage) -> Nanos:
    """Return the time of a message's header."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _odometry(message: RosOdometry) -> OdometryReading | str:
    twist, place = message.twist, message.pose.pose
    variances = float(twist.covariance[0]), float(twist.covariance[35])
    if any(variance >= UNUSED for variance in variances):
        return "twist not measured"
    yaw = _yaw(place.orientation)
    lateral = twist.twist.linear.y if float(twist.covariance[7]) < UNUSED else 0.0
    numbers = (twist.twist.linear.x, twist.twist.angular.z, place.position.x, place.position.y, yaw)
    if not all(math.isfinite(number) for number in (*numbers, lateral)):
        return "not finite"
    return OdometryReading(stamp(message), *numbers[:2], Pose(*numbers[2:]), lateral)


def _imu(sensor: str, message: RosImu) -> Imu | str:
    if float(message.angular_velocity_covariance[0]) == NOT_MEASURED:
        return "angular velocity not measured"
    rate, acceleration = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    if not all(math.isfinite(number) for number in (*rate, *acceleration)):
        return "not finite"
    q = message.orientation
    orientation = (q.x, q.y, q.z, q.w)
    measured = float(message.orientation_covariance[0]) != NOT_MEASURED and any(orientation)
    known = measured and all(map(math.isfinite, orientation))
    return Imu(sensor, stamp(message), rate, acceleration, orientation if known else None)


def _fix(message: RosFix) -> Fix | str:
    if message.status.status < 0:
        return "no fix"
    if not (abs(message.latitude) <= 90.0 and math.isfinite(message.longitude)):
        return "not on the earth"
    variance = (float(message.position_covariance[0]) + float(message.position_covariance[4])) / 2.0
    known = message.position_covariance_type != 0 and math.isfinite(variance)
    altitude = message.altitude if math.isfinite(message.altitude) else None
    place = message.latitude, message.longitude, altitude
    return Fix(message.header.frame_id, stamp(message), *place, variance if known else None)


def _vector(vector: RosVector) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _yaw(q: RosQuaternion) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
