"""The devices of a robot as a process: the loop in simulated time, two processes on the wall clock.

Processes, ptys and signals are on the wall clock: nothing less shows that they work together."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

import can
import pytest
from odrive_can.odrive import ODriveCAN

from gateway import config
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.can import open_can
from gateway.buses.virtual.bus import open_world
from gateway.cli.twin import invitation
from gateway.config import resources
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import BusSettings, Robot
from gateway.errors import BusError
from gateway.recording import read_recording
from gateway.runtime.device_log import DeviceLog
from gateway.runtime.loop import live
from gateway.runtime.serve import MADE_UP, ServeStats, ServeTick, serve
from gateway.runtime.twin_process import devices, without_interfaces
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos, Velocity
from tests.gateway.processes import PATIENCE, Process, eventually, patient
from tests.gateway.rig import BENCH, WATCHED, Rig

MS = MILLISECOND


class Script:
    """A bus that receives from a script and keeps what is sent."""

    name = "can0"

    def __init__(self) -> None:
        self.coming: list[Packet] = []
        self.states: list[BusState] = []
        self.sent: list[tuple[Nanos, Frame]] = []

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        packets, self.coming = self.coming, []
        states, self.states = self.states, []
        return states, packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        self.sent += [(now, frame) for frame in frames]

    def close(self) -> None:
        pass


class ServedBench:
    """A bench of twins that is served in simulated time, 0.4 s old; each iteration may come late."""

    def __init__(self) -> None:
        self.clock = SimulatedClock()
        twins = open_world(config.parse_robot(BENCH), 1)
        self.world = twins.world
        self.bus = Script()
        self.stats = ServeStats()
        self._serving = serve(twins.buses, {"can0": self.bus}, self.clock, stats=self.stats)
        self.run(400)

    def run(self, milliseconds: int) -> list[ServeTick]:
        return [next(self._serving) for _ in range(milliseconds)]

    def ask_version(self, t: Nanos) -> None:
        """A remote frame to node 1, which it answers at once (cmd 0x00, Get_Version)."""
        self.bus.coming.append(Packet(t, "can0", CanFrame(0x20, remote=True)))


@pytest.fixture
def served() -> ServedBench:
    return ServedBench()


# -- the serving loop ------------------------------------------------------------------------------


def answers(ticks: Sequence[ServeTick]) -> list[Nanos]:
    """Return when node 1 answered its version."""
    packets = [packet for tick in ticks for packet in tick.sent]
    return [p.t for p in packets if isinstance(p.frame, CanFrame) and p.frame.id == 0x20]


def test_a_frame_is_received_at_its_own_time_also_by_a_late_iteration(served: ServedBench) -> None:
    start = served.clock.now()
    served.clock.wait(start + 100 * MS)
    served.ask_version(start + 40 * MS)
    (late,) = served.run(1)
    assert (late.stalled_for, late.now) == (0, start + 100 * MS)
    (answered,) = answers([late])
    assert 40 * MS <= answered - start <= 43 * MS
    times = [packet.t for packet in late.sent]
    assert max(times) - min(times) > 80 * MS  # the world has made up for all of it
    assert served.stats.stalled == 0
    assert served.stats.late == pytest.approx(100 * MS, abs=2 * MS)


def test_frames_without_a_stamp_are_spread_evenly_since_the_last_iteration(served: ServedBench) -> None:
    start = served.clock.now() - MS
    served.clock.wait(start + 80 * MS)
    for _ in range(3):
        served.ask_version(served.clock.now())
    times = [t - start for t in answers(served.run(1))]
    assert times == pytest.approx([21.5 * MS, 41.5 * MS, 61.5 * MS], abs=1.5 * MS)


def test_a_process_that_stood_still_makes_up_for_nothing_and_obeys_nothing_old(served: ServedBench) -> None:
    before_it = len(served.bus.sent)
    start = served.clock.now()
    served.ask_version(start + 500 * MS)
    served.clock.wait(start + 10 * SECOND)
    (tick,) = served.run(1)
    assert tick.stalled_for == pytest.approx(10 * SECOND, abs=2 * MS)
    assert (tick.received, served.stats.dropped) == ((), 1)
    assert len(served.bus.sent) - before_it < 5
    assert served.stats.stalled == tick.stalled_for
    served.ask_version(served.clock.now())
    assert len(answers(served.run(5))) == 1  # and goes on as if nothing had been
    assert sum(tick.stalled_for for tick in served.run(100)) == 0


def test_one_iteration_makes_up_for_a_slice_and_what_was_received_waits_for_its_time(
    served: ServedBench,
) -> None:
    start = served.clock.now()
    served.clock.wait(start + 3 * MADE_UP + 50 * MS)
    served.ask_version(start + 250 * MS)
    ticks = served.run(5)
    assert [len(answers([tick])) for tick in ticks] == [0, 0, 1, 0, 0]
    assert 250 * MS <= answers(ticks)[0] - start <= 253 * MS
    assert (served.stats.stalled, served.stats.received) == (0, 1)


@pytest.mark.parametrize("cost", [0.5, 3.0, 40.0])
def test_a_machine_that_does_not_keep_up_bounds_what_an_iteration_does(
    served: ServedBench, cost: float
) -> None:
    """A step of the world costs so much of the time that it is to fill: all of it had to be made up for."""
    before, most = served.world.now, 0
    for _ in range(100):
        served.run(1)
        moved, before = served.world.now - before, served.world.now
        most = max(most, moved)
        served.clock.wait(served.clock.now() + round(cost * moved))
    assert most <= MADE_UP
    assert (served.stats.stalled > 0) == (cost > 1.0)


def test_states_of_the_outer_bus_are_passed_on_and_nothing_else(served: ServedBench) -> None:
    served.bus.states = [BusState.GONE, BusState.BACK]
    assert served.run(1)[0].states == (("can0", BusState.GONE), ("can0", BusState.BACK))
    assert served.run(1)[0].states == ()


def test_an_end_that_was_set_ends_it() -> None:
    twins = open_world(config.parse_robot(BENCH), 1)
    serving = serve(twins.buses, {"can0": Script()}, SimulatedClock(), until=50 * MS)
    assert [tick.now // MS for tick in serving] == list(range(50))


OTHER = (
    BENCH.replace('"rig"', '"other"')
    .replace("address = 1\n", "address = 11\n")
    .replace("address = 2\n", "address = 12\n")
)


def test_two_robots_share_a_bus_with_a_foreign_node_and_obey_only_their_own_commands() -> None:
    """Two brains, two worlds of twins, and a foreign node that sends often, on one python-can bus."""
    clock = SimulatedClock()
    settings = BusSettings("can0", "can", "virtual:shared", 1_000_000)
    rigs = [Rig(text) for text in (BENCH, OTHER)]
    speeds = (4.0, -7.0)
    with ExitStack() as stack:
        lived, served = [], []
        for rig, speed in zip(rigs, speeds, strict=True):

            def ask(rig: Rig = rig, speed: float = speed) -> list[Velocity]:
                able = rig.gateway.joints["left"].mode in (Mode.READY, Mode.ARMED)
                return [Velocity("left", speed)] if able else []

            ours, theirs = (stack.enter_context(closing(open_can(settings, clock))) for _ in range(2))
            served.append(stack.enter_context(closing(serve(rig.world.buses, {"can0": theirs}, clock))))
            lived.append(stack.enter_context(closing(live(rig.gateway, {"can0": ours}, clock, poll=ask))))
        foreign = stack.enter_context(can.Bus(interface="virtual", channel="shared"))
        for turn in range(1500):
            clock.wait(turn * MS)
            for serving in served:
                next(serving)
            if turn % 5 == 0:
                for living in lived:
                    next(living)
            for number in (0x7FF, 0x3E5, 0x0C9):  # nodes 0x3F, 0x1F and 6: of neither robot
                foreign.send(can.Message(arbitration_id=number, data=bytes(8), is_extended_id=False))
        assert [rig.velocity("left") for rig in rigs] == pytest.approx(speeds, abs=0.2)
        assert [rig.velocity("right") for rig in rigs] == [0.0, 0.0]
        for rig in rigs:
            ((_, _, counters),) = rig.gateway.rx_counters()
            assert counters.malformed == 0
            assert counters.ignored > 3000


# -- what it logs and prints -----------------------------------------------------------------------


def logged(text: str) -> tuple[DeviceLog, list[tuple[int, str]]]:
    """Return the log of a rig's devices, and its lines, from the start until the left motor turns."""
    rig = Rig(text)
    device_log = DeviceLog(rig.robot)
    lines: list[tuple[int, str]] = []
    for seconds, commands in ((0.3, ()), (0.8, (Velocity("left", 5.0),))):
        rig.run(seconds, *commands, at=lambda tick: lines.extend(device_log.update(tick.inputs.packets)))
    return device_log, lines


