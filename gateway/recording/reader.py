"""Reading a recording: closed, cut short, or damaged."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from gateway.core.message_text import escaped
from gateway.core.tick import Tick
from gateway.errors import RecordingError
from gateway.recording import tick_codec
from gateway.recording.layout import (
    FACTS,
    MAGIC,
    METADATA,
    READABLE,
    RECOVERED,
    ROBOT_FILE,
    VIEWS_FROM,
    Opcode,
    digest,
    modernised,
)
from gateway.recording.mcap_records import (
    MAX_UNPACKED,
    MESSAGE_HEAD,
    Damage,
    Record,
    newest_time,
    records,
    summary,
)
from gateway.recording.ros_views import ViewMessage
from gateway.recording.tick_codec import TickCodecError, UnknownKind
from protocols import sensors
from protocols.messages import Nanos

_VIEW = 200
"""Bytes of memory of a view, beside its data"""

if TYPE_CHECKING:
    from mcap.records import Attachment, Channel, Header, Metadata, MetadataIndex, Schema, Statistics

    R = TypeVar("R", Attachment, Channel, Header, Metadata, MetadataIndex, Schema, Statistics)


@dataclass(frozen=True, slots=True)
class FilePlace:
    """Where a tick stands in the file, and what it takes to read on from there without all before it."""

    at: tuple[int, int]
    """The byte where its chunk begins, and the byte in the chunk."""
    before: tick_codec.DigestChain
    """The digests written with the tick before it."""
    known: FileDeclarations
    """The channels so far."""


@dataclass(slots=True)
class FileDeclarations:
    """What the file has declared so far. It only grows: all places in a recording share it."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Topic and type."""


@dataclass(frozen=True, slots=True)
class Step:
    """A recorded tick, with its views."""

    tick: Tick
    views: tuple[ViewMessage, ...]
    damage: tuple[str, ...]
    """What was changed since it was written, in words; empty if nothing."""
    whole: bool
    """False where views may be missing: the last one before a cut, and what a trimmed file begins with."""
    place: FilePlace


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording on disk. Its ticks are read from the file at each iteration."""

    path: Path
    format: str
    robot_text: str
    """The robot file it was made with, in today's keys."""
    facts: dict[str, str]
    """Program, packages and processor it was made with."""
    whole: bool
    """True if it was closed; otherwise it ends where the writing ended."""
    indexed: int | None
    """Number of ticks by its index; None without an index."""
    end: Nanos
    """Time of its last tick: by its index, or by the heads of its chunks."""
    recovered: bool = False
    """True if `gateway recover` has made it of a file that was cut off or damaged."""

    @property
    def ticks(self) -> Iterator[Tick]:
        """The ticks, in order. Raises RecordingError where it is damaged."""
        return (step.tick for step in self.steps)

    @property
    def steps(self) -> Iterator[Step]:
        """The ticks with their views and damage. Raises RecordingError as `ticks`."""
        return _steps(self.path, self.whole, self.facts)

    def steps_from(self, place: FilePlace) -> Iterator[Step]:
        """The same from one of them on; what is before it is not read. Raises RecordingError as `ticks`."""
        return _steps(self.path, self.whole, self.facts, place)


def read_recording(path: Path | str) -> Recording:
    """Open a recording.

    Args:
        path: an MCAP file, whole, cut off or damaged.

    Returns:
        Recording: its robot file, where it was made, and its ticks, read as they are asked for.

    Raises:
        RecordingError: it is no recording, of an unknown format, or unreadable.
    """
    path = Path(path)
    whole = has_end(path)
    format_, robot_text, facts = head(path, whole)
    robot_text = modernised(robot_text, format_)
    indexed, end, recovered = _indexed(path) if whole else (None, None, False)
    if end is None:
        with path.open("rb") as file:
            end = newest_time(file)
    return Recording(path, format_, robot_text, facts, whole, indexed, end, recovered)


