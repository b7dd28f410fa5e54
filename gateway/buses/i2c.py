"""The bus on an I²C adapter of Linux (i2c-dev): transfers, one at a time, each answered.

Rules. Opening raises a BusError with what is missing; afterwards nothing is raised. The kernel carries out a
transfer while the caller waits: so a thread does that, and nothing here waits. What has waited for longer
than `STALE` is not carried out any more. A transfer that nobody acknowledges is an answer; one that the
adapter cannot carry out, since the bus hangs, is one, too, and after `MOST_FAILURES` in a row the bus is
off, until one is acknowledged again.

Source: Linux Documentation/i2c/dev-interface.rst, include/uapi/linux/i2c-dev.h and i2c.h, fault-codes.rst.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import logging
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from gateway.buses.queues import STALE
from gateway.buses.serial.opening import forbidden
from gateway.buses.troubles import Trouble, of_writes
from gateway.core.robot import BusSettings
from gateway.errors import BusError
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Nanos
from protocols.toolkit import i2c

log = logging.getLogger("gateway")

I2C_RETRIES, I2C_TIMEOUT, I2C_FUNCS, I2C_RDWR = 0x0701, 0x0702, 0x0705, 0x0707
FUNC_I2C = 1
"""The adapter can do transfers of any bytes, not only those of SMBus"""
M_RD = 1
TIMEOUT = 2
"""10 ms: how long the kernel waits for a bus that hangs"""
NOT_ACKNOWLEDGED = frozenset({errno.ENXIO, errno.EREMOTEIO})
MOST_FAILURES = 3
MOST_WAITING = 64
DEVICES = Path("/dev")
HANGS = (
    "it hangs (%s): a chip or a short holds SDA or SCL down; check the pull-ups, switch the chips off and on"
)


class _Message(ctypes.Structure):
    """struct i2c_msg"""

    _fields_ = (
        ("address", ctypes.c_uint16),
        ("flags", ctypes.c_uint16),
        ("length", ctypes.c_uint16),
        ("data", ctypes.c_void_p),
    )


class _Transfer(ctypes.Structure):
    """struct i2c_rdwr_ioctl_data"""

    _fields_ = (("messages", ctypes.POINTER(_Message)), ("count", ctypes.c_uint32))


Ioctl: TypeAlias = Callable[[int, int, Any], Any]


class I2cBus:
    """One adapter. `ioctl` is the kernel's."""

    def __init__(self, settings: BusSettings, file: int, ioctl: Ioctl = fcntl.ioctl) -> None:
        self.name = settings.name
        self._file, self._ioctl = file, ioctl
        self._now: Nanos = 0
        self._waiting: deque[tuple[Nanos, bytes]] = deque()
        self._done: deque[tuple[bytes, OSError | None]] = deque()
        self.write_errors: Counter[int] = Counter()
        """How often a transfer failed with each errno; a chip that does not answer is none of these."""
        self._failures = 0
        self._dead = False
        self._changes: list[BusState] = []
        self._wake = threading.Semaphore(0)
        self._ends = False
        self._readable, self._written = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Return the state changes, and the outcomes of transfers since it was read last."""
        self._now = now
        with suppress(BlockingIOError):
            os.read(self._readable, 4096)
        packets: list[Packet] = []
        while self._done:
            answer, error = self._done.popleft()
            self._note(answer, error)
            packets.append(Packet(now, self.name, answer))
        changes, self._changes = self._changes, []
        return changes, packets

    def troubles(self) -> Iterator[Trouble]:
        """Yield what transfers have failed with."""
        yield from of_writes(self.write_errors, self.name)

    def _note(self, answer: bytes, error: OSError | None) -> None:
        """Note how a transfer ended: a bus that hangs is off."""
        self._failures = self._failures + 1 if answer[1] == i2c.FAILED else 0
        if self._failures and error is not None:
            self.write_errors[error.errno or 0] += 1
        if self._failures == MOST_FAILURES and not self._dead:
            self._dead = True
            self._changes.append(BusState.OFF)
            log.warning(f"%s: {HANGS}", self.name, error)
        elif self._dead and not self._failures:
            self._dead = False
            self._changes.append(BusState.BACK)

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:  # noqa: ARG002 -- a real bus has no plan
        """Return the file that can be read when a transfer has ended."""
        return (self._readable,), None

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Give the thread transfers."""
        self._now = now
        for frame in frames:
            if isinstance(frame, bytes):
                self._waiting.append((now, frame))
                self._wake.release()
        while len(self._waiting) > MOST_WAITING:
            self._waiting.popleft()

    def close(self) -> None:
        """Carry out what waits, within a bound; then release the adapter. One that hangs beyond that keeps
        its files: their numbers would be those of the next ones that are opened."""
        self._ends = True
        self._wake.release()
        self._thread.join(0.5)
        if self._thread.is_alive():
            return
        for file in (self._readable, self._written, self._file):
            with suppress(OSError):
                os.close(file)

    # -- the thread -----------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            self._wake.acquire()
            if not self._waiting:
                if self._ends:
                    return
                continue
            given, frame = self._waiting.popleft()
            if self._now - given > STALE:
                continue
            self._done.append(self._carry_out(frame))
            with suppress(OSError):
                os.write(self._written, b"\0")

    def _carry_out(self, frame: bytes) -> tuple[bytes, OSError | None]:
        """Return the outcome of a transfer."""
        found = i2c.parse(frame)
        if found is None:
            return i2c.outcome(frame, i2c.FAILED), None
        written = ctypes.create_string_buffer(found.written, len(found.written))
        read = ctypes.create_string_buffer(max(1, found.reads))
        parts = [(0, len(found.written), written), (M_RD, found.reads, read)][: 1 + bool(found.reads)]
        messages = (_Message * len(parts))(
            *(_Message(found.address, flags, size, ctypes.addressof(data)) for flags, size, data in parts)
        )
        try:
            self._ioctl(self._file, I2C_RDWR, _Transfer(messages, len(parts)))
        except OSError as error:
            result = i2c.NO_CHIP if error.errno in NOT_ACKNOWLEDGED else i2c.FAILED
            return i2c.outcome(frame, result), error
        return i2c.outcome(frame, i2c.DONE, read.raw[: found.reads]), None


