"""The world as a bus: order and time of packets, gear and sign, encoders, overload, faults, determinism."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest

from gateway.buses.virtual.bus import TwinWorld, open_world
from gateway.buses.virtual.medium import Transmission
from gateway.buses.virtual.tamper import Tamper, composed
from gateway.core.robot import Motor, Robot, Sensor
from gateway.sim import World, WorldError, WorldFile, load_plant, load_world, parse_world
from protocols import messages as msg
from protocols.conformance.bench import TwinWrapper
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, Command, Event, Imu, Mode, Nanos
from protocols.plugin import Device, Driver, Plugin, Twin
from tests.gateway.world_helpers import ROOM, WALLS, plant, robot, scene

PERIOD = 5 * MILLISECOND
BENCH = 'kind = "bench"\nname = "bench"\n'
Messages = Sequence[Command | msg.Scan]


@dataclass
class Rig:
    """The host's end: drivers on the buses of a world of twins, stepped every 5 ms."""

    twins: TwinWorld
    drivers: dict[str, Driver]
    now: Nanos = 0
    packets: list[Packet] = field(default_factory=list)
    states: list[tuple[str, BusState]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def run(
        self, steps: int, command: Callable[[Nanos], Messages] | None = None, period: Nanos = PERIOD
    ) -> Rig:
        """Run `steps` steps; send the motors what `command` returns at each."""
        for _ in range(steps):
            for name, bus in self.twins.buses.items():
                states, packets = bus.read(self.now)
                self.states += [(name, state) for state in states]
                for packet in packets:
                    self.packets.append(packet)
                    self.events += self.drivers[name].receive(packet.t, packet.frame)
            if command:
                _, frames = self.drivers["motors"].send(self.now, command(self.now))
                self.twins.buses["motors"].write(self.now, frames)
            self.now += period
        return self

    def last(self, motor: str) -> msg.Feedback:
        """The newest feedback of a motor."""
        return next(e for e in reversed(self.events) if isinstance(e, msg.Feedback) and e.motor == motor)

    def truth(self) -> float:
        """m, the true distance from the origin"""
        pose = self.twins.world.truth()
        return math.hypot(pose.x, pose.y)


def rig(file: WorldFile | None = None, made: Robot | None = None, seed: int = 1, now: Nanos = 0) -> Rig:
    made = made or robot(sensors=file is None or file.kind == "scene")
    twins = TwinWorld(
        made, World(file or scene(), load_plant(made.plant) if made.plant else plant(), made, seed), seed
    )
    devices: list[Motor | Sensor] = [*made.motors.values(), *made.sensors.values()]
    drivers = {}
    for bus in twins.buses:
        if on_bus := [device for device in devices if device.bus == bus]:
            drivers[bus] = on_bus[0].plugin.driver([device.device for device in on_bus])
    return Rig(twins, drivers, now)


def bench(text: str = "") -> WorldFile:
    return parse_world(BENCH + text)


def drive(left: float, right: float) -> Callable[[Nanos], Messages]:
    """At the devices' shafts: gear 8, and the right motor is mounted the other way round."""
    return lambda _: [msg.Velocity("left", 8.0 * left), msg.Velocity("right", -8.0 * right)]


# -- motion through gear, sign and bus ------------------------------------------------------------------


def test_equal_velocities_drive_straight() -> None:
    driven = rig().run(600, drive(6.0, 6.0))
    assert driven.twins.world.truth().x == pytest.approx(0.05 * 6.0 * 3.0, rel=0.05)
    assert abs(driven.twins.world.truth().y) < 0.01
    left, right = driven.last("left"), driven.last("right")
    assert left.velocity == pytest.approx(48.0, rel=0.02)
    assert right.velocity == pytest.approx(-48.0, rel=0.02)
    shaft = driven.twins.world.shaft("left")[0]
    assert left.position == pytest.approx(8.0 * shaft, abs=48.0 * 0.02)


def test_encoders_count() -> None:
    reported = [
        e.position for e in rig(bench()).run(300, drive(3.0, 3.0)).events if isinstance(e, msg.Feedback)
    ]
    count = 2.0 * math.pi / 16384
    counts = [position / count for position in reported if position is not None]
    assert len({round(value) for value in counts}) > 100
    assert max(abs(value - round(value)) for value in counts) < 1e-6


# -- overload -------------------------------------------------------------------------------------------


def test_overload_on_a_bench_stalls_at_the_torque_limit() -> None:
    # A load of 1.8 N·m: more than 0.2 N·m × gear 8.
    heavy = rig(bench("[shafts.left]\nload = -1.8\nstops = [-0.5, 50.0]\n"))
    heavy.run(600, drive(5.0, 5.0))
    left, right = heavy.last("left"), heavy.last("right")
    assert left.torque == pytest.approx(0.2)
    assert left.current == pytest.approx(2.0)
    assert left.velocity == 0.0
    assert heavy.twins.world.contacts() == 1
    assert right.velocity == pytest.approx(-40.0, rel=0.02)
    lighter = rig(bench("[shafts.left]\nload = -1.2\n")).run(600, drive(5.0, 5.0)).last("left")
    assert lighter.velocity == pytest.approx(40.0, rel=0.02)
    assert lighter.torque == pytest.approx((1.2 + 0.02 + 0.002 * 5.0) / 8.0, rel=0.03)


# -- order and time -------------------------------------------------------------------------------------


def test_packets_come_in_order_and_never_from_the_future() -> None:
    driven = rig(now=77_000_000_123)
    for _ in range(200):
        before = len(driven.packets)
        driven.run(1, drive(4.0, 5.0))
        assert all(packet.t <= driven.now - PERIOD for packet in driven.packets[before:])
    for name in ("motors", "sensors"):
        stamps = [packet.t for packet in driven.packets if packet.bus == name]
        assert len(stamps) > 100
        assert stamps == sorted(stamps)
        assert len(set(stamps)) == len(stamps), "one frame at a time"
    assert min(packet.t for packet in driven.packets) > 77_000_000_123


def test_measurements_bring_the_time_at_which_they_were_taken() -> None:
    received = rig().run(220)
    scans = [event for event in received.events if isinstance(event, msg.LaserScan)]
    assert len(scans) == 10  # one that began at 1 s is not complete
    frames = [len(p.frame) for p in received.packets if p.bus == "sensors" and isinstance(p.frame, bytes)]
    late = max(frames) * 10 * 1_000_000_000 / 3_000_000
    for index, scan in enumerate(scans):
        assert 0 <= scan.t - index * 100 * MILLISECOND <= late + MILLISECOND


def test_packets_do_not_depend_on_how_often_the_bus_is_read() -> None:
    often = rig(scene(ROOM + WALLS)).run(900, period=MILLISECOND).packets
    seldom = rig(scene(ROOM + WALLS)).run(900 // 7 + 1, period=7 * MILLISECOND).packets
    shared = min(len(often), len(seldom))
    assert shared > 300
    for name in ("motors", "sensors"):
        one = [packet for packet in often if packet.bus == name and packet.t < 890 * MILLISECOND]
        other = [packet for packet in seldom if packet.bus == name and packet.t < 890 * MILLISECOND]
        assert one == other


def test_either_bus_brings_the_world_to_now() -> None:
    twins = rig().twins
    twins.buses["motors"].read(0)
    _, first = twins.buses["sensors"].read(20 * MILLISECOND)
    assert twins.world.now == 20 * MILLISECOND
    assert first
    assert twins.buses["sensors"].read(20 * MILLISECOND) == ([], [])
    assert twins.buses["motors"].read(20 * MILLISECOND)[1]


def test_same_seed_same_bytes() -> None:
    office = load_world("office")
    one, other, third = (
        rig(office, robot("office"), seed).run(300, drive(6.0, 7.0)).packets for seed in (5, 5, 6)
    )
    assert len(one) > 500
    assert one == other
    assert third != one


def test_a_copy_goes_on_alike() -> None:
    first = rig(load_world("office"), robot("office")).run(100, drive(6.0, 7.0))
    second = copy.deepcopy(first)
    first.run(100, drive(6.0, 7.0))
    second.run(100, drive(6.0, 7.0))
    assert second.packets == first.packets


# -- no ground truth among the inputs -------------------------------------------------------------------


@dataclass(slots=True)
class Spy(TwinWrapper):
    """A twin that records what it was shown and what it sent."""

    name: str
    shown: list[tuple[str, Event]]
    sent: list[Frame]

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        self.shown += [(self.name, event) for event in truth]
        torques, frames = self.twin.step(now, truth)
        self.sent += frames
        return torques, frames


def test_nothing_but_shafts_and_readings_reaches_a_packet() -> None:
    shown: list[tuple[str, Event]] = []
    sent: list[Frame] = []

    def spied(plugin: Plugin) -> Plugin:
        def twin(device: Device, seed: int) -> Twin:
            return Spy(plugin.twin(device, seed), device.name, shown, sent)

        return replace(plugin, twin=twin)

    plain = robot("office")
    made = replace(
        plain,
        motors={name: replace(motor, plugin=spied(motor.plugin)) for name, motor in plain.motors.items()},
        sensors={
            name: replace(sensor, plugin=spied(sensor.plugin)) for name, sensor in plain.sensors.items()
        },
    )
    driven = rig(load_world("office"), made).run(300, drive(6.0, 7.0))
    kinds = {"left": msg.Feedback, "right": msg.Feedback, "lidar": msg.LaserScan, "imu": msg.Imu}
    assert {(name, type(event)) for name, event in shown} == set(kinds.items())
    for name, event in shown:
        assert isinstance(event, msg.Feedback | msg.Imu | msg.LaserScan)
        assert (event.motor if isinstance(event, msg.Feedback) else event.sensor) == name
        if isinstance(event, msg.Feedback):
            assert (event.torque, event.current, event.voltage) == (None, None, None)
        if isinstance(event, msg.Imu):
            assert event.orientation is None
    sent_by_twins = {id(frame) for frame in sent}
    assert len(driven.packets) > 500
    assert all(id(packet.frame) in sent_by_twins for packet in driven.packets), (
        "every packet is what a twin sent"
    )


# -- faults ---------------------------------------------------------------------------------------------


def events_since(driven: Rig, start: Nanos, motor: str) -> list[Event]:
    return [
        e
        for e in driven.events
        if isinstance(e, msg.Feedback | msg.State | msg.Fault) and e.motor == motor and e.t >= start
    ]


def test_a_disconnected_motor_neither_sends_nor_receives() -> None:
    driven = rig(bench()).run(200, drive(4.0, 4.0))
    driven.twins.disconnect("left")
    start = driven.now
    driven.run(200, drive(8.0, 8.0))
    assert events_since(driven, start, "left") == []
    assert events_since(driven, start, "right")
    # Its own watchdog (100 ms) has disarmed it, so it runs out; the other one has followed.
    assert abs(driven.twins.world.shaft("left")[1]) < 1.0
    assert driven.twins.world.shaft("right")[1] == pytest.approx(8.0, rel=0.05)
    driven.twins.reconnect("left")
    back = driven.now
    driven.run(50)
    states = [e.mode for e in events_since(driven, back, "left") if isinstance(e, msg.State)]
    assert Mode.FAULT in states


def test_a_reset_motor_has_forgotten_its_command_and_keeps_its_shaft() -> None:
    driven = rig(bench()).run(200, drive(4.0, 4.0))
    driven.run(2)
    assert driven.last("left").torque != 0.0
    where = driven.twins.world.shaft("left")[0]
    driven.twins.reset("left")
    driven.run(20)
    states = [event for event in driven.events if isinstance(event, msg.State) and event.motor == "left"]
    assert [event.mode for event in states][-1] is Mode.READY
    assert driven.twins.world.shaft("left")[0] >= where
    assert driven.last("left").torque == 0.0


def test_a_second_device_with_the_same_address_answers_too() -> None:
    driven = rig(bench()).run(200, drive(4.0, 4.0))
    alone = sum(isinstance(e, msg.Feedback) and e.motor == "left" for e in driven.events)
    driven.twins.duplicate("left")
    start = driven.now
    driven.run(200, drive(4.0, 4.0))
    both = events_since(driven, start, "left")
    reported = [e for e in both if isinstance(e, msg.Feedback) and e.position is not None]
    assert len(reported) > 1.8 * alone
    jumps = [abs((b.position or 0.0) - (a.position or 0.0)) for a, b in pairwise(reported)]
    assert max(jumps) > 10.0, "the double turns a shaft of its own"


def test_a_lost_interface_reports_gone_and_back() -> None:
    driven = rig(bench()).run(200, drive(4.0, 4.0))
    driven.twins.buses["motors"].lose()
    start = driven.now
    driven.run(100, drive(4.0, 4.0))
    assert driven.states == [("motors", BusState.GONE)]
    assert not [packet for packet in driven.packets if packet.t >= start]
    assert abs(driven.twins.world.shaft("right")[1]) < 3.0, "its watchdog has disarmed it"
    driven.twins.buses["motors"].restore()
    driven.run(100)
    assert driven.states == [("motors", BusState.GONE), ("motors", BusState.BACK)]
    assert driven.last("right").t > start + 100 * PERIOD


def test_a_falsified_transmission_arrives_at_its_own_time_or_never() -> None:
    driven = rig(bench())
    delay = 12 * MILLISECOND
    driven.twins.tamper.transmission = lambda _bus, one: (
        (replace(one, t=one.t + delay),) if one.sender else ()
    )
    driven.run(200, drive(4.0, 4.0))
    assert driven.twins.world.shaft("left")[1] == 0.0, "no command has arrived"
    first = driven.packets[0]
    assert first.t > rig(bench()).run(200).packets[0].t + delay - MILLISECOND, "stamped when it has arrived"


def test_measurements_and_torques_are_falsified_on_their_own_side_of_the_twin() -> None:
    driven = rig(bench())
    driven.twins.tamper.measured = lambda motor, true: (
        replace(true, position=7.0) if motor == "left" else true
    )
    driven.twins.tamper.torques = lambda torques: torques | {"right": 0.0}
    driven.run(100, drive(4.0, 4.0))
    assert driven.last("left").position == 7.0 != driven.twins.world.shaft("left")[0] * 8.0
    assert driven.twins.world.shaft("right") == (0.0, 0.0)
    assert driven.last("right").torque != 0.0, "the device gives a torque that its shaft does not get"


def test_a_full_queue_reports_full_once_and_then_up() -> None:
    bus = (driven := rig(bench())).twins.buses["motors"]
    bus.read(0)
    flood = [bytes([index % 256]) * 100 for index in range(300)]
    bus.write(0, flood)
    driven.run(100)
    assert driven.states == [("motors", BusState.FULL)]
    driven.run(1)
    assert driven.states == [("motors", BusState.FULL), ("motors", BusState.UP)]


def test_a_closed_bus_sends_nothing() -> None:
    driven = rig(bench()).run(100, drive(4.0, 4.0))
    _, frames = driven.drivers["motors"].send(driven.now, [msg.Velocity("left", 50.0)])
    driven.twins.buses["motors"].close()
    driven.twins.buses["motors"].write(driven.now, frames)
    driven.run(100)
    assert abs(driven.twins.world.shaft("left")[1]) < 3.0


def test_the_last_command_arrives_when_time_goes_on() -> None:
    driven = rig(bench()).run(200, drive(4.0, 4.0))
    driven.run(1, lambda _: [msg.Idle("left"), msg.Idle("right")])
    driven.run(10)
    assert driven.last("left").torque == 0.0


def test_no_such_twin() -> None:
    with pytest.raises(KeyError, match="no twin 'middle'"):
        rig(bench()).twins.disconnect("middle")


# -- opening --------------------------------------------------------------------------------------------


def test_open_world_takes_the_world_of_the_robot_file() -> None:
    office = open_world(robot("office"), 3)
    assert office.world.file == load_world("office")
    shafts = open_world(robot(sensors=False), 3)
    assert shafts.world.file.kind == "bench"
    assert set(shafts.buses) == {"motors", "sensors"}


def test_sensors_without_a_world_are_a_mistake_of_the_file() -> None:
    with pytest.raises(WorldError, match="no sensor 'lidar'"):
        open_world(robot(), 1)
    with pytest.raises(WorldError, match="'ofice' is neither"):
        open_world(replace(robot(), world="ofice"), 1)


def test_a_bus_that_is_not_a_twin_is_left_alone() -> None:
    made = robot("office")
    buses = dict(made.buses)
    buses["sensors"] = replace(buses["sensors"], interface="serial:/dev/ttyUSB0")
    twins = open_world(replace(made, buses=buses), 1)
    assert list(twins.buses) == ["motors"]
    twins.buses["motors"].read(0)
    twins.buses["motors"].read(50 * MILLISECOND)
    assert twins.world.now == 50 * MILLISECOND


def test_several_falsifications_are_done_one_after_the_other() -> None:
    def lose(sender: str) -> Tamper:
        return Tamper(transmission=lambda _bus, one: () if one.sender == sender else (one, one))

    doubled = Tamper(torques=lambda given: {name: 2.0 * one for name, one in given.items()})
    added = Tamper(torques=lambda given: {name: one + 1.0 for name, one in given.items()})
    blind = Tamper(reading=lambda _true: None)
    made = composed([doubled, Tamper(), added, blind, lose("left"), lose("right")])
    assert made.torques is not None
    assert made.transmission is not None
    assert made.reading is not None
    assert made.torques({"left": 3.0}) == {"left": 7.0}
    frames = [Transmission(0, name, CanFrame(1)) for name in ("left", "right", "other")]
    assert [len([*made.transmission("can0", one)]) for one in frames] == [0, 0, 4]
    assert made.reading(Imu("imu", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8))) is None
    assert composed([]) == Tamper()
