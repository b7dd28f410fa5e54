"""What is in a recording of another program, in words; and the robot file to start with.

Rules. One pass, of which numbers remain: when each message was logged, and its stamp. What is proposed is
what the messages hold, and nothing else: the topics that say how the base moved, its sensors, and what may be
a truth. What was left out, and why, stands beside it as a comment.
"""

from __future__ import annotations

import json
import math
import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.body import Base
from gateway.config import parse_robot
from gateway.config.recorded import stand_in
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.rosbag import stamps
from gateway.rosbag.bag import BASES, Bag, read
from gateway.rosbag.carmen import ODOMETRY as LOG_ODOMETRY
from gateway.rosbag.carmen import POSE_TYPE, SCAN_TYPE, is_carmen
from gateway.rosbag.contradictions import contradictions
from gateway.rosbag.convert import (
    CLOUD,
    ECHOES,
    FIX,
    IMU,
    JOINTS,
    ODOMETRY,
    PLACED,
    POSE,
    POSE_COVARIANCE,
    SCAN,
    TWIST,
    TWIST_COVARIANCE,
)
from gateway.rosbag.evaluate import at_text, mounts_of
from gateway.rosbag.file import ROS1, first_bytes
from gateway.rosbag.frames import TF_TYPES, Frames
from gateway.rosbag.source import open_source
from gateway.rosbag.tables import TRUTH, layout
from gateway.rosbag.topic import Head, Topic
from protocols.messages import SECOND, Nanos

EXPECTED = (
    "expected a bag of ROS 1 (.bag), one of ROS 2 (a folder, .db3 or .mcap), a log of CARMEN (lines ODOM and "
    "FLASER), a CSV with columns t, x, y and yaw or t, v and w, or a recording of this gateway"
)
"""Of a file that is none"""
TRUE = re.compile(r"ground|truth|(^|[/_])gt([/_]|$)|vicon|mocap|optitrack|qualisys|vrpn|natnet|leica", re.I)
"""Names of topics that hold what somebody measured from outside."""
MADE = re.compile(r"filter|fused|fusion|ekf|ukf|slam|amcl|visual|vio|vins|lio|icp|rgbd|map|gps|global", re.I)
"""Names of odometry that another estimator made."""
WORLD = ("map", "odom", "world", "earth")
"""Frames in which a robot moves (REP 105)"""
GAP_FACTOR = 5.0
"""A pause is named from so many periods on."""
STATE = "StateStamped"
"""How types end whose messages are the state of a device, with a header;"""
NUMBERS = ("std_msgs/msg/Float64", "std_msgs/msg/Float32")
CONTROL = re.compile(r"[\x00-\x1f\x7f]")
WORDS = re.compile(r"[^A-Za-z0-9_]+")
SAME_STAMPS = 0.9
"""Share of the scans of one topic from which on it is another's again, if they have the same stamps"""
SIDEWAYS = 0.02
"""m/s to the side, above which a base is proposed that can move so"""


