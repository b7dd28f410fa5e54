"""The stop zone by itself: contact times against sampled motion, and a base that drives on what it allows."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from math import cos, hypot, inf, nan, pi, sin

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.bodies.base_profile import approach
from brain.bodies.plane import Commanded, Twist, arc
from brain.perception.mount import Mount
from brain.planning.outline import Outline
from brain.planning.stop_zone import MAX_POINTS, StopSettings, StopZone
from protocols.messages import MILLISECOND, LaserScan, Nanos, seconds
from tests.brain.control.ride import jerk
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


def moved(points: Floats, twist: Twist, t: float) -> Floats:
    """Points (n × 2) as seen after driving for t [s]."""
    there = arc(Pose(0.0, 0.0, 0.0), twist.linear * t, twist.angular * t, twist.lateral * t)
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
        twist = (Twist(v), Twist(0.0, w), Twist(v, w), Twist(v, w, -0.7 * v), Twist(0.0, 0.0, v))[case % 5]
        gap = min(0.05, float(outside(corners, points).min()))
        time, grown = Outline(body).contact(points.T, twist, 0.05)
        assert grown == pytest.approx(gap, abs=2e-6)
        steps = np.arange(0.0, min(time, 2.0), 0.005)
        assert min(outside(corners, moved(points, twist, t)).min() for t in steps) > gap - 1e-5
        if time < 60.0:
            met += 1
            assert outside(corners, moved(points, twist, time)).min() == pytest.approx(gap, abs=1e-5)
    assert 50 < met < 120


class Walker:
    """A person, as a disc that goes straight on."""

    def __init__(self, x: float, y: float, vx: float, vy: float, sigma: float = 0.0) -> None:
        self.x, self.y, self.vx, self.vy, self.radius, self.sigma = x, y, vx, vy, 0.25, sigma

    def step(self, dt: float) -> None:
        self.x, self.y = self.x + self.vx * dt, self.y + self.vy * dt


class Base:
    """A base between walls, whose wheels follow with a delay of 60 ms. Its clearance is that of the truth."""

    def __init__(self, walls: Walls, pose: Pose = Pose(0.0, 0.0, 0.0), **settings: float) -> None:  # noqa: B008  # frozen
        self.walls, self.pose, self.now = np.array(walls or box(90, 90, 91, 91)), pose, SCAN
        self.mounts = {"front": FRONT, "rear": REAR}
        self.fields = {"front": 2.0 * pi}
        """Angle that each lidar sees [rad]"""
        self.sweep: Nanos = 0
        """Of a scan; negative: clockwise, its first beam is the newest"""
        self.zone = StopZone(ROBOT, self.mounts, StopSettings(**settings))  # type: ignore[arg-type]  # numbers
        self.random = np.random.Generator(np.random.PCG64(1))
        self.commanded = Commanded()
        self.delayed = [self.twist] * 6
        self.track = [self.twist]
        self.nearest, self.reasons = inf, [""]
        self.walkers: list[Walker] = []
        self.struck: list[float] = []
        """The most that a corner moved [m/s] in each step in which a walker touched it"""
        dense = [np.linspace((a, b), (c, d), 150) for a, b, c, d in self.walls]
        self.dense = np.concatenate(dense)

    @property
    def twist(self) -> Twist:
        return self.commanded.twist

    def scan(self, name: str = "front", count: int = 360) -> LaserScan:
        """The scan that ends now, of a base that has moved during the sweep as it does now."""
        mount, field = self.mounts[name], self.fields[name]
        angles = np.asarray(-field / 2.0 + field / count * np.arange(count), dtype=np.float64)
        read = np.empty(count)
        for beams in np.array_split(np.arange(count), 12 if self.sweep else 1):
            share = float(beams.mean()) / (count - 1)
            ago = seconds(self.sweep) * (1.0 - share) if self.sweep > 0 else -seconds(self.sweep) * share
            lidar = arc(
                self.pose,
                *(
                    -ago * v
                    for v in (self.delayed[0].linear, self.delayed[0].angular, self.delayed[0].lateral)
                ),
            )
            lidar = arc(lidar, mount.x, 0.0)
            read[beams] = ranges(self.walls, lidar.x, lidar.y, lidar.yaw + mount.yaw + angles[beams], 10.0)
        read += self.random.normal(0.0, 0.003, count) * (read < 10.0)
        begin = self.now - max(self.sweep, 0)
        return LaserScan(
            name, begin, angles[0], field / count, 0.05, 10.0, tuple(map(float, read)), self.sweep
        )

    def drive(self, ask: tuple[float, ...], span: float, look: bool = True) -> None:
        """Drive for this time [s], with scans at 10 Hz, as far as the zone allows."""
        wanted = Twist(*ask)
        for _ in range(round(span / seconds(STEP))):
            self.now += STEP
            v, w, side = self.delayed.pop(0).scaled(seconds(STEP))
            self.pose = arc(self.pose, v, w, side)
            for walker in self.walkers:
                walker.step(seconds(STEP))
            events = [self.scan(name) for name in self.fields if look and self.now % SCAN == 0]
            self.zone.observe(self.now, self.pose, events, self.walkers)
            desired = approach(self.commanded, wanted, seconds(STEP), ROBOT)
            self.commanded = self.zone.allowed(self.commanded, desired, wanted, seconds(STEP))
            self.track.append(self.twist)
            self.delayed.append(self.twist)
            if self.zone.reason != self.reasons[-1]:
                self.reasons.append(self.zone.reason)
            if look:
                self.nearest = min(self.nearest, self.clearance())
            for walker in self.walkers:
                c, s = cos(self.pose.yaw), sin(self.pose.yaw)
                x, y = walker.x - self.pose.x, walker.y - self.pose.y
                place = np.array([[c * x + s * y, c * y - s * x]])
                if outside(np.array(OBLONG), place)[0] < walker.radius:
                    now = self.delayed[0]
                    self.struck.append(now.speed + hypot(0.2, 0.1) * abs(now.angular))

    def clearance(self) -> float:
        c, s = cos(self.pose.yaw), sin(self.pose.yaw)
        x, y = self.dense[:, 0] - self.pose.x, self.dense[:, 1] - self.pose.y
        return float(outside(np.array(OBLONG), np.stack([c * x + s * y, c * y - s * x], axis=1)).min())


WALL = box(1.0, -2.0, 1.1, 2.0)


@pytest.mark.sample(5)
@pytest.mark.parametrize(
    ("walls", "wanted", "sweep"),
    [
        (WALL, (0.6, 0.0), 0),
        (WALL, (0.6, 0.0), 90 * MILLISECOND),
        (WALL, (0.5, 0.35), 90 * MILLISECOND),
        (WALL, (0.6, 0.0), -90 * MILLISECOND),
        (WALL, (0.5, 0.35), -90 * MILLISECOND),
        (box(-0.5, -0.2, 0.5, -0.15), (0.0, -1.5), -90 * MILLISECOND),
        (box(-1.1, -2.0, -1.0, 2.0), (-0.6, 0.0), 0),
        (box(-1.1, -2.0, -1.0, 2.0), (-0.5, 0.2), 0),
        (box(-0.5, 0.15, 0.5, 0.2), (0.0, 1.5), 0),
        (box(-0.5, -0.2, 0.5, -0.15), (0.0, -1.5), 90 * MILLISECOND),
        (box(0.8, -0.025, 0.85, 0.025), (0.5, 0.0), 0),
        (box(0.8, 0.11, 0.85, 0.16), (0.5, 0.0), 0),
        (box(-1.0, 0.9, 1.0, 1.0), (0.0, 0.0, 0.5), 90 * MILLISECOND),
        (box(-1.0, -1.0, 1.0, -0.9), (0.3, 0.0, -0.4), 0),
    ],
)
def test_it_stops_before_what_the_footprint_would_meet(
    walls: Walls, wanted: tuple[float, ...], sweep: Nanos
) -> None:
    """Straight, on arcs and on the spot, where the corners sweep; poles; lidars that take time for a scan."""
    base = Base(walls)
    base.sweep = sweep
    base.drive((0.0, 0.0), 0.3)
    base.drive(wanted, 5.0)
    assert (0.005 if wanted[1] else 0.04) < base.nearest < 0.075
    assert any(reason.endswith("slow" if wanted[1] else "standing") for reason in base.reasons)
    for limit, values in zip((10.0, 50.0, 10.0), zip(*base.track, strict=True), strict=True):
        assert jerk(values, seconds(STEP)) <= limit + 1e-6
    if not all(wanted[:2]):  # on an arc it turns away, slowly, and goes on along the wall
        assert sum(map(abs, base.twist)) < 0.01


@pytest.mark.parametrize("wanted", [(0.6, 0.0), (0.6, 0.5), (0.0, 2.0), (-0.6, -0.5)])
@pytest.mark.parametrize("walls", [[], box(-3.0, 0.18, 3.0, 0.2)[:1] + box(-3.0, -0.2, 3.0, -0.18)[2:3]])
def test_what_is_beside_the_way_slows_nothing(walls: Walls, wanted: tuple[float, float]) -> None:
    """In the open, and straight on between two walls with 6 cm on either side."""
    base = Base(walls)
    base.drive((0.0, 0.0), 0.3)
    if not walls or not wanted[1]:
        base.drive(wanted, 1.0)
        assert base.twist[:2] == wanted


@pytest.mark.parametrize(
    ("wanted", "free"),
    [
        (Twist(0.1), False),
        (Twist(-0.1), True),
        (Twist(0.0, 1.0), False),
        (Twist(0.0, 0.0, -0.1), True),
        (Twist(), True),
    ],
)
def test_within_the_gap_only_what_comes_no_nearer_is_allowed(wanted: Twist, free: bool) -> None:
    """A wall 2 cm ahead and one 3 cm to the left: back, along it, but no turn that brings a corner nearer."""
    base = Base(box(0.22, -2.0, 0.3, 2.0) + box(-2.0, 0.15, 0.3, 0.2), turn_gap=0.05)
    base.drive((0.0, 0.0), 0.3)
    base.random = np.random.Generator(np.random.PCG64(2))
    base.drive(tuple(wanted), 1.0, look=False)
    assert base.twist == wanted if free else sum(map(abs, base.twist)) < 0.015


def test_a_base_that_stands_before_a_wall_can_turn_away_slowly_and_leave() -> None:
    base = Base(WALL)
    base.drive((0.5, 0.0), 4.0)
    stood = base.clearance()
    base.drive((0.3, 1.0), 5.0)
    assert 0.005 < base.nearest < stood
    assert base.pose.yaw > 1.0
    base.drive((0.5, 0.5), 1.5)
    assert base.twist == Twist(0.5, 0.5)


FULL = Twist(0.5)


def beams(zone: StopZone, t: Nanos, **short: float) -> Twist:
    """Allowed of 0.5 m/s after a scan that reads 10 m, but for the beams named b170=0.2 (180 is ahead)."""
    read = [10.0] * 360
    for name, value in short.items():
        read[int(name[1:])] = value
    scan = LaserScan("front", t, -pi, pi / 180.0, 0.05, 10.0, tuple(read))
    zone.observe(t, Pose(0.0, 0.0, 0.0), [scan])
    return zone.allowed(Commanded(FULL), Commanded(FULL), FULL, 0.01).twist


def test_one_beam_alone_is_speckle_until_it_is_there_again() -> None:
    zone = StopZone(ROBOT, {"front": FRONT}, StopSettings())
    assert beams(zone, SCAN, b180=0.3) == FULL
    assert beams(zone, 2 * SCAN, b155=0.3) == FULL
    assert beams(zone, 3 * SCAN, b155=0.3, b154=0.0) < FULL
    assert beams(zone, 4 * SCAN) < FULL  # what is gone may be a lost reading,
    assert beams(zone, 5 * SCAN) == FULL  # and is forgotten with the next scan
    assert beams(zone, 6 * SCAN, b180=0.3, b182=0.3) < FULL


def test_many_beams_alone_are_no_speckle() -> None:
    """Ranges of which no neighbours agree, as of a hedge or a defect: the step stays short, and it stops."""
    zone = StopZone(ROBOT, {"front": FRONT}, StopSettings())
    assert beams(zone, SCAN) == FULL
    assert beams(zone, 2 * SCAN, **{f"b{i}": 0.3 + 0.2 * (i % 3) for i in range(360)}) < FULL


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
    assert beams(zone, SCAN, **own) == FULL
    assert beams(zone, 2 * SCAN, **own) == FULL
    [note] = zone.take_notes()
    assert note.startswith("front: 21 beams end within the footprint: they are ignored")
    margin = StopZone(ROBOT, {"front": FRONT}, StopSettings(self_seen=0.03))
    near = dict.fromkeys(own, 0.1)
    assert beams(margin, SCAN, **near) == FULL
    assert beams(zone, 3 * SCAN, **near) < FULL


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
def test_only_creeping_where_no_lidar_looks(
    fields: dict[str, float], wanted: tuple[float, ...], speed: float
) -> None:
    base = Base([])
    base.fields = fields
    base.drive((0.0, 0.0), 0.2)
    base.drive(wanted, 1.0)
    assert base.twist == pytest.approx((speed, *wanted[1:]) if len(wanted) > 2 else (speed, wanted[1], 0.0))
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
    base.drive(FULL, 0.3, look=False)
    other = copy.deepcopy(base)
    base.zone.observe(base.now, base.pose, [replace(base.scan(), **{"t": base.now + 1} | change)])  # type: ignore[arg-type]  # wrong on purpose
    for one in (base, other):
        one.drive(FULL, 0.1, look=False)
    assert 0.0 < base.twist.linear < 0.5
    assert base.twist == other.twist


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
    base.drive(FULL, 0.5, look=False)
    assert base.twist == pytest.approx(Twist(0.1))
    assert base.zone.reason == "no lidar looks ahead: slow"


def test_its_work_is_bounded_and_a_copy_goes_on_alike() -> None:
    base = Base(box(0.5, -2.0, 0.6, 2.0))
    for _ in range(3):
        base.now += SCAN
        base.zone.observe(base.now, base.pose, [base.scan(count=4000)])
    sizes = [len(values) for values in vars(base.zone).values() if isinstance(values, np.ndarray)]
    points = vars(base.zone)["_points"]
    assert sizes == [2, 6, 2]
    assert MAX_POINTS < points.shape[1] <= 2 * MAX_POINTS
    other = copy.deepcopy(base)
    for one in (base, other):
        one.drive((0.4, 0.1), 1.0)
    assert (base.twist, base.pose, base.reasons) == (other.twist, other.pose, other.reasons)


@pytest.mark.sample(3)
@pytest.mark.parametrize("wanted", [(0.6, 0.0), (0.4, 0.6), (0.0, 0.0, 0.5), (0.0, 1.5)])
@pytest.mark.parametrize("speed", [0.3, 1.2])
def test_people_who_cross_are_not_touched_while_it_moves(speed: float, wanted: tuple[float, ...]) -> None:
    """From both sides, ahead and behind, at different moments; nothing but their motion is known of them."""
    struck, delayed = [], 0
    for side in (-1.0, 1.0):
        for when in (1.0, 2.0):
            base = Base([])
            there = arc(base.pose, *(v * when for v in Twist(*wanted)))
            base.walkers = [Walker(there.x + 0.2, there.y - side * speed * when, 0.0, side * speed)]
            base.drive(wanted, 3.0, look=False)
            struck += base.struck
            delayed += "obstacle" in "".join(base.reasons)
            base.walkers.clear()
            base.drive(wanted, 1.5, look=False)
            assert base.twist == pytest.approx(tuple(Twist(*wanted)), abs=1e-6)  # and it goes on
    assert max(struck, default=0.0) <= 0.05
    assert delayed


def test_who_walks_away_or_beside_slows_nothing() -> None:
    for walker in (Walker(0.8, 0.0, 0.8, 0.0), Walker(0.5, 0.6, 0.6, 0.0), Walker(-1.0, 1.0, 0.0, 1.0)):
        base = Base([])
        base.walkers = [walker]
        base.drive((0.5, 0.0), 1.0, look=False)
        assert base.twist == Twist(0.5)


@pytest.mark.parametrize(("ahead", "side"), [(2.2, 0.0), (1.2, 1.2), (1.0, -1.3)])
def test_who_has_just_appeared_may_come_from_anywhere(ahead: float, side: float) -> None:
    """Nothing is known of the velocity, which is 1.2 m/s towards the base; then it is: they stand."""
    base = Base([])
    base.drive((0.6, 0.0), 1.0, look=False)
    walker = Walker(base.pose.x + ahead, side, 0.0, 0.0, sigma=9.0)
    base.walkers = [walker]
    while not base.struck:
        far = hypot(walker.x - base.pose.x, walker.y - base.pose.y)
        walker.x += 0.06 * (base.pose.x - walker.x) / far
        walker.y += 0.06 * (base.pose.y - walker.y) / far
        base.drive((0.6, 0.0), 0.05, look=False)
    assert max(base.struck) <= 0.05
    walker.x, walker.y, walker.sigma = base.pose.x + 0.5, 0.6, 0.05
    base.drive((0.6, 0.0), 0.5, look=False)
    assert base.twist.linear > 0.3


@pytest.mark.parametrize("hidden_speed", [0.05, 20.0])
def test_before_a_door_frame_it_can_be_slow_enough_for_who_steps_out(hidden_speed: float) -> None:
    """At 1.2 m/s, when the base is just before the frame; behind it, it is as fast as ever."""
    base = Base(
        box(1.5, 0.55, 1.6, 3.0) + box(1.5, -3.0, 1.6, -0.55) + box(4.0, -3.0, 4.1, 3.0),
        hidden_speed=hidden_speed,
    )
    while base.pose.x < 1.1:
        base.drive((0.5, 0.0), 0.1)
    base.walkers = [Walker(base.pose.x + 0.45, 0.85, 0.0, -1.2)]
    base.drive((0.5, 0.0), 1.0, look=False)
    assert (max(base.struck, default=0.0) <= 0.05) is (hidden_speed < 1.0)
    base.walkers.clear()
    while base.pose.x < 1.9:
        base.drive((0.5, 0.0), 0.1)
    assert base.twist.linear > 0.4
