"""The devices of a robot as a process: the loop in simulated time, two processes on the wall clock.

What is on the wall clock is so because processes, ptys and signals are: nothing less shows that they meet."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import shlex
import signal
from collections.abc import Sequence
from contextlib import closing
from importlib.resources import files
from pathlib import Path

import can
import pytest
from odrive_can.odrive import ODriveCAN

from gateway import config
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.adapters.pty import SerialPty
from gateway.buses.can import open_can
from gateway.buses.virtual.bus import open_world
from gateway.cli.main import main
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import BusSettings, Robot
from gateway.errors import BusError, ConfigError
from gateway.recording import read_recording
from gateway.runtime import loop
from gateway.runtime.device_log import DeviceLog
from gateway.runtime.serve import ServeStats, ServeTick, serve
from gateway.runtime.twin_process import devices, invitation, outer
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos, Velocity
from tests.gateway.processes import Process
from tests.gateway.rig import BENCH, Rig

MS = MILLISECOND
WATCHED = BENCH.replace(
    'options = { watchdog = "acknowledged" }', "settings = { enable_watchdog = true, watchdog_timeout = 0.2 }"
)


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
    """A bench of twins that is served in simulated time; each `next` may come late."""

    def __init__(self, text: str = BENCH) -> None:
        self.robot: Robot = config.parse_robot(text)
        self.clock = SimulatedClock()
        self.twins = open_world(self.robot, 1)
        self.bus = Script()
        self.stats = ServeStats()
        self.serving = serve(self.twins.buses, {"can0": self.bus}, self.clock, stats=self.stats)

    def run(self, milliseconds: int) -> list[ServeTick]:
        return [next(self.serving) for _ in range(milliseconds)]

    def ask_version(self, t: Nanos) -> None:
        """A remote frame to node 1, which it answers at once (cmd 0x00, Get_Version)."""
        self.bus.coming.append(Packet(t, "can0", CanFrame(0x20, remote=True)))


# -- the serving loop ------------------------------------------------------------------------------


def test_what_comes_is_heard_at_its_own_time_also_by_a_late_moment() -> None:
    served = ServedBench()
    served.run(400)
    start = served.clock.now()
    served.clock.wait(start + 100 * MS)
    served.ask_version(start + 40 * MS)
    late = served.run(1)[0]
    assert late.stalled_for == 0
    assert late.now == start + 100 * MS
    answers = [packet for packet in late.sent if packet.frame.id == 0x20]  # type: ignore[union-attr]
    assert len(answers) == 1
    assert 40 * MS <= answers[0].t - start <= 43 * MS
    beats = [packet.t for packet in late.sent]
    assert max(beats) - min(beats) > 80 * MS  # the world has made up for all of it
    assert served.stats.stalled == 0
    assert served.stats.late == pytest.approx(100 * MS, abs=2 * MS)


def test_what_has_no_stamp_of_its_own_has_come_evenly_since_the_moment_before() -> None:
    served = ServedBench()
    served.run(400)
    start = served.clock.now() - MS
    served.clock.wait(start + 80 * MS)
    now = served.clock.now()
    for _ in range(3):
        served.ask_version(now)
    answers = [p.t for p in served.run(1)[0].sent if p.frame.id == 0x20]  # type: ignore[union-attr]
    assert [t - start for t in answers] == pytest.approx([21.5 * MS, 41.5 * MS, 61.5 * MS], abs=1.5 * MS)


def test_who_stood_still_makes_up_for_nothing_and_obeys_nothing_old() -> None:
    served = ServedBench()
    served.run(400)
    reported = len(served.bus.sent)
    before = served.clock.now()
    served.ask_version(before + 500 * MS)
    served.clock.wait(before + 10 * SECOND)
    moment = served.run(1)[0]
    assert moment.stalled_for == pytest.approx(10 * SECOND, abs=2 * MS)
    assert (moment.received, served.stats.dropped) == ((), 1)
    assert len(served.bus.sent) - reported < 5
    assert served.stats.stalled == moment.stalled_for
    served.ask_version(served.clock.now())
    answers = [p for m in served.run(5) for p in m.sent if p.frame.id == 0x20]  # type: ignore[union-attr]
    assert len(answers) == 1  # and goes on as if nothing had been
    assert sum(moment.stalled_for for moment in served.run(100)) == 0


def test_states_of_the_outer_bus_are_passed_on_and_nothing_else() -> None:
    served = ServedBench()
    served.bus.states = [BusState.GONE, BusState.BACK]
    assert served.run(1)[0].states == (("can0", BusState.GONE), ("can0", BusState.BACK))
    assert served.run(1)[0].states == ()


def test_an_end_that_was_set_ends_it() -> None:
    served = ServedBench()
    serving = serve(served.twins.buses, {"can0": served.bus}, served.clock, until=50 * MS)
    assert [moment.now // MS for moment in serving] == list(range(50))


OTHER = (
    BENCH.replace('"rig"', '"other"')
    .replace("address = 1\n", "address = 11\n")
    .replace("address = 2\n", "address = 12\n")
)


def test_two_robots_and_a_stranger_share_a_bus_and_none_obeys_another_s_word() -> None:
    """Two brains, two worlds of twins, and a foreign node that shouts, on one python-can bus."""
    clock = SimulatedClock()
    settings = BusSettings("can0", "can", "virtual:shared", 1_000_000)
    rigs = [Rig(text) for text in (BENCH, OTHER)]
    buses = [open_can(settings, clock) for _ in range(4)]
    stranger = can.Bus(interface="virtual", channel="shared")
    speeds = (4.0, -7.0)
    lived, served = [], []
    for rig, speed, ours, theirs in zip(rigs, speeds, buses[:2], buses[2:], strict=True):

        def ask(rig: Rig = rig, speed: float = speed) -> list[Velocity]:
            return (
                [Velocity("left", speed)]
                if rig.gateway.joints["left"].mode in (Mode.READY, Mode.ARMED)
                else []
            )

        lived.append(loop.live(rig.gateway, {"can0": ours}, clock, poll=ask))
        served.append(serve(rig.world.buses, {"can0": theirs}, clock))
    for turn in range(1500):
        clock.wait(turn * MS)
        for serving in served:
            next(serving)
        if turn % 5 == 0:
            for live in lived:
                next(live)
        for number in (0x7FF, 0x3E5, 0x0C9):  # nodes 0x3F, 0x1F and 6: nobody's
            stranger.send(can.Message(arbitration_id=number, data=bytes(8), is_extended_id=False))
    assert [rig.velocity("left") for rig in rigs] == pytest.approx(speeds, abs=0.2)
    assert [rig.velocity("right") for rig in rigs] == [0.0, 0.0]
    for rig in rigs:
        ((_, _, counters),) = rig.gateway.rx_counters()
        assert counters.malformed == 0
        assert counters.ignored > 3000
    for live in lived:
        live.close()
    for serving in served:
        serving.close()
    for bus in buses:
        bus.close()
    stranger.shutdown()


# -- what it says ----------------------------------------------------------------------------------


def received(text: str, seconds: float) -> tuple[DeviceLog, list[tuple[int, str]]]:
    """What the voices of a rig tell while it is armed and turns."""
    rig = Rig(text)
    device_log = DeviceLog(rig.robot)
    reported: list[tuple[int, str]] = []
    rig.run(0.3, at=lambda tick: reported.extend(device_log.update(tick.inputs.packets)))
    rig.run(
        seconds,
        Velocity("left", 5.0),
        at=lambda tick: reported.extend(device_log.update(tick.inputs.packets)),
    )
    return device_log, reported


def test_voices_tell_what_changes_and_what_becomes_of_armed_motors() -> None:
    device_log, reported = received(BENCH, 0.8)
    assert reported[-1] == (logging.INFO, "left: armed (CLOSED_LOOP_CONTROL)")
    assert len(reported) == len(set(reported))
    assert device_log.left_armed("can0") == "left stays armed: its watchdog is off"
    device_log, _ = received(WATCHED, 0.8)
    assert device_log.left_armed("can0") == "left will be disarmed by its watchdog in 200 ms"


def test_voices_know_the_devices_before_anybody_else_speaks() -> None:
    twins = open_world(config.parse_robot(BENCH), 1)
    device_log = DeviceLog(config.parse_robot(BENCH))
    age = device_log.warm_up(twins.buses)
    assert device_log._modes == {"left": Mode.READY, "right": Mode.READY}
    assert all(twins.world.shaft(name) == (0.0, 0.0) for name in ("left", "right"))
    assert 0 < age <= SECOND


def test_twins_speak_only_where_the_command_line_says_so() -> None:
    text = BENCH.replace('interface = "twin"', 'interface = "socketcan:can0"')
    robot = config.parse_robot(text)
    assert outer(robot, {}).buses["can0"].interface == "twin"
    assert outer(robot, {"can0": "socketcan:vcan0"}).buses["can0"].interface == "socketcan:vcan0"
    with pytest.raises(ConfigError, match="no bus 'cann0': there is can0; did you mean 'can0'"):
        outer(robot, {"cann0": "socketcan:vcan0"})


def test_the_invitation_is_a_line_to_type() -> None:
    robot = outer(config.load_robot(Path(str(files("gateway.fixtures"))) / "robots" / "diffbot.toml"), {})
    with devices(robot, SimulatedClock(), seed=3, adapters=("slcan",) * 3) as made:
        lines = invitation(made, "my robots/a.toml")
        words = shlex.split(lines[1])
    can0, sensors = made.offered["can0"], made.offered["sensors"]
    assert words == [
        *("gateway", "run", "my robots/a.toml"),
        *("--bus", f"can0={can0[0]}", "--bus", f"sensors={sensors[0]}"),
    ]
    assert len(set(can0)) == 3
    assert lines[2:] == [
        f"other programs may be on can0 too, by {can0[1]}, {can0[2]}; for instance:",
        f"  python -m can.viewer -i slcan -c {can0[1].removeprefix('slcan:')}",
    ]


def test_the_invitation_does_not_name_a_port_that_is_taken() -> None:
    robot = config.parse_robot(BENCH)
    with devices(outer(robot, {}), SimulatedClock(), adapters=("slcan", "slcan")) as first:
        path = first.offered["can0"][1].removeprefix("slcan:")
        with devices(outer(robot, {"can0": f"slcan:{path}"}), SimulatedClock()) as second:
            assert invitation(second, "rig")[1:] == [
                "  gateway run rig --bus can0=slcan:PORT",
                f"PORT of can0: another adapter on the bus of {path}",
            ]
    with devices(outer(robot, {"can0": "virtual:rig"}), SimulatedClock()) as third:
        assert invitation(third, "rig")[1:] == ["  gateway run rig --bus can0=virtual:rig"]


def test_ptys_may_have_names_that_stay_the_same(tmp_path: Path) -> None:
    robot = outer(config.parse_robot(BENCH), {})
    folder = tmp_path / "ports"
    folder.mkdir()
    (folder / "can0").symlink_to("/dev/pts/of-one-that-was-killed")
    for _ in range(2):
        with devices(robot, SimulatedClock(), adapters=("slcan", "slcan"), link=folder) as made:
            assert made.offered["can0"] == [f"slcan:{folder}/can0", f"slcan:{folder}/can0.2"]
            assert invitation(made, "rig")[1].endswith(f"--bus can0=slcan:{folder / 'can0'}")
            settings = BusSettings("can0", "can", f"slcan:{folder / 'can0'}", 1_000_000)
            with closing(open_can(settings, SimulatedClock())):
                assert made.buses["can0"].read(0)[0] == [BusState.BACK]
        assert list(folder.iterdir()) == []
    (folder / "can0").write_text("somebody's file")
    with pytest.raises(BusError, match="File exists"), devices(robot, SimulatedClock(), link=folder):
        pass
    assert (folder / "can0").read_text() == "somebody's file"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["difbot"], "did you mean 'diffbot'"),
        (["bench", "--bus", "cann0=socketcan:vcan0"], "no bus 'cann0'"),
        (["bench", "--bus", "can0=socketcan:no-such-bus"], "no-such-bus"),
        (["diffbot", "--bus", "sensors=serial:/dev/no-such-port"], "no-such-port"),
        (["bench", "--ports", "0"], "not a number from 1 to 16"),
        (["bench", "--seconds", "-1"], "not a positive number"),
    ],
)
def test_what_cannot_begin_is_a_sentence(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status: object
    try:
        status = main(["twin", *words])
    except SystemExit as stopped:
        status = stopped.code
    reported = capsys.readouterr().err
    assert status == 2
    assert said in reported
    assert "Traceback" not in reported


# -- two processes ---------------------------------------------------------------------------------


def patient(text: str) -> str:
    """A robot that does not mind that this machine does other things for a while."""
    text = re.sub(r"(feedback|command)_timeout_ms = \d+", r"\1_timeout_ms = 3000", text)
    text = re.sub(r"(?m)^timeout_ms = \d+", "timeout_ms = 3000", text)
    return text.replace('watchdog = "acknowledged"', 'watchdog = "acknowledged"\noffline_ms = 5000')


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sockets = tmp_path / "run"
    sockets.mkdir(mode=0o700)
    for name in ("diffbot", "bench"):
        shipped = Path(str(files("gateway.fixtures"))) / "robots" / f"{name}.toml"
        (tmp_path / f"{name}.toml").write_text(patient(shipped.read_text()))
    return tmp_path


def invited(twin: Process, *more: str) -> list[str]:
    """The words after `gateway` of the line that the twin has printed."""
    line = re.search(r"(?m)^  gateway (run .*)$", twin.until("gateway run "))
    assert line is not None
    return [*shlex.split(line[1]), *more]


@pytest.mark.timeout(240)
def test_two_processes_reach_a_goal_and_the_recording_replays(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = folder / "drive.mcap"
    with Process(folder / "run", "twin", str(folder / "diffbot.toml"), "-v") as twin:
        words = invited(twin, "--goal", "0.6,0", "--record", str(recording), "-v")
        with Process(folder / "run", *words) as robot:
            robot.until("goal 1 reached")
            status, text = robot.end(signal.SIGTERM)
            assert status == 0, text
            assert "leaving: SIGTERM" in text
            assert "Traceback" not in text
        twin.until("can0: client disconnected", "sensors: client disconnected")
        status, reported = twin.end(signal.SIGTERM)
        assert status == 0, reported
        assert re.search(r"\d{3,} packets received, \d{4,} sent", reported)
        assert "Traceback" not in reported
        assert "stays armed" not in reported  # the safe word went out first
        assert re.findall(r"left: (\w+)", reported)[:2] == ["armed", "ready"]
    ticks = list(read_recording(recording).ticks)
    assert {packet.bus for tick in ticks for packet in tick.inputs.packets} == {"can0", "sensors"}
    assert main(["replay", str(recording)]) == 0
    assert "the same, byte for byte" in capsys.readouterr().out


@pytest.mark.timeout(240)
def test_the_first_frame_goes_out_within_three_seconds_also_if_it_is_recorded(folder: Path) -> None:
    """Of the processor's time: what else the machine does is not ours to judge."""
    clock = WallClock()
    adapters = AdapterPty(BusSettings("can0", "can", "twin", 1_000_000))
    line = SerialPty(BusSettings("sensors", "serial", "twin", baudrate=3_000_000))
    buses = ["--bus", f"can0=slcan:{adapters.paths[0]}", "--bus", f"sensors=serial:{line.pty.path}"]
    words = ["run", "diffbot", *buses, "--record", str(folder / "first.mcap")]
    with closing(adapters), closing(line), Process(folder / "run", *words) as robot:
        while not adapters.read(clock.now())[1]:
            clock.wait(clock.now() + 2 * MS)
            assert clock.now() < 60 * SECOND, robot.text
        took = robot.processor_time()
        assert 0.1 < took < 3.0
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


