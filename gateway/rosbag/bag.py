"""A whole bag: the role of each topic on this robot, and the messages as events in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from brain.bodies.body import Base
from brain.bodies.plane import Twist
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.rosbag.convert import TYPES, OdometryReading, Reading, converted
from gateway.rosbag.file import open_bag
from gateway.rosbag.images import BagImages
from protocols.messages import Event, Feedback, Fix, Measurement, Nanos, seconds
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

    def leave_out(self, reason: str) -> None:
        """Count a message that is not used."""
        self.unused[reason] = self.unused.get(reason, 0) + 1

    @property
    def used(self) -> int:
        """Messages that were used."""
        return self.count - sum(self.unused.values()) if self.role else 0


@dataclass(frozen=True, slots=True)
class Bag:
    """A bag, converted for a robot."""

    path: Path
    events: tuple[Event, ...]
    """Feedback of the joints and readings of sensors, in order."""
    odometry: tuple[OdometryReading, ...]
    """The bag's own odometry, in order; its poses are for comparison."""
    truth: tuple[Fix, ...]
    """Ground truth."""
    topics: tuple[Topic, ...]
    """All topics of the bag, sorted by name."""
    stamps: Mapping[str, Sequence[tuple[Nanos, Nanos]]] = field(default_factory=dict)
    """By role: when each message that was used was logged, and its stamp, as they were written."""


def read(path: Path, topics: BagTopics | None, body: Base) -> Bag:
    """Read a bag. Raises BagError: what cannot be read, or which topics are missing."""
    with open_bag(path) as reader:
        found = _topics(reader)
        _check(path, topics, found)
        for name, role in topics.parts() if topics else ():
            found[name].role = role
        wanted = [one for one in reader.connections if found[one.topic].role]
        images, markers = BagImages(topics.cameras if topics else {}), list[Measurement]()
        messages: list[tuple[str, Nanos, object]] = []
        for connection, logged, data in reader.messages(wanted):
            name, message = connection.topic, reader.deserialize(data, connection.msgtype)
            if not found[name].role.startswith("cameras."):
                messages.append((name, logged, message))
            elif isinstance(seen := images.look(found[name].role, message), str):
                found[name].leave_out(seen)
            else:
                markers += seen
    wheels = _Wheels(body)
    odometry: list[OdometryReading] = []
    events: list[Event] = []
    truth: list[Fix] = []
    readings, stamps = _converted(messages, found)
    for reading in sorted([*markers, *readings], key=lambda reading: reading.t):
        if isinstance(reading, Fix):
            truth.append(reading)
        elif isinstance(reading, Measurement):
            events.append(reading)
        else:
            events += wheels.feedback(reading)
            odometry.append(reading)
    used = tuple(found[name] for name in sorted(found))
    return Bag(path, tuple(events), tuple(odometry), tuple(truth), used, stamps)


def _converted(
    messages: Sequence[tuple[str, Nanos, object]], found: Mapping[str, Topic]
) -> tuple[list[Reading], dict[str, list[tuple[Nanos, Nanos]]]]:
    """Return messages as readings, as they were written, and when each was logged and stamped, by role; count
    unused messages in their topic."""
    readings: list[Reading] = []
    stamps: dict[str, list[tuple[Nanos, Nanos]]] = {}
    for name, logged, message in messages:
        topic = found[name]
        reading = converted(topic.role, message)
        if isinstance(reading, str):
            topic.leave_out(reading)
        else:
            readings.append(reading)
            stamps.setdefault(topic.role, []).append((logged, reading.t))
    return readings, stamps


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
        kind, _, part = role.partition(".")
        topic, wanted = found.get(name), TYPES[part.rpartition(".")[2] if kind == "cameras" else kind]
        if topic is None:
            wrong.append(f"{role}: no topic {name!r}{did_you_mean(name, found)}")
        elif topic.type != wanted:
            wrong.append(f"{role}: {name} holds {topic.type}, expected {wanted}")
        elif not topic.count:
            wrong.append(f"{role}: {name} is empty")
    if wrong:
        raise BagError("\n".join([*(f"{path}: {text}" for text in wrong), f"there is\n{there}"]))


class _Wheels:
    """Joint angles from the twists of the base: of wheels by the trapezoidal rule, of what steers as set."""

    def __init__(self, body: Base) -> None:
        self._body = body
        self._angles = [0.0] * len(body.joints)
        """rad"""
        self._last: tuple[Nanos, list[float]] | None = None
        """Time of the last reading, and the joints' speeds then [rad/s]."""

    def feedback(self, reading: OdometryReading) -> list[Feedback]:
        """Return the feedback of every joint; to be called once per reading, in order."""
        setpoints = self._body.inverse(Twist(reading.linear, reading.angular, reading.lateral), self._angles)
        speeds = [one.velocity or 0.0 for one in setpoints]
        if self._last is not None:
            t, before = self._last
            half = seconds(reading.t - t) / 2.0
            for i, (old, new) in enumerate(zip(before, speeds, strict=True)):
                self._angles[i] += half * (old + new)
        for i, one in enumerate(setpoints):
            if one.position is not None:
                self._angles[i] = one.position
        self._last = (reading.t, speeds)
        moving = zip(self._body.joints, self._angles, speeds, strict=True)
        return [Feedback(name, reading.t, angle, speed) for name, angle, speed in moving]
