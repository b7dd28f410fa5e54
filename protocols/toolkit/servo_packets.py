"""The packets of servos on a bus: instructions that read and write registers by address, of one servo, of
several or of all, and the statuses that answer them.

Rules. A protocol gives its framing, how a packet is made and read, and what a status is. Who is asked
together answers one after the other, in the order asked. Nobody answers what is written to several.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import Nanos
from protocols.toolkit.memory_map import MemoryMap, Target
from protocols.toolkit.serial import Framing, messages_in

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
EVERYBODY = 0xFE
NAMES = {
    PING: "ping", READ: "read", WRITE: "write", REG_WRITE: "reg_write", ACTION: "action",
    SYNC_READ: "sync_read", SYNC_WRITE: "sync_write",
}  # fmt: skip
IDS = tuple(bytes((number,)) for number in range(256))

Targets: TypeAlias = Mapping[int, Target]
"""What is read, by device, in the order in which they answer."""
Written: TypeAlias = tuple[int, int, bytes]
"""Device, address and data of what is written."""
Status: TypeAlias = tuple[int, int, bytes]
"""Device, error and data of what answers. No class of its own: one is made of every answer."""


class Packet(NamedTuple):
    """One packet to a device, or from it."""

    id: int
    instruction: int
    data: bytes


class ServoPackets:
    """The packets of one protocol. A constant."""

    framing: Framing
    head: struct.Struct
    """With what a packet begins: sync, id, size and instruction."""
    counted: int
    """What the size counts beside the data"""
    answers: int | None = None
    """The instruction of a status, whose error is the first of its data; None: the error stands in the place
    of the instruction, and nothing tells a status from an instruction."""
    addresses: range
    overhead: int
    """Bytes of a status beside what is read"""
    place: struct.Struct
    """An address,"""
    block: struct.Struct
    """and an address and a size, in a packet."""
    longest: int
    """Bytes of a packet's data, at most"""
    joint: Collection[int] = ()
    """Instructions that all answer with one packet"""
    names: Mapping[int, str] = NAMES
    maps: Sequence[MemoryMap] = ()
    """By which what is written has a name."""

    def __init__(self) -> None:
        one, stuffing = self.framing, self.framing.stuffing
        self._error = self.head.size - (self.answers is None)
        """Where the error of a status is,"""
        self._stuffed = None if stuffing is None else stuffing.pattern
        """what is not in one that is read in place,"""
        self._checked = one.checksum, one.covers, one.checksum_size, one.order
        """and its checksum."""

    def __deepcopy__(self, memo: object) -> ServoPackets:
        """It is a constant."""
        return self

    # -- the protocol's own -------------------------------------------------------------------------------

    def answered(self, wanted: Targets, question: Packet, data: bytes) -> tuple[Sequence[Status], bytes]:
        """Return the statuses in an answer that are known by their place, and the rest of it."""
        return self.in_place(wanted, data)

    # -- in a packet --------------------------------------------------------------------------------------

    def unpacked(self, message: bytes) -> Packet:
        """Return what is in a message (as `Stream.feed` gives it)."""
        _, number, _, instruction = self.head.unpack_from(message)
        return Packet(number, instruction, message[self.head.size :])

    def status(self, one: Packet) -> Status | None:
        """Return the status that a packet is; None if it is none."""
        if self.answers is None:
            return one.id, one.instruction, one.data
        ok = one.instruction == self.answers and one.data
        return (one.id, one.data[0], one.data[1:]) if ok else None

    def in_place(self, wanted: Targets, data: bytes) -> tuple[Sequence[Status], bytes]:
        """Return whole statuses with nothing else before and between them, the usual case, which needs no
        search; and what is behind them."""
        found: list[Status] = []
        at, error, stuffed = 0, self._error, self._stuffed
        checksum, covers, check_size, order = self._checked
        for number, (_, size) in wanted.items():
            end = at + error + 1 + size
            behind = end + check_size
            one = data[at:end]
            if len(data) < behind or not one.startswith(status_begins(self, number, size)):
                break
            check = data[end] if check_size == 1 else int.from_bytes(data[end:behind], order)
            if checksum(one[covers:]) != check or (stuffed and one.find(stuffed, error) >= 0):
                break
            found.append((number, one[error], one[error + 1 :]))
            at = behind
        return found, data[at:]

    def targets(self, one: Packet) -> Targets:
        """Return what a packet reads of whom; {} if it reads nothing, or is ill-formed."""
        size = self.block.size
        if one.instruction == READ and len(one.data) == size:
            return {one.id: self._target(one.data)}
        if one.instruction == SYNC_READ and len(one.data) > size:
            return dict.fromkeys(one.data[size:], self._target(one.data))
        return {}

    def _target(self, data: bytes) -> Target:
        at, size = self.block.unpack_from(data)
        return at, size

    def writes(self, one: Packet) -> Sequence[Written]:
        """Return what a packet writes; () if it writes nothing, or is ill-formed."""
        data, first = one.data, self.place.size
        if one.instruction in (WRITE, REG_WRITE) and len(data) > first:
            return ((one.id, self.place.unpack_from(data)[0], data[first:]),)
        first = self.block.size
        if one.instruction != SYNC_WRITE or len(data) <= first or one.id != EVERYBODY:
            return ()
        at, size = self._target(data)
        if not size or (len(data) - first) % (size + 1) or max(data[first :: size + 1]) not in self.addresses:
            return ()
        return [(data[n], at, data[n + 1 : n + 1 + size]) for n in range(first, len(data), size + 1)]

    # -- made ---------------------------------------------------------------------------------------------

    def packet(self, address: int, instruction: int, data: bytes = b"") -> bytes:
        """Return a packet as it stands on the line."""
        head = self.head.pack(self.framing.sync, address, len(data) + self.counted, instruction)
        return self.framing.frame(head + data)

    def sync_write(self, at: int, data: Mapping[int, bytes]) -> bytes:
        """Return what writes data of one size, by device: nobody answers."""
        parts = [IDS[number] + each for number, each in data.items()]
        return self.packet(EVERYBODY, SYNC_WRITE, self.block.pack(at, len(parts[0]) - 1) + b"".join(parts))

    def sync_writes(self, at: int, data: Mapping[int, bytes]) -> Iterator[bytes]:
        """Return the same for any number of devices: in as many packets as carry it."""
        items = list(data.items())
        most = (self.longest - self.block.size) // (1 + len(items[0][1]))
        for first in range(0, len(items), most):
            yield self.sync_write(at, dict(items[first : first + most]))

    def asks(self, wanted: Targets, about: str, delay: Nanos, rank: Rank = Rank.QUESTION) -> Exchange:
        """Return a question to one device, or to several for the same registers.

        Args:
            wanted: what is read of whom.
            about, rank: as in `Exchange`.
            delay: how long all of them together wait before they answer, at most.
        """
        (number, target), *others = wanted.items()
        if others:
            frame = self.packet(EVERYBODY, SYNC_READ, self.block.pack(*target) + bytes(wanted))
        else:
            frame = self.packet(number, READ, self.block.pack(*target))
        return Exchange(frame, self.answer(wanted, delay), rank, about)

    def tells(
        self,
        address: int,
        instruction: int,
        data: bytes,
        about: str,
        delay: Nanos,
        size: int = 0,
        rank: Rank = Rank.QUESTION,
    ) -> Exchange:
        """Return an instruction that a device answers with a status of this size."""
        frame = self.packet(address, instruction, data)
        return Exchange(frame, self.answer({address: (0, size)}, delay), rank, about)

    def answer(self, wanted: Targets, delay: Nanos) -> Answer:
        """Return what is expected as answer to a question."""
        sizes = [size for _, size in wanted.values()]
        most = sum(self.overhead + self.stuffed(size) for size in sizes)
        usual = sum(self.overhead + size for size in sizes)
        return Answer(most, Answers(self, wanted, [*wanted][-1]), delay, usual)

    def stuffed(self, size: int) -> int:
        """Return the bytes on the line of so much data, at most."""
        return size

    # -- in a run of bytes --------------------------------------------------------------------------------

    def question(self, asked: bytes) -> Packet:
        """Return the packet of an exchange."""
        message, _ = self.framing.read(asked, 0)
        return self.unpacked(message) if isinstance(message, bytes) else Packet(EVERYBODY, 0, b"")

    def in_frame(self, frame: Frame) -> tuple[list[Packet], bool]:
        """Return the packets in a run of bytes, and whether it holds nothing else."""
        found, whole = messages_in(self.framing, frame)
        return [self.unpacked(each) for each in found], whole

    def messages(self, frame: Frame) -> tuple[str, ...]:
        """Return the names of the instructions in a run of bytes, with what they write: `Plugin.messages`."""
        return tuple(name for one in self.in_frame(frame)[0] if (name := self._name(one)))

    def _name(self, one: Packet) -> str:
        name, written = self.names.get(one.instruction, ""), self.writes(one)
        if not written:
            return "" if "write" in name else name
        return " ".join((name, *dict.fromkeys(self._register(at, len(data)) for _, at, data in written)))

    def _register(self, at: int, size: int) -> str:
        """Return the name of what is written there, in whatever model it is."""
        for each in self.maps:
            register = each.by_number.get(at)
            if register is not None:
                return register.name + " and on" * (register.size != size)
        return f"{at}"

    def read_only(self, frame: Frame) -> bool:
        """True if a run of bytes holds whole packets that only read: `Spec.read_only`."""
        found, whole = self.in_frame(frame)
        return whole and bool(found) and all(one.instruction == PING or self.targets(one) for one in found)


