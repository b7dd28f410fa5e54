"""`gateway run` and `gateway twin`, two processes on a real CAN: a goal, the recording, what candump sees.

The shipped robots of each protocol, and of three on one bus, on a virtual bus; a rover between two
controllers. The tier drives the three languages on one CAN FD bus, and one rover; all are
driven by `python -m tests.real_can pytest tests/real_can/test_drive.py`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from gateway.recording import read_recording
from protocols.frames import CanFrame, Packet
from tests.real_can.candump import Seen, candump, in_order, parse
from tests.real_can.conftest import bus_ends
from tests.real_can.pair import SHIPPED, Pair, connected, rover
from tests.real_can.programs import Program


@dataclass(frozen=True, slots=True)
class Robot:
    """Which robot drives, and what its frames are."""

    name: str
    kinds: frozenset[bool]
    """Of the frames sent: True is CAN FD."""
    ids: int
    """Number of ids, at least, that only we send."""
    bitrate: int = 0
    """0 on a virtual bus."""
    then: tuple[tuple[str, str], ...] = ()
    """Requests after it has arrived, and the expected output."""


CLASSIC, FD = frozenset({False}), frozenset({True})
ROBOTS = [
    pytest.param(Robot("diffbot", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_cia402", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_cubemars", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_damiao", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_moteus", FD, 2), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_myactuator", CLASSIC, 2), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_robomaster", CLASSIC, 1), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_robstride", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_vesc", CLASSIC, 4), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_zlac8015d", CLASSIC, 3), marks=pytest.mark.prove),
    pytest.param(Robot("diffbot_mixed_can", CLASSIC, 7), marks=pytest.mark.prove),
    Robot("diffbot_mixed", CLASSIC | FD, 6, then=(("velocity mast 1", "mast: armed"),)),
    pytest.param(Robot("rover", CLASSIC, 4, 500_000), marks=[pytest.mark.controllers, pytest.mark.prove]),
    pytest.param(Robot("rover", CLASSIC, 4, 1_000_000), marks=pytest.mark.controllers),
]


def title(robot: Robot) -> str:
    return f"{robot.name}-{robot.bitrate // 1000}k" if robot.bitrate else f"{robot.name}-vcan0"


@dataclass(frozen=True, slots=True)
class Drive:
    """The results of a drive."""

    robot: Robot
    status: int
    text: str
    recording: Path
    seen: list[Seen]
    """By candump, on our end."""


@contextmanager
def driving(folder: Path, robot: Robot, ends: tuple[str, str], *arguments: str) -> Iterator[Pair]:
    if robot.bitrate:
        with rover(folder, robot.bitrate, ends, *arguments) as pair:
            yield pair
    else:
        with connected(folder, SHIPPED / f"{robot.name}.toml", ends, *arguments) as pair:
            yield pair


@pytest.fixture(scope="module", params=ROBOTS, ids=title)
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    robot: Robot = request.param
    folder = tmp_path_factory.mktemp("drive")
    recording, log = folder / "drive.mcap", folder / "candump.log"
    asked = ("--goal", "0.4,0.1", "--record", str(recording))
    with (
        bus_ends(robot.bitrate) as ends,
        candump(ends[0], log),
        driving(folder, robot, ends, *asked) as (run, twin),
    ):
        run.until("goal 1 reached")
        for line, seen in robot.then:
            run.ask(robot.name, line)
            run.until(seen)
        status = run.end()
        twin.end()
        print(run.text, twin.text)
        return Drive(robot, status, run.text, recording, parse(log.read_text()))


def test_goal_is_reached(drive: Drive) -> None:
    assert drive.status == 0, drive.text
    assert "fault" not in drive.text


def test_recording_is_replayed_to_the_same_bytes(drive: Drive, tmp_path: Path) -> None:
    with Program(tmp_path, "replay", str(drive.recording)) as replay:
        assert replay.end(None) == 0, replay.text
        assert replay.text.startswith("the same, byte for byte\ncompared "), replay.text


def test_candump_reads_what_we_sent(drive: Drive) -> None:
    ticks = list(read_recording(drive.recording).ticks)
    sent = [frame_of(p) for tick in ticks for p in tick.outputs.packets if p.bus == "can0"]
    received = [frame_of(p) for tick in ticks for p in tick.inputs.packets if p.bus == "can0"]
    seen = [one.frame for one in drive.seen]
    assert len(sent) > 50
    assert in_order(sent, seen)
    assert in_order(received, seen)
    theirs = {(frame.id, frame.remote) for frame in received}
    ours = {(frame.id, frame.remote) for frame in sent} - theirs
    assert len(ours) >= drive.robot.ids
    assert {frame.fd for frame in sent} == drive.robot.kinds
    assert [f for f in seen if (f.id, f.remote) in ours] == [f for f in sent if (f.id, f.remote) in ours]


def frame_of(packet: Packet) -> CanFrame:
    assert isinstance(packet.frame, CanFrame)
    return packet.frame
