"""Registers and packets of Feetech bus servos: STS and SMS (little-endian), SCS (big-endian).

Sources: the vendor's memory tables as published for STS and SCSCL; SMS_STS.cpp, SCSCL.cpp of
adityakamath/SCServo_Linux@da2ed3a; feetech-servo-sdk 1.0.0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.plugin import FaultInfo
from protocols.suggest import did_you_mean
from protocols.toolkit.faults import Faults
from protocols.toolkit.serial import Framing, Stream, inverted_sum8

NAME = "feetech"
IDS = range(254)
EVERYBODY = 254
PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
INSTRUCTIONS = {
    PING: "ping",
    READ: "read",
    WRITE: "write",
    REG_WRITE: "reg write",
    ACTION: "action",
    SYNC_READ: "sync read",
    SYNC_WRITE: "sync write",
}
MIDDLE_HERE = 128
"""Written to Torque_Enable: the present position becomes the middle."""
LONGEST_DELAY = 508_000
"""ns: the largest Return_Delay_Time, 254 · 2 µs."""

# -- registers ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Register:
    """One register, or the two bytes of one."""

    name: str
    """The vendor's, as written by lerobot."""
    at: int
    size: int = 1
    sign: int = 0
    """The bit that is the sign of a magnitude; 0: there is none."""
    writable: bool = True

    @property
    def most(self) -> int:
        """Return the largest value."""
        return (1 << (self.sign or 8 * self.size)) - 1

    def value(self, raw: int) -> int:
        """Return the value of a number in the register; bits above the sign mean nothing."""
        if not self.sign:
            return raw
        magnitude = raw & (1 << self.sign) - 1
        return -magnitude if raw >> self.sign & 1 else magnitude


def _fixed(*registers: Register) -> tuple[Register, ...]:
    return tuple(replace(each, writable=False) for each in registers)


_R = Register
_STORED = (
    *_fixed(_R("Firmware_Major_Version", 0), _R("Firmware_Minor_Version", 1), _R("Model_Number", 3, 2)),
    *(_R("ID", 5), _R("Baud_Rate", 6), _R("Return_Delay_Time", 7), _R("Response_Status_Level", 8)),
    *(_R("Min_Position_Limit", 9, 2), _R("Max_Position_Limit", 11, 2), _R("Max_Temperature_Limit", 13)),
    *(_R("Max_Voltage_Limit", 14), _R("Min_Voltage_Limit", 15), _R("Max_Torque_Limit", 16, 2)),
    *(_R("Phase", 18), _R("Unloading_Condition", 19), _R("LED_Alarm_Condition", 20)),
    *(_R("P_Coefficient", 21), _R("D_Coefficient", 22), _R("I_Coefficient", 23)),
    *(_R("Minimum_Startup_Force", 24, 2), _R("CW_Dead_Zone", 26), _R("CCW_Dead_Zone", 27)),
)
_MEASURED = _fixed(
    _R("Present_Position", 56, 2, 15),
    _R("Present_Velocity", 58, 2, 15),
    _R("Present_Load", 60, 2, 10),
    _R("Present_Voltage", 62),
    _R("Present_Temperature", 63),
    _R("Status", 65),
    _R("Moving", 66),
)
STS = (
    *_STORED,
    *(_R("Protection_Current", 28, 2), _R("Angular_Resolution", 30), _R("Homing_Offset", 31, 2, 11)),
    *(_R("Operating_Mode", 33), _R("Protective_Torque", 34), _R("Protection_Time", 35)),
    *(_R("Overload_Torque", 36), _R("Velocity_P_Coefficient", 37), _R("Over_Current_Protection_Time", 38)),
    *(_R("Velocity_I_Coefficient", 39), _R("Torque_Enable", 40), _R("Acceleration", 41)),
    *(_R("Goal_Position", 42, 2, 15), _R("Goal_Time", 44, 2, 10), _R("Goal_Velocity", 46, 2, 15)),
    *(_R("Torque_Limit", 48, 2), _R("Lock", 55), *_MEASURED),
    *_fixed(_R("Present_Current", 69, 2, 15)),
)
SCS = (
    *_STORED,
    *(_R("Protective_Torque", 37), _R("Protection_Time", 38), _R("Torque_Enable", 40)),
    *(_R("Goal_Position", 42, 2), _R("Goal_Time", 44, 2), _R("Goal_Velocity", 46, 2), _R("Lock", 48)),
    *_MEASURED,
)
BLOCKS = {"who": (0, 40), "state": (33, 38), "motion": (56, 8)}
"""What is asked for at once: first register, and bytes."""
SCS_BLOCKS = BLOCKS | {"state": (40, 27)}
Values: TypeAlias = dict[str, int]


