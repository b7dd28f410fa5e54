import copy
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from brain.belief import Pose
from brain.perception.consistency import Trust
from brain.perception.fixes import FixSettings
from brain.perception.map import MapSettings
from brain.perception.mount import Mount
from brain.perception.perception import Perception, PerceptionSettings
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Event,
    Feedback,
    Fix,
    Imu,
    LaserScan,
    Mode,
    Nanos,
    PoseReading,
    State,
)
from tests.brain.perception.office import (
    BODY,
    MOUNTS,
    OFFICE,
    SETTINGS,
    TOUR,
    Drive,
    Rover,
    box,
    classes,
    clearance,
    drive,
    ranges,
    scan_at,
)

MS = MILLISECOND
IMU_ONLY = {"imu": MOUNTS["imu"]}


def new(settings: PerceptionSettings = SETTINGS) -> Perception:
    return Perception(BODY, MOUNTS, settings)


def run(
    rover: Rover, perception: Perception, steps: int, linear: float = 0.0, angular: float = 0.0
) -> Perception:
    for i in range(steps):
        part = min(1.0, (i + 1) / 40)  # full speed after 0.2 s
        perception.observe(rover.now + 5 * MS, rover.step(part * linear, part * angular))
    return perception


def pose(perception: Perception) -> Pose:
    assert perception.estimate is not None
    return perception.estimate.pose


def covariance(perception: Perception) -> np.ndarray:
    assert perception.estimate is not None
    return perception.estimate.covariance


def apart(perception: Perception, truth: Pose) -> float:
    return math.dist((pose(perception).x, pose(perception).y), (truth.x, truth.y))


def reports(t: Nanos, left: float = 0.0, right: float = 0.0, rate: float = 0.0) -> list[Event]:
    imu = Imu("imu", t, (0.0, 0.0, rate), (1e-12 * t, 0.0, 9.81))  # no two readings are equal: noise
    return [Feedback("left", t, left), Feedback("right", t, right), imu]


def rested(perception: Perception, until: Nanos = 1 * SECOND) -> Perception:
    for t in range(0, until, 10 * MS):
        perception.observe(t, reports(t))
    return perception


# -- a drive through the office: slip, scrub, gyro bias, noise ---------------------------------


@pytest.fixture(scope="module")
def driven() -> Drive:
    """35 m through two rooms and a doorway; the wheels lose 3 % of their way and 5 % of turns."""
    return drive(Rover(1), TOUR)


def test_the_path_believed_is_as_long_as_the_true_one(driven: Drive) -> None:
    assert 30.0 < driven.rover.length < 40.0
    assert driven.believed_length == pytest.approx(driven.rover.length, rel=0.005)


def test_raw_odometry_is_not(driven: Drive) -> None:
    assert abs(driven.raw_length / driven.rover.length - 1.0) > 0.02
    assert driven.raw_apart > 1.0


def test_the_pose_believed_is_the_true_one_all_the_way(driven: Drive) -> None:
    assert driven.worst < 0.05
    assert math.dist((driven.rover.truth.x, driven.rover.truth.y), TOUR[-1]) < 0.15


def test_bias_and_slip_are_found(driven: Drive) -> None:
    assert driven.perception.gyro_bias == pytest.approx(0.01, abs=0.002)
    assert driven.perception.slip == pytest.approx(0.0275, abs=0.008)


def test_hardly_anything_is_refused(driven: Drive) -> None:
    assert all(count <= 100 for count in driven.perception.rejected.values()), driven.perception.anomalies


def test_the_map_shows_the_office(driven: Drive) -> None:
    grid = driven.perception.map
    for x, y in [(9.5, 0.0), (3.0, -1.7), (4.0, 0.5), (1.2, 2.8), (6.1, 0.7), (7.4, 3.5)]:
        assert clearance(grid, x, y) < 0.08, (x, y)
    for x, y in [(0.0, 0.0), (4.0, 1.8), (8.3, 0.5), (3.0, 4.0)]:
        assert grid.values(*grid.cells(np.array([[x, y]])).T) < 0, (x, y)
    assert grid.values(*grid.cells(np.array([[6.4, 0.7]])).T) == 0  # inside a box


