"""The watchdog process: what it sends when the loop dies or hangs, and that it sends nothing else.

Real processes on a bus that they share (udp_multicast, on this machine alone); those on a kernel's CAN are in
tests/real_can. What the loop hands over is judged in simulated time, by what the devices would obey."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

import gateway as gw
from gateway.cli.jog import single_motor
from gateway.config import if_it_dies, parse_robot, with_interfaces
from gateway.core.clock import WallClock
from gateway.core.guard import decoder_of
from gateway.errors import ConfigError
from gateway.runtime.watchdog import WatchdogProcess, covered
from protocols.messages import MILLISECOND, Hold, Idle, Position, Velocity
from tests.gateway.processes import eventually
from tests.gateway.rig import BENCH, WATCHED, Rig
from tests.gateway.runtime.test_leaving import DRIVEN
from tests.real_can.programs import Program
from tests.sampled import sampled

SHARED = f"udp_multicast:239.74.{os.getpid() >> 8 & 0xFF}.{os.getpid() & 0xFF}"


def on_shared(text: str) -> gw.Robot:
    return with_interfaces(parse_robot(text), {"can0": SHARED})


# -- what is handed over -----------------------------------------------------------------------------------


@pytest.mark.sample(2)
@pytest.mark.parametrize("robot", sampled(DRIVEN, 3))
def test_the_frames_of_a_motor_that_turns_stop_it_and_making_them_changes_nothing(robot: str) -> None:
    with gw.open_session(single_motor(gw.load_robot(robot), "left"), simulated=True) as session:
        motor, left = session.robot.motors["left"], session.joints["left"]

        def rehearse() -> list[object]:
            packets = session.gateway.rehearse(session.clock.now(), motor.bus, motor.plugin.name)
            decoder = decoder_of(session.robot, motor.bus)
            return [one for packet in packets for one in decoder.decode(packet.t, packet.frame)]

        list(session.run(1.0))
        session.submit(Velocity("left", 0.5))
        with closing(session.run()) as ticks:
            for _ in ticks:
                before = left.sent
                if left.armed and abs(left.feedback.velocity or 0.0) > 0.3:
                    break
                rehearse()
                assert left.sent is before
            stop = rehearse()
            assert Idle("left") in stop
            assert left.sent is before
            assert not left.faults


def test_a_load_is_held_where_it_is_and_one_that_was_not_commanded_is_left_alone() -> None:
    rig = Rig(BENCH.replace("[motors.left]", '[motors.left]\nstop_action = "hold"'))
    rig.run(0.5)
    assert rig.gateway.rehearse(rig.clock.now(), "can0", "odrive_can") == ()
    rig.run(1.0, Position("left", 2.0))
    decoder = decoder_of(rig.robot, "can0")
    for tick in rig.ticks:
        for sent in tick.outputs.packets:
            decoder.decode(sent.t, sent.frame)
    packets = rig.gateway.rehearse(rig.clock.now(), "can0", "odrive_can")
    obeyed = [one for packet in packets for one in decoder.decode(packet.t, packet.frame)]
    held = [one for one in obeyed if isinstance(one, (Hold, Position))]
    assert held
    assert {getattr(one, "motor", "") for one in obeyed} == {"left"}


class Handed(WatchdogProcess):
    """What is handed over, in place of the process."""

    def __init__(self, robot: gw.Robot, rig: Rig) -> None:
        self.lines: list[object] = []
        self._clock, self._limit = rig.clock, robot.stall_timeout
        self._groups = {("can0", "odrive_can"): list(robot.motors)}
        self._known, self._unsent, self._sent, self._armed, self._pipe = {}, bytearray(), 0, False, 0

    def _hand_over(self, line: object) -> None:
        self.lines.append(line)


def handed(text: str = BENCH) -> tuple[Rig, Handed]:
    rig = Rig(text)
    return rig, Handed(rig.robot, rig)


def test_frames_are_made_when_something_has_changed_and_signs_of_life_come_between() -> None:
    rig, watchdog = handed()
    rig.record = lambda *_: watchdog.beat(rig.gateway)  # type: ignore[assignment]
    rig.run(0.5)
    assert watchdog.lines == [{}] * 10, "nothing is commanded"
    rig.run(1.0, Velocity("left", 5.0))
    made = [line for line in watchdog.lines if line]
    assert 2 <= len(made) <= 12, "until it is armed"
    rig.run(1.0)
    assert [line for line in watchdog.lines if line] == made, "an Idle is the same wherever the shaft is"
    watchdog.rest()
    assert watchdog.lines[-1] is None
    rig.leave()


def test_a_loop_that_has_stood_while_a_motor_was_armed_leaves() -> None:
    rig, watchdog = handed()
    told: list[str] = []
    rig.record = lambda *_: told.append(watchdog.beat(rig.gateway))
    rig.run(0.5)
    rig.clock.wait(rig.clock.now() + 600 * MILLISECOND)
    rig.run(0.5, Velocity("left", 5.0))
    assert set(told) == {""}, "nothing was armed"
    rig.clock.wait(rig.clock.now() + 600 * MILLISECOND)
    rig.run(0.02)
    (why,) = set(told) - {""}
    assert re.search(r"^the loop has stood for 6\d\d ms: after 500 ms", why)
    rig.leave()


@pytest.mark.parametrize(("value", "right"), [(99, False), (100, True), (2000, True), (2001, False)])
def test_the_limit_has_bounds(value: int, right: bool) -> None:
    text = f"stall_timeout_ms = {value}\n{BENCH}"
    if right:
        assert parse_robot(text).stall_timeout == value * MILLISECOND
    else:
        with pytest.raises(ConfigError, match="stall_timeout_ms"):
            parse_robot(text)
    with pytest.raises(ConfigError, match="at least 4 periods"):
        parse_robot("stall_timeout_ms = 300\n" + BENCH.replace("rate_hz = 200", "rate_hz = 10"))


def test_what_stops_each_motor_is_told() -> None:
    simulated = "NOTHING, unless its bus can be shared (socketcan): its own watchdog is off"
    assert if_it_dies(parse_robot(BENCH)) == [f"left, right: {simulated}"]
    serial = with_interfaces(parse_robot(BENCH), {"can0": "slcan:/dev/ttyACM0"})
    alone = "NOTHING: its own watchdog is off, and slcan:/dev/ttyACM0 cannot be shared"
    assert if_it_dies(serial) == [f"left, right: {alone}"]
    assert (covered(serial), covered(on_shared(BENCH))) == ([], ["left", "right"])
    own = "its own watchdog after 200 ms"
    ours = "the watchdog process at once, or after 500 ms if it hangs"
    assert if_it_dies(on_shared(WATCHED)) == [f"left, right: {own}; {ours}"]


# -- the process -------------------------------------------------------------------------------------------


def test_a_process_that_cannot_open_its_bus_says_why_and_ends() -> None:
    absent = with_interfaces(parse_robot(BENCH), {"can0": "socketcan:nosuch0"})
    watchdog = WatchdogProcess(absent, WallClock())
    assert "bus 'can0' cannot be opened as 'socketcan:nosuch0'" in watchdog.ready()
    assert watchdog._process.returncode == 1


@pytest.fixture(scope="module")
def devices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Program]:
    folder = tmp_path_factory.mktemp("twin")
    (folder / "rig.toml").write_text(ROBOT)
    with Program(folder, "twin", str(folder / "rig.toml"), "--bus", f"can0={SHARED}", "-v") as twin:
        twin.until("to run the robot:\n")
        yield twin


STALL = 2000
"""ms: the longest that there is. A machine that does other things for a while makes no fault, either."""
ROBOT = f"stall_timeout_ms = {STALL}\n" + BENCH.replace(
    "limits = {", "feedback_timeout_ms = 2000\ncommand_timeout_ms = 2000\nlimits = {"
)


@pytest.fixture
def robot(devices: Program, tmp_path: Path) -> Iterator[tuple[Program, Program, int]]:
    """A run with a motor that turns, its devices, and what these had printed before."""
    (tmp_path / "rig.toml").write_text(ROBOT)
    mark = len(devices.text)
    with Program(tmp_path, "run", str(tmp_path / "rig.toml"), "--bus", f"can0={SHARED}", "-v") as run:
        run.until("left: ready", "right: ready", "left, right: the watchdog process at once")
        run.ask("rig", "velocity left 5")
        run.until("left: armed")
        assert eventually(lambda: last_mode(devices, mark) == "armed")
        yield run, devices, mark


def last_mode(devices: Program, mark: int) -> str:
    found = re.findall(r"left: (armed|ready|fault)", devices.text[mark:])
    return found[-1] if found else ""


def watchdog_of(run: Program) -> int:
    """Return the process id of its watchdog."""
    assert run.pid is not None
    (child,) = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    return int(child)


def gone(pid: int) -> bool:
    """Whether a process has ended, and perhaps nobody has asked how."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.timeout(240)
