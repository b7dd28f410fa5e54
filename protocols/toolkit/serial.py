"""Messages on a byte stream, however it was cut: between sync bytes and a checksum, or lines of text.

Rules. A `Framing` (binary) or `TextLines` is a constant; a `Stream` holds at most one message's bytes, and
looks at each byte a bounded number of times. Any bytes are accepted, and nothing raises.
"""

from __future__ import annotations

import binascii
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache, reduce
from operator import xor
from typing import Literal, Protocol, TypeAlias

from protocols.frames import Frame
from protocols.toolkit.motor_driver import Rx

Checksum: TypeAlias = Callable[[bytes], int]


def crc(width: int, polynomial: int, start: int = 0, *, reflected: bool = True, end: int = 0) -> Checksum:
    """Return a cyclic redundancy check. `polynomial` without its highest bit, as printed (not reflected);
    `end` is combined with the result by XOR. (Williams, A Painless Guide to CRC Error Detection, 1993.)"""
    table = _remainders(width, polynomial, reflected)
    ones, top = (1 << width) - 1, width - 8

    def check8(data: bytes) -> int:
        value = start
        for byte in data:
            value = table[value ^ byte]
        return value ^ end

    def check_reflected(data: bytes) -> int:
        value = start
        for byte in data:
            value = value >> 8 ^ table[(value ^ byte) & 0xFF]
        return value ^ end

    def check(data: bytes) -> int:
        value = start
        for byte in data:
            value = (value << 8 & ones) ^ table[value >> top ^ byte]
        return value ^ end

    if width == 8:
        return check8
    if width == 16:
        return _by_pairs(polynomial, start, end, reflected, check_reflected if reflected else check)
    return check_reflected if reflected else check


def _by_pairs(polynomial: int, start: int, end: int, reflected: bool, short: Checksum) -> Checksum:
    """Return a check of 16 bits that takes two bytes at once: its first use makes the table."""
    order = "<" if reflected else ">"

    def check(data: bytes) -> int:
        if len(data) < 4:
            return short(data)
        table, value, count = _remainders_of_pairs(polynomial, reflected), start, len(data) // 2
        for pair in struct.unpack_from(f"{order}{count}H", data):
            value = table[value ^ pair]
        if len(data) % 2:
            last, one = data[-1], _remainders(16, polynomial, reflected)
            if reflected:
                value = value >> 8 ^ one[(value ^ last) & 0xFF]
            else:
                value = (value << 8 & 0xFFFF) ^ one[value >> 8 ^ last]
        return value ^ end

    return check


@cache
def _remainders_of_pairs(polynomial: int, reflected: bool) -> tuple[int, ...]:
    """Return the remainder of each pair of bytes, by what is combined with it."""
    found: list[int] = []
    one = _remainders(16, polynomial, reflected)
    for high in range(256):
        if reflected:  # the second byte is the high one
            found += [one[low] >> 8 ^ one[(one[low] ^ high) & 0xFF] for low in range(256)]
        else:
            after = one[high]
            found += [(after << 8 & 0xFFFF) ^ one[after >> 8 ^ low] for low in range(256)]
    return tuple(found)


@cache
def _remainders(width: int, polynomial: int, reflected: bool) -> tuple[int, ...]:
    """Return the remainder of each byte."""
    high, remainders = 1 << width - 1, []
    for byte in range(256):
        value = int(f"{byte:08b}"[::-1], 2) if reflected else byte
        value <<= width - 8
        for _ in range(8):
            value = value << 1 ^ (polynomial | high << 1 if value & high else 0)
        remainders.append(int(f"{value:0{width}b}"[::-1], 2) if reflected else value)
    return tuple(remainders)


CRC8_MAXIM = crc(8, 0x31)
CRC16_MODBUS = crc(16, 0x8005, 0xFFFF)


def CRC16_XMODEM(data: bytes) -> int:  # noqa: N802 -- as the others
    """CRC-16/XMODEM: what most vendors call CCITT, from 0."""
    return binascii.crc_hqx(data, 0)


CRC32: Checksum = zlib.crc32


def sum8(data: bytes) -> int:
    """Sum of all bytes, in 8 bits. The low half of an Adler-32 is that sum and 1, modulo 65,521 (RFC 1950),
    which 256 bytes do not reach, and takes a third of the time of `sum`."""
    return zlib.adler32(data) - 1 & 0xFF if len(data) <= 256 else sum(data) & 0xFF


