"""The messages and faults of RoboClaw boards, in the vendor's units: counts, qpps, 0.1 V, 10 mA, 0.1 °C.

Source: basicmicro 2.0.10 (`controller.py`, `commands.py`); the status of older firmware:
basicmicro/roboclaw_arduino_library@5e83dfe. Names are those of `commands.py`.

Rules. A question is address and command, without a checksum; all else ends with a CRC-16 over all of it,
and is acknowledged by one byte. An answer has neither address nor command: its CRC-16 covers those of the
question, too. How long a message is follows from its command.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import FaultInfo
from protocols.toolkit.boards import SIDES, Boards
from protocols.toolkit.device_file import device_file
from protocols.toolkit.faults import faults
from protocols.toolkit.packets import Packets
from protocols.toolkit.registers import Register, Registers
from protocols.toolkit.serial import CRC16_XMODEM, Coded, Covered
from protocols.toolkit.table import Field, Row, Table, Values, const, fields, uint

DEVICE = device_file("protocols.roboclaw")
BOARDS = Boards(range(0x80, 0x88))
ACK = b"\xff"
GAP: Nanos = 10 * MILLISECOND
"""A pause of this length within a message ends it."""
NVM_KEY = 0xE22EAB7A
SAVE = "save"
"""The parameter that saves all when 1 is written."""
TIMEOUT_UNIT_MS = 100
CONFIG = "config"
"""The parameter with mode, address and bit rate: what is written counts at once, and is not read back."""
FULL = 32767
"""Duty: all of the supply's voltage."""


def name_of(kind: str, motor: int) -> str:
    """Return the name of a message to or about one motor."""
    return kind.replace("#", str(BOARDS.side(motor)))


def duty_of(values: Values) -> Values:
    """Return the numbers for a motor; of a set-point of 7 bits the duty that it stands for."""
    match values:
        case {"forward": share}:
            share /= 127
        case {"backward": share}:
            share /= -127
        case {"seven": share}:
            share = (share - 64) / 63
        case _:
            return values
    return {"duty": round(max(-1.0, min(1.0, share)) * FULL)}


# -- messages ----------------------------------------------------------------------------------------------


def _messages(text: str) -> Iterator[tuple[str, int, tuple[Field, ...]]]:
    """Return name, number and fields of each message."""
    for line in text.strip().splitlines():
        number, name, *numbers = line.split()
        for side in SIDES if "#" in name else SIDES[:1]:
            yield name.replace("#", str(side)), int(number) + side - 1, fields(" ".join(numbers))


def _row(name: str, number: int, numbers: tuple[Field, ...], **others: Any) -> Row:  # noqa: ANN401 -- fields
    return Row(name, (uint("address"), const(number)), numbers, order="big", extended=True, **others)


_WRITTEN = tuple(_messages(DEVICE["messages"]["written"]))
_READ = tuple(_messages(DEVICE["messages"]["read"]))
LONGEST_VERSION = 48
_QUESTIONS = {number: name for name, number, _ in _READ}
_SIZES = {number: sum(field.bits for field in numbers) // 8 for _, number, numbers in _WRITTEN}
_ANSWERED = {number: 2 + sum(each.bits for each in numbers) // 8 for _, number, numbers in _READ if numbers}
"""Bytes of the answer to each question, but for a text."""
OLDER_STATUS = 4
"""Bytes of the answer to GETERROR of firmware before 4.1.3x."""


PACKETS = Packets(
    (
        *(_row(*each) for each in _WRITTEN),
        *(_row(name, number, (), read_only=True) for name, number, _ in _READ),
    ),
    Coded(BOARDS.addresses, _SIZES | dict.fromkeys(_QUESTIONS, 0), _QUESTIONS, CRC16_XMODEM, 2),
)
ANSWERS = Table(_row(*each, direction="from_device") for each in _READ if each[2])
COVERED = Covered(2, CRC16_XMODEM, 2)
"""An answer's checksum covers address and command of the question."""
QUESTIONS = frozenset(_QUESTIONS.values())
PARAMETERS: Mapping[str, tuple[str, str]] = {
    field.name: (written, read)
    for written, read in DEVICE["parameters"].items()
    for field in PACKETS.row(written.replace("#", "1")).fields
}
"""The messages that write and read a parameter, of the first motor with "#" in the place of 1"""
REGISTERS = Registers(
    *(
        Register(field.name, function, f"u{field.bits}")  # type: ignore[arg-type]
        for name, function, numbers in _WRITTEN
        for field in numbers
        if PARAMETERS.get(field.name, ("",))[0].replace("#", "1") == name
    )
)
"""The parameters by name, and what they can hold"""


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

ESTOP, DRIVER = 0x1, 0x40
OF_MOTOR, WARNINGS_OF_MOTOR = 0x1540, 0x4501_0000
"""Bits of the first motor; those of the second are the next higher ones. The others are of both."""
_KNOWN = DEVICE["faults"]
FAULTS: Mapping[int, FaultInfo] = faults(_KNOWN["board"], _KNOWN["phrases"])
(NOT_ARMED,) = _OWN = faults(_KNOWN["driver"])
ALL_FAULTS: Mapping[int, FaultInfo] = {**FAULTS, **_OWN}
WARNINGS: Mapping[int, str] = {int(bit, 0): text for bit, text in DEVICE["warnings"].items()}
_OLDER_BITS: Sequence[int] = DEVICE["older"]["bits"]


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
