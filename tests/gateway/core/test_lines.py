"""Safety on lines whose devices speak only when asked: every way out disarms, in a time that is stated.

Rules. Whole gateways on twins, in virtual time. The judges are the wire, as far as it arrives at the devices,
and another host, which only reads, afterwards.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import Any

import pytest

from brain.bodies import bare
from gateway import config
from gateway.buses.virtual.bus import HOST, TwinBus
from gateway.buses.virtual.medium import Transmission
from gateway.core.faults import DRIVER_FAILED
from gateway.core.guard import STOPS_AGAIN, STOPS_WITHIN, decoder_of, text_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.monitor.lines import LineTroubles
from gateway.runtime.loop import FINE, Reader, moments, write
from gateway.runtime.timing import LoopStats
from protocols import messages as msg
from protocols.conformance.case import addresses_of
from protocols.ddsm import table as ds
from protocols.feetech import table as ft
from protocols.line import PATIENCE, Exchange, Line, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Velocity
from protocols.plugin import CommandDecoder, Device, Plugin
from protocols.toolkit.serial import CRC8_MAXIM
from protocols.toolkit.servo_packets import WRITE
from tests.gateway.rig import Rig, notes_in
from tests.protocols.line_sessions import QUESTIONED
from tests.sampled import sampled

MS = MILLISECOND
MANY = """
name = "many"
rate_hz = 200
world = "bench"
[buses.wheels]
kind = "serial"
baudrate = 115_200
interface = "twin"
[defaults.motors]
protocol = "ddsm"
bus = "wheels"
gear = 1.0
feedback_timeout_ms = 300
limits = { velocity = 20.0, acceleration = 10.0, torque = 2.0 }
"""
HUB = 'options = { model = "DDSM115", watchdog = "acknowledged" }\n'
EIGHT = [f"m{number}" for number in range(1, 9)]
THREE = EIGHT[:3]


def many(motors: Sequence[str] = EIGHT, **joint: Any) -> Robot:
    """Eight hub motors on one line: each is asked alone, and an exchange takes about 2 ms: at one in each
    period, the last is disarmed after 40 ms."""
    text = f"{MANY}{HUB}[motors]\n" + "".join(
        f"{name} = {{ address = {at} }}\n" for at, name in enumerate(motors, 1)
    )
    names = ", ".join(f'"{name}"' for name in motors)
    made = config.parse_robot(f'{text}[brain]\nbody = "joints"\n[brain.joints]\nmotors = [{names}]\n')
    return with_joints(made, **joint)


def of_file(name: str, **joint: Any) -> Robot:
    """The motors of a robot that is shipped, on a bench."""
    robot = with_joints(config.load_robot(name), **joint)
    used = {motor.bus for motor in robot.motors.values()}
    return replace(
        robot,
        world="bench",
        plant=None,
        sensors={},
        buses={bus: each for bus, each in robot.buses.items() if bus in used},
        brain=replace(robot.brain, body=bare(list(robot.motors))),
    )


def with_joints(robot: Robot, **joint: Any) -> Robot:
    motors = {name: replace(each, joint=replace(each.joint, **joint)) for name, each in robot.motors.items()}
    return replace(robot, motors=motors)


@dataclass
class Wire:
    """What arrives at the devices of the one line of a rig."""

    rig: Rig
    share: float = 0.0
    """Of what is sent, either way, that is lost;"""
    next_lost: bool = False
    """and what comes next, too."""
    lost_once: set[str] = field(default_factory=set)
    """Frames to the devices of which the next is lost."""
    obeyed: list[tuple[Nanos, Command]] = field(default_factory=list)
    """What the devices obey, with the time of its last byte."""
    chance: random.Random = field(default_factory=lambda: random.Random(5))
    decoder: CommandDecoder = field(init=False)

    def __post_init__(self) -> None:
        self.decoder = decoder_of(self.rig.robot, self.bus.name)
        self.rig.world.tamper.transmission = self._arrives

    @property
    def bus(self) -> TwinBus:
        (bus,) = self.rig.world.buses.values()
        return bus

    @property
    def line(self) -> Line:
        return self.rig.gateway.lines[self.bus.name]

    def _arrives(self, _bus: str, one: Transmission) -> Iterable[Transmission]:
        if self.next_lost or (self.share and self.chance.random() < self.share):
            self.next_lost = False
            return ()
        if one.sender == HOST and text_of(one.frame) in self.lost_once:
            self.lost_once.remove(text_of(one.frame))
            return ()
        if one.sender == HOST:
            obeyed = self.decoder.decode(one.t, one.frame)
            self.obeyed += [(one.t, each) for each in obeyed if isinstance(each, Command)]
        return (one,)

    def disarmed(self, since: Nanos) -> Nanos:
        """Return how long after a time the last motor has been sent Idle, and nothing else from then on."""
        first: dict[str, Nanos | None] = dict.fromkeys(self.rig.robot.motors)
        for t, each in self.obeyed:
            if isinstance(each, msg.Idle):
                first[each.motor] = first[each.motor] or t
            elif each != Velocity(each.motor, 0.0):  # some are sent that with Idle
                first[each.motor] = None
        assert None not in first.values(), first
        return max(t for t in first.values() if t is not None) - since


def command_of(robot: Robot, name: str, share: float = 0.3) -> Command:
    """Return what turns a motor at a share of its limit, or holds it."""
    motor = robot.motors[name]
    able = Velocity in motor.joint.commands(motor.spec)
    return Velocity(name, share * motor.joint.limits.velocity) if able else msg.Hold(name)


def driven(robot: Robot, seconds: float = 0.4) -> tuple[Rig, Wire]:
    """Every motor armed, and commanded."""
    rig = Rig(robot)
    wire = Wire(rig)
    rig.run(0.2)
    rig.run(seconds, *(command_of(robot, name) for name in robot.motors))
    assert {name: (each.mode, each.faults) for name, each in rig.gateway.joints.items()} == dict.fromkeys(
        robot.motors, (Mode.ARMED, {})
    )
    return rig, wire


def modes(rig: Rig, seconds: float = 0.2) -> dict[str, Mode]:
    """What the devices report to another host, which only reads."""
    rig.world.tamper.transmission = None
    other, clock, buses = Gateway(rig.robot), rig.clock, rig.world.buses
    end = clock.now() + round(seconds * SECOND)
    reader = Reader(other, buses, clock)
    for now in moments(clock, rig.robot.period, other.due, LoopStats(), reader.wait, reader.least):
        write(buses, now, other.step(now, reader.inputs(now)).packets)
        if now >= end:
            break
    return {name: joint.mode for name, joint in other.joints.items()}


def fail(*_: object, **__: object) -> Any:
    raise ZeroDivisionError


def left(rig: Rig, way: str = "") -> Nanos:
    """Leave, since the step fails or not; return when it began."""
    if not way.startswith("the step fails"):
        began = rig.clock.now()
        rig.leave()
        return began
    failed: list[Nanos] = []

    def step(now: Nanos, inputs: object) -> Any:
        failed.append(now)
        raise ZeroDivisionError

    rig.gateway.step = step  # type: ignore[method-assign]  # the fault
    with pytest.raises(ZeroDivisionError):
        rig.run(0.1)
    return failed[0]


# -- leaving -----------------------------------------------------------------------------------------------

ROBOTS = ("twelve_dynamixel", "diffbot_roboclaw", "diffbot_feetech", "diffbot_ddsm", "diffbot_odrive_ascii")
WITHIN = {
    # ms from the reason to leave until the last motor has been sent Idle
    "": 10,
    "losses": 40,  # an answer that is lost is waited for 20 ms at most
    "the step fails": 40,  # and its inputs are lost with it
    "the step fails, losses": 60,
}


@pytest.mark.sample(3)
@pytest.mark.parametrize(("way", "name"), sampled(product(WITHIN, ROBOTS), 3))
def test_every_motor_on_a_line_is_disarmed_in_a_stated_time(way: str, name: str) -> None:
    rig, wire = driven(of_file(name, stop_action="idle"))
    wire.share, wire.next_lost = (0.1, True) if "losses" in way else (0.0, False)
    began = left(rig, way)
    assert wire.disarmed(began) <= WITHIN[way] * MS
    assert rig.gateway.still_armed() == []
    assert wire.bus.overlaps == 0
    assert set(modes(rig).values()) == {Mode.READY}


@pytest.mark.parametrize("way", ["", "the step fails"])
def test_many_motors_are_disarmed_in_the_time_of_the_line_and_not_one_in_each_period(way: str) -> None:
    rig, wire = driven(many(stop_action="idle"))
    began = left(rig, way)
    assert wire.disarmed(began) <= 30 * MS
    assert wire.bus.overlaps == 0
    assert set(modes(rig).values()) == {Mode.READY}


def test_many_motors_that_brake_lose_no_readings() -> None:
    rig, wire = driven(many(stop_action="brake"), 1.4)
    before = readings(rig.ticks, rig.clock.now() - 300 * MS, rig.clock.now())
    began = rig.clock.now()
    last = rig.leave()
    while_braking = readings(last, began, began + 300 * MS)
    assert min(while_braking.values()) >= 0.9 * min(before.values())
    assert wire.bus.overlaps == 0
    assert set(modes(rig).values()) == {Mode.READY}


@pytest.mark.parametrize("name", ["arm_feetech", "many"])
def test_one_that_is_unplugged_stops_alone_where_the_joints_are_bare(name: str) -> None:
    """In a chain of answers, and asked one by one. What disarms it and finds out whether it is back takes at
    most half of the line from the others, as the contract's clause `dead` has it."""
    given = {"on_fault": "continue"}
    rig, wire = driven(many(**given) if name == "many" else of_file(name, **given), 0.6)
    gone, *others = reversed(rig.robot.motors)
    before = readings(rig.ticks, rig.clock.now() - 300 * MS, rig.clock.now())
    rig.world.disconnect(gone)
    commands = [command_of(rig.robot, each) for each in rig.robot.motors]
    ticks = rig.run(0.4, *commands)
    began = rig.clock.now()
    ticks += rig.run(0.3, *commands)
    assert [each for each, joint in rig.gateway.joints.items() if joint.faults] == [gone]
    assert {rig.gateway.joints[each].mode for each in others} == {Mode.ARMED}
    assert rig.gateway.why_stopped() == ""
    after = readings(ticks, began, began + 300 * MS)
    assert gone not in after
    assert min(after[each] / before[each] for each in others) >= 0.5
    assert wire.bus.overlaps == 0