def inverted_sum8(data: bytes) -> int:
    """Complement of the sum, in 8 bits."""
    return -zlib.adler32(data) & 0xFF if len(data) <= 256 else ~sum(data) & 0xFF


def xor8(data: bytes) -> int:
    """XOR of all bytes."""
    return reduce(xor, data, 0)


class FrameReader(Protocol):
    """What finds messages on a line."""

    def __hash__(self) -> int:
        """What a constant has split is remembered."""
        ...

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on: a message (b"": nothing worth a word);
        MALFORMED, if its checksum is wrong; IGNORED: none begins here; None: more bytes must come."""
        ...


class FrameFormat(FrameReader, Protocol):
    """How messages stand on a line. A constant."""

    def frame(self, message: bytes) -> bytes:
        """Return a message, as `read` gives it, as it stands on the line."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Stuffing:
    """A byte that is inserted in a body wherever it would look like a sync, as Dynamixel 2.0 does."""

    pattern: bytes
    """Behind these bytes,"""
    inserted: bytes
    """this one is inserted."""
    resize: Callable[[bytes, int], bytes]
    """From a head, and the bytes of a body: the head of such a body."""

    def stuff(self, body: bytes) -> bytes:
        """Return a body as it stands on the line."""
        return body.replace(self.pattern, self.pattern + self.inserted)

    def unstuff(self, body: bytes) -> bytes:
        """Return a body without what was inserted."""
        return body.replace(self.pattern + self.inserted, self.pattern)

    def is_broken(self, held: bytes, start: int, end: int) -> bool:
        """True if in this part of a body, of what has come of it, nothing is inserted where it should be:
        another message has begun."""
        bare = held.find(self.pattern, start, end)
        while bare >= 0:
            behind = bare + len(self.pattern)
            if behind >= end or (behind < len(held) and held[behind : behind + 1] != self.inserted):
                return True
            bare = held.find(self.pattern, behind, end)
        return False


@dataclass(frozen=True, slots=True, eq=False)
class Framing:
    """How a message stands on the line: head (with the sync bytes), body, checksum, and what ends it.
    Raises ValueError for one that no stream could be split by."""

    sync: bytes
    """Not empty: by it a message is found behind other bytes."""
    head: int
    """Bytes up to the body, sync included."""
    body: Callable[[bytes], int | None]
    """From the head: bytes of the body, on the line; None if it is no head. As many as this says are held:
    let it take no more than a device sends."""
    checksum: Checksum
    checksum_size: int
    order: Literal["little", "big"] = "little"
    """Of the checksum's bytes."""
    covers: int = 0
    """The checksum covers the message from this byte on."""
    tail: bytes = b""
    """What stands behind the checksum."""
    stuffing: Stuffing | None = None
    """Of the body; the checksum covers it as it stands on the line."""

    def __post_init__(self) -> None:
        """Check that the stream can always go on."""
        if not self.sync:
            raise ValueError("a framing needs a sync: without one, no message is found behind other bytes")
        if self.head < len(self.sync):
            raise ValueError(f"a head of {self.head} bytes does not hold a sync of {len(self.sync)}")
        if self.checksum_size < 0 or self.covers < 0:
            raise ValueError("the size of a checksum, and where it begins, are not negative")
        if self.stuffing is not None and not (self.stuffing.pattern and len(self.stuffing.inserted) == 1):
            raise ValueError("stuffing inserts one byte behind a pattern")

    def __deepcopy__(self, memo: object) -> Framing:
        """It is a constant."""
        return self

    def frame(self, message: bytes) -> bytes:
        """Return a message, head and body, as it stands on the line: stuffed, with its checksum."""
        if self.stuffing is not None and self.stuffing.pattern in message[self.head :]:
            body = self.stuffing.stuff(message[self.head :])
            message = self.stuffing.resize(message[: self.head], len(body)) + body
        check = self.checksum(message[self.covers :]).to_bytes(self.checksum_size, self.order)
        return message + check + self.tail

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        start, stuffing = at + self.head, self.stuffing
        head = held[at:start]
        if not head.startswith(self.sync[: len(head)]):
            return Rx.IGNORED, self._sync(held, at + 1)
        if len(head) < self.head:
            return None, at
        size = self.body(head)
        if size is None or size < 0:
            return Rx.IGNORED, self._sync(held, at + 1)
        end = start + size
        behind = end + self.checksum_size
        whole = behind + len(self.tail)
        stuffed = stuffing is not None and held.find(stuffing.pattern, start, end) >= 0
        if stuffing is not None and stuffed and stuffing.is_broken(held, start, end):
            return Rx.MALFORMED, self._sync(held, at + 1)
        if len(held) < whole:
            return None, at
        check = int.from_bytes(held[end:behind], self.order)
        if held[behind:whole] != self.tail or self.checksum(held[at + self.covers : end]) != check:
            return Rx.MALFORMED, self._sync(held, at + 1)
        if stuffing is None or not stuffed:
            return held[at:end], whole
        body = stuffing.unstuff(held[start:end])
        return stuffing.resize(head, len(body)) + body, whole

    def _sync(self, held: bytes, at: int) -> int:
        """Return where the next sync begins, whole or as far as it has come."""
        found = held.find(self.sync, at)
        if found >= 0:
            return found
        for cut in range(max(at, len(held) - len(self.sync) + 1), len(held)):
            if self.sync.startswith(held[cut:]):
                return cut
        return len(held)


