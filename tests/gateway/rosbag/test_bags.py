"""Bags of other programs: conversion and order of messages; wrong and damaged bags."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from brain.belief import Pose
from gateway.cli.main import main
from gateway.core.robot import BagTopics
from gateway.errors import BagError
from gateway.recording import Recorder
from gateway.rosbag import Bag, is_bag, read
from gateway.rosbag.evaluate import evaluate
from protocols.messages import MILLISECOND, SECOND, Feedback, Fix, Imu
from tests.gateway.bag_helpers import (
    KINDS,
    START,
    BagMessage,
    Kind,
    body_of,
    drive,
    fix,
    imu,
    odometry,
    rover,
    vector,
    write,
)

ROVER = rover()
EXPECTED = "expected Imu, NavSatFix, PoseWithCovarianceStamped, LaserScan, MultiEchoLaserScan or PointCloud2"
BODY = body_of(ROVER)
TOPICS = BagTopics("/odom", {"imu": "/imu/data"}, "/fix")


def bag_of(path: Path, *messages: BagMessage, topics: BagTopics = TOPICS, kind: Kind = "ros1") -> Bag:
    """A bag with these messages and one of each topic, which count as the first of all."""
    first = (odometry(START, 0.0, 0.0), imu(START, (0.0, 0.0, 0.0)), fix(START, 0.0, 0.0))
    return read(write(path / kind, [*first, *messages], kind), topics, BODY)


def at(ms: float) -> int:
    return START + round(ms * MILLISECOND)


def refusal(path: Path, topics: BagTopics | None = TOPICS) -> str:
    with pytest.raises(BagError) as reported:
        read(path, topics, BODY)
    return str(reported.value)


# -- what becomes of a message --------------------------------------------------------------------


def test_every_kind_of_bag_gives_the_same(tmp_path: Path) -> None:
    bags = [read(write(tmp_path / kind, drive(8.0), kind), TOPICS, BODY) for kind in KINDS]
    for bag in bags:
        assert (bag.events, bag.truth, bag.odometry) == (bags[0].events, bags[0].truth, bags[0].odometry)
        assert [(t.name, t.role, t.count, t.used) for t in bag.topics] == [
            ("/fix", "truth", 20, 20),
            ("/imu/data", "sensors.imu", 267, 267),
            ("/odom", "odometry", 80, 80),
        ]
    assert len(bags[0].events) == 2 * 80 + 267


def test_speeds_become_what_each_wheel_turned(tmp_path: Path) -> None:
    """From 0 to 1 m/s within 1 s, straight on; then 1 s of turning on the spot, 0.8 rad/s to the left."""
    bag = bag_of(
        tmp_path, odometry(at(1000), 1.0, 0.0), odometry(at(1000), 0.0, 0.8), odometry(at(2000), 0.0, 0.8)
    )
    left, right = (
        [e for e in bag.events if isinstance(e, Feedback) and e.motor == m] for m in ("left", "right")
    )
    # wheels of 0.1 m, 0.5 m apart: 0.5 m are 5 rad of both, 0.8 rad are 0.2 m or 2 rad of each
    assert [e.position for e in left] == pytest.approx([0.0, 5.0, 5.0, 3.0])
    assert [e.position for e in right] == pytest.approx([0.0, 5.0, 5.0, 7.0])
    assert [e.velocity for e in left] == pytest.approx([0.0, 10.0, -2.0, -2.0])
    assert [e.velocity for e in right] == pytest.approx([0.0, 10.0, 2.0, 2.0])
    assert [e.t for e in left] == [e.t for e in right] == [START, at(1000), at(1000), at(2000)]


def test_poses_of_the_bag_are_for_comparison_alone(tmp_path: Path) -> None:
    place = Pose(3.0, -2.0, 2.5)
    bag = bag_of(tmp_path, odometry(at(100), 0.5, 0.0, place))
    own = bag.odometry[1]
    assert (own.t, own.pose.x, own.pose.y) == (at(100), 3.0, -2.0)
    assert own.pose.yaw == pytest.approx(2.5)
    moved = [e.position for e in bag.events if isinstance(e, Feedback) and e.t == at(100)]
    assert moved == pytest.approx([0.25, 0.25])  # 0.05 / 2 m, whatever the pose is


def test_an_imu_keeps_its_own_frame_and_its_stamp(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, imu(at(20), (0.1, -0.2, 0.3), (0.5, 0.5, 0.5, 0.5), logged=at(45)))
    message = bag.events[-1]
    assert message == Imu("imu", at(20), (0.1, -0.2, 0.3), (0.0, 0.0, 9.81), (0.5, 0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("message", "turned"),
    [
        (imu(at(5), (0.0, 0.0, 0.0), turned_variance=-1.0), None),
        (imu(at(5), (0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0, 0.0)), None),
        (imu(at(5), (0.0, 0.0, 0.0), turned=(math.nan, 0.0, 0.0, 1.0)), None),
        (imu(at(5), (0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.6, 0.8)), (0.0, 0.0, 0.6, 0.8)),
    ],
    ids=["marked as not measured", "all zero", "not a number", "there"],
)
def test_an_orientation_that_was_not_measured_is_none(
    tmp_path: Path, message: BagMessage, turned: object
) -> None:
    event = bag_of(tmp_path, message).events[-1]
    assert isinstance(event, Imu)
    assert event.orientation == turned


def test_a_fix_has_its_horizontal_variance_if_known(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, fix(at(5), 48.1, 11.5), fix(at(6), 48.1, 11.5, altitude=math.nan, known=0))
    assert bag.truth[1:] == (Fix("gps", at(5), 48.1, 11.5, 100.0, 1.0), Fix("gps", at(6), 48.1, 11.5))


LEFT = [
    (odometry(at(5), math.nan, 0.0), "/odom", "not finite"),
    (odometry(at(5), 0.0, math.inf), "/odom", "not finite"),
    (odometry(at(5), 0.0, 0.0, Pose(math.nan, 0.0, 0.0)), "/odom", "not finite"),
    (odometry(at(5), 0.0, 0.0, variance=1e6), "/odom", "twist not measured"),
    (odometry(0, 0.0, 0.0, logged=at(5)), "/odom", "no stamp"),
    (imu(at(5), (0.0, math.nan, 0.0)), "/imu/data", "not finite"),
    (imu(at(5), (0.0, 0.0, 0.0), rate_variance=-1.0), "/imu/data", "angular velocity not measured"),
    (imu(0, (0.0, 0.0, 0.0), logged=at(5)), "/imu/data", "no stamp"),
    (fix(at(5), 0.0, 0.0, status=-1), "/fix", "no fix"),
    (fix(at(5), math.nan, 0.0), "/fix", "not on the earth"),
    (fix(at(5), 91.0, 0.0), "/fix", "not on the earth"),
    (fix(at(5), 0.0, math.inf), "/fix", "not on the earth"),
    (fix(0, 0.0, 0.0, logged=at(5)), "/fix", "no stamp"),
]


@pytest.mark.parametrize(("message", "name", "reason"), LEFT)
def test_what_is_not_used_is_counted_with_its_reason(
    tmp_path: Path, message: BagMessage, name: str, reason: str
) -> None:
    plain, bag = bag_of(tmp_path / "a"), bag_of(tmp_path / "b", message)
    assert (bag.events, bag.truth, bag.odometry) == (plain.events, plain.truth, plain.odometry)
    topics = {topic.name: topic for topic in bag.topics}
    assert (topics[name].count, topics[name].used, topics[name].unused) == (2, 1, {reason: 1})
    assert all(not topic.unused for other, topic in topics.items() if other != name)


def test_topics_without_a_part_are_left_over(tmp_path: Path) -> None:
    other = imu(at(5), (0.0, 0.0, 0.0), topic="/imu/other")
    bag = bag_of(tmp_path, other, topics=BagTopics("/odom"))
    assert [(t.name, t.role, t.used) for t in bag.topics] == [
        ("/fix", "", 0),
        ("/imu/data", "", 0),
        ("/imu/other", "", 0),
        ("/odom", "odometry", 1),
    ]
    assert not bag.truth
    assert all(isinstance(event, Feedback) for event in bag.events)


# -- order ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_stamps_order_and_the_bag_orders_what_has_one_stamp(tmp_path: Path, kind: Kind) -> None:
    bag = bag_of(
        tmp_path,
        odometry(at(40), 0.0, 0.0, logged=at(41)),
        imu(at(30), (0.1, 0.0, 0.0), logged=at(42)),  # older, written down later
        imu(at(40), (0.2, 0.0, 0.0), logged=at(43)),
        imu(at(40), (0.3, 0.0, 0.0), logged=at(44)),
        odometry(at(20), 0.0, 0.0, logged=at(45)),
        kind=kind,
    )
    late = [e for e in bag.events if e.t > START]
    reported = [e.angular_velocity[0] if isinstance(e, Imu) else getattr(e, "motor", e) for e in late]
    assert reported == ["left", "right", 0.1, "left", "right", 0.2, 0.3]
    assert [e.t for e in bag.events] == sorted(e.t for e in bag.events)


def test_wheels_turn_in_the_order_of_stamps(tmp_path: Path) -> None:
    late = odometry(at(1000), 1.0, 0.0, logged=at(2500))
    swapped = bag_of(tmp_path / "a", odometry(at(2000), 1.0, 0.0), late)
    straight = bag_of(tmp_path / "b", odometry(at(1000), 1.0, 0.0), odometry(at(2000), 1.0, 0.0))
    assert swapped.events == straight.events


# -- what is not there ----------------------------------------------------------------------------


def test_every_missing_topic_is_reported_with_the_nearest_and_all_topics(tmp_path: Path) -> None:
    path = write(tmp_path / "x", drive(1.0))
    message = refusal(path, BagTopics("/odm", {"imu": "/odom"}, "/gps"))
    assert message.splitlines() == [
        f"{path}: odometry: no topic '/odm'; did you mean '/odom'?",
        f"{path}: sensors.imu: /odom holds nav_msgs/msg/Odometry, {EXPECTED}",
        f"{path}: truth: no topic '/gps'",
        "there is",
        "  /fix: 3 of sensor_msgs/msg/NavSatFix",
        "  /imu/data: 34 of sensor_msgs/msg/Imu",
        "  /odom: 10 of nav_msgs/msg/Odometry",
    ]


def test_without_odometry_a_lidar_is_needed(tmp_path: Path) -> None:
    message = refusal(write(tmp_path / "x", drive(1.0)), BagTopics("", {"imu": "/imu/data"}))
    assert "odometry is not named, and no lidar, whose scans would show how the base moved" in message
    assert "/odom: 10 of nav_msgs/msg/Odometry" in message


def test_without_a_table_bag_the_topics_are_listed(tmp_path: Path) -> None:
    message = refusal(write(tmp_path / "x", drive(1.0)), None)
    assert "no table [bag]" in message
    assert "/odom: 10 of nav_msgs/msg/Odometry" in message


def test_a_topic_with_messages_of_several_types_is_none_of_them(tmp_path: Path) -> None:
    def make(types: Any) -> Any:
        return vector(types, 0.0, 0.0, 0.0)

    other = BagMessage("/imu/data", "geometry_msgs/msg/Vector3", at(1), make)
    path = write(tmp_path / "x", [odometry(START, 0.0, 0.0), imu(START, (0.0, 0.0, 0.0)), other])
    message = refusal(path, BagTopics("/odom", {"imu": "/imu/data"}))
    assert "/imu/data holds messages of several types, expected Imu, " in message


# -- which file is one ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_known_as_foreign(tmp_path: Path, kind: Kind) -> None:
    path = write(tmp_path / "x", drive(1.0), kind)
    assert is_bag(path)
    assert all(is_bag(p) for p in path.parent.rglob("*") if p.suffix in (".bag", ".mcap", ".db3"))


def test_our_own_recording_is_not_foreign(tmp_path: Path) -> None:
    path = tmp_path / "own.mcap"
    recorder = Recorder(path, ROVER.text, {})
    recorder.close()
    assert not is_bag(path)


def test_what_is_no_bag_is_not_foreign(tmp_path: Path) -> None:
    for name, data in (("a", b""), ("b.bag", b"x" * 100), ("c.mcap", b"\x89MCAP0\r\n"), ("d", b"# no bag")):
        (tmp_path / name).write_bytes(data)
        assert not is_bag(tmp_path / name), name
    assert not is_bag(tmp_path / "nothing")


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_the_file_of_a_bag_can_be_read_without_its_folder(tmp_path: Path, kind: Kind) -> None:
    folder = write(tmp_path / "x", drive(1.0), kind)
    (inside,) = (p for p in folder.iterdir() if p.suffix != ".yaml")
    whole = read(folder, TOPICS, BODY)
    assert read(inside, TOPICS, BODY).events == whole.events
    (folder / "metadata.yaml").unlink()  # which a recorder that was killed never wrote
    bag = read(folder, TOPICS, BODY)
    assert bag.events == whole.events
    assert bag.remark == f"a folder without metadata.yaml: its one file is read, {inside.name}"


# -- damage ---------------------------------------------------------------------------------------


def test_a_folder_that_is_no_bag(tmp_path: Path) -> None:
    assert refusal(tmp_path) == f"{tmp_path}: a folder without metadata.yaml: no bag of ROS 2"


def test_an_unfinished_bag_of_ros_1(tmp_path: Path) -> None:
    path = write(tmp_path / "x", drive(1.0)).rename(tmp_path / "x.bag.active")
    assert "must be called .bag: rename it (a .active one was not finished, and is read to" in refusal(path)


UNINDEXED = "its index is absent or damaged: gone through from its beginning, 92 messages"


def test_an_index_that_states_another_length_is_not_needed(tmp_path: Path) -> None:
    """As recorders of ROS C Turtle wrote it."""
    path = write(tmp_path / "x", drive(2.0))
    whole = read(path, TOPICS, BODY)
    data = path.read_bytes()
    field = (
        b"\x0a\x00\x00\x00count="  # with its length in front, and the last of the header of an index record
    )
    length = data.index(field) + len(field) + 4
    path.write_bytes(data[:length] + bytes([data[length] ^ 1]) + data[length + 1 :])
    assert read(path, TOPICS, BODY).events == whole.events
    assert evaluate(read(path, TOPICS, BODY), ROVER).notes == (UNINDEXED,)


@pytest.mark.parametrize("packed", ["", "BZ2"])
def test_a_bag_of_ros_1_that_was_cut_off_is_read_to_where_it_is_whole(
    tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "x", drive(60.0), packed=packed)
    data, whole = path.read_bytes(), read(path, TOPICS, BODY)
    kept = []
    for share in (0.9,) if packed else (0.3, 0.6, 0.9):
        path.write_bytes(data[: round(share * len(data))])
        bag = read(path, TOPICS, BODY)
        assert "not to its end: its last " in bag.remark
        kept.append(len(bag.events) - 20)  # what was measured in the last moments was not all written
        assert bag.events[: kept[-1]] == whole.events[: kept[-1]]
    assert kept == sorted(set(kept))
    assert "gone through from its beginning" in printed(capsys, 0, "inspect", path)
    path.write_bytes(data[:4000])
    assert refusal(path).endswith("and no message of it is whole")


def test_without_asserts_no_bag_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "x", drive(1.0))
    robot = tmp_path / "rover.toml"
    robot.write_text(ROVER.text)
    done = subprocess.run(
        [sys.executable, "-O", "-m", "gateway", "replay", str(path), "--robot", str(robot)],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "python -O switches off the checks of the library that reads bags" in done.stderr


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_bag_is_read_or_refused_with_a_sentence(tmp_path: Path, kind: Kind) -> None:
    """Cut anywhere, and with bits flipped anywhere: nothing but BagError comes out, and what is read can
    be evaluated."""
    seed, read_after_all, refused = 7, 0, 0
    random = np.random.Generator(np.random.PCG64(seed))
    path = write(tmp_path / "x", drive(1.0), kind)
    files = [path] if path.is_file() else sorted(path.iterdir())
    for case in range(36):
        file = files[case % len(files)]
        whole = file.read_bytes()
        bad = bytearray(whole)
        if case % 3:
            for place in random.integers(0, len(bad), size=1 + case % 4):
                bad[place] ^= 1 << int(random.integers(0, 8))
        else:
            del bad[int(random.integers(0, len(bad))) :]
        file.write_bytes(bad)
        try:
            bag = read(path, TOPICS, BODY)
        except BagError:
            refused += 1
        except Exception as error:
            error.add_note(f"{kind}, seed {seed}, case {case}")
            raise
        else:
            read_after_all += 1
            assert evaluate(bag, ROVER).text()
        file.write_bytes(whole)
    assert refused > 6
    assert read_after_all > 0
    assert read(path, TOPICS, BODY).events


@pytest.mark.parametrize("kind", KINDS)
def test_a_text_in_a_bag_that_is_no_utf_8_is_read_over_or_refused_with_a_sentence(
    tmp_path: Path, kind: Kind
) -> None:
    """Names of topics, types, fields and formats, wherever they stand: in the files, in metadata.yaml."""
    path = write(tmp_path / "x", drive(0.2), kind)
    texts = re.compile(
        rb"/odom|/imu/data|_msgs|cdr|base_link|float64|CREATE TABLE|sqlite3|mcap|topic|version|message"
    )
    refused = 0
    for file in [path] if path.is_file() else sorted(path.iterdir()):
        whole = file.read_bytes()
        found = [match.start() + 2 for match in texts.finditer(whole)]
        for place in found[:: max(len(found) // 12, 1)]:
            file.write_bytes(whole[:place] + b"\xff" + whole[place + 1 :])
            try:
                bag = read(path, TOPICS, BODY)
            except BagError as error:
                refused += str(path) in str(error)
            else:
                assert evaluate(bag, ROVER).text()
        file.write_bytes(whole)
    assert refused == 0 if kind == "ros1" else refused > 2  # which says it twice, in its index, too


def test_a_stamp_far_away_harms_nothing_but_itself(tmp_path: Path) -> None:
    bag = bag_of(tmp_path, odometry(START + 4 * 10**8 * SECOND, 1.0, 0.0, logged=at(5)))
    assert evaluate(bag, ROVER).text()


# -- damage that has a remedy ------------------------------------------------------------------------


def printed(capsys: pytest.CaptureFixture[str], status: int, *arguments: object) -> str:
    assert main([*map(str, arguments)]) == status
    out, err = capsys.readouterr()
    return out + err


@pytest.mark.parametrize("packed", ["none", "zstd", "lz4"])
def test_a_bag_that_was_cut_off_is_recovered(
    tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a recorder leaves it that was killed: a folder without metadata, an MCAP file without its end."""
    robot = tmp_path / "rover.toml"
    robot.write_text(ROVER.text)
    folder = write(tmp_path / "x", drive(8.0), "mcap")
    (file,) = folder.glob("*.mcap")
    whole = read(folder, TOPICS, BODY)
    repacked(file, packed)
    assert read(folder, TOPICS, BODY).events == whole.events
    file.write_bytes(file.read_bytes()[: -file.stat().st_size // 4])
    (folder / "metadata.yaml").unlink()
    lost = f"of its {file.stat().st_size} bytes are lost, from byte "
    for path in (folder, file):
        assert lost in printed(capsys, 0, "inspect", path)
        assert lost in printed(capsys, 0, "replay", path, "--robot", robot)
    assert "without metadata.yaml: its one file is read" in printed(capsys, 0, "inspect", folder)
    assert "messages of another program's bag" in printed(capsys, 0, "recover", file)
    found = file.with_name(f"{file.stem}.recovered.mcap")
    recovered = read(found, TOPICS, BODY)
    assert read(file, TOPICS, BODY).events == recovered.events
    kept = len(recovered.events) - 20  # what was measured in the last moments was not all written
    assert 100 < kept < len(whole.events)
    assert recovered.events[:kept] == whole.events[:kept]
    assert "messages used" in printed(capsys, 0, "replay", found, "--robot", robot)
    assert "is whole" in printed(capsys, 0, "recover", found)
    file.write_bytes(file.read_bytes()[:600])  # before its first chunk ends
    assert refusal(file).endswith("and no message of it is whole")
    assert "no message of it is whole" in printed(capsys, 2, "map", file, "--out", tmp_path / "out")


def repacked(path: Path, packed: str) -> None:
    """Write a bag anew as another program does, in small chunks."""
    kinds = {"none": CompressionType.NONE, "zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
    data = path.read_bytes()
    with path.open("wb") as out:
        new = McapWriter(out, chunk_size=4096, compression=kinds[packed])
        new.start("ros2", "another program")
        schemas, channels = dict[int, int](), dict[str, int]()
        for schema, channel, message in make_reader(BytesIO(data)).iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = new.register_schema(schema.name, schema.encoding, schema.data)
            if channel.topic not in channels:
                number = new.register_channel(channel.topic, "cdr", schemas[schema.id], channel.metadata)
                channels[channel.topic] = number
            new.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        new.finish()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_metadata_without_a_storage_name_the_way_that_works(tmp_path: Path, kind: Kind) -> None:
    folder = write(tmp_path / "x", drive(1.0), kind)
    yaml = folder / "metadata.yaml"
    text = yaml.read_text()
    yaml.write_text(text.replace(f"storage_identifier: {kind}", "storage_identifier: ''"))
    assert yaml.read_text() != text
    (file,) = (one for one in folder.iterdir() if one != yaml)
    assert refusal(folder).endswith(f": replay its file alone, {file}")
    assert read(file, TOPICS, BODY).events
    file.with_name(f"b{file.suffix}").write_bytes(file.read_bytes())
    assert "its 2 files can be replayed one by one, or `ros2 bag reindex" in refusal(folder)