@pytest.mark.timeout(240)
def test_the_vendor_s_client_then_a_person_s_lines_then_the_twin_goes_and_comes_back(folder: Path) -> None:
    devices_of = ["twin", str(folder / "bench.toml"), "-v", "--link", str(folder / "ports")]
    with Process(folder / "run", *devices_of) as twin:
        words = invited(twin, "-v")
        channel = words[-2].partition("slcan:")[2]
        reported = asyncio.run(drive(channel, twin))
        assert reported[-1] == pytest.approx(3.0, abs=0.05)
        twin.until("left: ready", "can0: client disconnected")
        with Process(folder / "run", *words) as robot:
            robot.until("left: ready", "right: ready")
            robot.send_line("position left 1.5")
            robot.until("left: armed")
            for _ in range(200):
                robot.send_line("status")
                robot.until("ticks:")
                if abs(float(re.findall(r"left: armed.* at (-?[\d.]+) rad", robot.text)[-1]) - 1.5) < 0.01:
                    break
                robot.text = ""
            else:
                raise AssertionError(robot.text)
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


@pytest.mark.timeout(240)
def test_motors_of_a_host_that_was_killed_are_stopped_by_their_watchdog(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(patient(WATCHED))
    with Process(tmp_path, "twin", str(tmp_path / "rig.toml"), "-v") as twin:
        with Process(tmp_path, *invited(twin, "-v")) as robot:
            robot.until("left: ready")
            robot.send_line("velocity left 5")
            twin.until("left: armed")
            robot.end(signal.SIGKILL)
        twin.until(
            "can0: client disconnected; left will be disarmed by its watchdog in 200 ms",
            "left: fault: WATCHDOG_TIMER_EXPIRED",
        )
        with Process(tmp_path, *invited(twin, "-v")) as robot:  # whoever comes next finds it so
            robot.until("WATCHDOG_TIMER_EXPIRED")
        assert "Traceback" not in robot.text
        assert twin.end(signal.SIGINT)[0] == 0