@dataclass(slots=True)
class TopicSurvey:
    """One topic: its times, and what its messages show."""

    topic: Topic
    logged: array[int] = field(default_factory=lambda: array("q"))
    stamped: array[int] = field(default_factory=lambda: array("q"))
    frame: str = ""
    mount: Pose | None = None
    """Where its sensor is on the robot, if its messages tell"""
    child: str = ""
    sideways: float = 0.0
    """m/s, the largest, of an odometry"""
    good: int = 0
    """Fixes that are fixes"""
    telemetry: bool = False
    """Whether its messages are the state of a motor"""

    def add(self, logged: Nanos, message: Any) -> None:  # noqa: ANN401 -- of every type
        """Add a message, or its head."""
        self.logged.append(logged)
        t, frame = (message.t, message.frame) if isinstance(message, Head) else (0, "")
        if self.mount is None and isinstance(message, Head):
            self.mount = message.mount
        if self.topic.type == ODOMETRY and not isinstance(message, Head):
            stamp = message.header.stamp
            t, frame = stamp.sec * SECOND + stamp.nanosec, message.header.frame_id
            self.child = self.child or str(message.child_frame_id)
            self.sideways = max(self.sideways, abs(float(message.twist.twist.linear.y)))
        elif self.topic.type == FIX and not isinstance(message, Head):
            stamp = message.header.stamp
            t, frame = stamp.sec * SECOND + stamp.nanosec, message.header.frame_id
            self.good += message.status.status >= 0
        elif self.topic.type.endswith(STATE) and not isinstance(message, Head):
            stamp = message.header.stamp
            t, state = stamp.sec * SECOND + stamp.nanosec, message.state
            self.telemetry = hasattr(state, "speed") and hasattr(state, "duty_cycle")
        self.stamped.append(t)
        self.frame = self.frame or str(frame)

    @property
    def name(self) -> str:
        """Its name."""
        return self.topic.name

    def times(self) -> Floats:
        """Return the stamps [s from the first], or where there are none when each was logged."""
        ticks = np.frombuffer(self.stamped if any(self.stamped) else self.logged, dtype=np.int64)
        return (ticks - ticks[0]) / SECOND if len(ticks) else np.empty(0)

    def rate(self) -> str:
        """Return how often there is one, and the longest pause."""
        t = np.sort(self.times())
        if len(t) < 3 or not t[-1] > t[0]:
            return "-"
        apart = np.diff(t)
        usual = float(np.median(apart[apart > 0.0])) if (apart > 0.0).any() else 0.0
        text = f"{(len(t) - 1) / (t[-1] - t[0]):.3g} Hz"
        if usual and apart.max() > GAP_FACTOR * usual:
            text += f", a pause of {apart.max():.3g} s"
        return text

    def remarks(self) -> list[str]:
        """Return what is odd about its stamps."""
        if not self.logged:
            return ["no message"]
        if not self.topic.known:
            return ["its messages' definition is not in it: they cannot be read"]
        stamped = np.frombuffer(self.stamped, dtype=np.int64)
        if not stamped.any():
            return ["without stamps"]
        found = [f"{(stamped == 0).sum()} without a stamp"] if (stamped == 0).any() else []
        kept = stamped != 0
        logged = np.frombuffer(self.logged, dtype=np.int64)[kept]
        t, seen = (stamped[kept] - stamped[kept][0]) / SECOND, (logged - stamped[kept]) / SECOND
        back = -np.diff(t)
        if (back > 0.0).any():
            found.append(f"stamps go back {(back > 0.0).sum()} times, by up to {back.max():.2g} s")
        low, middle, high = (float(one) for one in np.quantile(seen, (0.0, 0.5, 1.0)))
        if high - low > LATE:
            found.append(f"logged {_span(low)} to {_span(high)} after its stamp, usually {_span(middle)}")
        elif abs(middle) > LATE:
            found.append(
                f"always logged {_span(abs(middle))} {'after' if middle > 0.0 else 'before'} its stamp"
            )
        one = stamps.Stamps((logged - logged[0]) / SECOND, t)
        odd = [*stamps.resolution(t), *stamps.order(t)] or stamps.steps(one)
        return [*found, *odd]


LATE = 0.05
"""s from the stamp to the log that is worth a word."""


