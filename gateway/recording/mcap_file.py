"""An MCAP file that is complete at any moment except for its index: chunks of messages, each in one write.

Rules. The file is always a sequence of complete records. A write that fails is undone: the file is truncated
to its previous size, the data of that write is dropped, and the next chunk may be tried. Memory does not grow
by more than a few bytes per chunk: the index is kept compressed until the end. Nothing here knows ticks.

Why not `mcap.writer`: it keeps 1 kB in memory per chunk, which is much at 12 chunks a second, spends several
times as long on a message, and leaves the file undefined after a failed write. Rare records are written by
`mcap.records`; layouts are those of the MCAP specification (mcap.dev/spec).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import zstandard

from gateway.recording.layout import MAGIC, Opcode
from gateway.recording.new_file import create
from protocols.messages import Nanos

if TYPE_CHECKING:
    from mcap.records import McapRecord

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BODY = 22
_INDEX_ENTRY = struct.Struct("<QQ")
_MESSAGE_INDEX = struct.Struct("<BQHI")
_CHUNK = struct.Struct("<BQQQQII4sQ")
_CHUNK_BODY = 8 + 8 + 8 + 4 + 4 + 4 + 8
_CHUNK_INDEX = struct.Struct("<BQQQQQI")
_CHUNK_INDEX_OFFSET = struct.Struct("<HQ")
_CHUNK_INDEX_END = struct.Struct("<QI4sQQ")
_CHUNK_INDEX_BODY = 4 * 8 + 4 + 8 + 4 + 4 + 8 + 8
_FOOTER = struct.Struct("<BQQQ")
_INDEX_BLOCK = 256 * 1024
LEVEL = 3
"""Of zstd: twice as hard takes three times as long, for 1 % less."""
UINT64 = 2**64 - 1


class McapFile:
    """Collects messages, and writes them on `flush`, to a new file. Raises OSError as a file does.

    `broken`: a failed write could not be undone; the file must not be written to any more."""

    def __init__(self, path: Path, library: str) -> None:
        from mcap.records import Header

        self.broken = False
        self.size = 0
        """Bytes in the file, all of them complete records,"""
        self._crc = 0
        """and their checksum."""
        self._head: list[tuple[int, int, McapRecord]] = []
        self._schemas: dict[str, int] = {}
        self._records: list[tuple[int, bytes]] = []
        """Schemas and channels, with their opcodes, for the summary."""
        self._unwritten = bytearray()
        """Those of them that are not yet in the file."""
        self._channels: dict[tuple[str, str], int] = {}
        self._counts: dict[int, int] = {}
        self._chunks = 0
        self._first, self._last = UINT64, 0
        self._index = bytearray()
        self._packed_index: list[bytes] = []
        self._chunk = bytearray()
        self._indices: dict[int, bytearray] = {}
        """Log time and offset of the messages in the chunk, by channel."""
        self._from: Nanos = UINT64
        self._to: Nanos = 0
        self._compress = zstandard.ZstdCompressor(LEVEL).compress
        self._stream = os.fdopen(create(path), "wb", buffering=0)
        try:
            self._append(MAGIC + _bytes(Header("ros2", library)))
        except OSError:
            self.abandon()
            raise

    @property
    def waiting(self) -> int:
        """Bytes in the present chunk."""
        return len(self._chunk)

    @property
    def descriptor(self) -> int:
        """File descriptor of the open file."""
        return self._stream.fileno()

    # -- add ------------------------------------------------------------------------------------

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write name-value pairs, immediately."""
        from mcap.records import Metadata

        self._write_now(Metadata(name, dict(values)))

    def attachment(self, name: str, kind: str, data: bytes) -> None:
        """Write an attached file, immediately."""
        from mcap.records import Attachment

        self._write_now(Attachment(0, 0, name, kind, data))

    def channel(self, topic: str, type_: str) -> int | None:
        """Return the channel of a topic with messages of a type; None if there is none yet."""
        return self._channels.get((topic, type_))

    def open_channel(
        self, topic: str, type_: str, definition: str, qos: str = "", kind: str = "ros2msg"
    ) -> int:
        """Add a channel with a ROS 2 message type in CDR; it is written with the next chunk."""
        from mcap.records import Channel, Schema

        schema = self._schemas.get(type_)
        if schema is None:
            schema = self._schemas[type_] = len(self._schemas) + 1
            self._register(
                Opcode.SCHEMA, Schema(id=schema, name=type_, encoding=kind, data=definition.encode())
            )
        number = self._channels[topic, type_] = len(self._channels) + 1
        metadata = {"offered_qos_profiles": qos} if qos else {}
        self._register(
            Opcode.CHANNEL,
            Channel(id=number, schema_id=schema, topic=topic, message_encoding="cdr", metadata=metadata),
        )
        return number

    def message(self, channel: int, sequence: int, log: Nanos, publish: Nanos, data: bytes) -> None:
        """Add a message to the present chunk."""
        chunk = self._chunk
        index = self._indices.get(channel)
        if index is None:
            index = self._indices[channel] = bytearray()
        index += _INDEX_ENTRY.pack(log, len(chunk))
        chunk += _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_BODY + len(data), channel, sequence, log, publish)
        chunk += data
        if not self._from <= log <= self._to:
            self._from, self._to = min(self._from, log), max(self._to, log)

    # -- write ----------------------------------------------------------------------------------

    def flush(self) -> None:
        """Write the present chunk in one write. If that fails, all messages in it are lost."""
        if not self._chunk:
            return
        data = self._compress(self._chunk)
        out = bytearray(self._unwritten)
        start = self.size + len(out)
        out += _CHUNK.pack(
            Opcode.CHUNK, _CHUNK_BODY + len(data), self._from, self._to,
            len(self._chunk), zlib.crc32(self._chunk), 4, b"zstd", len(data),
        )  # fmt: skip
        out += data
        length = self.size + len(out) - start
        offsets = bytearray()
        for channel, index in self._indices.items():
            offsets += _CHUNK_INDEX_OFFSET.pack(channel, self.size + len(out))
            out += _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(index), channel, len(index))
            out += index
        size = _CHUNK_INDEX_BODY + len(offsets)
        entry = bytearray(
            _CHUNK_INDEX.pack(Opcode.CHUNK_INDEX, size, self._from, self._to, start, length, len(offsets))
        )
        entry += offsets
        entry += _CHUNK_INDEX_END.pack(
            self.size + len(out) - start - length, 4, b"zstd", len(data), len(self._chunk)
        )
        try:
            self._append(out)
            self._count(entry)
        finally:
            self._new_chunk()

    def finish(self) -> None:
        """Write the present chunk, the index and the end, and close. If that fails, there is no index."""
        self.flush()
        size = self.size
        try:
            self._write_end()
            os.fsync(self.descriptor)
        except OSError:
            self.size = size
            self._truncate()
            self.abandon()
            raise
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    # -- private --------------------------------------------------------------------------------

    def _write_now(self, record: McapRecord) -> None:
        data = _bytes(record)
        at = self.size
        self._append(data)
        self._head.append((at, len(data), record))

    def _register(self, opcode: int, record: McapRecord) -> None:
        data = _bytes(record)
        self._records.append((opcode, data))
        self._unwritten += data

    def _append(self, data: bytes | bytearray) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._stream.write(view) :]
        except OSError:
            self._truncate()
            raise
        self.size += len(data)
        self._crc = zlib.crc32(data, self._crc)

    def _truncate(self) -> None:
        try:
            self._stream.truncate(self.size)
            self._stream.seek(self.size)
        except OSError:  # a pipe or a device, or a lost disk
            self.broken = True

    def _count(self, entry: bytearray) -> None:
        """Update counts and index after a chunk was written."""
        self._unwritten.clear()
        for channel, index in self._indices.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index) // _INDEX_ENTRY.size
        self._chunks += 1
        self._first, self._last = min(self._first, self._from), max(self._last, self._to)
        self._index += entry
        if len(self._index) > _INDEX_BLOCK:
            self._packed_index.append(zlib.compress(self._index, 1))
            self._index = bytearray()

    def _new_chunk(self) -> None:
        self._chunk, self._indices = bytearray(), {}
        self._from, self._to = UINT64, 0

    def _write_end(self) -> None:
        from mcap.records import DataEnd, SummaryOffset

        self._append(_bytes(DataEnd(self._crc)))
        start, crc = self.size, 0
        offsets: list[SummaryOffset] = []
        for opcode, blocks in self._summary():
            at = self.size
            for block in blocks:
                self._append(block)
                crc = zlib.crc32(block, crc)
            if self.size > at:
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=at, group_length=self.size - at)
                )
        where = self.size
        data = b"".join(_bytes(offset) for offset in offsets)
        footer = _FOOTER.pack(Opcode.FOOTER, 20, start, where)
        crc = zlib.crc32(footer, zlib.crc32(data, crc))
        self._append(data + footer + struct.pack("<I", crc) + MAGIC)

    def _summary(self) -> list[tuple[int, Iterable[bytes]]]:
        """Return the groups of the summary, each with its opcode."""
        from mcap.records import Attachment, AttachmentIndex, Metadata, MetadataIndex, Statistics

        attached = [
            _bytes(AttachmentIndex(at, size, r.log_time, r.create_time, len(r.data), r.name, r.media_type))
            for at, size, r in self._head
            if isinstance(r, Attachment)
        ]
        metadata = [
            _bytes(MetadataIndex(at, size, r.name)) for at, size, r in self._head if isinstance(r, Metadata)
        ]
        statistics = Statistics(
            attachment_count=len(attached),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            message_start_time=self._first if self._chunks else 0,
            message_end_time=self._last,
            metadata_count=len(metadata),
            schema_count=len(self._schemas),
        )
        unpacked = (zlib.decompress(block) for block in self._packed_index)
        return [
            (Opcode.SCHEMA, [data for opcode, data in self._records if opcode == Opcode.SCHEMA]),
            (Opcode.CHANNEL, [data for opcode, data in self._records if opcode == Opcode.CHANNEL]),
            (Opcode.STATISTICS, [_bytes(statistics)]),
            (Opcode.CHUNK_INDEX, chain(unpacked, [bytes(self._index)])),
            (Opcode.ATTACHMENT_INDEX, attached),
            (Opcode.METADATA_INDEX, metadata),
        ]


def _bytes(record: McapRecord) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]  # mcap annotates arguments only
