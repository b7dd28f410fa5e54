"""Reads a recording: closed, cut short, or damaged."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from gateway.core.tick import Tick
from gateway.errors import RecordingError
from gateway.recording import opcode, tick_codec
from gateway.recording.layout import FACTS, FORMAT, MAGIC, METADATA, ROBOT_FILE, digest
from gateway.recording.mcap_records import MESSAGE_HEAD, Damage, Record, records
from gateway.recording.ros_views import View
from gateway.recording.tick_codec import JournalError

if TYPE_CHECKING:
    from mcap.records import Attachment, Channel, Header, Metadata, Schema

    Rare = TypeVar("Rare", Attachment, Channel, Header, Metadata, Schema)


@dataclass(frozen=True, slots=True)
class Step:
    """A tick as it stands in a recording, with what was shown of it."""

    tick: Tick
    views: tuple[View, ...]
    damage: tuple[str, ...]
    """What was changed since it was written, in words; empty if nothing."""
    whole: bool
    """False for the last one before a cut: views may be missing."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording on disk. Its ticks are read as they are asked for, every time anew."""

    path: Path
    robot_text: str
    """The robot file it was made with."""
    facts: dict[str, str]
    """Where and with what it was made."""
    whole: bool
    """Whether it was closed; otherwise it ends where the writing ended."""
    promised: int | None
    """How many ticks its index says there are; None without an index."""

    @property
    def ticks(self) -> Iterator[Tick]:
        """The ticks, in the order in which they happened. Raises RecordingError where it is damaged."""
        return (step.tick for step in self.steps)

    @property
    def steps(self) -> Iterator[Step]:
        """The ticks with their views and with what was changed since. Raises RecordingError as `ticks`."""
        return _steps(self.path, self.whole)


def read(path: Path) -> Recording:
    """Open a recording. Raises RecordingError if it is none, of another format, or unreadable."""
    whole = has_end(path)
    robot_text, facts = head(path, whole)
    return Recording(path, robot_text, facts, whole, _promised(path) if whole else None)


def has_end(path: Path) -> bool:
    """Whether the file was closed. Raises RecordingError if it is no MCAP file."""
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC) + 8)
            file.seek(-min(len(MAGIC), file.seek(0, os.SEEK_END)), os.SEEK_END)
            whole = file.read() == MAGIC and len(start) > len(MAGIC)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    if not start.startswith(MAGIC):
        raise RecordingError(f"{path}: {_what_it_is(start)}, not a recording of this gateway")
    return whole


def _what_it_is(start: bytes) -> str:
    if not start:
        return "an empty file"
    if start.startswith(b"#ROSBAG"):
        return "a ROS 1 bag"
    return "a ROS 2 bag of kind sqlite3" if start.startswith(b"SQLite format") else "no MCAP file"


def parse(path: Path, kind: type[Rare], record: Record) -> Rare:
    """A rare record's fields. Raises RecordingError if they cannot be made out."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        made: Rare = kind.read(ReadDataStream(BytesIO(record.content)))
    except (McapError, struct.error, ValueError) as error:
        raise RecordingError(f"{path}: damaged: a {kind.__name__} cannot be read: {error}") from error
    return made


def head(path: Path, whole: bool) -> tuple[str, dict[str, str]]:
    """The robot file and the facts, which stand before the first tick. Raises RecordingError if they do not,
    or if the file has an end and is damaged before it."""
    from mcap.records import Attachment, Header, Metadata

    metadata: dict[str, dict[str, str]] = {}
    library = ""
    robot: bytes | None = None
    for record in _records(path, whole):
        if record.opcode == opcode.HEADER:
            library = parse(path, Header, record).library
        elif record.opcode == opcode.METADATA:
            reported = parse(path, Metadata, record)
            metadata[reported.name] = reported.metadata
        elif record.opcode == opcode.ATTACHMENT:
            attached = parse(path, Attachment, record)
            robot = attached.data if attached.name == ROBOT_FILE else robot
        elif record.opcode == opcode.MESSAGE:
            break
    if METADATA not in metadata:
        if not whole and not library:
            raise RecordingError(f"{path}: cut off in its first bytes: nothing can be read")
        raise RecordingError(f"{path}: an MCAP file of {library or 'another program'}, not of this gateway")
    _check_head(path, metadata[METADATA], robot)
    return (robot or b"").decode(errors="surrogateescape"), metadata.get(FACTS, {})


def _check_head(path: Path, head: Mapping[str, str], robot: bytes | None) -> None:
    if head.get("format") != FORMAT:
        raise RecordingError(
            f"{path}: a recording of format {head.get('format')}; this program reads format {FORMAT}"
        )
    if robot is None:
        raise RecordingError(f"{path}: cut off before the robot file: there is no tick in it")
    if digest(robot) != head.get("robot digest"):
        raise RecordingError(f"{path}: damaged: the robot file in it does not match its digest")


def _promised(path: Path) -> int | None:
    """How many ticks the index at the end counts."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, struct.error, ValueError, OSError) as error:
        raise RecordingError(f"{path}: damaged: its index cannot be read") from error
    if summary is None or summary.statistics is None:
        return None
    counts = summary.statistics.channel_message_counts
    return sum(counts.get(c.id, 0) for c in summary.channels.values() if c.topic == tick_codec.TOPIC)


def _records(path: Path, whole: bool) -> Iterator[Record]:
    """The records in the order of the file. A closed file must be undamaged; another ends at the first
    damage."""
    with path.open("rb") as file:
        for piece in records(file):
            if isinstance(piece, Damage):
                if not whole:
                    return
                raise RecordingError(f"{path}: damaged near byte {piece.at}: {piece.why}")
            yield piece


def _steps(path: Path, whole: bool) -> Iterator[Step]:
    from mcap.records import Channel, Schema

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    seals = tick_codec.UNPROTECTED
    entry: tick_codec.Entry | None = None
    views: list[View] = []
    for record in _records(path, whole):
        if record.opcode == opcode.SCHEMA:
            schema = parse(path, Schema, record)
            schemas[schema.id] = schema.name
        elif record.opcode == opcode.CHANNEL:
            channel = parse(path, Channel, record)
            channels[channel.id] = (channel.topic, schemas.get(channel.schema_id, ""))
        elif record.opcode == opcode.MESSAGE:
            number, _sequence, _log, published = MESSAGE_HEAD.unpack_from(record.content)
            topic, type_ = channels.get(number, ("", ""))
            data = record.content[MESSAGE_HEAD.size :]
            if topic != tick_codec.TOPIC:
                views.append(View(topic, type_, published, data))
                continue
            if entry is not None:
                yield Step(entry.tick, tuple(views), entry.damage(), whole=True)
            entry, views = _entry(path, data, seals, entry), []
            seals = entry.seals
    if entry is not None:
        yield Step(entry.tick, tuple(views), entry.damage(), whole)


def _entry(
    path: Path, data: bytes, seals: tick_codec.DigestChain, last: tick_codec.Entry | None
) -> tick_codec.Entry:
    try:
        return tick_codec.decode(data, seals)
    except JournalError as error:
        where = f"after tick {last.tick.number}" if last else "at its first tick"
        raise RecordingError(f"{path}: damaged {where}: {error}") from error
