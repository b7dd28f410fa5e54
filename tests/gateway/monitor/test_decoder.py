"""The bus monitor: which devices it finds, what it decodes, and that it never asks a driver to send."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import pytest

from gateway import config
from gateway.core.robot import BusSettings
from gateway.monitor import render
from gateway.monitor.candidates import choices, of_plugins, of_robot
from gateway.monitor.decoder import (
    AGAIN,
    MAX_IDS,
    MIN_EVENTS,
    MOST_IN_VAIN,
    WINDOW,
    BusMonitor,
    at_joint,
)
from gateway.monitor.state import DecodedPacket, DeviceRecord, ProtocolVariant, Rate
from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import MILLISECOND, SECOND, Event, Mode, Nanos, Obeyed
from protocols.odrive_can.table import table_of
from protocols.plain import table
from protocols.plugin import load_all
from tests.gateway.rig import BENCH, Rig, sent_commands
from tests.sampled import sampled

CAN = BusSettings("can0", "can", "socketcan:can0", bitrate=1_000_000)
TTY = BusSettings("tty", "serial", "serial:tty", baudrate=1_000_000)
PLUGINS = load_all()[0]


def odrive(name: str, node: int, *numbers: float) -> CanFrame:
    """A message of an ODrive of firmware 0.6.x."""
    rows = table_of("0.6")
    names = [field.name for field in rows.row(name).fields if field.name]
    return rows.encode(name, node, **dict(zip(names, numbers, strict=True)))


MOTOR = table.encode(3, msg.Feedback("", 0, position=1.5)) + table.encode(3, msg.State("", 0, Mode.ARMED))
"""What a motor at address 3 sends on a serial bus."""
Drive: TypeAlias = tuple[Rig, list[Packet]]


class ReceiveOnly(DriverWrapper):
    """A driver that must not be asked to send."""

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        raise AssertionError("the monitor asked a driver to send")

    def due(self) -> Nanos | None:
        raise AssertionError("the monitor asked a driver when it is due")


def monitor_of(
    buses: Sequence[BusSettings],
    variants: Iterable[ProtocolVariant],
    *,
    known: bool,
    window: Nanos | None = WINDOW,
) -> BusMonitor:
    variants = list(variants)
    for variant in variants:
        variant.driver = ReceiveOnly(variant.driver)
    return BusMonitor({bus.name: bus for bus in buses}, variants, 0, known=known, window=window)


def bare(*buses: BusSettings) -> BusMonitor:
    variants = [variant for bus in buses for variant in of_plugins(bus, PLUGINS)]
    return monitor_of(buses, variants, known=False)


def known(window: Nanos | None = WINDOW) -> BusMonitor:
    robot = config.parse_robot(BENCH)
    buses = list(robot.buses.values())
    return monitor_of(buses, of_robot(robot, list(robot.buses)), known=True, window=window)


def decode(monitor: BusMonitor, *frames: tuple[Nanos, Frame], bus: str = "can0") -> list[DecodedPacket]:
    return [monitor.decode(Packet(t, bus, frame)) for t, frame in frames]


def fed(monitor: BusMonitor, packets: Sequence[Packet]) -> BusMonitor:
    for packet in packets:
        monitor.decode(packet)
    return monitor


def device(monitor: BusMonitor, name: str) -> DeviceRecord:
    return next(record for record in monitor.found.values() if record.name == name)


def page(monitor: BusMonitor, now: Nanos) -> str:
    return "\n".join(render.page(monitor, now, "title"))


@pytest.fixture(scope="module")
def drive() -> Drive:
    """One second at rest, two in which the left motor turns; all packets of the bus, in order."""
    rig = Rig()
    rig.run(1.0)
    rig.run(2.0, msg.Velocity("left", 4.0))
    packets = [p for tick in rig.ticks for p in (*tick.inputs.packets, *tick.outputs.packets)]
    return rig, sorted(packets, key=lambda packet: packet.t)


# -- a robot's own devices ------------------------------------------------------------------------


def test_with_a_robot_file_the_monitor_knows_what_the_gateway_knows(drive: Drive) -> None:
    rig, packets = drive
    monitor = known()
    decoded = [monitor.decode(packet) for packet in packets]
    now = packets[-1].t
    for name, joint in rig.gateway.joints.items():
        record = device(monitor, name)
        assert record.joint is not None
        assert (record.joint.mode, record.joint.detail) == (joint.mode, joint.detail)
        assert record.joint.feedback == joint.feedback
        assert not record.silent(now)
    command = device(monitor, "left").command
    assert isinstance(command, msg.Velocity)
    assert command.velocity == pytest.approx(4.0)
    assert device(monitor, "right").command is None
    assert not monitor.unknown(now)
    assert monitor.not_understood("can0") == 0
    obeyed = [(t, at_joint(c, 8.0)) for t, c in sent_commands(rig.robot, rig.ticks) if c.motor == "left"]
    sent = [(one.packet.t, command) for one in decoded for command in one.commands]
    assert [(t, command) for t, command in sent if not isinstance(command, msg.Arm)] == obeyed
    assert [command for _, command in sent if isinstance(command, msg.Arm)] == [msg.Arm("left")]
    assert {one.direction for one in decoded} == {"from", "to"}


def test_rates_are_those_of_the_bus(drive: Drive) -> None:
    _, packets = drive
    monitor = fed(known(), packets)
    now = packets[-1].t
    since = now - WINDOW
    counted = [p.frame for p in packets if p.t > since and isinstance(p.frame, CanFrame)]
    rates = dict(monitor.message_rates(device(monitor, "left"), now))
    for number, label in ((0x029, "029 Feedback"), (0x021, "021 State")):
        true = sum(frame.id == number and not frame.remote for frame in counted) * SECOND / WINDOW
        assert rates[label] == pytest.approx(true, abs=true / 20 + 1)
    assert monitor.buses["can0"].packets.per_second(now) == pytest.approx(len(counted) / 2, rel=0.06)
    load = monitor.buses["can0"].busy.per_second(now) / SECOND
    assert 0.05 < load < 0.15  # some 700 frames of at most 135 µs


def test_without_a_window_rates_cover_the_whole_time(drive: Drive) -> None:
    _, packets = drive
    monitor = fed(known(window=None), packets)
    assert monitor.buses["can0"].packets.per_second(3 * SECOND) == pytest.approx(len(packets) / 3)


def test_a_device_that_falls_silent_is_marked(drive: Drive) -> None:
    _, packets = drive
    assert "no message yet" in page(known(), 0)
    monitor, now = fed(known(), packets), packets[-1].t
    assert "SILENT" not in page(monitor, now)
    assert page(monitor, now + 101 * MILLISECOND).count("SILENT") == 2  # feedback_timeout_ms is 100


def test_faults_have_the_texts_of_their_protocol_and_are_past_once_the_state_is_none_of_fault() -> None:
    monitor = known()
    idle, current = 1, 0x1000
    version = (0, odrive("Get_Version", 1, 2, 5, 1, 0, 0, 6, 10, 0))  # the meaning of errors depends on it
    beats = [(t * 100 * MILLISECOND, odrive("Heartbeat", 1, 0, idle, 0, 0)) for t in range(3)]
    decode(monitor, version, *beats)
    assert "FAULT" not in page(monitor, SECOND)
    (packet,) = decode(monitor, (300 * MILLISECOND, odrive("Heartbeat", 1, current, idle, 0, 0)))
    record = device(monitor, "left")
    (fault,) = record.faults.values()
    assert fault in packet.events
    text = page(monitor, 400 * MILLISECOND)
    for part in (fault.name, fault.cause, fault.remedy, "fault: IDLE"):
        assert part
        assert part in text
    decode(monitor, (500 * MILLISECOND, odrive("Heartbeat", 1, 0, idle, 0, 0)))
    assert record.faults == {}
    assert f"had a fault 300 ms ago: {fault.name}" in page(monitor, 600 * MILLISECOND)


def test_a_malformed_frame_is_counted_and_is_no_feedback() -> None:
    monitor = known()
    (packet,) = decode(monitor, (0, CanFrame(0x029, b"\x00" * 3)))
    assert (packet.events, packet.commands, packet.names) == ([], [], ("left",))
    assert monitor.not_understood("can0") == 1
    assert device(monitor, "left").received_at is None


def test_commands_are_converted_to_the_output_shaft() -> None:
    assert at_joint(msg.Velocity("m", 8.0, 0.5), -8.0) == msg.Velocity("m", -1.0, -4.0)
    assert at_joint(msg.Position("m", 16.0, 8.0, 1.0), 8.0) == msg.Position("m", 2.0, 1.0, 8.0)
    assert at_joint(msg.Torque("m", 1.0), 4.0) == msg.Torque("m", 4.0)
    assert at_joint(msg.Idle("m"), 4.0) == msg.Idle("m")


# -- a bare bus -----------------------------------------------------------------------------------


def test_without_a_robot_file_devices_are_found_by_trying(drive: Drive) -> None:
    _, packets = drive
    monitor, robot = fed(bare(CAN), packets), fed(known(), packets)
    assert sorted((place[0], place[2]) for place in monitor.found) == [("can0", 1), ("can0", 2)]
    for (_, _, address), record in monitor.found.items():
        expected = device(robot, "left" if address == 1 else "right")
        assert record.joint is not None
        assert expected.joint is not None
        assert record.joint.mode is expected.joint.mode
        position, geared = record.joint.feedback.position, expected.joint.feedback.position
        assert position is not None
        assert geared is not None
        assert position == pytest.approx(8.0 * geared)  # no gear is known here
    (command,) = [record.command for record in monitor.found.values() if record.command is not None]
    assert isinstance(command, msg.Velocity)
    assert command.velocity == pytest.approx(32.0)
    assert not monitor.unknown(packets[-1].t)


def test_frames_that_only_look_like_a_device_are_a_guess() -> None:
    """Any 8 bytes decode to estimates; a motor also sends its state."""
    monitor = bare(CAN)
    frames = [(t * 10 * MILLISECOND, odrive("Get_Encoder_Estimates", 5, 1.0, 0.0)) for t in range(20)]
    decoded = decode(monitor, *frames)
    assert not monitor.found
    assert all(one.guesses and not one.events and one.direction == "" for one in decoded)
    ((_, record),) = monitor.unknown(SECOND)
    assert {*record.could_be} == {"odrive_can:5", "cia406:41"}  # or the error of an encoder
    assert "could be" in page(monitor, SECOND)
    assert "no device has been found yet" in page(monitor, SECOND)
    (packet,) = decode(monitor, (SECOND, odrive("Heartbeat", 5, 0, 1, 0, 0)))
    assert len(monitor.found) == 1
    assert [type(event) for event in packet.events] == [msg.State]
    assert not monitor.unknown(SECOND)


def test_unknown_ids_are_listed_with_their_rates_the_busiest_first() -> None:
    monitor = bare(CAN)
    for i in range(200):
        t = i * 10 * MILLISECOND
        decode(monitor, (t, CanFrame(0x12345678, bytes([i]), extended=True)))
        if i % 10 == 0:
            decode(monitor, (t + 1, CanFrame(0x7FF, b"\x01\x02\x03")))
    now = 2 * SECOND
    ids = monitor.unknown(now)
    assert [key[3] for key, _ in ids] == [0x12345678, 0x7FF]
    assert [record.rate.per_second(now) for _, record in ids] == pytest.approx([100, 10], rel=0.1)
    text = page(monitor, now)
    assert "12345678" in text
    assert "#010203" in text
    assert monitor.not_understood("can0") == 220


class Counts(ReceiveOnly):
    """A driver that counts what it is asked to decode."""

    asked = 0

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        type(self).asked += 1
        return super().receive(t, frame)


def test_an_id_that_means_nothing_to_any_protocol_is_soon_only_counted() -> None:
    """Of no device's ids: no driver is asked. Of some, in vain: once in a while, until it means something."""
    variants = list(of_plugins(CAN, PLUGINS))
    for variant in variants:
        variant.driver = Counts(variant.driver)
    monitor = BusMonitor({"can0": CAN}, variants, 0, known=False)
    Counts.asked = 0
    free = next(n for n in range(0x7FF, 0, -1) if not any(n in ids for ids in monitor._ids_of.values()))
    decode(monitor, *((i, CanFrame(free, bytes(8))) for i in range(1000)))
    assert Counts.asked == 0
    short = CanFrame(odrive("Heartbeat", 5, 0, 1, 0, 0).id, b"")  # no message of any device
    decode(monitor, *((i, short) for i in range(1000, 2000)))
    each = sum(1 for one in variants if short.id in monitor._ids_of[one])
    assert each > 0
    assert Counts.asked <= each * (MOST_IN_VAIN + 900 // AGAIN + 1)
    frames = [(i, odrive("Heartbeat", 5, 0, 1, 0, 0)) for i in range(2000, 2000 + 4 * AGAIN)]
    meant = [bool(one.guesses or one.events) for one in decode(monitor, *frames)]
    assert any(meant[:AGAIN])
    vain = monitor._in_vain["can0", False, False, short.id]
    assert 0 in vain.values()  # by those to whom it means something each is decoded again
    assert max(vain.values()) > MOST_IN_VAIN  # and by the others one in a while
    assert monitor.ids["can0", False, False, short.id].rate.total == 1000 + 4 * AGAIN


def test_devices_on_a_serial_bus_are_found_whatever_their_options() -> None:
    """The default options, which are a sensor's, decode nothing of a motor's messages."""
    monitor = bare(TTY)
    for i in range(10):
        t = i * 100 * MILLISECOND
        scan = table.encode(1, msg.LaserScan("", 0, 0.0, 0.1, 0.1, 10.0, (1.0, 2.5, 11.0)))
        imu = table.encode(2, msg.Imu("", 0, (0.0, 0.0, 0.5), (0.0, 0.0, 9.81)))
        stream = scan + imu + MOTOR
        decode(monitor, (t, stream[:25]), (t + MILLISECOND, stream[25:]), bus="tty")
    found = {place[2]: record for place, record in monitor.found.items()}
    assert sorted(found) == [1, 2, 3]
    assert [found[address].joint is None for address in (1, 2, 3)] == [True, True, False]
    text = page(monitor, SECOND)
    assert "3 beams, 2 with an echo, the nearest at 1.000 m" in text
    assert "angular velocity 0.000, 0.000, 0.500 rad/s" in text
    assert "1.500 rad" in text


def test_commands_of_the_host_on_a_serial_bus_are_decoded() -> None:
    monitor = bare(TTY)
    for i in range(MIN_EVENTS):
        decode(monitor, (i * MILLISECOND, MOTOR), bus="tty")
    (packet,) = decode(monitor, (SECOND, table.encode(3, msg.Velocity("", 2.0))), bus="tty")
    (record,) = monitor.found.values()
    assert record.command == msg.Velocity(record.name, 2.0)
    assert packet.direction == "to"


@pytest.mark.parametrize("seed", sampled(range(3), 3))
def test_no_traffic_raises(seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    monitor = bare(CAN, TTY)
    for t in range(500):
        data = rng.bytes(int(rng.integers(0, 9)))
        extended, remote = bool(rng.integers(2)), rng.random() < 0.1
        number = int(rng.integers(0, 1 << (29 if extended else 11)))
        frame = CanFrame(number, b"" if remote else data, extended=extended, remote=remote)
        for raw, bus in ((frame, "can0"), (rng.bytes(int(rng.integers(0, 40))), "tty")):
            render.line(monitor.decode(Packet(t * MILLISECOND, bus, raw)))
    page(monitor, 2 * SECOND)
    assert monitor.buses["can0"].packets.total == 500


class Raises(ReceiveOnly):
    """A driver that raises at every frame."""

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        raise KeyError("Motor_Error_Flag")

    def bus(self, t: Nanos, state: BusState) -> None:
        raise ZeroDivisionError


class DecoderRaises:
    """A decoder that raises while its result is read."""

    def decode(self, t: Nanos, frame: Frame) -> Iterator[Obeyed]:
        yield msg.Idle("left")
        raise IndexError("no byte")


def test_a_plugin_that_raises_is_named_and_the_others_go_on() -> None:
    variants = list(of_plugins(CAN, PLUGINS))
    odrives = [variant for variant in variants if variant.protocol == "odrive_can"]
    for variant in odrives:
        variant.driver, variant.decoder = Raises(variant.driver), DecoderRaises()  # type: ignore[assignment]
    monitor = BusMonitor({"can0": CAN}, variants, 0, known=False)
    monitor.on_state(0, "can0", BusState.BACK)
    assert monitor.failures == {"odrive_can on can0": "ZeroDivisionError: "}
    frame = odrive("Heartbeat", 1, 0, 8, 0, 0)
    (decoded,) = decode(monitor, (MILLISECOND, frame))
    assert "the protocol odrive_can has failed: KeyError: 'Motor_Error_Flag'" in render.line(decoded)
    assert "the protocol odrive_can has failed: IndexError: no byte" in render.line(decoded)
    assert "odrive_can on can0: IndexError: no byte" in page(monitor, MILLISECOND)
    assert monitor.buses["can0"].packets.total == 1


def test_a_flood_of_ids_does_not_fill_the_memory() -> None:
    monitor = known()
    decode(monitor, *((i, CanFrame(0x10000 + i, b"", extended=True)) for i in range(MAX_IDS + 100)))
    assert len(monitor.ids) == MAX_IDS
    assert monitor.buses["can0"].packets.total == MAX_IDS + 100
    assert "more unknown ids" in page(monitor, SECOND)


def test_a_copy_continues_alike(drive: Drive) -> None:
    _, packets = drive
    monitor = fed(known(), packets[:400])
    other = copy.deepcopy(monitor)
    assert [monitor.decode(p) for p in packets[400:800]] == [other.decode(p) for p in packets[400:800]]


def test_the_page_shows_a_change_of_a_bus() -> None:
    monitor = known()
    monitor.on_state(0, "can0", BusState.GONE)
    assert "gone" in page(monitor, 0)
    monitor.on_state(1, "can0", BusState.BACK)
    assert "gone" not in page(monitor, 1)


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
