"""A folder of this user alone, for files that are code to whoever reads them.

Rules. It is held open: whoever can rename what is above it cannot put another in its place. Folders and files
are judged by what was opened, not by a name, and count only if they are this user's, and nobody else's to
write to. Links are not followed.
"""

from __future__ import annotations

import os
import shutil
import stat
from contextlib import suppress
from pathlib import Path

_OPEN = os.O_NOFOLLOW | os.O_CLOEXEC
_PART = "part"
"""What is being written. Of two who write at a time, one loses: readers know a file by its digest."""


class OwnFolder:
    """A folder, made if it was not there, open until it is closed.

    Args:
        path: where.
        above: the open folder that `path` is a name in; None: it is a path of its own.

    Raises:
        OSError: it cannot be made, is no folder, or is not this user's alone.
    """

    def __init__(self, path: Path | str, above: int | None = None) -> None:
        if above is None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            os.mkdir(path, 0o700, dir_fd=above)
        self._fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | _OPEN, dir_fd=above)
        found = os.fstat(self._fd)
        if found.st_uid != os.geteuid() or found.st_mode & 0o077:
            self.close()
            raise PermissionError(f"{path} is not a folder of yours alone")

    def folder(self, name: str) -> OwnFolder:
        """Return one in it, made if it was not there. Raises as `OwnFolder`."""
        return OwnFolder(name, self._fd)

    def found(self) -> dict[str, os.stat_result]:
        """Return what is in it by name."""
        found = {}
        with os.scandir(self._fd) as entries:
            for each in entries:
                with suppress(FileNotFoundError):  # somebody else may remove it meanwhile
                    found[each.name] = each.stat(follow_symlinks=False)
        return found

    def touch(self) -> None:
        """Let it be the one that was modified last."""
        os.utime(self._fd)

    def read(self, name: str) -> bytes:
        """Return a file's contents. Raises OSError, also if others may write to it."""
        with os.fdopen(os.open(name, os.O_RDONLY | os.O_NONBLOCK | _OPEN, dir_fd=self._fd), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o022:
                raise PermissionError(f"{name} is not a file that you alone may write to")
            return file.read()

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all. Raises OSError."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | _OPEN
        try:
            with os.fdopen(os.open(_PART, flags, 0o600, dir_fd=self._fd), "wb") as file:
                file.write(data)
            os.replace(_PART, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except OSError:
            self.remove(_PART)
            raise

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with suppress(OSError):
            os.unlink(name, dir_fd=self._fd)

    def remove_folder(self, name: str) -> None:
        """Remove a folder in it, as far as that is possible."""
        shutil.rmtree(name, ignore_errors=True, dir_fd=self._fd)

    def close(self) -> None:
        """Close it; it cannot be used any more."""
        os.close(self._fd)
