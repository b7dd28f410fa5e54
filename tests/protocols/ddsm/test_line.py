"""Four DDSM115 on one RS-485 line in virtual time: nobody sends while another does, and one lost answer costs
one reading."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.buses.virtual import TwinWorld, open_world
from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.halfduplex import HalfDuplex
from gateway.buses.virtual.medium import Transmission
from gateway.config import parse_robot
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols.messages import MILLISECOND, SECOND, Feedback, Nanos, Velocity

NAMES = ("m1", "m2", "m3", "m4")


def four() -> Robot:
    motors = "".join(f"[motors.{name}]\naddress = {at}\n" for at, name in enumerate(NAMES, 1))
    return parse_robot(
        f"""\
name = "four"
rate_hz = 100
world = "bench"
[buses.wheels]
kind = "serial"
baudrate = 115_200
interface = "twin"
[defaults.motors]
protocol = "ddsm"
bus = "wheels"
gear = 1.0
sign = 1
on_command_timeout = "idle"
stop_action = "idle"
on_fault = "continue"
command_timeout_ms = 100
feedback_timeout_ms = 300
[defaults.motors.limits]
velocity = 5.0
acceleration = 20.0
torque = 2.0
[defaults.motors.options]
model = "DDSM115"
watchdog = "acknowledged"
{motors}
[brain]
body = "joints"
[brain.joints]
motors = {list(NAMES)}
""".replace("'", '"')
    )


class Driven:
    """The four, which turn at 3 rad/s."""

    def __init__(self) -> None:
        self.robot = four()
        self.gateway, self.clock = Gateway(self.robot), SimulatedClock()
        self.world: TwinWorld = open_world(self.robot, 1)

    @property
    def wire(self) -> HalfDuplex:
        """The line."""
        (bus,) = self.world.buses.values()
        assert isinstance(bus.from_devices, HalfDuplex)
        return bus.from_devices

    def run(self, seconds: float) -> dict[str, Nanos]:
        """Run for a time; return the longest age of what each motor reported."""
        ages, last = dict.fromkeys(NAMES, 0), dict.fromkeys(NAMES, self.clock.now())
        until = self.clock.now() + round(seconds * SECOND)
        for now in moments(self.clock, self.robot.period, self.gateway.due, LoopStats()):
            if now >= until:
                break
            states, packets = read(self.world.buses, now)
            given = tuple(Velocity(name, 3.0) for name in NAMES)
            outputs = self.gateway.step(now, Inputs(tuple(states), tuple(packets), given))
            write(self.world.buses, now, outputs.packets)
            for event in outputs.events:
                if isinstance(event, Feedback):
                    last[event.motor] = event.t
            for name in NAMES:
                ages[name] = max(ages[name], now - last[name])
        return ages

    def must_turn(self) -> None:
        """All are armed, without a fault, at their speed."""
        for name in NAMES:
            assert self.gateway.joints[name].armed
            assert not self.gateway.joints[name].faults
            assert self.world.world.shaft(name)[1] == pytest.approx(3.0, abs=0.11)  # 1 rpm is 0.105 rad/s


def every(number: int, keep: Callable[[str], bool]) -> Callable[[str, Transmission], list[Transmission]]:
    """Lose each so many-th of these transmissions."""
    count = 0

    def tamper(_bus: str, one: Transmission) -> list[Transmission]:
        nonlocal count
        if keep(one.sender):
            return [one]
        count += 1
        return [] if count % number == 0 else [one]

    return tamper


def test_nobody_sends_while_another_does() -> None:
    driven = Driven()
    driven.run(1.0)
    ages = driven.run(2.0)
    driven.must_turn()
    assert driven.wire.collisions == []
    # Each is asked in every second step of 10 ms; how old a report is, is looked at between steps, too.
    assert max(ages.values()) <= 30 * MILLISECOND


def test_lost_answers_and_lost_questions_cost_readings_alone() -> None:
    driven = Driven()
    driven.run(1.0)
    for keep in (lambda sender: sender == HOST, lambda sender: sender != HOST):
        driven.world.tamper.transmission = every(10, keep)
        ages = driven.run(1.5)
        driven.must_turn()
        assert driven.wire.collisions == []
        assert max(ages.values()) <= 60 * MILLISECOND


def test_one_that_is_unplugged_stops_alone() -> None:
    driven = Driven()
    driven.run(1.0)
    driven.world.disconnect("m2")
    ages = driven.run(1.5)
    assert driven.gateway.joints["m2"].faults
    for name in ("m1", "m3", "m4"):
        assert driven.gateway.joints[name].armed
        assert not driven.gateway.joints[name].faults
        assert ages[name] <= 60 * MILLISECOND
    assert driven.wire.collisions == []
