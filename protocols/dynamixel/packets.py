"""Packets of protocol 2.0 on a line: head, stuffed body, CRC; what they read and write, and what answers
them.

Rules. In a body, FF FF FD is followed by another FD: a header begins nowhere else. The answer to a fast read
is one packet which its devices send together, each its block behind that of the one before, with a CRC over
all so far: its length is fixed, so it is not stuffed. (e-Manual, Protocol 2.0)
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from protocols.dynamixel.table import BY_NUMBER, register_at
from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import Nanos, value
from protocols.toolkit.serial import Framing, Stream, Stuffing, crc

HEADER, PLAIN, ALL = b"\xff\xff\xfd\x00", b"\xff\xff\xfd", 0xFE
PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET, REBOOT = 1, 2, 3, 4, 5, 6, 8
CLEAR, STATUS = 0x10, 0x55
SYNC_READ, SYNC_WRITE, FAST_SYNC_READ, BULK_READ, BULK_WRITE, FAST_BULK_READ = (
    0x82,
    0x83,
    0x8A,
    0x92,
    0x93,
    0x9A,
)
READS = frozenset({READ, SYNC_READ, FAST_SYNC_READ, BULK_READ, FAST_BULK_READ})
FAST = frozenset({FAST_SYNC_READ, FAST_BULK_READ})
NAMES = {
    PING: "ping", READ: "read", WRITE: "write", REG_WRITE: "reg_write", ACTION: "action", REBOOT: "reboot",
    FACTORY_RESET: "factory_reset", CLEAR: "clear", SYNC_READ: "sync_read", BULK_READ: "bulk_read",
    FAST_SYNC_READ: "fast_sync_read", FAST_BULK_READ: "fast_bulk_read", SYNC_WRITE: "sync_write",
    BULK_WRITE: "bulk_write",
}  # fmt: skip
HEAD, LONGEST = 7, 1024
ALERT = 0x80
"""Of the error of a status: there is a hardware error."""
CRC = crc(16, 0x8005, reflected=False)


def _body(head: bytes) -> int | None:
    size = head[5] | head[6] << 8
    return size - 2 if 3 <= size <= LONGEST and (head[4] < 253 or head[4] == ALL) else None


def _resize(head: bytes, size: int) -> bytes:
    return head[:5] + struct.pack("<H", size + 2)


FRAMING = Framing(HEADER, HEAD, _body, CRC, 2, stuffing=Stuffing(PLAIN, b"\xfd", _resize))

Target: TypeAlias = tuple[int, int]
"""Address and length of what is read."""
Targets: TypeAlias = Mapping[int, Target]
"""By device, in the order in which they answer."""


@value
class Packet:
    """One packet, without its stuffing."""

    id: int
    instruction: int
    parameters: bytes


def packet(address: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Return a packet as it stands on the line."""
    return FRAMING.frame(HEADER + struct.pack("<BHB", address, len(parameters) + 3, instruction) + parameters)


def unpack(message: bytes) -> Packet:
    """Return what is in a message (as `Stream.feed` gives it)."""
    return Packet(message[4], message[HEAD], message[HEAD + 1 :])


def targets(one: Packet) -> Targets:
    """Return what a packet reads of whom; {} if it reads nothing, or is ill-formed."""
    given = one.parameters
    if one.instruction in (BULK_READ, FAST_BULK_READ):
        return {} if len(given) % 5 else {each: at for each, *at in struct.iter_unpack("<BHH", given)}  # type: ignore[misc]
    if one.instruction not in READS or len(given) < 4:
        return {}
    target = struct.unpack_from("<HH", given)
    return {one.id: target} if one.instruction == READ else dict.fromkeys(given[4:], target)


def writes(one: Packet) -> Sequence[tuple[int, int, bytes]]:
    """Return what a packet writes: device, address, data; () if it writes nothing, or is ill-formed."""
    given, found = one.parameters, list[tuple[int, int, bytes]]()
    if one.instruction == WRITE and len(given) > 2:
        return ((one.id, given[0] | given[1] << 8, given[2:]),)
    if one.instruction == SYNC_WRITE and len(given) > 4:
        start, length = struct.unpack_from("<HH", given)
        if (len(given) - 4) % (length + 1) or not length:
            return ()
        return [
            (given[at], start, given[at + 1 : at + 1 + length]) for at in range(4, len(given), length + 1)
        ]
    while one.instruction == BULK_WRITE and len(given) > 5:
        each, start, length = struct.unpack_from("<BHH", given)
        found.append((each, start, given[5 : 5 + length]))
        given = given[5 + length :]
    return () if given or not all(data for _, _, data in found) else found