def has_end(path: Path) -> bool:
    """True if the file was closed. Raises RecordingError if it is not an MCAP file."""
    try:
        with path.open("rb") as file:
            start = file.read(len(MAGIC) + 8)
            file.seek(-min(len(MAGIC), file.seek(0, os.SEEK_END)), os.SEEK_END)
            whole = file.read() == MAGIC and len(start) > len(MAGIC)
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    if not start.startswith(MAGIC):
        raise RecordingError(f"{path}: {_file_kind(start)}, not a recording of this gateway")
    return whole


OURS = b"motor-gateway"
"""In the name of the library that an MCAP file's header has"""


def is_recording(path: Path) -> bool:
    """True if an MCAP file has a recording's metadata before its first message; or if it ends before that, or
    cannot be read, and does not name another program."""
    ours = True
    with path.open("rb") as file:
        for piece in records(file):
            if isinstance(piece, Damage):
                return ours and not piece.reason.startswith(
                    "a chunk packed with"
                )  # the reader reports others
            if piece.opcode == Opcode.HEADER:
                ours = OURS in piece.content
            if piece.opcode in (Opcode.MESSAGE, Opcode.DATA_END):
                return False
            if piece.opcode == Opcode.METADATA and METADATA.encode() in piece.content[: len(METADATA) + 4]:
                return True
    return ours


def _file_kind(start: bytes) -> str:
    if not start:
        return "an empty file"
    if start.startswith(b"#ROSBAG"):
        return "a ROS 1 bag"
    return "a ROS 2 bag of kind sqlite3" if start.startswith(b"SQLite format") else "no MCAP file"


