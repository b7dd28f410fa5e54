"""Packets of protocol 2.0 on a line: head, stuffed body, CRC; and what it has beside reads and writes of one
block: bulk ones, and fast ones.

Rules. In a body, FF FF FD is followed by another FD: a header begins nowhere else. The answer to a fast read
is one packet which its devices send together, each its block behind that of the one before, with a CRC over
all so far: its length is fixed, so it is not stuffed. (e-Manual, Protocol 2.0)
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from protocols.dynamixel.table import BY_NUMBER, TABLES
from protocols.line import Answer, Exchange, Rank
from protocols.messages import Nanos
from protocols.toolkit import servo_packets as sp
from protocols.toolkit.serial import Framing, Stuffing, crc
from protocols.toolkit.servo_packets import EVERYBODY, Packet, Status, Targets, Written

HEADER, PLAIN = b"\xff\xff\xfd\x00", b"\xff\xff\xfd"
FACTORY_RESET, REBOOT, CLEAR, STATUS = 6, 8, 0x10, 0x55
FAST_SYNC_READ, BULK_READ, BULK_WRITE, FAST_BULK_READ = 0x8A, 0x92, 0x93, 0x9A
FAST = frozenset({FAST_SYNC_READ, FAST_BULK_READ})
NAMES = sp.NAMES | {
    REBOOT: "reboot", FACTORY_RESET: "factory_reset", CLEAR: "clear", BULK_READ: "bulk_read",
    FAST_SYNC_READ: "fast_sync_read", FAST_BULK_READ: "fast_bulk_read", BULK_WRITE: "bulk_write",
}  # fmt: skip
HEAD, LONGEST = 7, 1024
ALERT = 0x80
"""Of the error of a status: there is a hardware error."""
CRC = crc(16, 0x8005, reflected=False)
_HEAD = struct.Struct("<4sBHB")
_BULK = struct.Struct("<BHH")


def _body(head: bytes) -> int | None:
    size = head[5] | head[6] << 8
    return size - 2 if 3 <= size <= LONGEST and (head[4] < 253 or head[4] == EVERYBODY) else None


def _resize(head: bytes, size: int) -> bytes:
    return head[:5] + struct.pack("<H", size + 2)


class Packets(sp.ServoPackets):
    """The packets of protocol 2.0."""

    framing = Framing(HEADER, HEAD, _body, CRC, 2, stuffing=Stuffing(PLAIN, b"\xfd", _resize))
    head, counted, answers = _HEAD, 3, STATUS
    addresses = range(253)
    overhead = 11
    place, block = struct.Struct("<H"), struct.Struct("<HH")
    longest = LONGEST - 3
    names, joint = NAMES, FAST
    maps = TABLES

    def targets(self, one: Packet) -> Targets:
        if one.instruction in (BULK_READ, FAST_BULK_READ):
            whole = len(one.data) % _BULK.size == 0
            return {each: (at, size) for each, at, size in _BULK.iter_unpack(one.data)} if whole else {}
        if one.instruction == FAST_SYNC_READ:
            one = Packet(one.id, sp.SYNC_READ, one.data)
        return super().targets(one)

    def writes(self, one: Packet) -> Sequence[Written]:
        if one.instruction != BULK_WRITE:
            return super().writes(one)
        found: list[Written] = []
        data = one.data
        while len(data) > _BULK.size:
            number, at, size = _BULK.unpack_from(data)
            found.append((number, at, data[5 : 5 + size]))
            data = data[5 + size :]
        return () if data or not all(each for _, _, each in found) else found

    def stuffed(self, size: int) -> int:
        return size + size // 3

    def chained(self, wanted: Targets, about: str, delay: Nanos, *, fast: bool) -> Exchange:
        """Return the question to several devices, for the same registers or not."""
        alike = len(set(wanted.values())) == 1
        if alike and not fast:
            return self.asks(wanted, about, delay)
        data = self.block.pack(*next(iter(wanted.values()))) + bytes(wanted)
        if not alike:
            data = b"".join(_BULK.pack(number, *target) for number, target in wanted.items())
        if not fast:
            frame = self.packet(EVERYBODY, BULK_READ, data)
            return Exchange(frame, self.answer(wanted, delay), Rank.QUESTION, about)
        frame = self.packet(EVERYBODY, FAST_SYNC_READ if alike else FAST_BULK_READ, data)
        head = fast_head(wanted)
        size = HEAD + int.from_bytes(head[5:7], "little")
        answer = Answer(size, Whole(head, size, next(iter(wanted))), delay, size)
        return Exchange(frame, answer, Rank.QUESTION, about)

    def answered(self, wanted: Targets, question: Packet, data: bytes) -> tuple[Sequence[Status], bytes]:
        """Return the statuses in an answer; of a fast read its blocks, up to the first that is wrong or
        missing."""
        if question.instruction not in FAST:
            return super().answered(wanted, question, data)
        found: list[Status] = []
        start, end = data.find(HEADER + bytes((EVERYBODY,))), 0
        at = start + HEAD + 1
        for _, length in wanted.values() if start >= 0 else ():
            behind = at + 2 + length
            check = int.from_bytes(data[behind : behind + 2], "little")
            if len(data) < behind + 2 or CRC(data[start:behind]) != check or data[at + 1] not in wanted:
                break
            found.append((data[at + 1], data[at], data[at + 2 : behind]))
            at = end = behind + 2
        return found, data[end:]


def fast_head(wanted: Targets) -> bytes:
    """Return with what the answer to a fast read begins."""
    return _HEAD.pack(HEADER, EVERYBODY, 1 + sum(4 + size for _, size in wanted.values()), STATUS)


@dataclass(frozen=True, slots=True)
class Whole:
    """Finds the answer to a fast read: it may hold what elsewhere would be stuffed."""

    head: bytes
    size: int
    first: int
    """The first device that was asked"""

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        """Return where it begins and ends."""
        at = held.find(self.head)
        while 0 <= at <= len(held) - self.size:
            if held[at + HEAD + 2] == self.first:
                return at, at + self.size
            at = held.find(self.head, at + 1)
        return None


PACKETS = Packets()


def note(data: bytes) -> str:
    """Return what the answer to a ping says: model and firmware."""
    number = data[0] | data[1] << 8
    return f"{BY_NUMBER.get(number, f'model {number}')}, firmware {data[2]}"