def open_i2c(settings: BusSettings) -> I2cBus:
    """Open the adapter of a bus. Raises BusError with what is missing and what helps."""
    path = settings.interface.partition(":")[2]
    head = f"bus {settings.name!r} cannot be opened as {settings.interface!r}"
    try:
        file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as error:
        raise BusError(f"{head}: {_reason(path, error)}") from error
    if why := _unfit(file):
        os.close(file)
        raise BusError(f"{head}: {path} is no I²C adapter for this: {why}")
    return I2cBus(settings, file)


def _unfit(file: int) -> str:
    """Configure an adapter; return why it cannot be used, "" if it can."""
    able = bytearray(8)
    try:
        fcntl.ioctl(file, I2C_FUNCS, able)
        fcntl.ioctl(file, I2C_RETRIES, 0)
        fcntl.ioctl(file, I2C_TIMEOUT, TIMEOUT)
    except OSError as error:
        return str(error)
    can = int.from_bytes(able, "little") & FUNC_I2C
    return "" if can else "it carries out transfers of SMBus only"


def _reason(path: str, error: OSError, devices: Path = DEVICES) -> str:
    """Return why an adapter cannot be opened, and what helps."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return forbidden(path, "i2c-dev", "i2c")
    found = ", ".join(sorted(str(each) for each in devices.glob("i2c-*"))) or "none"
    there = f"there is no {path}" if error.errno == errno.ENOENT else str(error)
    return (
        f"{there}. I²C adapters of this machine: {found}. They are there once the bus is switched on (on a "
        "Raspberry Pi dtparam=i2c_arm=on) and i2c-dev is loaded: `sudo modprobe i2c-dev`"
    )
