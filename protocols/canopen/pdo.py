"""PDOs: how objects are packed into the up to 8 bytes of a process data frame.

Rules. A *mapping* is a tuple of entries (index, subindex, bits), packed from the lowest bit on; as object
160x and 1Axx hold it, an entry is index << 16 | subindex << 8 | bits. `Packing` is a mapping compiled for
use: plain data, computed once. Values are integers in the order of the mapping; an object that is known as
signed is read as signed. Indices 2 to 7 are dummies: they take room and mean nothing.

Source: CiA 301 "PDO mapping parameter"; package canopen 2.4.1 `pdo/base.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from protocols.canopen.objects import Key, Objects

MOST_BITS = 64
DISABLED = 1 << 31
"""In a PDO's COB-ID: the PDO does not exist."""
NO_RTR = 1 << 30
"""In a PDO's COB-ID: no remote frames."""
SYNCHRONOUS_MOST = 240
"""Transmission types 1 to 240: every n-th SYNC; 0: with a SYNC if a value has changed."""
EVENT_VENDOR = 254
EVENT = 255
"""Event-driven transmission types: sent on events and by an event timer."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One object in a mapping."""

    index: int
    sub: int
    bits: int

    @property
    def key(self) -> Key:
        """Its (index, subindex)."""
        return self.index, self.sub


def decode_entry(value: int) -> Entry:
    """Decode an entry of object 160x or 1Axx."""
    return Entry(value >> 16, value >> 8 & 0xFF, value & 0xFF)


def encode_entry(entry: Entry) -> int:
    """Return the UNSIGNED32 value of an entry in object 160x or 1Axx."""
    return entry.index << 16 | entry.sub << 8 | entry.bits


def entry(objects: Objects, key: Key) -> Entry:
    """Return the entry of a known object, in its whole length. KeyError if it is not known."""
    return Entry(*key, objects[key].type.bits)


def mapping(objects: Objects, *keys: Key) -> tuple[Entry, ...]:
    """Return a mapping of known objects, each in its whole length."""
    return tuple(entry(objects, key) for key in keys)


def is_synchronous(transmission: int) -> bool:
    """True if a PDO of this transmission type is sent, or takes effect, with a SYNC."""
    return transmission <= SYNCHRONOUS_MOST


@dataclass(frozen=True, slots=True)
class Packing:
    """A mapping compiled for packing and unpacking."""

    entries: tuple[Entry, ...]
    size: int
    """Bytes of the frame."""
    form: str
    """Format for `struct`; "" if an entry has not 8, 16, 32 or 64 bits."""
    signed: tuple[bool, ...]

    def __deepcopy__(self, _: dict[int, object]) -> Packing:
        return self

    def pack(self, values: Sequence[int]) -> bytes:
        """Pack the values into a frame's data. ValueError if a value does not fit its entry."""
        if self.form:
            try:
                return struct.pack(self.form, *values)
            except struct.error as error:
                raise ValueError(f"{tuple(values)} does not fit {self.entries}") from error
        packed = at = 0
        for value, one, signed in zip(values, self.entries, self.signed, strict=True):
            half = 1 << one.bits - 1 if signed else 0
            if not -half <= value < (half or 1 << one.bits):
                raise ValueError(f"{value} does not fit {one}")
            packed |= (value & (1 << one.bits) - 1) << at
            at += one.bits
        return packed.to_bytes(self.size, "little")

    def unpack(self, data: bytes) -> tuple[int, ...] | None:
        """Unpack a frame's data; None if it is too short. Bytes beyond the mapping are ignored."""
        if len(data) < self.size:
            return None
        if self.form:
            return struct.unpack_from(self.form, data)
        packed, values = int.from_bytes(data, "little"), []
        for one, signed in zip(self.entries, self.signed, strict=True):
            value = packed & (1 << one.bits) - 1
            values.append(value - (1 << one.bits) if signed and value >> one.bits - 1 else value)
            packed >>= one.bits
        return tuple(values)


_LETTERS = {8: "b", 16: "h", 32: "i", 64: "q"}


def packing(objects: Objects, entries: Sequence[Entry]) -> Packing:
    """Compile a mapping. ValueError if it is longer than a frame, or an entry has no bits."""
    bits = sum(one.bits for one in entries)
    if bits > MOST_BITS:
        raise ValueError(f"{bits} bits are mapped: a PDO has room for {MOST_BITS}")
    if any(not one.bits for one in entries):
        raise ValueError("an entry without bits")
    signed = tuple(one.key in objects and objects[one.key].type.signed for one in entries)
    letters = [_LETTERS.get(one.bits, "") for one in entries]
    form = "<" + "".join(x if s else x.upper() for x, s in zip(letters, signed, strict=True))
    return Packing(tuple(entries), -(-bits // 8), form if all(letters) else "", signed)
