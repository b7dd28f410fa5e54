"""A step of the gateway in which every motor reports and every motor is commanded.

Rules. The motors are twins, on buses of six; they arm, are given targets and turn, in simulated time. What came in
is kept and given to fresh gateways, which alone are timed. Only those steps count in which at least one message of
each motor came in and at least one set-point for each went out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TypeAlias

from gateway import config
from gateway.bench.measure import Effort, Figures, figures
from gateway.bench.rows import Row, Target, span
from gateway.buses.twin import open_world
from gateway.clock import SimulatedClock, stopwatch
from gateway.gateway import Gateway
from gateway.robot import Robot
from gateway.run import live, quiet_collector
from gateway.tick import Tick
from protocols.words import MILLISECOND, SECOND, Asked, Nanos, Position, Velocity

GROUP = "a step of the gateway (odrive_can; all motors report, all are commanded)"
PERIOD = 5 * MILLISECOND
TICK = "a tick of 5 ms"
SETTLED = 400 * MILLISECOND
"""When targets are asked for: by then every motor has been heard."""
WARM = SECOND
"""From here on steps count."""
MOTORS_PER_BUS = 6
"""What 1 Mbit/s carries at 200 reports and 200 set-points a second each."""
Drive: TypeAlias = tuple[Robot, Sequence[Tick]]


def steps(effort: Effort) -> list[Row]:
    """2 and 12 motors."""
    seconds = effort.of(5, 2)
    drives = {
        "2 motors, velocity": drive(2, lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, velocity": drive(12, lambda motor: Velocity(motor, 5.0), seconds),
        "12 motors, position": drive(12, lambda motor: Position(motor, 3.0), seconds),
    }
    found = time_steps(drives, effort.of(8, 1))
    targets = {name: Target(at_most=0.4 * MILLISECOND) for name in drives if name.startswith("12")}
    return [Row(GROUP, name, found[name], (span(TICK, PERIOD),), targets.get(name)) for name in drives]


def robot_text(motors: int) -> str:
    """A robot file of so many bare motors, six to a bus, each of which reports every 5 ms."""
    names = [f"m{number:02}" for number in range(1, motors + 1)]
    bus_of = {name: f"can{index // MOTORS_PER_BUS}" for index, name in enumerate(names)}
    buses = "".join(
        f'[buses.{bus}]\nkind = "can"\nbitrate = 1_000_000\ninterface = "twin"\n'
        for bus in dict.fromkeys(bus_of.values())
    )
    parts = "".join(
        f'[motors.{name}]\nbus = "{bus_of[name]}"\naddress = {address}\n'
        for address, name in enumerate(names, start=1)
    )
    return f"""
name = "bench-of-{motors}"
rate_hz = 200
world = "bench"
{buses}
[defaults.motors]
protocol = "odrive_can"
gear = 8.0
limits = {{ velocity = 20.0, acceleration = 60.0, torque = 2.0 }}
options = {{ watchdog = "acknowledged", feedback_ms = 5 }}
settings = {{ encoder_msg_rate_ms = 5 }}
{parts}
[brain]
body = "joints"
[brain.joints]
motors = {names}
"""


def drive(motors: int, target: Callable[[str], Asked], seconds: int) -> Drive:
    """Let the twins of a robot turn for a while; all that happened."""
    robot = config.loads(robot_text(motors))
    world = open_world(robot, robot.seed)
    clock = SimulatedClock()
    waiting: list[Asked] = [target(name) for name in robot.motors]

    def ask() -> Sequence[Asked]:
        if not waiting or clock.now() < SETTLED:
            return ()
        asked = tuple(waiting)
        waiting.clear()
        return asked

    until: Nanos = seconds * SECOND
    with closing(live(Gateway(robot), world.buses, clock, ask=ask, until=until)) as ticks:
        return robot, list(ticks)


def time_steps(drives: dict[str, Drive], rounds: int) -> dict[str, Figures]:
    """Nanoseconds of the steps that count, over fresh gateways, drive by drive in turn."""
    took: dict[str, list[float]] = {name: [] for name in drives}
    for _ in range(rounds):
        for name, (robot, ticks) in drives.items():
            counting = {tick.number for tick in ticks if _counts(tick, len(robot.motors))}
            took[name] += [ns for tick, ns in _timed(robot, ticks) if tick.number in counting]
    return {name: figures(samples) for name, samples in took.items()}


def _counts(tick: Tick, motors: int) -> bool:
    """Whether each motor reports and each is commanded."""
    return tick.now >= WARM and len(tick.inputs.packets) >= motors and len(tick.outputs.packets) >= motors


def _timed(robot: Robot, ticks: Sequence[Tick]) -> list[tuple[Tick, int]]:
    gateway = Gateway(robot)
    took: list[tuple[Tick, int]] = []
    with quiet_collector():
        for tick in ticks:
            began = stopwatch()
            gateway.step(tick.now, tick.inputs)
            took.append((tick, stopwatch() - began))
    return took
