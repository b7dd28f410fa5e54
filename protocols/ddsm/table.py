"""The messages of Waveshare's DDSM115 and DDSM210, in the vendor's units: 10 bytes, the address first, a
CRC-8/MAXIM last, numbers big-endian.

Rules. The bytes have no sync, and an answer of a DDSM115 does not say what it answers: it is read by what was
asked. The DDSM115's `set mode` has no checksum, its mode stands in the place of it.

Source: waveshareteam/ddsm_example@79bfd6f `ddsm_ctrl.cpp`, rasheeddo/ddsm115_python@d3668b0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocols.plugin import FaultInfo
from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import CRC8_MAXIM, Finds, Unmarked
from protocols.toolkit.table import Field, Row, Table, Values, const, sint, uint, unused

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
LOOPS = frozenset({CURRENT, SPEED, POSITION})
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
    names_mode: bool
    """Whether its answers have its mode in the place of what they answer"""
    kinds: frozenset[int]
    """The second byte of its answers"""

    @property
    def confirms(self) -> int:
        """Answers after which a mode counts that was written."""
        return 1 if self.names_mode else 2

    def answer(self, ten: bytes) -> bytes | None:
        """Return these bytes, if they can be an answer of this model."""
        return ten if ten[1] in self.kinds and not CRC8_MAXIM(ten) else None  # with its checksum it gives 0


RPM = math.pi / 30.0
MODELS: Mapping[str, Model] = {
    "DDSM115": Model("DDSM115", CURRENT, RPM, 200 * RPM, 2.7, 0.75, True, LOOPS),
    "DDSM210": Model("DDSM210", 0, 0.1 * RPM, 210 * RPM, 0.0, 0.0, False, frozenset({DRIVE, QUERY})),
}


# -- messages to a motor ------------------------------------------------------------------------------------


def _row(name: str, *fields: Field, to: Field | None = None) -> Row:
    """Return a message to a motor; its first field is the function."""
    ids = to or uint("address"), fields[0]
    return Row(name, ids, fields[1:], order="big", read_only=name.endswith("query"))


ROWS = (
    _row("drive", const(DRIVE), sint("value"), unused(24), uint("brake"), unused()),
    _row("query", const(QUERY), unused(56)),
    _row("id query", const(DRIVE), const(0, 16), unused(40), to=const(ANYONE)),
    _row("set mode 115", const(MODE), const(0, 56), uint("mode")),
    _row("set mode 210", const(MODE), uint("mode"), unused(48)),
    _row("set id", const(0x55), const(0x53), uint("id"), unused(40), to=const(0xAA)),
)


def _checked(ten: bytes) -> bytes | None:
    """Return a message, or an answer, which the others on the line receive: nothing begins within it."""
    return None if CRC8_MAXIM(ten) else ten[:-1]  # over what ends with its own checksum it is 0


def _checked_or_bare(ten: bytes) -> bytes | None:
    """Return the same; `set mode` of a DDSM115 whole, since it has no checksum."""
    bare = ten[1] == MODE and not any(ten[2:9]) and ten[9] in LOOPS
    return ten if bare else _checked(ten)


def _packets(message: Callable[[bytes], bytes | None]) -> Packets:
    return Packets(ROWS, Unmarked(SIZE, message, CRC8_MAXIM))


ALL = _packets(_checked_or_bare)
"""The messages to motors of either model,"""
PACKETS: Mapping[str, Packets] = {"DDSM115": ALL, "DDSM210": _packets(_checked)}
"""and to those of one."""
encode, drive = ALL.encode, ALL.encoder("drive")


# -- answers -----------------------------------------------------------------------------------------------


def _answer(name: str, *fields: Field) -> Row:
    return Row(name, (), fields, "from_device", "big")


_MOTION = uint("mode"), sint("current"), sint("speed")
ANSWERS = Table(
    (
        _answer("DDSM115 64", *_MOTION, uint("angle", 16), uint("error")),
        _answer("DDSM115 74", *_MOTION, uint("temperature"), uint("coarse"), uint("error")),
        _answer(
            "DDSM210 64",
            *(const(DRIVE), sint("speed"), sint("current"), unused(), uint("temperature"), uint("error")),
        ),
        _answer("DDSM210 74", const(QUERY), sint("mileage", 32), uint("angle", 16), uint("error")),
    )
)
"""By model and the function that is answered."""


def answer(model: str, asked: int, address: int, /, **values: int) -> bytes:
    """Return the answer of a model to this function, of what it measures."""
    name = f"{model} {asked:02X}"
    fields = {each.name: values[each.name] for each in ANSWERS.row(name).fields if each.name}
    return ALL.framing.frame(bytes((address,)) + ANSWERS.encode(name, **fields).data)


_NAMES = {(model, asked): f"{model} {asked:02X}" for model in MODELS for asked in (DRIVE, QUERY)}


def read(model: str, asked: int, message: bytes) -> Values:
    """Return the numbers in an answer of a model to this function."""
    return ANSWERS.read(_NAMES[model, asked], message[1:-1]) or {}


@dataclass(frozen=True, slots=True)
class Belongs:
    """Whether an answer of a model can be that to a question."""

    model: Model

    def __call__(self, asked: bytes, answer: bytes) -> bool:
        """Return it."""
        return asked[0] in (answer[0], ANYONE) and (self.model.names_mode or answer[1] == asked[1])


def answers(answer: Callable[[bytes], bytes | None]) -> Unmarked:
    """Return how answers stand on the line."""
    return Unmarked(SIZE, answer, CRC8_MAXIM)


FINDS = {name: Finds(answers(model.answer), Belongs(model)) for name, model in MODELS.items()}
"""How the answer of a model is found."""


# -- faults ------------------------------------------------------------------------------------------------

_TEXTS = (
    ("sensor error", "the Hall sensors or the encoder of the motor", "check the cable; replace the motor"),
    ("over-current", "a load that is too heavy, or a short circuit", "take it off; accelerate less"),
    ("phase over-current", "a short circuit between phases", "replace the motor, if it comes again"),
    ("stall", "the wheel is blocked", "free it"),
    ("troubleshoot", "the vendor's name for any other failure", "switch it off and on; replace it"),
)
FAULTS: Mapping[int, FaultInfo] = {
    1 << bit: FaultInfo(*text, latching=False) for bit, text in enumerate(_TEXTS)
}
"""By the bit in the error byte. No message clears one."""
