"""Twins on a CAN bus: the committed robots, their current limit, frames in time, resets and doubles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import as_file, files
from itertools import pairwise

import pytest

from gateway.buses.frame_time import frame_time
from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.config import load_robot
from gateway.core.robot import Robot
from gateway.sim import World, WorldFile, parse_world
from protocols.frames import CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND, Event, Fault, Feedback, Mode, Nanos, State, Velocity

PERIOD = 5 * MILLISECOND


def committed(name: str) -> Robot:
    with as_file(files("gateway.fixtures") / "robots" / f"{name}.toml") as path:
        return load_robot(path)


class Host:
    """The driver of a robot's CAN motors, on the bus of its twins."""

    def __init__(self, robot: Robot, file: WorldFile | None = None) -> None:
        self.robot = robot
        self.twins = TwinWorld(robot, World(file, robot, 1), 1) if file else open_world(robot, 1)
        motors = list(robot.motors.values())
        self.bus = self.twins.buses["can0"]
        self.driver = motors[0].plugin.driver([motor.device for motor in motors])
        self.packets: list[Packet] = []
        self.events: list[Event] = []
        self.now: Nanos = 0

    def run(self, steps: int, command: Callable[[], Sequence[Velocity]] = tuple) -> Host:
        for _ in range(steps):
            _, packets = self.bus.read(self.now)
            for packet in packets:
                self.events += self.driver.receive(packet.t, packet.frame)
            self.packets += packets
            events, frames = self.driver.send(self.now, command())
            self.events += events
            self.bus.write(self.now, frames)
            self.now += PERIOD
        return self

    def modes(self, motor: str, since: Nanos = 0) -> list[Mode]:
        return [e.mode for e in self.events if isinstance(e, State) and e.motor == motor and e.t >= since]


def drive(left: float, right: float) -> Callable[[], Sequence[Velocity]]:
    """At the joints; gear 8, and the right motor is mounted the other way round."""
    return lambda: [Velocity("left", 8.0 * left), Velocity("right", -8.0 * right)]


def test_the_committed_robot_drives_through_its_office() -> None:
    host = Host(committed("diffbot")).run(80).run(500, drive(5.0, 5.0))
    pose = host.twins.world.truth()
    assert pose.x == pytest.approx(0.05 * 5.0 * 2.4, rel=0.15)
    assert abs(pose.y) < 0.05
    assert host.modes("left")[-1] is Mode.ARMED
    assert host.twins.world.contacts() == 0
    reported = [
        e for e in host.events if isinstance(e, Feedback) and e.motor == "right" and e.velocity is not None
    ]
    assert reported[-1].velocity == pytest.approx(-40.0, rel=0.05)


def test_overload_stalls_at_the_current_limit() -> None:
    # A load of 10 N·m: more than 30 A × 0.0306 N·m/A × gear 8 = 7.35 N·m.
    bench = parse_world('kind = "bench"\n[shafts.left]\nload = -10.0\nstops = [-0.5, 50.0]\n')
    robot = committed("bench")
    settings = robot.motors["left"].device.settings
    host = Host(robot, bench).run(80).run(500, drive(5.0, 5.0))
    currents = [e.current for e in host.events if isinstance(e, Feedback) and e.motor == "left" and e.current]
    assert currents[-1] == pytest.approx(settings.current_soft_max, rel=1e-3)
    assert host.twins.world.shaft("left") == (-0.5, 0.0)
    assert host.twins.world.shaft("right")[1] == pytest.approx(5.0, rel=0.01)


def test_frames_take_their_time_and_are_the_motors_own() -> None:
    host = Host(committed("diffbot")).run(80).run(200, drive(3.0, 4.0))
    expected = set().union(*(motor.spec.expects for motor in host.robot.motors.values()))
    assert len(host.packets) > 250
    for before, packet in pairwise(host.packets):
        assert packet.t - before.t >= frame_time(packet.frame, 1_000_000)
    for packet in host.packets:
        assert isinstance(packet.frame, CanFrame)
        assert packet.frame.id in expected


def test_a_reset_motor_is_not_armed_any_more() -> None:
    host = Host(committed("bench")).run(80).run(300, drive(4.0, 4.0))
    assert host.modes("left")[-1] is Mode.ARMED
    host.run(2)
    host.twins.reset("left")
    start = host.now
    host.run(200)
    assert Mode.ARMED not in host.modes("left", start)
    assert host.modes("left", start)
    assert abs(host.twins.world.shaft("left")[1]) < 1.0
    assert not [e for e in host.events if isinstance(e, Fault) and e.motor == "right"]


def test_a_duplicate_answers_beside_the_first() -> None:
    host = Host(committed("bench")).run(200)
    start = host.now
    alone = [packet for packet in host.packets if packet.t > start - SECOND]
    host.twins.duplicate("left")
    host.run(300)
    both = [packet for packet in host.packets if packet.t > host.now - SECOND]
    assert len(both) > 1.4 * len(alone)


def test_a_silent_motor_goes_offline() -> None:
    host = Host(committed("bench")).run(80).run(100, drive(2.0, 2.0))
    host.twins.disconnect("left")
    start = host.now
    host.run(200, drive(2.0, 2.0))
    assert host.modes("left", start) == [Mode.OFFLINE]
    assert Mode.OFFLINE not in host.modes("right", start)
