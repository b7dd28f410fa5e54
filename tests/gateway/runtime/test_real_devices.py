"""Hardware in the loop: some devices real, the others twins, in a world that follows real shafts.

"Real" are twins in another process, behind ptys, moved in step: no test here depends on the machine."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Self

import pytest

from gateway import config, open_session
from gateway.buses import Bus, open_bus
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.cli.main import main
from gateway.core.clock import SimulatedClock
from gateway.core.robot import TWIN, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import ConfigError, UserError
from gateway.runtime.scenario import verdicts
from gateway.runtime.scenario_file import parse_scenario
from gateway.runtime.session import Session
from gateway.sim import WorldFile, parse_world
from protocols.frames import BusState, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Goal, Instruction, Nanos, Stop, Velocity
from tests.gateway.processes import Process
from tests.gateway.runtime.real_bench import PATIENCE, amount

ROOT = Path(__file__).parents[3]


class RealBench:
    """A session with real devices in another process, in simulated time."""

    def __init__(
        self, name: str, real: Sequence[str], record: Path | None = None, world: WorldFile | None = None
    ) -> None:
        plain = config.load_robot(name)
        wired = list(dict.fromkeys(one.bus for one in plain.devices() if one.name in real))
        self.clock = SimulatedClock()
        self.happens: list[tuple[str, str]] = []
        """What is to happen there: a method of its world, and a device."""
        self._written = dict.fromkeys(wired, 0)
        self._sent = dict.fromkeys(wired, 0)
        self._stepped: Nanos = -1
        self._opened = ExitStack()
        self._running: Generator[Tick] | None = None
        robot = config.load_robot(name, real=real) if real else plain
        if wired:
            self._start(name, wired)
            robot = config.with_interfaces(robot, json.loads(self._answer()))
        self.robot = robot
        self.world: TwinWorld = open_world(robot, 1, world)
        buses: dict[str, Bus] = {
            n: self.world.buses[n] if one.interface == TWIN else Counted(open_bus(one, self.clock), self)
            for n, one in robot.buses.items()
        }
        for bus in buses.values():
            self._opened.callback(bus.close)
        self._simulated = [one for one in robot.motors if one not in self.world.followed]
        self.session = Session(robot, Gateway(robot), self.clock, buses, self.world)
        if record is not None:
            self.session.start_recording(record)

    def _start(self, name: str, wired: Sequence[str]) -> None:
        command = [sys.executable, "-m", "tests.gateway.runtime.real_bench", name, ",".join(wired)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1, cwd=ROOT
        )
        self._opened.callback(self._process.communicate)
        self._opened.callback(self._process.kill)

    def _answer(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, f"the devices' process has ended: {self._process.wait()}"
        return line

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._opened:
            self.session.end()

    def run(
        self, seconds: float, *asked: Instruction, until: Callable[[], bool] = lambda: False
    ) -> list[Tick]:
        """Run on; return the ticks. It begins with what is asked."""
        self.session.submit(*asked)
        end = self.clock.now() + round(seconds * SECOND)
        ticks: list[Tick] = []
        for tick in self._ticks():
            ticks.append(tick)
            if tick.now >= end or until():
                break
        return ticks

    def _ticks(self) -> Generator[Tick]:
        if self._running is None:
            self._running = self._opened.enter_context(closing(self.session.run()))
        return self._running

    def written(self, bus: str, frames: Sequence[Frame]) -> None:
        """Count what is on its way there."""
        self._written[bus] += amount(frames)

    def step(self, now: Nanos) -> None:
        """Let the devices come as far; once at each time."""
        if now <= self._stepped:
            return
        self._stepped = now
        shafts = {name: self.world.world.shaft(name) for name in self._simulated}
        step = {"t": now, "written": self._written, "shafts": shafts, "happens": self.happens}
        self.happens = []
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(step) + "\n")
        self._sent = json.loads(self._answer())

    def sent(self, bus: str) -> int:
        """Return how much the devices have sent."""
        return self._sent[bus]


class Counted:
    """A real bus that is read until all has come that was sent."""

    def __init__(self, bus: Bus, bench: RealBench) -> None:
        self.name, self._bus, self._bench = bus.name, bus, bench
        self._received = 0

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        self._bench.step(now)
        states: list[BusState] = []
        packets: list[Packet] = []
        end = time.monotonic() + PATIENCE
        while True:
            more, came = self._bus.read(now)
            states += more
            packets += came
            if self._received + amount(packets) >= self._bench.sent(self.name):
                break
            assert time.monotonic() < end, f"{self.name}: only {amount(packets)} have come"
        self._received += amount(packets)
        return states, packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self._bus.write(now, frames)
        self._bench.written(self.name, frames)

    def close(self) -> None:
        self._bus.close()


# -- a mix reaches its goal ------------------------------------------------------------------------------

MIXES = {
    "none": (),
    "wheels": ("left", "right"),
    "both": ("left", "right", "lidar"),
    "lidar": ("lidar",),
}


@pytest.mark.sample(1)
@pytest.mark.parametrize("mix", MIXES)
def test_a_robot_with_real_devices_in_a_simulated_world_reaches_its_goal(mix: str) -> None:
    with RealBench("diffbot", MIXES[mix]) as bench:
        assert set(bench.world.followed) == set(MIXES[mix]) & {"left", "right"}
        bench.run(1.0)
        begin = bench.world.world.truth()
        bench.run(9.0, Goal(0.6, 0.1), until=lambda: bench.session.belief.reached == 1)
        truth = bench.world.world.truth()
        assert bench.session.belief.reached == 1, bench.session.belief.reason
        assert (truth.x - begin.x, truth.y - begin.y) == pytest.approx((0.6, 0.1), abs=0.06)
        assert bench.world.world.contacts() == 0
        assert bench.session.gateway.in_fault() == ""
        counts = {name: one.count for name, one in bench.session.latencies.found.items()}
        assert counts.keys() == set(MIXES[mix])
        assert all(count > 20 for count in counts.values())


# -- what happens to a real joint while the world goes on ------------------------------------------------


def faults(bench: RealBench, motor: str) -> str:
    return "; ".join(one.name for one in bench.session.joints[motor].faults.values())


# fmt: off
ACCIDENTS = [
    # what happens to the real motor, what is told, and within which time [s]: the robot file's, and a period
    ("disconnect", "silent: no feedback for more than 100 ms", 0.12),
    ("hold", "does not follow its set-points", 0.6),
    ("reset", "", 0.6),
]
# fmt: on


@pytest.mark.parametrize(("what", "told", "within"), ACCIDENTS)
def test_a_real_joint_that_fails_while_the_world_goes_on_is_told_in_its_time_and_safe(
    what: str, told: str, within: float
) -> None:
    with RealBench("bench", ["left"]) as bench:
        bench.run(0.8)
        bench.run(1.0, Velocity("left", 4.0), Velocity("right", 4.0))
        shaft = bench.world.world.shaft("left")
        assert shaft[1] == pytest.approx(4.0, abs=0.4)  # the world's has followed
        assert bench.world.world.shaft("right")[1] == pytest.approx(4.0, abs=0.4)
        bench.happens = [(what, "left")]
        begin = bench.clock.now()
        bench.run(within, until=lambda: bool(faults(bench, "left")))
        assert bench.clock.now() - begin <= within * SECOND + 10 * MILLISECOND
        assert faults(bench, "left")
        assert told in faults(bench, "left")
        bench.run(0.6)
        assert not bench.session.joints["left"].armed or what == "disconnect"
        assert bench.world.world.shaft("right")[1] == pytest.approx(4.0, abs=0.4)  # on_fault = "continue"
        if what != "reset":  # which coasts
            assert bench.world.world.shaft("left")[1] == pytest.approx(0.0, abs=1e-9)


def test_a_wheel_that_begins_again_at_zero_does_not_leap_in_the_world() -> None:
    """Its device restarts after some turns."""
    with RealBench("bench", ["left"]) as bench:
        bench.run(0.8)
        bench.run(2.0, Velocity("left", 6.0))
        bench.happens = [("reset", "left")]
        last, fastest = bench.world.world.shaft("left")[0], 0.0
        for _ in range(40):
            bench.run(0.02)
            now = bench.world.world.shaft("left")[0]
            last, fastest = now, max(fastest, abs(now - last))
        assert last > 6.0
        assert fastest < 0.3


SCENARIO = """name = "a real motor and a simulated one"
robot = "bench"
seconds = 2.5
asks.left = { at = 0.8, line = "velocity left 4" }
asks.right = { at = 0.8, line = "velocity right 4" }
loads.heavy = { at = 1.6, on = "right", torque = -0.5 }
must.turn.real = { after = "left", within = 0.6, on = "left", velocity = 4.0, tolerance = 0.5 }
must.turn.twin = { after = "heavy", within = 0.5, on = "right", velocity = 4.0, tolerance = 0.5 }
"""


def test_a_scenario_runs_with_real_devices_which_it_cannot_break() -> None:
    with RealBench("bench", ["left"]) as bench:
        scenario = parse_scenario(SCENARIO, Path("x.toml"), lambda _: bench.robot)
        found = verdicts(scenario, bench.session)
        assert [one.name for one in found if one.holds] == ["must.turn.real", "must.turn.twin"], found
        wrong = SCENARIO.replace('on = "right", torque', 'on = "left", torque')
        with pytest.raises(ConfigError, match=r"loads\.heavy\.on: 'left' is real: .* expected a simulated"):
            parse_scenario(wrong, Path("x.toml"), lambda _: bench.robot)


# -- a dynamometer -------------------------------------------------------------------------------------------

HEAVY = """kind = "bench"
[shafts.left]
load = -0.6
friction = 0.0
damping = 0.0
"""


@pytest.fixture
def rig(tmp_path: Path) -> str:
    """The file of a bench with a third motor."""
    text = config.load_robot("bench").text.replace('motors = ["left", ', 'motors = ["other", "left", ')
    file = tmp_path / "rig.toml"
    file.write_text(f"{text}\n[motors.other]\naddress = 3\n")
    return str(file)


def test_the_worlds_torque_is_put_on_a_real_shaft_by_a_second_real_motor(rig: str) -> None:
    with RealBench(rig, ["left", "right"], world=parse_world(HEAVY)) as bench:
        bench.happens = [("couple", "left=right")]
        bench.run(0.8)
        bench.run(1.0, Velocity("left", 4.0))
        alone = bench.session.joints["left"].feedback.torque
        assert alone == pytest.approx(0.04, abs=0.06)  # the friction of two shafts
        bench.session.load("left", "right")
        bench.run(1.5)
        joint, brake = bench.session.joints["left"], bench.session.joints["right"]
        assert joint.feedback.torque == pytest.approx(0.64, abs=0.08)
        assert brake.feedback.torque == pytest.approx(-0.6, abs=0.06)
        assert joint.feedback.velocity == pytest.approx(4.0, abs=0.4)
        bench.run(1.0, Stop("a person"))
        assert not brake.armed
        assert bench.session.gateway.in_fault() == ""


def test_what_cannot_be_loaded_is_told() -> None:
    with RealBench("bench", ["left"]) as bench:
        for motor, brake, told in (
            ("right", "left", "'right' .* not a real motor; .*: left"),
            ("left", "right", "'right' cannot load 'left'; .* there is none"),
            ("left", "left", "'left' cannot load 'left'"),
        ):
            with pytest.raises(UserError, match=told):
                bench.session.load(motor, brake)
    with open_session("bench", simulated=True) as session, pytest.raises(UserError, match="not a real motor"):
        session.load("left", "right")


# -- latencies -------------------------------------------------------------------------------------------


def test_latencies_are_measured_shown_and_in_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bench.mcap"
    with RealBench("bench", ["left"], record=file) as bench:
        bench.run(1.0)
        bench.run(1.0, Velocity("left", 4.0), Velocity("right", 2.0))
    found, lines = bench.session.latencies.found, bench.session.latencies.lines()
    assert found.keys() == {"left"}
    assert found["left"].count > 50
    assert 0 < found["left"].share(0.5) <= 15 * MILLISECOND  # ODrive reports every 10 ms
    assert re.match(r"real device +median +99 % +longest +count$", lines[0])
    assert re.match(r"left +command to report +\d+\.\d ms +\d+\.\d ms +\d+\.\d ms +\d+$", lines[1])
    assert main(["replay", str(file)]) == 0
    shown = capsys.readouterr().out
    assert "the same, byte for byte" in shown
    assert all(line in shown.splitlines() for line in lines)


# -- the robot file, and the command line ----------------------------------------------------------------


def buses(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return interface and devices of each bus."""
    return {
        name: (bus.interface, *(one.name for one in robot.devices_on(name)))
        for name, bus in robot.buses.items()
    }


