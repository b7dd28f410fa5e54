"""The stop zone by itself: contact times against sampled motion, and a base that drives on what it allows."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from math import cos, inf, nan, pi, sin

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.bodies.differential import arc
from brain.perception.mount import Mount
from brain.planning.outline import Outline
from brain.planning.stop_zone import MAX_POINTS, StopSettings, StopZone, Velocity
from protocols.messages import MILLISECOND, LaserScan, Nanos, seconds
from tests.brain.helpers import BODY
from tests.brain.perception.office import box, ranges

OBLONG = ((0.2, 0.1), (0.05, 0.12), (-0.05, 0.12), (-0.2, 0.1), (-0.2, -0.1), (0.0, -0.12), (0.2, -0.1))
ROBOT = replace(BODY, footprint=OBLONG)
ARROW = replace(BODY, footprint=((0.25, 0.0), (-0.2, 0.12), (-0.2, -0.12)))
FRONT, REAR = Mount(x=0.12), Mount(x=-0.12, yaw=pi)
SCAN, STEP = 100 * MILLISECOND, 10 * MILLISECOND
Walls = list[tuple[float, float, float, float]]


def outside(corners: Floats, points: Floats) -> Floats:
    """By how much each point (n × 2) is outside of the polygon's farthest edge [m]."""
    edges = np.roll(corners, -1, axis=0) - corners
    across = points[:, None] - corners
    cross = edges[:, 1] * across[..., 0] - edges[:, 0] * across[..., 1]
    most: Floats = (cross / np.hypot(edges[:, 0], edges[:, 1])).max(axis=1)
    return most


def moved(points: Floats, v: float, w: float, t: float) -> Floats:
    """Points (n × 2) as seen after driving for t [s]."""
    there = arc(Pose(0.0, 0.0, 0.0), v * t, w * t)
    x, y = (points - (there.x, there.y)).T
    c, s = cos(there.yaw), sin(there.yaw)
    return np.stack([c * x + s * y, c * y - s * x], axis=1)


def test_the_first_contact_is_that_of_the_motion_in_small_steps() -> None:
    random, met = np.random.Generator(np.random.PCG64(3)), 0
    for case in range(120):
        body = (ROBOT, BODY, ARROW, ROBOT)[case % 4]
        corners = np.array(body.outline)
        points = random.uniform(-0.8, 0.8, (random.integers(1, 40), 2))
        points = points[outside(corners, points) > 0.0]
        v, w = random.uniform(-1.0, 1.0), random.uniform(-2.0, 2.0)
        v, w = ((v, 0.0), (0.0, w), (v, w))[case % 3]
        gap = min(0.05, float(outside(corners, points).min()))
        time, grown = Outline(body).contact(points.T, v, w, 0.05)
        assert grown == pytest.approx(gap, abs=2e-6)
        steps = np.arange(0.0, min(time, 2.0), 0.005)
        assert min(outside(corners, moved(points, v, w, t)).min() for t in steps) > gap - 1e-5
        if time < 60.0:
            met += 1
            assert outside(corners, moved(points, v, w, time)).min() == pytest.approx(gap, abs=1e-5)
    assert 50 < met < 120


