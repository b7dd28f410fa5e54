"""The loops: deadlines, the way out, and two ends face to face."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import pairwise

import can
import pytest

from gateway.buses.can import open_can
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import BusSettings
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.runtime import loop
from gateway.runtime.serve import serve
from protocols.messages import MILLISECOND, SECOND, Idle, Mode, Nanos, Velocity
from tests.gateway.rig import Rig, sent_commands

MS = MILLISECOND


class SlowClock(SimulatedClock):
    """A clock on which some steps take long."""

    def __init__(self, steps: Iterator[Nanos]) -> None:
        super().__init__()
        self._steps = steps

    def work(self) -> None:
        self.wait(self.now() + next(self._steps))


def test_deadlines_are_absolute_and_what_was_missed_is_counted_and_not_caught_up() -> None:
    clock = SlowClock(iter([1 * MS, 1 * MS, 17 * MS, 1 * MS, 1 * MS, 1 * MS]))
    stats = loop.LoopStats()
    seen = []
    for now in loop.moments(clock, 5 * MS, lambda: None, stats):
        seen.append(now // MS)
        if len(seen) == 6:
            break
        clock.work()
    assert seen == [0, 5, 10, 27, 30, 35]
    assert stats.missed == 2  # 20 and 25 ms; that of 15 ms came late


def test_a_driver_that_is_due_between_two_periods_gets_a_step_of_its_own() -> None:
    clock = SimulatedClock()
    due = iter([2 * MS, None, 5 * MS + 100, 7 * MS, None])
    seen = []
    for now in loop.moments(clock, 5 * MS, lambda: next(due), loop.LoopStats()):
        seen.append(now)
        if len(seen) == 5:
            break
    assert seen == [0, 2 * MS, 5 * MS, 6 * MS, 7 * MS]


def test_a_driver_that_is_always_due_does_not_keep_the_loop_busy() -> None:
    clock = SimulatedClock()
    seen = []
    for now in loop.moments(clock, 5 * MS, lambda: 0, loop.LoopStats()):
        seen.append(now)
        if now >= 20 * MS:
            break
    assert min(b - a for a, b in pairwise(seen)) >= loop.MIN_STEP


def test_the_wall_clock_moves_forward_and_waits() -> None:
    clock = WallClock()
    start = clock.now()
    clock.wait(start + 2 * MS)
    assert clock.now() >= start + 2 * MS
    clock.wait(0)  # past: at once
    assert abs(__import__("time").time_ns() - clock.system_offset() - clock.now()) < SECOND


@pytest.fixture
def driven() -> Rig:
    rig = Rig()
    rig.run(0.3)
    rig.run(0.5, Velocity("left", 5.0), Velocity("right", 5.0))
    assert {joint.mode for joint in rig.gateway.joints.values()} == {Mode.ARMED}
    return rig


def test_at_the_end_the_safe_word_goes_out_first_and_the_devices_are_heard_to_disarm(driven: Rig) -> None:
    farewell = driven.leave()
    words = [word for _, word in sent_commands(driven, farewell)]
    assert words[:2] == [Idle("left"), Idle("right")]
    assert {joint.mode for joint in driven.gateway.joints.values()} == {Mode.READY}
    assert farewell[-1].now - farewell[0].now <= loop.DISARM_TIMEOUT


def test_an_end_that_was_set_disarms_too() -> None:
    rig = Rig()
    ticks = list(
        loop.live(
            rig.gateway, rig.world.buses, rig.clock, until=SECOND, poll=lambda: (Velocity("left", 5.0),)
        )
    )
    assert ticks[-1].now < SECOND
    assert rig.gateway.joints["left"].owned
    assert rig.gateway.still_armed() == []


def test_an_exception_in_the_step_still_says_the_safe_word(
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


def test_a_dry_run_writes_nothing_at_all() -> None:
    rig = Rig()
    ticks = list(
        loop.live(
            rig.gateway,
            rig.world.buses,
            rig.clock,
            until=SECOND,
            poll=lambda: (Velocity("left", 5.0),),
            dry_run=True,
        )
    )
    assert any(tick.outputs.packets for tick in ticks)
    assert rig.velocity("left") == 0.0
    assert rig.gateway.joints["left"].mode is Mode.READY


def test_live_and_serve_face_to_face_over_real_buses() -> None:
    """Two loops in one for-loop: our end and the devices' end, each on its own python-can bus."""
    rig = Rig()
    clock = rig.clock
    settings = BusSettings("can0", "can", "virtual:face-to-face", 1_000_000)
    ours, theirs = (open_can(settings, clock) for _ in range(2))
    sniffer = can.Bus(interface="virtual", channel="face-to-face")
    asked = [Velocity("left", 5.0), Velocity("right", 5.0)]

    def ask() -> list[Velocity]:
        return asked if rig.gateway.joints["left"].feedback_age(clock.now()) is not None else []

    served = serve(rig.world.buses, {"can0": theirs}, clock, MS)
    lived = loop.live(rig.gateway, {"can0": ours}, clock, poll=ask)
    try:
        for _ in range(1200):
            next(served)
            if clock.now() % (5 * MS) == 0:
                next(lived)
        assert rig.velocity("left") == pytest.approx(5.0, abs=0.2)
        assert sniffer.recv(0) is not None
    finally:
        served.close()
        lived.close()
        ours.close()
        theirs.close()
        sniffer.shutdown()


SCRIPT = """
import sys
from gateway.cli.main import main
sys.exit(main(["run", sys.argv[1], "-v"]))
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_says_the_safe_word_and_ends_the_run(name: str, tmp_path: object) -> None:
    """On the wall clock, in a process of its own: only so a signal is a signal."""
    from pathlib import Path

    from gateway.recording import read_recording
    from tests.gateway.rig import BENCH

    folder = Path(str(tmp_path))
    robot = folder / "rig.toml"
    robot.write_text(BENCH)
    recording = folder / "run.mcap"
    command = [sys.executable, "-m", "gateway", "run", str(robot), "--record", str(recording), "-v"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=environment,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        output = []
        sent = False
        for line in process.stdout:
            output.append(line)
            if "right: ready" in line or "left: ready" in line:
                process.stdin.write("velocity left 5\nvelocity right 5\n")
                process.stdin.flush()
            if "armed" in line and not sent:
                process.send_signal(signal.Signals[name])
                sent = True
        status = process.wait()
    text = "".join(output)
    assert status == 0, text
    assert f"leaving: {name}" in text
    assert "Traceback" not in text
    rig = Rig()
    ticks = list(read_recording(recording).ticks)
    words = [word for _, word in sent_commands(rig, ticks)]
    assert any(isinstance(word, Velocity) for word in words)
    assert isinstance(words[-1], Idle)
