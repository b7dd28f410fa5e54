"""The messages and faults of RoboClaw boards, in the vendor's units: counts, qpps, 0.1 V, 10 mA, 0.1 °C.

Source: basicmicro 2.0.10 (`controller.py`, `commands.py`); the status of older firmware:
basicmicro/roboclaw_arduino_library@5e83dfe. Names are those of `commands.py`.

Rules. A question is address and command, without a checksum; all else ends with a CRC-16 over all of it,
and is acknowledged by one byte. An answer has neither address nor command: its CRC-16 covers those of the
question, too. How long a message is follows from its command.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import FaultInfo
from protocols.toolkit.boards import SIDES, Boards
from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import CRC16_XMODEM, Coded, Covered
from protocols.toolkit.table import Field, Row, Table, Values, const, sint, uint

BOARDS = Boards(range(0x80, 0x88))
ACK = b"\xff"
GAP: Nanos = 10 * MILLISECOND
"""A pause of this length within a message ends it."""
NVM_KEY = 0xE22EAB7A
SAVE = "save"
"""The parameter that saves all when 1 is written."""
TIMEOUT_UNIT_MS = 100
PID = "velocity_d", "velocity_p", "velocity_i", "qpps"
"""In the order in which they are written; gains in 1/65536."""
FULL = 32767
"""Duty: all of the supply's voltage."""


def name_of(kind: str, motor: int) -> str:
    """Return the name of a message to or about one motor."""
    return kind.replace("#", str(BOARDS.side(motor)))


# -- messages ----------------------------------------------------------------------------------------------


def _row(name: str, number: int, *fields: Field, read: bool = False, answer: bool = False) -> Row:
    direction = "from_device" if answer else "to_device"
    ids = uint("address"), const(number)
    return Row(name, ids, fields, direction, "big", read_only=read, extended=True)  # type: ignore[arg-type]


def _long(*names: str) -> tuple[Field, ...]:
    return tuple(uint(name, 32) for name in names)


def _signed(bits: int, *names: str) -> tuple[Field, ...]:
    return tuple(sint(name, bits) for name in names)


