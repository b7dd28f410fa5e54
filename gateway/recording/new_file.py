"""Files that a command writes: opened so that nothing that somebody else has, or writes, is lost by it.

Rules. What must be new is made by the call that opens it: of two programs with one name, one is refused. A
link in its place, also one to nothing, is never followed.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

from gateway.recording.layout import MAGIC

EXISTS = "exists already; it is never overwritten"


def create(path: Path) -> int:
    """Return the descriptor of a new file, open for writing; a pipe or device (/dev/null) is opened as it is.

    Raises OSError: FileExistsError if there is a file or a link already."""
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    except FileExistsError:
        if _is_kept(path.lstat().st_mode):
            raise FileExistsError(0, EXISTS, str(path)) from None
        return os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)


def _is_kept(mode: int) -> bool:
    return not (stat.S_ISCHR(mode) or stat.S_ISFIFO(mode))


def create_with(path: Path, data: bytes) -> None:
    """Write a new file, whole or not at all. Raises OSError as `create`."""
    descriptor = create(path)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
    except OSError:
        path.unlink(missing_ok=True)
        raise


def replace_with(path: Path, data: bytes) -> None:
    """Write a file, in the place of one of that name. Raises OSError, also if it is a link or a recording."""
    if _is_recording(path):
        raise FileExistsError(0, f"is a recording, which {EXISTS}", str(path))
    try:
        descriptor = os.open(
            path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666
        )
    except OSError as error:
        if path.is_symlink():
            raise OSError(error.errno, "is a link: name the file itself", str(path)) from error
        raise
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)


def _is_recording(path: Path) -> bool:
    if not path.is_file() or path.is_symlink():
        return False
    with path.open("rb") as there:
        return there.read(len(MAGIC)) == MAGIC


def publish(part: Path, target: Path) -> None:
    """Give a finished file its name, which nothing must have. Raises OSError as `create`."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise FileExistsError(0, EXISTS, str(target)) from None
    except OSError:  # a file system without hard links
        if os.path.lexists(target):
            raise FileExistsError(0, EXISTS, str(target)) from None
        part.replace(target)
    with suppress(FileNotFoundError):
        part.unlink()
