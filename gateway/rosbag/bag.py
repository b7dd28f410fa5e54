"""A whole recording: the role of each topic on this robot, and the messages as events in order.

Rules. What is small is read once, and kept; scans and clouds are read again, one by one, whenever they are
asked for (`Bag.scans`), so that memory does not grow with them.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from brain.belief import Pose
from brain.bodies.body import Base
from brain.perception.keyframes import KeyframeSettings
from brain.perception.mount import Mount
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.rosbag.carmen import POSE_TYPE, SCAN_TYPE
from gateway.rosbag.convert import LARGE, ODOMETRY, TYPES, Converter, Reading, TruePose, Truth, scan, stamp
from gateway.rosbag.frames import TF_TYPES, Frames, mount_of, name_of, pose_of
from gateway.rosbag.images import BagImages
from gateway.rosbag.motion import (
    JointsReading,
    OdometryReading,
    Wheels,
    never_filled_in,
    of_joints,
    rolled,
    with_twists,
)
from gateway.rosbag.scan_odometry import by_scans
from gateway.rosbag.source import Source, open_source
from gateway.rosbag.topic import Head, Topic
from protocols.messages import SECOND, Event, Feedback, Fix, Imu, LaserScan, Measurement, Nanos
from protocols.suggest import did_you_mean

FIXED = {"truth": "map", "odometry": "odom"}
ORIGIN = "taken at the robot's origin, level"
DESCRIPTION = "/robot_description"
BASES = ("base_link", "base_footprint", "base")
"""The robot's frame, where nothing else tells it (REP 105)."""
GRAVITY, LEVEL = 9.81, math.cos(math.radians(20.0))
"""m/s²; an IMU that is tilted by less than this counts as level, on a slope or by its driving."""
NEARLY = math.radians(10.0)
BY_SCANS = "no odometry: the motion is what its scans show, each searched where the speed before it leads"
FEW = 2
MOST_HELD_BACK = 100
HELD_BACK: Nanos = 2 * SECOND
"""By so much a scan may be older than one that was logged before it, and still come first."""


@dataclass(frozen=True, slots=True)
class Placed:
    """Where a sensor is on the robot, and who says so."""

    mount: Mount
    by: str


@dataclass(frozen=True, slots=True)
class Bag:
    """A recording, converted for a robot."""

    path: Path
    events: tuple[Event, ...]
    """Feedback of the joints and readings of sensors, in order, without scans."""
    odometry: tuple[OdometryReading, ...]
    """The recording's own odometry, in order; its poses are for comparison."""
    truth: tuple[Truth, ...]
    """Ground truth, in order."""
    topics: tuple[Topic, ...]
    """All topics of the recording, sorted by name."""
    stamps: Mapping[str, Sequence[tuple[Nanos, Nanos]]] = field(default_factory=dict)
    """By role: when each message that was used was logged, and its stamp, as they were written."""
    own_path: bool = True
    """Whether the poses of the odometry are the recording's own, not made here of its speeds or angles."""
    own_twists: bool = True
    """The same of its speeds."""
    several_clocks: frozenset[str] = frozenset()
    """Roles whose messages are stamped by several programs, and may overtake each other"""
    remark: str = ""
    """How it is read, where that is not as its writer meant"""
    placed: Mapping[str, Placed] = field(default_factory=dict)
    """By sensor that the robot file does not place."""
    scans: Callable[[], Iterator[LaserScan]] = field(default=lambda: iter(()), compare=False)
    """Yields the scans in order; those that are not used are counted when it ends."""


