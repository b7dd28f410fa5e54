"""From a feedback to the set-point that follows it: the live loop, a CAN adapter on a pty, a motor behind it.

Rules. The loop is the live one, by the machine's clock, with the bus of a slcan adapter; the far end of its
pty is a process of its own (`python -m benchmarks.latency RATE SECONDS`), which has the motor's twin and both
stamps: when the bytes of a feedback are written, and when those of the first set-point after it are there.
Feedback comes at random phases of the loop's period, so half a period is part of the median, and a whole one
of the worst. What the far end takes to look is part of it, too.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from importlib.resources import files
from pathlib import Path

from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.process import LEFT_OUT
from benchmarks.rows import Row, span
from benchmarks.steps import first
from gateway import config
from gateway.buses import open_bus
from gateway.buses.adapters.adapter_pty import AdapterPty
from gateway.buses.virtual.bus import NEVER, open_world
from gateway.core.clock import WallClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.runtime.loop import live
from gateway.runtime.process import fine_timers, quiet_collector
from protocols.frames import CanFrame, Frame
from protocols.messages import SECOND, Instruction, Nanos, Velocity

GROUP = "from the bytes of a feedback to those of the next set-point (one motor, slcan on a pty)"
WHAT = "at {} Hz"
RATES = (200, 500, 1000)
"""Hz"""
MOTOR, BUS = "left", "can0"
FEEDBACK, SET_POINT = 0x09, 0x0D
"""Commands of CANSimple: Get_Encoder_Estimates, Set_Input_Vel"""
LOOK: Nanos = 50_000
"""Period in which the far end looks."""
PATIENCE: Nanos = 60 * SECOND
"""After which the far end should have measured."""
PHASE = 0.6180339887
"""Share of a period by which each feedback comes later than the one before: all phases come evenly."""


def latency(effort: Effort) -> list[Row]:
    """Rate by rate."""
    rows = [
        Row(GROUP, WHAT.format(rate), measured(rate, effort.of(4, 1)), (span("its period", SECOND / rate),))
        for rate in RATES[: effort.of(len(RATES), 1)]
    ]
    return rows + [Row(GROUP, WHAT.format(rate), None, not_run=LEFT_OUT) for rate in RATES[len(rows) :]]


def robot_at(rate: int) -> Robot:
    """The first motor of the bench, at this rate [Hz]."""
    text = (files("gateway.fixtures") / "robots" / "bench.toml").read_text("utf-8")
    return first(config.parse_robot(text.replace("rate_hz = 200", f"rate_hz = {rate}")), 1)


def measured(rate: int, seconds: int) -> Figures:
    """Nanoseconds, over so many seconds. Raises NotMeasured if nothing was commanded."""
    root = str(Path(__file__).parents[1])
    command = [sys.executable, "-m", "benchmarks.latency", str(rate), str(seconds)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": root}
    ) as far:
        assert far.stdout is not None
        try:
            path = far.stdout.readline().strip()
            drive(config.with_interfaces(robot_at(rate), {BUS: f"slcan:{path}"}), far.stdout.fileno())
            ready = select.select([far.stdout], (), (), 0.0)[0]
            found: list[int] = json.loads(far.stdout.readline()) if ready else []
        finally:
            far.kill()
    if not found:
        raise NotMeasured(f"at {rate} Hz no set-point followed a feedback")
    return figures(found)


def drive(robot: Robot, said: int) -> None:
    """Turn the motor until the far end has said something."""
    clock = WallClock()
    asked: list[Instruction] = [Velocity(MOTOR, 2.0)]
    gateway, bus = Gateway(robot), open_bus(robot.buses[BUS], clock)

    def ask() -> Sequence[Instruction]:
        return [asked.pop()] if asked and not gateway.joints[MOTOR].feedback_lost(clock.now()) else ()

    fine_timers()
    with quiet_collector(), closing(bus), closing(live(gateway, {BUS: bus}, clock, poll=ask)) as ticks:
        for _ in ticks:
            if clock.now() > PATIENCE or select.select([said], (), (), 0.0)[0]:
                break


def far_end(rate: int, seconds: int) -> None:
    """Be the motor behind an adapter; print its path, then the latencies [ns] once they were measured."""
    robot, clock, phase = robot_at(rate), WallClock(), 0.0
    bus = open_world(robot, robot.seed).buses[BUS]
    held: list[tuple[Nanos, Frame]] = []
    found: list[Nanos] = []
    reported: Nanos | None = None
    begun: Nanos | None = None
    with closing(AdapterPty(robot.buses[BUS])) as adapter:
        print(adapter.paths[0], flush=True)
        while True:  # until it is ended
            clock.wait(clock.now() + LOOK)
            now = clock.now()
            _, packets = adapter.read(now)
            if any(_is(packet.frame, SET_POINT) for packet in packets):
                begun = now if begun is None else begun
                found += [] if reported is None else [now - reported]
                reported = None
            bus.write(now, [packet.frame for packet in packets])
            for packet in bus.read(now)[1]:
                phase = (phase + PHASE) % 1.0
                late = round(phase * robot.period) if _is(packet.frame, FEEDBACK) else 0
                held.append((now + late, packet.frame))
            due = [frame for at, frame in held if at <= now]
            held = [each for each in held if each[0] > now]
            if due:
                reported = clock.now() if any(_is(frame, FEEDBACK) for frame in due) else reported
                adapter.write(now, due)
            if begun is not None and now >= begun + seconds * SECOND:
                print(json.dumps(found), flush=True)
                begun = NEVER


def _is(frame: Frame, command: int) -> bool:
    return isinstance(frame, CanFrame) and frame.id & 0x1F == command


if __name__ == "__main__":
    far_end(int(sys.argv[1]), int(sys.argv[2]))
