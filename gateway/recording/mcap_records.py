"""The records of an MCAP file, damaged or not, in the order of the file, as far as they can be verified.

Rules. Nothing but OSError is raised. What cannot be read is a `Damage` with place and reason, and reading
continues after it: at the next record, or where the next chunk is found. A length in a damaged file is never
trusted beyond the bytes that exist, and chunks are not unpacked to more than the bounds below. A chunk counts
only if its checksum matches; records outside of chunks are verified by the checksum at the end of the data,
if the file has one.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame
import zstandard

from gateway.recording.layout import MAGIC, Opcode

_START = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
FOOTER = struct.Struct("<BQQQI")
"""Opcode, length, start of the summary and of its offsets, checksum."""
_U64 = struct.Struct("<Q")
_U32 = struct.Struct("<I")
_CHUNK_MARK = re.compile(rb"\x03\x00\x00\x00lz4|\x04\x00\x00\x00zstd")
"""How chunks name what they are packed with: of ours, those of 0.18 and before first."""
_MARK_OFFSET, _MARK_SIZE = _START.size + 28, 8
_SEARCH = 1 << 20
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time: the fields of a message before its data."""
_MIN_SIZE = {Opcode.DATA_END: _U32.size, Opcode.MESSAGE: MESSAGE_HEAD.size}
_IN_CHUNK = {Opcode.SCHEMA: 0, Opcode.CHANNEL: 0, Opcode.MESSAGE: MESSAGE_HEAD.size}
"""Records that a chunk may contain, with the least size of their content."""
MAX_UNPACKED = 64 * 1024 * 1024
"""Bytes that a chunk may unpack to: a thousand times the largest that we write,"""
MAX_EXPANSION = 64
"""and all chunks so far together, beside one such chunk, in proportion to their packed size."""


class Record(NamedTuple):
    """One record, in a chunk or outside."""

    opcode: int
    content: bytes
    at: tuple[int, int] = (0, 0)
    """The byte in the file where it begins, or its chunk does, and the byte in the chunk: in order."""


class Damage(NamedTuple):
    """Bytes of the file that cannot be read."""

    at: int
    size: int
    reason: str


Piece: TypeAlias = Record | Damage


def records(file: BinaryIO, start: int = len(MAGIC)) -> Iterator[Piece]:
    """Yield all records up to the end of the data (DATA_END is the last), or to a cut.

    `start`: where a record begins; from another than the first, the checksum of all data is not verified.
    A cut is a Damage that reaches to the end of the file; a cut between two records leaves no trace."""
    size = file.seek(0, os.SEEK_END)
    at, crc, damaged = start, zlib.crc32(MAGIC), start != len(MAGIC)
    unpacked = 0
    while at < size:
        found = _record(file, at, size)
        if found is None:
            following = _next_chunk(file, at + 1, size)
            yield Damage(at, following - at, "cut off" if following == size else "no valid record")
            at, damaged = following, True
            continue
        if found.opcode == Opcode.DATA_END:
            stored = _U32.unpack(found.content[:4])[0]
            if stored not in (0, crc) and not damaged:
                yield Damage(at, 0, "the data before it does not match its checksum")
            yield found
            return
        crc = zlib.crc32(found.content, zlib.crc32(_START.pack(found.opcode, len(found.content)), crc))
        if found.opcode == Opcode.CHUNK:
            unpacked += _CHUNK.unpack_from(found.content)[2]
            if unpacked > MAX_UNPACKED + MAX_EXPANSION * at:
                yield Damage(at, size - at, f"it would unpack to more than {MAX_EXPANSION} times its size")
                return
            for piece in _in_chunk(found.content, at):
                damaged = damaged or isinstance(piece, Damage)
                yield piece
        else:
            yield found
        at += _START.size + len(found.content)


def summary(file: BinaryIO) -> Iterator[Record]:
    """Yield the records after the end of the data: schemas, channels, statistics; up to the first damage."""
    end = file.seek(-min(len(MAGIC) + FOOTER.size, file.seek(0, os.SEEK_END)), os.SEEK_END)
    footer = file.read(FOOTER.size)
    if len(footer) < FOOTER.size or footer[0] != Opcode.FOOTER:
        return
    at: int = FOOTER.unpack(footer)[2]
    while 0 < at < end and (found := _record(file, at, end)):
        yield found
        at += _START.size + len(found.content)


