"""The load of a bus, counted on the kernel's own: bit lengths, frames of each id, and what they cost.

No interface here has a bit rate, and the machine may be busy. So frames are counted against the steps that
were made, too; a wire's share is the exact length of the frames that candump saw."""

from __future__ import annotations

import re
import subprocess
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from gateway.buses.frame_time import frame_bits, frame_time
from gateway.config import load_robot
from gateway.core.tick import Tick
from gateway.recording import read_recording
from gateway.runtime.schedule import count_buses
from protocols.frames import CanFrame
from protocols.messages import SECOND, Nanos
from tests.gateway.processes import eventually
from tests.real_can.candump import Seen, candump, listeners, parse
from tests.real_can.pair import SHIPPED, connected
from tests.real_can.programs import Program
from tests.real_can.springs import ROBOTS

SETTLED, END = 2, 7
"""s after the first step, between which is counted."""
FEW = 2.0
"""Frames per second that an id may differ: those every 100 ms go out a step later on some clocks."""
SECONDS = "2"
"""That are counted of a run; a busy one takes minutes of the host."""
BITS = re.compile(r"vcan0@\d+ +(\d+) +(\d+)")
"""A line of canbusload: frames and bits of a second."""


def ids(frames: Iterable[CanFrame]) -> Counter[str]:
    """Number of frames by id, in hexadecimal."""
    return Counter(str(frame).partition("#")[0] for frame in frames)


def test_bit_lengths_are_those_of_canbusload(vcan0: str, tmp_path: Path) -> None:
    log, load = tmp_path / "candump.log", tmp_path / "canbusload.txt"
    with (
        candump(vcan0, log),
        load.open("w") as output,
        subprocess.Popen(["canbusload", "-e", f"{vcan0}@1000000"], stdout=output) as counting,
    ):
        assert eventually(lambda: listeners(vcan0) == 2)  # candump, and this
        for form in ((), ("-e",), ("-R", "-L0"), ("-e", "-R", "-L0")):
            subprocess.run(["cangen", vcan0, "-g1", "-n200", *form], check=True)
        time.sleep(2.5)
        counting.terminate()
    seen = [one.frame for one in parse(log.read_text())]
    frames, bits = (sum(map(int, column)) for column in zip(*BITS.findall(load.read_text()), strict=True))
    assert len(seen) == frames == 800
    assert sum(sum(frame_bits(frame)) for frame in seen) == bits


# -- frames per second ----------------------------------------------------------------------------