def read(path: Path, topics: BagTopics | None, body: Base) -> Bag:
    """Read a recording. Raises BagError: what cannot be read, or which topics are missing."""
    with open_source(path) as source:
        found, remark = dict(source.topics), source.remark
        topics = _checked(path, topics, found)
        for name, role in topics.parts():
            found[name].role = role
        first = _Pass(topics, body, found)
        first.run(source)
    ordered = sorted([*first.markers, *first.readings], key=lambda reading: reading.t)
    kind = found[topics.odometry].type if topics.odometry else ""
    places = first.places()
    if not kind:
        mounts = {name: one.mount for name, one in places.items()} | topics.mounts
        shown = by_scans(_scans(path, topics, found), mounts, KeyframeSettings())
        ordered = sorted([*ordered, *shown], key=lambda reading: reading.t)
        remark = "; ".join(filter(None, [remark, BY_SCANS]))
    events, odometry, by_pose = _motion(topics, body, ordered, made=kind != ODOMETRY)
    fixes = [one for one in ordered if isinstance(one, Fix) and one.sensor not in topics.sensors]
    poses = [one for one in ordered if isinstance(one, TruePose)]
    return Bag(
        path,
        tuple(events),
        tuple(odometry),
        tuple(poses or fixes),
        tuple(found[name] for name in sorted(found)),
        first.stamps,
        kind in (ODOMETRY, POSE_TYPE, *TF_TYPES),
        not by_pose,
        frozenset(one.role for one in found.values() if one.role and one.type in (POSE_TYPE, SCAN_TYPE)),
        remark,
        places,
        partial(_scans, path, topics, found),
    )


def _motion(
    topics: BagTopics, body: Base, ordered: Sequence[Reading], *, made: bool
) -> tuple[list[Event], list[OdometryReading], bool]:
    """Return the events, with what the base's motion turns its joints by in its place; the motion; and
    whether it is that of its poses.

    `made`: its poses follow from its speeds here."""
    twists = [one for one in ordered if isinstance(one, OdometryReading)]
    joints = [one for one in ordered if isinstance(one, JointsReading)]
    by_pose = topics.motion == "pose" or (topics.motion == "auto" and never_filled_in(twists))
    if not topics.odometry:
        by_pose, odometry = True, twists
    elif by_pose:
        odometry = with_twists(twists, sideways=body.moves_sideways)
    elif made:
        odometry = rolled(twists)
    else:
        odometry = twists
    odometry = odometry or list(of_joints(body, joints))
    wheels, moved = Wheels(body), iter(odometry)
    events: list[Event] = []
    for reading in ordered:
        if isinstance(reading, JointsReading):
            turned = zip(body.joints, reading.angles, strict=True)
            events += [Feedback(name, reading.t, angle) for name, angle in turned]
        elif isinstance(reading, OdometryReading):
            one = next(moved)
            events += wheels.feedback_of_pose(one) if by_pose else wheels.feedback(one)
        elif not isinstance(reading, TruePose) and (
            not isinstance(reading, Fix) or reading.sensor in topics.sensors
        ):
            events.append(reading)
    return events, odometry, by_pose