def _span(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms" if abs(seconds) < 1.0 else f"{seconds:.4g} s"


@dataclass(frozen=True, slots=True)
class Proposal:
    """The robot file to start with."""

    body: str
    lines: tuple[str, ...]
    """Of the table [bag]"""
    notes: tuple[str, ...]
    """What was not taken, and why"""


@dataclass(frozen=True, slots=True)
class Survey:
    """What is in a recording."""

    path: Path
    kind: str
    topics: tuple[TopicSurvey, ...]
    proposal: Proposal | None
    lacking: str
    """Why there is no robot file to start with; "" if there is one"""
    remark: str = ""
    """How it is read, where that is not as its writer meant"""

    def robot_text(self) -> str:
        """Return the robot file to start with. Raises BagError if there is none."""
        if self.proposal is None:
            raise BagError(f"{self.path}: {self.lacking}; there is\n{self._listed()}")
        one = self.proposal
        name = WORDS.sub("_", self.path.name.partition(".")[0])[:60] or "recording"
        lines = [
            f"# How {self.path.name} is read: `gateway replay {self.path.name} --robot THIS_FILE`",
            "# Of the body it counts only whether it can move sideways: what was recorded is its motion.",
            f'name = "{name}"',
            f'body = "{one.body}"',
            "",
            "[bag]",
            *one.lines,
        ]
        if one.notes:
            lines += ["", *(f"# {note}" for note in one.notes)]
        return "\n".join(CONTROL.sub("?", line) for line in lines) + "\n"

    def _listed(self) -> str:
        return "\n".join(f"  {t.name}: {t.topic.count} of {t.topic.type}" for t in self.topics) or "  nothing"

    def span(self) -> tuple[Nanos, Nanos] | None:
        """Return when the first and the last message were logged."""
        ends = [(min(t.logged), max(t.logged)) for t in self.topics if t.logged and any(t.logged)]
        return (min(a for a, _ in ends), max(b for _, b in ends)) if ends else None

    def text(self) -> str:
        """Return what is in it, in words."""
        span = self.span()
        lasts = f", {(span[1] - span[0]) / SECOND:.1f} s" if span else ""
        messages = sum(t.topic.count for t in self.topics)
        rows = [("topic", "messages", "type", "rate", "frame")]
        for one in self.topics:
            frame = f"{one.frame} -> {one.child}" if one.child else one.frame
            rows.append((one.name, str(one.topic.count), one.topic.type, one.rate(), frame or "-"))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        table = ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)) for row in rows]
        lines = [f"{self.path.name}: {self.kind}{lasts}, {messages} messages"]
        lines += [*filter(None, [self.remark]), *(t.rstrip() for t in table)]
        remarks = [f"  {one.name}: {text}" for one in self.topics for text in one.remarks()]
        lines += ["stamps", *(remarks or ["  of every topic in order, and near to when it was logged"])]
        return "\n".join(lines)


def survey(path: Path) -> Survey:
    """Look through a recording. Raises BagError if it cannot be read."""
    frames = Frames()
    with open_source(path) as source:
        remark = source.remark
        topics = {name: TopicSurvey(one) for name, one in sorted(source.topics.items())}
        whole = {n for n, one in topics.items() if one.topic.type in (ODOMETRY, FIX, *TF_TYPES)}
        whole |= {n for n, one in topics.items() if one.topic.type.endswith(STATE)}
        whole = {name for name in whole if topics[name].topic.known}
        for name, logged, message in source.messages(whole, topics.keys() - whole):
            if name in whole and topics[name].topic.type in TF_TYPES:
                frames.add(message)
            topics[name].add(logged, message)
    found = tuple(topics.values())
    proposal, lacking = _proposed(found, frames)
    return Survey(path, _kind(path), found, proposal, lacking, remark)


def findings(one: Survey, robot: Robot) -> list[str]:
    """Return, by a robot file, where the sensors are and what contradicts itself. Raises BagError."""
    body = robot.brain.base
    if body is None or robot.bag is None:
        return []
    bag = read(one.path, robot.bag, body)
    placed = [f"  {name}: {at_text(each.mount)}: {each.by}" for name, each in bag.placed.items()]
    wrong = [f"  {text}" for text in _contradictions(bag, robot, body)]
    lines = ["where the sensors are", *placed] if placed else []
    return [*lines, "what contradicts itself", *(wrong or ["  nothing that was found"])]


def _contradictions(bag: Bag, robot: Robot, body: Base) -> Sequence[str]:
    return contradictions(bag, body, mounts_of(bag, robot), robot.brain.perception.filter.turn_slip)


def proposed_robot(one: Survey) -> Robot:
    """Return the robot to start with. Raises BagError if there is none."""
    return parse_robot(one.robot_text(), "the proposed robot file", recorded=True)


def _kind(path: Path) -> str:
    if is_carmen(path):
        return "a log of CARMEN"
    if known := layout(path):
        return f"a table ({known})"
    start = b"" if path.is_dir() else first_bytes(path)
    if start.startswith(ROS1):
        return "a bag of ROS 1"
    what = "SQLite" if start.startswith(b"SQLite") or list(path.glob("*.db3")) else "MCAP"
    return f"a bag of ROS 2 ({what})"


# -- what is proposed ----------------------------------------------------------------------------


