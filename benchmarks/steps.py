"""A step of the gateway in which every motor reports and every motor is commanded.

Rules. The motors are twins; they arm, are given targets and turn, in simulated time. What came in is kept and
given to fresh gateways, which alone are timed. Only steps count in which each motor reported its position
and a packet for each went out. A step is timed back to back, with all that it needs in the processor's
caches; a tick as it is on a robot: at its own pace, with the loop, buses that cost nothing, and the recorder.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

from benchmarks.measure import Effort, Figures, figures
from benchmarks.rows import Beside, Row, Target, span
from brain.bodies import bare
from gateway import config
from gateway.buses import Bus
from gateway.buses.virtual.bus import open_world
from gateway.core.clock import Clock, PacedClock, SimulatedClock, processor_time, stopwatch
from gateway.core.guard import Blocked, Guard
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.recording import Recorder
from gateway.runtime.loop import live
from gateway.runtime.process import quiet_collector
from protocols.frames import BusState, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Feedback, Instruction, Nanos, Position, Velocity

GROUP = "a step of the gateway (all motors report, all are commanded)"
TICKS = "a tick of the live loop at its own pace: processor time (read, step, write, record)"
GUARD = "the guard (for each frame that goes out, part of the step)"
TICK = "a tick of 5 ms"
STEP_ALONE, UNPACED = "its step alone, back to back", "the same tick, back to back"
FRAME = "the frame on a bus of 1 Mbit/s"
CAN_FRAME: Nanos = 130_000
"""8 bytes with an 11-bit id, the worst but for a few bits of stuffing"""
SETTLED = 300 * MILLISECOND
"""When targets are asked for: by then every motor has reported."""
WARM = 600 * MILLISECOND
"""From here on steps count."""
SPRING = 'mode = "mit"\nstiffness = 20.0\ndamping = 1.0\nfeedback_ms = 5'
"""Options of motors that take their set-points as springs."""
WINDOW = 20
"""Ticks over which the work is gathered: the recorder's threads work by chunks."""
Drive: TypeAlias = tuple[Robot, Sequence[Tick]]


