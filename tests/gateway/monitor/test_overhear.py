"""Listening: who is found, what is made of what they say and are told, and that nothing is ever said."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pytest

from gateway import config
from gateway.core.robot import BusSettings
from gateway.monitor import render
from gateway.monitor.candidates import Tongue, anybody, choices, of_robot
from gateway.monitor.decoder import ENOUGH, MOST_IDS, WINDOW, Listener
from gateway.monitor.rate import Rate
from gateway.monitor.state import Heard, Seen, at_joint
from protocols import messages as msg
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos, Request
from protocols.odrive_can.codec import encode
from protocols.odrive_can.messages import GetEncoderEstimates, GetVersion, Heartbeat
from protocols.plain import codec
from protocols.plugin import load_all
from tests.gateway.rig import BENCH, Rig, said

CAN = BusSettings("can0", "can", "socketcan:can0", bitrate=1_000_000)
TTY = BusSettings("tty", "serial", "serial:tty", baudrate=1_000_000)
PLUGINS = load_all()[0]


class Mute:
    """A driver that must not be asked to speak."""

    def __init__(self, tongue: Tongue) -> None:
        self._driver = tongue.driver
        self.counters = tongue.driver.counters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        return self._driver.receive(t, frame)

    def bus(self, t: Nanos, state: BusState) -> None:
        self._driver.bus(t, state)

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        raise AssertionError("a listener has asked a driver to speak")

    def due(self) -> Nanos | None:
        raise AssertionError("a listener has asked a driver when it wants to speak")


def bare(*buses: BusSettings, began: Nanos = 0) -> Listener:
    tongues = [tongue for bus in buses for tongue in anybody(bus, PLUGINS)]
    muted = [replace(tongue, driver=Mute(tongue)) for tongue in tongues]
    return Listener({bus.name: bus for bus in buses}, muted, began, known=False)


def known(text: str = BENCH, *, window: Nanos | None = WINDOW) -> Listener:
    robot = config.parse_robot(text)
    muted = [replace(tongue, driver=Mute(tongue)) for tongue in of_robot(robot, list(robot.buses))]
    return Listener(robot.buses, muted, 0, known=True, window=window)


def handle(listener: Listener, *frames: tuple[Nanos, Frame], bus: str = "can0") -> list[Heard]:
    return [listener.handle(Packet(t, bus, frame)) for t, frame in frames]


def device(listener: Listener, name: str) -> Seen:
    return next(seen for seen in listener.found.values() if seen.party.name == name)


def page(listener: Listener, now: Nanos) -> str:
    return "\n".join(render.page(listener, now, "title"))


@pytest.fixture(scope="module")
def drive() -> tuple[Rig, list[Packet]]:
    """A second of nothing, and two in which the left motor turns; all that stood on the bus, in order."""
    rig = Rig()
    rig.run(1.0)
    rig.run(2.0, msg.Velocity("left", 4.0))
    packets = [p for tick in rig.ticks for p in (*tick.inputs.packets, *tick.outputs.packets)]
    return rig, sorted(packets, key=lambda packet: packet.t)


# -- a robot's own devices ------------------------------------------------------------------------


def test_with_a_robot_file_a_listener_knows_what_the_gateway_knows(drive: tuple[Rig, list[Packet]]) -> None:
    rig, packets = drive
    listener = known()
    received = [listener.handle(packet) for packet in packets]
    now = packets[-1].t
    for name, joint in rig.gateway.joints.items():
        seen = device(listener, name)
        assert seen.joint is not None
        assert (seen.joint.mode, seen.joint.detail) == (joint.mode, joint.detail)
        assert seen.joint.feedback == joint.feedback
        assert not seen.silent(now)
    command = device(listener, "left").command
    assert isinstance(command, msg.Velocity)
    assert command.velocity == pytest.approx(4.0)
    assert device(listener, "right").command is None
    assert not listener.unknown(now)
    assert listener.not_understood("can0") == 0
    at_ear = [(t, at_joint(word, 8.0)) for t, word in said(rig, rig.ticks) if word.motor == "left"]
    assert [(one.packet.t, word) for one in received for word in one.reported] == at_ear
    assert {one.direction for one in received} == {"from", "to"}


def test_rates_are_those_of_the_wire(drive: tuple[Rig, list[Packet]]) -> None:
    _, packets = drive
    listener = known()
    for packet in packets:
        listener.handle(packet)
    now = packets[-1].t
    since = now - WINDOW
    counted = [p.frame for p in packets if p.t > since and isinstance(p.frame, CanFrame)]
    rates = dict(listener.messages(device(listener, "left"), now))
    for number, label in ((0x029, "029 Feedback"), (0x021, "021 State")):
        true = sum(frame.id == number and not frame.remote for frame in counted) * SECOND / WINDOW
        assert rates[label] == pytest.approx(true, abs=true / 20 + 1)
    assert listener.buses["can0"].packets.per_second(now) == pytest.approx(len(counted) / 2, rel=0.06)
    load = listener.buses["can0"].busy.per_second(now) / SECOND
    assert 0.05 < load < 0.15  # some 700 frames of at most 135 µs


def test_without_a_window_rates_are_of_the_whole_time(drive: tuple[Rig, list[Packet]]) -> None:
    _, packets = drive
    listener = known(window=None)
    for packet in packets:
        listener.handle(packet)
    assert listener.buses["can0"].packets.per_second(3 * SECOND) == pytest.approx(len(packets) / 3)


def test_who_falls_silent_is_said_to_be(drive: tuple[Rig, list[Packet]]) -> None:
    _, packets = drive
    listener = known()
    assert "never heard" in page(listener, 0)
    for packet in packets:
        listener.handle(packet)
    now = packets[-1].t
    assert "SILENT" not in page(listener, now)
    assert page(listener, now + 101 * MILLISECOND).count("SILENT") == 2  # feedback_timeout_ms is 100


def test_faults_are_told_in_the_devices_words_and_are_past_when_it_is_well_again() -> None:
    listener = known()
    idle, current = 1, 0x1000
    handle(
        listener, (0, encode(1, GetVersion(2, 5, 1, 0, 0, 6, 10, 0)))
    )  # what its errors mean depends on it
    beat = [(t * 100 * MILLISECOND, encode(1, Heartbeat(0, idle, 0, 0))) for t in range(3)]
    handle(listener, *beat)
    assert "FAULT" not in page(listener, SECOND)
    (received,) = handle(listener, (300 * MILLISECOND, encode(1, Heartbeat(current, idle, 0, 0))))
    seen = device(listener, "left")
    (fault,) = seen.faults.values()
    assert fault in received.said
    text = page(listener, 400 * MILLISECOND)
    for part in (fault.name, fault.cause, fault.remedy, "fault: IDLE"):
        assert part
        assert part in text
    handle(listener, (500 * MILLISECOND, encode(1, Heartbeat(0, idle, 0, 0))))
    assert seen.faults == {}
    assert f"had a fault 300 ms ago: {fault.name}" in page(listener, 600 * MILLISECOND)


def test_a_frame_that_is_wrong_is_counted_and_believed_of_nobody() -> None:
    listener = known()
    (received,) = handle(listener, (0, CanFrame(0x029, b"\x00" * 3)))
    assert (received.said, received.reported, received.names) == ((), (), ("left",))
    assert listener.not_understood("can0") == 1
    assert device(listener, "left").received_at is None


def test_words_are_moved_to_the_output_shaft() -> None:
    assert at_joint(msg.Velocity("m", 8.0, 0.5), -8.0) == msg.Velocity("m", -1.0, -4.0)
    assert at_joint(msg.Position("m", 16.0, 8.0, 1.0), 8.0) == msg.Position("m", 2.0, 1.0, 8.0)
    assert at_joint(msg.Torque("m", 1.0), 4.0) == msg.Torque("m", 4.0)
    assert at_joint(msg.Idle("m"), 4.0) == msg.Idle("m")


# -- a bare bus -----------------------------------------------------------------------------------


def test_on_a_bare_bus_devices_are_found_by_trying(drive: tuple[Rig, list[Packet]]) -> None:
    _, packets = drive
    listener, robot = bare(CAN), known()
    for packet in packets:
        listener.handle(packet)
        robot.handle(packet)
    assert sorted((place[0], place[2]) for place in listener.found) == [("can0", 1), ("can0", 2)]
    for (_, _, address), seen in listener.found.items():
        reported = device(robot, "left" if address == 1 else "right")
        assert seen.joint is not None
        assert reported.joint is not None
        assert seen.joint.mode is reported.joint.mode
        position, geared = seen.joint.feedback.position, reported.joint.feedback.position
        assert position is not None
        assert geared is not None
        assert position == pytest.approx(8.0 * geared)  # nobody knows of a gear here
    (command,) = [seen.command for seen in listener.found.values() if seen.command is not None]
    assert isinstance(command, msg.Velocity)
    assert command.velocity == pytest.approx(32.0)
    assert not listener.unknown(packets[-1].t)


def test_frames_that_only_look_like_a_device_are_a_guess() -> None:
    """Estimates alone come of any 8 bytes; a motor also tells its state."""
    listener = bare(CAN)
    frames = [(t * 10 * MILLISECOND, encode(5, GetEncoderEstimates(1.0, 0.0))) for t in range(20)]
    received = handle(listener, *frames)
    assert not listener.found
    assert all(one.guessed and not one.said and one.direction == "" for one in received)
    ((_, seen),) = listener.unknown(SECOND)
    assert [name.endswith(":5") for name in seen.could_be] == [True]
    assert "could be" in page(listener, SECOND)
    assert "no device has been found yet" in page(listener, SECOND)
    (heard_beat,) = handle(listener, (SECOND, encode(5, Heartbeat(0, 1, 0, 0))))
    assert len(listener.found) == 1
    assert [type(event) for event in heard_beat.said] == [msg.State]
    assert not listener.unknown(SECOND)


def test_unknown_ids_are_listed_with_their_rates_the_busiest_first() -> None:
    listener = bare(CAN)
    for i in range(200):
        t = i * 10 * MILLISECOND
        handle(listener, (t, CanFrame(0x12345678, bytes([i]), extended=True)))
        if i % 10 == 0:
            handle(listener, (t + 1, CanFrame(0x7FF, b"\x01\x02\x03")))
    now = 2 * SECOND
    ids = listener.unknown(now)
    assert [key[3] for key, _ in ids] == [0x12345678, 0x7FF]
    assert [seen.rate.per_second(now) for _, seen in ids] == pytest.approx([100, 10], rel=0.1)
    text = page(listener, now)
    assert "12345678" in text
    assert "#010203" in text
    assert listener.not_understood("can0") == 220


def test_devices_on_a_serial_line_are_found_whatever_their_options() -> None:
    """A motor's messages make sense to nobody with the default options, which are a sensor's."""
    listener = bare(TTY)
    for i in range(10):
        t = i * 100 * MILLISECOND
        scan = codec.encode(1, msg.LaserScan("", 0, 0.0, 0.1, 0.1, 10.0, (1.0, 2.5, 11.0)))
        imu = codec.encode(2, msg.Imu("", 0, (0.0, 0.0, 0.5), (0.0, 0.0, 9.81)))
        motor = codec.encode(3, msg.Feedback("", 0, position=1.5)) + codec.encode(
            3, msg.State("", 0, Mode.ARMED)
        )
        stream = scan + imu + motor
        handle(listener, (t, stream[:25]), (t + MILLISECOND, stream[25:]), bus="tty")
    found = {place[2]: seen for place, seen in listener.found.items()}
    assert sorted(found) == [1, 2, 3]
    assert [found[address].joint is None for address in (1, 2, 3)] == [True, True, False]
    text = page(listener, SECOND)
    assert "3 beams, 2 hit something, the nearest at 1.000 m" in text
    assert "turning 0.000, 0.000, 0.500 rad/s" in text
    assert "1.500 rad" in text


def test_what_a_tap_on_a_serial_line_hears_of_the_host_is_told_too() -> None:
    listener = bare(TTY)
    for i in range(ENOUGH):
        up = codec.encode(3, msg.Feedback("", 0, position=1.5)) + codec.encode(
            3, msg.State("", 0, Mode.ARMED)
        )
        handle(listener, (i * MILLISECOND, up), bus="tty")
    (received,) = handle(listener, (SECOND, codec.encode(3, msg.Velocity("", 2.0))), bus="tty")
    (seen,) = listener.found.values()
    assert seen.command == msg.Velocity(seen.party.name, 2.0)
    assert received.direction == "to"


@pytest.mark.parametrize("seed", range(3))
def test_any_traffic_is_survived_and_bounded(seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    listener = bare(CAN, TTY)
    for t in range(1500):
        data = rng.bytes(int(rng.integers(0, 9)))
        extended, remote = bool(rng.integers(2)), rng.random() < 0.1
        number = int(rng.integers(0, 1 << (29 if extended else 11)))
        frame = CanFrame(number, b"" if remote else data, extended=extended, remote=remote)
        for raw, bus in ((frame, "can0"), (rng.bytes(int(rng.integers(0, 40))), "tty")):
            received = listener.handle(Packet(t * MILLISECOND, bus, raw))
            render.line(received)
    page(listener, 2 * SECOND)
    assert listener.buses["can0"].packets.total == 1500


def test_a_flood_of_ids_does_not_fill_the_memory() -> None:
    listener = known()
    for number in range(MOST_IDS + 100):
        listener.handle(Packet(number, "can0", CanFrame(0x10000 + number, b"", extended=True)))
    assert len(listener.ids) == MOST_IDS
    assert listener.buses["can0"].packets.total == MOST_IDS + 100
    assert "more unknown ids" in page(listener, SECOND)


def test_a_copy_goes_on_alike(drive: tuple[Rig, list[Packet]]) -> None:
    _, packets = drive
    listener = bare(CAN)
    for packet in packets[:400]:
        listener.handle(packet)
    other = copy.deepcopy(listener)
    assert [listener.handle(p) for p in packets[400:800]] == [other.handle(p) for p in packets[400:800]]


def test_a_change_of_a_bus_is_told_to_those_who_listen() -> None:
    listener = known()
    listener.state(0, "can0", BusState.GONE)
    assert "gone" in page(listener, 0)
    listener.state(1, "can0", BusState.BACK)
    assert "gone" not in page(listener, 1)


# -- options and rates ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    line: Literal["a", "b", "c"] = "a"
    wide: bool = False
    number: int = 3

    def __post_init__(self) -> None:
        if self.wide and self.line != "b":
            raise ValueError("only b is wide")


def test_every_choice_of_options_is_tried_once() -> None:
    assert choices(Sample) == [Sample(), Sample("b"), Sample("c"), Sample("b", wide=True)]


def test_a_rate_is_that_of_the_last_window_and_never_more_than_there_was() -> None:
    rate = Rate(0, SECOND)
    assert rate.per_second(0) == 0.0
    for t in range(0, 5 * SECOND, 10 * MILLISECOND):
        rate.add(t)
        assert rate.per_second(t) <= 100.1 + (SECOND / min(t, SECOND) if t else 0.0)
    assert rate.per_second(5 * SECOND) == pytest.approx(100, rel=0.06)
    assert rate.per_second(5 * SECOND + SECOND // 2) == pytest.approx(50, rel=0.11)
    assert rate.per_second(7 * SECOND) == 0.0
    assert rate.total == 500
