"""SocketCAN as it is: kernel stamps, filters, full queues, lost frames, interfaces that go and come back."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import pytest

from gateway.buses import Bus, open_bus
from gateway.buses.netlink import NetDevice
from gateway.buses.queues import PATIENCE
from gateway.buses.socketcan.bus import FAST_POLL, SocketcanBus
from gateway.buses.states import CALM
from gateway.core.clock import WallClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame, Packet
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.processes import eventually
from tests.real_can.candump import listeners
from tests.real_can.conftest import ip

CLOCK = WallClock()
Open = Callable[[BusSettings], SocketcanBus]
Controllers = Callable[[int], tuple[str, str]]


def settings(name: str, receive_filter: tuple[tuple[int, int], ...] = ()) -> BusSettings:
    return BusSettings(name, "can", f"socketcan:{name}", bitrate=1_000_000, receive_filter=receive_filter)


def fast(name: str) -> BusSettings:
    return BusSettings(name, "canfd", f"socketcan:{name}", bitrate=1_000_000, data_bitrate=5_000_000)


@pytest.fixture
def opened() -> Iterator[Open]:
    with ExitStack() as stack:

        def open_one(wanted: BusSettings) -> SocketcanBus:
            bus = open_bus(wanted, CLOCK)
            assert isinstance(bus, SocketcanBus)
            stack.callback(bus.close)
            return bus

        yield open_one


def frames_of(packets: Sequence[Packet]) -> list[object]:
    return [packet.frame for packet in packets]


def receive(bus: Bus, count: int = 1, patience: int = SECOND) -> list[Packet]:
    """Read until `count` frames have come, for `patience` at most."""
    received: list[Packet] = []
    until = CLOCK.now() + patience
    while len(received) < count and CLOCK.now() < until:
        received += bus.read(CLOCK.now())[1]
        time.sleep(0.002)
    return received


def reported(bus: Bus, for_: int) -> list[BusState]:
    """The state changes within `for_`, read every 5 ms."""
    states: list[BusState] = []
    until = CLOCK.now() + for_
    while CLOCK.now() < until:
        states += bus.read(CLOCK.now())[0]
        time.sleep(0.005)
    return states


@contextmanager
def slow(name: str, frames: int) -> Iterator[None]:
    """While inside, the interface sends about 60 frames a second, and its queue holds so many; what is still
    in it on leaving is lost.

    As with a bus that higher priorities fill; QEMU's controllers send at once and are acknowledged always."""
    subprocess.run(["modprobe", "sch_tbf"], check=True)
    shape = f"tc qdisc replace dev {name} root tbf rate 8kbit burst 100 limit {16 * frames}"
    subprocess.run(shape.split(), check=True)
    yield
    subprocess.run(f"tc qdisc del dev {name} root".split(), check=True)


def run_commands(text: str) -> None:
    """Run the commands that an error message proposes."""
    lines = [line.strip() for line in text.splitlines() if line.strip().startswith("sudo ")]
    assert lines, text
    for line in lines:
        subprocess.run(line.removeprefix("sudo ").split(), check=True, capture_output=True)


FRAMES = [
    CanFrame(0x123, b"\x01\x02"),
    CanFrame(0x7FF),
    CanFrame(0x123, remote=True, requested=3),
    CanFrame(0x12345678, b"\xff" * 8, extended=True),
    CanFrame(0x123, b"\x03"),
]

# -- frames and stamps --------------------------------------------------------------------------------


def test_frames_cross_in_order_and_own_ones_are_not_received(vcan0: str, opened: Open) -> None:
    one, other = opened(settings(vcan0)), opened(settings(vcan0))
    one.write(CLOCK.now(), FRAMES)
    assert frames_of(receive(other, len(FRAMES))) == FRAMES
    assert one.read(CLOCK.now()) == ([], [])