def readings(ticks: Sequence[Tick], begin: Nanos, end: Nanos) -> dict[str, int]:
    """Return how often each motor was read in a time."""
    count: dict[str, int] = {}
    for tick in ticks:
        for each in tick.outputs.events:
            if isinstance(each, msg.Feedback) and begin < each.t <= end:
                count[each.motor] = count.get(each.motor, 0) + 1
    return count


# -- what disarms ------------------------------------------------------------------------------------------


def driver_of(rig: Rig) -> Any:
    (one,) = rig.gateway._drivers
    return one.driver


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[Exchange]:
    """All that is given to lines."""
    every: list[Exchange] = []
    put = Line.put

    def watched(self: Line, owner: int, frames: Sequence[bytes]) -> None:
        every.extend(frame for frame in frames if isinstance(frame, Exchange))
        put(self, owner, frames)

    monkeypatch.setattr(Line, "put", watched)
    return every


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("name", "lost"),
    [*((name, False) for name in ROBOTS[1:]), ("diffbot_feetech", True), ("diffbot_roboclaw", True)],
)
def test_a_motor_whose_driver_does_not_stop_it_gets_its_own_stop_before_all_else(
    name: str, lost: bool, given: list[Exchange]
) -> None:
    rig, wire = driven(of_file(name, stop_action="idle"))
    driver = driver_of(rig)
    send = driver.send
    driver.send = lambda now, messages: send(now, [m for m in messages if not isinstance(m, msg.Idle)])
    given.clear()
    stops = {text_of(motor.spec.stop[0]) for motor in rig.robot.motors.values()}
    wire.lost_once = stops.copy() if lost else set()
    began = rig.clock.now()
    rig.run(0.4, msg.Stop())
    assert not wire.lost_once
    ranks = {text_of(each): each.rank for each in given if text_of(each) in stops}
    assert ranks == dict.fromkeys(stops, Rank.RELEASE)
    after = STOPS_WITHIN + lost * STOPS_AGAIN
    assert after <= wire.disarmed(began) <= after + 20 * MS
    assert wire.bus.overlaps == 0
    assert set(modes(rig).values()) == {Mode.READY}
    driver.send = send
    rig.leave()


