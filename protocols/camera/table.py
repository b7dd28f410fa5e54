"""What a camera reports of each picture: how the picture is, and one marker in it. All is little-endian.

    CA 3E | picture u32 | age, ns, u64 | width u16 | height u16 | rate, 0.01 Hz, u16 | grey u8 | faults u8 |
    contents u8 | marker u32 | position 3 × f64 | orientation 4 × f64 | variance 2 × f64 |
    turn variance f64 | CRC-32 of all behind CA 3E

A picture with several markers is several messages of one number; one that shows nothing is one, too. `age` is
the time from when the picture was taken to when the message was sent. Numbers are those of `Marker`; which of
them are there stands in `contents`, and those that are not are 0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from protocols.messages import SECOND, Marker, Nanos
from protocols.plugin import FaultInfo
from protocols.sensors.marker import KIND
from protocols.toolkit.serial import CRC32, Framing
from protocols.toolkit.table import TINY

NAME = "camera"
MARKER, ORIENTATION, VARIANCE, TURN_VARIANCE = 1, 2, 4, 8
CONTENTS = MARKER | ORIENTATION | VARIANCE | TURN_VARIANCE
MOST = 1_000_000
"""The number of a marker"""
MAX_AGE: Nanos = 10 * SECOND
SIZE, DARK, SLOW = 1, 2, 4
"""Faults, as bits"""
FAULTS: Mapping[int, FaultInfo] = {
    SIZE: FaultInfo(
        "pictures of another size",
        "the camera has no such size, and gives the nearest: no marker is measured, since its lens is "
        "described for the size that was asked for",
        "set width and height of the bus's table to a size of the camera (v4l2-ctl --list-formats-ext)",
        latching=False,
    ),
    DARK: FaultInfo(
        "pictures are black",
        "its lens is covered, there is no light, or its exposure is set wrong",
        "uncover it, switch on the light; darkest = 0 of the bus's table if the dark is usual",
        latching=False,
    ),
    SLOW: FaultInfo(
        "pictures come too slowly",
        "the camera exposes longer in the dark, shares its USB with another one, or the machine is busy",
        "more light or a fixed exposure, a port of its own, smaller pictures",
        latching=False,
    ),
}

_SYNC = b"\xca\x3e"
_LAYOUT = struct.Struct("<2sIQHHHBBBI10d")
FRAMING = Framing(_SYNC, len(_SYNC), lambda _: _LAYOUT.size - len(_SYNC), CRC32, 4, covers=len(_SYNC))
_LIMITS = tuple(
    (quantity.low, quantity.high)
    for name, count in (("position", 3), ("orientation", 4), ("variance", 2), ("turn_variance", 1))
    for quantity in [KIND.quantities[name]] * count
)


class Picture(NamedTuple):
    """How a picture is."""

    number: int
    age: Nanos
    width: int
    height: int
    rate: int
    """0.01 pictures per second"""
    grey: int
    """Mean of its pixels, of 255"""
    faults: int = 0

    @property
    def text(self) -> str:
        """For a person."""
        return f"{self.width} × {self.height}, {self.rate / 100.0:.1f} pictures per second, grey {self.grey}"


def encode(picture: Picture, seen: Marker) -> bytes:
    """Return what is sent of a marker in a picture. Raises ValueError for numbers that no camera measures."""
    numbers: list[float] = []
    contents = 0
    for bit, values, size in zip(
        (MARKER, ORIENTATION, VARIANCE, TURN_VARIANCE),
        (
            seen.position,
            seen.orientation,
            seen.variance,
            None if seen.turn_variance is None else (seen.turn_variance,),
        ),
        (3, 4, 2, 1),
        strict=True,
    ):
        there = values is not None and seen.marker is not None
        contents |= bit if there else 0
        numbers += values if there and values else (0.0,) * size
    if not (_possible(numbers) and 0 <= (seen.marker or 0) <= MOST):
        raise ValueError(f"{seen} is beyond what a camera measures")
    number, age, width, height, rate, grey, faults = picture
    numbers = [0.0 if abs(each) < TINY else each for each in numbers]
    head = number & 0xFFFFFFFF, min(max(age, 0), MAX_AGE), width, height, min(rate, 0xFFFF), grey, faults
    return FRAMING.frame(_LAYOUT.pack(_SYNC, *head, contents, seen.marker or 0, *numbers))


def decode(message: bytes, t: Nanos, sensor: str) -> tuple[Picture, Marker] | None:
    """Decode a message without its checksum that came at t; None if it has numbers that there are not."""
    _, *head, contents, marker, n0, n1, n2, n3, n4, n5, n6, n7, n8, n9 = _LAYOUT.unpack(message)
    picture, numbers = Picture(*head), (n0, n1, n2, n3, n4, n5, n6, n7, n8, n9)
    known = not contents & ~CONTENTS and not picture.faults & ~(SIZE | DARK | SLOW)
    if not known or marker > MOST or picture.age > MAX_AGE or not _possible(numbers):
        return None
    if not contents & MARKER:
        return (
            None if contents or marker or any(numbers) else (picture, Marker(sensor, t - picture.age, None))
        )
    seen = Marker(
        sensor,
        t - picture.age,
        marker,
        (n0, n1, n2),
        (n3, n4, n5, n6) if contents & ORIENTATION else None,
        (n7, n8) if contents & VARIANCE else None,
        n9 if contents & TURN_VARIANCE else None,
    )
    return picture, seen


def _possible(numbers: tuple[float, ...] | list[float]) -> bool:
    limits = zip(numbers, _LIMITS, strict=True)
    return all(math.isfinite(each) and low <= each <= high for each, (low, high) in limits)


def faults_of(bits: int) -> Iterator[int]:
    """Yield the codes of faults."""
    yield from (code for code in FAULTS if bits & code)
