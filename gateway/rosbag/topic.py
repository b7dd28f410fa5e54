"""What a recording consists of: topics, their messages, and the head of a message."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from brain.belief import Pose
from protocols.messages import Nanos


class Head(NamedTuple):
    """When a message was measured, and in which frame."""

    t: Nanos
    """0 if it does not say"""
    frame: str
    mount: Pose | None = None
    """Where its sensor is on the robot, if it tells"""


@dataclass(slots=True)
class Topic:
    """One topic of a recording, and how its messages were used."""

    name: str
    type: str
    count: int
    """Messages in the recording."""
    role: str = ""
    """On this robot: "odometry", "sensors.imu", "truth"; "" if none."""
    unused: dict[str, int] = field(default_factory=dict)
    """Messages that were not used, by reason."""
    known: bool = True
    """Whether its messages can be taken apart: their definition is in the recording, or common."""

    def leave_out(self, reason: str) -> None:
        """Count a message that is not used."""
        self.unused[reason] = self.unused.get(reason, 0) + 1

    @property
    def used(self) -> int:
        """Messages that were used."""
        return self.count - sum(self.unused.values()) if self.role else 0


Message: TypeAlias = tuple[str, Nanos, Any]
"""Topic, when it was logged, and the message or its head."""
