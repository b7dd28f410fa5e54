"""Bounded transmit queues: what could not be sent at once. Plain data, no I/O of their own."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

from protocols.frames import ID_BITS, CanFrame, Frame, IdMask, id_number
from protocols.messages import MILLISECOND, Nanos
from protocols.plugin import Spec

MOST_WAITING = 256
"""CAN frames that may wait; beyond that the oldest is dropped."""
TURN = 8
"""CAN frames of one device that are sent before it is the next one's turn."""
PATIENCE = 20 * MILLISECOND
"""Longest time that a transmit queue may hold our frames before it is given no more."""

STALE = 100 * MILLISECOND
"""Time without progress after which what a serial port holds of ours is old, and is purged."""

Owner: TypeAlias = int | IdMask
"""Whose turn it is to send: a device, by its place among those of the bus, or ids of several or of none."""
Kind: TypeAlias = CanFrame | tuple[IdMask, bool]
"""What frames have in common that replace each other: all, or ids, and whether they are remote."""


class FrameQueue:
    """CAN frames that wait to be sent.

    Rules. Frames that are given together never replace each other. Those given later replace what waits of
    the same ids, so that no stale command is sent after a newer one was given; the devices' specs declare
    which ids are the same, since some carry data (a torque). What is read-only replaces nothing but itself.
    The frames of a device keep their order. Devices take turns, whatever replaces their frames, so that none
    is starved where a bus is given too much for long."""

    def __init__(self, devices: Iterable[Spec] = ()) -> None:
        self.dropped = 0
        """Frames never sent: replaced by newer ones, too many, or the bus died."""
        self._waiting: dict[Owner, list[tuple[Kind, CanFrame]]] = {}
        """In the order of their turns: the first that has frames is the next."""
        self._sent = 0
        """Frames that it has sent in its turn."""
        ids: dict[int, dict[int, tuple[Owner, Spec]]] = {}
        for device, spec in enumerate(devices):
            for number, mask in spec.sends:
                alike = ids.setdefault(mask, {})
                other, _ = alike.get(number & mask, (device, spec))
                alike[number & mask] = device if other == device else (number & mask, mask), spec
        self._ids = sorted(ids.items(), key=lambda each: -each[0].bit_count())
        """By mask, the narrowest first, and by number: whose ids they are, and what they are."""

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def give(self, frames: Sequence[Frame], send: Callable[[CanFrame], bool], *, wait: bool = False) -> None:
        """Send frames, in order, until `send` returns False: that one and the rest wait.

        All of them wait if something does already, or with `wait`."""
        given = [frame for frame in frames if isinstance(frame, CanFrame)]
        assert len(given) == len(frames), "a CAN bus carries CAN frames"
        sent = 0
        if not (wait or len(self)):
            while sent < len(given) and send(given[sent]):
                sent += 1
        self._put(given[sent:])

    def drain(self, send: Callable[[CanFrame], bool]) -> None:
        """Send what waits until `send` returns False: that frame remains the first.

        `send` may clear this queue."""
        while (owner := self._next()) is not None:
            frames = self._waiting[owner]
            first = frames.pop(0)
            if not send(first[1]):
                frames.insert(0, first)
                return
            self._sent += 1
            if self._waiting and (not frames or self._sent >= TURN):
                self._sent = 0
                self._waiting[owner] = self._waiting.pop(owner)

    def clear(self) -> None:
        """Drop everything."""
        self.dropped += len(self)
        self._waiting.clear()
        self._sent = 0

    def _put(self, frames: Sequence[CanFrame]) -> None:
        given = [(*self._place(frame), frame) for frame in frames]
        replaced, before = {kind for _, kind, _ in given}, len(self)
        for waiting in self._waiting.values():
            waiting[:] = [each for each in waiting if each[0] not in replaced]
        self.dropped += before - len(self)
        for owner, kind, frame in given:
            self._waiting.setdefault(owner, []).append((kind, frame))
        while len(self) > MOST_WAITING and (first := self._next()) is not None:
            del self._waiting[first][0]
            self.dropped += 1

    def _next(self) -> Owner | None:
        """Return whose turn it is, None if nothing waits."""
        return next((owner for owner, frames in self._waiting.items() if frames), None)

    def _place(self, frame: CanFrame) -> tuple[Owner, Kind]:
        """Return in whose turn a frame is sent, and its kind. One kind has one owner."""
        number = id_number(frame)
        for mask, alike in self._ids:
            if number & mask in alike:
                owner, spec = alike[number & mask]
                return owner, frame if spec.read_only(frame) else ((number & mask, mask), frame.remote)
        return (number, ID_BITS), ((number, ID_BITS), frame.remote)


class Patience:
    """Whether a transmit queue has held our frames for too long. Plain data."""

    def __init__(self) -> None:
        self._empty_at: Nanos = 0
        """When it last held none."""

    def is_over(self, now: Nanos, *, holds: bool) -> bool:
        """True if it `holds` frames of ours, and has held some for longer than `PATIENCE`."""
        if not holds:
            self._empty_at = now
        return now - self._empty_at > PATIENCE


class Stall:
    """Whether a port that bytes wait for takes none any more. Plain data."""

    def __init__(self) -> None:
        self._taken = 0
        """Bytes that had left this machine when it was last seen to go on,"""
        self._at: Nanos = 0
        """and when that was."""

    def is_stalled(self, now: Nanos, taken: int, *, waiting: bool) -> bool:
        """True if bytes have waited for `STALE`, and none of them was taken. Then it is measured anew."""
        going = taken != self._taken or not waiting
        if going or now - self._at > STALE:
            self._taken, self._at = taken, now
            return not going
        return False


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

    def __len__(self) -> int:
        return len(self._messages)

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
