"""Wires that a bus may hold: real ones, damaged ones, and what never was one."""

from __future__ import annotations

from dataclasses import replace

from protocols.conformance import bench as play
from protocols.conformance.case import Case
from protocols.conformance.random import Dice
from protocols.frames import CanFrame, Wire
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


def wires(case: Case, count: int) -> list[Wire]:
    """So many wires, most of them like those that alpha, beta and their driver say."""
    dice, spec = case.dice(), case.spec
    said = [wire for wire in conversation(case) if sealed(case, wire)]
    ids = sorted(case.sends | case.expects)
    return [_wire(spec, said, ids, dice) for _ in range(count)]


def conversation(case: Case) -> list[Wire]:
    """Different wires of both directions from a busy day."""
    seen = dict.fromkeys(wire for said in case.day for wire in (*said.down, *said.up))
    return list(seen)[:: max(len(seen) // 400, 1)]


def sealed(case: Case, wire: Wire) -> bool:
    """Whether the device can notice damage in this wire, as far as the spec says."""
    return not case.spec.unsealed.intersection(case.plugin.messages(wire))


def other_format(case: Case) -> list[Wire]:
    """The frames that the devices say, with the same numbers for ids in the other format of id."""
    frames = [wire for wire in conversation(case) if isinstance(wire, CanFrame)]
    known = {(frame.id, frame.extended) for frame in frames}
    turned = [replace(frame, extended=not frame.extended) for frame in frames]
    return [f for f in turned if (f.id, f.extended) not in known and (f.extended or f.id <= 0x7FF)]


def _wire(spec: Spec, said: list[Wire], ids: list[int], dice: Dice) -> Wire:
    kind = dice.uniform()
    if said and kind < 0.6:
        wire = dice.choice(said)
        return play.with_data(wire, damaged(play.data_of(wire), dice))
    data = dice.bytes(dice.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 8, 12, 64, 300)))
    if (spec.bus == "serial") == (kind < 0.9):
        return data
    return _frame(spec, ids, data, dice)


def _frame(spec: Spec, ids: list[int], data: bytes, dice: Dice) -> CanFrame:
    """A CAN frame, most often with an id that means something."""
    known = bool(ids) and dice.uniform() < 0.8
    id_ = dice.choice(ids) if known else dice.bits(11)
    extended = id_ > 0x7FF or dice.uniform() < 0.2
    fd = dice.uniform() < (0.8 if spec.bus == "canfd" else 0.1)
    remote = not fd and dice.uniform() < 0.1
    size = 0 if remote else 64 if fd else 8
    return CanFrame(id_, data[:size], extended, remote, fd, brs=fd)


def damaged(data: bytes, dice: Dice) -> bytes:
    """Cut, lengthened, with a bit or a number in it changed, or as it was."""
    at, change = dice.below(len(data) + 1), dice.below(5)
    if change == 0:
        return data[:at]
    if change == 1:
        return data + dice.bytes(1 + dice.below(8))
    if change == 2 and data:
        return flipped(data, dice.below(8 * len(data)))
    if change == 3:
        number = dice.choice(STRANGE)
        return (data[:at] + number + data[at + len(number) :])[: len(data)]
    return data


def flipped(data: bytes, bit: int) -> bytes:
    """The same bytes with one bit changed."""
    at = bit // 8
    return data[:at] + bytes((data[at] ^ 1 << bit % 8,)) + data[at + 1 :]
