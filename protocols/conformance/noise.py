"""Wires that a bus may hold: real ones, damaged ones, and what never was one."""

from __future__ import annotations

from dataclasses import replace

from protocols.conformance import bench as play
from protocols.conformance.case import Case
from protocols.conformance.random import Random
from protocols.frames import CanFrame, Frame
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
"""Numbers that are none, and the ends of integers."""


def frames(case: Case, count: int) -> list[Frame]:
    """So many wires, most of them like those that alpha, beta and their driver say."""
    random, spec = case.random(), case.spec
    said = [frame for frame in conversation(case) if sealed(case, frame)]
    ids = sorted(case.sends | case.expects)
    return [_frame(spec, said, ids, random) for _ in range(count)]


def conversation(case: Case) -> list[Frame]:
    """Different wires of both directions from a busy day."""
    seen = dict.fromkeys(frame for said in case.day for frame in (*said.down, *said.up))
    return list(seen)[:: max(len(seen) // 400, 1)]


def sealed(case: Case, frame: Frame) -> bool:
    """Whether the device can notice damage in this wire, as far as the spec says."""
    return not case.spec.unprotected.intersection(case.plugin.messages(frame))


def other_format(case: Case) -> list[Frame]:
    """The frames that the devices say, with the same numbers for ids in the other format of id."""
    frames = [raw for raw in conversation(case) if isinstance(raw, CanFrame)]
    known = {(frame.id, frame.extended) for frame in frames}
    turned = [replace(frame, extended=not frame.extended) for frame in frames]
    return [f for f in turned if (f.id, f.extended) not in known and (f.extended or f.id <= 0x7FF)]


def _frame(spec: Spec, said: list[Frame], ids: list[int], random: Random) -> Frame:
    kind = random.uniform()
    if said and kind < 0.6:
        frame = random.choice(said)
        return play.with_data(frame, damaged(play.data_of(frame), random))
    data = random.bytes(random.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 12, 64, 300)))
    if (spec.bus == "serial") == (kind < 0.9):
        return data
    return _can_frame(spec, ids, data, random)


def _can_frame(spec: Spec, ids: list[int], data: bytes, random: Random) -> CanFrame:
    """A CAN frame, most often with an id that means something."""
    known = bool(ids) and random.uniform() < 0.8
    id_ = random.choice(ids) if known else random.bits(11)
    extended = id_ > 0x7FF or random.uniform() < 0.2
    fd = random.uniform() < (0.8 if spec.bus == "canfd" else 0.1)
    remote = not fd and random.uniform() < 0.1
    size = 0 if remote else 64 if fd else 8
    return CanFrame(id_, data[:size], extended, remote, fd, brs=fd)


def damaged(data: bytes, random: Random) -> bytes:
    """Cut, lengthened, with a bit or a number in it changed, or as it was."""
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
    """The same bytes with one bit changed."""
    at = bit // 8
    return data[:at] + bytes((data[at] ^ 1 << bit % 8,)) + data[at + 1 :]
