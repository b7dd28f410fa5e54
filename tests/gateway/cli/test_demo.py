"""`gateway demo`: its figures, its recording, and what a replay of that finds. One drive serves all tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import pytest

from gateway import config
from gateway.core.tick import Tick
from gateway.recording import Recording, Step, read_recording
from gateway.replay import replay_recording
from protocols.frames import CanFrame, Packet
from protocols.messages import Feedback, Imu, LaserScan, State

ROOT = Path(__file__).parents[3]


class Drive(NamedTuple):
    """A demo that has run."""

    out: Path
    text: str
    status: int

    @property
    def recording(self) -> Path:
        return self.out / "demo.mcap"

    def figure(self, pattern: str) -> float:
        found = re.search(pattern, self.text)
        assert found, self.text
        return float(found[1])


def gateway(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own, with an empty home and a clean environment.

    Only the choice of the processor's arithmetic is kept: a replay in this process must round alike."""
    arithmetic = {name: value for name, value in os.environ.items() if name.startswith("OPENBLAS_")}
    clean = {"PATH": os.environ["PATH"], "HOME": environment.pop("home", "/nonexistent"), **environment}
    clean |= arithmetic
    return subprocess.run(
        [sys.executable, "-m", "gateway", *arguments],
        capture_output=True,
        text=True,
        env=clean,
        cwd=ROOT,
        timeout=280,
        check=False,
    )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    out = tmp_path_factory.mktemp("demo")
    home = tmp_path_factory.mktemp("home")
    done = gateway("demo", "--fast", "--out", str(out), home=str(home))
    return Drive(out, done.stdout + done.stderr, done.returncode)


def test_every_goal_is_reached_by_the_true_pose_and_nothing_is_touched(drive: Drive) -> None:
    assert drive.status == 0, drive.text
    assert (
        drive.figure(r"by the true pose: (\d+) of \d+")
        == drive.figure(r"by the true pose: \d+ of (\d+)")
        >= 6
    )
    assert drive.figure(r"touched: (\d+)") == 0


def test_the_believed_path_is_faithful_where_raw_odometry_is_not(drive: Drive) -> None:
    assert drive.figure(r"path driven: ([\d.]+) m") > 20.0
    assert drive.figure(r"believed path: at most [\d.]+ m off the true one \(([\d.]+) %") <= 1.0
    assert drive.figure(r"raw odometry ?: at most [\d.]+ m off the true one \(([\d.]+) %") > 1.0
    assert abs(drive.figure(r"believed path: .* m long \(([-+\d.]+) %\)")) <= 1.0
    assert abs(drive.figure(r"raw odometry ?: .* m long \(([-+\d.]+) %\)")) > 1.0


def test_the_picture_is_a_png(drive: Drive) -> None:
    png = (drive.out / "demo.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    assert len(png) > 30_000


# -- the inputs -----------------------------------------------------------------------------------


def test_the_inputs_are_frames_and_bytes_without_a_pose(drive: Drive) -> None:
    """Every input of the run, decoded by the drivers, is a motor's or a sensor's own measurement."""
    recording = read_recording(drive.recording)
    robot = config.parse_robot(recording.robot_text)
    ticks = list(recording.ticks)
    packets = [packet for tick in ticks for packet in tick.inputs.packets]
    assert len(packets) > 10_000
    assert {packet.bus for packet in packets} == set(robot.buses)
    received = [event for tick in ticks for event in tick.outputs.events]
    assert {type(event) for event in received} <= {Feedback, State, Imu, LaserScan}
    assert all(event.orientation is None for event in received if isinstance(event, Imu))


# -- replay -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", ["0", "4711"])
def test_a_replay_gives_the_same_bytes_whatever_the_hash_seed(drive: Drive, seed: str) -> None:
    done = gateway("replay", str(drive.recording), PYTHONHASHSEED=seed)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the same, byte for byte" in done.stdout
    found = re.search(r"compared (\d+) ticks, (\d+) packets with (\d+) bytes", done.stdout)
    assert found
    assert all(int(n) > 1000 for n in found.groups())
    assert "0 left over" in done.stdout


@dataclass(frozen=True)
class Excerpt(Recording):
    """Some steps of a recording, whole as far as they go."""

    kept: tuple[Step, ...] = ()

    @property
    def steps(self) -> Iterator[Step]:
        return iter(self.kept)


def excerpt(recording: Recording, steps: Iterable[Step]) -> Excerpt:
    kept = tuple(steps)
    values = {field.name: getattr(recording, field.name) for field in fields(Recording)}
    return Excerpt(**values | {"whole": True, "indexed": len(kept)}, kept=kept)


@pytest.fixture(scope="module")
def beginning(drive: Drive) -> Excerpt:
    """The first 1200 ticks."""
    recording = read_recording(drive.recording)
    return excerpt(recording, islice(recording.steps, 1200))


def test_one_changed_gain_is_found_and_named(beginning: Excerpt) -> None:
    changed = beginning.robot_text.replace("max_linear = 0.6 ", "max_linear = 0.5 ")
    assert changed != beginning.robot_text
    comparison = replay_recording(beginning, config.parse_robot(changed))
    assert not comparison.ok
    text = comparison.text()
    assert "brain.differential.max_linear: 0.6 recorded, 0.5 now" in text
    assert re.search(r"(left|right): Velocity -?[\d.]+ rad/s", text)
    assert comparison.packets > 100


def test_the_same_file_by_command_with_one_gain_changed_exits_with_1(drive: Drive, tmp_path: Path) -> None:
    robot = tmp_path / "other.toml"
    text = read_recording(drive.recording).robot_text
    robot.write_text(text.replace("acceleration = 60.0", "acceleration = 30.0", 1))
    done = gateway("replay", str(drive.recording), "--robot", str(robot))
    assert done.returncode == 1
    assert "NOT the same" in done.stdout
    assert "motors.left.limits.acceleration: 60.0 recorded, 30.0 now" in done.stdout


def flipped(tick: Tick) -> Tick | None:
    """Return the tick with one bit of its first encoder frame flipped: the sign of the velocity."""
    packets = list(tick.inputs.packets)
    for i, packet in enumerate(packets):
        frame = packet.frame
        if isinstance(frame, CanFrame) and frame.id & 0x1F == 0x09 and len(frame.data) == 8:
            data = bytes([*frame.data[:7], frame.data[7] ^ 0x80])
            packets[i] = Packet(packet.t, packet.bus, replace(frame, data=data))
            return replace(tick, inputs=replace(tick.inputs, packets=tuple(packets)))
    return None


def test_one_flipped_bit_in_one_recorded_frame_is_found_and_named(beginning: Excerpt) -> None:
    steps = list(beginning.steps)
    at, changed = next((i, t) for i in range(600, 1200) if (t := flipped(steps[i].tick)) is not None)
    steps[at] = replace(steps[at], tick=changed)
    comparison = replay_recording(excerpt(beginning, steps))
    assert comparison.first is not None
    assert comparison.first.tick == at
    assert "velocity" in comparison.text()