def test_what_is_not_real_is_on_a_simulated_bus() -> None:
    text = config.load_robot("diffbot").text
    text = re.sub(r'interface = "twin"', 'interface = "socketcan:can7"', text, count=1)
    assert buses(config.parse_robot(text)) == {
        "can0": ("socketcan:can7", "left", "right"),
        "sensors": (TWIN, "lidar", "imu"),
    }
    left = config.parse_robot(text, real=["left"])
    assert buses(left) == {
        "can0": ("socketcan:can7", "left"),
        "can0_twins": (TWIN, "right"),
        "sensors": (TWIN, "lidar", "imu"),
    }
    assert len(left.buses["can0"].devices) == 1
    assert buses(config.parse_robot(left.text)) == buses(left)  # a recording has it
    lidar = config.parse_robot(text.replace('protocol = "plain"', 'protocol = "plain"\nreal = true', 1))
    assert lidar.real == ("lidar",)
    assert buses(lidar) == {
        "can0": (TWIN, "left", "right"),
        "sensors": (TWIN, "lidar"),
        "sensors_twins": (TWIN, "imu"),
    }
    with pytest.raises(UserError, match=r"lidar; but .* sensors is 'twin'; say where .*--bus sensors=INTER"):
        open_session(lidar)


def test_a_wrong_name_and_two_answers_are_told() -> None:
    text = config.load_robot("bench").text
    with pytest.raises(ConfigError, match=r"real: .*'lefd'.*'left'"):
        config.parse_robot(text, real=["lefd", "right"])
    with pytest.raises(ConfigError, match="the file has a key 'real'; expected one of both"):
        config.parse_robot(f'real = ["left"]\n{text}', real=["right"])


def test_the_command_runs_a_real_motor_and_shows_its_latency(tmp_path: Path) -> None:
    """On the wall clock: that it works at all; how long anything takes is not judged."""
    ports = tmp_path / "ports"
    with Process(tmp_path, "twin", "bench", "--link", str(ports)) as devices:
        devices.until("to run the robot")
        bus = f"can0=slcan:{ports / 'can0'}"
        with Process(tmp_path, "run", "bench", "--real", "left", "--bus", bus) as robot:
            robot.until("is running")
            devices.until("client connected")
            robot.send_line("quit")
            _, shown = robot.end()
    assert re.search(r"^left +command to report ", shown, re.MULTILINE), shown
