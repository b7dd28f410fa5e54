"""motorbridge 0.5.6 as a client of twins, over a pseudo-terminal: Damiao motors by its `dm-serial`, behind
our emulated adapter; others, which it refuses there, as if behind a microcontroller, by its `mcu-serial`.
"""

from __future__ import annotations

import os
import struct
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from select import select

import motorbridge
from motorbridge.errors import CallError

from gateway.buses.adapters.dm_serial import EmulatedAdapter
from protocols.frames import EXTENDED_BIT, CanFrame
from protocols.messages import MILLISECOND, Feedback, Nanos
from protocols.plugin import Twin
from protocols.toolkit.serial import crc
from tests.gateway.processes import PATIENCE, eventually

CRC8 = crc(8, 0x07, reflected=False)
INERTIA = 0.01
"""kg·m² of the shaft"""
WAIT_MS = round(PATIENCE * 1e3)
"""ms that it waits for an answer: its own 1000 are too few beside what else the machine has to do"""


class Bench:
    """One twin and its shaft. Time is that of its frames: two milliseconds each."""

    def __init__(self, twin: Twin, name: str) -> None:
        self.twin, self.name, self.now = twin, name, 0
        self.position = self.velocity = self.torque = 0.0
        self.received: list[CanFrame] = []
        self.step()

    def exchange(self, frame: CanFrame) -> list[CanFrame]:
        """Return what the twin answers."""
        self.twin.receive(self.now, frame)
        answers = self.step() + self.step()
        self.received.append(frame)  # who waits for it finds it done
        return answers

    def step(self) -> list[CanFrame]:
        """Let a millisecond pass."""
        self.now += MILLISECOND
        truth = Feedback(self.name, self.now, self.position, self.velocity)
        (torque,), frames = self.twin.step(self.now, [truth])
        self.torque = torque.torque
        self.velocity += self.torque / INERTIA * 1e-3
        self.position += self.velocity * 1e-3
        return [frame for frame in frames if isinstance(frame, CanFrame)]


class Microcontroller:
    """A frame is A5, length, id (bit 31: 29 bits), data, CRC-8 of these three, 5A, both ways."""

    def __init__(self) -> None:
        self._held = b""

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        frames = []
        self._held += data
        while len(self._held) > 1 and len(self._held) >= 8 + self._held[1]:
            size, number = struct.unpack("<xBI", self._held[:6])
            frame = CanFrame(number & ~EXTENDED_BIT, self._held[6 : 6 + size], bool(number & EXTENDED_BIT))
            assert self._held.startswith(self.report(0, frame)), self._held.hex(" ")
            self._held = self._held[8 + size :]
            frames.append(frame)
        return frames, b""

    def report(self, t: Nanos, frame: CanFrame) -> bytes:
        body = struct.pack("<BI", len(frame.data), frame.id | EXTENDED_BIT * frame.extended) + frame.data
        return b"\xa5" + body + bytes((CRC8(body), 0x5A))


def _serve(
    line: int, bench: Bench, adapter: EmulatedAdapter | Microcontroller, stop: threading.Event
) -> None:
    """Answer until there is nothing more after the end."""
    while True:
        over = stop.is_set()
        if not select([line], [], [], 0.01)[0]:
            if over:
                return
            continue
        frames, replies = adapter.feed(os.read(line, 4096))
        answers = [answer for frame in frames for answer in bench.exchange(frame)]
        os.write(line, replies + b"".join(adapter.report(bench.now, answer) for answer in answers))


@contextmanager
def connected(bench: Bench, *, dm_serial: bool = False) -> Iterator[motorbridge.Controller]:
    """Connect motorbridge to a twin; what it sends is answered as long as this lasts."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    stop = threading.Event()
    adapter = EmulatedAdapter(1_000_000) if dm_serial else Microcontroller()
    server = threading.Thread(target=_serve, args=(ours, bench, adapter, stop))
    server.start()
    connect = motorbridge.Controller.from_dm_serial if dm_serial else motorbridge.Controller.from_mcu_serial
    controller = connect(os.ttyname(theirs))
    try:
        yield controller
    finally:
        controller.close()
        stop.set()
        server.join()
        os.close(theirs)
        os.close(ours)


def acknowledged(act: Callable[[], object]) -> None:
    """Do something until it is acknowledged: for some answers it waits 50 ms, whatever it is told."""

    def done() -> bool:
        try:
            act()
        except CallError:
            return False
        return True

    assert eventually(done)


def set_mode(motor: motorbridge.Motor, mode: motorbridge.Mode) -> None:
    """Ask for a mode until it is set."""
    acknowledged(lambda: motor.ensure_mode(mode, WAIT_MS))


def received(bench: Bench, count: int, act: Callable[[], None]) -> list[CanFrame]:
    """Do something, and return the frames that arrive for it, once there are as many as this."""
    before = len(bench.received)
    acknowledged(act)
    assert eventually(lambda: len(bench.received) - before >= count)
    return bench.received[before:]


def drive(bench: Bench, act: Callable[[], None], count: int = 500) -> None:
    """Do something as often, ten times between waits: more would not fit into the line."""

    def ten_times() -> None:
        for _ in range(10):
            act()

    for _ in range(count // 10):
        received(bench, 10, ten_times)
