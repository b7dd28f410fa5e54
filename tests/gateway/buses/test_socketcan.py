"""A SocketCAN bus over a pair of datagram sockets, which carry the kernel's struct can_frame, stamps and all.

What only a kernel with CAN can do (own frames, interfaces that go, ENOBUFS) is in tests/real_can."""

from __future__ import annotations

import errno
import logging
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import pytest

from gateway.buses.interfaces import check_fit, filters
from gateway.buses.netlink import NetDevice, NetLink, NetStatus
from gateway.buses.queues import PATIENCE
from gateway.buses.socketcan import bus as socketcan
from gateway.buses.socketcan.bus import FAST_POLL, MOST_READ, SLOW_POLL, SocketcanBus
from gateway.buses.socketcan.raw_socket import pack
from gateway.buses.states import CALM
from gateway.core.clock import Clock, SimulatedClock, WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Packet, exact
from protocols.messages import MILLISECOND, SECOND

SETTINGS = BusSettings("can0", "can", "socketcan:can0", bitrate=1_000_000)
LINK = NetLink(
    "can0", 7, up=True, mtu=16, queue=10, kind="can", state=BusState.UP, bitrate=1_000_000, restart_ms=0
)
SO_TIMESTAMPNS = 35


class End:
    """A socket as python-can opens one."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def shutdown(self) -> None:
        self.socket.close()


@dataclass
class Kernel(NetDevice):
    """The kernel's state of can0."""

    status_: NetStatus | None = field(default_factory=lambda: NetStatus(7, up=True, running=True))
    link_: NetLink | None = LINK
    closed: bool = False

    def status(self) -> NetStatus | None:
        return self.status_

    def link(self) -> NetLink | None:
        return self.link_

    def close(self) -> None:
        self.closed = True


@dataclass
class Rig:
    bus: SocketcanBus
    ours: socket.socket
    frame: socket.socket
    kernel: Kernel


@pytest.fixture
def clock() -> Clock:
    return SimulatedClock()


@pytest.fixture
def rig(clock: Clock) -> Iterator[Rig]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    theirs.setblocking(False)
    kernel = Kernel()
    bus = SocketcanBus(SETTINGS, clock, End(ours), kernel)
    yield Rig(bus, ours, theirs, kernel)
    bus.close()
    bus.close()
    theirs.close()
    assert kernel.closed


def error_frame(classes: int, *data: int) -> bytes:
    return struct.pack("=IB3x8s", 0x2000_0000 | classes, 8, bytes(data))


FRAMES = [
    CanFrame(1, b"one"),
    CanFrame(0x1234567, b"two", extended=True),
    CanFrame(3, bytes(12), fd=True, brs=True),
]


def test_frames_go_both_ways_whole_and_in_order(rig: Rig) -> None:
    rig.bus.write(1, FRAMES)
    assert [rig.frame.recv(100) for _ in FRAMES] == [pack(frame) for frame in FRAMES]
    for frame in FRAMES:
        rig.frame.send(pack(frame))
    rig.frame.send(b"no frame at all")
    assert rig.bus.read(5) == ([], [Packet(5, "can0", frame) for frame in FRAMES])
    assert rig.bus.read(6) == ([], [])
    assert (rig.bus.bad, rig.bus.missed, rig.bus.dropped) == (1, 0, 0)


@pytest.mark.parametrize("clock", [WallClock()])
def test_the_kernels_stamp_is_moved_onto_our_clock(rig: Rig, clock: Clock) -> None:
    moments = [clock.now()]
    for frame in FRAMES:
        rig.frame.send(pack(frame))
        moments.append(clock.now())
    packets = rig.bus.read(clock.now() + MILLISECOND)[1]
    assert len(packets) == len(FRAMES)
    slack = MILLISECOND // 2  # the two clocks are read one after the other
    for packet, before, after in zip(packets, moments, moments[1:], strict=False):
        assert before - slack <= packet.t <= after + slack


