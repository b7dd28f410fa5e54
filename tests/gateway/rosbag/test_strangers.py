"""Recordings of strangers: a body and [bag] are all that a robot file needs, however the recording tells."""

from __future__ import annotations

import bz2
import csv
import gc
import gzip
import json
import lzma
import math
import sqlite3
import tracemalloc
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from brain.belief import Pose
from brain.bodies.body import Base
from brain.bodies.plane import arc, seen_from, wrap
from brain.perception.map import Map, MapSettings
from gateway.cli.main import main
from gateway.config import load_robot, parse_robot
from gateway.config.map_file import saved_map
from gateway.core.robot import CloudSlice, Robot
from gateway.errors import BagError, ConfigError
from gateway.recording import Recorder
from gateway.rosbag import Bag, is_bag, read
from gateway.rosbag.carmen import is_carmen
from gateway.rosbag.drawn import Drawn
from gateway.rosbag.evaluate import NOT_JUDGED, NOT_PLACED, PASSED, evaluate, evaluate_file
from gateway.rosbag.scans import of_cloud
from gateway.rosbag.survey import proposed_robot, survey
from gateway.rosbag.truth import Relations, read_truth
from protocols.messages import SECOND, LaserScan, Nanos
from tests.gateway.bag_helpers import ROBOT, START, STORES, BagMessage, header, imu, odometry, write
from tests.gateway.rosbag import strangers as made
from tests.gateway.rosbag.strangers import Told, motion, told

LEAST = 'body = "differential"\n[bag]\n'


def stranger(lines: str, body: str = 'body = "differential"\n') -> Robot:
    return parse_robot(f"{body}[bag]\n{lines}", recorded=True)


def base_of(robot: Robot) -> Base:
    assert robot.brain.base is not None
    return robot.brain.base


def bag_of(path: Path, robot: Robot, messages: list[BagMessage]) -> Bag:
    return read(write(path / "bag", messages, "mcap"), robot.bag, base_of(robot))


# -- the robot file -------------------------------------------------------------------------------


@pytest.mark.parametrize("body", ["differential", "skid_steer", "tracked", "ackermann"])
@pytest.mark.parametrize("sideways", [False, True])
def test_a_body_and_a_topic_are_enough(tmp_path: Path, body: str, sideways: bool) -> None:
    name = {"differential": "mecanum", "skid_steer": "omni", "tracked": "swerve"}.get(body, "quadruped")
    robot = stranger('odometry = "/odom"\n', f'[brain]\nbody = "{name if sideways else body}"\n')
    assert robot.recorded
    assert base_of(robot).moves_sideways == sideways
    aside = [odometry(START + n * SECOND, 0.5, 0.0, lateral=0.25) for n in range(11)]
    evaluation = evaluate(bag_of(tmp_path, robot, aside), robot)
    assert evaluation.end is not None
    assert evaluation.end.x == pytest.approx(5.0, abs=0.01)
    assert evaluation.end.y == pytest.approx(2.5 if sideways else 0.0, abs=0.01)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('[bag]\nodometry = "/o"\n', 'brain: missing; expected body = "NAME" before'),
        (f'{LEAST}odometry = "/o"\nmounts = {{ lidar = {{ x = 1.0 }} }}\n', "no sensor 'lidar'"),
        (f'{LEAST}odometry = "/o"\n[sensors.imu]\naddress = 1\n', "[bag.mounts.NAME] says"),
        (f'{LEAST}base_frame = "b"\n', "bag.odometry: missing; expected a topic, or under sensors a lidar"),
        ('[brain]\nbody = "arm"\n[bag]\nodometry = "/o"\n', "brain.arm"),
        (
            '[brain]\nbody = "tracked"\ntracked = { left = "a", right = "b" }\n[bag]\nodometry = "/joints"\n',
            "wheel_radius: missing",
        ),
    ],
)
def test_a_mistake_is_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as reported:
        parse_robot(text, recorded=True)
    assert sentence in str(reported.value)


def test_it_cannot_be_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.toml"
    path.write_text(f'{LEAST}odometry = "/odom"\n')
    assert main(["run", str(path), "--fast", "--seconds", "0.1"]) == 2
    assert "this file is for recordings alone" in capsys.readouterr().err
    assert main(["check", str(path)]) == 0
    assert "cannot be run" in capsys.readouterr().out
    with pytest.raises(ConfigError, match="for recordings alone"):
        load_robot(path)


# -- how the base moved ---------------------------------------------------------------------------


def by_pose(t: Nanos, v: float, w: float, pose: Pose, wheels: object) -> list[BagMessage]:
    return [odometry(t, 0.0, 0.0, pose)]


def by_twist(t: Nanos, v: float, w: float, pose: Pose, wheels: object) -> list[BagMessage]:
    return [made.twisted(t, v, w)]


def by_joints(t: Nanos, v: float, w: float, pose: Pose, wheels: tuple[float, float]) -> list[BagMessage]:
    return [made.joints(t, *wheels)]