@dataclass
class Sweeping(Rover):
    """One whose lidar takes 100 ms for a turn; `way` −1: clockwise, so that its first beam is the newest."""

    way: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.lidar_noise, self.scan_delay = 0.0, 0
        self.places: deque[Pose] = deque([self.truth] * 20, maxlen=20)
        """Where it was in the last turn, at each step"""

    def sense(self) -> list[Event]:
        self.places.append(self.truth)
        return [self._swept(e) if isinstance(e, LaserScan) else e for e in super().sense()]

    def _swept(self, scan: LaserScan) -> LaserScan:
        first = scan.angle_min + MOUNTS["lidar"].yaw
        angles = np.asarray(first + scan.angle_increment * np.arange(360), dtype=np.float64)
        read = np.empty(360)
        for at, part in enumerate(np.array_split(np.arange(360), 20)):
            place = self.places[at if self.way > 0 else 19 - at]
            x, y = place.x + 0.08 * math.cos(place.yaw), place.y + 0.08 * math.sin(place.yaw)
            read[part] = ranges(self.walls, x, y, place.yaw + angles[part], 10.0)
        read += 0.01 * self.random.normal(size=360) * (read < 10.0)
        begin = self.now - 95 * MS if self.way > 0 else self.now
        return replace(scan, t=begin, ranges=tuple(read.tolist()), duration=self.way * 95 * MS)


@pytest.mark.sample(1)
@pytest.mark.parametrize("way", [1, -1])
def test_a_lidar_may_turn_either_way(way: int) -> None:
    """As well as one that sees all at once, since each beam counts at its own time."""
    there = drive(Sweeping(1, way=way), TOUR[:6])
    assert there.worst < 0.02
    assert there.perception.rejected["lidar"] < 5


def test_a_noisy_lidar_is_no_reason_to_be_lost() -> None:
    """0.2 m on each range. Defect: hardly any of a scan lay on what the scans before saw; it ended lost."""
    noisy = drive(Rover(2, lidar_noise=0.2), TOUR[:4])
    assert "does not fit the map" not in noisy.perception.anomalies["lidar"]
    assert noisy.perception.verdict.trust is Trust.CONSISTENT
    assert noisy.worst < 0.13


def test_without_a_lidar_the_gyro_still_beats_the_wheels() -> None:
    moved = drive(Rover(2), TOUR[:6], mounts=IMU_ONLY)
    assert moved.apart < 0.6
    assert moved.raw_apart > 3.0 * moved.apart
    estimate = moved.perception.estimate
    assert estimate is not None
    spread = math.sqrt(estimate.covariance[0, 0] + estimate.covariance[1, 1])
    assert moved.apart < 3.0 * spread  # and it knows how far off it may be


def test_two_runs_are_one() -> None:
    """The same events give the same belief to the last bit, and a copy made on the way does too."""
    rovers, beliefs = (Rover(5), Rover(5)), [new(), new()]
    for rover, belief in zip(rovers, beliefs, strict=True):
        run(rover, belief, 300)
        run(rover, belief, 300, 0.3, 0.4)
    forked = copy.deepcopy(rovers[0])
    beliefs.append(copy.deepcopy(beliefs[0]))
    for rover, belief in zip((*rovers, forked), beliefs, strict=True):
        run(rover, belief, 300, 0.3, -0.4)
    first = beliefs[0]
    for other in beliefs[1:]:
        assert pose(other) == pose(first)
        assert (covariance(other) == covariance(first)).all()
        assert (classes(other.map)[0] == classes(first.map)[0]).all()
        assert other.raw == first.raw
        assert other.anomalies == first.anomalies


# -- time --------------------------------------------------------------------------------------


def test_a_scan_counts_at_its_own_time() -> None:
    """Defect: the scan drawn at the pose of its arrival. Turning fast, it comes 100 ms (9°) late."""
    belief = new(replace(SETTINGS, matching=False))
    rover = Rover(3, slip_left=0.0, slip_right=0.0, scrub=0.0, slip_noise=0.0, scan_delay=20)
    run(rover, belief, 300)
    run(rover, belief, 300, 0.0, 1.5)
    _, points = classes(belief.map)
    low, high = np.minimum(OFFICE[:, :2], OFFICE[:, 2:]), np.maximum(OFFICE[:, :2], OFFICE[:, 2:])
    away = np.maximum(np.maximum(low[None] - points[:, None], points[:, None] - high[None]), 0.0)
    nearest = np.hypot(away[:, :, 0], away[:, :, 1]).min(axis=1)
    assert len(points) > 200
    assert np.mean(nearest < 0.1) > 0.97


