"""The table [bag] of the robot file: what the topics of somebody else's bag are on this robot.

Rules. A topic has one part to play, and the type of its messages is what that part asks for. What is a
truth to judge by cannot be an input too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Literal

from gateway.mistakes import Mistakes, shown, unknown


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Which topic is what."""

    odometry: str
    """nav_msgs/Odometry: its twist is what the wheels did."""
    sensors: dict[str, str] = field(default_factory=dict)
    """A sensor of this robot, and its topic: sensor_msgs/Imu."""
    truth: str = ""
    """sensor_msgs/NavSatFix: what the believed path is judged by; never an input. "" if there is none."""

    def parts(self) -> Iterator[tuple[str, str]]:
        """Each topic and its part, as the key that names it: "odometry", "sensors.imu", "truth"."""
        yield self.odometry, "odometry"
        yield from ((topic, f"sensors.{sensor}") for sensor, topic in self.sensors.items())
        if self.truth:
            yield self.truth, "truth"


def check_bag(
    bag: BagTopics, body: Literal["differential", "joints"], sensors: Collection[str], mistakes: Mistakes
) -> None:
    """The table against the rest of the robot file."""
    if body != "differential":
        said = f"a bag moves a base on wheels, and the body is {body!r}; expected no such table"
        mistakes.add(("bag",), said)
    for sensor in bag.sensors:
        if sensor not in sensors:
            mistakes.add(("bag", "sensors", sensor), unknown("sensor", sensor, sensors))
    played: dict[str, str] = {}
    for topic, part in bag.parts():
        key = ("bag", *part.split("."))
        if not topic.startswith("/"):
            mistakes.add(key, f'found {shown(topic)}, expected a topic: it begins with "/"')
        elif topic in played:
            mistakes.add(key, f"found {shown(topic)}, which is {played[topic]} too; expected another topic")
        played.setdefault(topic, part)