@pytest.mark.parametrize("number", sampled([signal.SIGKILL, signal.SIGSEGV], 2))
def test_a_loop_that_is_killed_leaves_no_motor_armed(
    robot: tuple[Program, Program, int], number: signal.Signals
) -> None:
    run, devices, mark = robot
    watchdog = watchdog_of(run)
    for harmless in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
        os.kill(watchdog, harmless)
    assert last_mode(devices, mark) == "armed"
    run.end(number)
    assert eventually(lambda: last_mode(devices, mark) == "ready")
    assert eventually(lambda: gone(watchdog))
    assert "the loop has died: the stop action was sent on can0" in run.text


@pytest.mark.timeout(240)
def test_a_loop_that_hangs_is_stopped_and_leaves_when_it_goes_on(
    robot: tuple[Program, Program, int],
) -> None:
    run, devices, mark = robot
    assert run.pid is not None
    os.kill(run.pid, signal.SIGSTOP)
    assert eventually(lambda: last_mode(devices, mark) == "ready")
    os.kill(run.pid, signal.SIGCONT)
    assert run.end(None) == 1
    stood = rf"the loop has stood for \d+ ms: after {STALL} ms the watchdog stops the motors"
    assert re.search(stood, run.text)
    assert f"stands for more than {STALL} ms" in run.text


@pytest.mark.timeout(240)
def test_a_loop_that_leaves_ends_it_and_it_has_sent_nothing(robot: tuple[Program, Program, int]) -> None:
    run, devices, mark = robot
    watchdog = watchdog_of(run)
    assert run.end(signal.SIGINT) == 0
    assert eventually(lambda: gone(watchdog))
    assert "watchdog: the loop" not in run.text
    assert last_mode(devices, mark) == "ready"


@pytest.mark.timeout(240)
def test_without_its_watchdog_a_robot_says_so_and_goes_on(robot: tuple[Program, Program, int]) -> None:
    run, devices, mark = robot
    os.kill(watchdog_of(run), signal.SIGKILL)
    run.until("the watchdog process has ended")
    assert last_mode(devices, mark) == "armed"
    assert run.end(signal.SIGINT) == 0
