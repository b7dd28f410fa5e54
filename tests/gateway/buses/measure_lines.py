"""Measure what a robot's serial lines carry, in virtual time and on ptys with real time.

$ python -m tests.gateway.buses.measure_lines ROBOT.toml [virtual] [pty] [--seconds S] [--rate HZ] …

Every motor is commanded and at rest. Printed for each line: feedback per motor and second, exchanges per
second, answers that were lost, frames that overlapped on the wire, how busy it was, and what this process
(and on ptys that of the devices) has computed for each second of it.
"""

from __future__ import annotations

import argparse
import re
import signal
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from gateway import config
from gateway.buses import Bus, open_bus
from gateway.buses.frame_time import frame_time
from gateway.buses.virtual import open_world
from gateway.buses.virtual.bus import TwinBus
from gateway.core.clock import Clock, SimulatedClock, WallClock, processor_time
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.runtime.loop import Reader, moments, write
from gateway.runtime.process import fine_timers, quiet_collector
from gateway.runtime.realtime import RealtimeWanted, realtime
from gateway.runtime.schedule import commands
from gateway.runtime.timing import LoopStats
from protocols.messages import SECOND, Feedback, Idle, Nanos
from tests.gateway.processes import Process

SETTLING: Nanos = 10 * SECOND
"""Longest time until all are armed."""


@dataclass(slots=True)
class Counted:
    """What was counted in a run, from when all motors were armed."""

    span: Nanos = 0
    feedback: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    answered: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    overlaps: Counter[str] = field(default_factory=Counter)
    busy: Counter[str] = field(default_factory=Counter)
    computed: Nanos = 0
    steps: Counter[bool] = field(default_factory=Counter)
    """Those of the brain, and those between."""
    oldest: Nanos = 0
    """Age of a feedback at a step of the brain."""


def measure(robot: Robot, buses: Mapping[str, Bus], clock: Clock, seconds: float) -> Counted:
    """Run a robot, count, and disarm it. Raises RuntimeError if it is not armed."""
    gateway, count = Gateway(robot), Counted()
    reader, last = Reader(gateway, buses, clock), dict[str, Nanos]()
    began: Nanos | None = None
    start = clock.now()
    for now in moments(clock, robot.period, gateway.due, LoopStats(), reader.wait, reader.least):
        inputs = reader.inputs(now)
        between = gateway.between(now, inputs.packets)
        inputs = inputs if between else replace(inputs, instructions=tuple(commands(robot)))
        outputs = gateway.step(now, inputs)
        write(buses, now, outputs.packets)
        if began is None and all(joint.armed for joint in gateway.joints.values()) and now > start + SECOND:
            began, before = now, lines(gateway)
            worked, overlaps = processor_time(), overlapped(buses)
        elif began is None and now > start + SETTLING:
            unarmed = [name for name, joint in gateway.joints.items() if not joint.armed]
            raise RuntimeError(f"not armed: {unarmed}; {list(gateway.lines.values())}; {gateway.in_fault()}")
        if began is None:
            continue
        for packet in (*inputs.packets, *outputs.packets):
            count.busy[packet.bus] += frame_time(packet.frame, robot.buses[packet.bus].baudrate)
        for event in outputs.events:
            if isinstance(event, Feedback):
                count.feedback[robot.motors[event.motor].bus] += 1
                last[event.motor] = event.t
        count.steps[between] += 1
        if not between:
            count.oldest = max([count.oldest, *(now - t for t in last.values())])
        if now >= began + seconds * SECOND:
            count.span, count.computed = now - began, processor_time() - worked
            for name, after in lines(gateway).items():
                count.sent[name], count.answered[name], count.lost[name] = (
                    a - b for a, b in zip(after, before[name], strict=True)
                )
            count.overlaps = overlapped(buses) - overlaps
            break
    disarm(gateway, reader, buses, robot)
    return count


def lines(gateway: Gateway) -> dict[str, tuple[int, int, int]]:
    return {name: (line.sent, line.answered, line.lost) for name, line in gateway.lines.items()}


