"""A world that is simulated in this process, on a machine that does not keep up: slow motion, and a page that
is served. The machine is a clock, too: it moves by what a step is said to take."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from brain.belief import Belief
from gateway.buses.virtual import beside_real, open_world
from gateway.config import load_robot
from gateway.core.clock import AWAKE, MADE_UP, REST, PacedClock, SimulatedClock
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.recording import read_recording
from gateway.runtime.loop import live
from gateway.runtime.session import Session, open_session
from gateway.runtime.status import status_text
from gateway.runtime.timing import LoopStats
from gateway.view.server import MAX_CLIENTS
from protocols.messages import MILLISECOND, SECOND, Nanos, Release, Velocity
from tests.gateway.runtime.test_live_view import address_of
from tests.gateway.view.clients import Browser

MS = MILLISECOND


def starved(session: Session, step: Nanos) -> SimulatedClock:
    """Let each step of a session take so long; return the machine's clock."""
    machine = SimulatedClock()
    session.clock = PacedClock(machine)
    session.watch(lambda tick, belief: machine.wait(machine.now() + step))
    return machine


@pytest.fixture
def bench() -> Iterator[Session]:
    with open_session("bench") as session:
        yield session


# -- the clock -------------------------------------------------------------------------------------


def test_a_paced_clock_waits_for_the_machine_and_makes_up_for_a_hiccup() -> None:
    machine = SimulatedClock()
    clock = PacedClock(machine)
    clock.wait(10 * MS)
    assert (clock.now(), machine.now()) == (10 * MS, 10 * MS)
    machine.wait(50 * MS)
    for until in range(15 * MS, 70 * MS, 5 * MS):
        clock.wait(until)
        assert clock.now() == until
    assert machine.now() == 65 * MS


def test_a_paced_clock_stands_still_for_what_is_more_than_a_hiccup() -> None:
    machine = SimulatedClock()
    clock = PacedClock(machine)
    machine.wait(10 * SECOND)
    clock.wait(5 * MS)
    assert clock.now() == 5 * MS
    clock.wait(SECOND)
    assert machine.now() == 10 * SECOND + REST + SECOND - 5 * MS - MADE_UP


def test_a_paced_clock_that_is_always_late_rests_now_and_then() -> None:
    machine = SimulatedClock()
    clock = PacedClock(machine)
    rests = 0
    for until in range(1000):
        machine.wait(machine.now() + MS)
        before = machine.now()
        clock.wait(until)
        rests += machine.now() - before == REST
    assert rests == 1000 * MS // AWAKE


# -- the loop --------------------------------------------------------------------------------------


def test_a_run_with_twins_is_in_real_time_at_most(bench: Session) -> None:
    assert isinstance(bench.clock, PacedClock)
    machine = starved(bench, 1 * MS)
    for _ in bench.run(2.0):
        pass
    assert machine.now() == pytest.approx(bench.clock.now(), abs=MADE_UP)
    assert bench.stats.pace == pytest.approx(1.0, abs=0.01)
    assert bench.stats.trouble == ""


@pytest.mark.parametrize("step", [40 * MS, 2 * SECOND])
def test_a_starved_run_moves_the_world_by_one_period_a_step_and_misses_nothing(
    bench: Session, step: Nanos
) -> None:
    starved(bench, step)
    assert bench.twins is not None
    world, most, before = bench.twins.world, 0, 0
    with closing(bench.run(1.0)) as ticks:
        for tick in ticks:
            most, before = max(most, world.now - before) if tick.number else 0, world.now
    assert 0 < most <= bench.robot.period
    assert bench.stats.missed == 0
    assert bench.clock.now() >= SECOND


def test_slow_motion_gives_the_same_ticks_as_simulated_time(tmp_path: Path) -> None:
    packets = []
    for name in ("fast", "slow"):
        file = tmp_path / f"{name}.mcap"
        with open_session("bench", simulated=name == "fast", record=file) as session:
            if name == "slow":
                starved(session, 30 * MS)
            session.submit(Velocity("left", 1.0))
            for _ in session.run(0.5):
                pass
        packets.append([(t.now, t.inputs.packets, t.outputs.packets) for t in read_recording(file).ticks])
    assert packets[0] == packets[1]
    assert any(sent for _, _, sent in packets[0])


