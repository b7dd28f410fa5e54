"""Frames that a bus may carry: valid ones, damaged ones, and random ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from protocols.conformance import bench as tools
from protocols.conformance.case import Case
from protocols.conformance.random import Random
from protocols.frames import EXTENDED_BIT, OF_BYTES, CanFrame, Frame, IdMask, any_matches
from protocols.plugin import Spec

STRANGE = tuple(
    bytes.fromhex(number)
    for number in (
        "0000c07f",  # NaN, float32 little-endian
        "7fc00000",
        "0000807f",  # infinity, float32
        "000080ff",
        "000000000000f87f",  # NaN, float64
        "007e",  # NaN, float16
        "ffffffff",
        "00000080",
        "ff7f",
        "0080",
    )
)
"""Numbers that are not finite, and the limits of integers."""


SIZES = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths of the data of CAN FD."""


def frames(case: Case, count: int) -> list[Frame]:
    """Return this many frames, most of them like those of alpha, beta and their driver."""
    random, spec = case.random(), case.spec
    valid = [frame for frame in valid_frames(case) if protected(case, frame)]
    ids = sorted({*case.sends, *case.expects})
    return [_frame(spec, valid, ids, random) for _ in range(count)]


def valid_frames(case: Case) -> list[Frame]:
    """Return different frames of both directions from the baseline."""
    distinct = dict.fromkeys(frame for step in case.baseline for frame in (*step.down, *step.up))
    return list(distinct)[:: max(len(distinct) // 400, 1)]


def protected(case: Case, frame: Frame) -> bool:
    """True if the device can detect damage to this frame, according to the spec."""
    return not case.spec.unprotected.intersection(case.plugin.messages(frame))


def other_format(case: Case) -> list[Frame]:
    """Return valid frames with the same numbers as ids, in the other id format (11 or 29 bits)."""
    valid = [frame for frame in valid_frames(case) if isinstance(frame, CanFrame)]
    known = (*case.sends, *case.expects)
    turned = [replace(frame, extended=not frame.extended) for frame in valid]
    return [f for f in turned if (f.extended or f.id <= 0x7FF) and not any_matches(known, f)]


def other_ids(case: Case) -> list[Frame]:
    """Return valid frames with ids of 29 bits in which one bit is wrong, so that they are of no device."""
    spec = case.spec
    known = (*case.sends, *case.expects, *spec.receives_also, *spec.obeys_also)
    valid = [frame for frame in valid_frames(case) if isinstance(frame, CanFrame) and frame.extended]
    up = [frame for frame in valid if any_matches(case.expects, frame)]
    some = [*up[:1], *valid[:1]]
    turned = [replace(frame, id=frame.id ^ 1 << bit) for frame in some for bit in range(29)]
    return [frame for frame in turned if not any_matches(known, frame)]


def shapes(case: Case, ids: Sequence[IdMask]) -> list[Frame]:
    """Return data of every length, none or one of its bits set, under each of these ids. (On a stream: valid
    messages, since others fail their checksum.)"""
    if case.spec.bus in OF_BYTES:
        return valid_frames(case)
    fd, random = case.spec.bus == "canfd", case.random()
    frames: list[Frame] = []
    for each in ids:
        for size in SIZES if fd else range(9):
            number = _one_of(*each, random)
            id_, long = number & ~EXTENDED_BIT, number > 0x7FF
            bits = range(8 * size) if size <= 8 else [random.below(8 * size) for _ in range(64)]
            data = [bytes(size), *((1 << bit).to_bytes(size, "little") for bit in bits)]
            frames += [CanFrame(id_, part, long, fd=fd) for part in data]
    return frames


def patched(frame: Frame, numbers: Sequence[bytes]) -> Iterator[Frame]:
    """Yield a frame with each of these numbers at each place of its first 64 bytes."""
    data = tools.data_of(frame)
    for number in numbers:
        for at in range(min(len(data), 64) - len(number) + 1):
            yield tools.with_data(frame, data[:at] + number + data[at + len(number) :])


def _frame(spec: Spec, valid: list[Frame], ids: list[IdMask], random: Random) -> Frame:
    kind = random.uniform()
    if valid and kind < 0.6:
        frame = random.choice(valid)
        return tools.with_data(frame, damaged(tools.data_of(frame), random))
    data = random.bytes(random.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 12, 64, 300)))
    if (spec.bus in OF_BYTES) == (kind < 0.9):
        return data
    return _can_frame(spec, ids, data, random)


def _can_frame(spec: Spec, ids: list[IdMask], data: bytes, random: Random) -> CanFrame:
    """Return a CAN frame, most often with an id of the spec."""
    known = bool(ids) and random.uniform() < 0.8
    number = _one_of(*random.choice(ids), random) if known else random.bits(11)
    id_ = number & ~EXTENDED_BIT
    extended = number > 0x7FF or random.uniform() < 0.2
    fd = random.uniform() < (0.8 if spec.bus == "canfd" else 0.1)
    remote = not fd and random.uniform() < 0.1
    size = 0 if remote else 64 if fd else 8
    return CanFrame(id_, data[:size], extended, remote, fd, brs=fd)


def _one_of(number: int, mask: int, random: Random) -> int:
    """Return one of these ids, with the bit of its format; those with an open format have 11 bits."""
    most = 0x1FFF_FFFF if number > 0x7FF else 0x7FF
    return number | random.bits(29) & most & ~mask


def damaged(data: bytes, random: Random) -> bytes:
    """Return data cut, lengthened, with a bit or a number in it changed, or unchanged."""
    at, change = random.below(len(data) + 1), random.below(5)
    if change == 0:
        return data[:at]
    if change == 1:
        return data + random.bytes(1 + random.below(8))
    if change == 2 and data:
        return flipped(data, random.below(8 * len(data)))
    if change == 3:
        number = random.choice(STRANGE)
        return (data[:at] + number + data[at + len(number) :])[: len(data)]
    return data


def flipped(data: bytes, bit: int) -> bytes:
    """Return the same data with one bit changed."""
    at = bit // 8
    return data[:at] + bytes((data[at] ^ 1 << bit % 8,)) + data[at + 1 :]
