"""What writer and reader of a recording agree on, beside the bytes of the ticks (`tick_codec`)."""

from __future__ import annotations

import re
from hashlib import blake2b

from gateway.config.errors import RENAMED

FORMAT = "2"
"""Format of ticks and metadata that is written."""
READABLE = ("1", FORMAT)
"""Formats that can be read. "1" has the same layout, but former robot-file keys (see `modernised`), and its
texts for people were worded differently."""
MAGIC = b"\x89MCAP0\r\n"
ROBOT_FILE = "robot.toml"
"""Name of the attachment with the robot file."""
METADATA = "motor_gateway"
"""Name of the metadata with format and digest of the robot file."""
FACTS = "facts"
"""Name of the metadata with versions, processor and so on."""
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


def modernised(robot_text: str) -> str:
    """Return a robot file of format 1 with today's keys of motors and buses; all else stays as it is.

    A key followed by a table is a motor or bus of that name."""
    return _KEYS_OUTSIDE_STRINGS.sub(
        lambda found: RENAMED[found["key"]] if found["key"] else found[0], robot_text
    )
