"""Frames of a log of CAN by another program: candump's .log, .asc, .blf, .trc and .csv, also .gz.

Rules. A log is read as a stream, in its own order; a stamp that goes back counts as the one before. What can
be read before a mistake in the file is given, and then the mistake is told.
"""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import can

from gateway.errors import UserError
from protocols.frames import CanFrame, Packet
from protocols.messages import SECOND, Nanos

READERS: dict[str, Callable[[Any], Iterable[can.Message]]] = {
    ".asc": can.ASCReader,
    ".blf": can.BLFReader,
    ".csv": can.CSVReader,
    ".log": can.CanutilsLogReader,
    ".trc": can.TRCReader,
}
"""Kinds of log, by the name's end, that python-can 4.6 reads without more packages."""
NO_CHANNEL = "can0"
"""The bus of a log that names none."""


@dataclass(slots=True)
class LogSummary:
    """What a log has, found by reading it once."""

    fd: dict[str, bool]
    """By bus, in the order in which they appear: whether frames of CAN FD are on it."""
    began: Nanos = 0
    """The stamp of the first frame."""
    error: str = ""
    """Why nothing more could be read."""


def is_log(path: Path) -> bool:
    """True if the name is one of a log of CAN."""
    return _kind(path) in READERS


def _kind(path: Path) -> str:
    return path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix


def _opened(path: Path) -> IO[Any]:
    """Open a log, as bytes where it is binary."""
    if path.suffix == ".gz":
        raw: IO[bytes] = cast("IO[bytes]", gzip.open(path))  # noqa: SIM115 -- its caller closes it
    else:
        raw = path.open("rb")
    return raw if _kind(path) == ".blf" else io.TextIOWrapper(raw, "utf-8", "replace")


def summary(path: Path) -> LogSummary:
    """Read a log once. Raises UserError if it has no frame that can be read."""
    found = LogSummary({})
    try:
        for packet, _ in logged(path):
            found.began = packet.t if not found.fd else found.began
            found.fd[packet.bus] = found.fd.get(packet.bus, False) or (
                isinstance(packet.frame, CanFrame) and packet.frame.fd
            )
    except UserError as error:
        found.error = str(error)
    if not found.fd:
        raise UserError(found.error or f"{path}: it holds no frame; is it a log of {', '.join(READERS)}?")
    return found


def logged(path: Path) -> Iterator[tuple[Packet, bool]]:
    """Yield the frames of a log, each with whether its writer had sent it. Raises UserError at a mistake."""
    last: Nanos = 0
    count = 0
    try:
        with _opened(path) as file:
            for message in READERS[_kind(path)](file):
                if message.is_error_frame:
                    continue
                last = max(last, round(message.timestamp * SECOND))
                frame = CanFrame(
                    message.arbitration_id,
                    bytes(message.data),
                    extended=message.is_extended_id,
                    remote=message.is_remote_frame,
                    fd=message.is_fd,
                    brs=message.bitrate_switch,
                    requested=message.dlc if message.is_remote_frame else 0,
                )
                channel = NO_CHANNEL if message.channel is None else str(message.channel)
                yield Packet(last, channel, frame), not message.is_rx
                count += 1
    except GeneratorExit:
        raise
    except OSError as error:
        if count or error.strerror is None:  # the second: by gzip, of what is in it
            raise UserError(f"{path}: after {count} frames it cannot be read: {error}") from error
        raise UserError(f"{path}: {error.strerror}: expected a log of CAN") from error
    except Exception as error:  # a reader of python-can may raise anything at a file that is none
        raise UserError(f"{path}: after {count} frames it cannot be read: {error!r}") from error