class Base:
    """A base between walls, whose wheels follow with a delay of 60 ms. Its clearance is that of the truth."""

    def __init__(self, walls: Walls, pose: Pose = Pose(0.0, 0.0, 0.0), **settings: float) -> None:  # noqa: B008  # frozen
        self.walls, self.pose, self.now = np.array(walls or box(90, 90, 91, 91)), pose, SCAN
        self.mounts = {"front": FRONT, "rear": REAR}
        self.fields = {"front": 2.0 * pi}
        """Angle that each lidar sees [rad]"""
        self.sweep: Nanos = 0
        self.zone = StopZone(ROBOT, self.mounts, StopSettings(**settings))  # type: ignore[arg-type]  # numbers
        self.random = np.random.Generator(np.random.PCG64(1))
        self.twist = (0.0, 0.0)
        self.delayed = [self.twist] * 6
        self.nearest, self.reasons = inf, [""]
        dense = [np.linspace((a, b), (c, d), 150) for a, b, c, d in self.walls]
        self.dense = np.concatenate(dense)

    def scan(self, name: str = "front", count: int = 360) -> LaserScan:
        """The scan that ends now, of a base that has moved during the sweep as it does now."""
        mount, field = self.mounts[name], self.fields[name]
        angles = np.asarray(-field / 2.0 + field / count * np.arange(count), dtype=np.float64)
        read = np.empty(count)
        for beams in np.array_split(np.arange(count), 12 if self.sweep else 1):
            ago = seconds(self.sweep) * (1.0 - float(beams.mean()) / (count - 1)) if self.sweep else 0.0
            lidar = arc(self.pose, -self.delayed[0][0] * ago, -self.delayed[0][1] * ago)
            lidar = arc(lidar, mount.x, 0.0)
            read[beams] = ranges(self.walls, lidar.x, lidar.y, lidar.yaw + mount.yaw + angles[beams], 10.0)
        read += self.random.normal(0.0, 0.003, count) * (read < 10.0)
        begin = self.now - self.sweep
        return LaserScan(
            name, begin, angles[0], field / count, 0.05, 10.0, tuple(map(float, read)), self.sweep
        )

    def drive(self, wanted: Velocity, span: float, look: bool = True) -> None:
        """Drive for this time [s], with scans at 10 Hz, as far as the zone allows."""
        for _ in range(round(span / seconds(STEP))):
            self.now += STEP
            v, w = self.delayed.pop(0)
            self.pose = arc(self.pose, v * seconds(STEP), w * seconds(STEP))
            events = [self.scan(name) for name in self.fields if look and self.now % SCAN == 0]
            self.zone.observe(self.now, self.pose, events)
            self.twist = self.zone.allowed(self.twist, wanted, wanted, seconds(STEP))
            self.delayed.append(self.twist)
            if self.zone.reason != self.reasons[-1]:
                self.reasons.append(self.zone.reason)
            self.nearest = min(self.nearest, self.clearance())

    def clearance(self) -> float:
        c, s = cos(self.pose.yaw), sin(self.pose.yaw)
        x, y = self.dense[:, 0] - self.pose.x, self.dense[:, 1] - self.pose.y
        return float(outside(np.array(OBLONG), np.stack([c * x + s * y, c * y - s * x], axis=1)).min())


WALL = box(1.0, -2.0, 1.1, 2.0)


@pytest.mark.parametrize(
    ("walls", "wanted", "sweep"),
    [
        (WALL, (0.6, 0.0), 0),
        (WALL, (0.6, 0.0), 90 * MILLISECOND),
        (WALL, (0.5, 0.35), 90 * MILLISECOND),
        (box(-1.1, -2.0, -1.0, 2.0), (-0.6, 0.0), 0),
        (box(-1.1, -2.0, -1.0, 2.0), (-0.5, 0.2), 0),
        (box(-0.5, 0.15, 0.5, 0.2), (0.0, 1.5), 0),
        (box(-0.5, -0.2, 0.5, -0.15), (0.0, -1.5), 90 * MILLISECOND),
        (box(0.8, -0.025, 0.85, 0.025), (0.5, 0.0), 0),
        (box(0.8, 0.11, 0.85, 0.16), (0.5, 0.0), 0),
    ],
)
def test_it_stops_before_what_the_footprint_would_meet(walls: Walls, wanted: Velocity, sweep: Nanos) -> None:
    """Straight, on arcs and on the spot, where the corners sweep; poles; lidars that take time for a scan."""
    base = Base(walls)
    base.sweep = sweep
    base.drive((0.0, 0.0), 0.3)
    base.drive(wanted, 5.0)
    assert (0.005 if wanted[1] else 0.04) < base.nearest < 0.075
    assert any(reason.endswith("slow" if wanted[1] else "standing") for reason in base.reasons)
    if not all(wanted):  # on an arc it turns away, slowly, and goes on along the wall
        assert abs(base.twist[0]) + abs(base.twist[1]) < 0.01


@pytest.mark.parametrize("wanted", [(0.6, 0.0), (0.6, 0.5), (0.0, 2.0), (-0.6, -0.5)])
@pytest.mark.parametrize("walls", [[], box(-3.0, 0.18, 3.0, 0.2)[:1] + box(-3.0, -0.2, 3.0, -0.18)[2:3]])
def test_what_is_beside_the_way_slows_nothing(walls: Walls, wanted: Velocity) -> None:
    """In the open, and straight on between two walls with 6 cm on either side."""
    base = Base(walls)
    base.drive((0.0, 0.0), 0.3)
    if not walls or not wanted[1]:
        base.drive(wanted, 1.0)
        assert base.twist == wanted


