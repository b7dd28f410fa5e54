"""Bounded transmit queues: what could not be sent at once. Plain data, no I/O of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from protocols.frames import CanFrame

MOST_WAITING = 256
"""CAN frames that may wait; beyond that the oldest is dropped."""


class FrameQueue:
    """CAN frames that wait to be sent, oldest first. A newer frame replaces an older one of the same id and
    goes to the end: no stale command is sent after a newer one was given."""

    def __init__(self) -> None:
        self.dropped = 0
        """Frames never sent: replaced by a newer one, too many, or the bus died."""
        self._frames: dict[tuple[int, bool, bool], CanFrame] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: CanFrame) -> None:
        """Append a frame."""
        key = (frame.id, frame.extended, frame.remote)
        self.dropped += self._frames.pop(key, None) is not None
        self._frames[key] = frame
        if len(self._frames) > MOST_WAITING:
            del self._frames[next(iter(self._frames))]
            self.dropped += 1

    def drain(self, send: Callable[[CanFrame], bool]) -> None:
        """Send what waits, oldest first, until `send` returns False: that frame remains the first.

        `send` may clear this queue."""
        while self._frames:
            key, frame = next(iter(self._frames.items()))
            del self._frames[key]
            if not send(frame):
                self._frames = {key: frame, **self._frames}
                return

    def clear(self) -> None:
        """Drop everything."""
        self.dropped += len(self._frames)
        self._frames.clear()


class ByteQueue:
    """Serial messages that wait to be sent. When too much waits the oldest whole ones are dropped; one that
    is partly sent is finished, so that the receiver stays in step."""

    def __init__(self, limit: int) -> None:
        self.dropped = 0
        """Messages never sent completely."""
        self._limit = limit
        """Bytes that may wait."""
        self._messages: deque[bytes] = deque()
        self._partly_sent = False
        """Whether the first message has been sent in part."""

    def put(self, message: bytes) -> None:
        """Append a message; nothing is dropped before `trim`."""
        self._messages.append(message)

    def drain(self, write: Callable[[bytes], int]) -> bool:
        """Write what waits until `write` takes less than it is given; True if all is sent.

        `write` returns how many bytes it took; a message at which it raises OSError is dropped."""
        while self._messages:
            message = self._messages.popleft()
            try:
                taken = write(message) if message else 0
            except BlockingIOError:
                taken = 0
            except OSError:
                self.dropped += 1
                raise
            if taken < len(message):
                self._messages.appendleft(message[taken:])
                self._partly_sent = self._partly_sent or taken > 0
                return False
            self._partly_sent = False
        return True

    def trim(self) -> bool:
        """Drop the oldest whole messages while too much waits; True if any was dropped."""
        dropped = self.dropped
        while len(self._messages) > 1 + self._partly_sent and sum(map(len, self._messages)) > self._limit:
            del self._messages[int(self._partly_sent)]
            self.dropped += 1
        return self.dropped > dropped

    def clear(self) -> None:
        """Drop everything."""
        self.dropped += len(self._messages)
        self._messages.clear()
        self._partly_sent = False
