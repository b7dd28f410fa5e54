"""The way out: whatever fails, and whatever comes meanwhile, no motor that can be reached is left armed."""

from __future__ import annotations

import errno
import logging
import os
import pty
import signal
import termios
from collections.abc import Callable, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

import gateway as gw
from gateway.buses import Bus
from gateway.buses.virtual.bus import TwinBus
from gateway.cli.jog import single_motor
from gateway.cli.main import LogHandler, main
from gateway.core.joint import Joint
from gateway.core.step import LEFT_ARMED, Gateway
from gateway.core.tick import Inputs, Note, Tick
from gateway.operator import Operator
from gateway.recording import Recorder
from gateway.recording.tick_writer import TickWriter
from gateway.runtime import loop, process
from gateway.runtime.process import signals
from protocols.messages import MILLISECOND, SECOND, Idle, Leave, Mode, Nanos, Velocity
from tests.gateway import little
from tests.gateway.processes import written
from tests.gateway.rig import BENCH, Rig, sent_commands
from tests.sampled import sampled

MS = MILLISECOND
CAN1 = '[buses.can1]\nkind = "can"\ninterface = "twin"\nbitrate = 1_000_000\n'
TWO = (
    BENCH.replace("[defaults", f"{CAN1}[defaults")
    .replace("address = 2", 'address = 2\nbus = "can1"')
    .replace("acceleration = 60.0", "acceleration = 10.0")
    .replace("gear = 8.0", 'gear = 8.0\nstop_action = "brake"')
)
"""A bench with a bus for each motor, and long ways to brake: 1 s from 10 rad/s."""


@pytest.fixture
def turning() -> Rig:
    rig = Rig(TWO)
    rig.run(0.5)
    rig.run(1.5, Velocity("left", 10.0), Velocity("right", 10.0))
    assert [round(rig.velocity(name)) for name in ("left", "right")] == [10, 10]
    return rig


def modes(of: Rig | gw.Session) -> dict[str, Mode]:
    """What the devices report to another host, which only reads, within 0.3 s from now."""
    other, world = Gateway(of.robot), of.world if isinstance(of, Rig) else of.twins
    assert world is not None
    for _ in range(60):
        of.clock.wait(of.clock.now() + 5 * MS)
        now = of.clock.now()
        packets = [packet for bus in world.buses.values() for packet in TwinBus.read(bus, now)[1]]
        for packet in other.step(now, Inputs(packets=tuple(packets))).packets:
            TwinBus.write(world.buses[packet.bus], now, [packet.frame])
    return {name: joint.mode for name, joint in other.joints.items()}


def fail(*_: object, **__: object) -> Any:
    raise ZeroDivisionError


