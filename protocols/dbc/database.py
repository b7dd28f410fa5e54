"""A file that describes CAN messages (DBC, KCD, SYM, ARXML) → messages and signals, as numbers in bits.

Rules. cantools reads the file; what frames are made of and decoded with is ours, since a step has many. A
signal is a raw number at a place in the data: an integer, or a binary32 or binary64. Its physical value is
`raw * factor + offset`. Bits that no signal has are 0.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Any, TypeAlias

from protocols.dbc.checksums import Checksum
from protocols.frames import CanFrame, IdMask, exact

Raw: TypeAlias = int | float
FORMATS = {"dbc": "dbc", "kcd": "kcd", "sym": "sym", "arxml": "arxml"}
"""By the end of a file's name."""
FLOATS = {16: "e", 32: "f", 64: "d"}
LARGEST = {16: 65504.0, 32: 3.4028234663852886e38, 64: 1.7e308}
TINY = {16: 2.0**-14, 32: 2.0**-126, 64: 2.0**-1022}
"""Smallest normal numbers: a smaller magnitude counts as 0."""
LONGEST = 8
"""Bytes of a message that is commanded or fed back: classic CAN."""
FILES_KEPT = 16


@dataclass(frozen=True, slots=True)
class Signal:
    """One number of a message."""

    name: str
    start: int
    """Place of its lowest bit in the data as one number: little-endian, or big-endian."""
    bits: int
    big: bool
    signed: bool
    real: bool
    """It is a binary16, 32 or 64, no integer."""
    factor: float
    offset: float
    unit: str
    least: float | None
    most: float | None
    """Physical values between which the file has it, if it says so."""
    choices: tuple[tuple[int, str], ...]
    """Names of raw values."""
    initial: Raw
    case: tuple[str, tuple[int, ...]] | None
    """The multiplexer, and its values with which the message has this signal."""

    def ends(self) -> tuple[float, float]:
        """Return the lowest and the highest raw number."""
        if self.real:
            return -LARGEST[self.bits], LARGEST[self.bits]
        return (-(1 << self.bits - 1), (1 << self.bits - 1) - 1) if self.signed else (0, (1 << self.bits) - 1)

    def read(self, little: int, big: int) -> Raw:
        """Return its raw number in data, given as a number in both orders of bytes."""
        raw = (big if self.big else little) >> self.start & (1 << self.bits) - 1
        if self.real:
            value: float = struct.unpack(f">{FLOATS[self.bits]}", raw.to_bytes(self.bits // 8, "big"))[0]
            return 0.0 if abs(value) < TINY[self.bits] else value
        return raw - (1 << self.bits) if self.signed and raw >> self.bits - 1 else raw

    def bits_of(self, raw: Raw) -> int:
        """Return the bits of a raw number, which saturates. Raises ValueError if it is not finite."""
        if not isfinite(raw):
            raise ValueError(f"{self.name}: {raw} is not finite: it is never sent")
        low, high = self.ends()
        raw = min(max(raw, low), high)
        if self.real:
            raw = 0.0 if abs(raw) < TINY[self.bits] else raw
            return int.from_bytes(struct.pack(f">{FLOATS[self.bits]}", raw), "big") << self.start
        return (round(raw) & (1 << self.bits) - 1) << self.start

    def choice(self, raw: Raw) -> str:
        """Return a raw number with its name, if the file has one."""
        named = dict(self.choices).get(int(raw)) if isfinite(raw) else None
        value = f"{raw * self.factor + self.offset:g}"
        return f"{value} ({named})" if named else value


@dataclass(frozen=True, slots=True)
class Message:
    """One message, with what the file does not say: its counter and its checksum."""

    name: str
    id: int
    extended: bool
    length: int
    signals: Mapping[str, Signal]
    counter: str = ""
    """The signal that counts the messages; "": none"""
    checksum: tuple[str, Checksum] | None = None

    def __deepcopy__(self, memo: object) -> Message:
        """It is a constant."""
        return self

    def __hash__(self) -> int:
        return hash((self.name, self.id, self.extended))

    @property
    def ids(self) -> IdMask:
        """Its id"""
        return exact(self.id, extended=self.extended)

    def encode(self, raws: Mapping[str, Raw]) -> CanFrame:
        """Return the frame; signals that are not given have their initial values. Raises ValueError for a
        number that is not finite."""
        little = big = 0
        for name, signal in self.signals.items():
            if name not in raws and not self._has(signal, raws):
                continue
            bits = signal.bits_of(raws.get(name, signal.initial))
            if signal.big:
                big |= bits
            else:
                little |= bits
        data = self._joined(little, big)
        if self.checksum is not None:
            name, _ = self.checksum
            bits = self._sum(data) << self.signals[name].start
            little, big = (little, big | bits) if self.signals[name].big else (little | bits, big)
            data = self._joined(little, big)
        return CanFrame(self.id, data, self.extended)

    def _joined(self, little: int, big: int) -> bytes:
        both = little | int.from_bytes(big.to_bytes(self.length, "big"), "little")
        return both.to_bytes(self.length, "little")

    def _has(self, signal: Signal, raws: Mapping[str, Raw]) -> bool:
        """True if the message has a signal, with the values of its multiplexers."""
        if signal.case is None:
            return True
        other, values = signal.case
        chosen = raws.get(other, self.signals[other].initial)
        return chosen in values and self._has(self.signals[other], raws)

    def _sum(self, data: bytes) -> int:
        """Return the checksum of data, in which its own bits are 0."""
        assert self.checksum is not None
        name, of = self.checksum
        signal = self.signals[name]
        at = self.length - 1 - signal.start // 8 if signal.big else signal.start // 8
        return of(self.id, self.extended, data, at) & (1 << signal.bits) - 1

    def decode(self, frame: CanFrame) -> dict[str, Raw] | None:
        """Return the raw numbers of a frame with this id; None if its length or checksum is wrong."""
        data = frame.data
        if frame.remote or frame.fd or len(data) != self.length:
            return None
        little, big = int.from_bytes(data, "little"), int.from_bytes(data, "big")
        raws = {name: signal.read(little, big) for name, signal in self.signals.items()}
        if self.checksum is not None:
            name, _ = self.checksum
            signal = self.signals[name]
            mask = (1 << signal.bits) - 1 << signal.start
            bare = (big & ~mask).to_bytes(len(data), "big") if signal.big else b""
            bare = bare or (little & ~mask).to_bytes(len(data), "little")
            if self._sum(bare) != raws[name]:
                return None
        return {name: raw for name, raw in raws.items() if self._has(self.signals[name], raws)}

    def stray(self, frame: CanFrame) -> bool:
        """True if bits are set in data that no signal of the file has."""
        little = big = 0
        for signal in self.signals.values():
            bits = (1 << signal.bits) - 1 << signal.start
            little, big = (little, big | bits) if signal.big else (little | bits, big)
        known = int.from_bytes(self._joined(little, big), "little")
        return bool(int.from_bytes(frame.data, "little") & ~known)


def read_database(name: str, text: str) -> Any:  # noqa: ANN401 -- cantools has no types
    """Return a file as cantools has it: its `messages`. Raises ValueError, in words: without cantools, or for
    a text that it cannot read."""
    if not name:
        raise ValueError('missing; expected the file with its messages, such as "motor.dbc"')
    if not text:
        raise ValueError(f"there is no text of {name!r}: it comes there by loading the robot file")
    try:
        import cantools
    except ImportError as error:
        raise ValueError(f"{name}: reading it needs cantools: pip install 'motor-gateway[dbc]'") from error
    kind = FORMATS.get(name.rpartition(".")[2].lower())
    try:
        found: Any = cantools.database.load_string(text, kind, strict=False)
    except Exception as error:  # of each of its parsers another one
        raise ValueError(f"{name}: not read as a DBC, KCD, SYM or ARXML file: {error}") from error
    if not getattr(found, "messages", ()):  # a diagnostics database has none
        raise ValueError(f"{name}: there is no CAN message in it")
    return found


@lru_cache(FILES_KEPT)
def messages_of(name: str, text: str) -> Mapping[str, Message]:
    """Return the messages of a file by name, but for those of more than 8 bytes, and for signals that reach
    beyond their message. Raises ValueError as `read_database`."""
    return {
        one.name: Message(
            one.name,
            one.frame_id,
            bool(one.is_extended_frame),
            one.length,
            {
                signal.name: made
                for signal in one.signals
                if 0 <= (made := _signal(signal, one.length)).start <= 8 * one.length - made.bits
            },
        )
        for one in read_database(name, text).messages
        if one.length <= LONGEST
    }


def _signal(one: Any, length: int) -> Signal:  # noqa: ANN401 -- cantools has no types
    big = one.byte_order == "big_endian"
    start = one.start
    if (
        big
    ):  # the file names the highest bit, in the way of Motorola: bytes from the left, bits from the right
        start = 8 * length - (8 * (start // 8) + 7 - start % 8) - one.length
    choices = tuple((int(raw), str(text)) for raw, text in (one.choices or {}).items())
    case = (one.multiplexer_signal, tuple(one.multiplexer_ids)) if one.multiplexer_ids else None
    factor, offset = float(one.scale), float(one.offset)
    bounded = one.minimum is not None and one.maximum is not None and one.minimum < one.maximum
    least, most = (float(one.minimum), float(one.maximum)) if bounded else (None, None)
    initial = one.raw_initial or 0
    fields = one.name, start, one.length, big, bool(one.is_signed), bool(one.is_float)
    return Signal(*fields, factor, offset, one.unit or "", least, most, choices, initial, case)