def test_a_driver_that_raises_loses_its_set_points_and_what_disarms_is_given_at_once() -> None:
    rig, wire = driven(of_file("diffbot_ddsm", stop_action="idle"))
    wire.line.free = rig.clock.now() + 12 * MS  # as while bytes come that nobody asked for
    rig.run(0.0)
    assert ranks_of(wire.line, Rank.SET_POINT, Rank.RELEASE) == {Rank.SET_POINT}
    driver, send = driver_of(rig), driver_of(rig).send
    driver.send = fail
    rig.run(0.009)  # the step in which it fails, and the next, in which its motors are to be idle
    assert ranks_of(wire.line, Rank.SET_POINT, Rank.RELEASE) == {Rank.RELEASE}, "the motors' own stops"
    assert {code for joint in rig.gateway.joints.values() for code, _ in joint.faults} == {DRIVER_FAILED}
    wire.line.free = rig.clock.now() + 12 * MS
    driver.send = send  # once: what disarms is given, and waits
    rig.run(0.0)
    assert ranks_of(wire.line, Rank.SET_POINT, Rank.RELEASE) == {Rank.RELEASE}
    driver.send = fail
    began = rig.clock.now()
    rig.run(0.05)
    assert wire.disarmed(began) <= 20 * MS
    driver.send = send
    rig.leave()
    assert set(modes(rig).values()) == {Mode.READY}


