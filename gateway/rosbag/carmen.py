"""Logs of the CARMEN toolkit: lines of text, each a message.

Rules. A line is a word, the message's numbers, and three fields more: its stamp, a host, when it was logged
[s]. What the lines hold stands at the head of such a file ("message formats defined"). `ODOM` has the pose by
the wheels, `FLASER` and `RLASER` a scan with the lidar's pose and that pose, `ROBOTLASER1` one that describes
itself besides, `RAWLASER1` one without poses, `TRUEPOS` the true pose of a simulation. Here they are topics
of their names, but the pose by the wheels is one topic, `odometry`, whatever line it stands in. A file may be
packed (.gz, .bz2, .xz).
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from brain.belief import Pose
from gateway.errors import BagError
from gateway.rosbag.topic import Head, Message, Topic
from protocols.messages import SECOND, Nanos

ODOMETRY = "odometry"
POSE_TYPE, SCAN_TYPE = "log/Pose", "log/Scan"
FAR = 80.0
"""m: a SICK LMS says 81.83 m or 81.91 m where nothing came back, and its own range ends at 80 m."""
NEAREST = 0.02
"""m"""
UNPACK: dict[bytes, Callable[..., Any]] = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}
LONGEST = 200_000
"""Characters of a line: a scan of 10,000 beams."""
DAMAGED = "a damaged line"
"""In place of a message"""
NAMES = (".clf", ".log")
LATEST, FARTHEST = 2.0**62, 1e9
"""ns, and m or rad: what is beyond is damage."""
LOOKED_AT, EXPLAINED = 50, 1000
"""Lines at the beginning, one of which tells that this is a log; those of explanation before it."""


class CarmenPose(NamedTuple):
    """A pose, when it was measured."""

    t: Nanos
    pose: Pose


class CarmenScan(NamedTuple):
    """A scan."""

    t: Nanos
    angle_min: float
    """rad"""
    angle_increment: float
    range_max: float
    """m"""
    ranges: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Line:
    """What stands where in a line: numbers counted from its first field."""

    scan: Callable[[list[str]], tuple[float, float, float, int, int, int]] | None = None
    """Returns angle of the first beam, increment, largest range, first range, their number, and where the
    lidar's pose stands."""
    odometry: Callable[[list[str]], int] | None = None
    """Returns where the pose by the wheels stands."""


def _simple(fields: list[str]) -> tuple[float, float, float, int, int, int]:
    """Of a scan that names only its number of beams: SICK lidars look to the front, over half a turn; those
    of 180 or 181 beams step by 1 degree, 360 or 361 by half a degree."""
    count = int(fields[1])
    step = math.pi / (count - count % 2) if count > 1 else math.pi
    return -math.pi / 2.0, step, FAR, 2, count, 2 + count


def _described(fields: list[str]) -> tuple[float, float, float, int, int, int]:
    """Of a scan that describes itself: kind, start, field of view, step, largest range, accuracy, mode."""
    count = int(fields[8])
    after = 9 + count
    return float(fields[2]), float(fields[4]), float(fields[5]), 9, count, after + 1 + int(fields[after])


LINES = {
    "ODOM": _Line(odometry=lambda _: 1),
    "FLASER": _Line(_simple, lambda fields: 2 + int(fields[1]) + 3),
    "RLASER": _Line(_simple, lambda fields: 2 + int(fields[1]) + 3),
    **{f"ROBOTLASER{n}": _Line(_described, lambda fields: _described(fields)[5] + 3) for n in range(1, 6)},
    **{f"RAWLASER{n}": _Line(_described) for n in range(1, 6)},
    "TRUEPOS": _Line(),
}


def is_carmen(path: Path) -> bool:
    """True if one of the first lines of a file is one of such a log."""
    if not path.is_file():
        return False
    try:
        with _opened(path) as file:
            lines = _first(file)
    except (OSError, EOFError, ValueError, lzma.LZMAError, zlib.error):
        return any(name in path.suffixes for name in NAMES)  # packed, and damaged
    return any(line.startswith(("# message_name [message contents]", "# CARMEN")) for line in lines) or any(
        len(fields := line.split()) > 6 and fields[0] in LINES and _is_number(fields[-1]) for line in lines
    )


def _first(file: Any) -> list[str]:  # noqa: ANN401 -- as `_opened` returns it
    """Return the first lines: so many, not counting those of explanation."""
    lines, counted = list[str](), 0
    while counted < LOOKED_AT and len(lines) < LOOKED_AT + EXPLAINED and (line := file.readline(LONGEST)):
        lines.append(line)
        counted += not _explains(line.split())
    return lines


def _explains(fields: list[str]) -> bool:
    """Return whether a line is a comment, or of the program that logged."""
    return not fields or fields[0].startswith("#") or fields[0] in ("PARAM", "SYNC")


def _opened(path: Path) -> Any:  # noqa: ANN401 -- of text, by four libraries
    with path.open("rb") as file:
        start = file.read(8)
    unpack = next((one for mark, one in UNPACK.items() if start.startswith(mark)), open)
    return unpack(path, "rt", encoding="ascii", errors="replace")


