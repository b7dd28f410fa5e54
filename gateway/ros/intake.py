"""What comes from the graph on its way to the loop: how much of it goes on, whatever is sent.

Rules. A stream (a row that is not reliable) is thinned: its newest sample from each writer goes on, at most
every `THINNED`; what others send faster is counted. Everything else goes on in order, as far as `Share` has
room in that time; a small request always has, since it may be a stop. What takes long to be read is read
here, if it is not too large (`READERS`): a step gets what it needs of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.ros import trajectory, types
from gateway.ros.graph import FOLLOW, LARGEST, TRAJECTORY
from gateway.ros.link import Link
from protocols.messages import MILLISECOND, Nanos

THINNED: Nanos = 4 * MILLISECOND
REQUESTS = 50
"""Of each row's samples and requests that are not thinned, those that go on in `THINNED`;"""
IN_ALL, BYTES = 200, 1 << 16
"""of all rows', and their bytes;"""
ALWAYS, SMALL = 4, 2048
"""and of each row's, those that always do, if they have no more bytes than that."""


READ_HERE = {TRAJECTORY: TRAJECTORY, f"{FOLLOW}_SendGoal": f"{FOLLOW}_SendGoal_Request"}
"""By the type of a row, that of what comes"""


def readers(kinds: Sequence[str]) -> dict[int, str]:
    """Return, by number of the rows of these types, the type of what is read here, and prepare for it."""
    found = {row: READ_HERE[kind] for row, kind in enumerate(kinds) if kind in READ_HERE}
    types.prepare(found.values())
    return found


@dataclass(slots=True)
class Share:
    """What goes on in one time of `THINNED`. One that is larger than what there is left of the bytes goes on,
    and the next times have fewer."""

    of_rows: dict[int, int] = field(default_factory=dict)
    count: int = 0
    left: int = BYTES

    def take(self, row: int, size: int) -> bool:
        """Return whether a message of this row, and of so many bytes, goes on."""
        of_row = self.of_rows.get(row, 0)
        small = of_row < ALWAYS and size <= SMALL
        if not small and (of_row >= REQUESTS or self.count >= IN_ALL or self.left <= 0):
            return False
        self.of_rows[row], self.count, self.left = of_row + 1, self.count + 1, self.left - size
        return True

    def begin(self) -> None:
        """Begin another time."""
        self.of_rows.clear()
        self.count, self.left = 0, min(BYTES, self.left + BYTES)


@dataclass(slots=True)
class _Stream:
    """The newest of a writer's samples."""

    payload: bytes
    count: int = 1


@dataclass(slots=True)
class Intake:
    """Between a transport and the loop's pipe."""

    link: Link
    readers: Mapping[int, str] = field(default_factory=dict)
    """By row, the type of what is read here"""
    _share: Share = field(default_factory=Share)
    _streams: dict[tuple[int, bytes], _Stream] = field(default_factory=dict)
    _passed: Nanos = 0

    def stream(self, row: int, payload: bytes, writer: bytes) -> None:
        """Take a sample that a newer one replaces."""
        known = self._streams.get((row, writer))
        if known is not None:
            known.payload, known.count = payload, known.count + 1
        elif len(self._streams) < REQUESTS:
            self._streams[row, writer] = _Stream(payload)

    def sample(self, row: int, payload: bytes, writer: bytes) -> None:
        """Take a sample of which each counts."""
        if self._share.take(row, len(payload)):
            self.link.send("sample", row, self._read(row, payload), writer, 1, may_drop=True)

    def request(self, row: int, payload: bytes, token: Sequence[Any]) -> bool:
        """Take a request, to be answered with the token; return whether it goes on."""
        if goes := self._share.take(row, len(payload)):
            self.link.send("request", row, self._read(row, payload), token, may_drop=True)
        return goes

    def _read(self, row: int, payload: bytes) -> bytes:
        type_ = self.readers.get(row)
        return payload if type_ is None or len(payload) > LARGEST else trajectory.packed(type_, payload)

    def turn(self, now: Nanos) -> None:
        """Let the streams go on, when it is time."""
        if now - self._passed >= THINNED:
            self._passed = now
            for (row, writer), stream in self._streams.items():
                self.link.send("sample", row, stream.payload, writer, stream.count, may_drop=True)
            self._streams.clear()
            self._share.begin()