def test_a_scan_waits_for_the_estimate() -> None:
    belief = rested(new())
    scan = scan_at(OFFICE, Pose(0.0, 0.0, 0.0), MOUNTS["lidar"], 1050 * MS)
    belief.observe(1000 * MS, [scan])
    assert belief.map.version == 0
    for t in (1060 * MS, 1070 * MS, 1080 * MS):  # freed from the motion, matched, drawn
        belief.observe(t, reports(t))
    assert belief.map.version == 1


def test_a_scan_does_not_wait_for_ever() -> None:
    belief = new()
    belief.observe(0, [scan_at(OFFICE, Pose(0.0, 0.0, 0.0), MOUNTS["lidar"], 0)])
    belief.observe(600 * MS, [])
    assert belief.anomalies["lidar"] == {"no estimate for its time": 1}
    assert belief.map.version == 0


def test_a_scan_from_long_ago_is_refused() -> None:
    belief = rested(new(), 3 * SECOND)
    belief.observe(3 * SECOND, [scan_at(OFFICE, Pose(0.0, 0.0, 0.0), MOUNTS["lidar"], 1 * SECOND)])
    belief.observe(3010 * MS, [])
    assert belief.anomalies["lidar"] == {"no estimate for its time": 1}


def test_the_order_within_one_step_does_not_matter() -> None:
    one, other = new(), new()
    for t in range(0, 1 * SECOND, 10 * MS):
        events = reports(t, 1e-9 * t, 1.2e-9 * t, 0.1)
        one.observe(t, events)
        other.observe(t, events[::-1])
    assert pose(one) == pose(other)


# -- wheels ------------------------------------------------------------------------------------


def test_no_estimate_before_both_wheels_have_moved_on() -> None:
    belief = new()
    known = [belief.estimate is not None]
    belief.observe(0, [Feedback("left", 0, 1.0), Imu("imu", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))])
    known.append(belief.estimate is not None)
    for t in (10 * MS, 20 * MS):
        belief.observe(t, reports(t, 1.0, 2.0))
        known.append(belief.estimate is not None)
    assert known == [False, False, True, True]
    assert pose(belief) == Pose(0.0, 0.0, 0.0)


def test_the_start_is_where_it_is_told() -> None:
    settings = replace(SETTINGS, filter=replace(SETTINGS.filter, start_x=1.0, start_y=-2.0, start_yaw=0.5))
    belief = rested(new(settings))
    assert (pose(belief).x, pose(belief).y, pose(belief).yaw) == pytest.approx((1.0, -2.0, 0.5), abs=1e-3)
    assert belief.raw == Pose(1.0, -2.0, 0.5)


def test_a_wheel_that_was_reset_throws_nobody_across_the_room() -> None:
    rover, belief = Rover(6), new()
    run(rover, belief, 300)
    run(rover, belief, 400, 0.4)
    before = pose(belief), belief.raw
    rover.angles[0] = 0.0
    run(rover, belief, 40, 0.4)
    assert belief.anomalies["left"]["position jumped"] == 1
    assert apart(belief, rover.truth) < 0.03
    assert math.dist((belief.raw.x, belief.raw.y), (before[1].x, before[1].y)) < 0.1


def test_a_wheel_that_falls_silent_and_comes_back() -> None:
    rover, belief = Rover(7), new()
    run(rover, belief, 300)
    run(rover, belief, 200, 0.3)
    for _ in range(60):
        events = rover.step(0.3, 0.0)
        belief.observe(rover.now, [e for e in events if not (isinstance(e, Feedback) and e.motor == "right")])
    run(rover, belief, 200, 0.3)
    assert apart(belief, rover.truth) < 0.04


# -- gyro --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mount", "axis"),
    [(Mount(), (0, 0, 1)), (Mount(roll=math.pi), (0, 0, -1)), (Mount(pitch=math.pi / 2), (-1, 0, 0))],
)
def test_the_gyros_mounting_counts(mount: Mount, axis: Sequence[float]) -> None:
    """Defect: extrinsics ignored. The wheels rest, slipping: only the gyro sees the turn."""
    belief = Perception(BODY, {"imu": mount}, SETTINGS)
    for t in range(0, 2 * SECOND, 10 * MS):
        rate = 0.0 if t < 1 * SECOND else 0.5
        way = 1e-9 * max(0, t - 1 * SECOND)
        turn = 0.5 * 0.22 / 0.05 / 2.0 * way
        x, y, z = (a * rate for a in axis)
        wheels = [Feedback("left", t, 5.0 * way - turn), Feedback("right", t, 5.0 * way + turn)]
        belief.observe(t, [*wheels, Imu("imu", t, (x, y, z), (0.0, 0.0, 9.81))])
    assert belief.estimate is not None
    assert belief.estimate.angular == pytest.approx(0.5, abs=0.01)
    assert belief.rejected["imu"] < 10


