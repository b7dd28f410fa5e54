"""What a path is judged by: true positions or poses at some times, or relations between poses.

Rules. A truth names the times at which the path is needed, and compares what was believed then. Positions
are compared after alignment (`gateway.rosbag.trajectory_error`). Relations are compared one by one, without
any: the believed pose at the second time, in the frame of that at the first, against the stated one; the mean
over all, as of R. Kümmerle et al. 2009, "On measuring the accuracy of SLAM algorithms", and over those whose
times are close. A truth from a file is a path in the TUM format (`t x y z qx qy qz qw`) or such relations
(`t1 t2 x y z roll pitch yaw`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from gateway.errors import BagError
from gateway.rosbag.convert import TruePose, Truth
from gateway.rosbag.trajectory_error import MIN_PAIRS, PathError, east_north, path_error, spread
from protocols.messages import SECOND, Fix, Nanos

MIN_EXTENT = 1.0
"""m: a truth that stays within this of its centre has not moved, and proves nothing."""
CLOSE: Nanos = 30 * SECOND
"""Between the two times of a close relation."""
ROUNDED: Nanos = 10_000
"""Stamps in seconds, of digits down to 1 µs; in a log the next odometry may follow a scan by 0.3 ms"""
FILE_FIELDS = 8


@dataclass(frozen=True, slots=True)
class RelationError:
    """How a path differs from relations: m, rad."""

    count: int
    mean: float
    median: float
    mean_turn: float
    close: int
    """Relations between times that are close, and their means"""
    close_mean: float
    close_turn: float


Paths = Mapping[str, Sequence[Pose | None]]
"""By name: the pose at each of the truth's times; None before the first estimate."""


# -- positions -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Positions:
    """True positions, or poses, in order of time."""

    truth: tuple[Truth, ...]
    slack: Nanos = 0

    @property
    def what(self) -> str:
        """What they are, in words."""
        return "fixes" if any(isinstance(one, Fix) for one in self.truth) else "poses"

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def times(self) -> list[Nanos]:
        """When they were measured."""
        return [one.t for one in self.truth]

    def errors(self, paths: Paths) -> tuple[dict[str, PathError], float, int]:
        """Return the error of each path, how far the truth goes from its centre, and how many were early."""
        known = [i for i in range(len(self.truth)) if all(path[i] is not None for path in paths.values())]
        if len(known) < MIN_PAIRS:
            return {}, 0.0, len(self.truth) - len(known)
        there = positions([self.truth[i] for i in known])
        errors = {}
        for name, path in paths.items():
            at = [path[i] or Pose(0.0, 0.0, 0.0) for i in known]
            errors[name] = path_error(np.array([(one.x, one.y) for one in at]), there)
        return errors, spread(there), len(self.truth) - len(known)


def positions(truth: Sequence[Truth]) -> Floats:
    """Return where the robot truly was: n × 2, m."""
    fixes = [one for one in truth if isinstance(one, Fix)]
    if fixes:
        return east_north(fixes)
    return np.array([(one.pose.x, one.pose.y) for one in truth if isinstance(one, TruePose)]).reshape(-1, 2)


# -- relations -----------------------------------------------------------------------------------


class Relation(NamedTuple):
    """Where the robot was at a later time, in its frame at the first."""

    first: Nanos
    second: Nanos
    pose: Pose


@dataclass(frozen=True)
class Relations:
    """Relations between poses that people verified."""

    relations: tuple[Relation, ...]
    slack: Nanos = ROUNDED
    """What was measured so much later still counts: their stamps are rounded."""
    what: ClassVar[str] = "relations between poses"

    def __len__(self) -> int:
        return len(self.relations)

    @property
    def times(self) -> list[Nanos]:
        """All times of relations, each once."""
        return sorted({t for one in self.relations for t in (one.first, one.second)})

    def errors(self, paths: Paths) -> dict[str, RelationError]:
        """Return the error of each path, over the relations whose poses all of them have."""
        at = {t: i for i, t in enumerate(self.times)}
        pairs = [(at[one.first], at[one.second], one) for one in self.relations]
        known = [
            pair
            for pair in pairs
            if all(path[pair[0]] is not None and path[pair[1]] is not None for path in paths.values())
        ]
        return {name: _relation_error(path, known) for name, path in paths.items()} if known else {}


def _relation_error(path: Sequence[Pose | None], pairs: Sequence[tuple[int, int, Relation]]) -> RelationError:
    apart, turned, close = [], [], []
    for first, second, one in pairs:
        a, b = path[first], path[second]
        if a is None or b is None:
            continue
        c, s = math.cos(a.yaw), math.sin(a.yaw)
        dx, dy = b.x - a.x, b.y - a.y
        apart.append(math.hypot(c * dx + s * dy - one.pose.x, c * dy - s * dx - one.pose.y))
        turned.append(abs(wrap(b.yaw - a.yaw - one.pose.yaw)))
        close.append(abs(one.second - one.first) <= CLOSE)
    near = [i for i, is_close in enumerate(close) if is_close]
    return RelationError(
        len(apart),
        _mean(apart),
        float(np.median(apart)),
        _mean(turned),
        len(near),
        _mean([apart[i] for i in near]),
        _mean([turned[i] for i in near]),
    )


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


# -- files ---------------------------------------------------------------------------------------


def read_truth(path: Path) -> Positions | Relations:
    """Read a truth from a file. Raises BagError with what is wrong with it."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            rows = list(_rows(path, file))
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not rows:
        raise BagError(f"{path}: it holds no numbers; {EXPECTED}")
    table = np.array(rows)
    quaternions = np.abs((table[:, 4:] ** 2).sum(axis=1) - 1.0) < 1e-2
    if quaternions.all():
        by_time = {row[0]: _of_tum(row) for row in rows}
        return Positions(tuple(by_time[t] for t in sorted(by_time)))
    relations = tuple(Relation(_nanos(row[0]), _nanos(row[1]), Pose(row[2], row[3], row[7])) for row in rows)
    return Relations(relations)


EXPECTED = (
    "expected lines of 8 numbers: a path (t x y z qx qy qz qw, as of TUM), or relations between poses "
    "(t1 t2 x y z roll pitch yaw)"
)


def _rows(path: Path, lines: Iterable[str]) -> Iterable[list[float]]:
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            row = list(map(float, fields))
        except ValueError:
            row = []
        if len(row) != FILE_FIELDS or not all(map(math.isfinite, row)) or abs(row[0]) > 1e10:
            raise BagError(f"{path}:{number}: found {line.strip()[:60]!r}; {EXPECTED}")
        yield row


def _of_tum(row: Sequence[float]) -> TruePose:
    t, x, y, _, qx, qy, qz, qw = row
    yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return TruePose(_nanos(t), Pose(x, y, yaw))


def _nanos(t: float) -> Nanos:
    return round(t * SECOND)
