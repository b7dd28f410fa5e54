"""A drive to be looked at: a recording of ours or of another program, or what a session has just done."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from brain.bodies.body import Base
from brain.perception.mount import Mount
from gateway.config import load_robot, parse_robot
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.recording import read_recording
from gateway.rosbag import is_bag, read
from gateway.rosbag.evaluate import mounts_of
from gateway.rosbag.survey import proposed_robot, survey
from protocols.messages import Event

CUT = "the recording ends without its end: it was cut; all before is used"
Events: TypeAlias = Callable[[], Iterable[Event]]
"""The events of a drive, in order, as often as they are asked for"""


@dataclass(frozen=True, slots=True)
class Driven:
    """One drive."""

    robot: Robot
    mounts: Mapping[str, Mount]
    """Of its sensors, as stated"""
    events: Events
    by_odometry: bool = False
    """Whether its wheels are made here of an odometry: their sizes are nobody's"""
    remark: str = ""
    """What of its file is not as it was meant, such as a lost end; "" if all is"""

    @property
    def body(self) -> Base:
        """What drives. Raises UserError if nothing does."""
        body = self.robot.brain.base
        if body is None:
            raise UserError(f"{self.robot.name} has no base that drives")
        return body


def of_events(robot: Robot, events: Events) -> Driven:
    """Return what a robot has done."""
    return Driven(robot, {name: one.mount for name, one in robot.sensors.items()}, events)


def of_file(path: Path, robot_file: str | None = None) -> Driven:
    """Open a recording. `robot_file`: another robot file than the recorded, or the proposed one. Raises
    GatewayError: it cannot be read, or does not say how a base moved."""
    if not is_bag(path):
        recording = read_recording(path)
        robot = load_robot(robot_file) if robot_file else parse_robot(recording.robot_text, str(path))
        driven = of_events(robot, lambda: (e for tick in recording.ticks for e in tick.outputs.events))
        return driven if recording.whole else replace(driven, remark=CUT)
    robot = load_robot(robot_file, recorded=True) if robot_file else proposed_robot(survey(path))
    if robot.brain.base is None:
        raise UserError(f"{path}: {robot.name} has no base that drives")
    bag = read(path, robot.bag, robot.brain.base)
    mounts = mounts_of(bag, robot)
    return Driven(
        robot,
        mounts,
        lambda: heapq.merge(bag.events, bag.scans(), key=lambda event: event.t),
        by_odometry=bool(bag.odometry),
        remark=bag.remark,
    )


def is_recording(path: Path) -> bool:
    """Whether a name on the command line is a recording, and no robot."""
    return path.is_dir() or (path.is_file() and path.suffix != ".toml")
