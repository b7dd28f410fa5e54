"""The live loop: its deadlines, and the stop command at its end, whatever the reason."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from itertools import chain, pairwise, repeat
from pathlib import Path

import pytest

from gateway.buses.virtual import open_world
from gateway.config import load_robot, parse_robot
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.recording import read_recording
from gateway.runtime import loop
from gateway.runtime.timing import LoopStats
from protocols.messages import MILLISECOND, SECOND, Goal, Idle, Mode, Nanos, Velocity
from tests import runs
from tests.gateway.processes import Process
from tests.gateway.rig import BENCH, Rig, sent_commands

MS = MILLISECOND


def stepped(
    count: int, due: Callable[[], Nanos | None], work: Iterable[Nanos] = ()
) -> tuple[list[Nanos], int]:
    """Return the first moments to step at, and the deadlines missed; the steps take as long as `work`."""
    clock, stats = SimulatedClock(), LoopStats()
    moments: list[Nanos] = []
    for now, took in zip(loop.moments(clock, 5 * MS, due, stats), chain(work, repeat(0)), strict=False):
        moments.append(now)
        if len(moments) == count:
            break
        clock.wait(now + took)
    return moments, stats.missed


def test_deadlines_are_absolute_and_what_was_missed_is_counted_and_not_caught_up() -> None:
    work = [1 * MS, 1 * MS, 17 * MS, 1 * MS, 1 * MS]
    moments, missed = stepped(6, lambda: None, work)
    assert moments == [t * MS for t in (0, 5, 10, 27, 30, 35)]
    assert missed == 2  # 20 and 25 ms; that of 15 ms came late


def test_a_driver_that_is_due_between_two_periods_gets_a_step_of_its_own() -> None:
    due = iter([2 * MS, None, 5 * MS + 100, 7 * MS, None])
    moments, _ = stepped(5, lambda: next(due))
    assert moments == [0, 2 * MS, 5 * MS, 6 * MS, 7 * MS]


def test_a_driver_that_is_always_due_does_not_keep_the_loop_busy() -> None:
    moments, _ = stepped(21, lambda: 0)
    assert min(b - a for a, b in pairwise(moments)) >= loop.MIN_STEP


def test_an_answer_that_is_awaited_gets_a_step_of_its_own() -> None:
    """An answer has come after 3 ms, and others follow."""
    clock, moments = SimulatedClock(), []
    arrivals = iter((3 * MS, 4 * MS, 5 * MS))
    for now in loop.moments(clock, 10 * MS, lambda: None, LoopStats(), lambda _: clock.wait(next(arrivals))):
        moments.append(now)
        if len(moments) == 4:
            break
    assert moments == [0, 3 * MS, 4 * MS, 5 * MS]


@pytest.mark.parametrize("name", ["diffbot_cia402", "diffbot_zlac8015d"])
def test_drives_of_many_questions_are_armed_within_half_a_second(name: str) -> None:
    """At one question a period, of 5 ms, it takes longer."""
    robot = load_robot(name)
    gateway, world = Gateway(robot), open_world(robot, 1)
    instructions = iter([(Goal(0.5, 0.0),)])
    run = loop.live(
        gateway, world.buses, SimulatedClock(), poll=lambda: next(instructions, ()), until=SECOND // 2
    )
    with closing(run):
        for _ in run:
            if all(joint.armed for joint in gateway.joints.values()):
                return
    pytest.fail(f"after half a second: { {name: joint.mode for name, joint in gateway.joints.items()} }")


def test_the_wall_clock_moves_forward_and_waits() -> None:
    clock = WallClock()
    start = clock.now()
    clock.wait(start + 2 * MS)
    assert clock.now() >= start + 2 * MS
    clock.wait(0)  # past: at once
    before = time.time_ns()
    read = clock.now() + clock.system_offset()
    assert before - SECOND < read < time.time_ns() + SECOND


def test_a_run_that_a_test_leaves_open_ends_with_it() -> None:
    with runs.ended():
        rig = Rig()
        rig.run(0.3)
        rig.run(0.5, Velocity("left", 2.0))
        assert rig.gateway.still_armed()
    assert not rig.gateway.still_armed()


@pytest.fixture
def driven() -> Rig:
    rig = Rig()
    rig.run(0.3)
    rig.run(0.5, Velocity("left", 5.0), Velocity("right", 5.0))
    assert {joint.mode for joint in rig.gateway.joints.values()} == {Mode.ARMED}
    return rig


def test_at_the_end_the_stop_command_goes_out_first_and_the_devices_report_that_they_disarm(
    driven: Rig,
) -> None:
    last = driven.leave()
    commands = [command for _, command in sent_commands(driven.robot, last)]
    assert commands[:2] == [Idle("left"), Idle("right")]
    assert {joint.mode for joint in driven.gateway.joints.values()} == {Mode.READY}
    assert last[-1].now - last[0].now <= loop.DISARM_TIMEOUT


def test_an_exception_in_the_step_still_sends_the_stop_command(
    driven: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_now: Nanos, _inputs: Inputs) -> Outputs:
        raise ZeroDivisionError

    monkeypatch.setattr(driven.gateway, "step", broken)
    with pytest.raises(ZeroDivisionError):
        driven.run(0.1)
    bus = driven.world.buses["can0"]
    driven.clock.wait(driven.clock.now() + 300 * MS)
    bus.read(driven.clock.now())
    fresh = Gateway(driven.robot)
    now = driven.clock.now() + 300 * MS
    fresh.step(now, Inputs(packets=tuple(bus.read(now)[1])))
    assert {joint.mode for joint in fresh.joints.values()} == {Mode.READY}


@pytest.mark.parametrize("late", [40 * MS, 150 * MS])
def test_a_step_that_comes_late_while_a_motor_accelerates_is_no_fault(late: Nanos) -> None:
    rig = Rig()
    rig.run(0.3)
    for number in range(5):
        rig.run(0.01 * number, Velocity("left", 18.0))
        rig.clock.wait(rig.clock.now() + late)
    rig.run(0.5, Velocity("left", 18.0))
    assert not rig.gateway.joints["left"].faults
    assert rig.velocity("left") == pytest.approx(18.0, abs=0.5)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_sends_the_stop_command_and_ends_the_run(name: str, tmp_path: Path) -> None:
    """On the wall clock, in a process of its own: only so a signal is a signal."""
    recording = tmp_path / "run.mcap"
    (tmp_path / "rig.toml").write_text(BENCH)
    arguments = ("run", str(tmp_path / "rig.toml"), "--record", str(recording), "-v")
    with Process(tmp_path, *arguments) as process:
        process.until("left: ready", "right: ready")
        process.send_line("velocity left 5\nvelocity right 5")
        process.until("armed")
        status, text = process.end(signal.Signals[name])
    assert status == 0, text
    assert f"leaving: {name}" in text
    assert "Traceback" not in text
    commands = [command for _, command in sent_commands(parse_robot(BENCH), read_recording(recording).ticks)]
    assert any(isinstance(command, Velocity) for command in commands)
    assert isinstance(commands[-1], Idle)
