"""A step of the gateway in which every motor reports and every motor is commanded.

Rules. The motors are twins; they arm, are given targets and turn, in simulated time. What came in is kept and
given to fresh gateways, which alone are timed. Only steps count in which each motor reported its position
and a packet for each went out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from contextlib import closing
from dataclasses import replace
from importlib.resources import files
from itertools import islice
from typing import Any, TypeAlias

from benchmarks.measure import Effort, Figures, figures
from benchmarks.rows import Row, Target, span
from brain.bodies import bare
from gateway import config
from gateway.buses.virtual.bus import open_world
from gateway.core.clock import SimulatedClock, stopwatch
from gateway.core.guard import Blocked, Guard
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.runtime.loop import live
from gateway.runtime.process import quiet_collector
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Feedback, Instruction, Nanos, Position, Velocity

GROUP = "a step of the gateway (all motors report, all are commanded)"
GUARD = "the guard (for each frame that goes out, part of the step)"
TICK = "a tick of 5 ms"
FRAME = "the frame on a bus of 1 Mbit/s"
CAN_FRAME: Nanos = 130_000
"""8 bytes with an 11-bit id, the worst but for a few bits of stuffing"""
SETTLED = 300 * MILLISECOND
"""When targets are asked for: by then every motor has reported."""
WARM = 600 * MILLISECOND
"""From here on steps count."""
Drive: TypeAlias = tuple[Robot, Sequence[Tick]]


def steps(effort: Effort) -> list[Row]:
    """12 motors, and the first 2 of them; 12 others, which take their set-points as springs."""
    twelve = config.load_robot("twelve")
    seconds = effort.of(3, 1)
    drives = {
        "2 motors, velocity": drive(first(twelve, 2), lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, velocity": drive(twelve, lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, position": drive(twelve, lambda motor: Position(motor, 3.0), seconds),
    } | {
        f"12 {name} in MIT mode, position": drive(
            springs(protocol), lambda motor: Position(motor, 1.0), seconds
        )
        for name, protocol in (("Damiao", "damiao"), ("RobStride", "robstride"))
    }
    found = time_steps(drives, effort.of(9, 1))
    targets = {name: Target(at_most=0.4 * MILLISECOND) for name in drives if name.startswith("12 motors")}
    tick = {name: (span(TICK, robot.period),) for name, (robot, _) in drives.items()}
    checked = {name: guard_time(*drives[name]) for name in drives}
    frame = (span(FRAME, CAN_FRAME),)
    return [
        *(Row(GROUP, name, found[name], tick[name], targets.get(name)) for name in drives),
        *(Row(GUARD, f"a frame: {name}", checked[name], frame, None) for name in drives),
    ]


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


def springs(protocol: str) -> Robot:
    """The robot of twelve motors with motors of another protocol, in MIT mode and without a gear."""
    text = (files("gateway.fixtures") / "robots" / "twelve.toml").read_text("utf-8")
    head, _, rest = text.partition("[defaults.motors.options]")
    head = head.replace('"odrive_can"', f'"{protocol}"').replace("gear = 8.0", "gear = 1.0")
    options = 'mode = "mit"\nstiffness = 20.0\ndamping = 1.0\nfeedback_ms = 5'
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