@lru_cache(maxsize=1024)
def status_begins(packets: ServoPackets, number: int, size: int) -> bytes:
    """Return what stands before error and data of a status of this size."""
    sync, counted = packets.framing.sync, size + packets.counted
    if packets.answers is None:
        return packets.head.pack(sync, number, counted, 0)[:-1]
    return packets.head.pack(sync, number, counted + 1, packets.answers)


# What follows is the same for all that are on a line, and is found once: each of them is given each packet.


@lru_cache(maxsize=16)
def read_packet(packets: ServoPackets, message: bytes) -> Packet:
    """Return what is in a message."""
    return packets.unpacked(message)


@lru_cache(maxsize=16)
def written_by(packets: ServoPackets, one: Packet) -> Sequence[Written]:
    """Return what a packet writes."""
    return tuple(packets.writes(one))


@lru_cache(maxsize=16)
def read_by(packets: ServoPackets, one: Packet) -> Targets:
    """Return what a packet reads of whom."""
    return packets.targets(one)


@lru_cache(maxsize=16)
def concerned(packets: ServoPackets, one: Packet) -> frozenset[int]:
    """Return the devices that an instruction is to, or reads, or writes."""
    written = (number for number, _, _ in written_by(packets, one))
    return frozenset((one.id, *read_by(packets, one), *written))


@lru_cache(maxsize=16)
def only_answers(packets: ServoPackets, frame: Frame) -> bool:
    """True for whole statuses, and nothing else."""
    found, whole = packets.in_frame(frame)
    return whole and not any(one.instruction in packets.names for one in found)


@dataclass(frozen=True, slots=True)
class Answers:
    """Finds the statuses that answer a question: they are over with that of the last device asked."""

    packets: ServoPackets
    wanted: Targets
    last: int
    """The last device that was asked"""

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        """Return where they begin and end. A status that is all error has no data."""
        packets, at, first = self.packets, 0, -1
        found, rest = packets.in_place(self.wanted, held)
        if len(found) == len(self.wanted):
            return 0, len(held) - len(rest)
        if status_begins(packets, self.last, 0)[: len(packets.framing.sync) + 1] not in held:
            return None
        while at + packets.overhead <= len(held):
            message, end = packets.framing.read(held, at)
            status = packets.status(packets.unpacked(message)) if isinstance(message, bytes) else None
            if status is not None and status[0] in self.wanted:
                number, error, data = status
                if len(data) == self.wanted[number][1] or (error and not data):
                    first = at if first < 0 else first
                    if number == self.last:
                        return first, end
            at = max(end, at + 1)
        return None