def overlapped(buses: Mapping[str, Bus]) -> Counter[str]:
    return Counter({name: bus.overlaps for name, bus in buses.items() if isinstance(bus, TwinBus)})


def disarm(gateway: Gateway, reader: Reader, buses: Mapping[str, Bus], robot: Robot) -> None:
    end = reader.clock.now() + SECOND
    for now in moments(reader.clock, robot.period, gateway.due, LoopStats(), reader.wait, reader.least):
        inputs = reader.inputs(now, () if gateway.between(now) else [Idle(name) for name in robot.motors])
        write(buses, now, gateway.step(now, inputs).packets)
        if now > end or not gateway.still_armed():
            return


def told(robot: Robot, count: Counted, more: str = "") -> None:
    span = count.span / SECOND
    for name in count.sent:
        motors = sum(one.bus == name for one in robot.motors.values())
        print(
            f"  {name}: {robot.buses[name].baudrate} bit/s, {motors} motors: "
            f"{count.feedback[name] / span / motors:.1f} feedbacks a second of each (at a step at most "
            f"{count.oldest / 1e6:.1f} ms old), {count.answered[name] / span:.0f} answers and "
            f"{count.sent[name] / span:.0f} frames sent a second, {count.lost[name]} lost, "
            f"busy {100 * count.busy[name] / count.span:.1f} %"
        )
    between, full = count.steps[True] / span, count.steps[False] / span
    exchanges = max(1, sum(count.answered.values()))
    print(
        f"  {full:.0f} steps of the brain a second and {between:.0f} between; "
        f"processor {100 * count.computed / count.span:.0f} %, {count.computed / exchanges / 1e3:.0f} µs for "
        f"each answer{more}"
    )


def virtual(robot: Robot, seconds: float) -> None:
    world = open_world(robot, robot.seed)
    count = measure(robot, world.buses, SimulatedClock(), seconds)
    print(f"{robot.name}, in virtual time: {sum(count.overlaps.values())} overlaps")
    told(robot, count)


def on_ptys(path: str, robot: Robot, seconds: float, more: Sequence[str]) -> None:
    with TemporaryDirectory() as folder, ExitStack() as stack, quiet_collector():
        devices = stack.enter_context(Process(Path(folder), "twin", path, *more))
        text = devices.until("gateway run ")
        ports = dict(re.findall(r"--bus (\w+)=(\S+)", text))
        robot = config.with_interfaces(robot, ports)
        clock, buses = WallClock(), dict[str, Bus]()
        fine_timers()
        for name, settings in robot.buses.items():
            buses[name] = open_bus(settings, clock)
            stack.callback(buses[name].close)
        worked, began = devices.processor_time(), clock.now()
        with realtime(RealtimeWanted() if "--realtime" in more else None, robot, lambda _: None):
            count = measure(robot, buses, clock, seconds)
        share = (devices.processor_time() - worked) / (clock.now() - began) * SECOND
        said = devices.end(signal.SIGTERM)[1].splitlines()[-1]
        print(f"{robot.name}, on ptys: {said}")
        each = share * count.span / max(1, sum(count.answered.values())) / 1e3
        told(robot, count, f"; that of the devices {100 * share:.0f} %, {each:.0f} µs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot")
    parser.add_argument("how", nargs="*", choices=["virtual", "pty", []])
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--rate", type=float, help="steps of the brain per second")
    parser.add_argument("--realtime", action="store_true", help="both processes with real-time priority")
    parser.add_argument("--echo", action="store_true", help="the adapter echoes")
    given = parser.parse_args()
    robot = config.load_robot(given.robot)
    if given.rate:
        robot = replace(robot, period=round(SECOND / given.rate))
    if "virtual" in given.how or not given.how:
        virtual(robot, given.seconds)
    if "pty" in given.how or not given.how:
        more = [f"--{each}" for each in ("echo", "realtime") if getattr(given, each)]
        on_ptys(given.robot, robot, given.seconds, more)


if __name__ == "__main__":
    main()