def test_slow_motion_is_told_once_and_at_the_end_and_in_the_status(
    bench: Session, caplog: pytest.LogCaptureFixture
) -> None:
    starved(bench, 50 * MS)
    with caplog.at_level(logging.WARNING):
        for _ in bench.run(2.0):
            pass
    told = [record.message for record in caplog.records if "slow motion" in record.message]
    share = bench.robot.period / (50 * MS)
    assert bench.stats.pace == pytest.approx(share, rel=0.15)
    assert len(told) == 2
    assert f"at {share:.2f} of real time" in told[1]
    assert "end other processes" in told[0]
    assert "slow motion" in status_text(bench)


# -- real buses ------------------------------------------------------------------------------------


def told(caplog: pytest.LogCaptureFixture, seconds: float, late: range, work: Nanos = 0) -> list[str]:
    """Return what a run whose clock does not wait logs of that; steps of these numbers take 12 ms of 5.

    `work`: computing in the longest step, which took 100 s."""
    robot, clock = load_robot("bench"), SimulatedClock()
    stats = LoopStats(longest_step=100 * SECOND, longest_work=work)

    def record(tick: Tick, belief: Belief) -> None:
        clock.wait(clock.now() + (12 * MS if tick.number in late else MS))

    caplog.clear()
    buses = open_world(robot, 1).buses
    run = live(Gateway(robot), buses, clock, record=record, until=round(seconds * SECOND), stats=stats)
    with closing(run):
        for _ in run:
            pass
    return [record.message for record in caplog.records if "missed" in record.message]


def test_missed_ticks_are_told_once_they_exceed_one_percent_and_at_the_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert told(caplog, 3.0, range(100, 103)) == []
    (once,) = told(caplog, 12.0, range(100, 115))
    assert once.startswith("21 of ")  # more than 1 % of 10 s
    assert "other processes had the processor" in once
    assert "--realtime" in once
    first, summary = told(caplog, 3.0, range(100, 2000), work=60 * SECOND)
    assert first.startswith("21 of ")
    assert "the step is too long" in first
    assert re.match(r"in this run: \d{3} of \d{3} ticks missed \(\d\d%\); the longest step", summary)


def test_twins_beside_real_buses_do_bounded_work_and_are_read_in_the_loops_time() -> None:
    """A sleep of 10 s had to be made up for by the whole world, in one step."""
    robot = load_robot("bench")
    world = open_world(robot, 1)
    bus, before = beside_real.buses(world)["can0"], 0
    last = 0
    for now in (*range(0, 200 * MS, 5 * MS), 10 * SECOND, *range(10 * SECOND, 11 * SECOND, 25 * MS)):
        _, packets = bus.read(now)
        assert all(max(last, now - MADE_UP) <= packet.t <= now for packet in packets)
        assert world.world.now - before <= MADE_UP
        before, last = world.world.now, now
    assert packets
    assert world.world.now == pytest.approx(11 * SECOND - (10 * SECOND - 195 * MS - MADE_UP), abs=30 * MS)


# -- the page --------------------------------------------------------------------------------------


@pytest.fixture
def pages() -> Iterator[list[Browser]]:
    made: list[Browser] = []
    yield made
    for page in made:
        page.close()


def talk(pages: list[Browser]) -> None:
    for page in pages:
        if page.of("hello"):
            page.send({"held": "velocity left 2"})
        page.poll()


def test_stop_is_taken_within_half_a_second_also_beside_as_many_clients_as_there_can_be(
    bench: Session, pages: list[Browser]
) -> None:
    """A step takes 100 ms; of 16 clients that all talk, three are read in one poll."""
    machine = starved(bench, 100 * MS)
    address = address_of(bench.view("0", steer=True))
    pages += [Browser(address) for _ in range(MAX_CLIENTS)]
    asked, turns, taken = 0, iter((0, 7, MAX_CLIENTS - 1)), []
    with closing(bench.run()) as ticks:
        for tick in ticks:
            assert tick.number < 300
            talk(pages)
            velocity = bench.joints["right"].feedback.velocity
            if tick.number == 20:
                bench.submit(Velocity("right", 2.0))
            if asked and bench.gateway.stopped:
                taken.append(machine.now() - asked)
                assert tick.outputs.packets  # the same step has sent it to the wheels
                bench.submit(Release(), Velocity("right", 2.0))
                asked = 0
            elif not asked and all(page.of("state") for page in pages) and (velocity or 0.0) > 1.0:
                if (turn := next(turns, None)) is None:
                    break
                pages[turn].send({"ask": "stop"})
                pages[turn].poll()
                asked = machine.now()
    assert len(taken) == 3
    assert max(taken) <= SECOND // 2
    assert pages[0].of("state")[-1]["pace"] == pytest.approx(0.05, abs=0.01)
    assert "slow motion" in pages[0].of("state")[-1]["timing"]
