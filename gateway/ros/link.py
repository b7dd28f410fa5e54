"""The pipe between the loop and the process that speaks with the graph: messages, and no end that waits.

Rules. Both ends use `Link`. A message is a list, packed by msgpack; the first says what there is (`Setup`).
What the other end does not read waits, up to a bound; then new samples are dropped and counted, answers are
kept.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgpack

MOST_WAITING = 4 << 20
"""Bytes"""
MOST_MESSAGE = 8 << 20
CHUNK = 1 << 18


@dataclass(frozen=True, slots=True)
class Setup:
    """What there is."""

    address: str
    domain: int
    node: str
    namespace: str
    rows: Sequence[Sequence[Any]]
    """Kind, name, type, hash; whether reliable, whether kept; depth"""


def dds_type(type_: str) -> str:
    """Return the name of a type in DDS."""
    package, folder, name = type_.split("/")
    return f"{package}::{folder}::dds_::{name}_"


class Link:
    """One end."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._out = bytearray()
        self._in = msgpack.Unpacker(max_buffer_size=MOST_MESSAGE, raw=False)
        self.dropped = 0
        """Samples for which there was no room."""
        self.closed = False
        """Whether the other end is gone."""

    def fileno(self) -> int:
        """Return the file to wait for."""
        return self._socket.fileno()

    @property
    def waiting(self) -> bool:
        """Whether something is still to be sent."""
        return bool(self._out)

    def send(self, *message: Any, may_drop: bool = False) -> None:  # noqa: ANN401 -- plain data
        """Send a message, or drop it if it may be dropped and too much is waiting."""
        if may_drop and len(self._out) > MOST_WAITING:
            self.dropped += 1
            return
        self._out += msgpack.packb(message, use_bin_type=True)
        self.flush()

    def flush(self) -> None:
        """Send what is waiting, as far as there is room."""
        while self._out and not self.closed:
            try:
                sent = self._socket.send(memoryview(self._out)[:CHUNK])
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                self.closed = True
                return
            del self._out[:sent]

    def receive(self) -> list[list[Any]]:
        """Return the messages that have come."""
        for _ in range(16):
            try:
                data = self._socket.recv(CHUNK)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:
                data = b""
            if not data:
                self.closed = True
                break
            self._in.feed(data)
        return list(self._in)

    def close(self) -> None:
        """Close this end."""
        self.closed = True
        self._socket.close()