def by_tf(t: Nanos, v: float, w: float, pose: Pose, wheels: object) -> list[BagMessage]:
    other = made.transform(t, "base_link", "wheel", (0.0, 0.2, 0.1), yaw=w)
    return [made.transform(t, "odom", "base_link", (pose.x, pose.y, 0.0), pose.yaw), other]


def by_vesc(t: Nanos, v: float, w: float, pose: Pose, wheels: object) -> list[BagMessage]:
    angle = math.atan(w * made.WHEELBASE / v)
    return [made.servo(t, 0.5 - 0.8 * angle), made.vesc(t, v * 4000.0)]


WHEELS = """[brain]
body = "differential"
differential = { left = "left_wheel", right = "right_wheel", wheel_radius = 0.1, wheel_separation = 0.5 }
"""
CAR = """odometry = "/sensors/core"
car.steering = "/sensors/servo"
car.middle = 0.5
car.per_angle = -0.8
car.per_speed = 4000
car.wheelbase = 0.3
"""


@pytest.mark.parametrize(
    ("how", "robot"),
    [
        (made.by_odometry, stranger('odometry = "/odom"\n')),
        (by_pose, stranger('odometry = "/odom"\n')),
        (by_twist, stranger('odometry = "/wheel_twist"\n')),
        (by_joints, stranger('odometry = "/joint_states"\n', WHEELS)),
        (by_tf, stranger('odometry = "/tf"\nodometry_frames = ["odom", "base_link"]\n')),
        (by_vesc, stranger(CAR)),
    ],
    ids=["twists", "poses alone", "TwistStamped", "JointState", "tf", "VESC"],
)
def test_however_it_is_told_the_base_goes_the_same_way(tmp_path: Path, how: Told, robot: Robot) -> None:
    evaluation = evaluate(bag_of(tmp_path, robot, told(how)), robot)
    *_, (_, _, _, last, _) = motion()
    assert evaluation.end is not None
    assert (evaluation.end.x, evaluation.end.y) == pytest.approx((last.x, last.y), abs=0.02)
    assert evaluation.end.yaw == pytest.approx(last.yaw, abs=0.01)
    assert evaluation.status == NOT_JUDGED
    assert "NOT JUDGED: there is no ground truth" in evaluation.text()


def test_angles_of_other_joints_are_named(tmp_path: Path) -> None:
    robot = stranger('odometry = "/joint_states"\n', WHEELS.replace("left_wheel", "left"))
    evaluation = evaluate(bag_of(tmp_path, robot, told(by_joints, 1.0)), robot)
    assert "without the joint 'left' (it has arm, right_wheel, left_wheel)" in evaluation.text()
    assert evaluation.status == 1


# -- scans ----------------------------------------------------------------------------------------


def scans(path: Path, robot: Robot, *messages: BagMessage) -> list[LaserScan]:
    still = [odometry(START + n * SECOND, 0.0, 0.0) for n in range(3)]
    return list(bag_of(path, robot, [*still, *messages]).scans())


LIDAR = stranger('odometry = "/odom"\nsensors = { lidar = "/scan" }\n')


def test_a_scan_is_put_in_order_and_made_finite(tmp_path: Path) -> None:
    """A lidar that turns clockwise; no return, a spurious one, and one that is too near."""
    ranges = [1.0, 2.0, math.inf, math.nan, 0.05, 30.0]
    (one,) = scans(tmp_path, LIDAR, made.scanned(START, ranges, 1.0, -0.1, time_increment=0.01))
    assert one.angle_min == pytest.approx(0.5)
    assert one.angle_increment == pytest.approx(0.1)
    assert one.ranges == pytest.approx((20.0, 0.0, 20.0, 20.0, 2.0, 1.0))
    assert (one.t - START, one.duration) == pytest.approx((0.05 * SECOND, -0.05 * SECOND), abs=100)


def test_a_full_turn_is_one_whatever_its_digits(tmp_path: Path) -> None:
    (one,) = scans(tmp_path, LIDAR, made.scanned(START, [1.0] * 360, 0.0, 0.017501922))
    assert one.angle_increment * 359 <= 2.0 * math.pi + 1e-9


def test_the_nearest_echo_counts(tmp_path: Path) -> None:
    (one,) = scans(tmp_path, LIDAR, made.scanned(START, [1.0, 3.0], echoes=True))
    assert one.ranges == pytest.approx((1.0, 3.0))


@pytest.mark.parametrize("by", ["ring", "band", "number"])
def test_of_a_cloud_a_level_slice_is_a_scan(tmp_path: Path, by: str) -> None:
    walls = made.room(Pose(0.0, 0.0, 0.0), 720, -math.pi, math.radians(0.5))
    points = [
        (r * math.cos(a), r * math.sin(a), r * math.tan(rise), ring)
        for ring, rise in enumerate((-0.2, 0.0, 0.2))
        for n, r in enumerate(walls if ring == 1 else [0.5] * 720)
        for a in [-math.pi + (n + 0.5) * math.radians(0.5)]
    ]
    robot = stranger('odometry = "/odom"\nsensors = { lidar = "/points" }\n')
    if by == "number":
        robot = stranger(
            'odometry = "/odom"\nsensors = { lidar = "/points" }\nclouds = { lidar = { ring = 1 } }\n'
        )
    (one,) = scans(tmp_path, robot, made.cloud(START, points, ring=by != "band"))
    assert np.allclose(one.ranges, walls, atol=0.05)


