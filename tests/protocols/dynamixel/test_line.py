"""Twelve servos on one line, in virtual time: its rate, lost answers, and one that is unplugged."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import pytest

from gateway import config
from gateway.buses.virtual import open_world
from gateway.buses.virtual.bus import HOST, TwinWorld
from gateway.buses.virtual.halfduplex import HalfDuplex
from gateway.buses.virtual.medium import Transmission
from gateway.config import resources
from gateway.core.clock import SimulatedClock
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.runtime.loop import Reader, moments, write
from gateway.runtime.schedule import commands as commands_of
from gateway.runtime.timing import LoopStats
from protocols.messages import MILLISECOND, SECOND, Feedback, Mode, Nanos


@dataclass
class Run:
    """What happened on the line since all were armed."""

    gateway: Gateway
    world: TwinWorld
    seconds: float = 0.0
    readings: dict[str, int] = field(default_factory=dict)
    oldest: dict[str, Nanos] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    fastest: float = 0.0

    @property
    def overlaps(self) -> int:
        wire = self.world.buses["line0"].from_devices
        assert isinstance(wire, HalfDuplex)
        return len(wire.collisions)


def twelve(baudrate: int = 1_000_000, *, fast: bool = False, on_fault: str = "stop") -> Robot:
    text = resources.find("robots", "twelve_dynamixel").read_text()
    text = text.replace("baudrate = 1_000_000", f"baudrate = {baudrate}").replace(
        "feedback_ms = 1 ", "feedback_ms = 0.5 "
    )
    text = text.replace('on_fault = "stop"', f'on_fault = "{on_fault}"')
    return config.parse_robot(
        text.replace('mode = "position"', f'mode = "position"\nfast = {str(fast).lower()}')
    )


def run(
    robot: Robot,
    rate: float,
    seconds: float,
    armed: Callable[[Run], None] = lambda _: None,
) -> Run:
    """Arm all at rest, and go on for a time."""
    robot = replace(robot, period=round(SECOND / rate))
    gateway, world = Gateway(robot), open_world(robot, robot.seed)
    clock, commands = SimulatedClock(), commands_of(robot)
    reader, done, began = Reader(gateway, world.buses, clock), Run(gateway, world), 0
    last: dict[str, Nanos] = {}
    for now in moments(clock, robot.period, gateway.due, LoopStats(), reader.wait, reader.least):
        between = gateway.between(now)
        outputs = gateway.step(now, reader.inputs(now, () if between else commands))
        write(world.buses, now, outputs.packets)
        if not began and now > SECOND and all(joint.armed for joint in gateway.joints.values()):
            began = now
            armed(done)
        done.notes += [f"{note.source}: {note.text}" for note in outputs.notes if began]
        for event in outputs.events:
            if isinstance(event, Feedback):
                done.fastest = max(done.fastest, abs(event.velocity or 0.0))
                if began:
                    done.readings[event.motor] = done.readings.get(event.motor, 0) + 1
                last[event.motor] = event.t
        for motor, at in last.items() if began and not between else ():
            done.oldest[motor] = max(done.oldest.get(motor, 0), now - at)
        if began and now >= began + seconds * SECOND:
            done.seconds = (now - began) / SECOND
            return done
        assert now < 8 * SECOND, "not armed"
    raise AssertionError


@pytest.mark.prove
@pytest.mark.parametrize(
    ("baudrate", "fast", "limit"),
    [
        (1_000_000, False, 284.1),
        (3_000_000, False, 852.3),
        (1_000_000, True, 362.3),
        (3_000_000, True, 1087.0),
    ],
)
def test_all_of_them_are_read_and_written_at_the_rate_of_the_wire(
    baudrate: int, fast: bool, limit: float
) -> None:
    done = run(twelve(baudrate, fast=fast), 2000.0 if baudrate > 2e6 else 1000.0, 0.5)
    assert min(done.readings.values()) / done.seconds >= 0.97 * limit
    assert done.overlaps == 0


def losing(share: float) -> Callable[[Run], None]:
    """Destroy a share of the answers, wherever one of their bytes stands."""
    chance = random.Random(5)

    def transmission(bus: str, one: Transmission) -> Iterable[Transmission]:
        if one.sender == HOST or chance.random() >= share or not isinstance(one.frame, bytes):
            return (one,)
        at, bit = chance.randrange(len(one.frame)), 1 << chance.randrange(8)
        damaged = bytearray(one.frame)
        damaged[at] ^= bit
        return (replace(one, frame=bytes(damaged)),)

    def armed(done: Run) -> None:
        done.world.tamper.transmission = transmission

    return armed


@pytest.mark.sample(1)
@pytest.mark.parametrize("fast", [False, True])
def test_a_lost_answer_costs_a_reading(fast: bool) -> None:
    done = run(twelve(fast=fast), 200.0, 1.0, losing(0.01))
    assert not [note for note in done.notes if "fault" in note or "offline" in note], done.notes
    assert all(joint.armed and not joint.faults for joint in done.gateway.joints.values())
    assert done.fastest < 0.05
    assert min(done.readings.values()) > 170 * done.seconds
    assert max(done.oldest.values()) < 40_000_000
    assert done.gateway.lines["line0"].sent > 0


@pytest.mark.sample(1)
@pytest.mark.parametrize(("latency_ms", "least"), [(0, 197), (2, 188)])
def test_one_that_is_unplugged_stops_alone(latency_ms: int, least: int) -> None:
    """Each of the 40 or so questions that it does not answer also costs the latency of the port: that is
    waited for before an answer is given up."""

    def unplug(done: Run) -> None:
        done.world.disconnect("fr_thigh")

    robot = twelve(on_fault="continue")
    latency = latency_ms * MILLISECOND
    robot = replace(robot, buses={name: replace(bus, latency=latency) for name, bus in robot.buses.items()})
    done = run(robot, 200.0, 1.0, unplug)
    joints = done.gateway.joints
    assert [name for name, joint in joints.items() if joint.faults or joint.mode is not Mode.ARMED] == [
        "fr_thigh"
    ]
    assert done.overlaps == 0
    others = [count for name, count in done.readings.items() if name != "fr_thigh"]
    assert min(others) > least * done.seconds