def test_a_second_at_rest_tells_the_bias() -> None:
    rover, belief = Rover(8, gyro_bias=0.03), new()
    run(rover, belief, 200)
    assert belief.gyro_bias == pytest.approx(0.03, abs=0.002)
    assert abs(pose(belief).yaw) < 0.01


def test_a_robot_turned_by_hand_is_not_at_rest() -> None:
    """The wheels rest, the gyro reads a turn: that is no bias."""
    belief = rested(new())
    for t in range(1000 * MS, 1500 * MS, 10 * MS):
        belief.observe(t, reports(t, rate=0.5))
    assert abs(belief.gyro_bias) < 0.05


def test_a_second_gyro_is_told_that_it_is_not_used() -> None:
    belief = Perception(BODY, {"imu": Mount(), "other": Mount()}, SETTINGS)
    belief.observe(0, [Imu(name, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)) for name in ("imu", "other")])
    assert belief.anomalies == {
        "left": {},
        "right": {},
        "imu": {},
        "other": {"not used beside another gyro": 1},
    }


# -- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_never_enters(bad: float) -> None:
    belief = rested(new())
    scan = scan_at(OFFICE, Pose(0.0, 0.0, 0.0), MOUNTS["lidar"], 1 * SECOND)
    rubbish: list[Event] = [
        Feedback("left", 1 * SECOND, bad),
        Imu("imu", 1 * SECOND, (0.0, 0.0, bad), (0.0, 0.0, bad)),
        replace(scan, angle_min=bad),
        replace(scan, angle_increment=bad),
        replace(scan, range_max=bad),
        replace(scan, ranges=()),
    ]
    belief.observe(1 * SECOND, rubbish)
    belief.observe(1010 * MS, [*reports(1010 * MS), replace(scan, t=1005 * MS, ranges=(bad,) * 360)])
    assert belief.anomalies["left"] == {"not finite": 1}
    assert belief.anomalies["imu"] == {"not finite": 1}
    assert belief.anomalies["lidar"] == {"not a scan": 4, "too few returns": 1}
    assert belief.estimate is not None
    assert np.isfinite(belief.estimate.covariance).all()
    assert math.isfinite(pose(belief).yaw)


def test_a_scan_told_twice_counts_once() -> None:
    belief = rested(new())
    scan = scan_at(OFFICE, Pose(0.0, 0.0, 0.0), MOUNTS["lidar"], 900 * MS)
    belief.observe(1 * SECOND, [scan, scan])
    for t in (1010 * MS, 1020 * MS):  # matched, then drawn
        belief.observe(t, [])
    assert belief.map.version == 1
    assert belief.anomalies["lidar"] == {"out of order": 1}


def test_a_push_aside_is_healed() -> None:
    """By 10 cm, beyond the gate."""
    rover, belief = Rover(9), new()
    run(rover, belief, 600)
    rover.truth = replace(rover.truth, y=rover.truth.y + 0.1)
    run(rover, belief, 600)
    assert apart(belief, rover.truth) < 0.03


@pytest.mark.parametrize("speed", [0.3, 0.5])
def test_wheels_that_spin_on_the_spot_are_noticed_and_take_the_pose_nowhere(speed: float) -> None:
    """The robot pushes against something for 1 s, its wheels slipping, and then drives off backwards."""
    rover, belief = Rover(11), new()
    run(rover, belief, 300)
    run(rover, belief, 400, speed)
    grip = rover.slip_left, rover.slip_right
    rover.slip_left = rover.slip_right = 1.0
    run(rover, belief, 200, speed)
    assert belief.contradictions() or belief.verdict.trust is Trust.LOST
    rover.slip_left, rover.slip_right = grip
    run(rover, belief, 600, -speed)
    assert apart(belief, rover.truth) < 0.03
    assert abs(belief.slip) <= 0.1


