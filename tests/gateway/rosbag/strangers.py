"""Messages of all kinds that a stranger's bag may hold, of one drive with known values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from brain.belief import Pose
from brain.bodies.plane import arc
from protocols.messages import MILLISECOND, SECOND, Nanos
from tests.gateway.bag_helpers import START, STORES, BagMessage, header, odometry, vector

VESC_STATE = "float64 speed\nfloat64 duty_cycle\n"
VESC_STAMPED = "std_msgs/Header header\nvesc_msgs/VescState state\n"
for store in STORES.values():
    store.register(get_types_from_msg(VESC_STATE, "vesc_msgs/msg/VescState"))
    store.register(get_types_from_msg(VESC_STAMPED, "vesc_msgs/msg/VescStateStamped"))

RADIUS, SEPARATION, WHEELBASE = 0.1, 0.5, 0.3
"""m: of the wheels of the drive, and of the car that does it"""
STEP: Nanos = 20 * MILLISECOND


def motion(length: float = 20.0) -> Iterator[tuple[Nanos, float, float, Pose, tuple[float, float]]]:
    """Yield time, speed, rate of turn, pose and angles of both wheels: a slalom at 0.8 m/s."""
    pose, left, right = Pose(0.0, 0.0, 0.0), 0.0, 0.0
    for n in range(round(length * SECOND / STEP)):
        turn = 0.5 * math.sin(n / 100.0)
        yield START + n * STEP, 0.8, turn, pose, (left, right)
        after = 0.5 * math.sin((n + 1) / 100.0)
        mean, dt = (turn + after) / 2.0, STEP / SECOND
        pose = arc(pose, 0.8 * dt, mean * dt)
        left += (0.8 - mean * SEPARATION / 2.0) * dt / RADIUS
        right += (0.8 + mean * SEPARATION / 2.0) * dt / RADIUS


def quaternion(types: Any, yaw: float, roll: float = 0.0) -> Any:
    cy, sy, cr, sr = (f(a / 2.0) for a in (yaw, roll) for f in (math.cos, math.sin))
    return types["geometry_msgs/msg/Quaternion"](x=cy * sr, y=sy * sr, z=sy * cr, w=cy * cr)


def pose_of(types: Any, at: Pose) -> Any:
    place = types["geometry_msgs/msg/Point"](x=at.x, y=at.y, z=0.0)
    return types["geometry_msgs/msg/Pose"](position=place, orientation=quaternion(types, at.yaw))


def posed(t: Nanos, at: Pose, topic: str = "/truth", *, covariance: bool = False) -> BagMessage:
    kind = f"geometry_msgs/msg/Pose{'WithCovariance' * covariance}Stamped"

    def make(types: Any) -> Any:
        pose = pose_of(types, at)
        if covariance:
            pose = types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.eye(6).ravel())
        return types[kind](header=header(types, t, "map"), pose=pose)

    return BagMessage(topic, kind, t, make)


def twisted(t: Nanos, linear: float, angular: float) -> BagMessage:
    def make(types: Any) -> Any:
        twist = types["geometry_msgs/msg/Twist"](
            linear=vector(types, linear, 0.0, 0.0), angular=vector(types, 0.0, 0.0, angular)
        )
        return types["geometry_msgs/msg/TwistStamped"](header=header(types, t, "base_link"), twist=twist)

    return BagMessage("/wheel_twist", "geometry_msgs/msg/TwistStamped", t, make)


def joints(t: Nanos, left: float, right: float) -> BagMessage:
    def make(types: Any) -> Any:
        return types["sensor_msgs/msg/JointState"](
            header=header(types, t, ""),
            name=["arm", "right_wheel", "left_wheel"],
            position=np.array([0.3, right, left]),
            velocity=np.array([]),
            effort=np.array([]),
        )

    return BagMessage("/joint_states", "sensor_msgs/msg/JointState", t, make)


def vesc(t: Nanos, erpm: float) -> BagMessage:
    def make(types: Any) -> Any:
        state = types["vesc_msgs/msg/VescState"](speed=erpm, duty_cycle=0.1)
        return types["vesc_msgs/msg/VescStateStamped"](header=header(types, t, ""), state=state)

    return BagMessage("/sensors/core", "vesc_msgs/msg/VescStateStamped", t, make)


def servo(t: Nanos, position: float) -> BagMessage:
    def make(types: Any) -> Any:
        return types["std_msgs/msg/Float64"](data=position)

    return BagMessage("/sensors/servo", "std_msgs/msg/Float64", t, make)


def transform(
    t: Nanos,
    parent: str,
    child: str,
    place: tuple[float, float, float],
    yaw: float = 0.0,
    roll: float = 0.0,
    topic: str = "/tf",
) -> BagMessage:
    def make(types: Any) -> Any:
        turned = types["geometry_msgs/msg/Transform"](
            translation=vector(types, *place), rotation=quaternion(types, yaw, roll)
        )
        one = types["geometry_msgs/msg/TransformStamped"](
            header=header(types, t, parent), child_frame_id=child, transform=turned
        )
        return types["tf2_msgs/msg/TFMessage"](transforms=[one])

    return BagMessage(topic, "tf2_msgs/msg/TFMessage", t, make)


def described(t: Nanos, text: str) -> BagMessage:
    def make(types: Any) -> Any:
        return types["std_msgs/msg/String"](data=text)

    return BagMessage("/robot_description", "std_msgs/msg/String", t, make)


def room(at: Pose, beams: int, first: float, step: float, half: float = 4.0) -> list[float]:
    """Return the ranges in a square room about the origin, `half` [m] from its walls."""
    found = []
    for n in range(beams):
        c, s = math.cos(at.yaw + first + n * step), math.sin(at.yaw + first + n * step)
        walls = [(math.copysign(half, c) - at.x) / c] if abs(c) > 1e-9 else []
        walls += [(math.copysign(half, s) - at.y) / s] if abs(s) > 1e-9 else []
        found.append(min(walls))
    return found


def scanned(
    t: Nanos,
    ranges: Sequence[float],
    first: float = -math.pi,
    step: float = math.radians(1.0),
    time_increment: float = 0.0,
    echoes: bool = False,
    frame: str = "laser",
    topic: str = "/scan",
) -> BagMessage:
    kind = f"sensor_msgs/msg/{'MultiEcho' * echoes}LaserScan"

    def make(types: Any) -> Any:
        values: Any = np.array(ranges, dtype=np.float32)
        intensities: Any = np.array([], dtype=np.float32)
        if echoes:
            echo = types["sensor_msgs/msg/LaserEcho"]
            values = [echo(echoes=np.array([r, 2.0 * r], dtype=np.float32)) for r in ranges]
            intensities = []
        return types[kind](
            header=header(types, t, frame),
            angle_min=first,
            angle_max=first + step * (len(ranges) - 1),
            angle_increment=step,
            time_increment=time_increment,
            scan_time=0.1,
            range_min=0.1,
            range_max=20.0,
            ranges=values,
            intensities=intensities,
        )

    return BagMessage(topic, kind, t, make)


def cloud(t: Nanos, points: Iterable[tuple[float, float, float, int]], *, ring: bool = True) -> BagMessage:
    """A cloud with x, y, z and the number of the ring."""
    layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2")][: 4 if ring else 3]
    data = np.array([one[: len(layout)] for one in points], dtype=layout)

    def make(types: Any) -> Any:
        known = {"<f4": 7, "<u2": 4}
        field = types["sensor_msgs/msg/PointField"]
        fields = [
            field(name=name, offset=4 * n, datatype=known[kind], count=1)
            for n, (name, kind) in enumerate(layout)
        ]
        return types["sensor_msgs/msg/PointCloud2"](
            header=header(types, t, "laser"),
            height=1,
            width=len(data),
            fields=fields,
            is_bigendian=False,
            point_step=data.itemsize,
            row_step=data.nbytes,
            data=np.frombuffer(data.tobytes(), dtype=np.uint8),
            is_dense=True,
        )

    return BagMessage("/points", "sensor_msgs/msg/PointCloud2", t, make)


Told = Callable[[Nanos, float, float, Pose, tuple[float, float]], list[BagMessage]]


def told(how: Told, length: float = 20.0) -> list[BagMessage]:
    """Return the drive as messages."""
    return [message for one in motion(length) for message in how(*one)]


def by_odometry(t: Nanos, v: float, w: float, pose: Pose, _: object = None) -> list[BagMessage]:
    return [odometry(t, v, w, pose)]


CARMEN_HEAD = "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"


def carmen_log(length: float = 20.0, bent: float = 0.0, kinds: Sequence[str] = ("FLASER",)) -> str:
    """Return the drive as a log of CARMEN, in the room, a scan every 0.2 s, in lines of these kinds; `bent`:
    m by which its walls are waves instead."""
    lines = [CARMEN_HEAD, "PARAM robot_frontlaser_offset 0.0 nohost 0\n"]
    for n, (t, v, w, pose, _) in enumerate(motion(length)):
        at = f"{pose.x:.6f} {pose.y:.6f} {pose.yaw:.6f}"
        end = f"{t / SECOND:.6f} host {t / SECOND + 0.01:.6f}\n"
        lines.append(f"ODOM {at} {v} {w} 0 {end}")
        if n % 10 == 5:
            ranges = room(pose, 181, -math.pi / 2.0, math.radians(1.0), 12.0)
            ranges = [one + bent * math.sin(n / 8.0) for n, one in enumerate(ranges)]
            readings = " ".join(f"{one:.2f}" for one in ranges)
            described = f"0 -1.570796 3.141593 0.017453 81.92 0.01 0 181 {readings} 0"
            written = {
                "FLASER": f"FLASER 181 {readings} {at} {at} {end}",
                "ROBOTLASER1": f"ROBOTLASER1 {described} {at} {at} {v} {w} 0 0 0 {end}",
                "RAWLASER1": f"RAWLASER1 {described} {end}",
                "RAWLASER2": f"RAWLASER2 {described} {end}",
            }
            lines += [written[kind] for kind in kinds]
    return "".join(lines)
