"""What a driver costs for one motor: a report into events, a command into frames.

Rules. Four motors of a protocol are twins on one bus; they are armed and turn, in simulated time. What they
send, and what they are commanded, is given to fresh drivers, which alone are timed, call by call: `receive`
of a frame that reports a motion and nothing else, and `send` of a command to each motor, divided by the
motors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from benchmarks.measure import Effort, Figures, NotMeasured, figures
from benchmarks.rows import Row, span
from benchmarks.steps import CAN_FRAME, FRAME
from gateway.core.clock import stopwatch
from gateway.runtime.process import quiet_collector
from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Command,
    Event,
    Fault,
    Feedback,
    Mode,
    Nanos,
    Request,
    State,
    seconds,
)
from protocols.plugin import Device, Driver, Plugin, load

GROUP = "a driver, for one motor"
WHAT = "{}: a report into events", "{}: a command into frames"
OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "cubemars": {"mode": "mit"},
    "damiao": {"mode": "mit"},
    "moteus": {},
    "myactuator": {"mode": "motion"},
    "odrive_can": {},
    "robomaster": {},
    "robstride": {"mode": "mit"},
    "vesc": {},
}
"""Options of the motors by protocol."""
MOTORS = ("one", "two", "three", "four")
SPEED = 0.5
"""rad/s"""
PERIOD: Nanos = 5 * MILLISECOND
SETTLED: Nanos = SECOND
"""When they are commanded to turn."""
WARM: Nanos = 2 * SECOND
"""From here on calls count."""

Call: TypeAlias = tuple[Nanos, Frame | Sequence[Command | Request]]
"""A frame that is received, or what is to be sent."""


@dataclass(frozen=True, slots=True)
class Session:
    """What four motors exchange with their driver."""

    plugin: Plugin
    devices: Sequence[Device]
    calls: Sequence[Call]


def drivers(effort: Effort) -> list[Row]:
    """Both directions, protocol by protocol."""
    sessions = {name: session(name, effort.of(6, 3) * SECOND) for name in OPTIONS}
    runs: dict[str, list[tuple[list[int], list[int]]]] = {name: [] for name in OPTIONS}
    for _ in range(effort.of(9, 1)):
        for name, each in sessions.items():
            runs[name].append(timed(each))
    beside = (span(FRAME, CAN_FRAME),)
    return [
        Row(GROUP, what.format(name), over(name, [run[at] for run in made]), beside)
        for name, made in runs.items()
        for at, what in enumerate(WHAT)
    ]


def over(name: str, runs: Sequence[Sequence[int]]) -> Figures:
    """Over the calls, each with the median of its runs. Raises NotMeasured if there is none."""
    if not runs[0]:
        raise NotMeasured(f"{name}: no motion was reported")
    return figures([figures(each).median for each in zip(*runs, strict=True)])


def session(name: str, end: Nanos) -> Session:
    """Let four twins turn for a while; all that happened. Raises NotMeasured if they are not armed then."""
    plugin = load(name)
    options, settings = plugin.options(**OPTIONS[name]), plugin.settings()
    devices = [Device(motor, at, options, settings) for at, motor in enumerate(MOTORS, 1)]
    driver, twins = plugin.driver(devices), [plugin.twin(device, at) for at, device in enumerate(devices)]
    calls: list[Call] = []
    events: list[Event] = []
    for now in range(SECOND, SECOND + end, MILLISECOND):
        if now % PERIOD == 0:
            commands = [command(plugin, each) for each in devices] if now >= SECOND + SETTLED else []
            calls.append((now, commands))
            found, frames = driver.send(now, commands)
            events += found
            for frame in frames:
                for twin in twins:
                    twin.receive(now, frame)
        for device, twin in zip(devices, twins, strict=True):
            for frame in twin.step(now, [Feedback(device.name, now, SPEED * seconds(now), SPEED)])[1]:
                calls.append((now, frame))
                events += driver.receive(now, frame)
    last = {event.motor: event.mode for event in events if isinstance(event, State)}
    if set(last.values()) != {Mode.ARMED} or any(isinstance(event, Fault) for event in events):
        raise NotMeasured(f"{name}: {last}, {[event for event in events if isinstance(event, Fault)]}")
    return Session(plugin, devices, calls)


def command(plugin: Plugin, device: Device) -> Command:
    """A velocity, or where a motor takes none, a torque."""
    takes = plugin.spec(device).commands
    return msg.Velocity(device.name, SPEED) if msg.Velocity in takes else msg.Torque(device.name, 0.05)


def timed(given: Session) -> tuple[list[int], list[int]]:
    """How long each call that counts takes a fresh driver: of `receive`, and of `send` per motor."""
    driver: Driver = given.plugin.driver(given.devices)
    received: list[int] = []
    sent: list[int] = []
    with quiet_collector():
        for now, what in given.calls:
            began = stopwatch()
            if isinstance(what, Sequence) and not isinstance(what, bytes):
                driver.send(now, what)
                took = stopwatch() - began
                sent += [took // len(MOTORS)] if now >= SECOND + WARM else []
            else:
                events = driver.receive(now, what)
                took = stopwatch() - began
                motion = events and all(isinstance(event, Feedback) for event in events)
                received += [took] if motion and now >= SECOND + WARM else []
    return received, sent