def test_a_robot_carried_elsewhere_is_lost_draws_nothing_and_is_found() -> None:
    """Lost within a second; then the map is searched, and the motion during the search is not forgotten."""
    rover, belief = Rover(12), new()
    for angular in (0.8, 0.0):
        run(rover, belief, 1200, 0.0, angular)
    rover.truth = Pose(1.0, 1.2, 1.0)
    verdicts = []
    for _ in range(200):
        run(rover, belief, 1)
        verdicts.append(belief.verdict)
    assert any(one.trust is Trust.LOST and one.reason.startswith("lost: lidar: ") for one in verdicts)
    assert belief.anomalies["lidar"]["does not fit the map"] >= 3
    assert clearance(belief.map, 0.5, 0.5) > 0.3  # nothing new where it was free
    run(rover, belief, 600, 0.0, 0.5)
    assert belief.verdict.trust is Trust.CONSISTENT
    assert belief.anomalies[""]["relocalised"] == 1
    assert apart(belief, rover.truth) < 0.03


def test_a_robot_that_is_carried_and_told_where_it_is_searches_for_nothing() -> None:
    """As exactly as a hand points on a map."""
    rover, belief = Rover(12), new()
    for angular in (0.8, 0.0):
        run(rover, belief, 1200, 0.0, angular)
    rover.truth = Pose(1.0, 1.2, 1.0)
    odom = belief.estimate.odom if belief.estimate else None
    assert belief.locate(Pose(1.2, 1.1, 1.15), 0.5, 0.26)
    assert belief.estimate is not None
    assert belief.estimate.odom == odom  # the pose in odom does not leap
    assert belief.take_notes()[-1].startswith("told that it is at (1.20, 1.10), 66°: ")
    for _ in range(300):
        run(rover, belief, 1)
        assert belief.verdict.trust is not Trust.LOST
    assert apart(belief, rover.truth) < 0.05
    assert belief.anomalies[""] == {"told where it is": 1}
    assert clearance(belief.map, 0.5, 0.5) > 0.3  # nothing new where it was free


def test_a_robot_told_that_it_is_elsewhere_finds_out() -> None:
    rover, belief = Rover(12), new()
    assert not belief.locate(Pose(0.0, 0.0, 0.0), 0.5, 0.26)  # before its first estimate
    for angular in (0.8, 0.0):
        run(rover, belief, 1200, 0.0, angular)
    assert belief.locate(Pose(1.5, 1.5, 2.0), 0.1, 0.1)
    run(rover, belief, 1200, 0.0, 0.5)
    assert belief.verdict.trust is Trust.CONSISTENT
    assert apart(belief, rover.truth) < 0.03


def test_a_full_map_forgets_what_is_farthest_and_says_so() -> None:
    walls = np.array(box(-2.0, -2.0, 28.0, 2.0) + [(x, 2.0, x, 1.2) for x in range(0, 28, 2)])
    few = replace(SETTINGS, map=MapSettings(resolution=0.02, farthest=2.5, tiles=64))
    moved = drive(Rover(3, walls), [(24.0, 0.0)], few)
    perception = moved.perception
    assert moved.apart < 0.1
    assert len(perception.map.known()) == 64
    assert perception.map.tile(0, 0) is None
    assert perception.anomalies[""]["the map is full"] > 3
    assert perception.take_notes() == ["the map is full, at 64 tiles: what is farthest is forgotten"]
    assert perception.take_notes() == []


def test_pushed_aside_in_a_corridor_it_knows_no_less_of_its_length_than_before() -> None:
    """The walls show where it is across; along them it is as unsure as it was, and as it was wrong."""
    rover, belief = Rover(3, walls=np.array(box(-14.0, -1.0, 14.0, 1.0))), new()
    run(rover, belief, 600, 0.3)
    rover.truth = Pose(rover.truth.x, rover.truth.y + 0.3, rover.truth.yaw + 0.15)
    run(rover, belief, 400)
    assert pose(belief).y == pytest.approx(rover.truth.y, abs=0.01)
    assert 0.1 < math.sqrt(covariance(belief)[0, 0]) < 0.5


