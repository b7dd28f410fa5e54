"""Real interfaces: python-can's in-process bus, and pairs of pseudo-terminals."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import pytest

from gateway.buses import Bus, open_bus
from gateway.buses.can import MOST_READ, CanBus, open_can
from gateway.buses.interfaces import missing
from gateway.buses.serial.bus import MOST_WAITING as MOST_BYTES
from gateway.buses.serial.bus import SerialBus, open_serial
from gateway.buses.states import CALM
from gateway.buses.usb import can_interfaces
from gateway.core.clock import SimulatedClock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.buses.adapter_helpers import frames_of, gather, poll, raw_pty, taken, wait_for_input

CAN = BusSettings("can0", "can", "virtual:test_buses", bitrate=500_000)


# -- CAN ---------------------------------------------------------------------------------------


@pytest.fixture
def pair() -> Iterator[tuple[Bus, Bus]]:
    one, other = open_can(CAN, SimulatedClock()), open_can(CAN, SimulatedClock())
    yield one, other
    one.close()
    other.close()


FRAMES = [
    CanFrame(0x123, b"\x01\x02"),
    CanFrame(0x7FF),
    CanFrame(0x123, remote=True),
    CanFrame(0x12345678, b"\xff" * 8, extended=True),
    CanFrame(0x1, bytes(64), fd=True, brs=True),
    CanFrame(0x123, b"\x03"),
]


def test_frames_arrive_whole_in_order_and_stamped(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    one.write(5, FRAMES)
    states, packets = other.read(7)
    assert states == []
    assert packets == [Packet(7, "can0", frame) for frame in FRAMES]
    assert other.read(8) == ([], [])


def test_own_frames_are_not_received(pair: tuple[Bus, Bus]) -> None:
    one, _ = pair
    one.write(0, FRAMES)
    assert one.read(1) == ([], [])


def test_one_read_is_bounded_and_loses_nothing(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    frames = [CanFrame(n % 2048, bytes([n % 256])) for n in range(MOST_READ + 10)]
    one.write(0, frames)
    first, second = other.read(1)[1], other.read(2)[1]
    assert (len(first), len(second)) == (MOST_READ, 10)
    assert [packet.frame for packet in (*first, *second)] == frames


def test_the_systems_stamp_is_moved_onto_the_clock_and_never_runs_backwards() -> None:
    clock = WallClock()
    one, other = open_can(CAN, clock), open_can(CAN, clock)
    try:
        before = clock.now()
        one.write(before, FRAMES[:3])
        between = clock.now()
        stamps = [packet.t for packet in other.read(between)[1]]
        assert stamps == sorted(stamps)
        assert len(stamps) == 3
        slack = SECOND  # the two clocks of the machine, decades apart, are read one after the other
        assert before - slack <= stamps[0] <= stamps[-1] <= between + slack
        one.write(0, FRAMES[:1])
        assert other.read(stamps[-1] - 10)[1][0].t == stamps[-1]
    finally:
        one.close()
        other.close()


class Frame(can.BusABC):
    """A back end that fails on demand, as no healthy bus can be made to do."""

    def __init__(self) -> None:
        super().__init__(channel="x")
        self.sent: list[CanFrame] = []
        self.failure: Exception | None = None
        self.incoming: list[can.Message] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.failure:
            raise self.failure
        self.sent.append(CanFrame(msg.arbitration_id, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if isinstance(self.failure, can.CanOperationError) and self.failure.error_code == errno.ENETDOWN:
            raise self.failure
        return (self.incoming.pop(0), True) if self.incoming else (None, False)


@pytest.fixture
def broken() -> Iterator[tuple[CanBus, Frame]]:
    frame = Frame()
    bus = CanBus(CAN, SimulatedClock(), frame)
    yield bus, frame
    bus.close()
    frame.shutdown()


@pytest.mark.parametrize(
    "full",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),
        can.CanOperationError("Transmit buffer full"),
        can.CanTimeoutError("the write timed out"),
    ],
    ids=["ENOBUFS", "select", "timeout"],
)
def test_a_full_queue_is_reported_once_and_the_newest_command_wins(
    broken: tuple[CanBus, Frame], full: Exception
) -> None:
    bus, frame = broken
    frame.failure = full
    bus.write(0, [CanFrame(1, b"old"), CanFrame(2, b"kept"), CanFrame(1, b"newer")])
    bus.write(1, [CanFrame(1, b"newest")])
    assert bus.read(2) == ([BusState.FULL], [])
    assert bus.read(3) == ([], [])
    assert frame.sent == []
    frame.failure = None
    bus.write(4, [CanFrame(3, b"after")])
    assert frame.sent == [CanFrame(1, b"newest"), CanFrame(2, b"kept"), CanFrame(3, b"after")]
    assert bus.dropped == 2
    assert bus.read(CALM) == ([], [])
    assert bus.read(3 + CALM) == ([BusState.UP], [])


def test_an_interface_that_vanishes_is_reported_and_the_queue_is_dropped(
    broken: tuple[CanBus, Frame],
) -> None:
    bus, frame = broken
    frame.failure = can.CanOperationError("full", errno.ENOBUFS)
    bus.write(0, [CanFrame(1, b"stale")])
    frame.failure = can.CanOperationError("Network is down", errno.ENETDOWN)
    assert bus.read(1) == ([BusState.FULL, BusState.GONE], [])
    bus.write(2, [CanFrame(1, b"lost")])
    assert bus.read(SECOND) == ([], [])
    other = open_can(CAN, SimulatedClock())
    try:
        assert bus.read(1 + SECOND) == ([BusState.BACK], [])
        assert other.read(2 * SECOND) == ([], [])
        bus.write(2 * SECOND, [CanFrame(1, b"new")])
        assert [packet.frame for packet in other.read(2 * SECOND)[1]] == [CanFrame(1, b"new")]
    finally:
        other.close()
    assert frame.sent == []
    assert bus.dropped == 2


def test_own_frames_received_over_loopback_are_dropped() -> None:
    raw = Frame()
    settings = BusSettings("can0", "can", "udp_multicast:239.74.163.2", bitrate=500_000)
    bus = CanBus(settings, SimulatedClock(), raw)
    ours, theirs = CanFrame(1, b"ours"), CanFrame(2, b"theirs")
    bus.write(0, [ours, ours])
    raw.incoming = [as_message(frame) for frame in (ours, theirs, ours, ours)]
    assert [packet.frame for packet in bus.read(1)[1]] == [theirs, ours]
    bus.close()


def as_message(frame: CanFrame) -> can.Message:
    return can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=frame.extended)


def error_frame(what: int, controller: int = 0) -> can.Message:
    data = bytes([0, controller, 0, 0, 0, 0, 0, 0])
    return can.Message(arbitration_id=what, data=data, is_error_frame=True)


def test_error_frames_are_states_and_never_data(broken: tuple[CanBus, Frame]) -> None:
    bus, frame = broken
    frame.incoming = [error_frame(0x004, 0x20), error_frame(0x004, 0x20), error_frame(0x002)]
    assert bus.read(0) == ([BusState.PASSIVE], [])
    frame.incoming = [error_frame(0x004, 0x40)]
    assert bus.read(1) == ([BusState.UP], [])
    frame.incoming = [error_frame(0x040), error_frame(0x100)]
    assert bus.read(2) == ([BusState.OFF, BusState.BACK], [])


def test_closing_again_and_using_a_closed_bus_is_harmless(pair: tuple[Bus, Bus]) -> None:
    one, other = pair
    one.close()
    one.close()
    one.write(0, FRAMES)
    assert one.read(10 * SECOND) == ([], [])
    assert other.read(0) == ([], [])


def test_an_adapters_acknowledgements_and_bad_lines_are_skipped() -> None:
    """Lawicel's protocol: t = 11-bit frame, r = remote frame, z and bare returns are acknowledgements."""
    device, host = raw_pty()
    bus = open_can(
        BusSettings("can0", "can", f"slcan:{os.ttyname(host)}", bitrate=1_000_000), SimulatedClock()
    )
    assert isinstance(bus, CanBus)
    try:
        bus.write(0, [CanFrame(0x123, b"\x01\xff"), CanFrame(0x12, remote=True)])
        sent = b""
        while not sent.endswith(b"r0120\r"):
            sent += os.read(device, 1000)
        assert b"S8\r" in sent
        assert sent.endswith(b"O\rt123201FF\rr0120\r")
        os.write(device, b"z\r\rz\rt0452AABB\rtXYZ\rt0\rz\rT123456780\rt04")
        frames = [CanFrame(0x45, b"\xaa\xbb"), CanFrame(0x12345678, extended=True)]
        assert frames_of(bus, 1, 2) == frames
        os.write(device, b"61CC\r")
        assert frames_of(bus, 2, 1) == [CanFrame(0x46, b"\xcc")]
        assert bus.bad == 2
        os.close(device)
        assert poll(lambda: list(bus.read(3)[0])) == [BusState.GONE]
    finally:
        bus.close()
        os.close(host)