@dataclass(frozen=True, slots=True, eq=False)
class Unmarked:
    """Messages of one size that nothing marks: any bytes that fit are one."""

    size: int
    """Bytes on the line"""
    message: Callable[[bytes], bytes | None]
    """From so many bytes: what is read, with or without a checksum; None if they are no message."""
    checksum: Checksum
    """Of a message that is shorter."""

    def frame(self, message: bytes) -> bytes:
        """Return a message as it stands on the line."""
        rest = self.size - len(message)
        return message + self.checksum(message).to_bytes(rest, "big") if rest else message

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if len(held) - at < self.size:
            return None, at
        message = self.message(held[at : at + self.size])
        return (Rx.IGNORED, at + 1) if message is None else (message, at + self.size)


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """Messages that begin with an address and a code, from which their size follows."""

    addresses: range
    """Of one byte"""
    sizes: Mapping[int, int]
    """By code: the bytes behind it, without the checksum."""
    bare: Collection[int]
    """Codes of messages without a checksum."""
    checksum: Checksum
    checksum_size: int
    order: Literal["little", "big"] = "big"

    def frame(self, message: bytes) -> bytes:
        """Return a message, address, code and numbers, as it stands on the line."""
        if message[1] in self.bare:
            return message
        return message + self.checksum(message).to_bytes(self.checksum_size, self.order)

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        if held[at] not in self.addresses:
            return Rx.IGNORED, self._next(held, at)
        if len(held) < at + 2:
            return None, at
        size = self.sizes.get(held[at + 1])
        if size is None:
            return Rx.IGNORED, self._next(held, at)
        bare = held[at + 1] in self.bare
        end = at + 2 + size
        whole = end if bare else end + self.checksum_size
        if len(held) < whole:
            return None, at
        if not bare and self.checksum(held[at:end]) != int.from_bytes(held[end:whole], self.order):
            return Rx.MALFORMED, self._next(held, at)
        return held[at:end], whole

    def _next(self, held: bytes, at: int) -> int:
        places = range(at + 1, len(held))
        return next((place for place in places if held[place] in self.addresses), len(held))


