"""The messages of Waveshare's DDSM115 and DDSM210, in the vendor's units: 10 bytes, the address first, a
CRC-8/MAXIM last, numbers big-endian.

Rules. The bytes have no sync, and an answer of a DDSM115 does not say what it answers: it is read by what was
asked. The DDSM115's `set mode` has no checksum, its mode stands in the place of it.

Source: waveshareteam/ddsm_example@79bfd6f `ddsm_ctrl.cpp`, rasheeddo/ddsm115_python@d3668b0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from protocols.frames import CanFrame, Frame
from protocols.plugin import FaultInfo
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import CRC8_MAXIM, Stream
from protocols.toolkit.table import Decoded, Direction, Field, Row, Table, Values, const, sint, uint, unused

SIZE = 10
DRIVE, QUERY, MODE = 0x64, 0x74, 0xA0
ADDRESSES = range(1, 0xAA)
"""From 0xAA on are addresses that are heads of other messages; the vendor gives no highest one."""
ANYONE = 0xC8
"""The address to which any motor answers: one alone may be on the line."""
BRAKE = 0xFF
TIMES = 5
"""How often `set id` is sent before it counts"""
CURRENT, SPEED, POSITION = 1, 2, 3
"""Modes. Of a DDSM210 the first is 0, "open loop": a share of the voltage."""
FULL = (1 << 15) - 1
AMPERE, ANGLE, COARSE = 8.0 / FULL, math.tau / FULL, math.tau / 255
"""A and rad of a count; rad of a count in the answer of a DDSM115 to a query"""


@dataclass(frozen=True, slots=True)
class Model:
    """What a model determines."""

    name: str
    rest: int
    """The mode without a loop for speed, in which a value of 0 lets go."""
    rpm: float
    """rad/s of a count of speed"""
    fastest: float
    """rad/s by the vendor's code"""
    strongest: float
    """A by the vendor's code; 0: its current cannot be commanded."""
    torque_constant: float
    """N·m/A; 0: not known"""
    tells_mode: bool
    """Whether its answers have its mode in the place of what they answer"""
    kinds: frozenset[int]
    """The second byte of its answers"""

    @property
    def told(self) -> int:
        """Answers after which a mode counts that was written."""
        return 1 if self.tells_mode else 2

    def fits(self, message: bytes) -> bool:
        """True if this can be an answer of this model."""
        return message[1] in self.kinds and not CRC8_MAXIM(message)  # with its checksum it gives 0


RPM = math.pi / 30.0
MODELS: Mapping[str, Model] = {
    "DDSM115": Model(
        "DDSM115", CURRENT, RPM, 200 * RPM, 2.7, 0.75, True, frozenset({CURRENT, SPEED, POSITION})
    ),
    "DDSM210": Model("DDSM210", 0, 0.1 * RPM, 210 * RPM, 0.0, 0.0, False, frozenset({DRIVE, QUERY})),
}


def _row(name: str, *fields: Field, to: Field | None = None) -> Row:
    direction: Direction = "from_device" if name.startswith("DDSM") else "to_device"
    ids = (to or uint("address"),)
    return Row(name, ids, fields, direction, "big", read_only=name.endswith("query"), extended=True)


_MOTION = uint("mode"), sint("current"), sint("speed")
TABLE = Table(
    (
        _row("drive", const(DRIVE), sint("value"), unused(24), uint("brake"), unused()),
        _row("query", const(QUERY), unused(56)),
        _row("id query", const(DRIVE), const(0, 16), unused(40), to=const(ANYONE)),
        _row("set mode 115", const(MODE), const(0, 56), uint("mode")),
        _row("set mode 210", const(MODE), uint("mode"), unused(48)),
        _row("set id", const(0x55), const(0x53), uint("id"), unused(40), to=const(0xAA)),
        _row("DDSM115 64", *_MOTION, uint("angle", 16), uint("error")),
        _row("DDSM115 74", *_MOTION, uint("temperature"), uint("coarse"), uint("error")),
        _row(
            "DDSM210 64",
            *(const(DRIVE), sint("speed"), sint("current"), unused(), uint("temperature"), uint("error")),
        ),
        _row("DDSM210 74", const(QUERY), sint("mileage", 32), uint("angle", 16), uint("error")),
    )
)
_ENCODE = {row.name: TABLE.encoder(row.name) for row in TABLE.rows}
_ANSWERS = {(model, asked): f"{model} {asked:02X}" for model in MODELS for asked in (DRIVE, QUERY)}