def ranks_of(line: Line, *ranks: Rank) -> set[Rank]:
    return {one.exchange.rank for one in line.waiting} & set(ranks)


@pytest.mark.parametrize("unplugged", [False, True])
def test_a_stop_while_an_answer_is_under_way_is_what_is_sent_next(unplugged: bool) -> None:
    rig, wire = driven(of_file("diffbot_ddsm", stop_action="idle"))
    if unplugged:
        rig.world.disconnect("left")
    while wire.line.out is None or (unplugged and wire.line.out.exchange[0] != 1):
        rig.run(0.0)
    assert rig.gateway.asked() == [wire.bus.name]
    began, question = rig.clock.now(), wire.line.last_byte
    rig.run(0.05, msg.Stop())
    obeyed = [(t, each) for t, each in wire.obeyed if t > question]
    assert all(isinstance(each, msg.Idle) or each == Velocity(each.motor, 0.0) for _, each in obeyed)
    assert {each.motor for _, each in obeyed} == {"left", "right"}
    assert wire.disarmed(began) <= (PATIENCE if unplugged else 0) + 10 * MS
    assert wire.bus.overlaps == 0
    rig.leave()


class NeverFree:
    """A line that is busy whenever the brain has its step: all goes out between."""

    def __init__(self, line: Line, gateway: Gateway) -> None:
        self.line, self.gateway = line, gateway

    def take(self, now: Nanos) -> list[tuple[int, Exchange]]:
        return [] if now == self.gateway._turns.asked_at else self.line.take(now)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.line, name)


