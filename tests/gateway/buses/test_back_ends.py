"""The back ends of python-can: those on a serial port, with a device on a pty, and one that fails on demand.

None keeps the bus waiting, and whatever it raises is a state of the bus."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import can
import pytest

from gateway.buses.can import CanBus, open_can
from gateway.buses.interfaces import NEVER_WAIT, waits
from gateway.buses.threaded import MOST_FAILURES, MOST_RECEIVED, MOST_TO_SEND, ThreadedInterface
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND
from tests.gateway.buses.adapter_helpers import frames_of, poll, raw_pty

FRAME, NEXT = CanFrame(0x123, b"\x01\x02\x03"), CanFrame(0x124, b"\x04")


def settings_of(kind: str, path: str) -> BusSettings:
    return BusSettings("can0", "can", f"{kind}:{path}", 1_000_000)


def serial(frame: CanFrame) -> bytes:
    """As python-can documents its interface "serial": time, length, id, data."""
    return b"\xaa" + struct.pack("<IBI", 0, len(frame.data), frame.id) + frame.data + b"\xbb"


def seeedstudio(frame: CanFrame) -> bytes:
    """As the USB-CAN analyzer sends it: type and length, id, data."""
    return struct.pack("<BBH", 0xAA, 0xC0 | len(frame.data), frame.id) + frame.data + b"\x55"


def robotell(frame: CanFrame) -> bytes:
    """As the adapter sends it: id, data, length, channel, format, type, checksum."""
    body = struct.pack("<I8sBBBB", frame.id, frame.data, len(frame.data), 0, 0, 0)
    return b"\xaa\xaa" + body + bytes([sum(body) & 0xFF]) + b"\x55\x55"


ENCODE = {"serial": serial, "seeedstudio": seeedstudio, "robotell": robotell}
on_ports = pytest.mark.parametrize("kind", list(ENCODE))


@pytest.fixture
def line(kind: str, tmp_path: Path) -> Iterator[tuple[CanBus, int, Path]]:
    """The bus, the device's end, and the link by which it is opened."""
    device, host = raw_pty()
    link = tmp_path / "adapter"
    link.symlink_to(os.ttyname(host))
    with closing(open_can(settings_of(kind, str(link)), SimulatedClock())) as bus:
        os.close(host)
        yield bus, device, link


@on_ports
def test_half_a_frame_delays_what_follows_and_no_more(kind: str, line: tuple[CanBus, int, Path]) -> None:
    bus, device, _ = line
    os.write(device, ENCODE[kind](FRAME))
    assert frames_of(bus, 0, 1) == [FRAME]
    os.write(device, ENCODE[kind](FRAME)[:6])
    if kind != "robotell":  # the others wait 0.1 s for the rest
        poll(lambda: bus.read(0) == ([], []) and bus.bad)
    os.write(device, 3 * ENCODE[kind](NEXT))
    assert set(frames_of(bus, 0, 1)) == {NEXT}
    assert bus.read(0)[0] == []


@pytest.mark.parametrize("kind", ["serial", "seeedstudio"])  # robotell takes 3 s to open
def test_frames_are_sent_and_a_port_that_vanishes_is_gone_and_opened_again(
    kind: str, line: tuple[CanBus, int, Path]
) -> None:
    bus, device, link = line
    bus.write(0, [FRAME])
    sent = b""
    while FRAME.data not in sent:
        sent += os.read(device, 1000)
    os.close(device)
    bus.write(0, [FRAME])  # one of them notices it in this way alone
    assert poll(lambda: list(bus.read(0)[0])) == [BusState.GONE]
    device, host = raw_pty()
    link.unlink()
    link.symlink_to(os.ttyname(host))
    assert poll(lambda: list(bus.read(SECOND)[0])) == [BusState.BACK]
    os.write(device, ENCODE[kind](NEXT))
    assert frames_of(bus, 0, 1) == [NEXT]
    os.close(device)
    os.close(host)


