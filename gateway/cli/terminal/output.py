"""Output that never waits for who reads it: neither for a stopped terminal, nor for a pipe that nobody reads.

Rules. A thread writes; the program only queues. What does not fit into the queue is left out, counted, and
told at the end, which waits for the reader for a bounded time. A thread, because no other way holds for every
kind of file: a terminal that takes some bytes may wait with the next, and a file can be told not to wait only
together with all programs that share it, the shell among them. It touches nothing but its queue and the file.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from gateway.errors import UserError

ROOM = 1 << 18
"""Characters that may wait: as much as is printed in minutes."""
PATIENCE = 2.0
"""s for which the end waits for the reader of what is left,"""
TOLD = 0.1
"""and then until it is told how much was left out"""


class Unblocked:
    """A text stream that is written by a thread of its own."""

    def __init__(self, stream: TextIO, room: int = ROOM) -> None:
        self.left_out = 0
        """Characters that nobody will read."""
        self._stream, self._room = stream, room
        self._error: OSError | None = None
        """Of the reader that has gone."""
        self._queue: deque[str] = deque()
        self._waiting = 0
        """Characters that are queued, or being written."""
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="output", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether all that was written has been taken."""
        return not self._waiting

    def write(self, text: str) -> int:
        """Queue a text, or leave it out. Raises the OSError of a reader that has gone."""
        with self._changed:
            self.flush()
            if self._waiting + len(text) > self._room:
                self.left_out += len(text)
            else:
                self._queue.append(text)
                self._waiting += len(text)
                self._changed.notify_all()
        return len(text)

    def flush(self) -> None:
        """Raise the OSError of a reader that has gone. Waits for nothing."""
        if self._error is not None:
            raise self._error

    def close(self, patience: float) -> None:
        """Wait for the reader for so many seconds at most; what is left then is left out."""
        with self._changed:
            self._changed.wait_for(lambda: self.idle or self._error is not None, patience)
            self.left_out += self._waiting
            self._closing = True
            self._changed.notify_all()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 -- all else is the stream's
        return getattr(self._stream, name)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closing)
                if self._closing:
                    return
                text = self._queue.popleft()
            error = self._put(text)
            with self._changed:
                self._waiting -= len(text)
                self._error = error
                self._changed.notify_all()
            if error is not None:
                return

    def _put(self, text: str) -> OSError | None:
        """Write a text, past the stream's buffer, which the end of the program must find empty."""
        stream = self._stream
        try:
            try:
                file = stream.fileno()
            except (AttributeError, OSError, ValueError):  # it is no file
                stream.write(text)
                return None
            data = memoryview(text.encode(stream.encoding or "utf-8", stream.errors or "replace"))
            while data:
                data = data[os.write(file, data) :]
        except OSError as error:
            return error
        return None


@contextmanager
def unblocked(*streams: TextIO) -> Iterator[list[Unblocked]]:
    """While inside, write to these by threads; at the end, wait for their readers for a bounded time."""
    made = [Unblocked(stream) for stream in streams]
    try:
        yield made
    finally:
        for one in made:
            one.close(PATIENCE)
        if left_out := sum(one.left_out for one in made):
            last = Unblocked(streams[-1])
            with suppress(OSError):
                last.write(f"{left_out} characters of the output were left out: nobody read them\n")
            last.close(TOLD)


def typed(prompt: str) -> str:
    """Return the line that a person types after a prompt, which follows what was printed before. Raises
    UserError if none can come any more."""
    print(prompt, end="", flush=True)
    line = sys.stdin.readline()
    if not line:
        raise UserError("the input has ended, and nothing was done")
    return line.strip()
