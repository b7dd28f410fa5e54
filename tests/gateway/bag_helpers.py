"""Bags of another program, small and with known values: a base that drives, its IMU, its GPS.

`write` makes a ROS 1 bag, or a ROS 2 bag in MCAP or SQLite, with the same messages in the same order."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import arc
from gateway.config import parse_robot
from gateway.core.robot import Robot
from protocols.messages import MILLISECOND, SECOND, Nanos

Kind = Literal["ros1", "mcap", "sqlite3"]
KINDS: tuple[Kind, ...] = ("ros1", "mcap", "sqlite3")
STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_JAZZY)}
START: Nanos = 1_700_000_000 * SECOND
ODOM, IMU, FIX = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
Make = Callable[[Any], Any]
"""Makes a message from the types of a typestore."""


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message of a bag."""

    topic: str
    type: str
    logged: Nanos
    make: Make


def write(path: Path, messages: Sequence[BagMessage], kind: Kind = "ros1", packed: str = "") -> Path:
    """Write a bag, a file called path.bag or a folder of ROS 2; return where it is. `packed`: the chunks of
    ROS 1, by BZ2 or LZ4."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path = path.with_suffix(".bag") if kind == "ros1" else path
    store = STORES["ros1" if kind == "ros1" else "ros2"]
    serialise = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    new: Any = Ros1Writer(path) if kind == "ros1" else Ros2Writer(path, version=9, storage_plugin=plugin)
    if packed:
        new.set_compression(Ros1Writer.CompressionFormat[packed])
    with new:
        topics = dict.fromkeys((one.topic, one.type) for one in messages)
        found = {name: new.add_connection(name, type_, typestore=store) for name, type_ in topics}
        for one in messages:
            new.write(found[one.topic], one.logged, serialise(one.make(store.types), one.type))
    return path


# -- messages -----------------------------------------------------------------------------------


def header(types: Any, t: Nanos, frame: str) -> Any:
    kind = types["std_msgs/msg/Header"]
    stamp = types["builtin_interfaces/msg/Time"](sec=t // SECOND, nanosec=t % SECOND)
    seq = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp, frame_id=frame, **seq)


def vector(types: Any, x: float, y: float, z: float) -> Any:
    return types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


def odometry(
    t: Nanos,
    linear: float,
    angular: float,
    pose: Pose = Pose(0.0, 0.0, 0.0),  # noqa: B008 -- frozen
    variance: float = 1e-3,
    topic: str = "/odom",
    logged: Nanos | None = None,
    lateral: float = 0.0,
) -> BagMessage:
    """`variance` is that of the speed along x."""

    def make(types: Any) -> Any:
        covariance = np.zeros(36)
        covariance[0] = variance
        half = pose.yaw / 2.0
        turned = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
        place = types["geometry_msgs/msg/Point"](x=pose.x, y=pose.y, z=0.0)
        whole = types["geometry_msgs/msg/Pose"](position=place, orientation=turned)
        twist = types["geometry_msgs/msg/Twist"](
            linear=vector(types, linear, lateral, 0.0), angular=vector(types, 0.0, 0.0, angular)
        )
        return types[ODOM](
            header=header(types, t, "odom"),
            child_frame_id="base_link",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=whole, covariance=np.zeros(36)),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance),
        )

    return BagMessage(topic, ODOM, t if logged is None else logged, make)


def imu(
    t: Nanos,
    rate: tuple[float, float, float],
    turned: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
    rate_variance: float = 0.0,
    turned_variance: float = 0.0,
    topic: str = "/imu/data",
    logged: Nanos | None = None,
) -> BagMessage:
    """Level and at rest but for its rate of turn."""

    def make(types: Any) -> Any:
        def covariance(first: float) -> Any:
            return np.array([first, *[0.0] * 8])

        x, y, z, w = turned
        return types[IMU](
            header=header(types, t, "imu_link"),
            orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
            orientation_covariance=covariance(turned_variance),
            angular_velocity=vector(types, *rate),
            angular_velocity_covariance=covariance(rate_variance),
            linear_acceleration=vector(types, 0.0, 0.0, 9.81),
            linear_acceleration_covariance=covariance(0.0),
        )

    return BagMessage(topic, IMU, t if logged is None else logged, make)


def fix(
    t: Nanos,
    latitude: float,
    longitude: float,
    status: int = 0,
    altitude: float = 100.0,
    known: int = 2,
    logged: Nanos | None = None,
) -> BagMessage:
    def make(types: Any) -> Any:
        state = types["sensor_msgs/msg/NavSatStatus"](status=status, service=1)
        return types[FIX](
            header=header(types, t, "gps"),
            status=state,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=np.diag([0.5, 1.5, 9.0]).ravel(),
            position_covariance_type=known,
        )

    return BagMessage("/fix", FIX, t if logged is None else logged, make)


# -- a drive ------------------------------------------------------------------------------------

METRES = 111_319.49
"""Per degree at the equator, along it (WGS 84: 6378137 m · π / 180)."""
METRES_NORTH = 110_574.28
"""Per degree along the meridian there: 6335439.3 m · π / 180"""


def drive(
    length: float = 60.0,
    seed: int = 1,
    slip: float = 0.1,
    rate: Callable[[float], tuple[float, float, float]] = lambda w: (0.0, 0.0, w),
) -> list[BagMessage]:
    """Return the messages of a base that drives a slalom at 1 m/s for `length` s near the equator, and turns
    less than its wheels by a share `slip`. Odometry at 10 Hz, IMU at 30 Hz (`rate`: what its axes measure of
    a turn), GPS (0.3 m) at 2.5 Hz, each stamped when it was measured, and logged later, the IMU last."""
    random = np.random.Generator(np.random.PCG64(seed))
    true = reported = Pose(0.0, 0.0, 0.5)
    messages: list[BagMessage] = []
    step = 10 * MILLISECOND
    for tick in range(round(length * 100.0)):
        t, now = START + tick * step, tick / 100.0
        turn = 0.4 * math.sin(now / 3.0) + 0.1
        if tick % 10 == 0:
            messages.append(odometry(t, 1.0, turn, reported, logged=t + MILLISECOND))
        if tick % 3 == 0:
            noise = float(random.normal(0.0, 0.01))
            messages.append(imu(t, rate(turn * (1.0 - slip) + noise), logged=t + 25 * MILLISECOND))
        if tick % 40 == 0:
            east, north = true.x + random.normal(0.0, 0.3), true.y + random.normal(0.0, 0.3)
            messages.append(
                fix(t, float(north / METRES_NORTH), float(east / METRES), logged=t + 2 * MILLISECOND)
            )
        true, reported = arc(true, 0.01, turn * (1.0 - slip) * 0.01), arc(reported, 0.01, turn * 0.01)
    return sorted(messages, key=lambda one: one.logged)


ROBOT = """\
name = "rover"
rate_hz = 50

[buses.line]
kind = "serial"
baudrate = 1_000_000
interface = "serial:/dev/ttyUSB0"

[defaults.motors]
protocol = "plain"
bus = "line"
options = { kind = "motor" }
limits = { velocity = 20.0, acceleration = 60.0, torque = 2.0 }

[motors.left]
address = 1

[motors.right]
address = 2

[sensors.imu]
protocol = "plain"
bus = "line"
address = 3

[brain]
body = "differential"

[brain.differential]
left = "left"
right = "right"
wheel_radius = 0.1
wheel_separation = 0.5
radius = 0.4
max_linear = 1.5
max_angular = 2.0
max_linear_acceleration = 1.0
max_angular_acceleration = 4.0

[brain.perception]
filter = { turn_slip = 0.1, slip_length = 60.0, bias_sigma = 0.002 }

[bag]
odometry = "/odom"
sensors = { imu = "/imu/data" }
truth = "/fix"
"""


def rover(text: str = ROBOT) -> Robot:
    return parse_robot(text, "rover.toml")


def body_of(robot: Robot) -> Differential:
    body = robot.brain.body
    assert isinstance(body, Differential)
    return body