def test_what_hides_walls_is_no_doubt_and_is_in_the_map_after_two_scans() -> None:
    rover, belief = Rover(13), new()
    run(rover, belief, 600)
    rover.walls = np.concatenate([OFFICE, [(0.9, -1.2, 0.9, 1.2)]])
    run(rover, belief, 50)
    assert belief.verdict.trust is Trust.CONSISTENT
    assert clearance(belief.map, 0.9, 0.0) < 0.08


def test_foreign_words_are_no_concern() -> None:
    belief = rested(new())
    before = pose(belief)
    belief.observe(
        1 * SECOND,
        [
            Feedback("arm", 1 * SECOND, 0.3),
            State("left", 1 * SECOND, Mode.ARMED),
            Imu("unheard of", 1 * SECOND, (9.0, 9.0, 9.0), (0.0, 0.0, 0.0)),
            LaserScan("unheard of", 1 * SECOND, 0.0, 0.1, 0.1, 10.0, (1.0,)),
        ],
    )
    assert pose(belief) == before


def test_names_stand_in_the_ledger_from_the_start() -> None:
    assert new().rejected == {"left": 0, "right": 0, "imu": 0, "lidar": 0}


# -- references from outside ----------------------------------------------------------------------


def test_motion_capture_and_satellites_correct_where_wheels_and_gyro_drift() -> None:
    """Without a lidar: poses at 10 Hz, or each second the place of an antenna 0.3 m ahead of the origin."""
    mounts = {**IMU_ONLY, "markers": Mount(), "gps": Mount(x=0.3)}
    settings = replace(SETTINGS, fixes=FixSettings(latitude=0.0, longitude=0.0))
    errors = {}
    for name, every in (("", 1), ("markers", 20), ("gps", 200)):
        rover, belief = Rover(14), Perception(BODY, mounts, settings)
        for step in range(6000):
            events = [event for event in rover.step(0.3, 0.1) if not isinstance(event, LaserScan)]
            here = rover.truth
            if step % every == 0 and name == "markers":
                events.append(PoseReading(name, rover.now, here.x, here.y, here.yaw, 1e-4, 1e-4))
            elif step % every == 0 and name == "gps":
                x, y = here.x + 0.3 * math.cos(here.yaw), here.y + 0.3 * math.sin(here.yaw)
                north, east = math.degrees(y / 6_335_439.0), math.degrees(x / 6_378_137.0)
                events.append(Fix(name, rover.now, north, east, None, 1e-4))  # on the equator: plain metres
            belief.observe(rover.now, events)
        errors[name] = apart(belief, rover.truth)
    assert errors[""] > 0.1
    assert max(errors["markers"], errors["gps"]) < 0.05


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308, -1e308])
def test_a_place_where_no_robot_can_be_is_counted_and_left_out(bad: float) -> None:
    """Nor does it become the datum of the fixes that follow."""
    belief = Perception(BODY, {"markers": Mount(), "gps": Mount()}, SETTINGS)
    places = [Fix("gps", 0, bad, 11.0), Fix("gps", 0, 48.0, bad), Fix("gps", 0, 48.0, 11.0, None, bad)]
    poses = [PoseReading("markers", 0, *pose) for pose in ((bad, 0.0), (0.0, bad), (0.0, 0.0, bad))]
    poses += [PoseReading("markers", 0, 0.0, 0.0, 0.0, *two) for two in ((bad, 1.0), (1.0, bad))]
    for t in range(0, SECOND, 10 * MS):
        belief.observe(t, reports(t))
        if t % (100 * MS) == 0:
            belief.observe(t, [replace(event, t=t) for event in places])
            belief.observe(t, [replace(event, t=t) for event in poses])
    assert belief.anomalies["gps"] == {"no possible place": 30}
    assert belief.anomalies["markers"] == {"no possible place": 50}
    belief.observe(SECOND, [Fix("gps", 990 * MS, 48.0, 11.0, None, 1e-4)])
    assert (pose(belief).x, pose(belief).y) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert np.isfinite(covariance(belief)).all()


@pytest.mark.parametrize("rate", [1e308, -1e308, 1e4])
def test_a_rate_that_no_gyro_reads_is_counted_and_left_out(rate: float) -> None:
    belief = rested(new())
    belief.observe(SECOND, [*reports(SECOND), Imu("imu", SECOND + 1, (0.0, 0.0, rate), (0.0, 0.0, 9.81))])
    assert belief.anomalies["imu"] == {"no possible rate": 1}
    assert abs(pose(belief).yaw) < 1e-3