def test_changes_are_logged_and_what_becomes_of_armed_motors() -> None:
    device_log, lines = logged(BENCH)
    assert lines[-1] == (logging.INFO, "left: armed (CLOSED_LOOP_CONTROL)")
    assert len(lines) == len(set(lines))
    assert device_log.left_armed("can0") == "left stays armed: its watchdog is off"
    device_log, _ = logged(WATCHED)
    assert device_log.left_armed("can0") == "left will be disarmed by its watchdog in 200 ms"


def test_the_devices_are_identified_before_any_other_program_is_there() -> None:
    robot = config.parse_robot(BENCH)
    twins, device_log = open_world(robot, 1), DeviceLog(robot)
    age = device_log.warm_up(twins.buses)
    assert device_log._modes == {"left": Mode.READY, "right": Mode.READY}
    assert all(twins.world.shaft(name) == (0.0, 0.0) for name in ("left", "right"))
    assert 0 < age <= SECOND


def test_twins_send_only_where_the_command_line_says_so() -> None:
    text = BENCH.replace('interface = "twin"', 'interface = "socketcan:can0"')
    assert without_interfaces(config.parse_robot(text)).buses["can0"].interface == "twin"


def bench(**interfaces: str) -> Robot:
    return config.with_interfaces(config.parse_robot(BENCH), interfaces)


