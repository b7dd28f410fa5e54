"""Makes a recording whole again: what can be read of one goes into a new file, byte for byte, with an index.

Rules. The damaged file is only read. The new one appears when it is finished, and never in place of another.
What is given back are whole ticks with all that was shown of them, as they were written; what is not is told.
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
from gateway.recording import opcode, tick_codec
from gateway.recording.layout import MAGIC
from gateway.recording.mcap_file import McapFile
from gateway.recording.mcap_records import MESSAGE_HEAD, Damage, Record, records
from gateway.recording.reader import has_end, head, parse, read
from protocols.messages import Nanos, seconds

SALVAGED = "recovered"
"""The metadata that a recovered file has beside the others: from which file, and what it lost."""
CHUNK_SIZE = 512 * 1024
_CRC = struct.Struct("<I")
_FOOTER = struct.Struct("<BQQQ")
_TICK = struct.Struct("<4xQq")


@dataclass(slots=True)
class Recovery:
    """What was found in a file."""

    ended: bool = False
    """Whether the data have an end: then nothing was cut off, though the index may have been."""
    size: int = 0
    """Bytes of the file."""
    ticks: int = 0
    messages: int = 0
    """All of them, ticks among them."""
    first: tuple[int, Nanos] | None = None
    """Number and time of the first tick,"""
    last: tuple[int, Nanos] | None = None
    """and of the last."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """Numbers of the first and last tick of each run that is missing in between."""
    damages: list[Damage] = field(default_factory=list)

    def reported(self) -> list[str]:
        """For a person: what there is, and what was lost."""
        lines = [f"bytes {d.at} to {d.at + d.size} of {self.size}: {d.why}" for d in self.damages]
        if self.first and self.last:
            span = seconds(self.last[1] - self.first[1])
            lines.append(
                f"{self.ticks} ticks, {self.first[0]} to {self.last[0]}, over {span:.3f} s; "
                f"{self.messages} messages in all"
            )
            lines.append(f"the last tick is {self.last[0]}, at {seconds(self.last[1]):.6f} s of its clock")
        else:
            lines.append("not one tick can be read")
        lines += [f"missing in between: ticks {a} to {b}" for a, b in self.gaps]
        if not self.ended:
            lines.append("the file was not closed: what came after that tick was never written whole")
        return lines


def is_whole(path: Path) -> bool:
    """Whether every byte before the end is proven, and the index counts all ticks. Raises RecordingError if
    it is no recording."""
    _check(path)
    found = Recovery()
    for _ in _followed(path, found):
        pass
    if not found.ended or found.damages or not _index_is_sound(path):
        return False
    try:
        return read(path).promised == found.ticks
    except RecordingError:  # its index
        return False


def _index_is_sound(path: Path) -> bool:
    """Whether index and footer match the checksum in the footer."""
    with path.open("rb") as file:
        end = file.seek(-len(MAGIC) - _CRC.size, os.SEEK_END)
        (crc,) = _CRC.unpack(file.read(_CRC.size))
        file.seek(end - _FOOTER.size)
        code, _length, start, _offsets = _FOOTER.unpack(file.read(_FOOTER.size))
        if code != opcode.FOOTER or start > end:
            return False
        file.seek(start)
        made, left = 0, end - start
        while left:
            block = file.read(min(left, CHUNK_SIZE))
            if not block:
                return False
            made, left = zlib.crc32(block, made), left - len(block)
    return bool(made == crc)


def salvage(path: Path, target: Path) -> Recovery:
    """Write what can be read of a recording to a new file; if there is no tick to be read, to none.

    Raises RecordingError if it is no recording, or if the new file is there already or cannot be written."""
    _check(path)
    if target.exists():
        raise RecordingError(f"{target}: there is such a file already; it is not overwritten")
    part = target.with_name(target.name + ".part")
    try:
        found = _copy(path, part)
        if found.ticks:
            part.replace(target)
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
    if found.ticks and read(target).promised != found.ticks:
        raise RecordingError(f"{target}: does not read back as it was written: do not trust it")
    return found


def _check(path: Path) -> None:
    has_end(path)
    head(path, whole=False)


def _followed(path: Path, found: Recovery) -> Iterator[Record]:
    """All records that can be read, while what they come to is noted."""
    from mcap.records import Channel

    ticks: set[int] = set()
    try:
        with path.open("rb") as file:
            found.size = path.stat().st_size
            for piece in records(file):
                if isinstance(piece, Damage):
                    found.damages.append(piece)
                    continue
                if piece.opcode == opcode.DATA_END:
                    found.ended = True
                elif piece.opcode == opcode.CHANNEL:
                    channel = parse(path, Channel, piece)
                    ticks |= {channel.id} if channel.topic == tick_codec.TOPIC else set()
                elif piece.opcode == opcode.MESSAGE:
                    found.messages += 1
                    if MESSAGE_HEAD.unpack_from(piece.content)[0] in ticks:
                        _note(found, piece)
                yield piece
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _note(found: Recovery, record: Record) -> None:
    number, now = _TICK.unpack_from(record.content, MESSAGE_HEAD.size)
    found.ticks += 1
    if found.last is not None and number > found.last[0] + 1:
        found.gaps.append((found.last[0] + 1, number - 1))
    found.first = found.first or (number, now)
    found.last = (number, now)


def _copy(path: Path, target: Path) -> Recovery:
    found = Recovery()
    copy = _Copy(path, target)
    try:
        for record in _followed(path, found):
            copy.take(record)
        copy.finish(found)
    finally:
        copy.file.abandon()
    return found


class _Copy:
    """A new file with the contents of another."""

    def __init__(self, path: Path, target: Path) -> None:
        self.file = McapFile(target, "motor-gateway recover")
        self._path = path
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, int] = {}

    def take(self, record: Record) -> None:
        """One record of the other file. Raises OSError and RecordingError."""
        from mcap.records import Attachment, Metadata, Schema

        if record.opcode == opcode.MESSAGE:
            self._message(record.content)
        elif record.opcode == opcode.CHANNEL:
            self._channel(record)
        elif record.opcode == opcode.SCHEMA:
            schema = parse(self._path, Schema, record)
            self._schemas[schema.id] = (schema.name, schema.data.decode(errors="replace"))
        elif record.opcode == opcode.METADATA:
            reported = parse(self._path, Metadata, record)
            self.file.metadata(reported.name, reported.metadata)
        elif record.opcode == opcode.ATTACHMENT:
            attached = parse(self._path, Attachment, record)
            self.file.attachment(attached.name, attached.media_type, attached.data)

    def finish(self, found: Recovery) -> None:
        """All is taken. What was lost is told in the file, too."""
        self.file.flush()
        self.file.metadata(SALVAGED, {"from": self._path.name, "told": "\n".join(found.reported())})
        self.file.finish()

    def _channel(self, record: Record) -> None:
        from mcap.records import Channel

        channel = parse(self._path, Channel, record)
        type_, definition = self._schemas.get(channel.schema_id, ("", ""))
        made = self.file.channel(channel.topic, type_)
        if made is None:
            qos = channel.metadata.get("offered_qos_profiles", "")
            made = self.file.open_channel(channel.topic, type_, definition, qos)
        self._channels[channel.id] = made

    def _message(self, content: bytes) -> None:
        channel, sequence, log, published = MESSAGE_HEAD.unpack_from(content)
        made = self._channels.get(channel)
        if made is None:  # its channel stood where the file is damaged
            return
        if self.file.waiting > CHUNK_SIZE:
            self.file.flush()
        self.file.message(made, sequence, log, published, content[MESSAGE_HEAD.size :])
