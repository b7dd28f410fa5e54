"""The vendor's dynamixel-sdk 4.1.0 as client of the twins over a pty, which they answer whenever it looks for
bytes. Its sender does not stuff."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import dynamixel_sdk as sdk
import pytest

from gateway.buses.adapters.pty import Pty
from protocols.dynamixel import plugin
from protocols.dynamixel.options import Options, Settings
from protocols.dynamixel.table import FAULTS
from protocols.dynamixel.twin import DynamixelTwin
from protocols.messages import MILLISECOND, Feedback, Mode, Nanos, seconds
from protocols.plugin import Device

X1, X2, P = 1, 2, 9


STEP: Nanos = 100_000


@dataclass
class Line:
    """Twins on one line: each hears the host and the others. They run when the client looks for bytes."""

    twins: dict[int, DynamixelTwin]
    pty: Pty = field(default_factory=Pty)
    now: Nanos = 0
    position: dict[int, float] = field(default_factory=dict)

    def run(self) -> None:
        """Go on by one step."""
        self.now += STEP
        data = self.pty.read()
        for twin in self.twins.values():
            twin.receive(self.now, data)
        for number, twin in self.twins.items():
            place = self.position.get(number, 0.0)
            torques, frames = twin.step(self.now, [Feedback(twin.device.name, self.now, place, 0.0)])
            self.position[number] = place + torques[0].torque * 20.0 * seconds(STEP)
            for frame in frames:
                assert isinstance(frame, bytes)
                self.pty.write(frame)
                for other in self.twins.values():
                    if other is not twin:
                        other.receive(self.now, frame)

    def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds * MILLISECOND // STEP):
            self.run()


class Port(sdk.PortHandler):  # type: ignore[misc]
    """The vendor's port, in the line's time."""

    def __init__(self, line: Line) -> None:
        self.line = line
        super().__init__(line.pty.path)

    def readPort(self, length: int) -> bytes:  # noqa: N802 -- the vendor's name
        self.line.run()
        read: bytes = super().readPort(length)
        return read

    def getCurrentTime(self) -> float:  # noqa: N802
        return self.line.now / MILLISECOND


def twin(number: int, model: str, **settings: int) -> DynamixelTwin:
    device = Device(f"m{number}", number, Options(model=model), Settings(**settings))
    made = plugin.twin(device, 0)
    assert isinstance(made, DynamixelTwin)
    return made


@pytest.fixture
def line() -> Iterator[Line]:
    models = {X1: "XM430-W350", X2: "XL330-M288", P: "PH42-020-S300"}
    made = Line({number: twin(number, model) for number, model in models.items()})
    yield made
    made.pty.close()


@pytest.fixture
def port(line: Line) -> Iterator[Port]:
    opened = Port(line)
    assert opened.openPort()
    assert opened.setBaudRate(1_000_000)
    line.wait(10)
    yield opened
    opened.closePort()


HANDLER = sdk.PacketHandler(2.0)
OK = sdk.COMM_SUCCESS


def write(port: Port, number: int, at: int, size: int, value: int) -> tuple[int, int]:
    call = {1: HANDLER.write1ByteTxRx, 2: HANDLER.write2ByteTxRx, 4: HANDLER.write4ByteTxRx}[size]
    result: tuple[int, int] = call(port, number, at, value)
    return result


def test_it_finds_them(port: Port) -> None:
    assert HANDLER.ping(port, X1) == (1020, OK, 0)
    assert HANDLER.ping(port, 5)[1] == sdk.COMM_RX_TIMEOUT
    found, result = HANDLER.broadcastPing(port)
    assert (found, result) == ({X1: [1020, 46], X2: [1200, 46], P: [2000, 46]}, OK)


def test_it_reads_and_writes(port: Port, line: Line) -> None:
    assert HANDLER.read4ByteTxRx(port, X1, 132) == (2048, OK, 0)
    assert HANDLER.read2ByteTxRx(port, X1, 144) == (120, OK, 0)
    assert write(port, X1, 11, 1, 1) == (OK, 0)
    assert write(port, X1, 64, 1, 1) == (OK, 0)
    assert line.twins[X1].mode is Mode.ARMED
    assert write(port, X1, 104, 4, 100) == (OK, 0)
    line.wait(50)
    assert line.position[X1] > 0.0
    assert HANDLER.read1ByteTxRx(port, X1, 11) == (1, OK, 0)
    errors = [
        (write(port, X1, 11, 1, 3), "Writing or Reading is not available to target address!"),
        (write(port, X1, 104, 4, 500), "The data value exceeds the limit value!"),
        (write(port, X1, 64, 1, 7), "The data value is out of range!"),
        (write(port, X1, 132, 4, 7), "Writing or Reading is not available to target address!"),
    ]
    for (result, error), text in errors:
        assert (result, HANDLER.getRxPacketError(error)) == (OK, f"[RxPacketError] {text}")
    assert write(port, X1, 64, 1, 0) == (OK, 0)
    assert line.twins[X1].mode is Mode.READY


def test_another_id_is_answered_for_at_the_old_one(port: Port) -> None:
    assert write(port, X1, 7, 1, 33) == (OK, 0)
    assert HANDLER.ping(port, 33) == (1020, OK, 0)
    assert HANDLER.ping(port, X1)[1] == sdk.COMM_RX_TIMEOUT


def test_all_at_once(port: Port) -> None:
    for number in (X1, X2):
        assert write(port, number, 64, 1, 1) == (OK, 0)
    goals = {X1: 3000, X2: 1000}
    writes = sdk.GroupSyncWrite(port, HANDLER, 116, 4)
    for number, goal in goals.items():
        writes.addParam(number, list(goal.to_bytes(4, "little")))
    assert writes.txPacket() == OK
    for fast in (False, True):
        reads = sdk.GroupSyncRead(port, HANDLER, 116, 4)
        for number in goals:
            reads.addParam(number)
        assert (reads.fastSyncRead if fast else reads.txRxPacket)() == OK
        assert {number: reads.getData(number, 116, 4) for number in goals} == goals


def test_of_several_kinds_at_once(port: Port) -> None:
    writes = sdk.GroupBulkWrite(port, HANDLER)
    writes.addParam(X1, 112, 4, [150, 0, 0, 0])
    writes.addParam(P, 560, 4, [0, 4, 0, 0])
    assert writes.txPacket() == OK
    for fast in (False, True):
        reads = sdk.GroupBulkRead(port, HANDLER)
        reads.addParam(X1, 112, 4)
        reads.addParam(P, 560, 4)
        reads.addParam(X2, 146, 1)
        assert (reads.fastBulkRead if fast else reads.txRxPacket)() == OK
        read = [reads.getData(X1, 112, 4), reads.getData(P, 560, 4), reads.getData(X2, 146, 1)]
        assert read == [150, 1024, 30]


def test_indirect_addresses(port: Port) -> None:
    for k, at in enumerate((144, 145, 146, 64)):
        assert write(port, X1, 168 + 2 * k, 2, at) == (OK, 0)
    assert HANDLER.readTxRx(port, X1, 224, 4)[:2] == ([120, 0, 30, 0], OK)
    assert write(port, X1, 227, 1, 1) == (OK, 0)
    assert HANDLER.read1ByteTxRx(port, X1, 64) == (1, OK, 0)


def test_a_write_waits_for_its_action(port: Port) -> None:
    assert HANDLER.regWriteTxRx(port, X1, 108, 4, [20, 0, 0, 0]) == (OK, 0)
    assert (HANDLER.read4ByteTxRx(port, X1, 108)[0], HANDLER.read1ByteTxRx(port, X1, 69)[0]) == (0, 1)
    HANDLER.action(port, 254)
    assert (HANDLER.read4ByteTxRx(port, X1, 108)[0], HANDLER.read1ByteTxRx(port, X1, 69)[0]) == (20, 0)


def test_a_fault_ends_by_a_restart(port: Port, line: Line) -> None:
    assert write(port, X1, 64, 1, 1) == (OK, 0)
    line.twins[X1].provoke(min(FAULTS))
    _, result, error = HANDLER.read1ByteTxRx(port, X1, 64)
    assert (result, error) == (OK, 0x80)
    assert HANDLER.read1ByteTxRx(port, X1, 70)[0] == min(FAULTS)
    assert write(port, X1, 64, 1, 1)[1] & 0x7F == 1
    assert line.twins[X1].mode is Mode.FAULT
    assert HANDLER.reboot(port, X1) == (OK, 0x80)
    assert HANDLER.ping(port, X1)[1] == sdk.COMM_RX_TIMEOUT
    line.wait(350)
    assert HANDLER.ping(port, X1) == (1020, OK, 0)


def test_what_would_lose_it_is_refused(port: Port) -> None:
    for error in (HANDLER.factoryReset(port, X1, 0xFF)[1], HANDLER.clearMultiTurn(port, X1)[1]):
        assert HANDLER.getRxPacketError(error).endswith("Undefined instruction or incorrect instruction!")
    assert HANDLER.ping(port, X1) == (1020, OK, 0)


@pytest.mark.parametrize(("level", "answers"), [(0, (True, False, False)), (1, (True, True, False))])
def test_status_return_level(port: Port, level: int, answers: tuple[bool, ...]) -> None:
    write(port, X1, 68, 1, level)
    pinged, read = HANDLER.ping(port, X1)[1], HANDLER.read1ByteTxRx(port, X1, 146)[1]
    written = write(port, X1, 65, 1, 1)[0]
    assert tuple(each == OK for each in (pinged, read, written)) == answers


def test_it_unstuffs_what_we_stuff(port: Port, line: Line) -> None:
    line.twins[X1].memory.put("Profile_Velocity", 0xFDFFFF)
    assert HANDLER.read4ByteTxRx(port, X1, 112) == (0xFDFFFF, OK, 0)


def test_what_it_does_not_stuff_is_not_obeyed(port: Port) -> None:
    assert write(port, X1, 112, 4, 0xFDFFFF)[0] == sdk.COMM_RX_TIMEOUT
    assert HANDLER.read4ByteTxRx(port, X1, 112) == (0, OK, 0)