def test_one_read_is_bounded(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    assert MOST_READ > 1_000_000 / 55 * 0.1  # the shortest frame of 11-bit id has 47 bits and more
    monkeypatch.setattr(socketcan, "MOST_READ", 3)
    for number in range(5):
        rig.frame.send(pack(CanFrame(number)))
    assert [len(rig.bus.read(now)[1]) for now in range(3)] == [3, 2, 0]


def test_a_full_queue_keeps_the_newest_of_each_id_and_is_reported_once(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    """EAGAIN, as from a raw CAN socket that has used up its share of the kernel's memory."""
    rig.ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 0)  # as little as can be: a few frames
    with caplog.at_level(logging.WARNING, "gateway"):
        rig.bus.write(0, [CanFrame(number) for number in range(100)])
        rig.bus.write(MILLISECOND, [CanFrame(99, b"newer"), CanFrame(98, b"newer")])
    assert rig.bus.read(2 * MILLISECOND) == ([BusState.FULL], [])
    assert "sudo ip link set can0 txqueuelen 100" in caplog.text
    sent: list[bytes] = []
    for tick in range(1, 200):
        while True:
            try:
                sent.append(rig.frame.recv(100))
            except BlockingIOError:
                break
        now = 2 * MILLISECOND + tick * 5 * MILLISECOND
        states, _ = rig.bus.read(now)
        if states:
            break
    expected = [*(CanFrame(number) for number in range(98)), CanFrame(98, b"newer"), CanFrame(99, b"newer")]
    assert sent == [pack(frame) for frame in expected]
    assert rig.bus.dropped == 2
    assert states == [BusState.UP]
    assert now >= CALM
    assert caplog.text.count("txqueuelen") == 1


def test_nothing_is_added_to_what_the_kernel_holds_for_too_long(rig: Rig) -> None:
    """Nothing reads what was sent, as with a controller that no node acknowledges, behind a long queue."""
    step = 5 * MILLISECOND
    reported: list[BusState] = []
    for tick in range(40):
        rig.bus.write(tick * step, [CanFrame(1, bytes([tick]))])
        reported += rig.bus.read(tick * step)[0]
    assert reported == [BusState.FULL]
    stale: list[bytes] = []
    while len(stale) < 100:
        try:
            stale.append(rig.frame.recv(100))
        except BlockingIOError:
            break
    assert len(stale) <= PATIENCE // step + 1
    rig.bus.read(40 * step)
    assert rig.frame.recv(100) == pack(CanFrame(1, bytes([39])))
    assert rig.bus.dropped == 40 - len(stale) - 1
    rig.bus.write(41 * step, [CanFrame(1, b"on")])
    assert rig.frame.recv(100) == pack(CanFrame(1, b"on"))


def receive_all(end: socket.socket) -> list[bytes]:
    received: list[bytes] = []
    while True:
        try:
            received.append(end.recv(100))
        except BlockingIOError:
            return received


def test_it_is_said_what_waits_in_the_kernel_and_how_late_it_went_out(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    for tick in range(300):
        rig.bus.write(tick * 5 * MILLISECOND, [CanFrame(1, bytes([tick % 256]))])
        rig.bus.read(tick * 5 * MILLISECOND)
    held = len(receive_all(rig.frame))
    assert f"can0: up to {held} frames wait in the kernel's queue; nothing is added until" in caplog.text
    assert "sudo ip link set can0 down; sudo ip link set can0 up" in caplog.text
    rig.bus.read(1500 * MILLISECOND)
    assert "what waited in the kernel's queue went out, 14" in caplog.text
    assert len(caplog.records) == 2


def test_what_the_kernel_drops_with_the_interface_is_counted(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.bus.write(0, [CanFrame(number) for number in range(3)])
    rig.bus.read(0)
    rig.kernel.status_ = NetStatus(7, up=False, running=False)
    receive_all(rig.frame)  # as the kernel does when an interface goes down
    assert rig.bus.read(SECOND) == ([BusState.GONE], [])
    assert "can0: up to 3 frames that waited in the kernel's queue were purged" in caplog.text
    rig.kernel.status_ = NetStatus(7, up=True, running=True)
    rig.bus.read(2 * SECOND)
    assert receive_all(rig.frame) == []


def test_what_the_kernel_keeps_over_bus_off_goes_before_anything_else(rig: Rig) -> None:
    rig.bus.write(0, [CanFrame(1, b"old")])
    rig.frame.send(error_frame(0x040))
    assert rig.bus.read(1) == ([BusState.OFF], [])
    rig.frame.send(error_frame(0x100))
    assert rig.bus.read(SECOND)[0] == [BusState.BACK, BusState.FULL]
    rig.bus.write(SECOND, [CanFrame(1, b"arm")])
    assert receive_all(rig.frame) == [pack(CanFrame(1, b"old"))]
    rig.bus.read(SECOND + MILLISECOND)
    assert receive_all(rig.frame) == [pack(CanFrame(1, b"arm"))]


def test_error_frames_are_states_and_log_lines_and_never_data(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    received = [error_frame(0x004, 0, 0x20), error_frame(0x028), error_frame(0x028), error_frame(0x040)]
    with caplog.at_level(logging.INFO, "gateway"):
        for raw in received:
            rig.frame.send(raw)
        assert rig.bus.read(0) == ([BusState.PASSIVE, BusState.OFF], [])
    assert caplog.text.count("no acknowledgement (no other node is active)") == 1
    assert rig.bus.errors["no acknowledgement (no other node is active)"] == 2
    assert "sudo ip link set can0 type can restart;" in caplog.text
    assert "restart-ms 100" in caplog.text
    rig.bus.write(1, [CanFrame(1, b"lost")])
    rig.frame.send(error_frame(0x100))
    assert rig.bus.read(2) == ([BusState.BACK], [])
    rig.bus.write(3, [CanFrame(1, b"new")])
    assert rig.frame.recv(100) == pack(CanFrame(1, b"new"))
    assert rig.bus.dropped == 1


def test_a_controller_that_restarts_by_itself_is_logged_as_such(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.bus._link = replace(LINK, restart_ms=100)
    rig.frame.send(error_frame(0x040))
    with caplog.at_level(logging.WARNING, "gateway"):
        rig.bus.read(0)
    assert "can0 restarts by itself 100 ms after bus-off" in caplog.text


def test_after_a_lost_error_frame_the_kernel_is_asked(rig: Rig) -> None:
    rig.bus.read(0)
    rig.kernel.status_ = NetStatus(7, up=True, running=False)
    rig.kernel.link_ = replace(LINK, state=BusState.OFF)
    assert rig.bus.read(SLOW_POLL - 1) == ([], [])
    assert rig.bus.read(SLOW_POLL) == ([BusState.OFF], [])
    rig.kernel.link_ = replace(LINK, state=BusState.PASSIVE)
    assert rig.bus.read(2 * SLOW_POLL) == ([BusState.BACK, BusState.PASSIVE], [])
    rig.kernel.link_ = LINK
    assert rig.bus.read(3 * SLOW_POLL) == ([BusState.UP], [])


def test_an_interface_that_goes_down_and_comes_up_keeps_what_it_received(rig: Rig) -> None:
    rig.bus.read(0)
    rig.kernel.status_ = NetStatus(7, up=False, running=False)
    assert rig.bus.read(SECOND) == ([BusState.GONE], [])
    rig.bus.write(SECOND, [CanFrame(1, b"stale")])
    rig.kernel.status_ = NetStatus(7, up=True, running=True)
    rig.frame.send(pack(CanFrame(5)))
    now = SECOND + FAST_POLL
    assert rig.bus.read(now) == ([BusState.BACK], [Packet(now, "can0", CanFrame(5))])
    with pytest.raises(BlockingIOError):
        rig.frame.recv(100)
    assert rig.bus.dropped == 1


def test_an_interface_that_comes_back_as_another_one_is_opened_anew(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A USB adapter pulled out and put in again: the name is the same, the number and the socket are not."""
    rig.bus.read(0)
    rig.kernel.status_ = None
    assert rig.bus.read(SECOND) == ([BusState.GONE], [])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    opened: list[BusSettings] = []

    def reopen(settings: BusSettings, link: NetLink | None, listen_only: bool) -> End:
        opened.append(settings)
        if len(opened) == 1:
            raise BusError("not yet")
        return End(ours)

    monkeypatch.setattr(socketcan, "_open", reopen)
    rig.kernel.status_ = NetStatus(8, up=True, running=True)
    now = SECOND + FAST_POLL
    with caplog.at_level(logging.WARNING, "gateway"):
        assert rig.bus.read(now) == ([], [])
    assert "not yet" in caplog.text
    theirs.send(pack(CanFrame(6)))
    now += FAST_POLL
    assert rig.bus.read(now) == ([BusState.BACK], [Packet(now, "can0", CanFrame(6))])
    assert rig.bus.read(now + SECOND) == ([], [])
    assert opened == [SETTINGS, SETTINGS]
    theirs.close()


def test_an_interface_that_comes_back_configured_otherwise_stays_gone(
    rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.kernel.status_ = NetStatus(7, up=False, running=False)
    rig.bus.read(0)
    rig.kernel.status_ = NetStatus(7, up=True, running=True)
    rig.kernel.link_ = replace(LINK, bitrate=500_000)
    with caplog.at_level(logging.WARNING, "gateway"):
        assert [rig.bus.read(n * SECOND)[0] for n in (1, 2)] == [[], []]
    assert caplog.text.count("can0 has a bitrate of 500000 bit/s, the robot file has 1000000") == 1
    rig.kernel.link_ = LINK
    assert rig.bus.read(3 * SECOND)[0] == [BusState.BACK]


def test_an_error_that_is_not_the_interfaces_is_counted_and_not_raised(rig: Rig) -> None:
    rig.frame.close()
    rig.bus.write(1, [CanFrame(1)])  # ECONNREFUSED: no error of an interface; the frame is refused
    assert rig.bus.read(2)[0] == []
    assert rig.bus.dropped == 1


def test_an_invalid_frame_is_refused_and_logged_once(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "gateway"):
        rig.bus.write(1, [CanFrame(0x800), CanFrame(0x801), CanFrame(1, b"good")])
    assert caplog.text.count("a frame was refused") == 1
    assert rig.frame.recv(100) == pack(CanFrame(1, b"good"))
    assert rig.bus.dropped == 2


def test_the_stop_command_that_waits_is_sent_on_closing(rig: Rig) -> None:
    rig.ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 0)
    rig.bus.write(0, [CanFrame(number) for number in range(50)])
    received = [rig.frame.recv(100) for _ in range(2)]
    rig.bus.close()
    while True:
        try:
            received.append(rig.frame.recv(100))
        except (BlockingIOError, ConnectionResetError):
            break
    assert len(received) > 2 + 2
    assert received == [pack(CanFrame(number)) for number in range(len(received))]


# -- what does not fit the robot file --------------------------------------------------------------------

FD = BusSettings("fast", "canfd", "socketcan:can0", bitrate=1_000_000, data_bitrate=5_000_000)


@pytest.mark.parametrize(
    ("settings", "link", "lines"),
    [
        (SETTINGS, replace(LINK, bitrate=500_000),
         ["bus 'can0' cannot be opened as 'socketcan:can0'", "can0 has a bitrate of 500000 bit/s, the robot",
          "file has 1000000", "[buses.can0]",
          "sudo ip link set can0 type can bitrate 1000000 restart-ms 100"]),
        (FD, replace(LINK, mtu=72, data_bitrate=2_000_000),
         ["data_bitrate of 2000000", "dbitrate 5000000 fd on"]),
        (FD, LINK, ["classic CAN only (mtu 16)", "type can bitrate 1000000 dbitrate 5000000 fd on"]),
        (FD, replace(LINK, name="vcan0", kind="vcan", bitrate=0), ["sudo ip link set vcan0 mtu 72 up"]),
    ],
)  # fmt: skip
def test_an_interface_configured_otherwise_is_reported_with_the_commands(
    settings: BusSettings, link: NetLink, lines: list[str]
) -> None:
    with pytest.raises(BusError) as caught:
        check_fit(settings, link)
    assert [line for line in lines if line not in str(caught.value)] == []


@pytest.mark.parametrize(
    ("settings", "link"),
    [
        (SETTINGS, LINK),
        (SETTINGS, replace(LINK, bitrate=993_000)),  # 0.7 %: as near as its clock can be divided
        (SETTINGS, NetLink("vcan0", 1, up=True, mtu=72, queue=1000, kind="vcan")),
        (FD, replace(LINK, mtu=72, data_bitrate=5_000_000)),
    ],
)
def test_an_interface_that_fits_is_accepted(settings: BusSettings, link: NetLink) -> None:
    check_fit(settings, link)


def test_filters_are_python_cans() -> None:
    assert filters((exact(0x21), exact(0x21, extended=True), (6, 0x1F))) == [
        {"can_id": 0x21, "can_mask": 0x1FFFFFFF, "extended": False},
        {"can_id": 0x21, "can_mask": 0x1FFFFFFF, "extended": True},
        {"can_id": 6, "can_mask": 0x1F},
    ]


def test_the_errno_of_an_interface_that_is_down_is_not_that_of_a_full_queue() -> None:
    assert {errno.ENETDOWN, errno.ENODEV}.isdisjoint(socketcan._FULL)