def encode(name: str, address: int = 0, /, **values: int) -> bytes:
    """Return a message to or from the motor at an address. Raises ValueError for a number that is not finite,
    TypeError for a field that is missing or unknown."""
    frame = _ENCODE[name](address, **values)
    message = bytes((frame.id,)) + frame.data
    return message if len(message) == SIZE else message + bytes((CRC8_MAXIM(message),))


def decode(message: bytes, model: str = "") -> Decoded | None:
    """Return the message to a motor in 10 bytes, None if it is none; `model`: the motor's, if known."""
    bare = message[1] == MODE and not any(message[2:9]) and message[9] in (CURRENT, SPEED, POSITION)
    if not (bare and model != "DDSM210"):
        if CRC8_MAXIM(message[:-1]) != message[-1]:
            return None
        message = message[:-1]
    decoded = TABLE.decode(CanFrame(message[0], message[1:], extended=True), "to_device")
    return decoded if decoded is not None and decoded.name else None


def read(model: str, asked: int, message: bytes) -> Values:
    """Return the numbers in an answer of a model to this function."""
    return TABLE.read(_ANSWERS[model, asked], message[1:-1]) or {}


@dataclass(frozen=True, slots=True)
class Tens:
    """How messages stand on the line: any 10 bytes that fit."""

    fits: Callable[[bytes], object]

    def frame(self, message: bytes) -> bytes:
        """Return a message as it stands on the line."""
        return message

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if len(held) - at < SIZE:
            return None, at
        message = held[at : at + SIZE]
        return (message, at + SIZE) if self.fits(message) else (Rx.IGNORED, at + 1)


def _is_message(message: bytes) -> bool:
    """True for a message to a motor, or an answer of one, which the others hear: nothing begins within it."""
    return not CRC8_MAXIM(message) or decode(message) is not None


COMMANDS = Tens(_is_message)


@dataclass(frozen=True, slots=True)
class Finds:
    """Where the answer of a model stands in what has come."""

    model: Model

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        """Return where the answer to this question begins and ends; None: it has not come."""
        model, address, function = self.model, asked[0], asked[1]
        for at in range(len(held) - SIZE + 1):
            its = held[at] == address or address == ANYONE
            if its and (model.tells_mode or held[at + 1] == function) and model.fits(held[at : at + SIZE]):
                return at, at + SIZE
        return None


def in_frame(frame: Frame) -> tuple[Sequence[Decoded], bool]:
    """Return the messages to motors in a run of bytes, and whether it holds nothing else."""
    if not isinstance(frame, bytes):
        return (), False
    found = [one for each in Stream(COMMANDS).messages(frame) if (one := decode(each)) is not None]
    return found, len(found) * SIZE == len(frame) > 0


def names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the messages to motors in a run of bytes, as `Plugin.messages` does."""
    return tuple(one.name for one in in_frame(frame)[0])


def read_only(frame: Frame) -> bool:
    """True if a run of bytes holds whole messages that change nothing, as `Spec.read_only` does."""
    found, whole = in_frame(frame)
    return whole and all(TABLE.row(one.name).read_only for one in found)


_TEXTS = (
    ("sensor error", "the Hall sensors or the encoder of the motor", "check the cable; replace the motor"),
    (
        "over-current",
        "a load that is too heavy, or a short circuit",
        "take the load off; lower the acceleration",
    ),
    ("phase over-current", "a short circuit between phases", "replace the motor, if it comes again"),
    ("stall", "the wheel is blocked", "free it"),
    ("troubleshoot", "the vendor's name for any other failure", "switch it off and on; replace it"),
)
FAULTS: Mapping[int, FaultInfo] = {
    1 << bit: FaultInfo(*text, latching=False) for bit, text in enumerate(_TEXTS)
}
"""By the bit in the error byte. No message clears one."""
