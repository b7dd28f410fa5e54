"""The demo as a newcomer runs it, its recording, and what a replay of it must find. One drive serves all."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest

from gateway import config
from gateway.core.step import Gateway, decoder_of
from gateway.core.tick import Tick
from gateway.recording import Recording, Step, read
from gateway.replay.compare import Verdict, compare
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
    """The command in a process of its own, with an empty home and nothing left over in the environment.

    But for the choice of the processor's arithmetic: a replay in this process must round as that one."""
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


def test_the_picture_is_a_picture(drive: Drive) -> None:
    png = (drive.out / "demo.png").read_bytes()
    assert png.startswith(b"\x89PNG")
    assert len(png) > 30_000


# -- what went in -----------------------------------------------------------------------------------


def test_what_went_in_is_frames_and_bytes_that_hold_no_pose(drive: Drive) -> None:
    """Every input of the run, as the drivers understand it, is a motor's or a sensor's own measurement."""
    recording = read(drive.recording)
    robot = config.parse_robot(recording.robot_text)
    ticks = list(recording.ticks)
    packets = [packet for tick in ticks for packet in tick.inputs.packets]
    assert len(packets) > 10_000
    assert {packet.bus for packet in packets} == set(robot.buses)
    received = [event for tick in ticks for event in tick.outputs.events]
    assert {type(event) for event in received} <= {Feedback, State, Imu, LaserScan}
    assert all(event.orientation is None for event in received if isinstance(event, Imu))


def test_nothing_that_steps_can_reach_the_world() -> None:
    """The true pose lives in gateway.sim. What steps, and all that it imports, never imports it."""
    seen: set[str] = set()
    todo = [
        "gateway.core.step",
        "gateway.core.joint",
        "brain.brain",
        "protocols.odrive_can",
        "protocols.plain",
    ]
    while todo:
        module = todo.pop()
        if module in seen:
            continue
        seen.add(module)
        todo += [name for name in _imports(module) if name.split(".")[0] in ("gateway", "brain", "protocols")]
    assert "brain.perception.ekf" in seen
    assert not [name for name in seen if name.startswith(("gateway.sim", "gateway.buses"))]


def _imports(module: str) -> Iterator[str]:
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            for alias in node.names:
                child = ROOT.joinpath(*node.module.split("."), alias.name)
                if child.is_dir() or child.with_suffix(".py").exists():
                    yield f"{node.module}.{alias.name}"


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


def short(drive: Drive, folder: Path, change: object = None, ticks: int = 1200) -> Recording:
    """The first ticks of the recording, each through `change`, but with the seals of the true ones."""
    recording = read(drive.recording)
    steps = []
    for step in recording.steps:
        steps.append(step)
        if len(steps) == ticks:
            break
    return _Short(recording, steps)  # type: ignore[return-value]  # it has what the judge reads


class _Short:
    """A recording cut short, whole as far as it goes."""

    def __init__(self, recording: Recording, steps: list[Step]) -> None:
        self.robot_text = recording.robot_text
        self.facts = recording.facts
        self.whole = True
        self.promised = len(steps)
        self.steps = steps


def judge(recording: Recording, text: str) -> Verdict:
    robot = config.parse_robot(text)
    made = Gateway(robot)
    mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
    return compare(
        recording,
        made.step,
        made.belief,
        lambda bus: decoder_of(robot, bus),
        robot_text=text,
        mounts=mounts,
        buses=robot.buses,
    )


def test_one_changed_gain_is_found_and_named(drive: Drive, tmp_path: Path) -> None:
    recording = short(drive, tmp_path)
    changed = recording.robot_text.replace("max_linear = 0.6 ", "max_linear = 0.5 ")
    assert changed != recording.robot_text
    verdict = judge(recording, changed)
    assert not verdict.ok
    text = verdict.text()
    assert "brain.differential.max_linear: 0.6 recorded, 0.5 now" in text
    assert re.search(r"(left|right): Velocity -?[\d.]+ rad/s", text)
    assert verdict.packets > 100


def test_the_same_file_by_command_with_one_gain_changed_exits_with_1(drive: Drive, tmp_path: Path) -> None:
    robot = tmp_path / "other.toml"
    text = read(drive.recording).robot_text
    robot.write_text(text.replace("acceleration = 60.0", "acceleration = 30.0", 1))
    done = gateway("replay", str(drive.recording), "--robot", str(robot))
    assert done.returncode == 1
    assert "NOT the same" in done.stdout
    assert "motors.left.limits.acceleration: 60.0 recorded, 30.0 now" in done.stdout


def flipped(tick: Tick) -> Tick | None:
    """The tick with one bit of its first encoder frame flipped: the sign of the velocity."""
    for i, packet in enumerate(tick.inputs.packets):
        frame = packet.frame
        if isinstance(frame, CanFrame) and frame.id & 0x1F == 0x09 and len(frame.data) == 8:
            data = bytes([*frame.data[:7], frame.data[7] ^ 0x80])
            packets = list(tick.inputs.packets)
            packets[i] = Packet(packet.t, packet.bus, replace(frame, data=data))
            return replace(tick, inputs=replace(tick.inputs, packets=tuple(packets)))
    return None


def test_one_flipped_bit_in_one_recorded_frame_is_found_and_named(drive: Drive, tmp_path: Path) -> None:
    recording = short(drive, tmp_path)
    steps = list(recording.steps)
    at, changed = next((i, t) for i in range(600, 1200) if (t := flipped(steps[i].tick)) is not None)
    steps[at] = replace(steps[at], tick=changed)
    verdict = judge(_Short(recording, steps), recording.robot_text)  # type: ignore[arg-type]
    assert not verdict.ok
    assert verdict.first is not None
    assert verdict.first.tick == at
    assert "velocity" in verdict.text()
