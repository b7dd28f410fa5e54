"""Fetching a file of the catalogue: what was cut off goes on where it ended, and only the right one counts.

Rules. What comes is kept in NAME.part. Only with the size and the sha256 of its entry does it get its name,
and never in the place of a file that is there. No more is taken than the entry says that there is.
"""

from __future__ import annotations

import errno
import http.client
import os
import re
import shutil
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from gateway.errors import UserError
from gateway.recording.catalogue import BLOCK, CatalogueEntry, check_file
from gateway.recording.new_file import publish

TIMEOUT = 30.0
"""s without a byte, after which a connection counts as lost"""
ATTEMPTS = 5
"""Connections in a row that may bring nothing"""
PART = ".part"


class LostConnection(Exception):
    """It ended before everything had come, with the reason."""


def fetch(
    entry: CatalogueEntry, folder: Path, shown: Callable[[int], None] = lambda _bytes: None
) -> tuple[Path, bool]:
    """Fetch a file into a folder, or what of it is missing there.

    Args:
        entry: of the catalogue.
        folder: of the recordings; the file's own folder is made in it.
        shown: called with the bytes that are there.

    Returns:
        tuple: its path, and whether anything was fetched: False if it was there.

    Raises:
        UserError: it cannot be fetched, or is not what the catalogue says; what to do.
    """
    path = folder / entry.file
    try:
        if os.path.lexists(path):
            check_file(path, entry)
            return path, False
        if not entry.address:
            text = f"no file of a repository that could be fetched: {entry.source}"
            raise UserError(f"{entry.file}: {text}")
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(path.name + PART)
        _complete(entry, part, shown)
        try:
            check_file(part, entry)
        except UserError as error:
            part.unlink()
            raise UserError(
                f"{entry.address}: what came is another file: {error}; it was not kept"
            ) from error
        publish(part, path)
    except OSError as error:
        raise UserError(f"{error.filename or path}: {error.strerror or error}") from error
    return path, True


def _complete(entry: CatalogueEntry, part: Path, shown: Callable[[int], None]) -> None:
    """Take what is missing in a part, by as many connections as it takes."""
    descriptor = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    with os.fdopen(descriptor, "r+b") as file:
        have = file.seek(0, os.SEEK_END)
        if have > entry.bytes:
            have = file.truncate(0)
        if (room := shutil.disk_usage(part.parent).free) < entry.bytes - have:
            raise UserError(f"{part.parent}: {entry.file} needs {entry.bytes - have} bytes, {room} are free")
        idle = 0
        while have < entry.bytes:
            before = have
            try:
                _take(entry, file, have, shown)
            except LostConnection as error:
                reason = str(error)
            else:
                reason = "the connection ended"
            file.flush()
            have = file.seek(0, os.SEEK_END)
            idle = 0 if have > before else idle + 1
            if idle >= ATTEMPTS:
                kept = f"; {have} of {entry.bytes} bytes are kept in {part}: ask again" if have else ""
                raise UserError(f"{entry.address}: {reason}{kept}")


def _take(entry: CatalogueEntry, file: BinaryIO, have: int, shown: Callable[[int], None]) -> None:
    """Take what one connection brings. Raises LostConnection, OSError of the file, and UserError for good."""
    request = urllib.request.Request(entry.address, headers={"Accept-Encoding": "identity"})  # noqa: S310
    if have:
        request.add_header("Range", f"bytes={have}-")
    with _opened(request, entry) as answer:
        at = _begins_at(answer, have)
        file.seek(at)
        file.truncate()
        while at < entry.bytes:
            try:
                block = answer.read1(min(BLOCK, entry.bytes - at))
            except (OSError, http.client.HTTPException) as error:
                raise LostConnection(_reason(error)) from error
            if not block:
                return
            try:
                file.write(block)
            except OSError as error:
                full = error.errno in (errno.ENOSPC, errno.EDQUOT)
                raise UserError(f"{file.name}: {'no room is left' if full else error.strerror}") from error
            at += len(block)
            shown(at)


def _opened(request: urllib.request.Request, entry: CatalogueEntry) -> http.client.HTTPResponse:
    """Return the answer. Raises LostConnection where it may be asked again, else UserError."""
    try:
        answer: http.client.HTTPResponse = urllib.request.urlopen(request, timeout=TIMEOUT)  # noqa: S310
    except urllib.error.HTTPError as error:
        with error:
            if error.code in (http.client.TOO_MANY_REQUESTS, *range(500, 600)):
                raise LostConnection(f"the server answers {error.code} {error.reason}") from error
            raise UserError(f"{entry.address}: the server answers {error.code} {error.reason}") from error
    except (OSError, http.client.HTTPException) as error:
        raise LostConnection(_reason(error)) from error
    return answer


def _begins_at(answer: http.client.HTTPResponse, have: int) -> int:
    """Return with which byte an answer begins: one without a range begins anew."""
    found = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    if answer.status == http.client.PARTIAL_CONTENT and found and int(found[1]) <= have:
        return int(found[1])
    if answer.status == http.client.OK:
        return 0
    raise LostConnection(f"the server answers {answer.status}, which was not asked for")


def _reason(error: Exception) -> str:
    """Return why nothing comes, in words."""
    inner = getattr(error, "reason", error)
    if isinstance(inner, TimeoutError):
        return f"no byte for {TIMEOUT:g} s"
    if isinstance(inner, OSError):
        return f"no connection: {inner.strerror or inner}"
    return str(inner) or type(inner).__name__