class _Pass:
    """The first time through a recording: all that is small, and of scans their stamps and frames."""

    def __init__(self, topics: BagTopics, body: Base, found: Mapping[str, Topic]) -> None:
        self._topics, self._found = topics, found
        self._roles = {name: found[name].role for name, _ in topics.parts()}
        types = {name: found[name].type for name in self._roles}
        self._large = {name for name in self._roles if found[name].type in LARGE}
        self._converter = Converter(topics, body.joints, types)
        self._images = BagImages(topics.cameras)
        self._placing = [name for name, one in found.items() if one.type in TF_TYPES and one.known]
        self._frames, self._frame_of = Frames(), dict[str, str]()
        self._base = topics.base_frame or (topics.odometry_frames or ("", ""))[1]
        self._told: dict[str, set[Pose]] = {}
        """Where lidars are, as their messages say."""
        self.readings: list[Reading] = []
        self.markers: list[Measurement] = []
        self.stamps: dict[str, list[tuple[Nanos, Nanos]]] = {}

    def run(self, source: Source) -> None:
        """Read everything."""
        small = {name for name in self._roles if name not in self._large}
        described = {DESCRIPTION} & {n for n, one in self._found.items() if one.type == "std_msgs/msg/String"}
        whole = small | set(self._placing if self._places else []) | (described if self._places else set())
        for name, logged, message in source.messages(whole, self._large):
            if name in self._placing:
                self._place(name, logged, message)
            elif name in described:
                self._frames.describe(message.data)
            elif name in self._large:
                self._note(name, logged, message)
            else:
                self._take(name, logged, message)

    @property
    def _places(self) -> bool:
        """Whether a sensor's place is looked for."""
        return any(sensor not in self._topics.mounts for sensor in self._topics.sensors)

    def _take(self, name: str, logged: Nanos, message: Any) -> None:  # noqa: ANN401
        role, topic = self._roles[name], self._found[name]
        if role.startswith("cameras."):
            seen = self._images.look(role, message)
            if isinstance(seen, str):
                topic.leave_out(seen)
            else:
                self.markers += seen
            return
        reading = self._converter.take(name, role, message)
        if isinstance(reading, str):
            topic.leave_out(reading)
        elif reading is not None:
            self.readings.append(reading)
            self.stamps.setdefault(role, []).append((logged, reading.t))
        if name not in self._frame_of and hasattr(message, "header"):
            self._frame_of[name] = str(message.header.frame_id)
            if role == "odometry" and topic.type == ODOMETRY and not self._base:
                self._base = str(message.child_frame_id)

    def _note(self, name: str, logged: Nanos, head: Head) -> None:
        if head.t > 0:
            self.stamps.setdefault(self._roles[name], []).append((logged, head.t))
        self._frame_of.setdefault(name, head.frame)
        if head.mount is not None:
            told = self._told.setdefault(name, set())
            if len(told) < FEW:
                told.add(Pose(*(round(one, 3) for one in (head.mount.x, head.mount.y, head.mount.yaw))))

    def _place(self, name: str, logged: Nanos, message: Any) -> None:  # noqa: ANN401
        self._frames.add(message)
        role = self._roles.get(name, "")
        pair = self._topics.truth_frames if role == "truth" else self._topics.odometry_frames
        if not role or pair is None:
            return
        way = self._frames.way(*pair)
        times = [stamp(one) for one in message.transforms if name_of(one.child_frame_id) in way]
        if not times:
            self._found[name].leave_out("other frames")
            return
        there, t = self._frames.between(*pair), max(times)
        if there is None or t <= 0:
            self._found[name].leave_out("no stamp" if there is not None else "frames that are not connected")
            return
        pose = pose_of(there)
        made = TruePose(t, pose) if role == "truth" else OdometryReading(t, 0.0, 0.0, pose)
        self.readings.append(made)
        self.stamps.setdefault(role, []).append((logged, t))

    def places(self) -> dict[str, Placed]:
        """Return where the sensors are that the robot file does not place."""
        base = self._base
        if name_of(base) not in self._frames:
            base = next((one for one in self._frames.names() if one.rpartition("/")[2] in BASES), base)
        found = {}
        for sensor, name in self._topics.sensors.items():
            if sensor in self._topics.mounts:
                continue
            found[sensor] = self._placed(name, base, self._frame_of.get(name, ""))
        return found

    def _placed(self, name: str, base: str, frame: str) -> Placed:
        told = self._told.get(name, set())
        if len(told) == 1:
            (at,) = told
            return Placed(Mount(at.x, at.y, yaw=at.yaw), "as the log has it")
        if told:
            return Placed(Mount(), f"the log's poses of it are another's estimate: {ORIGIN}")
        if not frame:
            return Placed(Mount(), f"its messages name no frame: {ORIGIN}")
        if name_of(frame) == name_of(base):
            return Placed(Mount(), f"in the robot's own frame, {base}")
        way = self._frames.between(base, frame) if base else None
        mount = mount_of(way) if way is not None else None
        if mount is None and (level := self._by_gravity(name)) is not None:
            return Placed(
                level, f"no transform from {base or 'the robot'} to {frame}: turned as gravity shows"
            )
        if mount is None:
            return Placed(
                Mount(),
                f"no transform from {base or 'the robot'} to {frame}: {ORIGIN}",
            )
        if self._frames.moves(base, frame):
            return Placed(mount, f"{base} to {frame}, which MOVES; taken as it was at last")
        return Placed(mount, f"{base} to {frame}")

    def _by_gravity(self, name: str) -> Mount | None:
        """Return how an IMU is turned, by what it takes for up on average; None if it is level, or cannot be
        told. About the vertical it may be turned by anything, which no rate about the vertical shows."""
        sensor = self._roles[name].partition(".")[2]
        pushes = [
            one.linear_acceleration for one in self.readings if isinstance(one, Imu) and one.sensor == sensor
        ]
        if not pushes:
            return None
        x, y, z = (math.fsum(axis) / len(pushes) for axis in zip(*pushes, strict=True))
        size = math.sqrt(x * x + y * y + z * z)
        if not abs(size - GRAVITY) < 0.1 * GRAVITY or z > LEVEL * size:
            return None
        pitch, roll = -math.asin(min(max(x / size, -1.0), 1.0)), math.atan2(y, z)
        return Mount(pitch=_squared(pitch), roll=_squared(roll))