@pytest.mark.controllers
def test_frames_cross_between_two_controllers(controllers: Controllers, opened: Open) -> None:
    one, other = (opened(settings(name)) for name in controllers(1_000_000))
    # The emulated controller loses its place in what it receives behind a remote frame with a length.
    frames = [replace(frame, requested=0) for frame in FRAMES]
    one.write(CLOCK.now(), frames)
    assert frames_of(receive(other, len(frames))) == frames
    other.write(CLOCK.now(), frames[::-1])
    assert frames_of(receive(one, len(frames))) == frames[::-1]
    assert (one.bad, other.bad, one.dropped, other.dropped) == (0, 0, 0, 0)


def test_a_timestamp_is_when_a_frame_arrived_and_not_when_it_was_read(vcan0: str, opened: Open) -> None:
    one, other = opened(settings(vcan0)), opened(settings(vcan0))
    time.sleep(0.05)  # the kernel's first to ask for stamps gets them a little later (net_enable_timestamp)
    moments = []
    for frame in FRAMES:
        before = CLOCK.now()
        one.write(before, [frame])
        moments.append((before, CLOCK.now()))
        time.sleep(0.05)
    packets = other.read(CLOCK.now())[1]
    slack = MILLISECOND // 2  # two clocks are read one after the other
    for (before, after), packet in zip(moments, packets, strict=True):
        assert before - slack <= packet.t <= after + slack


def test_another_process_sends_to_us_and_receives_from_us(vcan0: str, opened: Open) -> None:
    bus = opened(settings(vcan0))
    before = listeners(vcan0)
    command = ["candump", "-L", "-n3", "-T60000", vcan0]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as dump:
        assert eventually(lambda: listeners(vcan0) > before)
        subprocess.run(["cansend", vcan0, "345#DEADBEEF"], check=True)
        assert frames_of(receive(bus)) == [CanFrame(0x345, b"\xde\xad\xbe\xef")]
        bus.write(CLOCK.now(), [CanFrame(0x12, b"\x01"), CanFrame(0x1ABCDEF0, b"\x02", extended=True)])
        output, _ = dump.communicate()
    assert [line.split()[-1] for line in output.splitlines()] == ["345#DEADBEEF", "012#01", "1ABCDEF0#02"]


def test_a_flood_from_another_process_arrives_whole(vcan0: str, opened: Open) -> None:
    """As fast as it can: many frames in one read, none of them lost."""
    bus = opened(settings(vcan0))
    count = 3000
    subprocess.run(["cangen", vcan0, "-g", "0", "-n", str(count), "-I", "i", "-L", "8", "-i"], check=True)
    packets = receive(bus, count)
    assert len(packets) == count
    assert [p.t for p in packets] == sorted(p.t for p in packets)
    assert (bus.missed, bus.bad) == (0, 0)


