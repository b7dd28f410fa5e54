"""RTPS 2.3 on the wire: datagrams ↔ submessages, and the parameter lists of discovery. No socket, no clock.

Rules. Little endian is written, both are read. `read` never raises: what is malformed ends the datagram, and
what comes before it counts. Sequence numbers and counts are plain integers; an entity is its four bytes.

Source: OMG formal/2021-03-03, "The Real-time Publish-Subscribe Protocol, version 2.3", chapters 8.3 and 9.4
(submessages), 9.6 (parameters); DDS-RPC 1.0 and Fast DDS for the identity of a request in inline QoS.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

MAGIC, VERSION, VENDOR = b"RTPS", b"\x02\x03", b"\x00\x00"
"""Of no vendor that has a number."""
HEADER = struct.Struct("<4s2s2s12s")
GUID = 16
UNKNOWN = bytes(4)
MOST_BITS = 256
"""Of a set of numbers."""
MOST_SUBMESSAGES = 256

Prefix: TypeAlias = bytes
"""Of a participant: 12 bytes"""
Entity: TypeAlias = bytes
"""Of an endpoint in its participant: 4 bytes"""
Guid: TypeAlias = bytes
"""Both: 16 bytes"""


class Locator(NamedTuple):
    """Where somebody receives, by UDP over IPv4."""

    host: str
    port: int


class Identity(NamedTuple):
    """Of a sample: who wrote it, and its number."""

    guid: Guid
    number: int


class Data(NamedTuple):
    """A sample, or what ends one (without a payload)."""

    reader: Entity
    writer: Entity
    number: int
    payload: bytes
    """With its encapsulation; "" if there is none"""
    related: Identity | None = None
    """The sample that it is about: of a reply, its request"""
    ends: bool = False
    """Whether the instance is disposed or unregistered"""
    key: bytes = b""
    """Guid of what ends"""


class Fragment(NamedTuple):
    """Some fragments of a sample."""

    reader: Entity
    writer: Entity
    number: int
    first: int
    """From 1"""
    parts: int
    size: int
    """Of a fragment"""
    total: int
    """Of the sample"""
    payload: bytes
    related: Identity | None = None


class Heartbeat(NamedTuple):
    """What a writer has."""

    reader: Entity
    writer: Entity
    first: int
    last: int
    serial: int
    final: bool
    """Whether no answer is needed"""


class Acknack(NamedTuple):
    """What a reader has (all below `base`), and what it lacks."""

    reader: Entity
    writer: Entity
    base: int
    missing: tuple[int, ...]
    serial: int


class Gap(NamedTuple):
    """Numbers that are no sample for this reader: from `start` to before `base`, and those."""

    reader: Entity
    writer: Entity
    start: int
    base: int
    others: tuple[int, ...] = ()


class NackFragments(NamedTuple):
    """Fragments of a sample that a reader lacks."""

    reader: Entity
    writer: Entity
    number: int
    missing: tuple[int, ...]


Submessage: TypeAlias = Data | Fragment | Heartbeat | Acknack | Gap | NackFragments


class Received(NamedTuple):
    """A submessage with what the datagram says about it."""

    source: Prefix
    destination: Prefix
    """Zeros: everybody"""
    content: Submessage


_INFO_TS, _INFO_SRC, _INFO_DST = 0x09, 0x0C, 0x0E
_ACKNACK, _HEARTBEAT, _GAP, _NACK_FRAG, _DATA, _DATA_FRAG = 0x06, 0x07, 0x08, 0x12, 0x15, 0x16
_RELATED, _RELATED_OLD, _KEY_HASH, _STATUS, _SENTINEL = 0x0083, 0x800F, 0x0070, 0x0071, 0x0001
ENDPOINT_GUID, PARTICIPANT_GUID = 0x005A, 0x0050
ENDING = 3
"""Status: disposed, unregistered"""


# -- reading ------------------------------------------------------------------------------------


def read(datagram: bytes) -> list[Received]:
    """Return what a datagram has, up to the first thing that is wrong."""
    found: list[Received] = []
    if len(datagram) < HEADER.size or datagram[:4] != MAGIC:
        return found
    source, destination = datagram[8:20], bytes(12)
    at = HEADER.size
    try:
        for _ in range(MOST_SUBMESSAGES):
            if at + 4 > len(datagram):
                break
            kind, flags = datagram[at], datagram[at + 1]
            order = "<" if flags & 1 else ">"
            (size,) = struct.unpack_from(order + "H", datagram, at + 2)
            end = at + 4 + size if size or kind == _INFO_TS else len(datagram)
            if end > len(datagram):
                break
            body = datagram[at + 4 : end]
            at = end
            if kind == _INFO_DST:
                destination = body[:12]
            elif kind == _INFO_SRC:
                source = body[8:20]
            elif (one := _submessage(kind, flags, order, body)) is not None:
                found.append(Received(source, destination, one))
    except (struct.error, IndexError, ValueError):
        pass
    return found


def _submessage(kind: int, flags: int, order: str, body: bytes) -> Submessage | None:
    ends = body[:4], body[4:8]
    match kind:
        case 0x15 | 0x16:
            return _sample(kind, flags, order, body)
        case 0x07:
            first_high, first, last_high, last, count = struct.unpack_from(order + "iIiII", body, 8)
            numbers = _number(first_high, first), _number(last_high, last)
            return Heartbeat(*ends, *numbers, count, bool(flags & 2))
        case 0x06:
            base, missing, at = _set(order, body, 8)
            (count,) = struct.unpack_from(order + "I", body, at)
            return Acknack(*ends, base, missing, count)
        case 0x08:
            high, low = struct.unpack_from(order + "iI", body, 8)
            base, others, _ = _set(order, body, 16)
            return Gap(*ends, _number(high, low), base, others)
        case 0x12:
            high, low, first, bits = struct.unpack_from(order + "iIII", body, 8)
            return NackFragments(*ends, _number(high, low), _bits(order, body, 24, first, bits))
    return None


def _sample(kind: int, flags: int, order: str, body: bytes) -> Data | Fragment:
    to_qos, reader, writer, high, low = struct.unpack_from(order + "2xH4s4siI", body)
    number, at = _number(high, low), 4 + to_qos
    related, status, key = None, 0, b""
    if flags & 2:
        parameters, at = _parameters(order, body, at)
        for pid, value in parameters:
            if pid in (_RELATED, _RELATED_OLD) and len(value) >= GUID + 8:
                related = Identity(value[:GUID], _number(*struct.unpack_from(order + "iI", value, GUID)))
            elif pid == _STATUS and len(value) >= 4:
                status = value[3]
            elif pid == _KEY_HASH:
                key = value[:GUID]
    if kind == _DATA_FRAG:
        first, count, size, total = struct.unpack_from(order + "IHHI", body, 20)
        return Fragment(reader, writer, number, first, count, size, total, body[at:], related)
    payload = body[at:] if flags & 0x0C else b""
    if flags & 8 and not key:  # of what ends, the payload is its key
        key = dict(read_parameters(payload)).get(ENDPOINT_GUID) or payload[-GUID:]
    return Data(reader, writer, number, payload if flags & 4 else b"", related, bool(status & ENDING), key)


def _number(high: int, low: int) -> int:
    return (high << 32) | low


def _set(order: str, body: bytes, at: int) -> tuple[int, tuple[int, ...], int]:
    """Return base, numbers, and where it ends."""
    high, low, bits = struct.unpack_from(order + "iII", body, at)
    base = _number(high, low)
    return base, _bits(order, body, at + 12, base, bits), at + 12 + (bits + 31) // 32 * 4


def _bits(order: str, body: bytes, at: int, base: int, bits: int) -> tuple[int, ...]:
    if bits > MOST_BITS:
        raise ValueError(bits)
    words = struct.unpack_from(f"{order}{(bits + 31) // 32}I", body, at)
    return tuple(base + i for i in range(bits) if words[i // 32] >> (31 - i % 32) & 1)


def _parameters(order: str, data: bytes, at: int) -> tuple[list[tuple[int, bytes]], int]:
    """Return the parameters of a list, and where it ends."""
    found: list[tuple[int, bytes]] = []
    while True:
        pid, size = struct.unpack_from(order + "HH", data, at)
        at += 4
        if pid == _SENTINEL:
            return found, at
        found.append((pid, data[at : at + size]))
        at += size
        if at > len(data):
            raise ValueError(at)


def read_parameters(payload: bytes) -> list[tuple[int, bytes]]:
    """Return the parameters of a payload in little endian; none if it is no list of them."""
    if payload[:2] != b"\x00\x03":
        return []
    try:
        return _parameters("<", payload, 4)[0]
    except (struct.error, ValueError):
        return []


# -- writing ------------------------------------------------------------------------------------


def datagram(source: Prefix, destination: Prefix, parts: Iterable[bytes]) -> bytes:
    """Return a datagram of submessages to one participant; zeros: to everybody."""
    head = HEADER.pack(MAGIC, VERSION, VENDOR, source)
    to = _with_head(_INFO_DST, 1, destination) if any(destination) else b""
    return head + to + b"".join(parts)


def _with_head(kind: int, flags: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    return struct.pack("<BBH", kind, flags, len(body) if len(body) < 65536 else 0) + body


def write(one: Submessage) -> bytes:
    """Return the bytes of a submessage."""
    match one:
        case Data():
            qos = _inline(one.related, one.ends, one.key)
            flags = 1 | (2 if qos else 0) | (4 if one.payload and not one.ends else 0)
            flags |= 8 if one.ends else 0
            head = struct.pack("<2xH4s4sii", 16, one.reader, one.writer, *_halves(one.number))
            return _with_head(_DATA, flags, head + qos + one.payload)
        case Fragment():
            qos = _inline(one.related, ends=False, key=b"")
            numbers = *_halves(one.number), one.first, one.parts, one.size, one.total
            head = struct.pack("<2xH4s4siiIHHI", 28, one.reader, one.writer, *numbers)
            return _with_head(_DATA_FRAG, 3 if qos else 1, head + qos + one.payload)
        case Heartbeat():
            ends = *_halves(one.first), *_halves(one.last)
            body = struct.pack("<4s4siiiiI", one.reader, one.writer, *ends, one.serial)
            return _with_head(_HEARTBEAT, 3 if one.final else 1, body)
        case Acknack():
            body = one.reader + one.writer + _packed_set(one.base, one.missing)
            return _with_head(_ACKNACK, 1 if one.missing else 3, body + struct.pack("<I", one.serial))
        case Gap():
            body = one.reader + one.writer + struct.pack("<ii", *_halves(one.start))
            return _with_head(_GAP, 1, body + _packed_set(one.base, one.others))
    raise AssertionError("fragments are never asked for: a sample is, as a whole")


def _halves(number: int) -> tuple[int, int]:
    low = number & 0xFFFFFFFF
    return number >> 32, low - (1 << 32) if low >= 1 << 31 else low


def _packed_set(base: int, numbers: Sequence[int]) -> bytes:
    bits = max(numbers) - base + 1 if numbers else 0
    words = [0] * ((bits + 31) // 32)
    for number in numbers:
        words[(number - base) // 32] |= 1 << (31 - (number - base) % 32)
    return struct.pack(f"<iiI{len(words)}I", *_halves(base), bits, *words)


def _inline(related: Identity | None, ends: bool, key: bytes) -> bytes:
    parameters: list[tuple[int, bytes]] = []
    if related is not None:
        value = related.guid + struct.pack("<ii", *_halves(related.number))
        parameters += [(_RELATED, value), (_RELATED_OLD, value)]
    if ends:
        parameters += [(_KEY_HASH, key), (_STATUS, bytes((0, 0, 0, ENDING)))]
    return _list(parameters) if parameters else b""


def _list(parameters: Iterable[tuple[int, bytes]]) -> bytes:
    parts = [struct.pack("<HH", pid, len(v) + -len(v) % 4) + v + bytes(-len(v) % 4) for pid, v in parameters]
    return b"".join(parts) + struct.pack("<HH", _SENTINEL, 0)


def parameter_list(parameters: Iterable[tuple[int, bytes]]) -> bytes:
    """Return a payload of parameters."""
    return b"\x00\x03\x00\x00" + _list(parameters)


# -- values of parameters -----------------------------------------------------------------------


def string(text: str) -> bytes:
    """Return a string as CDR has it."""
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def octets(data: bytes) -> bytes:
    """Return a sequence of octets as CDR has it."""
    return struct.pack("<I", len(data)) + data


def read_octets(value: bytes) -> bytes:
    """Return a sequence of octets; "" if it is none."""
    size = int.from_bytes(value[:4], "little")
    return value[4 : 4 + size] if len(value) >= 4 + size else b""


def read_string(value: bytes) -> str:
    """Return a string; "" if it is none."""
    return read_octets(value).rstrip(b"\0").decode(errors="replace")


def locator(one: Locator) -> bytes:
    """Return a locator of UDP over IPv4."""
    address = bytes(map(int, one.host.split(".")))
    return struct.pack("<iI12x4s", 1, one.port, address)


def read_locator(value: bytes) -> Locator | None:
    """Return a locator; None if it is not of UDP over IPv4."""
    if len(value) < 24:
        return None
    kind, port, address = struct.unpack_from("<iI12x4s", value)
    return Locator(".".join(map(str, address)), port) if kind == 1 and 0 < port < 65536 else None


def duration(seconds: float) -> bytes:
    """Return a duration, of at most some years; inf: for ever."""
    if seconds == float("inf"):
        return struct.pack("<iI", 0x7FFFFFFF, 0xFFFFFFFF)
    whole = int(seconds)
    return struct.pack("<iI", whole, int((seconds - whole) * (1 << 32)))


def read_duration(value: bytes) -> float:
    """Return a duration [s]; inf for ever, or if it is none."""
    if len(value) < 8:
        return float("inf")
    seconds, fraction = struct.unpack_from("<iI", value)
    return float("inf") if seconds == 0x7FFFFFFF else seconds + fraction / (1 << 32)


def of_kind(parameters: Iterable[tuple[int, bytes]], pid: int) -> Iterator[bytes]:
    """Yield the values of one kind of parameter."""
    return (value for found, value in parameters if found == pid)


Parameters: TypeAlias = Mapping[int, bytes]