def steps(effort: Effort) -> list[Row]:
    """12 motors, and the first 2 of them; 12 of other protocols; and the whole ticks of all of these."""
    twelve = config.load_robot("twelve")
    seconds = effort.of(3, 1)
    drives = {
        "2 motors, velocity": drive(first(twelve, 2), lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, velocity": drive(twelve, lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, position": drive(twelve, lambda motor: Position(motor, 3.0), seconds),
    } | {
        f"12 {name} in MIT mode, position": drive(
            of_protocol(protocol, SPRING), lambda motor: Position(motor, 1.0), seconds
        )
        for name, protocol in (("Damiao", "damiao"), ("RobStride", "robstride"))
    }
    drives |= {
        f"12 {name}, velocity": drive(
            of_protocol(protocol, options), lambda motor: Velocity(motor, 5.0), seconds
        )
        for name, protocol, options in (
            ("moteus", "moteus", "timeout_ms = 100"),
            ("CiA 402", "cia402", "sync_ms = 5"),
        )
    }
    found = time_steps(drives, effort.of(9, 1))
    targets = {name: Target(at_most=0.4 * MILLISECOND) for name in drives if name.startswith("12 motors")}
    tick = {name: (span(TICK, robot.period),) for name, (robot, _) in drives.items()}
    checked = {name: guard_time(*drives[name]) for name in drives}
    frame = (span(FRAME, CAN_FRAME),)
    return [
        *(Row(GROUP, name, found[name], tick[name], targets.get(name)) for name in drives),
        *(
            Row(
                TICKS, f"a tick: {name}", paced(*drives[name]), tick[name] + back_to_back(name, found, drives)
            )
            for name in drives
        ),
        *(Row(GUARD, f"a frame: {name}", checked[name], frame, None) for name in drives),
    ]


def back_to_back(name: str, found: Mapping[str, Figures], drives: Mapping[str, Drive]) -> tuple[Beside, ...]:
    """What a tick at its own pace stands beside: the step alone, and the same tick without a pause."""
    return Beside(STEP_ALONE, found[name]), Beside(UNPACED, paced(*drives[name], SimulatedClock()))


@dataclass(slots=True)
class Played:
    """A bus on which what once came in comes again, at its times, and that takes all that is sent."""

    name: str
    packets: Sequence[Packet]
    _read: int = 0

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return what has come since the last call."""
        begun, self._read = self._read, bisect_right(self.packets, now, key=lambda packet: packet.t)
        return (), self.packets[begun : self._read]

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Take them."""

    def close(self) -> None:
        """Nothing is open."""


def paced(robot: Robot, ticks: Sequence[Tick], clock: Clock | None = None) -> Figures:
    """Processor time of a tick with its recording, all threads together, by windows of so many ticks. By
    default at its own pace."""
    packets = [packet for tick in ticks for packet in tick.inputs.packets]
    buses: dict[str, Bus] = {
        name: Played(name, [packet for packet in packets if packet.bus == name]) for name in robot.buses
    }
    asked = deque((tick.now, tick.inputs.instructions) for tick in ticks if tick.inputs.instructions)
    clock, found = clock or PacedClock(), list[float]()

    def ask() -> Sequence[Instruction]:
        return asked.popleft()[1] if asked and clock.now() >= asked[0][0] else ()

    log = logging.getLogger("gateway")
    log.disabled = True  # what is played does not hear that it is to disarm
    with TemporaryDirectory() as folder, Recorder(Path(folder) / "a.mcap", robot.text, {}) as recorder:
        run = live(Gateway(robot), buses, clock, poll=ask, record=recorder.record, until=ticks[-1].now)
        with quiet_collector(), closing(run):
            begun = processor_time()
            for tick in run:
                if tick.number % WINDOW == 0:
                    now = processor_time()
                    found += [(now - begun) / WINDOW] if tick.now >= WARM else []
                    begun = now
    log.disabled = False
    return figures(found)


class TimedGuard(Guard):
    """A guard with the time that each frame that it passed took [ns]."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.took: list[float] = []

    def check(self, *given: Any, **named: Any) -> tuple[list[Frame], list[Blocked]]:  # noqa: ANN401 -- passed on
        """Check, with a clock around it."""
        began = stopwatch()
        passed, blocked = super().check(*given, **named)
        if passed:
            self.took.append((stopwatch() - began) / len(passed))
        return passed, blocked


def guard_time(robot: Robot, ticks: Sequence[Tick]) -> Figures:
    """Nanoseconds that the guard takes for each frame that goes out."""
    gateway, guard = Gateway(robot), TimedGuard(robot)
    gateway.guard = guard
    with quiet_collector():
        for tick in ticks:
            gateway.step(tick.now, tick.inputs)
    return figures(guard.took)


def of_protocol(protocol: str, options: str) -> Robot:
    """The robot of twelve motors with motors of another protocol, without a gear."""
    text = (files("gateway.fixtures") / "robots" / "twelve.toml").read_text("utf-8")
    head, _, rest = text.partition("[defaults.motors.options]")
    head = head.replace('"odrive_can"', f'"{protocol}"').replace("gear = 8.0", "gear = 1.0")
    if protocol == "moteus":
        head = head.replace('kind = "can"', 'kind = "canfd"\ndata_bitrate = 5_000_000')
    return config.parse_robot(
        f"{head}[defaults.motors.options]\n{options}\n[motors]{rest.partition('[motors]')[2]}"
    )


def first(robot: Robot, motors: int) -> Robot:
    """The same robot of bare joints with so many of its motors, and the buses that they are on."""
    kept = dict(islice(robot.motors.items(), motors))
    used = {motor.bus for motor in kept.values()}
    buses = {name: bus for name, bus in robot.buses.items() if name in used}
    return replace(robot, motors=kept, buses=buses, brain=replace(robot.brain, body=bare(kept)))


def drive(robot: Robot, target: Callable[[str], Instruction], seconds: int) -> Drive:
    """Let the twins of a robot turn for a while; all that happened."""
    world = open_world(robot, robot.seed)
    clock = SimulatedClock()
    waiting: list[Instruction] = [target(motor) for motor in robot.motors]

    def ask() -> Sequence[Instruction]:
        if not waiting or clock.now() < SETTLED:
            return ()
        asked = tuple(waiting)
        waiting.clear()
        return asked

    until: Nanos = seconds * SECOND
    with closing(live(Gateway(robot), world.buses, clock, poll=ask, until=until)) as ticks:
        return robot, list(ticks)


def time_steps(drives: dict[str, Drive], rounds: int) -> dict[str, Figures]:
    """Nanoseconds of the steps that count, over fresh gateways, drive by drive in turn."""
    runs: dict[str, list[Sequence[int]]] = {name: [] for name in drives}
    for _ in range(rounds):
        for name, (robot, ticks) in drives.items():
            runs[name].append(timed(robot, ticks))
    return {
        name: figures_by_step(runs[name], counting(ticks, robot)) for name, (robot, ticks) in drives.items()
    }


def counting(ticks: Sequence[Tick], robot: Robot) -> set[int]:
    """The numbers of the ticks in which each motor reports its motion and each is commanded."""
    return {
        tick.number
        for tick in ticks
        if tick.now >= WARM
        and len(tick.outputs.packets) >= len(robot.motors)
        and {e.motor for e in tick.outputs.events if isinstance(e, Feedback) and e.position is not None}
        == set(robot.motors)
    }


def timed(robot: Robot, ticks: Sequence[Tick]) -> list[int]:
    """How long each step takes a fresh gateway that is given the same as before."""
    gateway = Gateway(robot)
    took: list[int] = []
    with quiet_collector():
        for tick in ticks:
            began = stopwatch()
            gateway.step(tick.now, tick.inputs)
            took.append(stopwatch() - began)
    return took


def figures_by_step(runs: Sequence[Sequence[int]], which: Collection[int]) -> Figures:
    """Over the chosen steps, each with the median of its runs: so the 99th percentile is of steps that
    take long, and not of moments in which the machine did something else."""
    return figures([figures([run[number] for run in runs]).median for number in sorted(which)])