def _proposed(topics: Sequence[TopicSurvey], frames: Frames) -> tuple[Proposal | None, str]:
    """Return the robot file to start with, or why there is none."""
    by_type: dict[str, list[TopicSurvey]] = {}
    for one in topics:
        if one.topic.count:
            by_type.setdefault(one.topic.type, []).append(one)
    notes: list[str] = []
    odometry = _odometry(by_type, frames)
    if odometry is None and (lidar := _lidar_alone(by_type, frames)):
        why = "nothing in it says how the base moved, but its scans, matched one by one"
        odometry = lidar, [f"# no odometry: {why}"], stand_in(sideways=True)
    if odometry is None:
        return None, (
            "nothing in it says how the base moved: expected nav_msgs/Odometry, geometry_msgs/TwistStamped "
            "of the base, the telemetry of a motor, transforms from odom to base_link, or the scans of a "
            "lidar that is fixed to it; a command "
            "(cmd_vel) is no measurement, and of sensor_msgs/JointState a robot file has to say which joint "
            "is which wheel"
        )
    one, lines, body = odometry
    notes += [
        f"odometry, too: {other.name} ({other.topic.type})"
        for kind in (ODOMETRY, TWIST, TWIST_COVARIANCE, JOINTS)
        for other in by_type.get(kind, ())
        if other is not one and not TRUE.search(other.name)
    ]
    sensors = _sensors(by_type, notes)
    if sensors:
        pairs = ", ".join(f"{name} = {quoted(topic)}" for name, topic in sensors.items())
        lines.append(f"sensors = {{ {pairs} }}")
    else:
        notes.append("no gyro, no lidar: the path will be that of the odometry")
    truth = _truth(by_type, one, notes)
    if truth:
        lines.append(truth)
    else:
        notes.append('truth = "TOPIC" of poses or fixes judges the path (or --truth FILE); none was found')
    return Proposal(body, tuple(lines), tuple(notes)), ""


def _odometry(
    by_type: Mapping[str, list[TopicSurvey]], frames: Frames
) -> tuple[TopicSurvey, list[str], str] | None:
    """Return what says how the base moved, with its lines in the file and the body; None if nothing does."""
    plain = [one for one in by_type.get(ODOMETRY, ()) if not TRUE.search(one.name)]
    if plain:
        one = min(plain, key=lambda one: (bool(MADE.search(one.name)), -one.topic.count))
        sideways = one.sideways > SIDEWAYS
        body = stand_in(sideways=sideways)
        what = f"{_hz(one)}; it moves sideways by up to {one.sideways:.2g} m/s" if sideways else _hz(one)
        return one, [f"odometry = {quoted(one.name)}  # {what}"], body
    if logs := by_type.get(POSE_TYPE):
        one = next((each for each in logs if each.name == LOG_ODOMETRY), logs[0])
        return one, [f"odometry = {quoted(one.name)}  # {_hz(one)}"], stand_in(sideways=False)
    if cars := [one for several in by_type.values() for one in several if one.telemetry]:
        return cars[0], _car(cars[0], by_type), stand_in(sideways=False)
    for kind in (TWIST, TWIST_COVARIANCE):
        moved = [one for one in by_type.get(kind, ()) if re.search(r"odom|wheel|base|vel", one.name)]
        for one in moved:
            if not re.search(r"cmd|gps|imu|fix", one.name) and one.frame.lstrip("/") in (*BASES, ""):
                return one, [f"odometry = {quoted(one.name)}  # {_hz(one)}"], stand_in(sideways=False)
    base = next((name for name in BASES if frames.between("odom", name) is not None), "")
    tf = [one for kind in TF_TYPES for one in by_type.get(kind, ()) if not one.name.endswith("static")]
    if base and tf and frames.moves("odom", base):
        lines = [f"odometry = {quoted(tf[0].name)}", f'odometry_frames = ["odom", {quoted(base)}]']
        return tf[0], lines, stand_in(sideways=False)
    return None


def _lidar_alone(by_type: Mapping[str, list[TopicSurvey]], frames: Frames) -> TopicSurvey | None:
    """Return a lidar whose scans show how the base moved; None if there is none, or it moves itself."""
    lidars = [one for kind in (SCAN, ECHOES, SCAN_TYPE, CLOUD) for one in by_type.get(kind, ())]
    bases = [name for name in frames.names() if name not in WORLD]
    tilts = any(frames.moves(base, one.frame) for one in lidars for base in bases)
    return None if tilts or not lidars else lidars[0]