@pytest.mark.prove
@pytest.mark.parametrize(
    "name", ["diffbot", "diffbot_cia402", "diffbot_damiao", "diffbot_robstride", "diffbot_moteus"]
)
def test_frames_of_each_id_are_those_of_the_schedule(name: str, vcan0: str, tmp_path: Path) -> None:
    recording, log = tmp_path / "drive.mcap", tmp_path / "candump.log"
    robot = SHIPPED / f"{name}.toml"
    asked = ("--record", str(recording))
    with candump(vcan0, log), connected(tmp_path, robot, (vcan0, vcan0), *asked) as (run, twin):
        run.until("is running")
        for _ in range(5 * END + 5):
            run.ask(name, "drive 0 0")
            time.sleep(0.2)
        run.end()
        twin.end()
    ticks, seen = list(read_recording(recording).ticks), parse(log.read_text())
    period = load_robot(robot).period
    (began, first), (ended, last) = (place(ticks, seen, at * SECOND) for at in (SETTLED, END))
    seconds = (ended - began) / SECOND
    steps = len({(tick.now - ticks[0].now) // period for tick in ticks if began <= tick.now < ended})
    counted, schedule = ids(one.frame for one in seen[first:last]), count_buses(load_robot(robot))[0].frames
    print(f"{name}: {seconds:.3f} s, {steps} steps, {counted.total() / seconds:.1f} frames/s")
    wrong = {}
    for one in sorted(counted | schedule):
        by_second, by_step = counted[one] / seconds, counted[one] / steps * SECOND / period
        print(f"{one}: schedule {schedule[one]}, counted {by_second:.1f}/s, by steps {by_step:.1f}/s")
        if min(abs(found - schedule[one]) for found in (by_second, by_step)) > max(FEW, 0.02 * schedule[one]):
            wrong[one] = (schedule[one], by_second, by_step)
    assert not wrong


def place(ticks: Sequence[Tick], seen: Sequence[Seen], at: Nanos) -> tuple[Nanos, int]:
    """The first step from a moment on that sends an id that only we send, and where candump has its frame.

    candump has seen all of those, in order: so they need no common clock."""
    sent = {key(p.frame) for tick in ticks for p in tick.outputs.packets if p.bus == "can0"}
    ours = sent - {key(p.frame) for tick in ticks for p in tick.inputs.packets if p.bus == "can0"}
    steps = [t.now for t in ticks for p in t.outputs.packets if p.bus == "can0" and key(p.frame) in ours]
    places = [number for number, one in enumerate(seen) if key(one.frame) in ours]
    assert len(steps) == len(places)
    found = bisect_left(steps, ticks[0].now + at)
    return steps[found], places[found]


def key(frame: object) -> tuple[int, bool]:
    """The id of a CAN frame, and whether it is a remote frame."""
    assert isinstance(frame, CanFrame)
    return frame.id, frame.remote


# -- twelve actuators -----------------------------------------------------------------------------


@pytest.mark.prove
@pytest.mark.parametrize(
    ("name", "rate"),
    [("twelve_damiao", 200), ("twelve_damiao", 670), ("twelve_moteus", 200), ("twelve_moteus", 317)],
)
def test_every_step_is_a_command_and_an_answer_of_each_of_twelve_motors(
    name: str, rate: int, vcan: Callable[[], str], tmp_path: Path
) -> None:
    path = ROBOTS / f"{name}.toml"
    robot = load_robot(path)
    interfaces = {bus: vcan() for bus in robot.buses}
    buses = [f"{bus}=socketcan:{interface}" for bus, interface in interfaces.items()]
    with ExitStack() as stack:
        for interface in interfaces.values():
            stack.enter_context(candump(interface, tmp_path / interface))
        options = [word for bus in buses for word in ("--bus", bus)]
        twin = stack.enter_context(Program(tmp_path, "twin", str(path), *options))
        twin.until("to run the robot:\n")
        run = stack.enter_context(Program(tmp_path, "springs", str(path), str(rate), SECONDS, *buses))
        run.until("counting")
        before = processor_time(twin)
        run.until("counted")
        twins = processor_time(twin) - before
        run.end(None)
        twin.end()
    began, ended, steps, missed, used = map(int, run.text.split("counted ")[1].split()[:5])
    took = ended - began
    print(f"{name} at {rate} Hz: {steps} steps in {took / SECOND:.2f} s, {missed} missed")
    for who, time_used in (("springs", used), ("twin", twins)):
        print(f"{who}: {time_used / steps / 1e3:.0f} us of processor a step, {time_used / took:.1%}")
    for bus, interface in interfaces.items():
        seen = parse((tmp_path / interface).read_text())
        frames = [one.frame for one in seen if began <= one.seconds * SECOND < ended]
        settings, counted = robot.buses[bus], ids(frames)
        wire = sum(frame_time(frame, settings.bitrate, settings.data_bitrate) for frame in frames)
        print(f"{bus}: {len(frames) / took * SECOND:.0f} frames/s, {wire / took:.1%} of the wire")
        assert len(counted) == 2 * sum(motor.bus == bus for motor in robot.motors.values())
        assert all(abs(number / steps - 1.0) < 0.02 for number in counted.values()), counted


def processor_time(program: Program) -> int:
    """Nanoseconds that it has run."""
    return int(Path(f"/proc/{program.pid}/schedstat").read_text().split()[0])
