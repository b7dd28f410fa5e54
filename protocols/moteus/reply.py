"""Replies of a device: the bytes of its frames → registers, errors, and console output.

Rules. A frame that is malformed anywhere, or is no reply, has no meaning (`decode` returns None). The replies
to the two queries that are sent all the time have a known layout and are decoded without a loop, to the same
result. Layouts: mjbots/moteus@db1a762 `docs/protocol/can.md`, `docs/protocol/registers.md`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

from protocols.moteus import codec
from protocols.moteus.codec import Console, Error, Subframe, Values, from_raw, normalise


@dataclass(frozen=True, slots=True)
class Reply:
    """One frame of a device: its registers, the registers that it could not read or write, console output."""

    values: Mapping[int, float | None]
    errors: tuple[Error, ...] = ()
    console: bytes = b""


def decode(data: bytes) -> Reply | None:
    """Decode a device's frame; None if it is malformed or no reply."""
    if len(data) not in codec.LENGTHS:
        return None
    fast_path = FAST_PATHS.get(len(data))
    if fast_path is not None:
        values = fast_path(data)
        if values is not None:
            return Reply(values)
    subframes, well_formed = codec.parse(data)
    return _reply(subframes) if well_formed else None


def _reply(subframes: list[Subframe]) -> Reply | None:
    values: dict[int, float | None] = {}
    errors: list[Error] = []
    console = b""
    for subframe in subframes:
        match subframe:
            case Values(codec.REPLY, start, resolution, raw):
                if resolution == codec.F32 and any(math.isinf(x) for x in raw):
                    return None
                for register, value in enumerate(raw, start):
                    values[register] = from_raw(register, resolution, value)
            case Error():
                errors.append(subframe)
            case Console(codec.FROM_DEVICE, _, piece):
                console += piece
            case _:
                return None
    return Reply(values, tuple(errors), console)


# -- the two queries that are sent all the time --------------------------------------------------------

FAST = bytes.fromhex("11001f01110f")
"""Query for mode as int8, position, velocity, torque as binary32, fault as int8: a reply of 20 bytes."""
FULL = bytes.fromhex("11001c040114060a")
"""Query for current, motor temperature, trajectory, home state, voltage, temperature as well."""
_FAST = struct.Struct("<2sb2sfff2sb")
_FULL = struct.Struct("<2sb3sffff3shhhhhh11s")
_PADDING = b"\x50" * 11


def _fast(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, position, velocity, torque, c, fault = _FAST.unpack(data)
    if a != b"\x21\x00" or b != b"\x2f\x01" or c != b"\x21\x0f" or mode == -128 or fault == -128:
        return None
    if not math.isfinite(position + velocity + torque):
        return None
    return {0: mode, 1: normalise(position), 2: normalise(velocity), 3: normalise(torque), 0x0F: fault}


def _full(data: bytes) -> dict[int, float | None] | None:
    a, mode, b, position, velocity, torque, current, c, *rest, padding = _FULL.unpack(data)
    if a != b"\x21\x00" or b != b"\x2c\x04\x01" or c != b"\x24\x06\x0a" or padding != _PADDING:
        return None
    if mode == -128 or not math.isfinite(position + velocity + torque + current):
        return None
    values: dict[int, float | None] = {0: mode}
    values |= {1 + i: normalise(value) for i, value in enumerate((position, velocity, torque, current))}
    return values | {0x0A + i: from_raw(0x0A + i, codec.INT16, value) for i, value in enumerate(rest)}


FAST_PATHS = {20: _fast, 48: _full}
"""Decoders by length of the frame; they return None for another layout."""
