"""Opening a bag on disk, and recognising one.

Rules. The library that reads bags recognises ROS 1 by the file name only, checks by `assert`, and passes
other libraries' errors through. Here all of that becomes a `BagError` with its cause.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING

from gateway.errors import BagError, GatewayError
from gateway.recording.layout import MAGIC
from gateway.recording.mcap_records import MAX_EXPANSION
from gateway.recording.reader import has_end, is_recording

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

ROS1 = b"#ROSBAG"


def is_bag(path: Path) -> bool:
    """True if this is another program's bag: a folder, a ROS 1 bag, SQLite, or another's MCAP file."""
    if path.is_dir():
        return True
    try:
        start = first_bytes(path)
    except OSError:
        return False
    if start.startswith(MAGIC):
        return not is_recording(path)
    return start.startswith((ROS1, b"SQLite format 3"))


def first_bytes(path: Path) -> bytes:
    """Return the beginning of a file, which tells its format."""
    with path.open("rb") as file:
        return file.read(16)


@contextmanager
def open_bag(path: Path) -> Iterator[tuple[AnyReader, str]]:
    """Open a bag, and tell how it is read where it is not as it was meant ("" if it is); any error of its
    reader becomes a BagError."""
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error

    try:
        file, remark = _file_of(path)
        _check_form(file)
        with _limited_memory(path), ExitStack() as stack:
            reader, made = _opened(file, stack)
            yield reader, "; ".join(filter(None, [remark, made]))
    except (AnyReaderError, Ros1Error, Ros2Error) as error:
        alone = f": {inside}" if (inside := _inside(path)) else ""
        raise BagError(f"{path}: {_line(error)}{alone}") from error
    except AssertionError as error:
        place = extract_tb(error.__traceback__)[-1]
        raise BagError(
            f"{path}: damaged: it fails the reader's check `{place.line}` ({place.name})"
        ) from error
    except MemoryError as error:
        raise BagError(f"{path}: needs too much memory for its size: damaged, or made to do harm") from error
    except GatewayError:
        raise
    except Exception as error:  # of SQLite, YAML, a codec: whatever damaged bytes make a library raise
        raise BagError(f"{path}: damaged: {type(error).__name__}: {_line(error)}") from error


def _opened(path: Path, stack: ExitStack) -> tuple[AnyReader, str]:
    """Open a bag until the stack is closed; one whose index is absent or damaged by going through it."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    from gateway.rosbag.mcap_scan import UnindexedMcap
    from gateway.rosbag.ros1 import OldOrNew, Unindexed

    # A ROS 1 bag contains the definitions of its types; some ROS 2 bags leave them to the reader.
    reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
    one: Unindexed | UnindexedMcap | None = None
    if path.suffix == ".bag":
        reader.readers = [OldOrNew(path)]
        try:
            return stack.enter_context(reader), ""
        except (AnyReaderError, AssertionError, ArithmeticError, LookupError, ValueError, struct.error):
            one = Unindexed(path)
            reader.readers = [one]
    elif _is_cut(path):
        whole = Reader(path)
        whole.storage = one = UnindexedMcap(path)
        reader.readers = [whole]
    stack.enter_context(reader)
    if one is None:
        return reader, ""
    count = sum(each.msgcount for each in reader.connections)
    if not count:
        raise BagError(f"{path}: its index is absent or damaged, and no message of it is whole")
    end = f"; {'' if path.suffix == '.mcap' else 'not to its end: '}{_line(one.why)}" if one.why else ""
    return reader, f"its index is absent or damaged: gone through from its beginning, {count} messages{end}"


def _file_of(path: Path) -> tuple[Path, str]:
    """Return what to open, and a remark: of a folder without its metadata, or whose only file was cut off, it
    alone."""
    if not path.is_dir() or len(files := _files(path)) != 1 or not is_bag(files[0]):
        return path, ""  # or a recording of this gateway
    told, cut = (path / "metadata.yaml").exists(), _is_cut(files[0])
    if told and not cut:
        return path, ""
    what = "whose file was cut off" if told else "without metadata.yaml"
    return files[0], f"a folder {what}: its one file is read, {files[0].name}"


def _is_cut(file: Path) -> bool:
    """Whether a file is an MCAP that was not closed."""
    return file.is_file() and first_bytes(file).startswith(MAGIC) and not has_end(file)


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


@contextmanager
def _limited_memory(path: Path) -> Iterator[None]:
    """Limit the memory of this process: the library unpacks whatever a bag contains, to any size.

    Linux alone reports and limits it; elsewhere it is not limited."""
    if not STATM.exists():
        yield
        return
    import resource

    files = path.rglob("*") if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files if file.is_file())
    pages = int(STATM.read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = pages * resource.getpagesize() + MAX_MEMORY + MAX_EXPANSION * size
    if soft == resource.RLIM_INFINITY or most < soft:
        resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _check_form(path: Path) -> None:
    """Raise BagError for what the library would misinterpret."""
    if not __debug__:
        raise BagError(
            f"{path}: python -O switches off the checks of the library that reads bags; run without"
        )
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(f"{path}: a folder without metadata.yaml: {_inside(path) or 'no bag of ROS 2'}")
    for file in path.glob("*.mcap") if path.is_dir() else ():
        if _is_cut(file):
            raise BagError(f"{file}: it was cut off, and its folder has others: replay it alone")
    if path.suffix != ".bag" and path.is_file() and first_bytes(path).startswith(ROS1):
        raise BagError(
            f"{path}: a bag of ROS 1 must be called .bag: rename it (a .active one was not finished, and is "
            "read to where it is whole)"
        )
    for database in sorted(path.glob("*.db3")) if path.is_dir() else [path] * (path.suffix == ".db3"):
        _check_database(database)


def _inside(path: Path) -> str:
    """Return what to do with the files of a folder whose metadata are absent or wrong; "" without any."""
    if not path.is_dir():
        return ""
    files = _files(path)
    if len(files) > 1:
        return (
            f"its {len(files)} files can be replayed one by one, or `ros2 bag reindex {path}` makes it anew"
        )
    return f"replay its file alone, {files[0]}" if files else ""


def _check_database(path: Path) -> None:
    """Run SQLite's own check: the library that reads bags passes SQLite's errors through."""
    try:
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            result = database.execute("PRAGMA integrity_check(1)").fetchone()[0]
    except sqlite3.Error as error:
        raise BagError(f"{path}: damaged: {_line(error)}") from error
    if result != "ok":
        raise BagError(f"{path}: damaged: {_line(result)}")


def _line(error: object) -> str:
    """Return an error of another library as one short line."""
    text = " ".join(str(error).split())
    return (text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}…").rstrip(".: ")


STATM = Path("/proc/self/statm")
"""What memory this process takes; its first number is in pages."""
MAX_MEMORY = 512 * 1024 * 1024
"""Bytes that reading a bag may take, beside `MAX_EXPANSION` times its size."""
MAX_LENGTH = 120
"""Characters of another library's error text that are shown."""