def _car(car: TopicSurvey, by_type: Mapping[str, list[TopicSurvey]]) -> list[str]:
    numbers = [one.name for kind in NUMBERS for one in by_type.get(kind, ())]
    steering = next((name for name in numbers if re.search("servo|steer", name)), "")
    lines = [
        f"odometry = {quoted(car.name)}  # {_hz(car)}",
        "# Its messages count revolutions; what a metre and an angle are, they leave out. The defaults are",
        "# of an F1TENTH car: per_speed = 4614.0, middle = 0.5304, per_angle = -1.2135, wheelbase = 0.25.",
        "# All metres and turns hang on them: state your own in car.",
    ]
    named = f", steering = {quoted(steering)}" if steering else ""
    return [*lines, f'car = {{ speed = "state.speed"{named} }}']


def _sensors(by_type: Mapping[str, list[TopicSurvey]], notes: list[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    imus = by_type.get(IMU, [])
    if imus:
        best = max(imus, key=lambda one: one.topic.count)
        found["imu"] = best.name
        notes += [f"an IMU, too: {one.name}; one gyro is used" for one in imus if one is not best]
    lidars = _each_once([one for kind in (SCAN, ECHOES, SCAN_TYPE) for one in by_type.get(kind, ())], notes)
    clouds = by_type.get(CLOUD, [])
    if not lidars and clouds:
        lidars = [max(clouds, key=lambda one: one.topic.count)]
        notes.append(
            f"of the cloud {lidars[0].name} its most level ring is taken, or what is within 0.1 m of the "
            "lidar's height: clouds = { lidar = { ring = 7 } } or { low = -0.1, high = 0.1 } says otherwise"
        )
    notes += [f"a cloud of points, too: {one.name}" for one in clouds if one not in lidars]
    for one in lidars:
        name = "lidar" if len(lidars) == 1 else WORDS.sub("_", one.name).strip("_") or "lidar"
        found[name] = one.name
    return found


def _each_once(lidars: Sequence[TopicSurvey], notes: list[str]) -> list[TopicSurvey]:
    """Return each lidar by one of its topics: filters and throttles publish its scans again, and what counted
    twice would be believed too much."""
    kept: dict[str, TopicSurvey] = {}
    for one in sorted(lidars, key=lambda one: (-one.topic.count, one.mount is None, len(one.name))):
        same = next((other for other in kept.values() if _same_lidar(other, one)), None)
        if same is None:
            kept[one.name] = one
        else:
            notes.append(f"the scans of {same.name} again: {one.name}")
    return [one for one in lidars if one.name in kept]


def _same_lidar(one: TopicSurvey, other: TopicSurvey) -> bool:
    """True if two topics hold scans in one frame that is known, and at the same times."""
    stamps = [np.frombuffer(each.stamped, dtype=np.int64) for each in (one, other)]
    apart = one.mount is not None and other.mount is not None and not _near(one.mount, other.mount)
    if not one.frame or one.frame != other.frame or apart or not all(each.any() for each in stamps):
        return False
    return bool(np.isin(stamps[1], stamps[0]).mean() > SAME_STAMPS)


def _near(one: Pose, other: Pose) -> bool:
    return math.hypot(one.x - other.x, one.y - other.y) < 0.05 and math.cos(one.yaw - other.yaw) > 0.99


def _truth(by_type: Mapping[str, list[TopicSurvey]], odometry: TopicSurvey, notes: list[str]) -> str:
    """Return the line that names a truth; "" if nothing is one for sure."""
    poses = [
        one
        for kind in (POSE, POSE_COVARIANCE, ODOMETRY, PLACED, POSE_TYPE)
        for one in by_type.get(kind, ())
        if one is not odometry and one.name != LOG_ODOMETRY
    ]
    measured = [one for one in poses if TRUE.search(one.name) or one.name in ("TRUEPOS", TRUTH)]
    fixes = [one for one in by_type.get(FIX, ()) if one.good]
    notes += [
        f"another program's estimate, and no truth: {one.name} ({one.topic.type})"
        for one in poses
        if one not in measured and one.topic.type != ODOMETRY
    ]
    best = measured or fixes
    if not best:
        return ""
    notes += [f"a truth, too: {one.name}" for one in [*measured, *fixes] if one is not best[0]]
    return f"truth = {quoted(best[0].name)}  # {best[0].topic.count} of {best[0].topic.type}; never an input"


def quoted(text: str) -> str:
    """Return a text as a string of TOML: a topic may be called anything."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _hz(one: TopicSurvey) -> str:
    return f"{one.topic.count} of {one.topic.type}, {one.rate()}"