def newest_time(file: BinaryIO) -> int:
    """Return the newest log time by the heads of the chunks, up to the first damage; 0 without a chunk."""
    at, size, newest = len(MAGIC), file.seek(0, os.SEEK_END), 0
    while at < size:
        file.seek(at)
        head = file.read(_START.size + 2 * _U64.size)
        if len(head) < _START.size + 2 * _U64.size:
            break
        opcode, length = _START.unpack_from(head)
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END:
            break
        at += _START.size + length
        if opcode == Opcode.CHUNK and at <= size:
            newest = max(newest, _U64.unpack_from(head, _START.size + _U64.size)[0])
    return newest


def _record(file: BinaryIO, at: int, size: int) -> Record | None:
    """Return the record at a position; None if there is none, or it is incomplete."""
    file.seek(at)
    start = file.read(_START.size)
    if len(start) < _START.size:
        return None
    opcode, length = _START.unpack(start)
    if not Opcode.HEADER <= opcode <= Opcode.DATA_END or length > size - at - _START.size:
        return None
    if length < _MIN_SIZE.get(opcode, 0):
        return None
    content = file.read(length)
    if len(content) < length or (opcode == Opcode.CHUNK and _chunk_data(content) is None):
        return None
    return Record(opcode, content, (at, 0))


def _chunk_data(content: bytes) -> tuple[int, int, str, bytes] | None:
    """Return a chunk's uncompressed size, checksum, compression and compressed bytes; None: not a chunk."""
    if len(content) < _CHUNK.size:
        return None
    _from, _to, size, crc, name_size = _CHUNK.unpack_from(content)
    end = _CHUNK.size + name_size
    if name_size > 8 or len(content) < end + 8:
        return None
    compression = content[_CHUNK.size : end].decode("ascii", "replace")
    if _U64.unpack_from(content, end)[0] != len(content) - end - 8:
        return None
    return size, crc, compression, content[end + 8 :]


def _in_chunk(content: bytes, at: int) -> Iterator[Piece]:
    """Yield the records in a chunk, or one Damage."""
    contents = _contents(content)
    if isinstance(contents, str):
        yield Damage(at, _START.size + len(content), contents)
        return
    place = 0
    while place < len(contents):
        opcode = length = 0
        if place + _START.size <= len(contents):
            opcode, length = _START.unpack_from(contents, place)
        place += _START.size + length
        if place > len(contents) or length < _IN_CHUNK.get(opcode, length + 1):
            yield Damage(at, _START.size + len(content), "a chunk with an incomplete record in it")
            return
        yield Record(opcode, contents[place - length : place], (at, place))


def _contents(content: bytes) -> bytes | str:
    """Return the contents of a chunk, or what is wrong with it."""
    parts = _chunk_data(content)
    if parts is None:
        return "no chunk"
    size, crc, compression, data = parts
    if size > MAX_UNPACKED:
        return f"a chunk that would unpack to {size} bytes; at most {MAX_UNPACKED} are read"
    if compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        except (RuntimeError, EOFError, MemoryError) as error:  # RuntimeError is lz4's for a broken frame
            return f"a chunk that cannot be unpacked: {error}"
    elif compression == "zstd":
        try:
            data = zstandard.ZstdDecompressor().stream_reader(data).read(size)
        except zstandard.ZstdError as error:
            return f"a chunk that cannot be unpacked: {error}"
    elif compression:
        return f"a chunk packed with {compression}"
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        return "a chunk that does not match its checksum"
    return data


def _next_chunk(file: BinaryIO, at: int, size: int) -> int:
    """Return where the next chunk begins, from a position on; the size of the file if there is none."""
    while at < size:
        file.seek(at)
        block = file.read(_SEARCH)
        for mark in _CHUNK_MARK.finditer(block, _MARK_OFFSET):
            start = at + mark.start() - _MARK_OFFSET
            if block[mark.start() - _MARK_OFFSET] == Opcode.CHUNK and _record(file, start, size):
                return start
        at += max(1, len(block) - _MARK_OFFSET - _MARK_SIZE)
        if len(block) < _SEARCH:
            break
    return size
