"""Recordings on disk: what is written can be read, also when the writing is cut short.

The two tests that end a process and the one that waits for an idle flush run on a wall clock, since that is
what they are about.
"""

from __future__ import annotations

import hashlib
import os
import random
import struct
import subprocess
import sys
import threading
from dataclasses import replace
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from gateway.cli.main import main
from gateway.core.tick import Inputs, Note, Outputs, Tick
from gateway.errors import RecordingError
from gateway.recording import Recorder, environment, read_recording, tick_codec
from gateway.recording.layout import FORMAT, METADATA, modernised
from gateway.recording.mcap_file import McapFile
from gateway.recording.ros_views import Views
from gateway.recording.tick_writer import TickWriter
from protocols.messages import SetId
from tests.gateway import little
from tests.gateway.processes import eventually

CHILD = """
import os, sys
from pathlib import Path
from gateway.recording import Recorder
from tests.gateway import little
"""


def child(code: str, path: Path, seed: str = "0") -> str:
    """Return what a process prints that runs this code with a path as argument."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD + code, str(path)],
        env={**os.environ, "PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def drained(recorder: Recorder) -> None:
    """Wait until the thread has taken all, and has gone idle once."""
    assert eventually(lambda: not recorder._queue and not recorder._writer.pending), "it did not flush"


# -- there and back ----------------------------------------------------------------------------


def test_what_goes_in_comes_out(path: Path) -> None:
    ticks = little.record(path, 300, facts={"date": "2026-11-21T10:00:00+00:00"})
    made = read_recording(path)
    assert list(made.ticks) == ticks
    assert list(made.ticks) == ticks, "a second time"
    assert (made.whole, made.indexed, made.robot_text) == (True, 300, little.ROBOT)
    assert made.facts["date"] == "2026-11-21T10:00:00+00:00"
    assert not any(step.damage for step in made.steps)
    assert all(step.whole for step in made.steps)


def test_where_it_was_made_stands_in_it(path: Path) -> None:
    little.record(path, 1)
    facts, here = read_recording(path).facts, environment.facts()
    assert facts == here
    assert facts[environment.PROGRAM] == environment.sources()
    for key in ("package numpy", "package mcap", "package rosbags", "python", "platform", "numpy blas"):
        assert facts[key]
    assert any(key.startswith("processor") for key in facts)


def test_any_change_of_a_source_is_seen(tmp_path: Path) -> None:
    (tmp_path / "brain").mkdir()
    file = tmp_path / "brain" / "a.py"
    file.write_text("x = 1\n")
    first = environment.digest_of(tmp_path)
    file.write_text("x = 2\n")
    second = environment.digest_of(tmp_path)
    file.rename(tmp_path / "brain" / "b.py")
    assert len({first, second, environment.digest_of(tmp_path)}) == 3


def test_the_sources_of_this_program_are_found(tmp_path: Path) -> None:
    assert environment.sources() != environment.digest_of(tmp_path)  # where there are none


def test_the_processor_is_known_without_cpuinfo(tmp_path: Path) -> None:
    reported = environment.facts(tmp_path / "none")
    assert reported["processor model name"]


def test_rosbags_reads_every_message(path: Path) -> None:
    ticks = little.record(path, 200)
    seen: dict[str, int] = {}
    numbers = []
    with AnyReader([path]) as reader:
        for connection, t, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
            if connection.topic == tick_codec.TOPIC:
                numbers.append(message.number)
                assert t == message.now == ticks[len(numbers) - 1].now
        promised = {c.topic: c.msgcount for c in reader.connections}
    assert numbers == list(range(200))
    assert seen == promised
    assert set(seen) == {
        "/gateway/tick", "/can0/from_can_bus", "/can0/to_can_bus", "/odom", "/tf", "/estimate", "/tf_static",
        "/map", "/plan", "/goal_pose", "/joint_states", "/diagnostics", "/rosout",
    }  # fmt: skip


def test_views_stand_behind_their_tick(path: Path) -> None:
    little.record(path, 30)
    for step in read_recording(path).steps:
        topics = [view.topic for view in step.views]
        assert topics.count("/can0/from_can_bus") == 2
        assert topics.count("/can0/to_can_bus") == 1
        received = [v.t for v in step.views if v.topic == "/can0/from_can_bus"]
        assert received == [max(0, p.t) for p in step.tick.inputs.packets[:2]]


def test_contents_do_not_depend_on_the_hash_seed(tmp_path: Path) -> None:
    contents = []
    for seed in ("0", "1", "4711"):
        path = tmp_path / f"{seed}.mcap"
        child("little.record(Path(sys.argv[1]), 120)", path, seed=seed)
        contents.append([(step.tick, step.views) for step in read_recording(path).steps])
    assert contents[0] == contents[1] == contents[2]


# -- cut short ---------------------------------------------------------------------------------


def test_reading_goes_on_from_any_tick(path: Path) -> None:
    little.record(path, 300)
    whole = path.read_bytes()
    for size in (len(whole), len(whole) * 2 // 3):
        path.write_bytes(whole[:size])
        made = read_recording(path)
        steps = list(made.steps)
        assert made.end == steps[-1].tick.now
        for at in (0, 1, 9, 10, 11, len(steps) // 2, len(steps) - 1):
            assert list(made.steps_from(steps[at].place)) == steps[at:]


def test_reading_from_the_middle_finds_the_same_damage(path: Path) -> None:
    little.record(path, 300)
    place = [step.place for step in read_recording(path).steps][250]
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    made = read_recording(path)
    assert [step.tick.number for step in made.steps_from(place)] == list(range(250, 300))
    wrong = replace(place, before=tick_codec.CHAIN_START)
    assert [bool(step.damage) for step in made.steps_from(wrong)] == [True] + [False] * 49
    with pytest.raises(RecordingError, match="damaged near byte"):
        list(made.steps)


def test_a_process_that_ends_loses_at_most_100_ms(path: Path) -> None:
    """The loop is ahead of the writer by one waiting tick and one at work; 80 ms are 16 ticks."""
    code = """