# -- questions, and what answers them ------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Statuses:
    """Ends an answer behind the status of the last device that was asked."""

    last: int
    size: int
    """Bytes of its parameters; of the answer to a fast read, all"""
    first: int
    """The first device that was asked"""

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        first = at = held.find(HEADER)
        while at >= 0 and at + HEAD <= len(held):
            end = at + HEAD + (held[at + 5] | held[at + 6] << 8)
            if held[at + 4] == self.last and end <= len(held) and not self._of_another(held[at:end]):
                return (at if self.last == ALL else first), end
            at = held.find(HEADER, at + HEAD)
        return None

    def _of_another(self, status: bytes) -> bool:
        """True for a whole answer to another question: it is late."""
        if self.last == ALL:
            return len(status) != self.size or status[9] != self.first
        found = Stream(FRAMING).messages(status)
        return bool(found) and len(unpack(found[0]).parameters) not in (1, 1 + self.size)


def question(
    instruction: int,
    wanted: Targets,
    rank: Rank,
    about: str,
    delay: Nanos,
    parameters: bytes = b"",
    tries: int = 1,
) -> Exchange:
    """Return what asks devices, or one device (with `parameters` of what is no reading) for its answer.

    Args:
        instruction: what it is.
        wanted: what is read of whom, in the order in which they answer; of what is no reading only the length
            counts.
        rank, about, tries: as in `Exchange`.
        delay: the longest that all of them together wait before they answer.
        parameters: of an instruction that reads nothing.
    """
    last = list(wanted)[-1]
    size = wanted[last][1]
    fast, single = instruction in FAST, instruction not in READS or instruction == READ
    if instruction in (BULK_READ, FAST_BULK_READ):
        parameters = b"".join(struct.pack("<BHH", each, *at) for each, at in wanted.items())
    elif instruction in READS:
        parameters = struct.pack("<HH", *wanted[last]) + (b"" if single else bytes(wanted))
    if fast:
        most = size = 8 + sum(4 + length for _, length in wanted.values())
        last = ALL
    else:
        most = sum(11 + length + length // 3 for _, length in wanted.values())
    frame = packet(last if single else ALL, instruction, parameters)
    return Exchange(frame, Answer(most, Statuses(last, size, next(iter(wanted))), delay), rank, about, tries)


def sync_write(start: int, data: Mapping[int, bytes]) -> bytes:
    """Return what writes data of one length, by device: nobody answers it."""
    length = len(next(iter(data.values())))
    each = b"".join(bytes((address,)) + one for address, one in data.items())
    return packet(ALL, SYNC_WRITE, struct.pack("<HH", start, length) + each)


def blocks(data: bytes, wanted: Targets) -> tuple[list[Packet], int]:
    """Return the blocks of the answer to a fast read as statuses, up to the first that is wrong or missing;
    and how many bytes they are."""
    start = data.find(HEADER + bytes((ALL,)))
    at, found = start + 8, list[Packet]()
    for _, length in wanted.values() if start >= 0 else ():
        end = at + 2 + length
        if (
            len(data) < end + 2
            or CRC(data[start:end]) != data[end] | data[end + 1] << 8
            or data[at + 1] not in wanted
        ):
            break
        found.append(Packet(data[at + 1], STATUS, data[at : at + 1] + data[at + 2 : end]))
        at = end + 2
    return found, at if found else 0


# -- what is in a run of bytes ---------------------------------------------------------------------------


def packets(frame: Frame) -> tuple[list[Packet], bool]:
    """Return the packets in a run of bytes, and whether it holds nothing else."""
    if not isinstance(frame, bytes):
        return [], False
    found = Stream(FRAMING).messages(frame)
    return [unpack(message) for message in found], sum(len(FRAMING.frame(each)) for each in found) == len(
        frame
    )


def names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the messages to a device, with the register that they write: `Plugin.messages`."""
    return tuple(filter(None, map(_name, packets(frame)[0])))


def _name(one: Packet) -> str:
    if one.instruction not in (WRITE, REG_WRITE, SYNC_WRITE, BULK_WRITE):
        return NAMES.get(one.instruction, "")
    written = writes(Packet(one.id, WRITE, one.parameters) if one.instruction == REG_WRITE else one)
    registers = dict.fromkeys(register_at(start, len(data)) for _, start, data in written)
    return " ".join((NAMES[one.instruction], *registers)) if registers else ""


def read_only(frame: Frame) -> bool:
    """True if a run of bytes holds whole packets that only read: `Spec.read_only`."""
    found, whole = packets(frame)
    return whole and bool(found) and all(one.instruction == PING or targets(one) for one in found)


def note(parameters: bytes) -> str:
    """Return what the answer to a ping says: model and firmware."""
    number = parameters[0] | parameters[1] << 8
    return f"{BY_NUMBER.get(number, f'model {number}')}, firmware {parameters[2]}"
