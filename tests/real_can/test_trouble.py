"""A drive on a real CAN bus in trouble: the interface goes down and comes up; other nodes flood the bus."""

from __future__ import annotations

import re
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from protocols.frames import CanFrame
from tests.real_can.candump import candump, parse
from tests.real_can.conftest import bus_ends, ip
from tests.real_can.pair import rover

AXIS_STATE, VELOCITY, IDLE = 0x07, 0x0D, 1
"""Messages of an ODrive (Set_Axis_State, Set_Input_Vel), and the idle state."""
NODES = (1, 2)


def to(node: int, message: int) -> int:
    return node << 5 | message


@pytest.mark.parametrize(
    "bitrate",
    [pytest.param(0, marks=pytest.mark.prove), pytest.param(1_000_000, marks=pytest.mark.controllers)],
)
def test_interface_goes_down_and_comes_back_while_driving(bitrate: int, tmp_path: Path) -> None:
    """The motors have no watchdog, and go on turning meanwhile."""
    log = tmp_path / "candump.log"
    with (
        bus_ends(bitrate) as ends,
        candump(ends[1], log),
        rover(tmp_path, bitrate, ends, "--goal", "1.4,0") as (run, twin),
    ):
        run.until("left: armed", "right: armed")
        time.sleep(0.4)
        mark = len(run.text)
        ip("link", "set", ends[0], "down")
        mark = run.until("can0: has vanished", "left: fault: ", "right: fault: ", after=mark)
        ip("link", "set", ends[0], "up")
        up = time.time()
        mark = run.until("can0: is back", "left: ready", "right: ready", after=mark)
        time.sleep(0.3)
        assert "fault: " in run.ask("rover", "status")
        cleared = time.time()
        run.ask("rover", "clear")
        mark = run.until("left: ClearFault: done", "right: ClearFault: done", "brain: ready", after=mark)
        run.ask("rover", "goal 0.7 0")
        run.until("reached", after=mark)
        assert run.end() == 0, run.text
        twin.end()
        print(run.text, twin.text)
    between = [one.frame for one in parse(log.read_text()) if up <= one.seconds <= cleared]
    assert_safe(between)


def assert_safe(frames: list[CanFrame]) -> None:
    """Both motors were commanded to idle, and none to turn."""
    for node in NODES:
        states = {f.data[:4] for f in frames if f.id == to(node, AXIS_STATE) and not f.remote}
        assert states == {struct.pack("<I", IDLE)}
        speeds = [struct.unpack("<ff", f.data)[0] for f in frames if f.id == to(node, VELOCITY)]
        assert all(speed == 0.0 for speed in speeds), speeds


@contextmanager
def flood(interface: str) -> Iterator[None]:
    """While inside, other nodes send: another ODrive's messages, extended ids, requests, CAN FD, bursts."""
    others = [
        "-g4 -I105 -L8 -Dr",
        "-g8 -e -I1ABCDEF0",
        "-g8 -R -I2A7",
        "-g20 -f -I305 -L64",
        "-g300 -c100 -I4F1",
    ]
    with ExitStack() as stack:
        for other in others:
            sender = stack.enter_context(subprocess.Popen(["cangen", interface, "-i", *other.split()]))
            stack.callback(sender.terminate)
        yield


def test_a_flood_of_other_frames_disturbs_nothing(tmp_path: Path) -> None:
    with bus_ends(0) as ends, rover(tmp_path, 0, ends, "--goal", "0.4,0") as (run, twin):
        run.until("rover is running")
        with flood(ends[0]):
            run.until("goal 1 reached")
            reply = run.ask("rover", "status")
        status = run.end()
        twin.end()
        print(run.text, twin.text, reply)
    assert status == 0, run.text
    counted = re.search(r"can0: (\d+) messages accepted, (\d+) malformed, (\d+) ignored", reply)
    assert counted is not None, reply
    accepted, malformed, ignored = map(int, counted.groups())
    assert accepted > 100
    assert malformed == 0
    assert ignored > 300
    assert "fault" not in run.text
