"""Recovery of a damaged recording: what can be read is copied to a new file, byte for byte, with an index.

Rules. The damaged file is only read. The new one appears when it is finished, and never replaces another.
Recovered are complete ticks with all their views, as they were written; what is lost is reported. Of another
program's bag (MCAP, ROS 2) all messages are.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from gateway.errors import RecordingError
from gateway.recording import tick_codec
from gateway.recording.layout import MAGIC, RECOVERED, Opcode
from gateway.recording.mcap_file import McapFile
from gateway.recording.mcap_records import FOOTER, MESSAGE_HEAD, Damage, Record, records
from gateway.recording.new_file import EXISTS, publish
from gateway.recording.reader import has_end, head, is_recording, parse, read_recording
from protocols.messages import Nanos, seconds

CHUNK_SIZE = 512 * 1024
MAX_LISTED = 1000
"""Gaps"""
_TICK = struct.Struct("<4xQq")


@dataclass(slots=True)
class Recovery:
    """What was found in a file."""

    bag: bool = False
    """True for another program's bag, in which there are no ticks."""
    ended: bool = False
    """True if the data have an end: then nothing was cut off, except perhaps the index."""
    size: int = 0
    """Size of the file [bytes]."""
    ticks: int = 0
    messages: int = 0
    """Of all topics, including ticks."""
    first: tuple[int, Nanos] | None = None
    """Number and time of the first tick,"""
    last: tuple[int, Nanos] | None = None
    """and of the last."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """First and last number of each run of missing ticks; the first `MAX_LISTED`,"""
    more_gaps: int = 0
    """and how many more there are."""
    damages: list[Damage] = field(default_factory=list)

    @property
    def anything(self) -> bool:
        """True if there is something to keep."""
        return bool(self.messages if self.bag else self.ticks)

    def summary(self) -> list[str]:
        """Return, for the operator, what was found and what was lost."""
        lines = [f"bytes {d.at} to {d.at + d.size} of {self.size}: {d.reason}" for d in self.damages]
        if self.first and self.last:
            span = seconds(self.last[1] - self.first[1])
            lines.append(
                f"{self.ticks} ticks, {self.first[0]} to {self.last[0]}, over {span:.3f} s; "
                f"{self.messages} messages in all"
            )
            lines.append(f"the last tick is {self.last[0]}, at {seconds(self.last[1]):.6f} s of its clock")
        elif self.bag:
            lines.append(f"{self.messages} messages of another program's bag")
        else:
            lines.append("no tick can be read")
        lines += [f"missing in between: ticks {a} to {b}" for a, b in self.gaps]
        lines += [f"and {self.more_gaps} gaps more"] * bool(self.more_gaps)
        if not self.ended:
            last = "them" if self.bag else "that tick"
            lines.append(f"the file was not closed: what followed {last} was not completely written")
        return lines


def is_whole(path: Path) -> bool:
    """True if every byte before the end is verified, and the index counts all ticks. Raises RecordingError if
    it is neither a recording nor an MCAP bag."""
    found = _begun(path)
    for _ in _scanned(path, found):
        pass
    if not found.ended or found.damages or not _index_is_sound(path):
        return False
    try:
        return found.bag or read_recording(path).indexed == found.ticks
    except RecordingError:  # of its index
        return False


def _index_is_sound(path: Path) -> bool:
    """True if index and footer match the checksum in the footer."""
    with path.open("rb") as file:
        end = file.seek(-len(MAGIC) - FOOTER.size, os.SEEK_END) + FOOTER.size - 4
        code, _length, start, _offsets, crc = FOOTER.unpack(file.read(FOOTER.size))
        if code != Opcode.FOOTER or start > end:
            return False
        file.seek(start)
        computed, left = 0, end - start
        while left:
            block = file.read(min(left, CHUNK_SIZE))
            if not block:
                return False
            computed, left = zlib.crc32(block, computed), left - len(block)
    return bool(computed == crc)


def recover(path: Path, target: Path) -> Recovery:
    """Write what can be read of a recording to a new file; write no file if no tick can be read.

    Raises RecordingError if it is neither a recording nor an MCAP bag, or if the new file exists already or
    cannot be written."""
    found = _begun(path)
    if os.path.lexists(target):
        raise RecordingError(f"{target}: {EXISTS}")
    part = target.with_name(target.name + ".part")
    try:
        copy = _Copy(path, part)
    except FileExistsError as error:
        wrong = "another recovery writes it, or was broken off: then remove it"
        raise RecordingError(f"{part}: {wrong}") from error
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror}") from error
    try:
        try:
            for record in _scanned(path, found):
                copy.add(record)
            copy.finish(found)
        finally:
            copy.file.abandon()
        if found.anything:
            publish(part, target)
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    if not found.bag and found.ticks and read_recording(target).indexed != found.ticks:
        raise RecordingError(f"{target}: does not read back as it was written: do not use it")
    return found


def _begun(path: Path) -> Recovery:
    """Return an empty recovery, of the file's kind. Raises RecordingError if it is of no kind."""
    has_end(path)
    found = Recovery(bag=not is_recording(path))
    if not found.bag:
        head(path, whole=False)
    return found


