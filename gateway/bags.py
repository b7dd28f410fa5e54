"""Somebody else's bag (ROS 1 or ROS 2) → events for the brain's perception, and a truth to judge it by.

Rules. Such a bag holds what sensors said, not what went over our wires; so it becomes events, and no
driver and no joint has a part in it. The robot file's table [bag] says which topic is what. A message
counts at its header's own stamp, whenever it was written down; events come in the order of their stamps,
those of one stamp in the order of the bag. Of odometry the twist is taken, and made into what each wheel
turned by the body's own kinematics. The truth stands beside the events, never among them. What is not
used is counted by topic and reason: nothing is made up for a field that its message says was not
measured. A bag that cannot be read is a `BagError`, whatever is wrong with it.
"""

from __future__ import annotations

import difflib
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, TypeAlias, cast

from brain.belief import Pose
from brain.bodies.differential import Differential
from gateway.recording.layout import MAGIC, METADATA
from gateway.topics import BagTopics
from protocols.words import SECOND, Event, Feedback, Fix, Imu, Nanos, seconds

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as RosQuaternion
    from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as RosVector
    from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Odometry as RosOdometry
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as RosImu
    from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__NavSatFix as RosFix

UNUSED = 1e6
"""A variance from here on marks an axis that is not measured, as drivers of bases have it."""
NOT_MEASURED = -1.0
"""In the first field of a covariance: the message has no such measurement (sensor_msgs/Imu.msg)."""


class BagError(Exception):
    """This bag cannot be read, or not on this robot. A sentence, or one line for each thing wrong."""


@dataclass(slots=True)
class Topic:
    """What became of one topic of a bag."""

    name: str
    type: str
    count: int
    """Messages in the bag."""
    part: str = ""
    """What it is on this robot: "odometry", "sensors.imu", "truth"; "" if nothing."""
    left: dict[str, int] = field(default_factory=dict)
    """Messages that were not used, by reason."""

    @property
    def used(self) -> int:
        """Messages that became something."""
        return self.count - sum(self.left.values()) if self.part else 0


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag as this robot understands it."""

    path: Path
    events: tuple[Event, ...]
    """Feedback of both wheels and Imu, in order."""
    odometry: tuple[tuple[Nanos, Pose], ...]
    """The poses that the bag's own odometry told, for comparison."""
    truth: tuple[Fix, ...]
    topics: tuple[Topic, ...]
    """All topics of the bag, in order of their names."""


def is_foreign(path: Path) -> bool:
    """Whether this is a bag of somebody else's: a folder, a ROS 1 bag, SQLite, or another's MCAP file."""
    if path.is_dir():
        return True
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError:
        return False
    if start.startswith(MAGIC):
        return not _is_ours(path)
    return start.startswith((b"#ROSBAG", b"SQLite format 3"))


def _is_ours(path: Path) -> bool:
    """Whether our metadata stand before the first message; yes too for what is too short to tell."""
    from mcap.exceptions import McapError
    from mcap.records import Message, Metadata
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=path.stat().st_size).records:
                if isinstance(record, Message):
                    return False
                if isinstance(record, Metadata) and record.name == METADATA:
                    return True
        except (McapError, struct.error, ValueError, RuntimeError):
            return True  # our own reader says what is wrong with it
    return False


def read(path: Path, topics: BagTopics | None, body: Differential) -> Bag:
    """The whole bag. Raises BagError: what it is that cannot be read, or which topics are not there."""
    with _reading(path) as reader:
        found = _topics(reader)
        _check(path, topics, found)
        for name, part in topics.parts() if topics else ():
            found[name].part = part
        wanted = [one for one in reader.connections if found[one.topic].part]
        messages = [(c.topic, reader.deserialize(data, c.msgtype)) for c, _, data in reader.messages(wanted)]
    wheels = _Wheels(body)
    poses: list[tuple[Nanos, Pose]] = []
    events: list[Event] = []
    truth: list[Fix] = []
    for said in _in_order(messages, found):
        if isinstance(said, Fix):
            truth.append(said)
        elif isinstance(said, Imu):
            events.append(said)
        else:
            events += wheels.turned(said)
            poses.append((said.t, said.pose))
    return Bag(path, tuple(events), tuple(poses), tuple(truth), tuple(found[n] for n in sorted(found)))


def _in_order(messages: Sequence[tuple[str, object]], found: Mapping[str, Topic]) -> list[_Said]:
    """What messages in the order of the bag say, in the order of their stamps; what says nothing is
    counted in its topic."""
    said: list[_Said] = []
    for name, message in messages:
        topic = found[name]
        one = _understood(topic.part, message)
        if isinstance(one, str):
            topic.left[one] = topic.left.get(one, 0) + 1
        else:
            said.append(one)
    return sorted(said, key=lambda one: one.t)


# -- the file -----------------------------------------------------------------------------------


@contextmanager
def _reading(path: Path) -> Iterator[AnyReader]:
    """The bag, open; whatever its reader meets becomes a BagError that says so."""
    if not __debug__:
        raise BagError(
            f"{path}: python -O switches off the checks of the library that reads bags; run without"
        )
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error
    from rosbags.typesys import Stores, get_typestore

    try:
        # A ROS 1 bag holds the definitions of its types; of ROS 2, some leave them to the reader.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            yield reader
    except (AnyReaderError, Ros1Error, Ros2Error) as error:
        raise BagError(f"{path}: {str(error).rstrip('.')}") from error
    except AssertionError as error:
        place = extract_tb(error.__traceback__)[-1]
        raise BagError(
            f"{path}: damaged: it fails the reader's check `{place.line}` ({place.name})"
        ) from error
    except DAMAGE as error:
        raise BagError(f"{path}: damaged: {type(error).__name__}: {error}") from error