def _squared(angle: float) -> float:
    """Return the right angle next to an angle, if it is near; sensors are mounted so."""
    nearest = round(angle / (math.pi / 2.0)) * math.pi / 2.0
    return nearest if abs(angle - nearest) < NEARLY else angle


def _scans(path: Path, topics: BagTopics, found: Mapping[str, Topic]) -> Iterator[LaserScan]:
    """Yield the scans of a recording in the order of their stamps, as far as that can be told without all."""
    sensors = {name: sensor for sensor, name in topics.sensors.items() if found[name].type in LARGE}
    if not sensors:
        return
    waiting: list[tuple[Nanos, int, LaserScan]] = []
    unused: dict[str, dict[str, int]] = {name: {} for name in sensors}
    newest = 0
    with open_source(path) as source:
        for number, (name, _, message) in enumerate(source.messages(sensors)):
            sensor = sensors[name]
            made = scan(sensor, found[name].type, message, topics.clouds.get(sensor))
            if isinstance(made, str):
                unused[name][made] = unused[name].get(made, 0) + 1
                continue
            heapq.heappush(waiting, (made.t, number, made))
            newest = max(newest, made.t)
            while waiting and (newest - waiting[0][0] > HELD_BACK or len(waiting) > MOST_HELD_BACK):
                yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]
    for name, reasons in unused.items():
        found[name].unused = reasons


def _checked(path: Path, topics: BagTopics | None, found: Mapping[str, Topic]) -> BagTopics:
    """Return the table. Raises BagError unless every role has its topic, with messages of its type."""
    there = "\n".join(f"  {t.name}: {t.count} of {t.type}" for _, t in sorted(found.items())) or "  nothing"
    if topics is None:
        raise BagError(f"{path}: the robot file has no table [bag] that maps its topics; there is\n{there}")
    wrong: list[str] = []
    seen = {found[one].type for one in topics.sensors.values() if one in found}
    if not topics.odometry and not seen & set(LARGE):
        wrong.append("odometry is not named, and no lidar, whose scans would show how the base moved")
    for name, role in topics.parts():
        kind, _, part = role.partition(".")
        topic, wanted = found.get(name), TYPES.get(part.rpartition(".")[2] if kind == "cameras" else kind, ())
        if topic is None:
            wrong.append(f"{role}: no topic {name!r}{did_you_mean(name, found)}")
        elif topic.type not in wanted and not (topics.car is not None and kind in ("odometry", "car")):
            wrong.append(f"{role}: {name} holds {topic.type}, expected {_one_of(wanted)}")
        elif not topic.known:
            wrong.append(f"{role}: {name} holds {topic.type}, whose definition is not in it")
        elif not topic.count:
            wrong.append(f"{role}: {name} is empty")
        elif topic.type in TF_TYPES and getattr(topics, f"{role}_frames") is None:
            remedy = f'say which two, by {role}_frames = ["{FIXED[role]}", "base_link"]'
            wrong.append(f"{role}: {name} holds many frames: {remedy}")
    if wrong:
        raise BagError("\n".join([*(f"{path}: {text}" for text in wrong), f"there is\n{there}"]))
    return topics


def _one_of(types: Sequence[str]) -> str:
    """Return types of ROS in words."""
    names = [one.rpartition("/")[2] for one in types if not one.startswith("log/")]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