def test_a_set_point_that_goes_out_between_two_steps_counts_as_sent() -> None:
    robot = of_file("diffbot_ddsm", stop_action="idle")
    rig = Rig(robot)
    wire = Wire(rig)
    gateway, left = rig.gateway, rig.gateway.joints["left"]
    gateway.lines[wire.bus.name] = NeverFree(wire.line, gateway)  # type: ignore[assignment]
    rig.run(0.2)
    counted: list[tuple[bool, bool]] = []
    decoder = decoder_of(robot, wire.bus.name)
    turned = [False]

    def look(tick: Tick) -> None:
        full = tick.now == gateway._turns.asked_at
        for packet in tick.outputs.packets:
            assert not full
            obeyed = decoder.decode(packet.t, packet.frame)
            turned[0] |= any(isinstance(each, Velocity) and each.motor == "left" for each in obeyed)
        if full:
            counted.append((turned[0], left._arming.driven_since is not None))

    rig.run(0.4, Velocity("left", 3.0), at=look)
    assert (False, False) in counted, "it is armed at once"
    assert (True, True) in counted
    assert all(sent is since for sent, since in counted)
    assert rig.velocity("left") == pytest.approx(3.0, abs=0.11)
    assert not left.faults


def test_a_line_that_is_lost_and_back_starts_nothing_and_leaves_nothing_armed() -> None:
    rig, wire = driven(of_file("diffbot_ddsm", stop_action="idle"))
    wire.bus.lose()
    ticks = rig.run(0.3)
    assert any("has vanished" in note.text for note in notes_in(ticks, wire.bus.name))
    assert len(wire.line.waiting) < 20
    wire.bus.restore()
    wire.obeyed.clear()
    began = rig.clock.now()
    ticks = rig.run(0.3)
    assert any("is back" in note.text for note in notes_in(ticks, wire.bus.name))
    assert wire.disarmed(began) <= 40 * MS
    assert all(isinstance(each, msg.Idle) for _, each in wire.obeyed)
    rig.run(0.2, *(msg.ClearFault(name) for name in rig.robot.motors))
    rig.run(0.5, *(command_of(rig.robot, name) for name in rig.robot.motors))
    assert {(each.mode, *each.faults) for each in rig.gateway.joints.values()} == {(Mode.ARMED,)}
    wire.bus.lose()
    rig.run(0.02)
    wire.bus.restore()
    began = left(rig)  # before anything else is known
    assert wire.disarmed(began) <= 100 * MS
    assert wire.bus.overlaps == 0
    assert set(modes(rig).values()) == {Mode.READY}


CAN0 = """[buses.can0]
kind = "can"
bitrate = 1_000_000
interface = "twin"
"""
DRIVE = """protocol = "cia402"
bus = "can0"
address = 2
options = { feedback = "sdo" }
"""


def test_beside_a_line_a_drive_of_many_questions_has_its_steps_and_the_loop_does_not_spin() -> None:
    """Steps that only look at the line do not serve it: it was due all the time."""
    text = MANY.replace("[defaults", f"{CAN0}[defaults") + f"[motors.m1]\naddress = 1\n{HUB}"
    rig = Rig(f'{text}[motors.m2]\n{DRIVE}[brain]\nbody = "joints"\n[brain.joints]\nmotors = ["m1", "m2"]\n')
    rig.run(0.3)
    ticks = rig.run(0.5, *(command_of(rig.robot, name, 0.1) for name in ("m1", "m2")))
    assert all(joint.armed and not joint.faults for joint in rig.gateway.joints.values())
    assert sum(after.now - before.now <= FINE for before, after in pairwise(ticks)) < 0.4 * len(ticks)
    rig.leave()
    assert rig.gateway.still_armed() == []


@pytest.mark.parametrize("plugin", QUESTIONED, ids=lambda each: each.name)
def test_an_own_stop_that_is_answered_says_so(plugin: Plugin) -> None:
    """Else the line would not wait for the answer, and two would send at once."""
    device = Device("one", addresses_of(plugin)[0], plugin.options(), plugin.settings())
    for stop in plugin.spec(device).stop:
        twin = plugin.twin(device, 0)
        twin.step(0, (msg.Feedback("one", 0, 0.0, 0.0),))
        twin.receive(MS, stop)
        _, answers = twin.step(20 * MS, (msg.Feedback("one", 20 * MS, 0.0, 0.0),))
        assert bool(answers) == (isinstance(stop, Exchange) and stop.answer is not None), text_of(stop)


