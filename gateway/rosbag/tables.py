"""Tables of numbers that hold a recording: known layouts, read as poses and scans.

Rules. A layout is known by its shape or by the names of its columns; a table of another shape is none. What
an odometry's steps or ticks add up to is its pose: by arcs.

    by names     a CSV whose first line names its columns: a time (t, time, stamp …), and x, y and a heading,
                 or a speed (v) and a rate of turn (w)
    range-only   a MATLAB file with DR (t, way, turn) and GT (t, x, y, heading): CMU's range-only recordings
                 (borglab/gtsam:examples/Data/Plaza*)
    ticks        lines of 24 numbers and a scan after them: microseconds, ticks of both wheels at 2 and 3,
                 millimetres from 24 on: Mines ParisTech, with the robot and its lidar as in
                 simondlevy/BreezySLAM:examples/mines.py
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import arc
from gateway.errors import BagError
from gateway.rosbag.carmen import (
    DAMAGED,
    ODOMETRY,
    POSE_TYPE,
    SCAN_TYPE,
    CarmenPose,
    CarmenScan,
    nanos,
    pose_within,
)
from gateway.rosbag.matlab import START, matrices
from gateway.rosbag.topic import Head, Message, Topic
from protocols.messages import SECOND, Nanos

TIMES = ("t", "time", "stamp", "timestamp", "time_s", "seconds", "sec")
HEADINGS = ("yaw", "theta", "heading", "th")
SPEEDS, TURNS = ("v", "linear", "speed", "vx"), ("w", "omega", "angular", "yaw_rate", "wz")
LONGEST = 200_000
"""Characters of a line"""


class _Ticks(NamedTuple):
    """The robot of the layout "ticks": BreezySLAM:examples/mines.py, and its lidar, a URG-04LX."""

    first: int = 24
    """The scan's first column"""
    beams: int = 682
    radius: float = 0.077
    """m"""
    separation: float = 0.33
    """m, between the wheels"""
    turn: int = 2000
    """Ticks"""
    view: float = math.radians(240.0)
    ahead: float = 0.145
    """m from the axle to the lidar"""
    farthest: float = 5.6
    """m"""


ROBOT = _Ticks()
TICKS, TRUTH, SCAN = "ticks", "GT", "scan"


def layout(path: Path) -> str:
    """Return the layout of a file, or "" if it has none that is known."""
    if not path.is_file():
        return ""
    try:
        with path.open("rb") as file:
            start = file.read(len(START))
        if start == START:
            return "range-only" if {"DR", "GT"} <= matrices(path).keys() else ""
        with path.open(encoding="ascii") as text:
            first, second = text.readline(LONGEST), text.readline(LONGEST)
    except (OSError, ValueError, BagError):
        return ""
    if _columns(first) is not None and _numbers(second.replace(",", " ").split()) is not None:
        return "by names"
    row = _numbers(first.split())
    return "ticks" if row is not None and len(row) >= ROBOT.first + ROBOT.beams else ""


def _numbers(fields: Sequence[str]) -> list[float] | None:
    try:
        return list(map(float, fields)) if fields else None
    except ValueError:
        return None


def _columns(line: str) -> dict[str, int] | None:
    """Return where time and motion stand, by the names in a line; None if it names none."""
    names = [one.strip().strip('"#').strip().lower() for one in line.split(",")]
    at = {name: i for i, name in reversed(list(enumerate(names)))}

    def of(*known: str) -> int | None:
        return next((at[name] for name in known if name in at), None)

    found = {"t": of(*TIMES), "x": of("x"), "y": of("y"), "yaw": of(*HEADINGS)}
    if None in found.values():
        found = {"t": of(*TIMES), "v": of(*SPEEDS), "w": of(*TURNS)}
    return None if None in found.values() else {key: i for key, i in found.items() if i is not None}