@dataclass(frozen=True, slots=True)
class Covered:
    """Answers that have neither a beginning nor an address: one is known by its size, and by a checksum, big
    endian, which covers the beginning of the question, too."""

    head: int
    """Bytes of the question that it covers"""
    checksum: Checksum
    """It must be 0 of what ends with it."""
    checksum_size: int
    searched: int = 128
    """Bytes behind which an answer is looked for, whatever has come before."""

    def frame(self, asked: bytes, data: bytes) -> bytes:
        """Return the answer to a question as it stands on the line."""
        return data + self.checksum(asked[: self.head] + data).to_bytes(self.checksum_size, "big")

    def fits(self, asked: bytes, answer: bytes) -> bool:
        """True if this may be the answer to a question."""
        return not self.checksum(asked[: self.head] + answer)

    def find(self, asked: bytes, held: bytes, sizes: Iterable[int]) -> tuple[int, int] | None:
        """Return where an answer of one of these sizes, with its checksum, begins and ends."""
        first = max(0, len(held) - self.searched)
        places = ((at, at + size) for size in sizes for at in range(first, len(held) - size + 1))
        return next((each for each in places if self.fits(asked, held[slice(*each)])), None)

    def find_text(self, asked: bytes, held: bytes, end: bytes = b"\0") -> tuple[int, int] | None:
        """Return where a text with this end, and its checksum, begins and ends."""
        first = max(0, len(held) - self.searched)
        ends = (found.end() + self.checksum_size for found in re.finditer(re.escape(end), held[first:]))
        places = ((at, first + stop) for stop in ends for at in range(first, first + stop - 2))
        whole = (each for each in places if each[1] <= len(held))
        return next((each for each in whole if self.fits(asked, held[slice(*each)])), None)


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """Messages in an envelope: a first byte that says of what kind the length is, the length, the message,
    its checksum, an end. One that is damaged is as noise: any first byte in it may begin another."""

    lengths: Mapping[int, range]
    """By first byte: the bytes that a message may have. A length has one byte, or two if it must."""
    checksum: Checksum
    checksum_size: int
    order: Literal["little", "big"]
    """Of the bytes of length and checksum"""
    end: bytes
    starts: re.Pattern[bytes] = field(init=False)
    heads: Mapping[int, bytes] = field(init=False)
    """What stands before a message, by its length"""

    def __post_init__(self) -> None:
        """Make the heads, and the pattern by which the next message is looked for."""
        starts = b"[" + re.escape(bytes(self.lengths)) + b"]"
        object.__setattr__(self, "starts", re.compile(starts))
        heads: dict[int, bytes] = {}
        for first, sizes in self.lengths.items():
            for size in sizes:
                heads.setdefault(size, bytes((first,)) + size.to_bytes(_bytes_of(sizes), self.order))
        object.__setattr__(self, "heads", heads)

    def frame(self, message: bytes) -> bytes:
        """Return a message as it stands on the line. Raises ValueError if none has its length."""
        head = self.heads.get(len(message))
        if head is None:
            raise ValueError(
                f"a message has {min(self.heads)} to {max(self.heads)} bytes, not {len(message)}"
            )
        return head + message + self.checksum(message).to_bytes(self.checksum_size, self.order) + self.end

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        sizes = self.lengths.get(held[at])
        if sizes is None:
            return Rx.IGNORED, self._next(held, at)
        start = at + 1 + _bytes_of(sizes)
        if len(held) < start:
            return None, at
        size = int.from_bytes(held[at + 1 : start], self.order)
        if size not in sizes:
            return Rx.IGNORED, self._next(held, at)
        end = start + size
        behind = end + self.checksum_size
        whole = behind + len(self.end)
        if len(held) < whole:
            return None, at
        message = held[start:end]
        right = held[behind:whole] == self.end
        if not right or self.checksum(message) != int.from_bytes(held[end:behind], self.order):
            return Rx.IGNORED, self._next(held, at)
        return message, whole

    def _next(self, held: bytes, at: int) -> int:
        found = self.starts.search(held, at + 1)
        return found.start() if found else len(held)


def _bytes_of(sizes: range) -> int:
    return 1 if sizes.stop <= 256 else 2


@dataclass(frozen=True, slots=True, eq=False)
class TextLines:
    """Messages that are lines of text, printable ASCII. A message is a line without its end. Noise in a line
    spoils that line alone; what stands between two ends is read."""

    end: bytes = b"\n"
    """What we end a line with; of what comes, what stands in it before its last byte may be missing."""
    ends: bytes = b"\r\n"
    """Each of these bytes ends one."""
    longest: int = 255
    """Bytes of a line, without its end."""
    check: Checksum | None = None
    """Stands behind `mark` in decimal figures, and covers all that is before it."""
    mark: bytes = b"*"
    required: bool = True
    """False: a checksum is compared where there is one, and the message goes with it; `frame` adds none."""

    def __post_init__(self) -> None:
        """Check that a line that is written is a line that is read."""
        if not self.ends or not self.end or self.end[-1] not in self.ends:
            raise ValueError("a line ends with bytes that end it")
        if self.longest < 1 or len(self.mark) != 1:
            raise ValueError("a line has at least one byte, and the mark of a checksum is one")

    def __deepcopy__(self, memo: object) -> TextLines:
        """It is a constant."""
        return self

    def frame(self, message: bytes) -> bytes:
        """Return a line, with its checksum, if it must have one, and its end. Raises ValueError if it is too
        long, or would not be one line."""
        if self.check is not None and self.required:
            message += self.mark + b"%d" % self.check(message)
        if len(message) > self.longest or not _is_text(message):
            raise ValueError(f"no line of text of at most {self.longest} bytes: {message!r}")
        return message + self.end

    def read(self, held: bytes, at: int) -> tuple[bytes | Rx | None, int]:
        """Return what begins here, and where the search goes on, as every `FrameFormat`."""
        found = [end for end in (held.find(end, at) for end in self.ends) if end >= 0]
        if not found:
            # One byte more than a line may have: the rest of one that is too long is none.
            keep = len(held) - self.longest - 1
            return (Rx.IGNORED, keep) if keep > at else (None, at)
        line, behind = held[at : min(found)].removesuffix(self.end[:-1]), min(found) + 1
        if len(line) > self.longest or not _is_text(line):
            return Rx.IGNORED, behind
        text, mark, figures = line.rpartition(self.mark)
        if self.check is None or not line or (not mark and not self.required):
            return line, behind
        if not mark or (figures.lstrip(b"0") or b"0") != b"%d" % self.check(text):
            return Rx.MALFORMED, behind
        return text if self.required else line, behind