DAMAGE = (
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
"""What a reader of damaged bytes runs into, beside its own errors."""


def _topics(reader: AnyReader) -> dict[str, Topic]:
    found: dict[str, Topic] = {}
    for one in reader.connections:
        known = found.setdefault(one.topic, Topic(one.topic, one.msgtype, 0))
        known.count += one.msgcount
        if known.type != one.msgtype:
            known.type = "messages of several types"
    return found


TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "sensors": "sensor_msgs/msg/Imu",
    "truth": "sensor_msgs/msg/NavSatFix",
}
"""What the messages of each part are."""


def _check(path: Path, topics: BagTopics | None, found: Mapping[str, Topic]) -> None:
    """Every part has its topic, with messages of its type: otherwise all that is wrong, and what there is."""
    there = "\n".join(f"  {t.name}: {t.count} of {t.type}" for _, t in sorted(found.items())) or "  nothing"
    if topics is None:
        raise BagError(
            f"{path}: the robot file has no table [bag] that says which topic is what; there is\n{there}"
        )
    wrong: list[str] = []
    for name, part in topics.parts():
        topic, wanted = found.get(name), TYPES[part.split(".")[0]]
        if topic is None:
            near = difflib.get_close_matches(name, found, 1)
            wrong.append(f"{part}: no topic {name!r}" + (f"; did you mean {near[0]!r}?" if near else ""))
        elif topic.type != wanted:
            wrong.append(f"{part}: {name} holds {topic.type}, expected {wanted}")
        elif not topic.count:
            wrong.append(f"{part}: {name} is empty")
    if wrong:
        raise BagError("\n".join([*(f"{path}: {said}" for said in wrong), f"there is\n{there}"]))


# -- one message --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Report:
    """What odometry says."""

    t: Nanos
    linear: float
    """m/s"""
    angular: float
    """rad/s"""
    pose: Pose


_Said: TypeAlias = _Report | Imu | Fix


def _understood(part: str, message: object) -> _Said | str:
    """A message as a value, or why it is not used."""
    said: _Said | str
    if part == "odometry":
        said = _report(cast("RosOdometry", message))
    elif part == "truth":
        said = _fix(cast("RosFix", message))
    else:
        said = _imu(part.removeprefix("sensors."), cast("RosImu", message))
    return said if isinstance(said, str) or said.t > 0 else "no stamp"


def _stamp(message: RosOdometry | RosImu | RosFix) -> Nanos:
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def _report(message: RosOdometry) -> _Report | str:
    twist, place = message.twist, message.pose.pose
    variances = float(twist.covariance[0]), float(twist.covariance[35])
    if any(variance >= UNUSED for variance in variances):
        return "no speed in it"
    yaw = _yaw(place.orientation)
    numbers = (twist.twist.linear.x, twist.twist.angular.z, place.position.x, place.position.y, yaw)
    if not all(math.isfinite(number) for number in numbers):
        return "not finite"
    return _Report(_stamp(message), *numbers[:2], Pose(*numbers[2:]))


def _imu(sensor: str, message: RosImu) -> Imu | str:
    if float(message.angular_velocity_covariance[0]) == NOT_MEASURED:
        return "no rate of turn in it"
    rate, push = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    if not all(math.isfinite(number) for number in (*rate, *push)):
        return "not finite"
    q = message.orientation
    turned = (q.x, q.y, q.z, q.w)
    told = float(message.orientation_covariance[0]) != NOT_MEASURED and all(map(math.isfinite, turned))
    return Imu(sensor, _stamp(message), rate, push, turned if told and any(turned) else None)


def _fix(message: RosFix) -> Fix | str:
    if message.status.status < 0:
        return "no fix"
    if not (abs(message.latitude) <= 90.0 and math.isfinite(message.longitude)):
        return "not finite"
    variance = (float(message.position_covariance[0]) + float(message.position_covariance[4])) / 2.0
    known = message.position_covariance_type != 0 and math.isfinite(variance)
    altitude = message.altitude if math.isfinite(message.altitude) else None
    place = message.latitude, message.longitude, altitude
    return Fix(message.header.frame_id, _stamp(message), *place, variance if known else None)


def _vector(vector: RosVector) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _yaw(q: RosQuaternion) -> float:
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


class _Wheels:
    """What the wheels turned, from the twists of the base.

    From one report to the next the speeds change evenly (trapezium rule)."""

    def __init__(self, body: Differential) -> None:
        self._body = body
        self._left = self._right = 0.0
        """rad"""
        self._last: tuple[Nanos, float, float] | None = None
        """The last report's time, and the wheels' speeds then [rad/s]."""

    def turned(self, report: _Report) -> list[Feedback]:
        """The feedback of the left and the right wheel at a report; each report once, and in order."""
        left, right = self._body.inverse(report.linear, report.angular)
        if self._last is not None:
            t, left_before, right_before = self._last
            dt = seconds(report.t - t)
            self._left += dt * (left_before + left) / 2.0
            self._right += dt * (right_before + right) / 2.0
        self._last = (report.t, left, right)
        return [
            Feedback(self._body.left, report.t, self._left, left),
            Feedback(self._body.right, report.t, self._right, right),
        ]