READY = {"left": Mode.READY, "right": Mode.READY}
FAILURES: dict[str, tuple[Callable[[Rig], object], set[str]]] = {
    # what fails: how, and the motors that are not known to be disarmed afterwards
    "the step": (lambda rig: setattr(rig.gateway, "step", fail), set()),
    "the brain": (lambda rig: setattr(rig.gateway.brain, "step", fail), set()),
    "the belief": (lambda rig: setattr(rig.gateway, "belief", fail), set()),
    "the recorder": (lambda rig: setattr(rig, "record", fail), set()),
    "the operator": (lambda rig: setattr(rig, "poll", fail), set()),
    "reading a bus": (lambda rig: setattr(rig.world.buses["can1"], "read", fail), {"right"}),
    "writing a bus": (lambda rig: setattr(rig.world.buses["can0"], "write", fail), {"left"}),
}


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", FAILURES)
def test_what_fails_is_raised_when_every_motor_that_can_be_reached_is_disarmed(
    name: str, turning: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    breaking, unknown = FAILURES[name]
    breaking(turning)
    with pytest.raises(ZeroDivisionError):
        turning.run(1.0)
    assert set(turning.gateway.still_armed()) == unknown
    assert critical(caplog) == {f"{motor}: {LEFT_ARMED}" for motor in unknown}
    unreached = {"left"} if name == "writing a bus" else set()
    assert modes(turning) == READY | dict.fromkeys(unreached, Mode.ARMED)


def critical(caplog: pytest.LogCaptureFixture) -> set[str]:
    return {record.getMessage() for record in caplog.records if record.levelno == logging.CRITICAL}


def test_an_error_of_the_caller_and_then_all_else_failing_still_disarms(turning: Rig) -> None:
    """Everything but the drivers, and of the last frames the first are lost."""

    def caller(_: object) -> None:
        for breaking, unreached in FAILURES.values():
            if not unreached:
                breaking(turning)
        for bus in turning.world.buses.values():
            lose_writes(bus, 2)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        turning.run(1.0, at=caller)
    turning.leave()
    assert turning.gateway.still_armed() == []
    assert modes(turning) == READY


def lose_writes(bus: Bus, count: float) -> None:
    """Lose so many of the next writes; inf: nothing gets out any more, while feedback still comes in."""
    left = [count]

    def write(now: Nanos, frames: Sequence[Any]) -> None:
        left[0] -= 1
        if left[0] < 0:
            type(bus).write(bus, now, frames)

    bus.write = write  # type: ignore[method-assign]  # the fault


REASONS = [
    # the reasons to leave, by the time [ms] after the run was left; how long the motors are braked [ms]
    ([0], (900, 1100)),
    ([0, 50], (900, 1100)),
    ([0, 500], (900, 1100)),
    ([0, 1, 2], (900, 1100)),  # within a period: one act
    ([0, 50, 100], (100, 110)),
    ([0, 50, 100, 105, 500], (100, 110)),
    ([0, 50, 1055], (900, 1100)),
]


@pytest.mark.sample(3)
@pytest.mark.parametrize(("times", "braked"), REASONS, ids=lambda value: str(value))
def test_a_second_reason_is_never_worse_than_one_and_a_third_ends_the_time_to_brake(
    times: list[int], braked: tuple[int, int], turning: Rig
) -> None:
    began = turning.clock.now()
    due = [began + t * MS for t in times]

    def reason(now: Nanos) -> None:
        while due and due[0] <= now:
            turning.reasons.append(f"at {due.pop(0)}")

    turning.record = lambda tick, _: reason(tick.now)
    reason(began)
    last = turning.run(10.0)
    commands = sent_commands(turning.robot, last) + sent_commands(turning.robot, last, "can1")
    idle = min(t for t, command in commands if isinstance(command, Idle))
    assert braked[0] * MS <= idle - last[0].now <= braked[1] * MS
    assert all(t <= idle + 10 * MS for t, command in commands if isinstance(command, Velocity))
    assert last[-1].now - idle <= loop.DISARM_TIMEOUT
    assert modes(turning) == READY
    assert turning.gateway.still_armed() == []


def test_a_second_reason_shortens_the_braking_of_a_motor_that_does_not_come_to_rest(turning: Rig) -> None:
    """Its velocity, as reported, does not change; one reason alone waits for twice the time it needs."""
    left = turning.gateway.joints["left"]
    turning.reasons.append("enough")

    def hurry(tick: Tick, _: object) -> None:
        if tick.now >= began + 20 * MS and len(turning.reasons) == 1:
            turning.reasons.append("now")

    began, turning.record = turning.clock.now(), hurry
    assert left.braking_time == 2 * SECOND  # from its limit of 20 rad/s
    assert left.hurried_braking_time == pytest.approx(1.6 * SECOND, rel=0.05)  # from 10 rad/s
    lose_writes(turning.world.buses["can1"], float("inf"))
    last = turning.run(10.0)
    assert last[-1].now - began < 1.6 * SECOND + loop.DISARM_TIMEOUT + 50 * MS


@pytest.mark.parametrize("braking", [None, 10**15])
def test_motors_that_do_not_obey_are_noted_in_a_bounded_time(
    braking: Nanos | None, turning: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if braking is not None:
        monkeypatch.setattr(Joint, "braking_time", braking)
    lose_writes(turning.world.buses["can1"], float("inf"))
    began = turning.clock.now()
    last = turning.leave()
    longest = loop.LONGEST_BRAKING + loop.DISARM_TIMEOUT
    assert turning.clock.now() - began <= longest + 10 * MS
    assert Note("error", "right", LEFT_ARMED) in last[-1].outputs.notes
    assert critical(caplog) == {f"right: {LEFT_ARMED}"}
    assert modes(turning) == {"left": Mode.READY, "right": Mode.ARMED}


DRIVEN = [
    "diffbot",
    "diffbot_cia402",
    "diffbot_cubemars",
    "diffbot_damiao",
    "diffbot_ddsm",
    "diffbot_dynamixel",
    "diffbot_feetech",
    "diffbot_hoverboard",
    "diffbot_moteus",
    "diffbot_myactuator",
    "diffbot_odrive_ascii",
    "diffbot_robomaster",
    "diffbot_roboclaw",
    "diffbot_robstride",
    "diffbot_sabertooth",
    "diffbot_vesc",
    "diffbot_vesc_uart",
    "diffbot_zlac8015d",
]


@pytest.mark.sample(2)
@pytest.mark.parametrize("robot", sampled(DRIVEN, 3))
def test_a_motor_that_is_about_to_arm_when_the_run_is_left_does_not_stay_armed(robot: str) -> None:
    """Left after each of the first ticks of a motion, with what arms it sent or on its way; the first frames
    of the way out are lost."""
    with gw.open_session(single_motor(gw.load_robot(robot), "left"), simulated=True) as session:
        list(session.run(1.0))
        for count in range(1, 13):
            session.submit(Velocity("left", 0.5))
            with closing(session.run()) as ticks:
                list(islice(ticks, count))
                for bus in session.buses.values():
                    lose_writes(bus, 1)
            left = session.joints["left"]
            assert not left.armed, f"left after {count} ticks"
            list(session.run(0.5))  # a set-up of which a frame was lost goes on
            # one that only replies has reported nothing before it is commanded
            assert left.mode is Mode.READY or not left.owned, f"left after {count} ticks: {left.mode}"
        assert left.owned


# -- a session ---------------------------------------------------------------------------------------------

SIGNALS = ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGUSR1"]


def kill(name: str) -> None:
    os.kill(os.getpid(), signal.Signals[name])


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", SIGNALS)
def test_signals_are_reasons_to_leave_from_the_opening_to_the_close(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # under nohup, where it is no reason
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    before = {each: signal.getsignal(signal.Signals[each]) for each in SIGNALS}
    opened, closed = TwinBus.__init__, TwinBus.close
    after_opening, after_running = [], []

    def open_(self: TwinBus, *arguments: Any) -> None:
        opened(self, *arguments)
        kill(name)

    def close(self: TwinBus) -> None:
        kill(name)
        closed(self)

    monkeypatch.setattr(TwinBus, "close", close)
    with gw.open_session("bench", simulated=True) as session:
        for _ in session.run():
            after_opening.append(session.joints["left"].mode)
            turn(session)
            if session.stats.ticks == 400:
                kill(name)
        assert session.reasons == [name]
        assert session.gateway.still_armed() == []
        assert signal.getsignal(signal.SIGTTOU) is signal.SIG_IGN
        monkeypatch.setattr(TwinBus, "__init__", open_)
    assert session.reasons == [name] * 2
    assert Mode.ARMED in after_opening
    with gw.open_session("bench", simulated=True) as session:
        after_running += list(session.run())
    assert after_running == []
    assert before == {each: signal.getsignal(signal.Signals[each]) for each in SIGNALS}


def turn(session: gw.Session) -> None:
    if session.joints["left"].mode is Mode.READY:
        session.submit(Velocity("left", 5.0))


NUMBERS = {process.signal_name(number): number for number in signal.valid_signals()}
TABLES = (process.WAY_OUT, process.IGNORED, process.BEYOND, process.HARMLESS)


def test_every_signal_stands_in_one_table_or_is_a_real_time_signal() -> None:
    named = [name for table in TABLES for name in table]
    assert sorted(named) == sorted(name for name in NUMBERS if not name.startswith("SIGRT"))


@pytest.mark.parametrize("name", sorted(NUMBERS.keys() - process.BEYOND.keys() - set(process.HARMLESS)))
def test_every_signal_that_would_end_a_process_is_a_reason_or_is_ignored(name: str) -> None:
    received: list[str] = []
    before = signal.signal(NUMBERS[name], signal.SIG_DFL)
    try:
        with signals(received.append, suspend=False):
            os.kill(os.getpid(), NUMBERS[name])
        assert received == ([] if name in process.IGNORED else [name])
        assert signal.getsignal(NUMBERS[name]) is signal.SIG_DFL
    finally:
        signal.signal(NUMBERS[name], before)


def test_a_handler_that_a_program_has_set_for_its_own_signals_stays() -> None:
    received: list[str] = []
    before = signal.signal(signal.SIGUSR2, lambda *_: received.append("its own"))
    try:
        with signals(received.append, suspend=False):
            kill("SIGUSR2")
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert received == ["its own"]


def test_a_bus_that_cannot_be_closed_keeps_no_other_open_and_the_recording_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "two.toml").write_text(TWO)
    closed, names = TwinBus.close, []

    def close(self: TwinBus) -> None:
        names.append(self.name)
        closed(self)
        raise ZeroDivisionError

    monkeypatch.setattr(TwinBus, "close", close)

    def drive() -> None:
        with gw.open_session(tmp_path / "two.toml", simulated=True, record=tmp_path / "a.mcap") as session:
            for _ in session.run(1.0):
                turn(session)

    with pytest.raises(ZeroDivisionError):
        drive()
    assert names == ["can1", "can0"]
    assert gw.replay_recording(gw.read_recording(tmp_path / "a.mcap")).ok


def test_a_run_that_is_left_at_once_is_replayed_to_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(TWO)
    path = tmp_path / "a.mcap"
    with gw.open_session(tmp_path / "two.toml", simulated=True, record=path) as session:
        record = session.gateway.belief

        def belief() -> Any:
            if session.reasons and session.stats.ticks in (420, 440):
                session.leave("and now at once")
            return record()

        session.gateway.belief = belief  # type: ignore[method-assign]  # a moment within the way out
        for _ in session.run():
            turn(session)
            if session.stats.ticks == 400:
                session.leave("enough")
        del session.gateway.belief
    ticks = list(gw.read_recording(path).ticks)
    leaves = [
        (tick.number, each) for tick in ticks for each in tick.inputs.instructions if isinstance(each, Leave)
    ]
    assert leaves == [(400, Leave(loop.LEFT)), (440, Leave(loop.LEFT, at_once=True))]
    assert gw.replay_recording(gw.read_recording(path)).ok


def test_a_recorder_whose_writer_fails_is_in_trouble_and_does_not_raise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TickWriter, "add", fail)
    with Recorder(tmp_path / "a.mcap", little.ROBOT, {}) as recorder:
        for tick, belief in little.life(3000):
            recorder.record(tick, belief, patient=True)
        assert "the recording ends here" in recorder.trouble or "nothing writes it" in recorder.trouble
        assert recorder.lost > 0


# -- the command -------------------------------------------------------------------------------------------


def test_motors_left_armed_are_reported_on_every_channel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    reported: list[str] = []
    report, write = Operator.report, TwinBus.write

    def witnessed(self: Operator, text: str, *, logged: bool = True) -> None:
        reported.append(text)
        report(self, text, logged=logged)

    def dead(self: TwinBus, now: Nanos, frames: Sequence[Any]) -> None:
        if now < 1500 * MS:
            write(self, now, frames)

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(Operator, "report", witnessed)
    monkeypatch.setattr(TwinBus, "write", dead)
    path = tmp_path / "a.mcap"
    assert main(["run", "diffbot", "--fast", "--seconds", "1.6", "--goal", "2,0", "--record", str(path)]) == 1
    expected = {f"{motor}: {LEFT_ARMED}" for motor in ("left", "right")}
    assert set(reported[-2:]) == expected
    assert critical(caplog) == expected
    noted = {f"{note.source}: {note.text}" for note in list(gw.read_recording(path).ticks)[-1].outputs.notes}
    assert expected <= noted


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO])
def test_output_that_nobody_reads_any_more_ends_the_run_safely(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions: list[gw.Session] = []
    close = gw.Session.close

    def witnessed(self: gw.Session) -> None:
        sessions.append(self)
        close(self)

    def print_(*_: object) -> str:
        raise OSError(number, "what is printed is not read")

    monkeypatch.setattr(gw.Session, "close", witnessed)
    monkeypatch.setattr("gateway.cli.demo._progress", print_)
    monkeypatch.setattr("gateway.cli.demo.PROGRESS_PERIOD", 10**9)
    assert main(["demo", "--fast", "--out", str(tmp_path)]) == 1
    assert sessions[0].joints["left"].owned
    assert sessions[0].gateway.still_armed() == []


def test_a_terminal_that_takes_no_output_delays_nothing() -> None:
    """Ctrl-S: a line of the log that waited for the terminal would keep the motors turning."""
    master, slave = pty.openpty()
    try:
        with os.fdopen(slave, "w") as terminal:
            handler = LogHandler(terminal)
            record = logging.LogRecord("gateway", logging.ERROR, "", 0, "left: %s", ("fault",), None)
            handler.emit(record)
            termios.tcflow(slave, termios.TCOOFF)
            handler.emit(record)
            termios.tcflow(slave, termios.TCOON)
        assert written(master) == b"left: fault\r\n"
    finally:
        os.close(master)