MOTION_SIZE = 14
MOTION_HEADS = tuple(b"\xff\xff%c\x0a" % number for number in range(254))
Motion: TypeAlias = tuple[int, int, int, int, int, int]
"""Error, position [steps], velocity [steps/s], load [0.1 %], supply [0.1 V], °C"""


class Layout(NamedTuple):
    """How registers lie in a block of bytes."""

    names: tuple[str, ...]
    numbers: struct.Struct
    signs: tuple[tuple[str, int], ...]
    """Those with a sign, and what it is."""


class Family:
    """The registers of servos that are programmed alike. A constant."""

    def __init__(self, name: str, order: Literal["little", "big"], registers: Sequence[Register]) -> None:
        self.name, self.order = name, order
        self.registers = {each.name: each for each in registers}
        self.blocks = BLOCKS if order == "little" else SCS_BLOCKS
        self._layouts: dict[tuple[int, int], Layout] = {}
        self._motion = struct.Struct("<>"[order == "big"] + "4sBHHHBBB")
        self._coding = {
            each.name: (each.size, 1 << each.sign, each.most, -each.most if each.sign else 0)
            for each in registers
        }
        """Of each register: size, what the sign is, and the largest and smallest value."""
        self.modes = (0, 1, 2) if "Operating_Mode" in self.registers else (0,)

    def __deepcopy__(self, memo: object) -> Family:
        return self

    def data(self, name: str, value: float) -> bytes:
        """Return a value as the bytes of its register, at the ends of its range beyond it. Raises ValueError
        if it is not finite."""
        size, sign, most, least = self._coding[name]
        if not -1e9 < value < 1e9 and not math.isfinite(value):
            raise ValueError(f"{name} is {value}")
        number = round(value)
        number = most if number > most else least if number < least else number
        return (number if number >= 0 else sign - number).to_bytes(size, self.order)

    def values(self, at: int, data: bytes) -> Values:
        """Return the values of the registers of which a block of bytes has all."""
        names, numbers, signs = self._layouts.get((at, len(data))) or self._layout(at, len(data))
        found = dict(zip(names, numbers.unpack(data), strict=True))
        for name, sign in signs:
            raw = found[name]
            if raw >= sign:  # bits above the sign mean nothing
                found[name] = -(raw & sign - 1) if raw & sign else raw & sign - 1
        return found

    def motion(self, number: int, data: bytes) -> Motion | None:
        """Return what a servo answers to the question for its motion; None if that is not its answer."""
        if len(data) != MOTION_SIZE or sum(data) & 0xFF != 0xFD:  # the sync bytes and the checksum
            return None
        head, error, place, speed, load, volts, degrees, _ = self._motion.unpack(data)
        if head != MOTION_HEADS[number]:
            return None
        place = place if place < 0x8000 else 0x8000 - place
        speed = speed if speed < 0x8000 else 0x8000 - speed
        load = load & 0x3FF if not load & 0x400 else -(load & 0x3FF)
        return error, place, speed, load, volts, degrees

    def _layout(self, at: int, size: int) -> Layout:
        """Return how the registers lie in a block, made once."""
        inside = [
            each for each in self.registers.values() if at <= each.at and each.at + each.size <= at + size
        ]
        form, end = "<" if self.order == "little" else ">", at
        for each in sorted(inside, key=lambda one: one.at):
            form += "x" * (each.at - end) + " BH"[each.size]
            end = each.at + each.size
        numbers = struct.Struct(form + "x" * (at + size - end))
        signs = tuple((each.name, 1 << each.sign) for each in inside if each.sign)
        made = Layout(tuple(each.name for each in inside), numbers, signs)
        self._layouts[at, size] = made
        return made

    def wrong(self, name: str, value: float | None = None) -> str:
        """Return why a register cannot be read or (with a value) written, "" if it can."""
        register = self.registers.get(name)
        if register is None:
            hint = did_you_mean(name, self.registers)
            return f"no parameter {name!r}{hint}; there are {', '.join(self.registers)}"
        if value is None:
            return ""
        low = -register.most if register.sign else 0
        if not register.writable:
            return f"{name} is read only"
        ok = value == int(value) and low <= value <= register.most
        return "" if ok else f"{name} cannot be {value:g}: it is a whole number, {low} … {register.most}"


