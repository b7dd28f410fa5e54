"""Servos on a bus of a family that nobody makes: what the toolkit does for one that a stranger adds."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any

import pytest

from protocols import messages as msg
from protocols.frames import Frame
from protocols.line import Exchange
from protocols.messages import MILLISECOND, Command, Event, Feedback, Mode, Nanos
from protocols.plugin import Device, FaultInfo, Range
from protocols.toolkit.assembly import declared
from protocols.toolkit.host import Host
from protocols.toolkit.memory_map import GoalRegister, MemoryMap, Values, rows
from protocols.toolkit.motor_driver import MotorDriver
from protocols.toolkit.serial import CRC8_MAXIM, Framing
from protocols.toolkit.servo import Gains
from protocols.toolkit.servo_device import BusServo, ServoDecoder, ServoMemory
from protocols.toolkit.servo_driver import Known, Motion, ServoAdapter
from protocols.toolkit.servo_packets import READ, SYNC_READ, SYNC_WRITE, Packet, ServoPackets

TABLE = MemoryMap(
    rows(
        """
0 u16 Model r|2 u8 ID|3 u8 Baud_Rate|4 u8 Level|6 m11 Homing_Offset|10 u8 Torque_Enable|11 u8 Lock
12 i16 Goal_Position|14 u16 Limit|20 i16 Position r|22 m10 Load r|24 u32 Ticks r"""
    ),
    {"who": (0, 8), "state": (10, 6), "motion": (20, 4)},
    stored=10,
    order="big",
)
ANSWERED = 0x80
STEP = 0.001
GOAL = GoalRegister("Goal_Position", msg.Position, STEP)


class Packets(ServoPackets):
    """Sync, id, size, instruction, data, CRC."""

    framing = Framing(b"\xa5\x5a", 5, lambda head: head[3], CRC8_MAXIM, 1)
    head, counted, answers = struct.Struct("<2sBBB"), 0, ANSWERED
    addresses = range(1, 33)
    overhead = 7
    place, block = struct.Struct("B"), struct.Struct("BB")
    longest = 17
    maps = (TABLE,)


PACKETS = Packets()


@dataclass(frozen=True, slots=True)
class Options:
    feedback_ms: int = 5
    offline_ms: int = 100
    table: MemoryMap = TABLE
    set_up: Mapping[str, int] = field(default_factory=lambda: {"Limit": 700})
    operating_mode: int = 0
    ampere: float = 0.0
    newton_metre: float = 0.0

    @staticmethod
    def goal_in(mode: int) -> GoalRegister:
        return GOAL


class Adapter(ServoAdapter[Known]):
    """Its set-up is a limit of 700."""

    name, kind = "made_up", Known
    packets, supply = PACKETS, "Supply"
    faults: Mapping[int, FaultInfo] = {}
    silence = MILLISECOND
    commanded = ("Goal_Position",)

    def who(self, number: int) -> Exchange:
        return self.packets.asks({number: (0, 2)}, f"{number} who", 0)

    def note(self, question: Packet, data: bytes) -> str:
        return data.hex() if question.data == b"\0\2" else ""

    def refusal(self, error: int) -> str:
        return f"error {error}" if error else ""

    def faults_in(self, host: Host[Known], error: int, values: Values) -> Collection[int] | None:
        return () if "Torque_Enable" in values else None

    def shaft(self, t: Nanos, host: Host[Known], values: Values) -> Motion | None:
        return (values["Position"] * STEP, None) if "Load" in values else None

    def wanted(self, host: Host[Known]) -> Iterable[tuple[str, Nanos]]:
        return [("state", 20 * MILLISECOND), ("motion", host.options.feedback_ms * MILLISECOND)]

    def changes(self, host: Host[Known], name: str, value: float) -> Sequence[tuple[str, float]]:
        stored = self.table(host).is_stored(name)
        return (("Lock", 0.0), (name, value), ("Lock", 1.0)) if stored else ((name, value),)

    def zeroing(self, host: Host[Known]) -> tuple[Sequence[Frame], int | None] | str:
        return (self.change(host, "Homing_Offset", 0),), 0

    def arm(self, now: Nanos, host: Host[Known], command: Command) -> Sequence[Frame]:
        wrong = host.own.different(host.own.set_up)
        self.put(host, wrong or {"Torque_Enable": 1})
        return self.ask(now, host, "state")

    def command(self, now: Nanos, host: Host[Known], command: Command) -> Sequence[Frame]:
        self.set_point(host, command)
        return ()


@dataclass(slots=True)
class Memory(ServoMemory):
    """Stored registers are written while Lock is 0 only."""

    def wrong(self, at: int, data: bytes) -> int:
        locked = at < TABLE.stored and self.get("Lock")
        return 3 if locked or not TABLE.layout(at, len(data)).whole else 0


def memory_of(device: Device) -> Memory:
    made = Memory(device.name, device.address, device.options)
    made.deliver(64, {"Model": 0x1234, "ID": device.address, "Level": 2, "Lock": 1, "Homing_Offset": -5})
    return made


class Twin(BusServo):
    faults: Mapping[int, FaultInfo] = {}
    packets = PACKETS
    level = "Level"
    who = ((0, 2),)

    def __init__(self, device: Device) -> None:
        super().__init__(device, 0, Gains(), memory_of(device))

    def present(self) -> Mapping[str, float]:
        return {
            "Position": self.encoder.position / STEP,
            "Load": -7,
            "Torque_Enable": self.mode is Mode.ARMED,
        }

    def status(self, number: int, error: int, data: bytes) -> bytes:
        return self.packets.packet(number, ANSWERED, bytes((error,)) + data)


def devices(count: int) -> list[Device]:
    return [Device(f"m{number}", number, Options(), None) for number in range(1, count + 1)]


@dataclass
class Bus:
    """Driver and twins: one exchange after the other, each answered at once."""

    twins: list[Twin]
    driver: MotorDriver[Known]
    now: Nanos = 0
    asked: list[Packet] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    whole: list[bool] = field(default_factory=list)
    """Whether each answer was found to be over when it was."""

    def step(self, *messages: Command | msg.Request, silent: Sequence[str] = ()) -> list[Packet]:
        """Go on by 5 ms; return what was sent."""
        self.now += 5 * MILLISECOND
        events, frames = self.driver.send(self.now, messages)
        self.events += events
        sent = []
        given = [frame for frame in frames if isinstance(frame, Exchange)]
        assert len(given) == len(frames)
        for frame in sorted(given, key=lambda each: each.rank):
            sent.append(PACKETS.question(frame))
            data = self._answers(frame, silent)
            if frame.answer is not None:
                self.whole.append(frame.answer.find(frame, data) == (0, len(data)))
                self.events += self.driver.answer(self.now, frame, data)
        return sent

    def _answers(self, frame: bytes, silent: Sequence[str]) -> bytes:
        data, new = b"", [frame]
        while new:
            heard, new = new, []
            for one in heard:
                for twin in self.twins:
                    twin.receive(self.now, one)
            for twin in self.twins:
                truth = [Feedback(twin.device.name, self.now, 0.1, 0.0)]
                replies = [each for each in twin.step(self.now, truth)[1] if isinstance(each, bytes)]
                new += replies if twin.device.name not in silent else []
            data += b"".join(new)
        return data

    def of(self, kind: type[Any]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]


def bus(count: int = 3) -> Bus:
    made = devices(count)
    ranges = {each.name: {"Position.position": Range(-3.0, 3.0, STEP)} for each in made}
    begun = Bus([Twin(each) for each in made], MotorDriver(Adapter(), made, ranges))
    for twin in begun.twins:
        twin.step(0, [])
    return begun


def test_a_map_reads_what_it_writes() -> None:
    for name, register in TABLE.by_name.items():
        low, high = map(int, register.ends())
        for value in {low, -1 if low else 0, 0, 1, high}:
            data = TABLE.data(name, value)
            assert len(data) == register.size
            assert TABLE.values(register.number, data) == {name: value}
        assert TABLE.data(name, high + 1e9) == TABLE.data(name, high)
    assert TABLE.data("Homing_Offset", -5) == b"\x08\x05"
    assert TABLE.values(6, b"\xf8\x05") == {"Homing_Offset": -5}  # bits above the sign mean nothing
    assert TABLE.values(19, bytes(5)) == {"Position": 0, "Load": 0}  # whole ones only
    assert TABLE.runs({"Torque_Enable": 1, "Lock": 0, "Limit": 2}) == [(10, b"\1\0"), (14, b"\0\2")]
    assert deepcopy(TABLE) is TABLE


@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_what_is_not_finite_is_never_sent(value: float) -> None:
    with pytest.raises(ValueError, match="Goal_Position"):
        TABLE.data("Goal_Position", value)


def test_more_than_a_packet_carries_goes_in_several() -> None:
    data = {number: bytes(2) for number in range(1, 9)}
    found = [PACKETS.question(frame) for frame in PACKETS.sync_writes(12, data)]
    assert [number for one in found for number, _, _ in PACKETS.writes(one)] == list(data)
    assert len(found) == 2
    assert all(len(one.data) <= PACKETS.longest for one in found)


def test_what_is_sent_has_names_and_what_only_reads_is_known() -> None:
    write = PACKETS.sync_write(12, {1: b"\0\1"})
    question = PACKETS.asks(dict.fromkeys((1, 2), (20, 4)), "", 0)
    assert PACKETS.messages(write + question) == ("sync_write Goal_Position", "sync_read")
    assert PACKETS.messages(PACKETS.packet(1, 3, b"\x0c\0\1\0\2")) == ("write Goal_Position and on",)
    assert [PACKETS.read_only(frame) for frame in (question, write, write + question, question + b"\0")] == [
        True, False, False, False,
    ]  # fmt: skip


def test_all_are_read_in_one_chain_and_who_breaks_it_alone() -> None:
    line = bus()
    line.step()
    line.step()
    assert [(one.instruction, one.data[2:]) for one in line.step() if one.data[0] == 20] == [
        (SYNC_READ, b"\1\2\3")
    ]
    assert {event.motor: event.position for event in line.of(Feedback)} == {
        f"m{number}": pytest.approx(0.1) for number in (1, 2, 3)
    }
    assert all(line.whole)
    line.step(silent=["m2"])
    assert not line.whole[-1], "who waits for it does not answer"
    motions = [one for one in line.step(silent=["m2"]) if one.data[0] == 20]
    assert [(one.instruction, one.id, one.data[2:]) for one in motions] == [
        (READ, 2, b""), (SYNC_READ, 254, b"\1\3"),
    ]  # fmt: skip
    line.step()
    assert line.step()[-1].data[2:] == b"\1\2\3"


def test_all_are_set_up_armed_and_moved_at_once() -> None:
    line = bus()
    for _ in range(4):
        line.step()
    goals = [msg.Position(f"m{number}", 0.1 * number) for number in (1, 2, 3)]
    written = [
        [(number, at, data) for one in line.step(*goals) for number, at, data in PACKETS.writes(one)]
        for _ in range(3)
    ]
    assert written[0] == [(number, 14, b"\x02\xbc") for number in (1, 2, 3)]
    assert written[1] == [(number, 10, b"\1") for number in (1, 2, 3)]
    assert written[2] == [(number, 12, (100 * number).to_bytes(2, "big")) for number in (1, 2, 3)]
    assert [twin.mode for twin in line.twins] == [Mode.ARMED] * 3
    released = line.step(*(msg.Idle(each.motor) for each in goals))
    assert [one.instruction for one in released if PACKETS.writes(one)] == [SYNC_WRITE]


def test_requests_write_step_by_step_and_read_back() -> None:
    line = bus(2)
    line.step()
    line.step(msg.WriteParameter("m1", "ID", 2.0), msg.WriteParameter("m1", "Goal_Position", 1.0))
    assert [event.reason for event in line.of(msg.Refused)] == [
        "ID 2 is that of m2", "Goal_Position is commanded, not written",
    ]  # fmt: skip
    line.step(msg.WriteParameter("m1", "ID", 7.0))
    for _ in range(60):
        line.step()
    assert [event.detail for event in line.of(msg.Done)] == ["stored"]
    assert (line.twins[0].memory.id, line.twins[0].memory.get("Lock")) == (7, 1)
    line.step(msg.ReadParameter("m1", "ID"), msg.Zero("m2"))
    assert [event.value for event in line.of(msg.Parameter)] == [7.0]
    line.step()
    assert [event.reason for event in line.of(msg.Refused)][2:] == ["error 3"]  # it is locked


def test_a_scan_finds_all() -> None:
    line = bus(2)
    line.step(msg.Scan("line0"))
    for _ in range(80):
        line.step()
    assert [(event.address, event.detail) for event in line.of(msg.Found)] == [
        (1, "m1, 1234"), (2, "m2, 1234"),
    ]  # fmt: skip
    assert [event.detail for event in line.of(msg.Done)] == ["2 devices"]


def test_decoder_and_twin_obey_the_same() -> None:
    made = devices(2)
    decoder = ServoDecoder(PACKETS, [memory_of(each) for each in made])
    frames = PACKETS.sync_write(10, {1: b"\1", 2: b"\1"})
    assert list(decoder.decode(0, frames)) == [
        msg.Arm("m1"), msg.Position("m1", 0.0), msg.Arm("m2"), msg.Position("m2", 0.0),
    ]  # fmt: skip
    frames = PACKETS.sync_write(12, {1: b"\0\1", 2: b"\0\2"}) + PACKETS.packet(1, 4, b"\x0e\0\x09")
    assert list(decoder.decode(0, frames)) == [
        msg.Position("m1", 0.001), msg.Position("m2", 0.002), msg.Kept("m1", "reg write 14", 2.0),
    ]  # fmt: skip
    other = deepcopy(decoder)
    assert other.decode(0, PACKETS.packet(254, 5)) == [msg.WriteParameter("m1", "Limit", 9.0)]
    assert other.decode(0, PACKETS.packet(254, 5)) == []
    assert decoder.decode(0, PACKETS.packet(1, 5)) == [msg.WriteParameter("m1", "Limit", 9.0)]
    assert declared({"Limit": 9.0}) == {"Limit": (9.0,)}