recorder = Recorder(Path(sys.argv[1]), little.ROBOT, {}, little.MOUNTS, depth=1)
for tick, belief in little.life(500):
    recorder.record(tick, belief, patient=True)
os._exit(0)
"""
    child(code, path)
    made = read_recording(path)
    assert (made.whole, made.indexed, made.robot_text) == (False, None, little.ROBOT)
    steps = list(made.steps)
    assert [step.tick for step in steps] == [tick for tick, _ in little.life(len(steps))]
    assert 500 - len(steps) <= 16 + 2
    assert not any(step.damage for step in steps)
    assert [step.whole for step in steps] == [True] * (len(steps) - 1) + [False]


def test_an_idle_recorder_flushes(path: Path) -> None:
    with Recorder(path, little.ROBOT, {}) as recorder:
        (tick, belief), *_ = little.life(1)
        recorder.record(tick, belief)
        drained(recorder)
        assert list(read_recording(path).ticks) == [tick]


@pytest.mark.parametrize(("level", "flushed"), [("error", True), ("warning", True), ("info", False)])
def test_trouble_is_flushed_at_once(path: Path, level: Any, flushed: bool) -> None:
    file = TickWriter(path, little.ROBOT, {}, Views())
    tick = Tick(0, 0, Inputs(), Outputs((), (), (Note(level, "left", "something"),)))
    assert file.add(tick, little.bare_belief()) == ""
    assert [t.number for t in read_recording(path).ticks] == ([0] if flushed else [])
    assert file.finish() == ""
    assert [t.number for t in read_recording(path).ticks] == [0]


def test_a_cut_anywhere_leaves_the_ticks_before_it(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    ticks = little.record(path, 40)
    whole = path.read_bytes()
    sizes = (*range(64), *range(64, len(whole), 293), len(whole) - 1)
    lengths = set()
    # Zeros are what a file system may leave after a loss of power.
    for size, behind in product(sizes, (b"", bytes(5000))):
        cut.write_bytes(whole[:size] + behind)
        try:
            made = read_recording(cut)
        except RecordingError:
            continue
        left = list(made.ticks)
        assert left == ticks[: len(left)]
        assert not made.whole
        lengths.add(len(left))
    assert {0, 40} < lengths


# -- trouble -----------------------------------------------------------------------------------


def test_a_tick_that_cannot_be_encoded_is_reported(path: Path) -> None:
    belief = little.bare_belief()
    with Recorder(path, little.ROBOT, {}) as recorder:
        for number, serial in enumerate((1, 2**70, 3)):
            tick = Tick(number, number, Inputs((), (), (SetId("can0", serial, 4),)), Outputs())
            recorder.record(tick, belief)
    assert recorder.lost == 1
    assert recorder.trouble.startswith("tick 1 is not in the recording: SetId")
    assert [tick.number for tick in read_recording(path).ticks] == [0, 2]


def test_after_closing_ticks_are_lost_and_reported(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.mcap", little.ROBOT, {})
    recorder.close()
    recorder.close()
    assert recorder.trouble == ""
    for patient in (False, True):
        recorder.record(*next(little.life(1)), patient=patient)
    assert recorder.lost == 2
    assert "are missing" in recorder.trouble
    assert "it is closed" in recorder.trouble
    assert list(read_recording(recorder.path).ticks) == []


def test_recordings_that_have_ended_leave_no_thread_and_no_file_open(tmp_path: Path) -> None:
    def held() -> tuple[set[threading.Thread], list[Path]]:
        files = [file.resolve() for file in Path("/proc/self/fd").iterdir()]
        return {*threading.enumerate()} - before, [file for file in files if tmp_path in file.parents]

    before, recorders = {*threading.enumerate()}, []
    for number in range(10):
        recorders.append(Recorder(tmp_path / f"{number}.mcap", little.ROBOT, {}))
        recorders[-1].record(*next(little.life(1)))
        recorders[-1].end()
    assert eventually(lambda: held() == (set(), [])), held()
    assert all(read_recording(one.path).whole for one in recorders)
    for one in recorders:
        one.close()
        assert one.trouble == ""


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("none/a.mcap", "cannot be written: No such file or directory"),
        (".", "exists already"),
        ("/dev/full", "cannot be written: No space left on device"),
    ],
)
def test_a_file_that_cannot_be_begun_raises(tmp_path: Path, path: str, why: str) -> None:
    with pytest.raises(RecordingError, match=why):
        Recorder(tmp_path / path, little.ROBOT, {})


# -- what is no recording ----------------------------------------------------------------------


def mcap(head: dict[str, str] | None, robot: bytes | None = b"x = 1\n") -> bytes:
    """Return an MCAP file with this metadata and robot file."""
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.LZ4)
    writer.start(profile="ros2", library="some program 1.0")
    if head is not None:
        writer.add_metadata(METADATA, head)
    if robot is not None:
        writer.add_attachment(0, 0, "robot.toml", "", robot)
    writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates arguments only
    return stream.getvalue()


DIGEST = hashlib.blake2b(b"x = 1\n", digest_size=16).hexdigest()
OURS = {"format": FORMAT, "robot digest": DIGEST}
NOT_RECORDINGS = [
    (b"", "an empty file, not a recording"),
    (b"#ROSBAG V2.0\n" + bytes(50), "a ROS 1 bag, not a recording"),
    (b"SQLite format 3\0" + bytes(50), "a ROS 2 bag of kind sqlite3, not a recording"),
    (b"(1.0) can0 123#00\n", "no MCAP file, not a recording"),
    (b"\x89MCAP0\r\n", "cut off in its first bytes"),
    (b"\x89MCAP0\r\n" + bytes(50), "cut off in its first bytes"),
    (b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 2**62), "cut off in its first bytes"),
    (mcap({**OURS, "format": "4"}), "of format 4; this program reads formats 1, 2 and 3"),
    (mcap(OURS, None), "there is no tick in it"),
    (mcap(OURS, b"x = 2\n"), "the robot file in it does not match its digest"),
]


@pytest.mark.parametrize(("content", "reason"), NOT_RECORDINGS, ids=[reason for _, reason in NOT_RECORDINGS])
def test_other_files_are_refused(
    path: Path, content: bytes, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=reason):
        read_recording(path)
    assert main(["recover", str(path)]) == 2
    assert reason in capsys.readouterr().err
    assert path.read_bytes() == content


def test_a_file_of_another_program_is_no_recording_of_ours(path: Path) -> None:
    path.write_bytes(mcap(None, None))
    with pytest.raises(RecordingError, match=r"an MCAP file of some program 1\.0, not of this gateway"):
        read_recording(path)


@pytest.mark.parametrize(("name", "why"), [("none.mcap", "No such file"), (".", "Is a directory")])
def test_what_cannot_be_opened(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(RecordingError, match=why):
        read_recording(tmp_path / name)


def test_a_damaged_file_gives_a_sentence_or_the_truth(path: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    ticks = little.record(path, 40)
    whole = path.read_bytes()
    generator = random.Random(7)
    reported = 0
    for _ in range(250):
        at, bit = generator.randrange(len(whole)), generator.randrange(8)
        data = bytearray(whole)
        data[at] ^= 1 << bit
        damaged.write_bytes(data)
        try:
            steps = list(read_recording(damaged).steps)
        except RecordingError:
            reported += 1
            continue
        if not any(step.damage for step in steps):
            assert [step.tick for step in steps] == ticks[: len(steps)], f"bit {bit} of byte {at}"
    assert reported > 50


def test_the_index_of_a_long_recording_costs_little_and_is_right(path: Path) -> None:
    """10,000 chunks are four minutes of a real run; the index is packed several times on the way."""
    file = McapFile(path, "a test")
    channels = [file.open_channel(f"/{n}", "std_msgs/msg/Header", "string a") for n in range(6)]
    count = 10_000
    for number in range(count):
        for channel in channels:
            file.message(channel, number, number * 25_000_000, number, b"\0\1\0\0abcd")
        file.flush()
    assert len(file._packed_index) > 3
    assert sum(map(len, file._packed_index)) + len(file._index) < 60 * count
    file.finish()
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == count * len(channels)
        assert len(summary.chunk_indexes) == count
        at = 4_999 * 25_000_000
        middle = list(reader.iter_messages(starting_at=at, ending_before=at + 1))
    assert [(channel.topic, message.sequence) for _, channel, message in middle] == [
        (f"/{n}", 4_999) for n in range(6)
    ]


# -- format 1 ----------------------------------------------------------------------------------


def test_keys_of_format_1_are_translated_where_they_are_keys() -> None:
    old = (
        'silent = "hold" # safe = "idle"\n[buses.hear]\nhear = [1]\nmixed = true\n'
        'left = { silent = "idle", safe="brake" }\nsafe = { bus = "silent = 1" }\n'
        'text = """\nsafe = 1\n"""\nother_safe = 1\n[defaults.motors]\nsafe = \'hold\'\n'
    )
    new = (
        'on_command_timeout = "hold" # safe = "idle"\n[buses.hear]\nreceive_filter = [1]\nshared_bus = true\n'
        'left = { on_command_timeout = "idle", stop_action="brake" }\nsafe = { bus = "silent = 1" }\n'
        'text = """\nsafe = 1\n"""\nother_safe = 1\n[defaults.motors]\nstop_action = \'hold\'\n'
    )
    assert modernised(old, "1") == new
    assert modernised(old, "2") == old


def test_the_border_of_the_map_is_left_out_of_recordings_that_had_one() -> None:
    old = (
        "[brain.perception.map]\nresolution = 0.1\nwidth = 8.0\nheight = 8.0 # m\n"
        "[brain.planner]\nwidth = 1\n[brain]\nperception.map.width = 8.0\n"
        "[brain.perception]\n  map.height = 8.0"
    )
    new = (
        "[brain.perception.map]\nresolution = 0.1\n[brain.planner]\nwidth = 1\n[brain]\n[brain.perception]\n"
    )
    assert modernised(old, "1") == modernised(old, "2") == new
    assert modernised(old, FORMAT) == old
