"""The records of an MCAP file in the order of the file, as far as they can be trusted, whatever befell it.

Rules. Nothing raises but an OSError. What cannot be read is a `Damage` that says where and why, and reading
goes on behind it: at the next record, or where the next chunk can be found. No length that a damaged file
claims is believed beyond the bytes that are there. A chunk counts only if its checksum proves it; records
outside of chunks are proven by the checksum at the end of the data, where the file has one.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame

from gateway.recording.layout import MAGIC
from gateway.recording.opcode import CHUNK, DATA_END, HEADER, MESSAGE

_START = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_U64 = struct.Struct("<Q")
_U32 = struct.Struct("<I")
_CHUNK_MARK = b"\x03\x00\x00\x00lz4"
_MARK_OFFSET = _START.size + 28
_SEARCH = 1 << 20
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time: what stands in a message before its data."""
_LEAST = {DATA_END: _U32.size, MESSAGE: MESSAGE_HEAD.size}
_MOST_EXPANSION = 255
"""lz4 cannot make more of a byte."""


class Record(NamedTuple):
    """One record, also of those in a chunk."""

    opcode: int
    content: bytes


class Damage(NamedTuple):
    """Bytes of the file that cannot be read."""

    at: int
    size: int
    why: str


Piece: TypeAlias = Record | Damage


def records(file: BinaryIO) -> Iterator[Piece]:
    """All records up to the end of the data (DATA_END is the last), or to where the file was cut off.

    A cut is a Damage that reaches to the end of the file; one between two records leaves no trace."""
    size = file.seek(0, os.SEEK_END)
    at, crc, reported = len(MAGIC), zlib.crc32(MAGIC), False
    while at < size:
        found = _record(file, at, size)
        if found is None:
            following = _next_chunk(file, at + 1, size)
            yield Damage(at, following - at, "cut off" if following == size else "no record can be made out")
            at, reported = following, True
            continue
        if found.opcode == DATA_END:
            stands = _U32.unpack(found.content[:4])[0]
            if stands not in (0, crc) and not reported:
                yield Damage(at, 0, "all before it does not match its checksum")
            yield found
            return
        crc = zlib.crc32(found.content, zlib.crc32(_START.pack(found.opcode, len(found.content)), crc))
        if found.opcode == CHUNK:
            for piece in _in_chunk(found.content, at):
                reported = reported or isinstance(piece, Damage)
                yield piece
        else:
            yield found
        at += _START.size + len(found.content)


def _record(file: BinaryIO, at: int, size: int) -> Record | None:
    """The record at a place; None if there is none, or not all of it."""
    file.seek(at)
    start = file.read(_START.size)
    if len(start) < _START.size:
        return None
    opcode, length = _START.unpack(start)
    if not HEADER <= opcode <= DATA_END or length > size - at - _START.size:
        return None
    if length < _LEAST.get(opcode, 0):
        return None
    content = file.read(length)
    if len(content) < length or (opcode == CHUNK and _chunk_data(content) is None):
        return None
    return Record(opcode, content)


def _chunk_data(content: bytes) -> tuple[int, int, str, bytes] | None:
    """Size and checksum of what is in a chunk, its compression, and the compressed bytes; None: no chunk."""
    if len(content) < _CHUNK.size:
        return None
    _from, _to, size, crc, letters = _CHUNK.unpack_from(content)
    end = _CHUNK.size + letters
    if letters > 8 or len(content) < end + 8:
        return None
    compression = content[_CHUNK.size : end].decode("ascii", "replace")
    if _U64.unpack_from(content, end)[0] != len(content) - end - 8:
        return None
    return size, crc, compression, content[end + 8 :]


def _in_chunk(content: bytes, at: int) -> Iterator[Piece]:
    """The records in a chunk, or one Damage."""
    opened = _opened(content)
    if isinstance(opened, str):
        yield Damage(at, _START.size + len(content), opened)
        return
    place = 0
    while place < len(opened):
        opcode = length = 0
        if place + _START.size <= len(opened):
            opcode, length = _START.unpack_from(opened, place)
        place += _START.size + length
        if place > len(opened) or (opcode == MESSAGE and length < MESSAGE_HEAD.size):
            yield Damage(at, _START.size + len(content), "a chunk with half a record in it")
            return
        yield Record(opcode, opened[place - length : place])


def _opened(content: bytes) -> bytes | str:
    """What is in a chunk, or what is wrong with it."""
    parts = _chunk_data(content)
    if parts is None:
        return "no chunk"
    size, crc, compression, data = parts
    if compression == "lz4":
        if size > _MOST_EXPANSION * len(data) + 64:
            return "a chunk of an impossible size"
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
        except (RuntimeError, EOFError, MemoryError) as error:  # RuntimeError is lz4's for a broken frame
            return f"a chunk that cannot be unpacked: {error}"
    elif compression:
        return f"a chunk packed with {compression}"
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        return "a chunk that does not match its checksum"
    return data


def _next_chunk(file: BinaryIO, at: int, size: int) -> int:
    """Where the next chunk begins, at or after a place; the size of the file if there is none."""
    while at < size:
        file.seek(at)
        block = file.read(_SEARCH)
        mark = block.find(_CHUNK_MARK)
        while mark >= 0:
            start = at + mark - _MARK_OFFSET
            if mark >= _MARK_OFFSET and block[mark - _MARK_OFFSET] == CHUNK and _record(file, start, size):
                return start
            mark = block.find(_CHUNK_MARK, mark + 1)
        at += max(1, len(block) - _MARK_OFFSET - len(_CHUNK_MARK))
        if len(block) < _SEARCH:
            break
    return size
