"""What a device tells: the bytes of its frames → registers, errors, and what its console says.

Rules. A frame that is ill-formed anywhere, or is none of a device's, tells nothing (`decode` gives None). The
answers to the two questions that are asked all the time have a known shape and are read without a loop; they
come to the same. Layouts: mjbots/moteus@db1a762 `docs/protocol/can.md`, `docs/protocol/registers.md`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.moteus.codec import (
    F32,
    FROM_DEVICE,
    INT16,
    REPLY,
    SOUND,
    Error,
    Stream,
    Subframe,
    Values,
    normal,
    parse,
    quantity,
)


@dataclass(frozen=True, slots=True)
class Reply:
    """One frame of a device: its registers, what it could not do, and what its console says."""

    values: Mapping[int, float | None]
    errors: tuple[Error, ...] = ()
    console: bytes = b""


def decode(data: bytes) -> Reply | None:
    """What a device's frame tells; None if it is ill-formed, or is none of a device's."""
    if len(data) not in SOUND:
        return None
    known = SHAPES.get(len(data))
    if known is not None:
        values = known(data)
        if values is not None:
            return Reply(values)
    subframes, sound = parse(data)
    return _reported(subframes) if sound else None


def _reported(subframes: list[Subframe]) -> Reply | None:
    values: dict[int, float | None] = {}
    errors: list[Error] = []
    console = b""
    for subframe in subframes:
        match subframe:
            case Values(code, start, resolution, raw) if code == REPLY:
                if resolution == F32 and not all(math.isfinite(x) or math.isnan(x) for x in raw):
                    return None
                for i, value in enumerate(raw):
                    values[start + i] = quantity(start + i, resolution, value)
            case Error():
                errors.append(subframe)
            case Stream(code, _, piece) if code == FROM_DEVICE:
                console += piece
            case _:
                return None
    return Reply(values, tuple(errors), console)


# The two questions that are asked all the time have answers of a known shape: the same, without a loop.

FAST = bytes.fromhex("11001f01110f")
"""Mode as int8, position, velocity, torque as binary32, fault as int8: 20 bytes of answer."""
FULL = bytes.fromhex("11001c040114060a")
"""And the current, motor's temperature, trajectory, home state, voltage, temperature, fault as int16."""
_FAST = struct.Struct("<2sb2sfff2sb")
_FULL = struct.Struct("<2sb3sffff3shhhhhh11s")
_PADDING = b"\x50" * 11


def _fast(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, position, velocity, torque, c, fault = _FAST.unpack(data)
    if a != b"\x21\x00" or b != b"\x2f\x01" or c != b"\x21\x0f" or mode == -128 or fault == -128:
        return None
    if not math.isfinite(position + velocity + torque):
        return None
    return {0: mode, 1: normal(position), 2: normal(velocity), 3: normal(torque), 0x0F: fault}


def _full(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, position, velocity, torque, current, c, *rest, padding = _FULL.unpack(data)
    if a != b"\x21\x00" or b != b"\x2c\x04\x01" or c != b"\x24\x06\x0a" or padding != _PADDING:
        return None
    if mode == -128 or not math.isfinite(position + velocity + torque + current):
        return None
    floats = (position, velocity, torque, current)
    reply: dict[int, float | None] = {0: mode}
    reply |= {1 + i: normal(value) for i, value in enumerate(floats)}
    return reply | {0x0A + i: quantity(0x0A + i, INT16, value) for i, value in enumerate(rest)}


SHAPES = {20: _fast, 48: _full}
"""By length of the frame."""