def _is_text(line: bytes) -> bool:
    return line.isascii() and line.decode("ascii").isprintable()


@dataclass(slots=True)
class Stream:
    """Splits a byte stream into messages. Holds at most one message's bytes.

    What is not a message is skipped: MALFORMED stands once for each message whose checksum is wrong, IGNORED
    once for each run of other bytes between two messages. A message behind either is found, since after a
    wrong checksum the search goes on at the next byte."""

    framing: FrameReader
    skipped: int = 0
    """Bytes that belonged to no message."""
    held: bytes = b""
    """What has come of a message that is not complete."""
    skipping: bool = False
    """The run of bytes that is being skipped has been reported."""

    def feed(self, data: bytes) -> list[bytes | Rx]:
        """Return the messages that these bytes complete."""
        found: list[bytes | Rx] = []
        held, at = self.held + data, 0
        while at < len(held):
            one, end = self.framing.read(held, at)
            if one is None:
                break
            if isinstance(one, bytes):
                found += (one,) if one else ()
            else:
                found += () if one is Rx.IGNORED and self.skipping else (one,)
                self.skipped += end - at
            self.skipping = isinstance(one, Rx)
            at = end
        self.held = held[at:]
        return found

    def messages(self, data: bytes) -> list[bytes]:
        """Return only the messages that these bytes complete."""
        found, self.held, skipped, self.skipping = _split(self.framing, self.held + data, self.skipping)
        self.skipped += skipped
        return list(found)

    def drop(self) -> None:
        """Discard a partial message: the line was interrupted, its rest will not come."""
        self.skipped += len(self.held)
        self.held, self.skipping = b"", False


def messages_in(framing: FrameFormat, frame: Frame) -> tuple[list[bytes], bool]:
    """Return the messages in a frame, and whether it is bytes, and holds nothing else."""
    if not isinstance(frame, bytes):
        return [], False
    found = Stream(framing).messages(frame)
    return found, sum(len(framing.frame(each)) for each in found) == len(frame)


@lru_cache(maxsize=16)
def _split(framing: FrameReader, held: bytes, skipping: bool) -> tuple[tuple[bytes, ...], bytes, int, bool]:
    """Return the messages in a run of bytes, what is left of it, how many bytes were skipped, and whether a
    run of them goes on. All that are on a line are given the same bytes one after the other: so they are
    split once."""
    stream = Stream(framing, skipping=skipping)
    found = tuple(each for each in stream.feed(held) if isinstance(each, bytes))
    return found, stream.held, stream.skipped, stream.skipping


@dataclass(frozen=True, slots=True)
class Finds:
    """The usual `protocols.line.Answer.find`: the answer is over with the last of so many messages that
    belong to the question. Noise before, behind and between them is passed over, also where it looks like
    the beginning of a message."""

    framing: FrameFormat
    belongs: Callable[[bytes, bytes], bool]
    """From the question, as it stands on the line, and a message. A function of a module or a frozen
    dataclass with `__call__`, so that it can be copied."""
    count: int = 1

    def __call__(self, asked: bytes, held: bytes) -> tuple[int, int] | None:
        """Return where the answer begins and ends, or None."""
        at, found, first = 0, 0, 0
        while at < len(held):
            one, end = self.framing.read(held, at)
            if isinstance(one, bytes) and one and self.belongs(asked, one):
                first, found = at if not found else first, found + 1
                if found == self.count:
                    return first, end
            at = max(end, at + 1)
        return None
