"""What a CAN bus tells of itself, and what waits to go out on one. Values and two small objects, no I/O.

Rules. One change is told once, in words of `BusState`. A line that is OFF or GONE hides everything else; a
jammed queue hides whether the line is up or error-passive. BACK is told when OFF or GONE ends, and then what
else there is to tell. A jam has ended when nothing had to wait for a while, so that a queue that is a little
too short for each tick's frames is told once and not at every tick.
"""

from __future__ import annotations

from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, Nanos

CALM = 500 * MILLISECOND
"""A jam is over when nothing has had to wait for so long."""
MOST_WAITING = 256
"""Frames that may wait to go out; beyond that the oldest is dropped."""
DEAD = (BusState.OFF, BusState.GONE)


class States:
    """The state of the line (up, passive, off, gone), a jam, and what has not been told of them yet."""

    def __init__(self) -> None:
        self.line = BusState.UP
        self._full_until: Nanos | None = None
        self._shown = BusState.UP
        self._reported: list[BusState] = []

    @property
    def dead(self) -> bool:
        """Whether nothing goes out."""
        return self.line in DEAD

    def set(self, line: BusState) -> None:
        """The line is now up, passive, off or gone; BACK is up."""
        self.line = BusState.UP if line is BusState.BACK else line
        if self.dead:
            self._full_until = None
        self._show()

    def full(self, now: Nanos) -> None:
        """Something found no room."""
        if not self.dead:
            self._full_until = now + CALM
            self._show()

    def take(self, now: Nanos) -> list[BusState]:
        """What has changed since last asked, in order."""
        if self._full_until is not None and now >= self._full_until:
            self._full_until = None
            self._show()
        reported, self._reported = self._reported, []
        return reported

    def _show(self) -> None:
        was, jammed = self._shown, self._full_until is not None
        self._shown = BusState.FULL if jammed and not self.dead else self.line
        if self._shown is was:
            return
        if was in DEAD and not self.dead:
            self._reported.append(BusState.BACK)
            if self._shown is BusState.UP:
                return
        self._reported.append(self._shown)


class Outbox:
    """Frames that wait for room, oldest first. A newer frame replaces an older one of the same id, and
    goes to the end: no stale command goes out after a newer one was given."""

    def __init__(self) -> None:
        self.dropped = 0
        """Frames that never went out: a newer one came, there were too many, or the line died."""
        self._frames: dict[tuple[int, bool, bool], CanFrame] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: CanFrame) -> None:
        """Let a frame wait."""
        key = (frame.id, frame.extended, frame.remote)
        self.dropped += self._frames.pop(key, None) is not None
        self._frames[key] = frame
        if len(self._frames) > MOST_WAITING:
            self.take()
            self.dropped += 1

    def take(self) -> CanFrame:
        """The one that has waited longest, which waits no more."""
        return self._frames.pop(next(iter(self._frames)))

    def put_back(self, frame: CanFrame) -> None:
        """What was taken has found no room: it is the first again."""
        self._frames = {(frame.id, frame.extended, frame.remote): frame, **self._frames}

    def clear(self) -> None:
        """Throw away what waits."""
        self.dropped += len(self._frames)
        self._frames.clear()