# -- what cannot be opened ------------------------------------------------------------------------


def a_net(tmp_path: Path, **flags: str) -> Path:
    for name, value in {"lo": "0x9", **flags}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text("772\n" if name == "lo" else "280\n")
        (tmp_path / name / "flags").write_text(value + "\n")
    return tmp_path


def socketcan(channel: str, kind: Any = "can") -> BusSettings:
    return BusSettings("can0", kind, f"socketcan:{channel}", bitrate=1_000_000, data_bitrate=5_000_000)


def test_a_missing_vcan_is_named_with_what_there_is_and_the_commands(tmp_path: Path) -> None:
    net = a_net(tmp_path, can1="0x40080", can3="0x40081")
    text = missing(socketcan("vcan0"), "vcan0", True, net)
    assert "bus 'can0' cannot be opened as 'socketcan:vcan0'" in text
    assert "there is no CAN interface 'vcan0'" in text
    assert "can1, can3." in text
    assert "sudo ip link add dev vcan0 type vcan\n  sudo ip link set vcan0 up" in text


def test_a_missing_can_gets_its_bit_rate(tmp_path: Path) -> None:
    text = missing(socketcan("can0"), "can0", True, a_net(tmp_path))
    assert "interfaces of this machine: none" in text
    assert "sudo ip link set can0 type can bitrate 1000000 restart-ms 100\n  sudo ip link set can0 up" in text
    text = missing(socketcan("can0", "canfd"), "can0", True, tmp_path)
    assert "type can bitrate 1000000 dbitrate 5000000 fd on restart-ms 100" in text