# -- two protocols on one line -----------------------------------------------------------------------------

TWO = """
name = "two"
rate_hz = 200
world = "bench"
[buses.servos]
kind = "serial"
baudrate = 1_000_000
interface = "twin"
[defaults.motors]
bus = "servos"
gear = 1.0
limits = { velocity = 3.0, acceleration = 20.0, torque = 1.0 }
[motors]
d1 = { address = 1, protocol = "dynamixel", options = { model = "XM430-W350", mode = "velocity" } }
d2 = { address = 2, protocol = "dynamixel", options = { model = "XM430-W350", mode = "velocity" } }
f3 = { address = 3, protocol = "feetech", options = { model = "sts3215", mode = "wheel" } }
f4 = { address = 4, protocol = "feetech", options = { model = "sts3215", mode = "wheel" } }
[brain]
body = "joints"
[brain.joints]
motors = ["d1", "d2", "f3", "f4"]
"""


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_two_protocols_share_a_line_and_both_get_their_readings(share: float) -> None:
    rig, wire = driven(config.parse_robot(TWO), 1.0)
    wire.share = share
    ticks = rig.run(1.0)
    readings = Counter(
        each.motor for tick in ticks for each in tick.outputs.events if isinstance(each, Feedback)
    )
    assert set(readings) == set(rig.robot.motors)
    assert min(readings.values()) >= (60 if share else 95)  # each 10 ms
    assert (wire.bus.overlaps, rig.gateway.in_fault()) == (0, "")
    for name in rig.robot.motors:
        assert rig.velocity(name) == pytest.approx(0.9, rel=0.1), name
    wire.share = 0.0
    began = left(rig)
    assert wire.disarmed(began) <= 10 * MS
    assert set(modes(rig).values()) == {Mode.READY}


# -- what is wrong on a line -------------------------------------------------------------------------------