def test_a_cloud_without_what_is_wanted_says_so(tmp_path: Path) -> None:
    message = made.cloud(START, [(1.0, 0.0, 0.0, 0)], ring=False).make(STORES["ros2"].types)
    assert "no field 'ring'" in str(of_cloud("lidar", START, message, CloudSlice(ring=3)))


def test_memory_does_not_grow_with_the_scans(tmp_path: Path) -> None:
    peaks = []
    for count in (60, 180):
        still = [odometry(START + n * SECOND, 0.0, 0.0) for n in range(3)]
        many = [made.scanned(START + n * SECOND // 10, [1.0 + n / 1000.0] * 300) for n in range(count)]
        path = write(tmp_path / str(count), [*still, *many], "sqlite3")
        gc.collect()  # the sqlite reader's cycles are garbage until one comes by
        tracemalloc.start()
        assert sum(1 for _ in read(path, LIDAR.bag, base_of(LIDAR)).scans()) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


# -- where the sensors are ------------------------------------------------------------------------

FIXED_JOINT = """<robot name="r"><joint name="j" type="fixed"><parent link="base_link"/><child link="laser"/>
<origin xyz="0.2 0 0.1" rpy="0 0 1.5707963267948966"/></joint></robot>"""


@pytest.mark.parametrize(
    ("messages", "x", "yaw", "by"),
    [
        ([], 0.0, 0.0, "no transform from base_link to laser"),
        ([made.transform(START, "base_link", "laser", (0.2, 0.0, 0.1), math.pi / 2)], 0.2, math.pi / 2, ""),
        (
            [
                made.transform(START, "/base_link", "/top", (0.3, 0.0, 0.1), topic="/tf_static"),
                made.transform(START, "/top", "/laser", (-0.1, 0.0, 0.0), math.pi / 2, topic="/tf_static"),
            ],
            0.2,
            math.pi / 2,
            "base_link to laser",
        ),
        ([made.transform(START, "laser", "base_link", (0.2, 0.0, 0.0))], -0.2, 0.0, ""),
        ([made.described(START, FIXED_JOINT)], 0.2, math.pi / 2, ""),
        (
            [made.transform(START + n, "base_link", "laser", (0.2, 0.0, 0.0), n / 10.0) for n in range(3)],
            0.2,
            0.2,
            "MOVES",
        ),
    ],
    ids=["unknown", "tf", "tf_static in two steps", "the other way round", "a description", "it moves"],
)
def test_a_sensor_is_where_the_recording_says(
    tmp_path: Path, messages: list[BagMessage], x: float, yaw: float, by: str
) -> None:
    still = [odometry(START + n * SECOND, 0.0, 0.0) for n in range(3)]
    bag = bag_of(tmp_path, LIDAR, [*still, made.scanned(START, [1.0] * 9), *messages])
    placed = bag.placed["lidar"]
    assert (placed.mount.x, placed.mount.yaw) == pytest.approx((x, yaw))
    assert by in placed.by


def test_an_imu_that_no_transform_places_is_turned_as_gravity_shows(tmp_path: Path) -> None:
    robot = stranger('odometry = "/odom"\nsensors = { imu = "/imu/data" }\n')

    def on_edge(one: BagMessage) -> BagMessage:
        def make(types: object) -> object:
            message = one.make(types)
            message.linear_acceleration.y, message.linear_acceleration.z = 9.75, 0.4
            return message

        return BagMessage(one.topic, one.type, one.logged, make)

    messages = [odometry(START + n * SECOND // 10, 0.3, 0.2) for n in range(100)]
    messages += [on_edge(imu(START + n * SECOND // 10, (0.0, 0.2, 0.0))) for n in range(100)]
    bag = bag_of(tmp_path, robot, messages)
    assert bag.placed["imu"].mount.roll == pytest.approx(math.pi / 2.0)
    assert "gravity" in bag.placed["imu"].by


# -- truth ----------------------------------------------------------------------------------------


def shifted(pose: Pose) -> Pose:
    """The same path in another frame: turned by a right angle."""
    return Pose(3.0 - pose.y, 1.0 + pose.x, pose.yaw + math.pi / 2.0)


TRUTHS: dict[str, tuple[str, Callable[[Nanos, Pose], BagMessage]]] = {
    "PoseStamped": ('truth = "/truth"', made.posed),
    "PoseWithCovarianceStamped": ('truth = "/truth"', lambda t, p: made.posed(t, p, covariance=True)),
    "Odometry": ('truth = "/truth"', lambda t, p: odometry(t, 0.0, 0.0, p, topic="/truth")),
    "tf": (
        'truth = "/tf"\ntruth_frames = ["world", "base_link"]',
        lambda t, p: made.transform(t, "world", "base_link", (p.x, p.y, 0.0), p.yaw),
    ),
}


@pytest.mark.parametrize("kind", TRUTHS)
def test_any_pose_may_be_the_truth(tmp_path: Path, kind: str) -> None:
    lines, message = TRUTHS[kind]
    robot = stranger(f'odometry = "/odom"\n{lines}\n')
    true = [message(t, shifted(pose)) for n, (t, _, _, pose, _) in enumerate(motion()) if n % 5 == 4]
    evaluation = evaluate(bag_of(tmp_path, robot, [*told(made.by_odometry), *true]), robot)
    assert evaluation.status == PASSED
    assert len(evaluation.truth) == 200
    assert evaluation.estimated is not None
    assert evaluation.estimated.rms < 0.02


def test_many_frames_are_no_truth_without_two_names(tmp_path: Path) -> None:
    robot = stranger('odometry = "/odom"\ntruth = "/tf"\n')
    with pytest.raises(BagError, match='say which two, by truth_frames = \\["map", "base_link"\\]'):
        bag_of(tmp_path, robot, [*told(made.by_odometry, 1.0), made.transform(START, "a", "b", (0, 0, 0))])


def test_relations_are_judged_one_by_one(tmp_path: Path) -> None:
    """Kümmerle et al.: 1 m and 0.1 rad wrong in half of them."""
    poses = [(t, pose) for t, _, _, pose, _ in motion()]
    lines = []
    for n, ((t1, a), (t2, b)) in enumerate(zip(poses[::100], poses[50::100], strict=True)):
        c, s = math.cos(a.yaw), math.sin(a.yaw)
        dx, dy = b.x - a.x, b.y - a.y
        x, y = c * dx + s * dy + n % 2, c * dy - s * dx
        numbers = (t1 / SECOND, t2 / SECOND, x, y, 0.0, 0.0, 0.0, b.yaw - a.yaw + 0.1 * (n % 2))
        lines.append(" ".join(f"{one:.6f}" for one in numbers))
    path = tmp_path / "drive.relations"
    path.write_text("\n".join(lines))
    truth = read_truth(path)
    assert isinstance(truth, Relations)
    robot = stranger('odometry = "/odom"\n')
    bag = bag_of(tmp_path, robot, told(made.by_odometry))
    evaluation = evaluate(bag, robot, at_most=0.6, truth=truth)
    one = evaluation.relations["estimated"]
    assert (one.count, one.close) == (10, 10)
    assert (one.mean, one.mean_turn, one.median) == pytest.approx((0.5, 0.05, 0.5), abs=0.01)
    assert evaluation.status == PASSED
    assert "error over 10 relations between poses" in evaluation.text()
    assert evaluate(bag, robot, at_most=0.4, truth=truth).status == 1


def test_a_path_in_a_file_is_a_truth_and_nonsense_is_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    rows = [(t / SECOND, shifted(pose)) for t, _, _, pose, _ in motion()]
    path.write_text(
        "# t x y z qx qy qz qw\n"
        + "\n".join(f"{t:.6f} {p.x} {p.y} 0 0 0 {math.sin(p.yaw / 2)} {math.cos(p.yaw / 2)}" for t, p in rows)
    )
    robot = stranger('odometry = "/odom"\n')
    bag = bag_of(tmp_path, robot, told(made.by_odometry))
    evaluation = evaluate(bag, robot, truth=read_truth(path))
    assert evaluation.estimated is not None
    assert evaluation.estimated.rms < 0.02
    assert f"over {len(rows)} poses, after alignment" in evaluation.text()
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:0:-1], lines[3]]))
    assert read_truth(path) == evaluation.truth  # of what says the time, the order says nothing
    for text in ("1 2 3\n", "a b c d e f g h\n", "", "1 2 3 4 5 6 7 nan\n"):
        path.write_text(text)
        with pytest.raises(BagError, match="expected lines of 8 numbers"):
            read_truth(path)


# -- logs of CARMEN -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["drive.clf", "drive.log", "drive"])
def test_a_log_is_replayed_without_a_robot_file(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever its name: that of `drive.log` could be one of a log of CAN."""
    path = tmp_path / name
    path.write_text(made.carmen_log(8.0))
    assert main(["replay", str(path)]) == NOT_JUDGED
    out = capsys.readouterr().out
    assert "FLASER: 40 of 40 as sensors.lidar" in out
    assert "odometry: 440 of 440 as odometry" in out
    assert "scans: 40, of which 0 (0.0 %) came while it was lost" in out
    assert "NOT PASSED" not in out


def test_a_log_is_known_behind_a_long_head_and_a_text_of_comments_is_none(tmp_path: Path) -> None:
    """Some begin with all parameters of the program that logged, 245 in a public one."""
    head = "\n".join(f"PARAM robot_number_{n} on 1134863807.6 host 1134863807.6" for n in range(300))
    path = tmp_path / "drive.log"
    path.write_text(f"# message formats defined: PARAM ODOM FLASER\n{head}\n{made.carmen_log(4.0)}")
    assert is_carmen(path)
    assert proposed_robot(survey(path)).bag is not None
    path.write_text("# nothing\n" * 3000 + made.carmen_log(4.0))
    assert not is_carmen(path)


@pytest.mark.parametrize(
    ("kinds", "used"),
    [
        (("RAWLASER1",), "RAWLASER1"),
        (("RAWLASER1", "ROBOTLASER1"), "ROBOTLASER1"),
        (("FLASER", "RAWLASER1"), "FLASER"),
    ],
)
def test_a_scan_that_is_logged_twice_counts_once(tmp_path: Path, kinds: tuple[str, ...], used: str) -> None:
    path = tmp_path / "drive.clf"
    path.write_text(made.carmen_log(8.0, kinds=kinds))
    robot = proposed_robot(survey(path))
    assert robot.bag is not None
    assert robot.bag.sensors == {"lidar": used}
    again = [f"the scans of {used} again: {kind}" for kind in kinds if kind != used]
    proposal = survey(path).proposal
    assert proposal is not None
    assert [note for note in proposal.notes if "again" in note] == again
    evaluation = evaluate_file(path, robot)
    assert f"{used}: 40 of 40 as sensors.lidar" in evaluation.text()


def test_two_lidars_at_the_same_times_are_two(tmp_path: Path) -> None:
    """Where their frames differ, and where none is told: one that is left out would be missed."""
    path = tmp_path / "drive.clf"
    path.write_text(made.carmen_log(4.0, kinds=("FLASER", "RAWLASER2")))
    robot = proposed_robot(survey(path))
    assert robot.bag is not None
    assert sorted(robot.bag.sensors.values()) == ["FLASER", "RAWLASER2"]
    messages = told(made.by_odometry, 2.0)
    messages += [
        made.scanned(START + n * SECOND // 10, [1.0] * 90, frame="", topic=topic)
        for n in range(20)
        for topic in ("/front", "/rear")
    ]
    found = survey(write(tmp_path / "x", sorted(messages, key=lambda one: one.logged), "mcap"))
    unnamed = proposed_robot(found)
    assert unnamed.bag is not None
    assert sorted(unnamed.bag.sensors.values()) == ["/front", "/rear"]


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_a_packed_log_is_the_same(tmp_path: Path, pack: Callable[[bytes], bytes]) -> None:
    robot = stranger('odometry = "odometry"\nsensors = { lidar = "FLASER" }\n')
    plain, packed = tmp_path / "drive.clf", tmp_path / "drive.clf.packed"
    plain.write_text(made.carmen_log(4.0))
    packed.write_bytes(pack(plain.read_bytes()))
    assert is_bag(packed)
    one, other = (read(path, robot.bag, base_of(robot)) for path in (plain, packed))
    assert (one.events, list(one.scans())) == (other.events, list(other.scans()))


def test_a_torn_log_is_read_up_to_there_and_a_damaged_line_is_counted(tmp_path: Path) -> None:
    path, text = tmp_path / "drive.clf", made.carmen_log(4.0)
    robot = stranger('odometry = "odometry"\nsensors = { lidar = "FLASER" }\n')
    path.write_text(text[: len(text) - 20])
    assert 195 <= len(read(path, robot.bag, base_of(robot)).odometry) <= 220
    packed = bz2.compress(text.encode())
    path.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(BagError, match="cannot be unpacked"):
        read(path, robot.bag, base_of(robot))
    wrong = text.replace("FLASER 181", "FLASER 18x", 3).replace("ODOM 0.000000", "ODOM 1e300", 1)
    path.write_text(wrong.replace(" host 17000", " host 1e300", 1))
    found = evaluate_file(path, robot).text()
    assert "FLASER: 17 of 20 as sensors.lidar; not used: 3 × a damaged line" in found
    assert proposed_robot(survey(path)).bag == robot.bag


def test_a_damaged_log_raises_nothing_else(tmp_path: Path) -> None:
    random, path = np.random.Generator(np.random.PCG64(3)), tmp_path / "drive.clf"
    robot = stranger('odometry = "odometry"\nsensors = { lidar = "FLASER" }\n')
    whole = made.carmen_log(2.0).encode()
    fine = 0
    for case in range(20):
        bad = bytearray(whole if case % 2 else bz2.compress(whole))
        for place in random.integers(200, len(bad), size=1 + case % 5):
            bad[place] ^= 1 << int(random.integers(0, 8))
        path.write_bytes(bad)
        try:
            if is_bag(path):
                fine += bool(evaluate_file(path, robot).text())
        except BagError:
            pass
    assert fine > 1


# -- tables ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", ["time, x, y, heading", "Stamp,V,omega,x"])
def test_a_table_is_read_by_the_names_of_its_columns(tmp_path: Path, names: str) -> None:
    path = tmp_path / "drive.csv"
    rows = [
        (t / SECOND, p.x, p.y, p.yaw) if "heading" in names else (t / 1000, v, w, 7.0)
        for t, v, w, p, _ in motion()
    ]
    path.write_text("\n".join([names, *(",".join(f"{one:.9f}" for one in row) for row in rows), "1,,x"]))
    found = survey(path)
    evaluation = evaluate_file(path, proposed_robot(found))
    *_, (_, _, _, last, _) = motion()
    assert evaluation.end is not None
    assert (evaluation.end.x, evaluation.end.y) == pytest.approx((last.x, last.y), abs=0.03)
    assert evaluation.duration == pytest.approx(20.0 * SECOND, rel=0.01)
    assert "not used: 1 × a damaged line" in evaluation.text()
    path.write_text(path.read_text() + "\n1e300,1,1,1\n")
    with pytest.raises(BagError, match=r"1e\+300 is no time"):
        survey(path)


# -- the map --------------------------------------------------------------------------------------


def test_a_map_has_the_walls_where_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A square room of 24 m, looked at from within by a lidar that reaches all of it."""
    path, out = tmp_path / "drive.clf", tmp_path / "out"
    path.write_text(made.carmen_log(8.0))
    assert main(["map", str(path), "--out", str(out)]) == NOT_JUDGED
    assert "map.pgm, map.png, map.yaml, map.keyframes, path.tum, path.csv" in capsys.readouterr().out
    lines = dict(line.split(": ", 1) for line in (out / "map.yaml").read_text().splitlines())
    resolution, origin = float(lines["resolution"]), json.loads(lines["origin"])
    _, size, _, pixels = (out / "map.pgm").read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    grid = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)[::-1]
    rows, columns = np.nonzero(grid == 0)
    x, y = origin[0] + (columns + 0.5) * resolution, origin[1] + (rows + 0.5) * resolution
    assert len(x) > 200
    from_walls = np.minimum(np.abs(np.abs(x) - 12.0), np.abs(np.abs(y) - 12.0))
    assert np.quantile(from_walls, 0.95) < 0.1
    assert grid[round(-origin[1] / resolution), round((1.0 - origin[0]) / resolution)] == 254
    assert (out / "map.png").read_bytes().startswith(b"\x89PNG")
    believed = read_truth(out / "path.tum")
    assert len(believed) == pytest.approx(80, abs=2)
    files = {name: (out / name).read_bytes() for name in ("map.pgm", "map.keyframes")}
    again = Map(MapSettings(), saved_map((out / "map.yaml").read_text(), files, MapSettings(), None))
    table = [line.split(",") for line in (out / "path.csv").read_text().splitlines()[1:]]
    poses = [(0, Pose(float(one[1]), float(one[2]), 0.0)) for one in table]
    drawn = Drawn(again.view(), poses)
    text = drawn.yaml("map.keyframes")
    assert (drawn.pgm(), text) == (files["map.pgm"], (out / "map.yaml").read_text())
    assert survey(out / "path.csv").topics[0].topic.count == len(believed)
    assert main(["map", str(path), "--out", str(out)]) == 2
    assert "name another folder with --out" in capsys.readouterr().err


def test_a_second_recording_is_mapped_in_the_map_of_the_first_or_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same drive again, which is not told where it begins; and one among other walls."""
    path, other = tmp_path / "drive.clf", tmp_path / "other.clf"
    path.write_text(made.carmen_log(8.0))
    other.write_text(made.carmen_log(8.0, bent=1.0))
    begun, gone_on, out = (tmp_path / name for name in ("begun", "gone_on", "out"))
    in_it = ["--map", str(begun / "map.yaml")]
    assert main(["map", str(path), "--out", str(begun)]) == NOT_JUDGED
    assert main(["map", str(path), *in_it, "--out", str(gone_on)]) == NOT_JUDGED
    tables = [(folder / "path.csv").read_text().splitlines()[1:] for folder in (begun, gone_on)]
    first, second = ({t: (x, y, yaw) for t, x, y, yaw in csv.reader(table)} for table in tables)
    both = sorted(first.keys() & second.keys())
    assert len(both) > 60
    for t in both:
        assert list(map(float, second[t])) == pytest.approx(list(map(float, first[t])), abs=0.03)
    capsys.readouterr()
    assert main(["map", str(other), *in_it, "--out", str(out)]) == 2
    assert f"{other}: {NOT_PLACED}: no map is made of it" in capsys.readouterr().err
    assert main(["map", str(path), str(tmp_path / "absent"), "--out", str(out)]) == 2
    assert "there is no such file or folder" in capsys.readouterr().err
    assert not out.exists()
    (begun / "map.keyframes").write_bytes((begun / "map.keyframes").read_bytes()[:-100])
    assert main(["map", str(path), *in_it, "--out", str(out)]) == 2
    assert "map.keyframes: it is cut off, damaged or another file" in capsys.readouterr().err


# -- inspect --------------------------------------------------------------------------------------


def test_inspect_writes_a_file_that_replays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = told(made.by_odometry, 8.0)
    poses = [(t, pose) for t, _, _, pose, _ in motion(8.0)][::10]
    messages += [made.scanned(t, made.room(p, 360, -math.pi, math.radians(1.0), 12.0)) for t, p in poses]
    messages += [made.posed(t, shifted(pose), "/vicon/robot") for t, pose in poses]
    messages += [made.posed(t, pose, "/amcl_pose", covariance=True) for t, pose in poses]
    messages.append(made.transform(START, "base_link", "laser", (0.0, 0.0, 0.2), topic="/tf_static"))
    path = write(tmp_path / "stranger", sorted(messages, key=lambda one: one.logged), "mcap")
    target = tmp_path / "r.toml"
    assert main(["inspect", str(path), "--write", str(target)]) == 0
    out = capsys.readouterr().out
    assert "a bag of ROS 2 (MCAP), 8.0 s, 521 messages" in out
    assert "lidar: 0 m, 0 m, 0.2 m" in out
    text = target.read_text()
    for line in ('odometry = "/odom"', 'sensors = { lidar = "/scan" }', 'truth = "/vicon/robot"'):
        assert line in text
    assert "no truth: /amcl_pose" in text
    assert main(["replay", str(path), "--robot", str(target), "--at-most", "0.05"]) == 0
    assert "over 40 poses, after alignment" in capsys.readouterr().out
    assert main(["inspect", str(path), "--write", str(target)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_lidar_of_several_topics_is_one(tmp_path: Path) -> None:
    """As filters and throttles publish it; a second lidar in its own frame stays one, too."""
    at = [START + n * SECOND // 10 for n in range(40)]
    messages = told(made.by_odometry, 4.0)
    for topic, frame, times in (
        ("/scan_filtered", "laser", at),
        ("/scan", "laser", at),
        ("/scan_slow", "laser", at[::4]),
        ("/rear", "rear_laser", at),
    ):
        messages += [made.scanned(t, [1.0] * 90, frame=frame, topic=topic) for t in times]
    found = survey(write(tmp_path / "x", sorted(messages, key=lambda one: one.logged), "mcap"))
    assert found.proposal is not None
    robot = proposed_robot(found)
    assert robot.bag is not None
    assert sorted(robot.bag.sensors.values()) == ["/rear", "/scan"]
    again = [note for note in found.proposal.notes if "again" in note]
    assert again == ["the scans of /scan again: /scan_filtered", "the scans of /scan again: /scan_slow"]


def test_a_topic_may_be_called_anything(tmp_path: Path) -> None:
    name = '/odom" \\ \x7f\n[brain]\nbody = "arm"\n#'
    messages = [odometry(START + n * SECOND, 0.5, 0.0, topic=name) for n in range(5)]
    found = survey(write(tmp_path / "x", [*messages, made.transform(START, "a\nb", "c", (0, 0, 0))], "mcap"))
    robot = proposed_robot(found)
    assert robot.bag is not None
    assert robot.bag.odometry == name


@pytest.mark.parametrize("base", ["base_link", "base_footprint"])
def test_transforms_alone_are_an_odometry(tmp_path: Path, base: str) -> None:
    poses = [(t, p) for t, _, _, p, _ in motion(8.0)]
    messages = [made.transform(t, "odom", base, (p.x, p.y, 0.0), p.yaw) for t, p in poses]
    messages += [made.transform(t, "map", "odom", (t % 7, 0.0, 0.0)) for t, _ in poses[::10]]
    found = survey(write(tmp_path / "x", messages, "mcap"))
    evaluation = evaluate_file(found.path, proposed_robot(found))
    assert evaluation.driven == pytest.approx(0.8 * 8.0, rel=0.02)
    assert "/tf: 400 of 440 as odometry; not used: 40 × other frames" in evaluation.text()


KIND = "strange_msgs/msg/StateStamped"


def test_a_type_without_a_definition_hinders_nothing(tmp_path: Path) -> None:
    """As bags of ROS 2 before Iron: the definitions are left to who reads them."""
    new = Ros2Writer(tmp_path / "x", version=8, storage_plugin=StoragePlugin.SQLITE3)
    store = get_typestore(Stores.ROS2_HUMBLE)  # another one than that of the reader
    store.register(get_types_from_msg(made.VESC_STATE, "strange_msgs/msg/State"))
    stamped = made.VESC_STAMPED.replace("vesc_msgs/VescState", "strange_msgs/State")
    store.register(get_types_from_msg(stamped, KIND))
    with new:
        odom = new.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        core = new.add_connection("/core", KIND, typestore=store)
        for t in (START + n * SECOND for n in range(5)):
            message = odometry(t, 0.5, 0.0).make(store.types)
            new.write(odom, t, store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
            state = store.types["strange_msgs/msg/State"](speed=1.0, duty_cycle=0.1)
            message = store.types[KIND](header=header(store.types, t, ""), state=state)
            new.write(core, t, store.serialize_cdr(message, KIND))
    (file,) = (tmp_path / "x").glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
    found = survey(tmp_path / "x")
    assert "/core: its messages' definition is not in it" in found.text()
    assert evaluate_file(found.path, proposed_robot(found)).driven == pytest.approx(2.0)
    with pytest.raises(BagError, match=f"/core holds {KIND}, whose definition is not in it"):
        evaluate_file(found.path, stranger('odometry = "/core"\ncar = {}\n'))


def test_what_moves_sideways_gets_a_body_that_can(tmp_path: Path) -> None:
    messages = [odometry(START + n * SECOND, 0.5, 0.0, lateral=0.25) for n in range(11)]
    found = survey(write(tmp_path / "x", messages))
    assert base_of(proposed_robot(found)).moves_sideways


def test_a_recording_without_motion_is_told_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "x", [imu(START + n * SECOND, (0.0, 0.0, 0.0)) for n in range(5)])
    assert main(["inspect", str(path)]) == 1
    assert "nothing in it says how the base moved" in capsys.readouterr().out
    assert main(["replay", str(path)]) == 2
    assert "/imu/data: 5 of sensor_msgs/msg/Imu" in capsys.readouterr().err


def test_stamps_that_are_odd_are_named(tmp_path: Path) -> None:
    messages = [odometry(START + n * SECOND // 50, 0.1, 0.0) for n in range(200)]
    messages += [odometry(START + n * SECOND // 50, 0.1, 0.0, logged=START + 5 * SECOND) for n in range(50)]
    text = survey(write(tmp_path / "x", messages)).text()
    assert "/odom: stamps go back 1 times, by up to 4 s" in text
    assert "/odom: its stamps jump back by" in text


def test_inspect_knows_our_own_recordings_and_what_is_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, target = tmp_path / "own.mcap", tmp_path / "r.toml"
    Recorder(own, ROBOT, {}).close()
    assert main(["inspect", str(own), "--write", str(target)]) == 0
    assert target.read_text() == ROBOT
    assert f"{own.name}: a recording of this gateway, 0 ticks\n" in capsys.readouterr().out
    own.write_bytes(own.read_bytes()[:-8])
    assert main(["inspect", str(own)]) == 0
    assert f"cut off: `gateway recover {own}` repairs it\n" in capsys.readouterr().out
    (tmp_path / "x.txt").write_text("hello\n")
    for path, sentence in (
        (tmp_path / "x.txt", "no recording that is known"),
        (tmp_path / "y", "no such file"),
    ):
        assert main(["inspect", str(path)]) == 2
        assert sentence in capsys.readouterr().err


def test_a_scan_is_placed_before_what_comes_next_is_read(tmp_path: Path) -> None:
    """Defect: a log with an event for each scan gave perception no steps between them, and each pose was that
    of the odometry since the scan before. Here the odometry turns 1.5 times too far."""
    path, odometry, poses = tmp_path / "drive.clf", Pose(0.0, 0.0, 0.0), dict[int, Pose]()
    lines, before = made.carmen_log(8.0).splitlines(), Pose(0.0, 0.0, 0.0)
    kept = []
    for number, (t, _, _, pose, _) in enumerate(made.motion(8.0)):
        if number % 10 != 5:
            continue
        ahead = math.dist((pose.x, pose.y), (before.x, before.y))
        odometry = arc(odometry, ahead, 1.5 * wrap(pose.yaw - before.yaw))
        poses[t], before = pose, pose
        scan = next(one for one in lines if one.startswith("FLASER") and f" {t / SECOND:.6f} host" in one)
        at = f"{odometry.x:.6f} {odometry.y:.6f} {odometry.yaw:.6f}"
        end = scan.split()[-3:]
        kept += [f"ODOM {at} 0 0 0 {' '.join(end)}", " ".join([*scan.split()[:183], *at.split() * 2, *end])]
    path.write_text("\n".join([*lines[:2], *kept]) + "\n")
    relations = tmp_path / "drive.relations"
    times = sorted(poses)[10:]
    relations.write_text(
        "".join(
            f"{a / SECOND:.6f} {b / SECOND:.6f} {one.x:.6f} {one.y:.6f} 0 0 0 {one.yaw:.6f}\n"
            for a, b in zip(times, times[8:], strict=False)
            for one in [seen_from(poses[a], poses[b])]
        )
    )
    robot = stranger('odometry = "odometry"\nsensors = { lidar = "FLASER" }\n')
    found = evaluate_file(path, robot, truth=read_truth(relations)).relations
    assert found["dead reckoning"].mean_turn > math.radians(10.0)
    assert found["estimated"].mean_turn < 0.02 * found["dead reckoning"].mean_turn
    assert found["estimated"].mean < 0.05 * found["dead reckoning"].mean
