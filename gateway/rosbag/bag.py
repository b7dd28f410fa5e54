"""A whole bag, as a robot understands it: its topics' parts, and its messages as events in order."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from brain.belief import Pose
from brain.bodies.differential import Differential
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.rosbag.convert import TYPES, Report, Said, understood
from gateway.rosbag.file import opened
from protocols.messages import Event, Feedback, Fix, Imu, Nanos, seconds

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


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


def read(path: Path, topics: BagTopics | None, body: Differential) -> Bag:
    """The whole bag. Raises BagError: what it is that cannot be read, or which topics are not there."""
    with opened(path) as reader:
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


def _in_order(messages: Sequence[tuple[str, object]], found: Mapping[str, Topic]) -> list[Said]:
    """What messages in the order of the bag say, in the order of their stamps; what says nothing is
    counted in its topic."""
    said: list[Said] = []
    for name, message in messages:
        topic = found[name]
        one = understood(topic.part, message)
        if isinstance(one, str):
            topic.left[one] = topic.left.get(one, 0) + 1
        else:
            said.append(one)
    return sorted(said, key=lambda one: one.t)


def _topics(reader: AnyReader) -> dict[str, Topic]:
    found: dict[str, Topic] = {}
    for one in reader.connections:
        known = found.setdefault(one.topic, Topic(one.topic, one.msgtype, 0))
        known.count += one.msgcount
        if known.type != one.msgtype:
            known.type = "messages of several types"
    return found


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


class _Wheels:
    """What the wheels turned, from the twists of the base.

    From one report to the next the speeds change evenly (trapezium rule)."""

    def __init__(self, body: Differential) -> None:
        self._body = body
        self._left = self._right = 0.0
        """rad"""
        self._last: tuple[Nanos, float, float] | None = None
        """The last report's time, and the wheels' speeds then [rad/s]."""

    def turned(self, report: Report) -> list[Feedback]:
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
