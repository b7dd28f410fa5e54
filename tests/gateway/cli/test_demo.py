"""`gateway demo`: its figures, its recording, and what a replay of that finds. One drive serves all tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from brain.bodies.body import Base
from gateway import config
from gateway.cli.tour import TourLeg
from gateway.recording import read_recording
from protocols.messages import Feedback, Imu, LaserScan, State
from tests.sampled import sampled

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
        timeout=1500,
        check=False,
    )


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    out = tmp_path_factory.mktemp("demo")
    home = tmp_path_factory.mktemp("home")
    done = gateway("demo", "--fast", "--out", str(out), home=str(home))
    return Drive(out, done.stdout + done.stderr, done.returncode)


@pytest.fixture(scope="module")
def leg(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of the way to one goal."""
    out = tmp_path_factory.mktemp("leg")
    done = gateway("demo", "--fast", "--goal", "1.6,0.6", "--out", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    return out / "demo.mcap"


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


@pytest.mark.parametrize("seed", sampled(["4711", "0"], 2))
def test_a_replay_gives_the_same_bytes_whatever_the_hash_seed(leg: Path, seed: str) -> None:
    done = gateway("replay", str(leg), PYTHONHASHSEED=seed)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the same, byte for byte" in done.stdout
    found = re.search(r"compared (\d+) ticks, (\d+) packets with (\d+) bytes", done.stdout)
    assert found
    assert all(int(n) > 500 for n in found.groups())
    assert "0 left over" in done.stdout


def test_one_changed_limit_is_found_and_named_and_the_exit_status_is_1(leg: Path, tmp_path: Path) -> None:
    robot = tmp_path / "other.toml"
    text = read_recording(leg).robot_text
    robot.write_text(text.replace("acceleration = 60.0", "acceleration = 30.0", 1))
    done = gateway("replay", str(leg), "--robot", str(robot))
    assert done.returncode == 1
    assert "NOT the same" in done.stdout
    assert "motors.left.limits.acceleration: 60.0 recorded, 30.0 now" in done.stdout
    assert re.search(r"(left|right): Velocity -?[\d.]+ rad/s", done.stdout)
    compared = re.search(r"(\d+) packets with", done.stdout)
    assert compared
    assert int(compared[1]) > 100


# -- other bodies, and missions -----------------------------------------------------------------------

SIDEWAYS = """
[[steps]]
drive = 0.0
left = 0.3
distance = 0.15

[[steps]]
wait = 0.1
"""


def test_a_mission_of_another_body(tmp_path: Path) -> None:
    mission = tmp_path / "sideways.toml"
    mission.write_text(SIDEWAYS)
    out = tmp_path / "out"
    done = gateway("demo", "--fast", "--robot", "mecanum", "--mission", str(mission), "--out", str(out))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "mission sideways done" in done.stdout
    driven = re.search(r"path driven: ([\d.]+) m", done.stdout)
    assert driven
    assert 0.12 < float(driven[1]) < 0.2
    assert (out / "demo.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("planned", "seconds"),
    [(0.2, 1.0), (0.45, 1.5), (4.5, 8.25)],  # by hand: s = a t² / 4 up to v² / a, then s / v + v / a
)
def test_the_least_time_of_a_leg(planned: float, seconds: float) -> None:
    body = config.load_robot("diffbot").brain.body
    assert isinstance(body, Base)
    assert (body.max_linear, body.max_linear_acceleration) == (0.6, 0.8)
    assert TourLeg(0, planned).least(body) == pytest.approx(seconds)
