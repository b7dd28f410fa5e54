"""A whole bag: the role of each topic on this robot, and the messages as events in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from brain.belief import Pose
from brain.bodies.differential import Differential
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.rosbag.convert import TYPES, OdometryReading, Reading, converted
from gateway.rosbag.file import open_bag
from protocols.messages import Event, Feedback, Fix, Imu, Nanos, seconds
from protocols.suggest import did_you_mean

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


@dataclass(slots=True)
class Topic:
    """One topic of a bag, and how its messages were used."""

    name: str
    type: str
    count: int
    """Messages in the bag."""
    role: str = ""
    """On this robot: "odometry", "sensors.imu", "truth"; "" if none."""
    unused: dict[str, int] = field(default_factory=dict)
    """Messages that were not used, by reason."""

    @property
    def used(self) -> int:
        """Messages that were used."""
        return self.count - sum(self.unused.values()) if self.role else 0


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag, converted for a robot."""

    path: Path
    events: tuple[Event, ...]
    """Feedback of both wheels and Imu, in order."""
    odometry: tuple[tuple[Nanos, Pose], ...]
    """The poses of the bag's own odometry, for comparison."""
    truth: tuple[Fix, ...]
    """Ground truth."""
    topics: tuple[Topic, ...]
    """All topics of the bag, sorted by name."""


def read(path: Path, topics: BagTopics | None, body: Differential) -> Bag:
    """Read a bag. Raises BagError: what cannot be read, or which topics are missing."""
    with open_bag(path) as reader:
        found = _topics(reader)
        _check(path, topics, found)
        for name, role in topics.parts() if topics else ():
            found[name].role = role
        wanted = [one for one in reader.connections if found[one.topic].role]
        messages = [(c.topic, reader.deserialize(data, c.msgtype)) for c, _, data in reader.messages(wanted)]
    wheels = _Wheels(body)
    poses: list[tuple[Nanos, Pose]] = []
    events: list[Event] = []
    truth: list[Fix] = []
    for reading in _in_order(messages, found):
        if isinstance(reading, Fix):
            truth.append(reading)
        elif isinstance(reading, Imu):
            events.append(reading)
        else:
            events += wheels.feedback(reading)
            poses.append((reading.t, reading.pose))
    return Bag(path, tuple(events), tuple(poses), tuple(truth), tuple(found[n] for n in sorted(found)))


def _in_order(messages: Sequence[tuple[str, object]], found: Mapping[str, Topic]) -> list[Reading]:
    """Return the messages as readings, in the order of their stamps; count unused ones in their topic."""
    readings: list[Reading] = []
    for name, message in messages:
        topic = found[name]
        reading = converted(topic.role, message)
        if isinstance(reading, str):
            topic.unused[reading] = topic.unused.get(reading, 0) + 1
        else:
            readings.append(reading)
    return sorted(readings, key=lambda reading: reading.t)


def _topics(reader: AnyReader) -> dict[str, Topic]:
    found: dict[str, Topic] = {}
    for one in reader.connections:
        known = found.setdefault(one.topic, Topic(one.topic, one.msgtype, 0))
        known.count += one.msgcount
        if known.type != one.msgtype:
            known.type = "messages of several types"
    return found


def _check(path: Path, topics: BagTopics | None, found: Mapping[str, Topic]) -> None:
    """Raise BagError unless every role has its topic, with messages of its type."""
    there = "\n".join(f"  {t.name}: {t.count} of {t.type}" for _, t in sorted(found.items())) or "  nothing"
    if topics is None:
        raise BagError(f"{path}: the robot file has no table [bag] that maps its topics; there is\n{there}")
    wrong: list[str] = []
    for name, role in topics.parts():
        topic, wanted = found.get(name), TYPES[role.split(".")[0]]
        if topic is None:
            wrong.append(f"{role}: no topic {name!r}{did_you_mean(name, found)}")
        elif topic.type != wanted:
            wrong.append(f"{role}: {name} holds {topic.type}, expected {wanted}")
        elif not topic.count:
            wrong.append(f"{role}: {name} is empty")
    if wrong:
        raise BagError("\n".join([*(f"{path}: {text}" for text in wrong), f"there is\n{there}"]))


class _Wheels:
    """Wheel angles from the twists of the base, by the trapezoidal rule."""

    def __init__(self, body: Differential) -> None:
        self._body = body
        self._left = self._right = 0.0
        """rad"""
        self._last: tuple[Nanos, float, float] | None = None
        """Time of the last reading, and the wheels' speeds then [rad/s]."""

    def feedback(self, reading: OdometryReading) -> list[Feedback]:
        """Return the feedback of the left and right wheel; to be called once per reading, in order."""
        left, right = self._body.inverse(reading.linear, reading.angular)
        if self._last is not None:
            t, left_before, right_before = self._last
            dt = seconds(reading.t - t)
            self._left += dt * (left_before + left) / 2.0
            self._right += dt * (right_before + right) / 2.0
        self._last = (reading.t, left, right)
        return [
            Feedback(self._body.left, reading.t, self._left, left),
            Feedback(self._body.right, reading.t, self._right, right),
        ]