@pytest.mark.parametrize("kind", sorted(can.VALID_INTERFACES))
def test_what_cannot_be_opened_is_a_sentence_whatever_it_raises(kind: str) -> None:
    """No vendor's library is installed here; one of them raises NameError."""
    if kind in ("virtual", "udp_multicast"):
        return
    with pytest.raises(BusError, match=f"bus 'can0' cannot be opened as '{kind}:there-is-none'"):
        open_can(settings_of(kind, "there-is-none"), SimulatedClock())


def test_what_was_not_measured_has_threads() -> None:
    direct = {kind for kind in can.VALID_INTERFACES if not waits(settings_of(kind, "0"))}
    assert direct == {"slcan", "socketcan", "udp_multicast", "virtual"} < set(NEVER_WAIT)


class Stubborn(can.BusABC):
    """A back end that waits for ever, or raises, as told."""

    def __init__(self) -> None:
        super().__init__(channel="x")
        self.failure: Exception | None = None
        self.incoming: list[can.Message] = []
        self.sent: list[int] = []
        self.go_on = threading.Event()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.go_on.wait()
        if self.failure is not None:
            raise self.failure
        self.sent.append(msg.arbitration_id)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.failure is not None:
            raise self.failure
        if self.incoming:
            return self.incoming.pop(0), True
        self.go_on.wait(timeout)
        return None, True


@pytest.fixture
def stubborn() -> Iterator[tuple[CanBus, Stubborn]]:
    raw = Stubborn()
    bus = CanBus(settings_of("seeedstudio", "there-is-none"), SimulatedClock(), ThreadedInterface(raw))
    yield bus, raw
    raw.go_on.set()
    bus.close()


def test_a_back_end_that_takes_nothing_keeps_nobody_waiting_and_sends_nothing_old(
    stubborn: tuple[CanBus, Stubborn],
) -> None:
    bus, raw = stubborn
    for number in range(400):
        bus.write(number * MILLISECOND, [CanFrame(0x100 + number)])
        bus.read(number * MILLISECOND)
    raw.go_on.set()
    poll(lambda: raw.sent[-1:] == [0x100 + 399] or bus.read(400 * MILLISECOND)[1])
    assert len(raw.sent) < 400 - MOST_TO_SEND
    assert bus.read(SECOND)[0] == [BusState.UP]


@pytest.mark.parametrize(
    "failure", [NameError("x"), struct.error("x"), can.CanOperationError("x"), OSError("x")]
)
def test_whatever_a_back_end_raises_it_is_gone_in_the_end(
    failure: Exception, stubborn: tuple[CanBus, Stubborn]
) -> None:
    bus, raw = stubborn
    raw.failure = failure
    assert poll(lambda: list(bus.read(0)[0])) == [BusState.GONE]
    counted = 0 if isinstance(failure, can.CanError | OSError) else MOST_FAILURES
    assert bus.bad == counted


def test_what_comes_faster_than_it_is_taken_is_counted() -> None:
    raw = Stubborn()
    raw.incoming = [can.Message(arbitration_id=number) for number in range(MOST_RECEIVED + 100)]
    interface = ThreadedInterface(raw)
    poll(lambda: not raw.incoming)
    raw.go_on.set()
    interface.shutdown()
    first = interface.recv(0)
    assert first is not None
    assert (first.arbitration_id, interface.missed) == (100, 100)


def test_what_came_faster_than_it_was_taken_is_told_once(
    stubborn: tuple[CanBus, Stubborn], caplog: pytest.LogCaptureFixture
) -> None:
    bus, raw = stubborn
    raw.incoming = [can.Message(arbitration_id=number) for number in range(MOST_RECEIVED + 100)]
    poll(lambda: not raw.incoming)
    raw.go_on.set()
    poll(lambda: bus.read(0)[1] or caplog.messages)
    assert caplog.messages == ["can0: 100 frames were lost: they came faster than they were read"]
    for number in range(1, 4):
        bus.read(number * SECOND)
    assert len(caplog.messages) == 1