def test_frames_that_come_faster_than_they_are_read_are_counted_exactly(
    vcan0: str, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    one, other = opened(settings(vcan0)), opened(settings(vcan0))
    count, frame = 16_000, CanFrame(1, bytes(8))
    for _ in range(count // 1000):
        one.write(CLOCK.now(), [frame] * 1000)
    received = len(receive(other, count))
    assert received < count
    one.write(CLOCK.now(), [frame])  # the kernel reports it with the next frame
    assert len(receive(other)) == 1
    assert other.missed == count - received
    assert f"{other.missed} frames were lost: they came faster than they were read" in caplog.text


# -- CAN FD ---------------------------------------------------------------------------------------


def test_can_fd_with_and_without_the_switched_bit_rate_beside_classic_frames(
    vcan0: str, opened: Open
) -> None:
    one, other, classic = opened(fast(vcan0)), opened(fast(vcan0)), opened(settings(vcan0))
    frames = [
        CanFrame(1, bytes(range(64)), fd=True, brs=True),
        CanFrame(0x1234567, bytes(12), extended=True, fd=True),
        CanFrame(2, b"classic"),
    ]
    one.write(CLOCK.now(), frames)
    assert frames_of(receive(other, 3)) == frames
    assert frames_of(receive(classic)) == [CanFrame(2, b"classic")]
    one.write(CLOCK.now(), [CanFrame(3, b"ten bytes!", fd=True, brs=True)])
    assert frames_of(receive(other)) == [CanFrame(3, b"ten bytes!\0\0", fd=True, brs=True)]


def test_candump_sees_the_switched_bit_rate(vcan0: str, opened: Open) -> None:
    bus = opened(fast(vcan0))
    with subprocess.Popen(
        ["candump", "-L", "-n1", "-T20000", vcan0], stdout=subprocess.PIPE, text=True
    ) as dump:
        while dump.poll() is None:  # until it listens
            bus.write(CLOCK.now(), [CanFrame(0x123, bytes(12), fd=True, brs=True)])
            time.sleep(0.1)
        output, _ = dump.communicate()
    assert output.split()[-1] == f"123##5{'00' * 12}"  # the flags: 1 = switched, 4 = CAN FD


def test_a_can_fd_frame_on_a_classic_bus_is_refused_and_logged_once(
    vcan0: str, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    one, other = opened(settings(vcan0)), opened(settings(vcan0))
    one.write(CLOCK.now(), [CanFrame(1, b"", fd=True)] * 3 + [CanFrame(2)])
    assert frames_of(receive(other)) == [CanFrame(2)]
    assert one.dropped == 3
    assert caplog.text.count("a frame was refused: 001##0: Invalid argument") == 1


# -- the commands that an error message proposes ---------------------------------------------------------


def test_the_lines_for_a_missing_vcan_make_one(opened: Open) -> None:
    for kind in (settings, fast):
        with pytest.raises(BusError, match="there is no CAN interface 'vcan7'") as caught:
            opened(kind("vcan7"))
        try:
            run_commands(str(caught.value))
            opened(kind("vcan7")).write(CLOCK.now(), [CanFrame(1)])
        finally:
            ip("link", "delete", "vcan7")


def test_the_lines_for_classic_can_where_can_fd_is_wanted_make_it_can_fd(vcan0: str, opened: Open) -> None:
    ip("link", "set", vcan0, "down")
    ip("link", "set", vcan0, "mtu", "16", "up")
    with pytest.raises(BusError, match="classic CAN only") as caught:
        opened(fast(vcan0))
    run_commands(str(caught.value))
    opened(fast(vcan0))


@pytest.mark.controllers
def test_the_lines_for_another_bit_rate_set_it(controllers: Controllers, opened: Open) -> None:
    one, other = controllers(500_000)
    with pytest.raises(BusError, match="has a bitrate of 500000 bit/s, the robot file has 1000000") as caught:
        opened(settings(one))
    run_commands(str(caught.value))
    opened(settings(one))
    ip("link", "set", other, "down")
    with pytest.raises(BusError, match=f"{other} is down") as caught:
        opened(BusSettings(other, "can", f"socketcan:{other}", bitrate=500_000))
    run_commands(str(caught.value))
    opened(BusSettings(other, "can", f"socketcan:{other}", bitrate=500_000))
    device = NetDevice(one)
    link = device.link()
    device.close()
    assert link is not None
    assert (link.bitrate, link.restart_ms, link.state) == (1_000_000, 100, BusState.UP)


@pytest.mark.controllers
def test_a_listen_only_controller_is_logged(
    controllers: Controllers, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    one, _ = controllers(1_000_000)
    ip("link", "set", one, "down")
    ip("link", "set", one, "type", "can", "listen-only", "on")
    ip("link", "set", one, "up")
    try:
        opened(settings(one))
    finally:
        ip("link", "set", one, "down")
        ip("link", "set", one, "type", "can", "listen-only", "off")
    assert f"{one} is in listen-only mode" in caplog.text


# -- filters ----------------------------------------------------------------------------------------


def test_the_kernel_lets_in_what_is_asked_for_and_error_frames(vcan0: str, opened: Open) -> None:
    talker = opened(settings(vcan0))
    some = opened(settings(vcan0, receive_filter=((0x021, 0x1FFFFFFF), (0x006, 0x01F))))
    frames = [CanFrame(number, b"x") for number in range(0x800)]
    talker.write(CLOCK.now(), frames)
    expected = [frame for frame in frames if frame.id == 0x021 or frame.id & 0x1F == 6]
    assert frames_of(receive(some, len(frames), SECOND // 5)) == expected
    subprocess.run(["cansend", vcan0, "20000040#0000000000000000"], check=True)
    assert reported(some, SECOND // 5) == [BusState.OFF]


# -- the state of the line ----------------------------------------------------------------------------


def test_error_frames_become_states(vcan0: str, opened: Open) -> None:
    """A virtual interface has no controller; its error frames are sent by hand, as a driver would."""
    bus = opened(settings(vcan0))
    for what, state in (
        ("20000004#0020000000000000", [BusState.PASSIVE]),
        ("20000008#0000000000000000", []),
        ("20000004#0040000000000000", [BusState.UP]),
        ("20000040#0000000000000000", [BusState.OFF]),
        ("20000100#0000000000000000", [BusState.BACK]),
    ):
        subprocess.run(["cansend", vcan0, what], check=True)
        assert reported(bus, 100 * MILLISECOND) == state
    assert bus.errors["bus-off"] == 1


def go_down_and_up(name: str, bus: SocketcanBus, talker: Callable[[CanFrame], None]) -> None:
    """Down is reported at once; what comes right after going up is received, though up is detected later."""
    bus.write(CLOCK.now(), [CanFrame(1)])
    ip("link", "set", name, "down")
    assert bus.read(CLOCK.now())[0] == [BusState.GONE]
    before = bus.dropped
    bus.write(CLOCK.now(), [CanFrame(2), CanFrame(3)])
    assert bus.dropped == before + 2
    assert reported(bus, SECOND // 2) == []
    ip("link", "set", name, "up")
    talker(CanFrame(4, b"early"))
    came = CLOCK.now()
    states: list[BusState] = []
    packets: list[Packet] = []
    while not packets and CLOCK.now() < came + SECOND:
        more, arrived = bus.read(CLOCK.now())
        states += more
        packets += arrived
        time.sleep(0.01)
    states += reported(bus, 2 * FAST_POLL)
    assert states == [BusState.BACK]
    assert frames_of(packets) == [CanFrame(4, b"early")]
    assert packets[0].t <= came + MILLISECOND


def test_a_virtual_interface_that_goes_down_and_comes_up(vcan0: str, opened: Open) -> None:
    bus = opened(settings(vcan0))

    def talk(frame: CanFrame) -> None:
        opened(settings(vcan0)).write(CLOCK.now(), [frame])

    go_down_and_up(vcan0, bus, talk)
    bus.write(CLOCK.now(), [CanFrame(5)])
    assert bus.dropped == 2


@pytest.mark.controllers
def test_a_controller_that_goes_down_and_comes_up(controllers: Controllers, opened: Open) -> None:
    one, other = controllers(1_000_000)
    bus, far = opened(settings(one)), opened(settings(other))
    go_down_and_up(one, bus, lambda frame: far.write(CLOCK.now(), [frame]))
    bus.write(CLOCK.now(), [CanFrame(5)])
    assert frames_of(receive(far, 2)) == [CanFrame(1), CanFrame(5)]


@pytest.mark.controllers
def test_one_that_is_up_again_before_anybody_looked_was_gone_all_the_same(
    controllers: Controllers, opened: Open
) -> None:
    one, _ = controllers(1_000_000)
    bus = opened(settings(one))
    bus.read(CLOCK.now())
    ip("link", "set", one, "down")
    ip("link", "set", one, "up")
    assert reported(bus, SECOND // 2) == [BusState.GONE, BusState.BACK]


def test_an_interface_that_is_removed_and_made_again(vcan0: str, opened: Open) -> None:
    bus = opened(settings(vcan0))
    bus.read(CLOCK.now())
    ip("link", "delete", vcan0)
    assert reported(bus, SECOND // 2) == [BusState.GONE]
    bus.write(CLOCK.now(), [CanFrame(1)])
    ip("link", "add", "dev", vcan0, "type", "vcan")
    assert reported(bus, SECOND // 2) == []  # there, but down
    ip("link", "set", vcan0, "up")
    assert reported(bus, SECOND // 2) == [BusState.BACK]
    other = opened(settings(vcan0))
    bus.write(CLOCK.now(), [CanFrame(2)])
    assert frames_of(receive(other)) == [CanFrame(2)]
    other.write(CLOCK.now(), [CanFrame(3)])
    assert frames_of(receive(bus)) == [CanFrame(3)]


# -- full queues ----------------------------------------------------------------------------------


@pytest.mark.controllers
def test_a_full_queue_of_the_kernel_is_reported_once_and_the_newest_goes_out(
    controllers: Controllers, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    """ENOBUFS for real: ten frames fit."""
    one, other = controllers(1_000_000)
    bus, far = opened(settings(one)), opened(settings(other))
    with slow(one, frames=10):
        bus.write(CLOCK.now(), [CanFrame(number, b"old") for number in range(60)])
        bus.write(CLOCK.now(), [CanFrame(number, b"new") for number in range(40, 60)])
        assert bus.read(CLOCK.now())[0] == [BusState.FULL]
        assert reported(bus, SECOND + CALM + SECOND // 2) == [BusState.UP]
    assert frames_of(receive(far, 60)) == [CanFrame(n, b"old" if n < 40 else b"new") for n in range(60)]
    assert bus.dropped == 20
    assert f"sudo ip link set {one} txqueuelen 100" in caplog.text


@pytest.mark.controllers
def test_a_long_queue_of_the_kernel_does_not_fill_with_old_commands(
    controllers: Controllers, opened: Open
) -> None:
    """1000 frames would fit, 30 s of them: a command goes out every 5 ms, one in 17 ms gets through."""
    one, other = controllers(1_000_000)
    bus, far = opened(settings(one)), opened(settings(other))
    sent: dict[bytes, int] = {}
    with slow(one, frames=1000):
        for number in range(400):
            now = CLOCK.now()
            data = number.to_bytes(2, "big")
            sent[data] = now
            bus.write(now, [CanFrame(1, data)])
            bus.read(CLOCK.now())
            time.sleep(0.005)
        reported(bus, SECOND // 10)  # the last one may wait for room
        received = receive(far, 400, SECOND // 2)
    assert bus.dropped > 150  # sleeping 5 ms may take 8
    ages = [p.t - sent[p.frame.data] for p in received if isinstance(p.frame, CanFrame)]
    assert len(ages) == 400 - bus.dropped
    assert max(ages) < 20 * PATIENCE
    newest = received[-1].frame
    assert isinstance(newest, CanFrame)
    assert newest.data == (399).to_bytes(2, "big")


@pytest.mark.controllers
def test_what_waits_in_the_kernel_goes_with_the_interface(
    controllers: Controllers, opened: Open, caplog: pytest.LogCaptureFixture
) -> None:
    """An interface that goes down and comes up delivers nothing from before; it is said how much that was."""
    one, other = controllers(1_000_000)
    bus, far = opened(settings(one)), opened(settings(other))
    with slow(one, frames=1000):
        bus.write(CLOCK.now(), [CanFrame(number) for number in range(60)])
        ip("link", "set", one, "down")
        reported(bus, SECOND // 2)
        before = receive(far, 60, SECOND // 5)
        ip("link", "set", one, "up")
        reported(bus, SECOND // 2)
        bus.write(CLOCK.now(), [CanFrame(0x700)])
        after = receive(far, 60, SECOND // 2)
    assert len(before) < 30
    assert frames_of(after) == [CanFrame(0x700)]
    assert f"{bus.name}: up to 60 frames that waited in the kernel's queue were purged" in caplog.text