@pytest.mark.parametrize(
    ("wanted", "free"),
    [
        ((0.1, 0.0), False),
        ((-0.1, 0.0), True),
        ((0.0, 1.0), False),
        ((0.0, 0.0), True),
    ],
)
def test_within_the_gap_only_what_comes_no_nearer_is_allowed(wanted: Velocity, free: bool) -> None:
    """A wall 2 cm ahead and one 3 cm to the left: back, along it, but no turn that brings a corner nearer."""
    base = Base(box(0.22, -2.0, 0.3, 2.0) + box(-2.0, 0.15, 0.3, 0.2), turn_gap=0.05)
    base.drive((0.0, 0.0), 0.3)
    base.random = np.random.Generator(np.random.PCG64(2))
    twist = base.zone.allowed((0.0, 0.0), wanted, wanted, 0.01)
    assert twist == (wanted if free else pytest.approx((0.0, 0.0), abs=0.005))


def test_a_base_that_stands_before_a_wall_can_turn_away_slowly_and_leave() -> None:
    base = Base(WALL)
    base.drive((0.5, 0.0), 4.0)
    stood = base.clearance()
    base.drive((0.3, 1.0), 5.0)
    assert 0.005 < base.nearest < stood
    assert base.pose.yaw > 1.0
    base.drive((0.5, 0.5), 1.5)
    assert base.twist == (0.5, 0.5)


def beams(zone: StopZone, t: Nanos, **short: float) -> Velocity:
    """Allowed of 0.5 m/s after a scan that reads 10 m, but for the beams named b170=0.2 (180 is ahead)."""
    read = [10.0] * 360
    for name, value in short.items():
        read[int(name[1:])] = value
    scan = LaserScan("front", t, -pi, pi / 180.0, 0.05, 10.0, tuple(read))
    zone.observe(t, Pose(0.0, 0.0, 0.0), [scan])
    return zone.allowed((0.5, 0.0), (0.5, 0.0), (0.5, 0.0), 0.01)


def test_one_beam_alone_is_speckle_until_it_is_there_again() -> None:
    zone = StopZone(ROBOT, {"front": FRONT}, StopSettings())
    assert beams(zone, SCAN, b180=0.3) == (0.5, 0.0)
    assert beams(zone, 2 * SCAN, b155=0.3) == (0.5, 0.0)
    assert beams(zone, 3 * SCAN, b155=0.3, b154=0.0) < (0.5, 0.0)
    assert beams(zone, 4 * SCAN) < (0.5, 0.0)  # what is gone may be a lost reading,
    assert beams(zone, 5 * SCAN) == (0.5, 0.0)  # and is forgotten with the next scan
    assert beams(zone, 6 * SCAN, b180=0.3, b182=0.3) < (0.5, 0.0)


def test_many_beams_alone_are_no_speckle() -> None:
    """Ranges of which no neighbours agree, as of a hedge or a defect: the step stays short, and it stops."""
    zone = StopZone(ROBOT, {"front": FRONT}, StopSettings())
    assert beams(zone, SCAN) == (0.5, 0.0)
    assert beams(zone, 2 * SCAN, **{f"b{i}": 0.3 + 0.2 * (i % 3) for i in range(360)}) < (0.5, 0.0)


def test_a_sweep_of_a_turning_lidar_is_straightened() -> None:
    base = Base(box(-0.9, -0.9, 0.9, 0.9))
    base.sweep = 90 * MILLISECOND
    base.drive((0.0, 1.5), 1.0)
    away = np.abs(np.abs(vars(base.zone)["_points"]).max(axis=0) - 0.9)
    assert len(away) > 100
    assert away.max() < 0.03