def test_the_invitation_is_a_line_to_type() -> None:
    robot = config.load_robot("diffbot")
    with devices(robot, SimulatedClock(), seed=3, adapters=("slcan",) * 3) as made:
        lines = invitation(made, "my robots/a.toml")
    can0, sensors = made.offered["can0"], made.offered["sensors"]
    assert shlex.split(lines[1]) == [
        *("gateway", "run", "my robots/a.toml"),
        *("--bus", f"can0={can0[0]}", "--bus", f"sensors={sensors[0]}"),
    ]
    assert len(set(can0)) == 3
    assert lines[2:] == [
        f"other programs can join can0 by {can0[1]}, {can0[2]}; for instance:",
        f"  python -m can.viewer -i slcan -c {can0[1].removeprefix('slcan:')}",
    ]


def test_the_invitation_does_not_name_a_port_that_is_taken() -> None:
    with devices(bench(), SimulatedClock(), adapters=("slcan", "slcan")) as first:
        path = first.offered["can0"][1].removeprefix("slcan:")
        with devices(bench(can0=f"slcan:{path}"), SimulatedClock()) as second:
            assert invitation(second, "rig")[1:] == [
                "  gateway run rig --bus can0=slcan:PORT",
                f"PORT of can0: another adapter on the bus of {path}",
            ]
    with devices(bench(can0="virtual:rig"), SimulatedClock()) as third:
        assert invitation(third, "rig")[1:] == ["  gateway run rig --bus can0=virtual:rig"]


def test_ptys_may_have_names_that_stay_the_same(tmp_path: Path) -> None:
    folder = tmp_path / "ports"
    folder.mkdir()
    (folder / "can0").symlink_to("/dev/pts/of-one-that-was-killed")
    for _ in range(2):
        with devices(bench(), SimulatedClock(), adapters=("slcan", "slcan"), link=folder) as made:
            assert made.offered["can0"] == [f"slcan:{folder}/can0", f"slcan:{folder}/can0.2"]
            assert invitation(made, "rig")[1].endswith(f"--bus can0=slcan:{folder / 'can0'}")
            settings = BusSettings("can0", "can", f"slcan:{folder / 'can0'}", 1_000_000)
            with closing(open_can(settings, SimulatedClock())):
                assert made.buses["can0"].read(0)[0] == [BusState.BACK]
        assert list(folder.iterdir()) == []
    (folder / "can0").write_text("another program's file")
    with pytest.raises(BusError, match="File exists"), devices(bench(), SimulatedClock(), link=folder):
        pass
    assert (folder / "can0").read_text() == "another program's file"


