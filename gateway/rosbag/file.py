"""A bag on disk, opened; and whether a file is one.

Rules. The library that reads bags knows by the name alone whether one is of ROS 1, checks by `assert`, and
lets other libraries' errors through. Here all of that becomes a `BagError`: a sentence with a cause.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING

from gateway.errors import BagError
from gateway.recording.layout import MAGIC, METADATA

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

ROS1 = b"#ROSBAG"


def is_foreign(path: Path) -> bool:
    """Whether this is a bag of somebody else's: a folder, a ROS 1 bag, SQLite, or another's MCAP file."""
    if path.is_dir():
        return True
    try:
        start = _start(path)
    except OSError:
        return False
    if start.startswith(MAGIC):
        return not _is_ours(path)
    return start.startswith((ROS1, b"SQLite format 3"))


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


def _is_ours(path: Path) -> bool:
    """Whether our metadata stand before the first message; yes too for what is too short to tell."""
    from mcap.exceptions import McapError
    from mcap.records import Message, Metadata
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=path.stat().st_size).records:
                if isinstance(record, Message):
                    return False
                if isinstance(record, Metadata) and record.name == METADATA:
                    return True
        except (McapError, struct.error, ValueError, RuntimeError):
            return True  # our own reader says what is wrong with it
    return False


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """The bag, open; whatever its reader meets becomes a BagError that says so."""
    _check_form(path)
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error
    from rosbags.typesys import Stores, get_typestore

    try:
        # A ROS 1 bag holds the definitions of its types; of ROS 2, some leave them to the reader.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            yield reader
    except (AnyReaderError, Ros1Error, Ros2Error) as error:
        raise BagError(f"{path}: {_line(error)}") from error
    except AssertionError as error:
        place = extract_tb(error.__traceback__)[-1]
        raise BagError(
            f"{path}: damaged: it fails the reader's check `{place.line}` ({place.name})"
        ) from error
    except DAMAGE as error:
        raise BagError(f"{path}: damaged: {type(error).__name__}: {_line(error)}") from error


def _check_form(path: Path) -> None:
    """What the library would take for something else."""
    if not __debug__:
        raise BagError(
            f"{path}: python -O switches off the checks of the library that reads bags; run without"
        )
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(f"{path}: a folder without metadata.yaml: no bag of ROS 2")
    if path.suffix != ".bag" and path.is_file() and _start(path).startswith(ROS1):
        raise BagError(
            f"{path}: a bag of ROS 1 must be called .bag (a .active one is unfinished: reindex it)"
        )
    for database in sorted(path.glob("*.db3")) if path.is_dir() else [path] * (path.suffix == ".db3"):
        _check_database(database)


def _check_database(path: Path) -> None:
    """SQLite's own check: the library that reads bags lets SQLite's complaints through."""
    try:
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            said = database.execute("PRAGMA integrity_check(1)").fetchone()[0]
    except sqlite3.Error as error:
        raise BagError(f"{path}: damaged: {_line(error)}") from error
    if said != "ok":
        raise BagError(f"{path}: damaged: {_line(said)}")


def _line(said: object) -> str:
    """What somebody else's error says, as a part of a sentence."""
    text = " ".join(str(said).split())
    return (text if len(text) <= LONGEST else f"{text[:LONGEST]}…").rstrip(".: ")


LONGEST = 120
"""Characters of somebody else's words that are told."""
DAMAGE = (
    ArithmeticError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
"""What a reader of damaged bytes runs into, beside its own errors."""
