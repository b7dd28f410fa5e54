"""The bus on an I²C adapter: a chip behind the kernel's call; why an adapter cannot be opened. There is no
such adapter on a test machine, nor i2c-stub, which knows transfers of SMBus only."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import select
import stat
import threading
from pathlib import Path

import pytest

from gateway.buses import open_bus
from gateway.buses.i2c import I2C_RDWR, MOST_FAILURES, I2cBus, _reason
from gateway.config import parse_robot
from gateway.core.clock import SimulatedClock
from gateway.core.robot import BusSettings
from gateway.errors import BusError, ConfigError
from protocols.frames import BusState, Packet
from protocols.messages import MILLISECOND, SECOND, Nanos
from protocols.pca9685 import table as pt
from protocols.pca9685.memory import output_of
from protocols.pca9685.options import Options, Settings
from protocols.plugin import Device
from protocols.toolkit import i2c

SETTINGS = BusSettings("i2c1", "i2c", "i2c:/dev/i2c-1", bitrate=400_000, baudrate=400_000)
PATIENCE = 60.0
"""s"""


class Adapter:
    """What the kernel does with I2C_RDWR: one chip at 0x40, by its registers."""

    def __init__(self) -> None:
        self.chip = output_of(Device("servo", 0, Options(), Settings()))
        self.fails = 0
        """errno of every transfer"""
        self.seen: list[tuple[int, bytes, int]] = []
        self.begun = threading.Event()
        self.goes_on = threading.Event()
        self.goes_on.set()

    def __call__(self, _file: int, request: int, argument: object) -> int:
        assert request == I2C_RDWR
        self.begun.set()
        assert self.goes_on.wait(PATIENCE)
        transfer = argument
        count = transfer.count  # type: ignore[attr-defined]
        parts = [transfer.messages[at] for at in range(count)]  # type: ignore[attr-defined]
        assert [part.flags for part in parts] == [0, 1][:count]
        written = ctypes.string_at(parts[0].data, parts[0].length)
        reads = parts[1].length if count > 1 else 0
        self.seen.append((parts[0].address, written, reads))
        if self.fails or parts[0].address != 0x40:
            raise OSError(self.fails or errno.ENXIO, os.strerror(self.fails or errno.ENXIO))
        self.chip.obey(i2c.transfer(0x40, written, reads))
        if reads:
            ctypes.memmove(parts[1].data, self.chip.read(reads), reads)
        return count  # type: ignore[no-any-return]


def made(adapter: Adapter) -> I2cBus:
    return I2cBus(SETTINGS, os.open(os.devnull, os.O_RDWR), adapter)


def until(bus: I2cBus, count: int, now: Nanos = SECOND) -> tuple[list[BusState], list[bytes]]:
    """Read until so many answers have come."""
    states: list[BusState] = []
    packets: list[Packet] = []
    while len(packets) < count:
        files, _ = bus.wakes(now)
        assert select.select(files, [], [], PATIENCE)[0], "nothing came"
        changes, more = bus.read(now)
        states, packets = [*states, *changes], [*packets, *more]
    assert all(packet.bus == "i2c1" and packet.t == now for packet in packets)
    return states, [packet.frame for packet in packets if isinstance(packet.frame, bytes)]


def test_transfers_are_carried_out_in_order_and_answered() -> None:
    adapter = Adapter()
    bus = made(adapter)
    wake = i2c.transfer(0x40, bytes((pt.MODE1, pt.AWAKE)))
    frames = [wake, i2c.transfer(0x40, pt.led(0, 0, 307)), i2c.transfer(0x40, bytes((pt.LED0,)), 4)]
    bus.write(SECOND, frames)
    states, answers = until(bus, 3)
    assert (states, answers[:2]) == ([], [i2c.outcome(each, i2c.DONE) for each in frames[:2]])
    assert answers[2] == i2c.outcome(frames[2], i2c.DONE, bytes((0, 0, 0x33, 0x01)))
    assert adapter.seen == [(0x40, b"\x00\x20", 0), (0x40, pt.led(0, 0, 307), 0), (0x40, b"\x06", 4)]
    assert adapter.chip.high() == 307
    assert bus.read(SECOND) == ([], [])
    bus.close()


def test_a_chip_that_is_not_there_is_an_answer() -> None:
    bus = made(Adapter())
    read = i2c.transfer(0x41, b"\x00", 1)
    bus.write(SECOND, [read])
    assert until(bus, 1) == ([], [i2c.outcome(read, i2c.NO_CHIP)])
    bus.close()


def test_what_comes_late_is_not_taken_for_the_answer_to_another_transfer() -> None:
    first, second = i2c.transfer(0x40, b"\x06", 4), i2c.transfer(0x40, b"\x0e", 4)
    late, answer = i2c.outcome(first, i2c.DONE, b"\0\0\0\x10"), i2c.outcome(second, i2c.DONE, b"\0\0\x33\1")
    assert answer == bytes((0x40, i2c.DONE, 0x15, 0, 0, 0x33, 1))
    assert i2c.find(second, late) is None
    assert i2c.find(second, late + answer) == (len(late), len(late + answer))
    assert i2c.find(first, late) == (0, len(late))


def test_a_bus_that_hangs_is_off_and_back_when_a_chip_answers(caplog: pytest.LogCaptureFixture) -> None:
    adapter = Adapter()
    adapter.fails = errno.ETIMEDOUT
    bus = made(adapter)
    read = i2c.transfer(0x40, b"\x00", 1)
    bus.write(SECOND, [read] * MOST_FAILURES)
    assert until(bus, MOST_FAILURES) == ([BusState.OFF], [i2c.outcome(read, i2c.FAILED)] * MOST_FAILURES)
    (text,) = [record.getMessage() for record in caplog.records]
    assert text.startswith(
        "i2c1: it hangs ([Errno 110] Connection timed out): a chip or a short holds SDA or"
    )
    adapter.fails = 0
    bus.write(SECOND, [read])
    assert until(bus, 1) == ([BusState.BACK], [i2c.outcome(read, i2c.DONE, b"\x11")])
    bus.close()


def test_what_waited_behind_a_transfer_that_hung_is_not_carried_out_later() -> None:
    """A set-point must not go out when nobody stands behind it any more; reading never waits."""
    adapter = Adapter()
    adapter.goes_on.clear()
    bus = made(adapter)
    bus.write(SECOND, [i2c.transfer(0x40, b"\x00", 1), i2c.transfer(0x40, pt.led(0, 0, 307))])
    later = 2 * SECOND
    assert adapter.begun.wait(PATIENCE)
    assert bus.read(later) == ([], [])
    adapter.goes_on.set()
    until(bus, 1, later)
    bus.write(later, [i2c.transfer(0x40, b"\x00", 1)])
    until(bus, 1, later)
    assert [written for _, written, _ in adapter.seen] == [b"\x00", b"\x00"]
    bus.close()


def test_closing_carries_out_what_waits() -> None:
    adapter = Adapter()
    bus = made(adapter)
    bus.write(SECOND, [i2c.transfer(0x40, bytes((pt.MODE1, pt.AWAKE)))] * 3)
    bus.close()
    assert len(adapter.seen) == 3


def test_a_transfer_that_hangs_beyond_the_close_ends_on_its_own_file_with_what_was_sent_last() -> None:
    adapter = Adapter()
    adapter.goes_on.clear()
    file = os.open(os.devnull, os.O_RDWR)
    bus = I2cBus(SETTINGS, file, adapter)
    bus.write(SECOND, [i2c.transfer(0x40, b"\x00", 1), i2c.transfer(0x40, pt.led(0, 0, 0))])
    assert adapter.begun.wait(PATIENCE)
    bus.close()
    os.fstat(file)  # it is nobody else's
    adapter.goes_on.set()
    bus._thread.join(PATIENCE)
    assert adapter.seen[-1] == (0x40, pt.led(0, 0, 0), 0)
    os.close(file)


def test_what_is_queued_is_bounded() -> None:
    adapter = Adapter()
    adapter.goes_on.clear()
    bus = made(adapter)
    for at in range(100):
        bus.write(SECOND + at * MILLISECOND // 10, [i2c.transfer(0x40, b"\x00", 1)] * 10)
    adapter.goes_on.set()
    bus.close()
    assert len(adapter.seen) <= 66


def test_an_adapter_that_is_not_there_says_how_to_get_one() -> None:
    with pytest.raises(BusError) as told:
        open_bus(SETTINGS, SimulatedClock())
    text = str(told.value)
    assert text.startswith(
        "bus 'i2c1' cannot be opened as 'i2c:/dev/i2c-1': there is no /dev/i2c-1. I²C adapters"
    )
    assert "sudo modprobe i2c-dev" in text


def test_what_is_no_adapter_is_refused() -> None:
    with pytest.raises(BusError, match="/dev/null is no I²C adapter for this"):
        open_bus(BusSettings("i2c1", "i2c", "i2c:/dev/null"), SimulatedClock())


def test_no_permission_names_the_group(tmp_path: Path) -> None:
    path = tmp_path / "i2c-1"
    path.touch()
    path.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IWGRP)
    text = _reason(str(path), PermissionError(errno.EACCES, "Permission denied"))
    assert text.startswith(f"no permission: {path} is ")
    assert "group" in text
    there = _reason("/dev/i2c-9", FileNotFoundError(errno.ENOENT, "No such file"), tmp_path)
    assert f"I²C adapters of this machine: {path}." in there


BUS = """
name = "head"
rate_hz = 100
world = "bench"
[buses.i2c1]
kind = "i2c"
bitrate = 400_000
interface = "twin"
[motors.pan]
protocol = "pca9685"
bus = "i2c1"
address = 0
gear = 1.0
limits = { velocity = 4.0, acceleration = 40.0, torque = 1.0, position = [-0.7, 0.7] }
[brain]
body = "joints"
[brain.joints]
motors = ["pan"]
"""


def test_an_i2c_bus_in_a_robot_file() -> None:
    bus = parse_robot(BUS).buses["i2c1"]
    assert (bus.kind, bus.bitrate, bus.baudrate, bus.carries_bytes) == ("i2c", 400_000, 400_000, True)
    assert bus.line == "asked"


@pytest.mark.parametrize(
    ("part", "instead", "wrong"),
    [
        ('interface = "twin"', 'interface = "serial:/dev/ttyUSB0"', 'expected "i2c:PATH", such as'),
        ('interface = "twin"', 'interface = "i2c"', 'such as "i2c:/dev/i2c-1"'),
        ("bitrate = 400_000", "baudrate = 400_000", "a bus of kind 'i2c' has no baudrate; expected bitrate"),
        (
            "bitrate = 400_000",
            "bitrate = 400_000\ntransmit_queue = 5",
            "an I²C bus has no queue of CAN frames",
        ),
        ("bitrate = 400_000", 'bitrate = 400_000\necho = "no"', "a bus of kind 'i2c' is no serial line"),
        ('kind = "i2c"\nbitrate', 'kind = "serial"\nbaudrate', "pca9685"),
        ('protocol = "pca9685"', 'protocol = "maestro"', "maestro"),
    ],
)
def test_what_is_wrong_with_one_is_said(part: str, instead: str, wrong: str) -> None:
    assert part in BUS
    with pytest.raises(ConfigError, match=re.escape(wrong)):
        parse_robot(BUS.replace(part, instead))