def test_an_interface_that_is_down_is_not_called_missing(tmp_path: Path) -> None:
    net = a_net(tmp_path, can0="0x40080", can1="0x400c1")
    assert "can0 is down" in missing(socketcan("can0"), "can0", True, net)
    assert missing(socketcan("can1"), "can1", True, net) == ""
    assert can_interfaces(net) == ["can0", "can1"]


def test_a_kernel_without_can_is_named_with_the_commands(tmp_path: Path) -> None:
    text = missing(socketcan("vcan0"), "vcan0", False, a_net(tmp_path))
    assert "kernel has no CAN (errno 97" in text
    assert "ip link add dev vcan0 type vcan" in text


def test_a_socketcan_that_is_not_there_is_a_bus_error() -> None:
    with pytest.raises(BusError, match="socketcan:vcan97") as caught:
        open_bus(socketcan("vcan97"), SimulatedClock())
    assert "ip link add dev vcan97" in str(caught.value)


@pytest.mark.parametrize(
    ("interface", "nearest"), [("socketcam:can0", "socketcan"), ("fdcanusbb:/dev/x", "fdcanusb")]
)
def test_an_unknown_interface_is_reported_with_the_nearest(interface: str, nearest: str) -> None:
    with pytest.raises(BusError, match=f"did you mean '{nearest}'"):
        open_bus(BusSettings("can0", "can", interface, bitrate=500_000), SimulatedClock())


# -- serial ------------------------------------------------------------------------------------


@pytest.fixture
def line() -> Iterator[tuple[int, SerialBus, BusSettings]]:
    """The device's end of a line, and the bus at the other one."""
    device, host = raw_pty()
    os.set_blocking(device, False)
    settings = BusSettings("line", "serial", f"serial:{os.ttyname(host)}", baudrate=1_000_000)
    bus = open_serial(settings)
    os.close(host)
    yield device, bus, settings
    bus.close()
    with suppress(OSError):  # a test may have closed it
        os.close(device)


def received(bus: Bus, now: int) -> bytes:
    return b"".join(p.frame for p in bus.read(now)[1] if isinstance(p.frame, bytes))


