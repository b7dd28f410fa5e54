"""Readers of ROS 1 bags: of old ones, and of those whose index is absent or damaged.

Rules. Who records writes chunks, and behind each the index of its messages; where all chunks are is written
at the end, which a recorder that was killed never did. The messages themselves are whole: `Unindexed` goes
through their records one by one, from the beginning to where they are whole, and makes the index anew, in
memory. Nothing is written to the file. An index record is as long as its entries, whatever length it states,
as ROS takes it. `roslib/Header` is what std_msgs/Header was called until ROS C Turtle.

Source: https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import os
from collections import defaultdict
from io import BytesIO
from typing import TYPE_CHECKING, BinaryIO

from rosbags.rosbag1.reader import (
    Chunk,
    ChunkInfo,
    Header,
    IndexData,
    Reader,
    ReaderError,
    RecordType,
    decompressors,
    read_bytes,
    read_uint32,
)

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

ENTRY = 12
"""Bytes of an entry of an index record"""
OLD, NEW = "MSG: roslib/Header", "MSG: std_msgs/Header"
DAMAGE = (ReaderError, OSError, EOFError, RuntimeError, ValueError)
"""What damaged records make the library and its decompressors raise"""


class OldOrNew(Reader):
    """The library's reader, of old bags, too."""

    def read_connection(self) -> Connection:
        """Read what a connection's messages are."""
        one = super().read_connection()
        return one._replace(msgdef=one.msgdef._replace(data=one.msgdef.data.replace(OLD, NEW)))


class Unindexed(OldOrNew):
    """The same, with an index that is made here."""

    why = ""
    """Why it was not gone through to its end; "" if it was"""

    def open(self) -> None:
        """Go through the file. Raises ReaderError if it does not begin as a bag does."""
        self.bio = file = self.path.open("rb")
        self._found: dict[int, Connection] = {}
        self._entries: dict[int, list[IndexData]] = defaultdict(list)
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        if file.readline(32) != b"#ROSBAG V2.0\n":
            raise ReaderError("it does not begin as a bag of version 2.0")
        while (start := file.tell()) < size:
            try:
                self._take_record(file, start, size)
            except DAMAGE as error:
                self.why = str(error)
                break
        self.indexes = {number: sorted(self._entries[number]) for number in self._found}
        counted = ((one, len(self.indexes[number])) for number, one in sorted(self._found.items()))
        self.connections = [one._replace(msgcount=count) for one, count in counted]

    def _take_record(self, file: BinaryIO, start: int, size: int) -> None:
        """Take a record of the file, and go behind it. Raises one of DAMAGE if it is not whole."""
        header = Header.read(file)
        kind = header.get_uint8("op")
        if kind == RecordType.CHUNK:
            file.seek(start)
            self._take_chunk(file, start, self.read_chunk(), size)
        elif kind == RecordType.CONNECTION:
            file.seek(start)
            self._take_connection()
        else:
            length = read_uint32(file)
            if kind == RecordType.IDXDATA:
                length = ENTRY * header.get_uint32("count")
            if file.seek(length, os.SEEK_CUR) > size:
                raise ReaderError("its last record was not written to its end")

    def _take_connection(self) -> None:
        one = self.read_connection()
        self._found.setdefault(one.id, one)

    def _take_chunk(self, file: BinaryIO, start: int, chunk: Chunk, size: int) -> None:
        """Take the records of a chunk, and go behind it; of the last one, if it is not packed, those that
        were written."""
        end = chunk.datapos + chunk.datasize
        if end > size and chunk.decompressor is not decompressors["none"]:
            raise ReaderError("its last chunk, which is packed, was not written to its end")
        chunk = chunk._replace(datasize=min(end, size) - chunk.datapos)
        file.seek(chunk.datapos)
        data = chunk.decompressor(read_bytes(file, chunk.datasize))
        self.chunks[start] = chunk
        times: list[int] = []
        counts: dict[int, int] = defaultdict(int)
        inside = BytesIO(data)
        try:
            while inside.tell() < len(data):
                number, time = self._take_message(inside, start)
                if number >= 0:
                    times.append(time)
                    counts[number] += 1
        except DAMAGE:
            if end <= size:
                raise
        finally:
            self.bio = file
            if times:
                self.chunk_infos.append(ChunkInfo(start, min(times), max(times) + 1, dict(counts)))
        if end > size:
            raise ReaderError("its last chunk was not written to its end")
        file.seek(end)

    def _take_message(self, inside: BinaryIO, start: int) -> tuple[int, int]:
        """Take a record of a chunk; return the connection and time of a message, or (-1, 0)."""
        at = inside.tell()
        header = Header.read(inside)
        kind = header.get_uint8("op")
        if kind == RecordType.CONNECTION:
            inside.seek(at)
            self.bio = inside  # of which the library reads
            self._take_connection()
            return -1, 0
        read_bytes(inside, read_uint32(inside))
        if kind != RecordType.MSGDATA:
            return -1, 0
        number, time = header.get_uint32("conn"), header.get_time("time")
        if number not in self._found:
            raise ReaderError(f"it does not say what the messages of connection {number} are")
        self._entries[number].append(IndexData(time, start, at))
        return number, time
