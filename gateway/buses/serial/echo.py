"""Our own bytes that come back: of an adapter whose receiver stays on while it sends, on one wire.

Rules. An echo comes first, in order, and as long as what was sent; it is left out of what is received. One
that differs is a collision: somebody else has sent at the same time. Where it is not known whether there is
an echo ("auto"), nothing is left out until `SURE` sendings in a row came back and were followed by more, or
`ALONE` different ones came back with nothing behind: some devices answer with what they were sent, but not
each time. Time is an argument; what was sent is forgotten when it can no longer come back.
"""

from __future__ import annotations

from typing import Literal

from protocols.line import BITS
from protocols.messages import MILLISECOND, SECOND, Nanos

SURE = 3
"""Sendings in a row that came back, each followed by an answer;"""
ALONE = 8
"""or different ones in a row that came back, and nothing else ever did."""
WRONG = 8
"""Sendings in a row that did not come back, after which there is no echo any more."""
WAIT: Nanos = 20 * MILLISECOND
"""Beside the time on the wire and in the port: what came no sooner does not come."""
MOST = 8192
"""Bytes under way."""

FOUND = (
    "its adapter echoes: what is sent comes back {how}; it is left out from now on, and by {setting} from "
    "the first byte on"
)
COLLIDED = (
    "what comes back of what is sent differs from it: two send at the same time. Likely causes: an id twice "
    "on the line, another program or host on it, answers that come later than latency_ms allows"
)
GONE = "its adapter echoes no more; what comes is taken as it is"
ABSENT = (
    'echo = "yes", but nothing comes back of what is sent: is the adapter switched otherwise, or cut off?'
)


class Echo:
    """Leaves out what comes back. Pure: no port, no clock.

    Args:
        kind: "yes", "no", or "auto": to be found out.
        bus: its name, for what is noted.
        rate: bit/s.
        latency: of the port, both ways.
    """

    def __init__(self, kind: Literal["auto", "yes", "no"], bus: str, rate: int, latency: Nanos) -> None:
        self.on = kind == "yes"
        """Whether what comes back is left out."""
        self.collisions = 0
        """Sendings that came back otherwise."""
        self.stripped = 0
        """Bytes left out."""
        self._kind, self._bus, self._rate, self._latency = kind, bus, rate, latency
        self._expected = b""
        """What has been sent, and can still come back."""
        self._until: Nanos = 0
        """When it no longer can."""
        self._came = b""
        """Where it is not known: what has come since it was sent."""
        self._differs = False
        """This sending has come back otherwise."""
        self._sure = self._wrong = 0
        self._alone: set[bytes] = set()
        self._told: set[str] = set()
        self._notes: list[str] = []

    def take_notes(self) -> list[str]:
        """Return what a person is to be told, each once."""
        notes, self._notes = self._notes, []
        return notes

    def sent(self, now: Nanos, data: bytes) -> None:
        """Take what is sent now."""
        if self._kind == "no" or not data:
            return
        if not self.on and self._came:
            self._judge()
        elif now > self._until:
            self._forget()
        if len(self._expected) + len(data) > MOST:
            self._forget()
        self._expected += data
        took = len(data) * BITS * SECOND // self._rate
        self._until = max(now, self._until - self._latency - WAIT) + took + self._latency + WAIT
        self._differs = False

    def strip(self, now: Nanos, data: bytes) -> bytes:
        """Return what has come without what has come back."""
        if not self._expected:
            return data
        if now > self._until:
            self._forget()
            return data
        if not self.on:
            self._came = (self._came + data)[: len(self._expected) + 1]
            return data
        size = min(len(self._expected), len(data))
        head, self._expected = self._expected[:size], self._expected[size:]
        self.stripped += size
        if data[:size] != head and not self._differs:
            self._differs = True
            self.collisions += 1
            self._missed(COLLIDED)
        elif not self._expected and not self._differs:
            self._wrong = 0
        return data[size:]

    def _judge(self) -> None:
        """Take what has come since something was sent for or against an echo."""
        came, sent = self._came, self._expected
        if len(came) < len(sent) and sent.startswith(came):
            return  # more is under way
        self._expected, self._came = b"", b""
        if not came.startswith(sent):
            self._sure = 0
            self._alone.clear()
        elif len(came) > len(sent):
            self._sure += 1
            self._alone.clear()
        else:
            self._alone.add(sent)
        if self._sure >= SURE or len(self._alone) >= ALONE:
            alone = "and nothing else: no device answers, or RX is on TX"
            how = "before the answer" if self._sure >= SURE else alone
            self.on, self._wrong = True, 0
            self._note(FOUND.format(how=how, setting=f'echo = "yes" under [buses.{self._bus}]'))

    def _forget(self) -> None:
        """What has not come back does not come any more."""
        if self.on and self._expected and not self._differs:
            self._missed("")
        self._expected, self._came = b"", b""

    def _missed(self, text: str) -> None:
        self._wrong += 1
        if self._wrong < WRONG:
            if text:
                self._note(text)
        elif self._kind == "auto":
            self.on, self._wrong, self._sure, self._expected = False, 0, 0, b""
            self._alone.clear()
            self._note(GONE)
        else:
            self._note(text or ABSENT)

    def _note(self, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self._notes.append(text)
