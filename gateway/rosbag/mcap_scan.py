"""Reader of another program's MCAP file without its end, or with a damaged index.

Rules. Who records writes chunks, each with its checksum, and at the end where they all are, which a recorder
that was killed never did. The records are gone through one by one, as far as they can be verified
(`gateway.recording.mcap_records`), each time that messages are asked for: no memory is needed for them, and
nothing is written to the file. Messages come in the order of writing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator
from pathlib import Path
from typing import TYPE_CHECKING

from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import ReaderError
from rosbags.rosbag2.storage_mcap import McapReader, Schema, get_msgdef

from gateway.errors import RecordingError
from gateway.recording.layout import Opcode
from gateway.recording.mcap_records import MESSAGE_HEAD, Damage, records
from gateway.recording.reader import parse

if TYPE_CHECKING:
    from gateway.recording.mcap_records import Record


class UnindexedMcap(McapReader):
    """The library's storage of a file, of which nothing but whole records is believed."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = path
        self.why = ""
        """What of it is lost; "" if nothing is"""

    def _open(self) -> None:
        """Go through the file. Raises ReaderError if it does not begin as one of ROS 2 does."""
        counts: Counter[int] = Counter()
        lost: list[Damage] = []
        first, last, ended, size = 0, -1, False, self._file.stat().st_size
        with self._file.open("rb") as file:
            for piece in records(file):
                if isinstance(piece, Damage):
                    lost.append(piece)
                elif piece.opcode == Opcode.MESSAGE:
                    channel, _, logged, _ = MESSAGE_HEAD.unpack_from(piece.content)
                    counts[channel] += 1
                    first, last = (logged, logged) if last < 0 else (min(first, logged), max(last, logged))
                elif piece.opcode == Opcode.DATA_END:
                    ended = True
                else:
                    self._declare(piece)
        self.connections = [one._replace(msgcount=counts[one.id]) for one in self.connections]
        count = sum(one.msgcount for one in self.connections)
        self.metadata = self.metadata._replace(
            duration=last - first + 1, start_time=first, end_time=last + 1, message_count=count
        )
        self.why = "" if ended else "nothing is known of what followed"
        if lost:
            bytes_, at = sum(one.size for one in lost), lost[0].at
            self.why = f"{bytes_} of its {size} bytes are lost, from byte {at} on ({lost[0].reason})"

    def _declare(self, record: Record) -> None:
        """Take note of what a schema or channel says. Raises ReaderError."""
        from mcap.records import Channel
        from mcap.records import Schema as SchemaRecord

        try:
            if record.opcode == Opcode.SCHEMA:
                one = parse(self._file, SchemaRecord, record)
                text = one.data.decode(errors="replace")
                self.schemas[one.id] = Schema(one.id, one.name, one.encoding, text)
            elif record.opcode == Opcode.CHANNEL:
                channel = parse(self._file, Channel, record)
                schema = self.schemas.get(channel.schema_id)
                if schema is None or any(one.id == channel.id for one in self.connections):
                    return
                ext = ConnectionExtRosbag2(channel.message_encoding, [])
                definition = get_msgdef(schema)
                self.connections.append(
                    Connection(channel.id, channel.topic, schema.name, definition, "", 0, ext, self)
                )
        except RecordingError as error:
            raise ReaderError(str(error)) from error

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Yield connection, time [ns] and bytes of each message of these connections."""
        wanted = {one.id: one for one in connections}
        with self._file.open("rb") as file:
            for piece in records(file):
                if isinstance(piece, Damage) or piece.opcode != Opcode.MESSAGE:
                    continue
                channel, _, logged, _ = MESSAGE_HEAD.unpack_from(piece.content)
                within = (start is None or start <= logged) and (stop is None or logged < stop)
                if channel in wanted and within:
                    yield wanted[channel], logged, piece.content[MESSAGE_HEAD.size :]