# -- two processes ---------------------------------------------------------------------------------


@pytest.fixture
def folder() -> Iterator[Path]:
    """A directory with a short name, as sockets need."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "run").mkdir(mode=0o700)
        for robot in ("diffbot", "diffbot_damiao", "bench"):
            (folder / f"{robot}.toml").write_text(patient(resources.find("robots", robot).read_text()))
        yield folder


def invited(twin: Process, *more: str) -> list[str]:
    """Return the arguments in the line that the twin has printed."""
    return [*shlex.split(twin.find(r"(?m)^  gateway (run .*)")), *more]


def reach(robot: Process, x: float, y: float) -> None:
    """Wait until the robot has reached its goal; give the goal again where it drops or refuses it: for a
    robot that has no processor for a while, wheels and lidar may not agree."""
    given = time.monotonic()
    end = given + PATIENCE
    while not re.search(r"brain: goal \d+ reached", robot.text):
        assert time.monotonic() < end, robot.text
        robot.look()
        told = re.findall(r"goal dropped|Goal refused|goal \d+ accepted", robot.text)
        if told and not told[-1].endswith("accepted") and time.monotonic() > given + 2.0:
            given = time.monotonic()
            robot.send_line(f"goal {x} {y}")


@pytest.mark.sample(1)
@pytest.mark.parametrize(("name", "adapter"), [("diffbot", "slcan"), ("diffbot_damiao", "dm-serial")])
def test_two_processes_reach_a_goal_and_the_recording_replays(folder: Path, name: str, adapter: str) -> None:
    recording = folder / "drive.mcap"
    command = ("twin", str(folder / f"{name}.toml"), "--adapter", adapter, "-v")
    with Process(folder / "run", *command) as twin:
        arguments = invited(twin, "--goal", "0.6,0", "--record", str(recording), "-v")
        with Process(folder / "run", *arguments) as robot:
            reach(robot, 0.6, 0.0)
            status, text = robot.end(signal.SIGTERM)
            assert status == 0, text
            assert "leaving: SIGTERM" in text
            assert "Traceback" not in text
        twin.until("can0: client disconnected", "sensors: client disconnected")
        status, reported = twin.end(signal.SIGTERM)
        assert status == 0, reported
        assert re.search(r"\d{3,} packets received, \d{4,} sent", reported)
        assert "Traceback" not in reported
        assert "fault" not in reported
        assert "stays armed" not in reported  # the stop command went out first
        assert re.findall(r"left: (\w+)", reported)[:2] == ["armed", "ready"]
    ticks = list(read_recording(recording).ticks)
    assert {packet.bus for tick in ticks for packet in tick.inputs.packets} == {"can0", "sensors"}
    with Process(folder / "run", "replay", str(recording)) as replay:  # as patient as the run was
        status, said = replay.end()
    assert status == 0, said
    assert "the same, byte for byte" in said


def test_nothing_is_imported_before_the_first_frame_that_a_run_does_not_need() -> None:
    code = (
        "import sys\nimport gateway as gw\n"
        "with gw.open_session('diffbot', simulated=True, record=sys.argv[1]) as session:\n"
        "    next(tick for tick in session.run() if tick.outputs.packets)\n"
        "sys.exit(', '.join(sorted({'cv2', 'filterpy', 'matplotlib', 'rosbags.highlevel'}"
        " & set(sys.modules))) or None)"
    )
    with tempfile.TemporaryDirectory() as name:
        run = [sys.executable, "-c", code, f"{name}/first.mcap"]
        done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.prove
def test_the_first_frame_costs_no_more_than_ten_times_what_its_libraries_do_to_import(folder: Path) -> None:
    """Also if it is recorded. Both are the processor's time, and one after the other: a processor that is
    shared is slower for both."""
    bare = [sys.executable, "-c", "import can, mcap, numpy, serial"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(bare, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    libraries = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    clock = WallClock()
    adapters = AdapterPty(BusSettings("can0", "can", "twin", 1_000_000))
    line = SerialPty(BusSettings("sensors", "serial", "twin", baudrate=3_000_000))
    buses = ["--bus", f"can0=slcan:{adapters.paths[0]}", "--bus", f"sensors=serial:{line.pty.path}"]
    arguments = ["run", "diffbot", *buses, "--record", str(folder / "first.mcap")]
    with closing(adapters), closing(line), Process(folder / "run", *arguments) as robot:
        while not adapters.read(clock.now())[1]:
            clock.wait(clock.now() + 2 * MS)
            assert clock.now() < 60 * SECOND, robot.text
        took = robot.processor_time()
        print(f"{took:.2f} s, the libraries {libraries:.2f} s")
        assert 0.0 < took < 10.0 * libraries
        assert "Traceback" not in robot.end(signal.SIGTERM)[1]


async def drive(channel: str, twin: Process) -> list[float]:
    """A session of package odrive-can 2.1.0 on the twin's adapter: turns per second, as it reads them.

    What its waiting calls wait for is looked for at the twin: they give up after one second."""
    bus = can.Bus(interface="slcan", channel=channel, bitrate=1_000_000, sleep_after_open=0)
    client = ODriveCAN(axis_id=1, can_bus=bus)
    reported: list[float] = []
    try:
        await client.start()
        client.set_controller_mode("VELOCITY_CONTROL", "PASSTHROUGH")
        client.set_input_vel(0.0)
        client.set_axis_state_no_wait("CLOSED_LOOP_CONTROL")
        await asyncio.to_thread(twin.until, "left: armed")
        client.set_input_vel(3.0)
        for _ in range(1000):
            with contextlib.suppress(TimeoutError):
                reported.append((await client.get_encoder_estimates())["Vel_Estimate"])
            if reported and abs(reported[-1] - 3.0) < 0.05:
                break
    finally:
        await asyncio.to_thread(client.stop)
        del client._bus  # or its destructor closes the port once more, which raises
        bus.shutdown()
    return reported


def test_the_vendors_client_then_typed_lines_then_the_twin_goes_and_comes_back(folder: Path) -> None:
    devices_of = ["twin", str(folder / "bench.toml"), "-v", "--link", str(folder / "ports")]
    with Process(folder / "run", *devices_of) as twin:
        arguments = invited(twin, "-v")
        channel = arguments[-2].partition("slcan:")[2]
        reported = asyncio.run(drive(channel, twin))
        assert reported[-1] == pytest.approx(3.0, abs=0.05)
        twin.until("left: ready", "can0: client disconnected")
        with Process(folder / "run", *arguments) as robot:
            robot.until("left: ready", "right: ready")
            robot.send_line("position left 1.5")
            robot.until("left: armed")

            def there() -> bool:
                robot.text = ""
                robot.send_line("status")
                found = re.findall(r"left: armed.*position (-?[\d.]+) rad", robot.until("ticks:"))
                return abs(float(found[-1]) - 1.5) < 0.01

            assert eventually(there), robot.text
            status, text = twin.end(signal.SIGTERM)
            assert status == 0
            assert "Traceback" not in text
            robot.until("can0: has vanished", "left: offline", "left: fault: silent")
            robot.text = ""
            with Process(folder / "run", *devices_of):
                robot.until("can0: is back", "left: ready", "right: ready")
            status, text = robot.end(signal.SIGTERM)
            assert status == 0, text  # on a bench one motor's fault does not stop the rest
            assert "Traceback" not in text


def test_motors_of_a_host_that_was_killed_are_stopped_by_their_watchdog(tmp_path: Path) -> None:
    watched = WATCHED.replace("watchdog_timeout = 0.2", "watchdog_timeout = 2.0")  # or the host is too slow
    (tmp_path / "rig.toml").write_text(patient(watched))
    with Process(tmp_path, "twin", str(tmp_path / "rig.toml"), "-v") as twin:
        with Process(tmp_path, *invited(twin, "-v")) as robot:
            robot.until("left: ready")
            robot.send_line("velocity left 5")
            twin.until("left: armed")
            robot.end(signal.SIGKILL)
        twin.until(
            "can0: client disconnected; left will be disarmed by its watchdog in 2000 ms",
            "left: fault: WATCHDOG_TIMER_EXPIRED",
        )
        with Process(tmp_path, *invited(twin, "-v")) as robot:  # the next program finds it so
            robot.until("WATCHDOG_TIMER_EXPIRED")
        assert "Traceback" not in robot.text
        assert twin.end(signal.SIGINT)[0] == 0
