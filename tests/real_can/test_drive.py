"""`gateway run` and `gateway twin`, two processes on a real CAN: a goal, the recording, what others see.

Over ODrive on each wire; over CiA 402, moteus, and the three on one CAN FD bus, on a virtual one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from gateway.recording import read
from protocols.wire import CanFrame, Packet
from tests.real_can.candump import Seen, candump, in_order, parse
from tests.real_can.conftest import WIRES, wire
from tests.real_can.programs import Program
from tests.real_can.rover import rover


@dataclass(frozen=True, slots=True)
class Robot:
    """Which robot drives, on which wire, and what it says."""

    name: str
    bitrate: int
    """Of the wire; 0 on a virtual one."""
    kinds: frozenset[bool]
    """Of the frames that go out: True is CAN FD."""
    ids: int
    """So many ids, at least, are ours alone."""
    then: tuple[tuple[str, str], ...] = ()
    """What is asked when it has arrived, and what is said to that."""


ROVERS = [
    pytest.param(
        Robot("rover", int(str(wired.values[0])), frozenset({False}), 4), id=wired.id, marks=wired.marks
    )
    for wired in WIRES
]
LANGUAGES = [
    Robot("rover_cia402", 0, frozenset({False}), 4),
    Robot("rover_moteus", 0, frozenset({True}), 2),
    Robot("rover_mixed", 0, frozenset({False, True}), 6, (("velocity arm 1", "arm: armed"),)),
]


@dataclass(frozen=True, slots=True)
class Drive:
    """What is left of a drive."""

    robot: Robot
    status: int
    said: str
    recording: Path
    seen: list[Seen]
    """By candump, on our end."""


@pytest.fixture(scope="module", params=[*ROVERS, *(pytest.param(one, id=one.name) for one in LANGUAGES)])
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Drive:
    robot: Robot = request.param
    folder = tmp_path_factory.mktemp("drive")
    recording, log = folder / "drive.mcap", folder / "candump.log"
    asked = ("--goal", "0.4,0", "--record", str(recording))
    with (
        wire(robot.bitrate) as ends,
        candump(ends[0], log),
        rover(folder, robot.bitrate, ends, *asked, name=robot.name) as (run, twin),
    ):
        run.until("goal 1 reached", patience=60.0)
        for line, seen in robot.then:
            run.ask(robot.name, line)
            run.until(seen)
        status = run.end()
        twin.end()
        print(run.text, twin.text)
        return Drive(robot, status, run.text, recording, parse(log.read_text()))


def test_goal_is_reached(drive: Drive) -> None:
    assert drive.status == 0, drive.said
    assert "fault" not in drive.said


def test_recording_is_replayed_to_the_same_bytes(drive: Drive, tmp_path: Path) -> None:
    with Program(tmp_path, "replay", str(drive.recording)) as replay:
        assert replay.end(None) == 0, replay.text
        assert replay.text.startswith("the same, byte for byte\ncompared "), replay.text


def test_candump_reads_what_we_sent(drive: Drive) -> None:
    ticks = list(read(drive.recording).ticks)
    sent = [frame_of(p) for tick in ticks for p in tick.outputs.packets if p.bus == "can0"]
    heard = [frame_of(p) for tick in ticks for p in tick.inputs.packets if p.bus == "can0"]
    seen = [one.frame for one in drive.seen]
    assert len(sent) > 50
    assert in_order(sent, seen)
    assert in_order(heard, seen)
    theirs = {(frame.id, frame.remote) for frame in heard}
    ours = {(frame.id, frame.remote) for frame in sent} - theirs
    assert len(ours) >= drive.robot.ids
    assert {frame.fd for frame in sent} == drive.robot.kinds
    assert [f for f in seen if (f.id, f.remote) in ours] == [f for f in sent if (f.id, f.remote) in ours]


def frame_of(packet: Packet) -> CanFrame:
    assert isinstance(packet.wire, CanFrame)
    return packet.wire
