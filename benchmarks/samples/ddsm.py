"""Benchmark samples of ddsm, measured beside crccheck on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. No package speaks these messages: a user takes
`struct` for the layout and crccheck for the checksum, as here. Bare `struct` knows its message and the
checksum beforehand, and checks nothing: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.ddsm import table as ds

RIVAL = ("crccheck.crc", "crccheck", "struct, and crccheck for the checksum")
_DRIVE, _BODY, _ANSWER = struct.Struct(">BBh5xB"), struct.Struct(">BBh5x"), struct.Struct(">BBhhHBB")
ANSWER = bytes.fromhex("01021000ffce4000000d")


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    theirs: Callable[[Any], Callable[[], Any]]

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- bytes, or numbers
        """True if the bytes are the same, or the numbers in order (bare `struct` has more)."""
        if isinstance(ours, bytes):
            return bool(ours == theirs == struct)
        return bool(tuple(ours.values()) == theirs == struct[1:6])


def prepared(crc: Any) -> Any:  # noqa: ANN401 -- crccheck has no types
    """Return its checksum."""
    return crc.Crc8Maxim.calc


def _made(calc: Callable[[bytes], int]) -> Callable[[], bytes]:
    def make() -> bytes:
        body = _BODY.pack(1, 0x64, -50)
        return body + bytes((calc(body),))

    return make


def _parsed(calc: Callable[[bytes], int]) -> Callable[[], tuple[int, ...]]:
    def parse() -> tuple[int, ...]:
        if calc(ANSWER[:9]) != ANSWER[9]:
            raise ValueError("checksum")
        return _ANSWER.unpack(ANSWER)[1:6]

    return parse


_FINDS, _ASKED = ds.FINDS["DDSM115"], ds.encode("drive", 1, value=-50, brake=0)


def _found() -> Any:  # noqa: ANN401 -- numbers
    """What the driver does with an answer: find it, and read it by what was asked."""
    found = _FINDS(_ASKED, ANSWER)
    assert found is not None
    return ds.read("DDSM115", _ASKED[1], ANSWER[found[0] : found[1]])


SAMPLES = (
    Sample(
        "encode drive",
        lambda: ds.drive(1, value=-50, brake=0),
        lambda: _DRIVE.pack(1, 0x64, -50, 0xDA),
        _made,
    ),
    Sample("decode its answer", _found, lambda: _ANSWER.unpack(ANSWER), _parsed),
)