FAMILIES = {"sts": Family("sts", "little", STS), "scs": Family("scs", "big", SCS)}


class Model(NamedTuple):
    """What differs between the servos of a family."""

    family: Family
    number: int
    """Model_Number; 0: not checked"""
    steps: int
    """Of the position in `span`"""
    span: float
    """rad"""
    ends: tuple[int, int]
    """Positions at or beyond which a reading is none."""
    sync_read: bool = True

    @property
    def step(self) -> float:
        """Return one step [rad]."""
        return self.span / self.steps

    @property
    def middle(self) -> int:
        """Return the position that is 0 rad."""
        return self.steps // 2


def _sts(number: int) -> Model:
    return Model(FAMILIES["sts"], number, 4096, 2.0 * math.pi, (-0x7FFF, 0x7FFF))


def _scs(number: int) -> Model:
    return Model(FAMILIES["scs"], number, 1024, math.radians(300.0), (0, 1023), sync_read=False)


MODELS: Mapping[str, Model] = {
    "sts3215": _sts(777),
    "sts3250": _sts(2825),
    "sm8512bl": _sts(11272),
    "sts": _sts(0),
    "scs0009": _scs(1284),
    "scs": _scs(0),
}
NUMBERS = {model.number: name for name, model in MODELS.items() if model.number}


def identified(data: bytes) -> str:
    """Return firmware and model from the first five registers, whatever the family: END (2) is its order."""
    order: Literal["little", "big"] = "big" if data[2] else "little"
    number = int.from_bytes(data[3:5], order)
    return f"{NUMBERS.get(number, 'model')} ({number}), firmware {data[0]}.{data[1]}"


# -- faults ------------------------------------------------------------------------------------------------

NOT_ARMED = 0x100
FAULTS = {
    0x01: FaultInfo(
        "voltage", "the supply is outside Min_ … Max_Voltage_Limit", "check supply and load", latching=False
    ),
    0x02: FaultInfo(
        "angle", "the magnetic encoder or potentiometer", "restart it; if it comes again, replace the servo",
        latching=False,
    ),
    0x04: FaultInfo(
        "overheat", "hotter than Max_Temperature_Limit: too much load for too long", "let it cool",
        latching=False,
    ),
    0x08: FaultInfo(
        "current", "more than Protection_Current for too long", "free the shaft; look for a short",
        latching=False,
    ),
    0x20: FaultInfo(
        "overload", "more than Overload_Torque for Protection_Time", "free the shaft, or carry less",
        latching=False,
    ),
}  # fmt: skip
ALL_FAULTS = Faults(
    FAULTS
    | {
        NOT_ARMED: FaultInfo(
            "does not obey", "it answers, and its registers do not become what is written",
            "check the wire to it (does it hear broadcasts?), its id, and whether another host writes to it",
        )
    }
)  # fmt: skip


def faults_in(error: int) -> tuple[int, ...]:
    """Return the faults in the error byte of a status; bits without a name are none."""
    return tuple(bit for bit in FAULTS if error & bit) if error else ()


# -- packets -----------------------------------------------------------------------------------------------


def _body(head: bytes) -> int | None:
    return head[3] - 1 if head[3] >= 2 and head[2] != 0xFF else None


FRAMING = Framing(b"\xff\xff", 4, _body, inverted_sum8, 1, covers=2)


class Packet(NamedTuple):
    """What follows the sync bytes. Of a status, the instruction is the error byte."""

    id: int
    instruction: int
    data: bytes


def packet(address: int, instruction: int, data: bytes = b"") -> bytes:
    """Return a packet."""
    size = len(data) + 2
    return b"\xff\xff%c%c%c%b%c" % (
        address,
        size,
        instruction,
        data,
        ~(address + size + instruction + sum(data)) & 0xFF,
    )


def unpacked(message: bytes) -> Packet:
    """Return a message, as `Stream.feed` gives it."""
    return Packet(message[2], message[4], message[5:])


def in_frame(frame: Frame) -> tuple[list[Packet], bool]:
    """Return the packets in a run of bytes, and whether it holds nothing else."""
    if not isinstance(frame, bytes):
        return [], False
    found = Stream(FRAMING).messages(frame)
    return [unpacked(each) for each in found], sum(len(each) + 1 for each in found) == len(frame)