def test_the_robots_own_body_is_ignored_and_noted_once() -> None:
    zone, own = StopZone(ROBOT, {"front": FRONT}, StopSettings()), {f"b{i}": 0.1 for i in range(170, 191)}
    own = dict.fromkeys(own, 0.07)
    assert beams(zone, SCAN, **own) == (0.5, 0.0)
    assert beams(zone, 2 * SCAN, **own) == (0.5, 0.0)
    [note] = zone.take_notes()
    assert note.startswith("front: 21 beams end within the footprint: they are ignored")
    margin = StopZone(ROBOT, {"front": FRONT}, StopSettings(self_seen=0.03))
    near = dict.fromkeys(own, 0.1)
    assert beams(margin, SCAN, **near) == (0.5, 0.0)
    assert beams(zone, 3 * SCAN, **near) < (0.5, 0.0)


@pytest.mark.parametrize(
    ("fields", "wanted", "speed"),
    [
        ({"front": pi}, (-0.4, 0.0), -0.1),
        ({"front": pi}, (0.4, 0.0), 0.4),
        ({"front": pi}, (0.0, 1.0), 0.0),
        ({"rear": pi}, (0.4, 0.0), 0.1),
        ({"front": pi, "rear": pi}, (-0.4, 0.0), -0.4),
        ({"front": 2.0 * pi}, (-0.4, 0.0), -0.4),
        ({}, (-0.4, 0.0), -0.4),
    ],
)
def test_only_creeping_where_no_lidar_looks(fields: dict[str, float], wanted: Velocity, speed: float) -> None:
    base = Base([])
    base.fields = fields
    base.drive((0.0, 0.0), 0.2)
    base.drive(wanted, 1.0)
    assert base.twist == pytest.approx((speed, wanted[1]))
    assert base.zone.reason == ("" if speed == wanted[0] else base.reasons[1])
    assert (speed == wanted[0]) is (base.reasons == [""])


@pytest.mark.parametrize(
    "change",
    [
        {"ranges": ()},
        {"ranges": (0.3,) * 20_000},
        {"angle_min": inf},
        {"angle_increment": nan},
        {"range_max": nan},
        {"sensor": "other"},
        {"t": 0},
    ],
)
def test_what_is_no_scan_changes_nothing(change: dict[str, float | str | Sequence[float]]) -> None:
    base = Base(box(0.4, -2.0, 0.6, 2.0))
    base.drive((0.0, 0.0), 0.2)
    before = base.zone.allowed((0.0, 0.0), (0.5, 0.0), (0.5, 0.0), 0.01)
    base.zone.observe(base.now, base.pose, [replace(base.scan(), **{"t": base.now + 1} | change)])  # type: ignore[arg-type]  # wrong on purpose
    assert 0.0 < before[0] < 0.5
    assert base.zone.allowed((0.0, 0.0), (0.5, 0.0), (0.5, 0.0), 0.01) == before


def test_a_turn_may_come_nearer_than_a_drive_and_not_the_other_way_round() -> None:
    with pytest.raises(ValueError, match="gap must not be less than turn_gap"):
        StopSettings(turn_gap=0.1)


def test_numbers_that_are_no_ranges_are_no_readings() -> None:
    base = Base(box(0.4, -2.0, 0.6, 2.0))
    base.drive((0.0, 0.0), 0.2)
    for _ in range(2):
        base.now += SCAN
        scan = replace(base.scan(), ranges=(nan, inf, -inf, -1.0, 0.0) * 72)
        base.zone.observe(base.now, base.pose, [scan])
    assert base.zone.allowed((0.0, 0.0), (0.5, 0.0), (0.5, 0.0), 0.01) == pytest.approx((0.1, 0.0))
    assert base.zone.reason == "no lidar looks ahead: slow"


def test_its_work_is_bounded_and_a_copy_goes_on_alike() -> None:
    base = Base(box(0.5, -2.0, 0.6, 2.0))
    for _ in range(3):
        base.now += SCAN
        base.zone.observe(base.now, base.pose, [base.scan(count=4000)])
    sizes = [len(values) for values in vars(base.zone).values() if isinstance(values, np.ndarray)]
    points = vars(base.zone)["_points"]
    assert sizes == [2]
    assert MAX_POINTS < points.shape[1] <= 2 * MAX_POINTS
    other = copy.deepcopy(base)
    for one in (base, other):
        one.drive((0.4, 0.1), 1.0)
    assert (base.twist, base.pose, base.reasons) == (other.twist, other.pose, other.reasons)