class Table:
    """A table of a known layout."""

    remark = ""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics, by name."""
        found: dict[str, Topic] = {}
        for name, kind, _ in self._all(scans=False):
            found.setdefault(name, Topic(name, kind, 0)).count += 1
        return found

    def messages(self, whole: Collection[str], heads: Collection[str] = ()) -> Iterator[Message]:
        """Yield the messages of some topics, and of others the heads alone."""
        for name, _, message in self._all(scans=SCAN in whole):
            t = 0 if isinstance(message, str) else message.t
            if name in whole:
                yield name, t, message
            elif name in heads:
                at = Pose(ROBOT.ahead, 0.0, 0.0) if name == SCAN else None
                yield name, t, Head(t, "", at)

    def _all(self, *, scans: bool) -> Iterator[tuple[str, str, Any]]:
        """Yield topic, type and message. `scans`: with their ranges. Raises BagError."""
        try:
            if self._kind == "range-only":
                yield from self._range_only()
            elif self._kind == "ticks":
                yield from self._ticks(scans=scans)
            else:
                yield from self._by_names()
        except ValueError as error:
            raise BagError(f"{self._path}: damaged: {error}") from error

    def _range_only(self) -> Iterator[tuple[str, str, Any]]:
        found = matrices(self._path)
        pose = Pose(0.0, 0.0, 0.0)
        for t, way, turn in _rows(self._path, found["DR"], 3):
            pose = arc(pose, way, turn)
            yield ODOMETRY, POSE_TYPE, CarmenPose(_nanos(t), pose)
        for t, x, y, yaw in _rows(self._path, found["GT"], 4):
            yield TRUTH, POSE_TYPE, CarmenPose(_nanos(t), pose_within(x, y, yaw))
        for name, rows in found.items():
            if name not in ("DR", "GT"):
                yield from ((name, "a row of numbers", DAMAGED) for _ in range(len(rows)))

    def _ticks(self, *, scans: bool) -> Iterator[tuple[str, str, Any]]:
        pose, before = Pose(0.0, 0.0, 0.0), None
        roll = math.tau * ROBOT.radius / ROBOT.turn
        for row in self._lines(" "):
            if row is None or len(row) < ROBOT.first + ROBOT.beams:
                yield ODOMETRY, POSE_TYPE, DAMAGED
                continue
            t = nanos(row[0], 1000)
            if before is not None:
                left, right = ((row[i] - before[i]) * roll for i in (2, 3))
                pose = arc(pose, (left + right) / 2.0, (right - left) / ROBOT.separation)
            before = row[:4]
            yield ODOMETRY, POSE_TYPE, CarmenPose(t, pose)
            ranges: tuple[float, ...] = ()
            if scans:  # a range of 0: nothing came back
                beams = row[ROBOT.first : ROBOT.first + ROBOT.beams]
                ranges = tuple(one / 1e3 if one else ROBOT.farthest for one in beams)
            step = ROBOT.view / (ROBOT.beams - 1)
            yield SCAN, SCAN_TYPE, CarmenScan(t, -ROBOT.view / 2.0, step, ROBOT.farthest, ranges)

    def _by_names(self) -> Iterator[tuple[str, str, Any]]:
        rows = self._lines(",")
        with self._path.open(encoding="utf-8", errors="replace") as text:
            at = _columns(text.readline(LONGEST))
        next(rows, None)
        pose, before = Pose(0.0, 0.0, 0.0), None
        for row in rows:
            if at is None or row is None or len(row) <= max(at.values()):
                yield ODOMETRY, POSE_TYPE, DAMAGED
                continue
            t = _nanos(row[at["t"]])
            if "yaw" in at:
                pose = pose_within(row[at["x"]], row[at["y"]], row[at["yaw"]])
            else:
                if before is not None:
                    dt = max(t - before[0], 0) / SECOND
                    pose = arc(pose, before[1] * dt, before[2] * dt)
                before = t, row[at["v"]], row[at["w"]]
            yield ODOMETRY, POSE_TYPE, CarmenPose(t, pose)

    def _lines(self, comma: str) -> Iterator[list[float] | None]:
        """Yield the numbers of every line; None for one that holds something else."""
        with self._path.open(encoding="utf-8", errors="replace") as file:
            while line := file.readline(LONGEST):
                fields = line.replace(comma, " ").split()
                if not fields:
                    continue
                row = _numbers(fields)
                yield row if row is not None and all(map(math.isfinite, row)) else None


def _rows(path: Path, table: Floats, width: int) -> Iterator[list[float]]:
    if table.ndim != 2 or table.shape[1] < width:
        raise BagError(f"{path}: a table of shape {table.shape}, expected {width} columns")
    rows = np.asarray(table, dtype=np.float64)[:, :width]
    if not np.isfinite(rows).all():
        raise BagError(f"{path}: a number in it is not finite")
    yield from rows.tolist()


def _nanos(t: float) -> Nanos:
    """Return a time in nanoseconds. It was written in s; of the epoch, also in ms, µs or ns."""
    unit = next((unit for unit in (1, 1_000, 1_000_000) if t >= 1e17 / unit), SECOND)
    return nanos(t, unit)