class CarmenLog:
    """A log, read line by line."""

    remark = ""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ahead: dict[str, float] = {}
        """m from the robot's origin to a lidar, by kind of line, as the log's parameters say"""

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics, by name."""
        found: dict[str, Topic] = {}

        def count(name: str, kind: str) -> None:
            found.setdefault(name, Topic(name, kind, 0)).count += 1

        for fields in self._lines():
            known = LINES.get(fields[0])
            if known is None:
                count(fields[0], "a line of text")
                continue
            if known.odometry is not None:
                count(ODOMETRY, POSE_TYPE)
            if known.scan is not None:
                count(fields[0], SCAN_TYPE)
            elif fields[0] != "ODOM":
                count(fields[0], POSE_TYPE)
        return found

    def messages(self, whole: Collection[str], heads: Collection[str] = ()) -> Iterator[Message]:
        """Yield the messages of some topics, and of others the heads alone."""
        for fields in self._lines():
            known = LINES.get(fields[0])
            if known is None:
                continue
            try:
                t, logged = nanos(float(fields[-3])), nanos(float(fields[-1]))
                made = list(self._made(t, fields, known, whole, heads))
            except (ValueError, IndexError):
                logged, made = 0, [(name, DAMAGED) for name in (ODOMETRY, fields[0]) if name in whole]
            yield from ((name, logged, message) for name, message in made)

    def _made(
        self, t: Nanos, fields: list[str], line: _Line, whole: Collection[str], heads: Collection[str]
    ) -> Iterator[tuple[str, object]]:
        """Yield what a line says, by topic. Raises ValueError or IndexError if it is damaged."""
        if line.odometry is not None and ODOMETRY in whole:
            yield ODOMETRY, CarmenPose(t, _pose(fields, line.odometry(fields)))
        elif line.odometry is not None and ODOMETRY in heads:
            yield ODOMETRY, Head(t, "")
        if fields[0] in heads:
            yield fields[0], Head(t, _frame(fields[0]) if line.scan else "", self._mount(fields, line))
        elif fields[0] in whole:
            yield fields[0], _scan(t, fields, line) if line.scan else _true(t, fields)

    def _mount(self, fields: list[str], line: _Line) -> Pose | None:
        """Return where the lidar is on the robot, by the two poses of a line or the log's parameters."""
        if line.scan is None or line.odometry is None:
            return None
        if self._ahead.get(fields[0]):
            return Pose(self._ahead[fields[0]], 0.0, 0.0 if fields[0] == "FLASER" else math.pi)
        lidar, base = _pose(fields, line.scan(fields)[5]), _pose(fields, line.odometry(fields))
        c, s = math.cos(base.yaw), math.sin(base.yaw)
        dx, dy = lidar.x - base.x, lidar.y - base.y
        turn = math.remainder(lidar.yaw - base.yaw, math.tau)
        return Pose(c * dx + s * dy, c * dy - s * dx, turn)

    def _parameter(self, fields: list[str]) -> None:
        for kind, name in (("FLASER", "robot_frontlaser_offset"), ("RLASER", "robot_rearlaser_offset")):
            if len(fields) > 2 and fields[1] == name and _is_number(fields[2]):
                self._ahead[kind] = float(fields[2])

    def _lines(self) -> Iterator[list[str]]:
        """Yield the fields of every line that is none of explanation; the last may be cut off."""
        try:
            with _opened(self._path) as file:
                while line := file.readline(LONGEST):
                    fields = line.split()
                    if _explains(fields):
                        self._parameter(fields)
                        continue
                    if not line.endswith("\n") and not self._is_whole(fields):
                        return
                    yield fields
        except (OSError, EOFError, lzma.LZMAError, zlib.error) as error:
            raise BagError(f"{self._path}: damaged: it cannot be unpacked: {error}") from error

    def _is_whole(self, fields: list[str]) -> bool:
        known = LINES.get(fields[0])
        try:
            if known is None or known.odometry is None:
                return False
            return len(fields) >= known.odometry(fields) + 6 and _is_number(fields[-1])
        except (ValueError, IndexError):
            return False


def _frame(line: str) -> str:
    """Return which lidar a line is of: 1 looks to the front, and 2 to the rear."""
    return f"laser {({'FLASER': '1', 'RLASER': '2'}).get(line, line[-1])}"


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _pose(fields: list[str], at: int) -> Pose:
    x, y, yaw = map(float, fields[at : at + 3])
    return pose_within(x, y, yaw)


def nanos(t: float, unit: int = SECOND) -> Nanos:
    """Return a time in nanoseconds. Raises ValueError if no clock shows it."""
    if not abs(t * unit) < LATEST:
        raise ValueError(f"{t:g} is no time")
    return round(t * unit)


def pose_within(x: float, y: float, yaw: float) -> Pose:
    """Return a pose. Raises ValueError if nothing is there."""
    if not max(abs(x), abs(y), abs(yaw)) < FARTHEST:
        raise ValueError(f"{x:g}, {y:g}, {yaw:g} is no place")
    return Pose(x, y, yaw)


def _true(t: Nanos, fields: list[str]) -> CarmenPose:
    return CarmenPose(t, _pose(fields, 1))


def _scan(t: Nanos, fields: list[str], line: _Line) -> CarmenScan:
    if line.scan is None:
        raise ValueError("no scan")
    first, step, most, begin, count, end = line.scan(fields)
    if not 0 < count <= len(fields) - begin or end > len(fields):
        raise ValueError(f"{count} beams")
    return CarmenScan(t, first, step, most, tuple(map(float, fields[begin : begin + count])))
