"""A recording of another program, open: its topics, and their messages in the order of writing.

Rules. Nothing is kept: memory does not grow with the length of a recording. Of what is large (scans, clouds)
the head alone can be read, without the message being taken apart.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from gateway.rosbag import file
from gateway.rosbag.carmen import CarmenLog, is_carmen
from gateway.rosbag.tables import Table, layout
from gateway.rosbag.topic import Head, Message, Topic
from protocols.messages import SECOND

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

LONGEST_NAME = 256
"""Bytes of a frame's name; a longer one is damage."""


class Source(Protocol):
    """An open recording."""

    @property
    def remark(self) -> str:
        """How it is read, where that is not as its writer meant; "" if it is."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """All topics, by name; new ones each time."""

    def messages(self, whole: Collection[str], heads: Collection[str] = ()) -> Iterator[Message]:
        """Yield the messages of some topics, and of others the heads alone."""


def is_bag(path: Path) -> bool:
    """True if this is another program's recording: a bag of ROS (`file.is_bag`), a log of CARMEN, or a
    table of a known layout."""
    return file.is_bag(path) or is_carmen(path) or bool(layout(path))


@contextmanager
def open_source(path: Path) -> Iterator[Source]:
    """Open a recording of another program. Raises BagError, also while it is read."""
    if is_carmen(path):
        yield CarmenLog(path)
        return
    if known := layout(path):
        yield Table(path, known)
        return
    with file.open_bag(path) as (reader, remark):
        yield RosBag(path, reader, remark)


class RosBag:
    """A bag of ROS 1 or ROS 2."""

    def __init__(self, path: Path, reader: AnyReader, remark: str = "") -> None:
        self._path, self._reader, self.remark = path, reader, remark
        self._ros1 = path.suffix == ".bag"

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics, by name."""
        found: dict[str, Topic] = {}
        for one in self._reader.connections:
            known = found.setdefault(one.topic, Topic(one.topic, one.msgtype, 0))
            known.known &= one.msgtype in self._reader.typestore.fielddefs
            known.count += one.msgcount
            if known.type != one.msgtype:
                known.type = "messages of several types"
        return found

    def messages(self, whole: Collection[str], heads: Collection[str] = ()) -> Iterator[Message]:
        """Yield the messages of some topics, and of others the heads alone."""
        wanted = [one for one in self._reader.connections if one.topic in whole or one.topic in heads]
        headed = {one.id: self._has_head(one) for one in wanted}
        for one, logged, data in self._reader.messages(wanted) if wanted else ():
            if one.topic in whole:
                yield one.topic, logged, self._reader.deserialize(data, one.msgtype)
            else:
                yield one.topic, logged, self._head(data) if headed[one.id] else Head(0, "")

    def _has_head(self, one: Connection) -> bool:
        """Whether its messages begin with a std_msgs/Header."""
        definition = self._reader.typestore.fielddefs.get(one.msgtype)
        if definition is None or not definition[1]:
            return False
        return bool(definition[1][0][1][1] == "std_msgs/msg/Header")

    def _head(self, data: bytes) -> Head:
        """Return the stamp and the frame. ROS 1: a number, seconds, nanoseconds, text; ROS 2: four bytes that
        tell the order of the others (CDR), seconds, nanoseconds, text with a NUL."""
        order = "<" if self._ros1 or data[1] & 1 else ">"
        if len(data) < 16:
            return Head(0, "")
        whole, part, length = struct.unpack_from(f"{order}{'I' if self._ros1 else 'i'}II", data, 4)
        name = bytes(data[16 : 16 + length]) if length <= LONGEST_NAME else b""
        return Head(whole * SECOND + part, name.rstrip(b"\0").decode(errors="replace"))