def cut_short(rig: Rig, wire: Wire) -> None:
    """Every fifth answer of any device is half of one."""

    def arrives(_bus: str, one: Transmission) -> Iterable[Transmission]:
        assert isinstance(one.frame, bytes)
        cut = one.sender != HOST and wire.chance.random() < 0.2
        return (replace(one, frame=one.frame[: len(one.frame) // 2]) if cut else one,)

    rig.world.tamper.transmission = arrives


def for_another(rig: Rig, wire: Wire) -> None:
    """The last one answers as the device at address 99 would."""

    def arrives(_bus: str, one: Transmission) -> Iterable[Transmission]:
        assert isinstance(one.frame, bytes)
        body = bytes((99,)) + one.frame[1:-1]
        wrong = one.sender == THREE[-1] and len(one.frame) == ds.SIZE
        return (replace(one, frame=body + bytes((CRC8_MAXIM(body),))) if wrong else one,)

    rig.world.tamper.transmission = arrives


def twice(rig: Rig, wire: Wire) -> None:
    """Another device at the last one's address; what it measures is different."""
    rig.world.duplicate(THREE[-1])


def noise(rig: Rig, wire: Wire) -> None:
    """Bytes as fast as the line carries them, for the whole time."""
    for number in range(1200):
        piece = wire.chance.randbytes(11)  # 115,200 bit/s
        wire.bus.intrude(rig.clock.now() + number * MS, "noise", [piece])


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("wrong", "said", "faulty"),
    [
        (cut_short, "are garbage: noise, a loose connector, an adapter that cuts packets", ()),
        (for_another, "a device that answers for another id", THREE[-1:]),
        (twice, "an id twice on the line (both answer at once)", THREE[-1:]),
        (noise, "are garbage: another baud rate, or two that always send at once", THREE),
    ],
)
def test_what_is_wrong_on_a_line_is_counted_bounded_and_told_once_with_its_cause(
    wrong: Callable[[Rig, Wire], None],
    said: str,
    faulty: Sequence[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig, wire = driven(many(THREE, on_fault="continue"))
    troubles = LineTroubles(rig.gateway, {})
    wrong(rig, wire)
    caplog.clear()
    most = 0

    def at(tick: Tick) -> None:
        nonlocal most
        troubles.take(tick)
        most = max(most, len(wire.line.held) + len(wire.line.waiting))

    rig.run(1.2, at=at)
    assert [said in text for text in troubles.told.values()] == [True], troubles.told
    assert sum(said in message for message in caplog.messages) == 1
    assert wire.line.cut > 8
    assert most < 100
    assert [name for name, joint in rig.gateway.joints.items() if joint.faults] == [*faulty]


def test_what_a_driver_sends_to_the_devices_of_another_is_held_back() -> None:
    rig = Rig(TWO)
    place = ft.FAMILIES["sts"].by_name["Torque_Enable"].number
    arms = ft.PACKETS.packet(3, WRITE, bytes((place, 1)))
    guard, joints = rig.gateway.guard, rig.gateway.joints
    passed, (blocked,) = guard.check(0, "servos", "dynamixel", [arms], joints, False)
    assert (passed, blocked.rule, blocked.motors) == (
        [],
        "a command to a device that was not commanded",
        ("f3",),
    )


def test_only_what_reads_goes_out_before_the_last_answer_is_decoded() -> None:
    """The guard judges all else by what has come; and the brain has its steps, though answers go first."""
    rig, _ = driven(of_file("diffbot_ddsm"))
    gateway, check, think = rig.gateway, rig.gateway.guard.check, rig.gateway.brain.step
    checked, thought = Counter[tuple[bool, bool]](), list[Nanos]()

    def noted(now: Nanos, bus: str, protocol: str, frames: Sequence[Any], *others: Any) -> Any:
        for frame in frames:
            checked[gateway.guard.reads(bus, protocol, frame), bool(gateway._ended)] += 1
        return check(now, bus, protocol, frames, *others)

    def timed(now: Nanos, *others: Any) -> Any:
        thought.append(now)
        return think(now, *others)

    guard: Any = gateway.guard
    brain: Any = gateway.brain
    guard.check, brain.step = noted, timed
    rig.run(0.5)
    assert checked[True, True]
    assert checked[False, False]
    assert not checked[False, True]
    apart = [after - before for before, after in pairwise(thought)]
    assert max(abs(each - rig.robot.period) for each in apart) <= 2 * FINE


@pytest.mark.parametrize("name", ["bench", "twelve_dynamixel"])
@pytest.mark.parametrize("ticks", range(4))
def test_a_fault_that_comes_while_others_arm_is_no_defect_of_their_driver(name: str, ticks: int) -> None:
    """Defect: what was commanded before the fault was known, in the same step or while it waited for its
    line, was blocked and blamed on the driver: all others were in a fault, too, that only a restart ends."""
    robot = of_file(name, on_fault="stop")
    last = list(robot.motors)[-1]
    limits = replace(robot.motors[last].joint.limits, position=(-3.0, 3.0))
    rig = Rig(with_joints(robot, limits=limits))
    rig.run(0.3 + 0.005 * ticks)

    def jump(motor: str, true: Feedback) -> Feedback:
        return true if motor != last or true.position is None else replace(true, position=true.position + 2.0)

    rig.world.tamper.measured = jump
    rig.run(0.3, *(msg.Position(motor, 0.1) for motor in robot.motors))
    assert [motor for motor, joint in rig.gateway.joints.items() if joint.faults] == [last]


def test_who_is_asked_before_the_worlds_first_step_tells_where_its_shaft_is() -> None:
    """Defect: the shoulder of an arm that hangs told 0 rad, and then where it was: a turn lost, it seemed."""
    rig = Rig(config.load_robot("arm_dynamixel"))
    told = [
        event.position
        for tick in rig.run(0.05)
        for event in tick.outputs.events
        if isinstance(event, Feedback) and event.motor == "shoulder" and event.position is not None
    ]
    assert told
    assert told == pytest.approx([-1.0] * len(told), abs=0.002)
    assert not any(joint.faults for joint in rig.gateway.joints.values())