def test_bytes_go_both_ways_unchanged(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, bus, _ = line
    everything = bytes(range(256))
    os.write(device, everything)
    assert gather(lambda: received(bus, 3), len(everything)) == everything
    bus.write(4, [everything, b"tail"])
    assert taken(device, 260) == everything + b"tail"


def test_what_is_there_is_one_packet_stamped_now(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, bus, _ = line
    assert bus.read(1) == ([], [])
    os.write(device, b"abc")
    packets = poll(lambda: bus.read(9)[1])
    assert packets == [Packet(9, "line", b"abc")]


def test_a_line_that_is_not_read_drops_whole_messages_and_stays_in_step(
    line: tuple[int, SerialBus, BusSettings],
) -> None:
    device, bus, _ = line
    frames = [bytes([n % 251]) * 97 for n in range(1000)]
    for frame in frames:
        bus.write(0, [frame])
    assert bus.read(1)[0] == [BusState.FULL]
    assert bus.dropped > 0
    got = b""
    while len(got) < 97 * (1000 - bus.dropped):
        bus.read(2)
        wait_for_input(device)
        got += os.read(device, 65536)
    assert len(got) == 97 * (1000 - bus.dropped)
    pieces = [got[at : at + 97] for at in range(0, len(got), 97)]
    assert all(len(set(piece)) == 1 for piece in pieces)
    assert pieces[-1] == frames[-1]
    assert 1000 - bus.dropped >= MOST_BYTES // 97


def test_old_commands_do_not_go_out_when_a_line_goes_on(
    line: tuple[int, SerialBus, BusSettings], caplog: pytest.LogCaptureFixture
) -> None:
    """A pty has handed over 4200 bytes already, which cannot be purged."""
    device, bus, _ = line
    purges, purged_at = 0, 0
    for number in range(2000):
        bus.write(number * MILLISECOND, [b"%020d\n" % number])
        if caplog.text.count("was purged") > purges:
            purges, purged_at = purges + 1, number
    assert bus.read(2000 * MILLISECOND)[0][-1] is BusState.FULL
    got = b""
    with suppress(BlockingIOError):
        while True:
            got += os.read(device, 65536)
    numbers = [int(each) for each in got.split(b"\n") if len(each) == 20]
    assert numbers[-1] == 1999
    assert purged_at > 500
    assert sum(number < purged_at for number in numbers) < 4200 // 21
    assert bus.dropped > 50
    assert bus.read(4000 * MILLISECOND) == ([BusState.UP], [])


def test_a_hang_up_is_reported_once_and_raises_nothing(line: tuple[int, SerialBus, BusSettings]) -> None:
    device, bus, _ = line
    os.close(device)
    states = poll(lambda: list(bus.read(5)[0]))
    assert states == [BusState.GONE]
    bus.write(6, [b"lost"])
    assert bus.read(7) == ([], [])
    assert bus.read(5 + SECOND) == ([], [])
    assert bus.dropped == 1


def test_a_port_that_comes_back_is_reported(tmp_path: Path) -> None:
    first, second = raw_pty(), raw_pty()
    port = tmp_path / "port"
    port.symlink_to(os.ttyname(first[1]))
    bus = open_serial(BusSettings("line", "serial", f"serial:{port}", baudrate=9600))
    try:
        os.close(first[1])
        os.close(first[0])
        assert poll(lambda: list(bus.read(0)[0])) == [BusState.GONE]
        port.unlink()
        port.symlink_to(os.ttyname(second[1]))
        assert bus.read(SECOND // 2) == ([], [])
        assert bus.read(SECOND) == ([BusState.BACK], [])
        os.write(second[0], b"hello again")
        assert gather(lambda: received(bus, SECOND), 11) == b"hello again"
    finally:
        bus.close()
        os.close(second[0])
        os.close(second[1])


def test_a_port_in_use_is_reported(line: tuple[int, SerialBus, BusSettings]) -> None:
    with pytest.raises(BusError, match="another program has"):
        open_serial(line[2])


def test_a_missing_port_is_reported_with_what_there_is() -> None:
    settings = BusSettings("line", "serial", "serial:/dev/ttyNOWHERE", baudrate=9600)
    with pytest.raises(BusError, match=r"bus 'line'.*serial:/dev/ttyNOWHERE.*Serial ports of this machine:"):
        open_serial(settings)
