"""`gateway replay --only guard`: what was sent to a robot's motors, asked of the guard alone."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import can
import pytest

from gateway.cli.main import main
from gateway.config import resources
from gateway.monitor.allowed import GuardOnly
from gateway.runtime.session import open_session
from protocols.frames import CanFrame, Packet
from protocols.messages import SECOND, Goal, Velocity
from tests.sampled import sampled

INPUT_VELOCITY, ARM = 0x2D, 0x27
"""Ids of ODrive's Set_Input_Vel and Set_Axis_State, of the device at address 1"""
NINE = [
    f"diffbot_{name}"
    for name in (
        "cia402",
        "zlac8015d",
        "vesc",
        "moteus",
        "damiao",
        "robstride",
        "myactuator",
        "cubemars",
        "robomaster",
    )
]
Change = Callable[[Packet, CanFrame], Iterator[Packet]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench of two ODrives: 5 rad/s of one, up and down again."""
    path = tmp_path_factory.mktemp("allowed") / "run.mcap"
    with open_session("bench", simulated=True, record=path) as session:
        for tick in session.run(1.4):
            if tick.now > 0.6 * SECOND:
                session.submit(Velocity("left", 5.0 if tick.now < SECOND else 0.0))
    return path


@pytest.fixture(scope="module")
def frames(recorded: Path) -> Sequence[Packet]:
    """All frames of it in their order."""
    from gateway.recording import read_recording

    ticks = read_recording(recorded).ticks
    return [packet for tick in ticks for packet in (*tick.inputs.packets, *tick.outputs.packets)]


def log(path: Path, packets: Sequence[Packet], change: Change) -> Path:
    """Write a candump log of what a function makes of each frame."""
    with can.CanutilsLogWriter(path) as writer:
        for packet in packets:
            frame = packet.frame
            assert isinstance(frame, CanFrame)
            for each in change(packet, frame):
                made = each.frame
                assert isinstance(made, CanFrame)
                data = None if made.remote else made.data
                writer.on_message_received(
                    can.Message(
                        timestamp=1_700_000_000.0 + each.t / SECOND,
                        arbitration_id=made.id,
                        data=data,
                        dlc=made.requested if made.remote else len(made.data),
                        is_extended_id=made.extended,
                        is_remote_frame=made.remote,
                        channel="can0",
                    )
                )
    return path


def as_it_is(packet: Packet, _frame: CanFrame) -> Iterator[Packet]:
    yield packet


def with_velocity(factor: float) -> Change:
    """Send another velocity in the place of each that was not 0."""

    def change(packet: Packet, frame: CanFrame) -> Iterator[Packet]:
        if frame.id == INPUT_VELOCITY:
            velocity, torque = struct.unpack("<ff", frame.data)
            frame = replace(frame, data=struct.pack("<ff", velocity * factor, torque))
        yield replace(packet, frame=frame)

    return change


def mirrored(packet: Packet, frame: CanFrame) -> Iterator[Packet]:
    """Turn the sign of one frame under way: a jump from 5 to -5 rad/s."""
    turned = with_velocity(-1.0) if 0.8 * SECOND < packet.t < 0.81 * SECOND else as_it_is
    yield from turned(packet, frame)


def reconfigured(packet: Packet, frame: CanFrame) -> Iterator[Packet]:
    """Write a limit of the device while it turns (Set_Limits)."""
    yield packet
    if frame.id == INPUT_VELOCITY and 0.8 * SECOND < packet.t < 0.81 * SECOND:
        yield replace(packet, frame=CanFrame(0x2F, struct.pack("<ff", 1000.0, 1000.0)))


# fmt: off
FOREIGN: list[tuple[Change, int, str]] = [
    # what somebody sends, the exit status, and what is told
    (as_it_is, 0, r"left: \d+ frames to it, 0 would have been blocked\nright: "),
    (with_velocity(9.0), 1, r"\n  \d+ times, from 0\.\d+ s on: (velocity|acceleration) beyond the limit "),
    (mirrored, 1, r"left: \d+ frames to it, [12] would have been blocked\n  (once|2 times), from 0\.80\d s"),
    (reconfigured, 0, r"left: \d+ .*\n  (once|2 times), if a person asks for it: left: Write.*1000"),
]
# fmt: on


@pytest.mark.parametrize(("change", "status", "told"), sampled(FOREIGN, 2))
def test_a_foreign_log(
    change: Change,
    status: int,
    told: str,
    frames: Sequence[Packet],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = log(tmp_path / "foreign.log", frames, change)
    assert main(["replay", str(file), "--robot", "bench", "--only", "guard"]) == status
    assert re.search(told, printed := capsys.readouterr().out), printed


def test_a_recording_is_judged_by_its_own_robot_file_or_by_another(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(recorded), "--only", "guard"]) == 0
    stricter = tmp_path / "stricter.toml"
    text = resources.find("robots", "bench").read_text()
    stricter.write_text(re.sub(r"velocity = [\d.]+", "velocity = 2.0", text))
    assert main(["replay", str(recorded), "--only", "guard", "--robot", str(stricter)]) == 1
    assert re.search(r"velocity beyond the limit \([\d.]+, limit 2\)", capsys.readouterr().out)


def test_wrong_arguments_are_told(
    recorded: Path, frames: Sequence[Packet], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = log(tmp_path / "foreign.log", frames[:50], as_it_is)
    for arguments, told in (
        ([str(file)], "is a log of CAN: --robot ROBOT says whose devices"),
        ([str(recorded), "--report", "x.html"], "leave --report away"),
    ):
        assert main(["replay", *arguments, "--only", "guard"]) == 2
        assert told in capsys.readouterr().err


@pytest.mark.prove
@pytest.mark.parametrize("robot", NINE)
def test_of_what_the_gateway_itself_sends_nothing_would_have_been_blocked(robot: str) -> None:
    with open_session(robot, simulated=True) as session:
        guard = GuardOnly(session.robot, 0)
        session.submit(Goal(0.3, 0.1))
        for tick in session.run(0.7):
            for packet in (*tick.inputs.packets, *tick.outputs.packets):
                guard.take(packet)
    assert guard.sound, guard.lines()
    assert re.match(r"left: \d\d+ frames to it, 0 would", guard.lines()[0])
