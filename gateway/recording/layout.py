"""What writer and reader of a recording agree on, beside the bytes of the ticks (`tick_codec`)."""

from __future__ import annotations

import re
from hashlib import blake2b

from gateway.config.errors import RENAMED

FORMAT = "3"
"""Format of ticks and metadata that is written."""
READABLE = ("1", "2", FORMAT)
"""Formats that can be read, all of one layout. "1" and "2" have every pose in one frame, "odom". "1" has
former robot-file keys, too, and its texts for people were worded differently; see `modernised`."""
MAGIC = b"\x89MCAP0\r\n"
ROBOT_FILE = "robot.toml"
"""Name of the attachment with the robot file."""
METADATA = "motor_gateway"
"""Name of the metadata with format and digest of the robot file."""
FACTS = "facts"
"""Name of the metadata with versions, processor and so on."""
VIEWS_FROM = "views from tick"
"""A fact of a trimmed file: the ticks before this one are there for the state alone, and have few views."""
NEVER = str(2**62)
"""Its value in a file that has no views"""
RECOVERED = "recovered"
"""Name of additional metadata of a recovered file: its source, and what was lost."""


class Opcode:
    """Kinds of records in an MCAP file (mcap.dev/spec)."""

    HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
    ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(
        9, 16
    )


def digest(data: bytes) -> str:
    """Return the digest of the robot file, as in the metadata."""
    return blake2b(data, digest_size=16).hexdigest()


_KEYS_OUTSIDE_STRINGS = re.compile(
    r'"{3}.*?"{3}|\'{3}.*?\'{3}|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*'
    rf"|(?<![\w-])(?P<key>{'|'.join(RENAMED)})(?=[ \t]*=[ \t]*[^{{\s])",
    re.DOTALL,
)


_LINES = re.compile(r"(?m)^[ \t]*(?:\[(?P<table>[\w.]+)\]|(?P<key>[\w.]+)[ \t]*=).*(?:\n|\Z)")
DROPPED = frozenset({"brain.perception.map.width", "brain.perception.map.height"})
"""Settings of formats 1 and 2 that there are no longer: the map has no border."""


def modernised(robot_text: str, format_: str) -> str:
    """Return the robot file of a recording of that format with today's keys; all else stays as it is.

    Format 1 has former keys of motors and buses (one followed by a table is a motor or bus of that name);
    1 and 2 have `DROPPED`."""
    if format_ == "1":
        robot_text = _KEYS_OUTSIDE_STRINGS.sub(
            lambda found: RENAMED[found["key"]] if found["key"] else found[0], robot_text
        )
    return _without_dropped(robot_text) if format_ in ("1", "2") else robot_text


def _without_dropped(robot_text: str) -> str:
    table = ""

    def kept(found: re.Match[str]) -> str:
        nonlocal table
        table = found["table"] or table
        dropped = found["key"] and ".".join(filter(None, (table, found["key"]))) in DROPPED
        return "" if dropped else found[0]

    return _LINES.sub(kept, robot_text)
