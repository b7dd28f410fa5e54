"""The lines of the ASCII protocol, what they mean, and the properties that are used, by firmware line.

Rules. A line begins with a letter; an axis is a number behind it, or the beginning of a property. Where a
line has a checksum, ` *` and the XOR of all before the `*`, so has its answer. Ours always have one: but a
line that loses its `*` is obeyed without. Set-points change the control mode and the inputs at once.

Source: odriverobotics/ODrive@f9b5419 `docs/ascii-protocol.rst`, `Firmware/communication/ascii_protocol.cpp`
(0.5.6); odriverobotics/ODriveArduino@f52eef5 `src/ODriveUART.cpp` (0.6).
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence

from protocols.frames import Frame
from protocols.toolkit.device_file import device_file
from protocols.toolkit.serial import Finds, Stream, TextLines, xor8
from protocols.toolkit.table import FLOAT_MAX, Decoded, Direction

AXES = range(8)
"""A board has one or two."""
BOARD = -2
"""In the place of an address: the board, and so every axis of it."""
LONGEST = 64
"""Bytes of an answer"""
CUT_OFF = 9
"""Characters of a value to which firmware 0.5 cuts it off"""

TO_DEVICE = TextLines(end=b"\n", ends=b"\r\n!", check=xor8, required=False)
"""As a device reads."""
_SENT = TextLines(end=b"\n", check=xor8)
FROM_DEVICE = TextLines(end=b"\r\n", ends=b"\n", check=xor8)
"""Of one whose end is damaged nothing counts."""


def line(text: str) -> bytes:
    """Return a line to a device, with its checksum."""
    return _SENT.frame(text.encode("ascii") + b" ")


def number(value: float) -> str:
    """Return a number as it is written: six decimals, as a device writes them. Raises ValueError if it is not
    finite."""
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be sent")
    return f"{value:.6f}".rstrip("0").rstrip(".") if abs(value) >= 5e-7 else "0"


def binary32(value: float) -> float:
    """Return a number as a device has it; what is too large as the largest."""
    if math.isnan(value):
        return value
    rounded: float = struct.unpack("<f", struct.pack("<f", max(-FLOAT_MAX, min(FLOAT_MAX, value))))[0]
    return rounded


# -- what a line means -------------------------------------------------------------------------------------

_DEVICE = device_file("protocols.odrive_ascii")
INPUTS: Mapping[str, tuple[Mapping[str, int], Sequence[str]]] = _DEVICE["inputs"]
"""By letter: the modes that it sets, and its numbers, of which the first must be there."""
_WRITTEN: Mapping[str, tuple[str, str, bool]] = _DEVICE["written"]
"""Properties of an axis that are commands: message that does the same, its field, and whether it is whole."""
_SYSTEM: Mapping[str, tuple[str, dict[str, int]]] = _DEVICE["system"]
READING = frozenset("frihu")
"""Letters of lines that change nothing; `u` only feeds the watchdog."""
_AXIS = re.compile(r"axis(\d)\.(\S+)")


def words_of(message: bytes) -> list[str]:
    """Return the words of a line, without checksum and comment."""
    return message.decode("ascii").partition(";")[0].partition("*")[0].split()


def _floats(words: Sequence[str]) -> list[float]:
    """Return the numbers with which these words begin."""
    found: list[float] = []
    for word in words:
        try:
            found.append(binary32(float(word.replace("_", "x"))))
        except ValueError:
            break
    return found


class Lines:
    """The lines to a device."""

    framing = TO_DEVICE

    def decode(self, message: bytes, direction: Direction = "to_device") -> Decoded | None:
        """Return what a line means, by the names of the messages over CAN that do the same; of inputs
        "Input", of another property "w"; None if nothing."""
        words = words_of(message)
        if not words:
            return None
        if words[0] in INPUTS and len(words) > 1 and words[1].isdigit():
            modes, names = INPUTS[words[0]]
            numbers = _floats(words[2 : 2 + len(names)])
            given = dict(zip(names, numbers, strict=False))
            return Decoded("Input", int(words[1][:6]), {**modes, **given}) if numbers else None
        if words[0] == "w" and len(words) > 2:
            return _write(words[1], words[2])
        name, values = _SYSTEM.get(words[0], ("", {}))
        return Decoded(name, BOARD, dict(values)) if name else None

    def name(self, message: bytes) -> str:
        """Return the name of a line: its letters, and the property that it writes."""
        words = words_of(message)
        if not words or (
            words[0] not in INPUTS and words[0] not in _SYSTEM and words[0] not in (*READING, "w")
        ):
            return ""
        if words[0] != "w" or len(words) < 3:
            return words[0] if words[0] != "w" else ""
        found = _AXIS.fullmatch(words[1])
        known = found is not None and found[2] in _WRITTEN
        return f"w {found[2]}" if found is not None and known else "w"

    def letters(self) -> list[str]:
        """Return the names of all lines."""
        return [*READING, *INPUTS, *_SYSTEM, "w", *(f"w {name}" for name in _WRITTEN)]

    def names(self, frame: Frame) -> tuple[str, ...]:
        """Return the names of the lines in a run of bytes, as `Plugin.messages` does."""
        found = Stream(self.framing).messages(frame) if isinstance(frame, bytes) else ()
        return tuple(name for name in map(self.name, found) if name)

    def read_only(self, frame: Frame) -> bool:
        """True if a run of bytes holds whole lines that change nothing, as `Spec.read_only` does."""
        if not isinstance(frame, bytes) or not frame.endswith((b"\n", b"\r", b"!")):
            return False
        stream = Stream(self.framing)
        found = stream.messages(frame)
        return bool(found) and not stream.skipped and all(self.name(one) in READING for one in found)


LINES = Lines()


def _write(name: str, text: str) -> Decoded | None:
    numbers = _floats([text])
    if not numbers:
        return None
    found = _AXIS.fullmatch(name)
    if found is None:
        return Decoded("w", BOARD, {"name": name, "value": numbers[0]})
    axis = int(found[1])
    known = _WRITTEN.get(found[2])
    if known is None:
        return Decoded("w", axis, {"name": name, "value": numbers[0]})
    message, field, whole = known
    if whole and not math.isfinite(numbers[0]):
        return None
    return Decoded(message, axis, {field: int(numbers[0]) if whole else numbers[0]})


# -- questions and answers ---------------------------------------------------------------------------------

_PLAIN = re.compile(r"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|-?nan|-?inf|lu")
WRONG = ("invalid", "not implemented", "unknown command")
"""What an answer begins with that is none."""


def belongs(asked: bytes, message: bytes) -> bool:
    """True if a line may be the answer to a question, or to one of several."""
    text = message.decode("ascii")
    if text.startswith(WRONG):
        return True
    if asked.startswith(b"i"):
        return ": " in text
    parts = text.split(" ")
    count = 2 if asked.startswith((b"f", b"u")) else 1
    return len(parts) == count and all(_PLAIN.fullmatch(part) for part in parts)


def finds(count: int) -> Finds:
    """Return how so many answers are found."""
    return Finds(FROM_DEVICE, belongs, count)


def questions(asked: bytes) -> list[list[str]]:
    """Return the words of the lines of a frame that are answered."""
    found = map(words_of, Stream(TO_DEVICE).messages(asked))
    return [words for words in found if words and words[0] in ("f", "r", "i")]


def plain(text: str, *, whole: bool = False) -> float | None:
    """Return the number in an answer; None if there is none, or it may be cut off (`whole`: never)."""
    if not _PLAIN.fullmatch(text) or text == "lu":
        return None
    cut = not whole and len(text) >= CUT_OFF and "." not in text
    return None if cut else float(text) + 0.0


PROPERTIES: Mapping[str, Mapping[str, str]] = _DEVICE["properties"]
"""Of an axis, by firmware line and what is asked for; of the components' errors by the message over CAN."""
SUPPLY = "vbus_voltage"
FLAGS: Mapping[str, str] = _DEVICE["flags"]
"""By the axis' error (0.5.x): the message with the word of the component."""