def _scanned(path: Path, found: Recovery) -> Iterator[Record]:
    """Yield all records that can be read, and count them in `found`."""
    from mcap.records import Channel

    ticks: set[int] = set()
    try:
        with path.open("rb") as file:
            found.size = path.stat().st_size
            for piece in records(file):
                if isinstance(piece, Damage):
                    found.damages.append(piece)
                    continue
                if piece.opcode == Opcode.DATA_END:
                    found.ended = True
                elif piece.opcode == Opcode.CHANNEL:
                    channel = parse(path, Channel, piece)
                    ticks |= {channel.id} if channel.topic == tick_codec.TOPIC else set()
                elif piece.opcode == Opcode.MESSAGE:
                    found.messages += 1
                    if MESSAGE_HEAD.unpack_from(piece.content)[0] in ticks:
                        if len(piece.content) < MESSAGE_HEAD.size + _TICK.size:
                            raise RecordingError(f"{path}: damaged: a tick without number and time")
                        _count_tick(found, piece)
                yield piece
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _count_tick(found: Recovery, record: Record) -> None:
    number, now = _TICK.unpack_from(record.content, MESSAGE_HEAD.size)
    found.ticks += 1
    if found.last is not None and number > found.last[0] + 1:
        if len(found.gaps) < MAX_LISTED:
            found.gaps.append((found.last[0] + 1, number - 1))
        else:
            found.more_gaps += 1
    found.first = found.first or (number, now)
    found.last = (number, now)


class _Copy:
    """Copies the records of a recording to a new file."""

    def __init__(self, path: Path, target: Path) -> None:
        self.file = McapFile(target, "motor-gateway recover")
        self._path = path
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, int] = {}

    def add(self, record: Record) -> None:
        """Copy a record. Raises OSError and RecordingError."""
        from mcap.records import Attachment, Metadata, Schema

        if record.opcode == Opcode.MESSAGE:
            self._message(record.content)
        elif record.opcode == Opcode.CHANNEL:
            self._channel(record)
        elif record.opcode == Opcode.SCHEMA:
            schema = parse(self._path, Schema, record)
            self._schemas[schema.id] = (schema.name, schema.data.decode(errors="replace"), schema.encoding)
        elif record.opcode == Opcode.METADATA:
            entry = parse(self._path, Metadata, record)
            self.file.metadata(entry.name, entry.metadata)
        elif record.opcode == Opcode.ATTACHMENT:
            attachment = parse(self._path, Attachment, record)
            self.file.attachment(attachment.name, attachment.media_type, attachment.data)

    def finish(self, found: Recovery) -> None:
        """Write the end, and what was lost."""
        self.file.flush()
        self.file.metadata(RECOVERED, {"from": self._path.name, "summary": "\n".join(found.summary())})
        self.file.finish()

    def _channel(self, record: Record) -> None:
        from mcap.records import Channel

        channel = parse(self._path, Channel, record)
        type_, definition, kind = self._schemas.get(channel.schema_id, ("", "", "ros2msg"))
        number = self.file.channel(channel.topic, type_)
        if number is None:
            qos = channel.metadata.get("offered_qos_profiles", "")
            number = self.file.open_channel(channel.topic, type_, definition, qos, kind)
        self._channels[channel.id] = number

    def _message(self, content: bytes) -> None:
        channel, sequence, log, published = MESSAGE_HEAD.unpack_from(content)
        number = self._channels.get(channel)
        if number is None:  # the record of its channel is damaged
            return
        if self.file.waiting > CHUNK_SIZE:
            self.file.flush()
        self.file.message(number, sequence, log, published, content[MESSAGE_HEAD.size :])