_PATH = _long("accel", "speed", "deccel")
_BUFFER = uint("buffer")
"""0: behind what is under way; 1: at once."""
_WRITTEN: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "SETTIMEOUT": (14, (uint("timeout"),)),
    "RESETENC": (20, ()),
    **{f"SETM{n}ENCCOUNT": (21 + n, _long("count")) for n in SIDES},
    **{f"SETM{n}PID": (27 + n, _long(*PID)) for n in SIDES},
    **{f"M{n}DUTY": (31 + n, _signed(16, "duty")) for n in SIDES},
    "MIXEDDUTY": (34, _signed(16, "duty1", "duty2")),
    **{f"M{n}SPEED": (34 + n, _signed(32, "speed")) for n in SIDES},
    "MIXEDSPEED": (37, _signed(32, "speed1", "speed2")),
    **{f"M{n}SPEEDACCEL": (37 + n, (*_long("accel"), sint("speed", 32))) for n in SIDES},
    "MIXEDSPEEDACCEL": (40, (*_long("accel"), *_signed(32, "speed1", "speed2"))),
    **{f"M{n}DUTYACCEL": (51 + n, (sint("duty"), *_long("accel"))) for n in SIDES},
    "MIXEDDUTYACCEL": (54, tuple(f for n in SIDES for f in (sint(f"duty{n}"), *_long(f"accel{n}")))),
    **{
        f"M{n}SPEEDACCELDECCELPOS": (64 + n, (*_PATH, sint("position", 32), _BUFFER)) for n in SIDES
    },
    "MIXEDSPEEDACCELDECCELPOS": (
        67,
        (
            *_long("accel1", "speed1", "deccel1"),
            sint("position1", 32),
            *_long("accel2", "speed2", "deccel2"),
            sint("position2", 32),
            _BUFFER,
        ),
    ),
    "WRITENVM": (94, _long("key")),
    **{f"M{n}POS": (118 + n, (sint("position", 32), _BUFFER)) for n in SIDES},
    "MIXEDPOS": (121, (*_signed(32, "position1", "position2"), _BUFFER)),
    "RESETESTOP": (200, ()),
}  # fmt: skip
_READ: Mapping[str, tuple[int, tuple[Field, ...]]] = {
    "GETTIMEOUT": (15, (uint("timeout"),)),
    **{f"GETM{n}ENC": (15 + n, (*_long("count"), uint("status"))) for n in SIDES},
    **{f"GETM{n}SPEED": (17 + n, (sint("speed", 32), uint("backwards"))) for n in SIDES},
    "GETVERSION": (21, ()),
    "GETMBATT": (24, (uint("voltage", 16, 0.1),)),
    "GETLBATT": (25, (uint("voltage", 16, 0.1),)),
    "GETBUFFERS": (47, (uint("buffer1"), uint("buffer2"))),
    "GETPWMS": (48, _signed(16, "duty1", "duty2")),
    "GETCURRENTS": (49, (sint("current1", 16, 0.01), sint("current2", 16, 0.01))),
    **{f"READM{n}PID": (54 + n, _long("velocity_p", "velocity_i", "velocity_d", "qpps")) for n in SIDES},
    "GETENCODERS": (78, _long("count1", "count2")),
    "GETTEMP": (82, (uint("temperature", 16, 0.1),)),
    "GETTEMP2": (83, (uint("temperature", 16, 0.1),)),
    "GETERROR": (90, (uint("status", 32),)),
    "GETSPEEDS": (108, _signed(32, "speed1", "speed2")),
}
LONGEST_VERSION = 48
_QUESTIONS = {number: name for name, (number, _) in _READ.items()}
_SIZES = {number: sum(field.bits for field in fields) // 8 for number, fields in _WRITTEN.values()}
_ANSWERED = {number: 2 + sum(f.bits for f in fields) // 8 for number, fields in _READ.values() if fields}
"""Bytes of the answer to each question, but for a text."""
OLDER_STATUS = 4
"""Bytes of the answer to GETERROR of firmware before 4.1.3x."""


PACKETS = Packets(
    (
        *(_row(name, number, *fields) for name, (number, fields) in _WRITTEN.items()),
        *(_row(name, number, read=True) for name, (number, _) in _READ.items()),
    ),
    Coded(BOARDS.addresses, _SIZES | dict.fromkeys(_QUESTIONS, 0), _QUESTIONS, CRC16_XMODEM, 2),
    lambda address, function, data: bytes((address, function)) + data,
    lambda message: (message[0], message[1], message[2:]),
)
ANSWERS = Table(
    (_row(name, number, *fields, answer=True) for name, (number, fields) in _READ.items() if fields)
)
COVERED = Covered(2, CRC16_XMODEM, 2)
"""An answer's checksum covers address and command of the question."""
QUESTIONS = frozenset(_READ)


def is_question(frame: bytes) -> bool:
    """True if a message is answered with data, and not acknowledged."""
    return frame[1] in _QUESTIONS


def size_of_answer(frame: bytes) -> int:
    """Return the bytes of the answer to a message, at most."""
    if not is_question(frame):
        return len(ACK)
    return _ANSWERED.get(frame[1], 2 + LONGEST_VERSION + 1)


def answer(frame: bytes, name: str, /, **values: Any) -> bytes:  # noqa: ANN401 -- numbers
    """Return the answer to a question."""
    return COVERED.frame(frame, ANSWERS.encode(name, frame[0], **values).data)


def older_status(frame: bytes, status: int) -> bytes:
    """Return the answer of older firmware to GETERROR."""
    return COVERED.frame(frame, status.to_bytes(OLDER_STATUS - 2, "big"))


def version(frame: bytes, text: str) -> bytes:
    """Return the answer to GETVERSION."""
    return COVERED.frame(frame, text.encode("ascii") + b"\0")


def find_answer(frame: bytes, held: bytes) -> tuple[int, int] | None:
    """Return where the answer to a message begins and ends in what has come, as `Answer.find` does. An
    acknowledgement is the last byte that has come: inside the answer to another question it says nothing."""
    if not is_question(frame):
        return (len(held) - 1, len(held)) if held.endswith(ACK) else None
    name, size = _QUESTIONS[frame[1]], _ANSWERED.get(frame[1])
    if size is None:
        return COVERED.find_text(frame, held)
    if len(held) == size and COVERED.fits(frame, held):
        return 0, size  # nearly always
    return COVERED.find(frame, held, (size, OLDER_STATUS) if name == "GETERROR" else (size,))


def read_answer(frame: bytes, data: bytes) -> tuple[str, Values]:
    """Return the name of a question, and the numbers of its answer, which `find_answer` has found; of
    GETVERSION the text."""
    name, data = _QUESTIONS[frame[1]], data[:-2]
    if name == "GETVERSION":
        return name, {"version": data[:-1].decode("ascii", "replace").strip()}
    if name == "GETERROR" and len(data) == 2:
        return name, {"status": _newer(int.from_bytes(data, "big"))}
    return name, ANSWERS.read(name, data) or {}


# -- faults ------------------------------------------------------------------------------------------------

ESTOP, TEMPERATURE, TEMPERATURE2, MBATT_HIGH, LBATT_HIGH, LBATT_LOW = 0x1, 0x2, 0x4, 0x8, 0x10, 0x20
DRIVER, SPEED, POSITION, CURRENT, MBATT_LOW, MBATT_HYSTERESIS = 0x40, 0x100, 0x400, 0x1000, 0x4000, 0x8000
OF_MOTOR = DRIVER | SPEED | POSITION | CURRENT
"""Bits of the first motor; those of the second are the next higher ones. The others are of both."""
WARNINGS: Mapping[int, str] = {
    0x1_0000: "current",
    0x4_0000: "main battery high",
    0x8_0000: "main battery low",
    0x10_0000: "temperature",
    0x20_0000: "temperature 2",
    0x40_0000: "S4",
    0x80_0000: "S5",
    0x100_0000: "speed",
    0x400_0000: "position",
    0x1000_0000: "CAN",
    0x2000_0000: "boot",
    0x4000_0000: "regeneration",
}
WARNINGS_OF_MOTOR = 0x4500_0000 | 0x1_0000
_OLDER_BITS = (
    0x1_0000, 0x2_0000, ESTOP, TEMPERATURE, TEMPERATURE2, MBATT_HIGH, LBATT_HIGH, LBATT_LOW,
    DRIVER, 2 * DRIVER, 0x4_0000, 0x8_0000, 0x10_0000, 0x20_0000, 0x40_0000, 0x80_0000,
)  # fmt: skip
"""What each bit of the status of older firmware is today."""


def _newer(status: int) -> int:
    """Return the status of older firmware in the bits of today's."""
    return sum(bit for at, bit in enumerate(_OLDER_BITS) if status >> at & 1)


def older(status: int) -> int:
    """Return a status as older firmware has it."""
    return sum(1 << at for at, bit in enumerate(_OLDER_BITS) if status & bit)


def of_side(status: int, side: int) -> tuple[list[int], list[str]]:
    """Return the faults and the warnings of one motor in a status."""
    motors = OF_MOTOR | WARNINGS_OF_MOTOR
    own = status & motors if side == 1 else status >> 1 & motors
    all_of_it = own | status & ~(motors | motors << 1)
    faults = [code for code in FAULTS if code & all_of_it]
    return faults, [text for bit, text in WARNINGS.items() if bit & all_of_it]


_BATTERY = "check battery and cables, and the limits that are configured"
FAULTS: Mapping[int, FaultInfo] = {
    ESTOP: FaultInfo("emergency stop", "an input for it is active", "release it, then clear"),
    **{
        code: FaultInfo(name, cause, remedy, latching=False)
        for code, name, cause, remedy in (
            (TEMPERATURE, "temperature", "the board is too hot", "let it cool; less current, more air"),
            (TEMPERATURE2, "temperature 2", "the board is too hot", "let it cool; less current, more air"),
            (MBATT_HIGH, "main battery high", "braking feeds back more than the supply takes", _BATTERY),
            (LBATT_HIGH, "logic battery high", "the logic supply is beyond its limit", _BATTERY),
            (LBATT_LOW, "logic battery low", "the logic supply is below its limit", _BATTERY),
            (DRIVER, "driver fault", "a shorted motor, or a damaged power stage", "check the motor's cables"),
            (SPEED, "speed error", "the speed is beyond its limit of error", "check encoder, load and PID"),
            (POSITION, "position error", "the position is beyond its limit of error", "check load and PID"),
            (CURRENT, "over-current", "a blocked shaft, or a low limit", "free it; check the limit"),
            (MBATT_LOW, "main battery low", "the main supply is below its limit", _BATTERY),
            (MBATT_HYSTERESIS, "main battery was high", "it has not come down yet", _BATTERY),
        )
    },
}  # fmt: skip
NOT_ARMED = 0x1_0000_0000
"""A fault that the driver finds."""
ALL_FAULTS: Mapping[int, FaultInfo] = {
    **FAULTS,
    NOT_ARMED: FaultInfo(
        "does not obey", "it acknowledges no set-point, or not its serial timeout", "check its mode and cable"
    ),
}