def written(one: Packet) -> dict[int, tuple[int, bytes]]:
    """Return what an instruction writes: by id, the first register and the bytes."""
    if one.instruction in (WRITE, REG_WRITE) and len(one.data) >= 2:
        return {one.id: (one.data[0], one.data[1:])}
    if one.instruction != SYNC_WRITE or len(one.data) < 2 or one.id != EVERYBODY:
        return {}
    at, size, each = one.data[0], one.data[1], one.data[2:]
    if not size or len(each) % (size + 1) or max(each[:: size + 1], default=0) not in IDS:
        return {}
    return {each[n]: (at, each[n + 1 : n + 1 + size]) for n in range(0, len(each), size + 1)}


def name_of(one: Packet) -> str:
    """Return the name of an instruction, with the register at which it writes; "" if it is none."""
    name = INSTRUCTIONS.get(one.instruction, "")
    if not name or one.instruction in (PING, READ, SYNC_READ, ACTION):
        return name
    places = {at for at, _ in written(one).values()}
    first = next((each.name for each in STS if each.at in places), "")
    return f"{name} {first or 'Lock' * (48 in places)}" if places else ""


def messages(frame: Frame) -> tuple[str, ...]:
    """Return the names of the instructions in a run of bytes, as `Plugin.messages` does."""
    return tuple(name for one in in_frame(frame)[0] if (name := name_of(one)))


def read_only(frame: Frame) -> bool:
    """True if a run of bytes holds whole questions, and nothing else."""
    found, whole = in_frame(frame)
    return bool(found) and whole and all(one.instruction in (PING, READ, SYNC_READ) for one in found)


# -- what is exchanged -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Statuses:
    """Finds the answers of these devices, in this order, each with as many bytes of data."""

    ids: tuple[int, ...]
    size: int

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        """Return where they begin and end."""
        every, at, first = 6 + self.size, 0, -1
        if len(held) < every * len(self.ids):
            return None
        for number in self.ids:
            head = bytes((0xFF, 0xFF, number, self.size + 2))
            at = held.find(head, at)
            while at >= 0 and not _is_sound(held[at + 2 : at + every]):
                at = held.find(head, at + 1)
            if at < 0:
                return None
            first = at if first < 0 else first
            at += every
        return first, at


def _is_sound(body: bytes) -> bool:
    """True if a packet without its sync bytes is whole, and its checksum right."""
    return len(body) > 3 and len(body) == body[1] + 2 and sum(body) & 0xFF == 0xFF


def asks(
    ids: tuple[int, ...],
    block: tuple[int, int],
    about: str,
    delay: int,
    rank: Rank = Rank.QUESTION,
) -> Exchange:
    """Return a question for the same bytes of one device or of several; `delay`: before all their answers."""
    at, size = block
    if len(ids) == 1:
        frame = packet(ids[0], READ, bytes((at, size)))
    else:
        frame = packet(EVERYBODY, SYNC_READ, bytes((at, size, *ids)))
    return Exchange(frame, Answer(len(ids) * (6 + size), Statuses(ids, size), delay), rank, about)


def writes(at: int, each: Mapping[int, bytes]) -> bytes:
    """Return what writes the same registers of devices: nobody answers."""
    parts = bytearray((at, 0))
    for number, data in each.items():
        parts.append(number)
        parts += data
    parts[1] = len(data)
    return packet(EVERYBODY, SYNC_WRITE, bytes(parts))


def answers(ids: Sequence[int], size: int, data: bytes) -> list[Packet] | None:
    """Return the answers of these devices, each with as many bytes of data, if there is nothing else."""
    every, at, found = size + 6, 0, list[Packet]()
    if len(data) != every * len(ids):
        return None
    for number in ids:
        head, body = data[at : at + 4], data[at + 2 : at + every]
        at += every
        if head != b"\xff\xff%c%c" % (number, size + 2) or sum(body) & 0xFF != 0xFF:
            return None
        found.append(Packet(number, body[2], body[3:-1]))
    return found


def slices(each: Iterable[tuple[int, bytes]]) -> Iterator[dict[int, bytes]]:
    """Yield the data of devices in portions that a packet can carry."""
    portion: dict[int, bytes] = {}
    for number, data in each:
        if (len(portion) + 1) * (1 + len(data)) > 240:
            yield portion
            portion = {}
        portion[number] = data
    if portion:
        yield portion