def parse(path: Path, kind: type[R], record: Record) -> R:
    """Parse a record other than a message. Raises RecordingError if it is damaged."""
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError

    try:
        parsed: R = kind.read(ReadDataStream(BytesIO(record.content)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: damaged: a {kind.__name__} cannot be read: {error}") from error
    return parsed


def head(path: Path, whole: bool) -> tuple[str, str, dict[str, str]]:
    """Return format, robot file and facts, which precede the first tick.

    Raises RecordingError if they do not, or if the file has an end and is damaged before it."""
    from mcap.records import Attachment, Header, Metadata

    metadata: dict[str, dict[str, str]] = {}
    library = ""
    robot: bytes | None = None
    for record in _records(path, whole):
        if record.opcode == Opcode.HEADER:
            library = parse(path, Header, record).library
        elif record.opcode == Opcode.METADATA:
            entry = parse(path, Metadata, record)
            metadata[entry.name] = entry.metadata
        elif record.opcode == Opcode.ATTACHMENT:
            attachment = parse(path, Attachment, record)
            robot = attachment.data if attachment.name == ROBOT_FILE else robot
        elif record.opcode == Opcode.MESSAGE:
            break
    if METADATA not in metadata:
        if not whole and not library:
            raise RecordingError(f"{path}: cut off in its first bytes: nothing can be read")
        raise RecordingError(
            f"{path}: an MCAP file of {escaped(library) or 'another program'}, not of this gateway"
        )
    own = metadata[METADATA]
    format_ = own.get("format", "")
    if format_ not in READABLE:
        readable = f"{', '.join(READABLE[:-1])} and {READABLE[-1]}"
        raise RecordingError(
            f"{path}: a recording of format {escaped(format_)}; this program reads formats {readable}"
        )
    if robot is None:
        raise RecordingError(f"{path}: cut off before the robot file: there is no tick in it")
    if digest(robot) != own.get("robot digest"):
        raise RecordingError(f"{path}: damaged: the robot file in it does not match its digest")
    return format_, robot.decode(errors="surrogateescape"), metadata.get(FACTS, {})


def _indexed(path: Path) -> tuple[int | None, Nanos | None, bool]:
    """Return the number of ticks that the index counts, and the time of the last (None if it does not); and
    whether the file was recovered."""
    from mcap.records import Channel, MetadataIndex, Statistics

    ticks: set[int] = set()
    found: Statistics | None = None
    recovered = False
    with path.open("rb") as file:
        for record in summary(file):
            if record.opcode == Opcode.CHANNEL:
                channel = parse(path, Channel, record)
                ticks |= {channel.id} if channel.topic == tick_codec.TOPIC else set()
            elif record.opcode == Opcode.STATISTICS:
                found = parse(path, Statistics, record)
            elif record.opcode == Opcode.METADATA_INDEX:
                recovered |= parse(path, MetadataIndex, record).name == RECOVERED
    if found is None:
        return None, None, recovered
    count = sum(found.channel_message_counts.get(channel, 0) for channel in ticks)
    return count, found.message_end_time, recovered


def _records(path: Path, whole: bool, start: int = len(MAGIC)) -> Iterator[Record]:
    """Yield the records in the order of the file, from a byte on. A closed file must be undamaged; another
    ends at the first damage."""
    with path.open("rb") as file:
        for piece in records(file, start):
            if isinstance(piece, Damage):
                if not whole:
                    return
                raise RecordingError(f"{path}: damaged near byte {piece.at}: {piece.reason}")
            yield piece


_START = FilePlace((len(MAGIC), 0), tick_codec.CHAIN_START, FileDeclarations())


def _steps(path: Path, whole: bool, facts: Mapping[str, str], start: FilePlace = _START) -> Iterator[Step]:
    from mcap.records import Channel, Schema

    known = FileDeclarations(dict(start.known.schemas), dict(start.known.channels))
    chain, place = start.before, start
    seen_from = _views_from(facts)
    entry: tick_codec.TickEntry | None = None
    views: list[ViewMessage] = []
    held = 0
    """Memory of the views, about"""
    for record in _records(path, whole, start.at[0]):
        if record.at < start.at:
            continue
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                if record.opcode == Opcode.SCHEMA:
                    schema = parse(path, Schema, record)
                    known.schemas[schema.id] = schema.name
                else:
                    channel = parse(path, Channel, record)
                    known.channels[channel.id] = (channel.topic, known.schemas.get(channel.schema_id, ""))
            except RecordingError:
                if whole:
                    raise
                break  # cut off within it, with zeros behind: like any damage, the end of an unclosed file
        elif record.opcode == Opcode.MESSAGE:
            number, _sequence, _log, published = MESSAGE_HEAD.unpack_from(record.content)
            topic, type_ = known.channels.get(number, ("", ""))
            data = record.content[MESSAGE_HEAD.size :]
            if topic != tick_codec.TOPIC:
                views.append(ViewMessage(topic, type_, published, data))
                held += _VIEW + len(data)
                if held > MAX_UNPACKED:
                    raise RecordingError(f"{path}: damaged: more than {MAX_UNPACKED} bytes between two ticks")
                continue
            if entry is not None:
                yield Step(entry.tick, tuple(views), entry.damage(), entry.tick.number >= seen_from, place)
            place = FilePlace(record.at, chain, known)
            entry, views, held = _entry(path, data, chain, entry, facts), [], 0
            chain = entry.written
    if entry is not None:
        whole = whole and entry.tick.number >= seen_from
        yield Step(entry.tick, tuple(views), entry.damage(), whole, place)


def _views_from(facts: Mapping[str, str]) -> int:
    """Return the number of the tick from which on all views are there."""
    text = facts.get(VIEWS_FROM, "0")
    return int(text) if text.isascii() and text.isdigit() and len(text) < 20 else 0


def _entry(
    path: Path,
    data: bytes,
    chain: tick_codec.DigestChain,
    last: tick_codec.TickEntry | None,
    facts: Mapping[str, str],
) -> tick_codec.TickEntry:
    try:
        return tick_codec.decode(data, chain)
    except UnknownKind as error:
        kind = error.kind
        broken = sensors.kinds().broken.get(kind)
        why = f"is broken here: {broken}" if broken else "is not installed here"
        whose = facts.get(f"sensor {kind}", "another program")
        text = f"it holds readings of the kind of sensor {kind!r} of {whose}, which {why}"
        raise RecordingError(escaped(f"{path}: {text}")) from error
    except TickCodecError as error:
        where = f"after tick {last.tick.number}" if last else "at its first tick"
        raise RecordingError(f"{path}: damaged {where}: {error}") from error
