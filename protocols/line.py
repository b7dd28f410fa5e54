"""A serial line on which devices speak only when asked: what its drivers want to exchange, one at a time.

Rules. A driver gives an `Exchange` in place of a frame. The line hands over any number of frames that nobody
answers, and behind them one that is answered; nothing more until that answer has come, or is overdue. What
disarms goes first. The rest goes in rounds: all that waited when a round began, set-points first, of the
background one; so none starves, and a set-point waits for one round at most. Of what waits about one thing
only the newest is kept, in its place. A set-point that its driver does not give again is taken back: nothing
arms a device later. What answers goes to who asked, with what was asked. Who has been silent is asked less
often. No clock, no bus: plain data, in virtual time as on a port.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from protocols.messages import MILLISECOND, SECOND, Nanos, value

BITS = 10
"""Bits per byte: start, 8 of data, no parity, stop."""
CAPACITY = 64
"""Questions of one driver that may wait."""
SILENT = 3
"""Answers in a row that are lost before a question is asked less often;"""
LONGEST_BACKOFF: Nanos = 250 * MILLISECOND
"""the longest pause between two of them."""


class Rank(IntEnum):
    """What goes first."""

    RELEASE = 0
    """It disarms: it goes before everything, and waits until it is sent."""
    SET_POINT = 1
    """A level: sent in the step in which it is given, or as soon as the line is free if the next step gives
    it too. Also what arms."""
    QUESTION = 2
    """What is asked in every cycle; and requests. It waits until it is sent."""
    BACKGROUND = 3
    """What is asked now and then: one in each round at most."""


@value
class Answer:
    """What is expected to come back."""

    size: int
    """Bytes, at most (with all that may be stuffed)."""
    find: Callable[[bytes, bytes], tuple[int, int] | None]
    """From the question, and what has come since then: where its answer begins and ends; None: it is not
    there yet. It checks whatever there is to check, a checksum over both too. A function of a module or a
    frozen dataclass with `__call__`, so that it can be copied."""
    delay: Nanos = 0
    """The longest time that the device (or all of them together) wait before they answer."""


class Exchange(bytes):
    """A frame to a device on a serial line, and what comes back.

    Args:
        frame: the bytes.
        answer: what comes back; None: nothing answers.
        rank: what it goes before.
        about: of those that wait about the same, only the newest is sent; "": each is.
        tries: how often it is sent at most, if no answer comes.
    """

    answer: Answer | None
    rank: Rank
    about: str
    tries: int

    def __new__(
        cls,
        frame: bytes,
        answer: Answer | None = None,
        rank: Rank = Rank.QUESTION,
        about: str = "",
        tries: int = 1,
    ) -> Exchange:
        """Make one."""
        made = super().__new__(cls, frame)
        made.answer, made.rank, made.about, made.tries = answer, rank, about, tries
        return made

    def same_as(self, other: Exchange) -> bool:
        """True if it has the same bytes, about the same."""
        return self == other and (self.rank, self.about) == (other.rank, other.about)


def exchange(frame: bytes) -> Exchange:
    """Return a frame as an exchange: without more, it is a set-point that nobody answers."""
    return frame if isinstance(frame, Exchange) else Exchange(frame, None, Rank.SET_POINT)


@dataclass(slots=True)
class Waiting:
    """An exchange that waits, or is under way."""

    owner: int
    exchange: Exchange
    left: int
    """How often it may still be sent."""
    round: int

    @property
    def subject(self) -> tuple[int, str]:
        """Whose it is, and about what."""
        return self.owner, self.exchange.about


@value
class Ended:
    """An exchange that is over: what has come goes to its driver (with nothing: the answer is lost)."""

    owner: int
    exchange: Exchange
    data: bytes
    complete: bool


@dataclass(slots=True)
class Line:
    """One serial line, shared by all drivers on it. `owner`: the number of a driver."""

    rate: int
    """bit/s"""
    half_duplex: bool = True
    """Both directions share one wire. False: what nobody answers need not wait for an answer to end."""
    slack: Nanos = 300_000
    """What an answer may be late: latency of the port both ways, period of the loop's readings."""
    quiet: Nanos = 100_000
    """Silence that is waited for after bytes that nobody asked for, and after an answer that did not come."""
    gap: Nanos = 0
    """From the end of an answer to the next frame: a device must have released the line."""
    waiting: list[Waiting] = field(default_factory=list)
    out: Waiting | None = None
    """The exchange under way,"""
    overdue: Nanos = 0
    """when its answer is, and"""
    held: bytes = b""
    """what has come of it."""
    free: Nanos = 0
    """When the wire is idle again."""
    round: int = 0
    """What waited when it began is sent in it."""
    background: bool = False
    """In this round, one of the background was sent."""
    last_owner: dict[int, int] = field(default_factory=dict)
    """The driver that was last in turn, by rank."""
    silence: dict[tuple[int, str], tuple[int, Nanos]] = field(default_factory=dict)
    """By subject: answers lost in a row, and before when it is not asked again."""
    sent: int = 0
    answered: int = 0
    lost: int = 0
    full: int = 0
    """Questions dropped, since too many wait."""
    replaced: int = 0
    stray: int = 0
    """Bytes that nobody asked for."""

    def time(self, size: int) -> Nanos:
        """Return the time that this many bytes take."""
        return size * BITS * SECOND // self.rate

    def put(self, owner: int, frames: Sequence[bytes]) -> None:
        """Take what a driver gives in a step. Set-points are levels: those that it gave before, that still
        wait, and that it does not give again are taken back, so that none arms a device later."""
        given = [exchange(frame) for frame in frames]
        places: dict[tuple[Rank, str], Waiting] = {}
        kept: list[Waiting] = []
        for one in self.waiting:
            before, key = one.exchange, (one.exchange.rank, one.exchange.about)
            released = before.rank is Rank.RELEASE and not any(before.same_as(new) for new in given)
            if one.owner != owner or released or (before.rank >= Rank.QUESTION and not before.about):
                kept.append(one)
            elif before.rank >= Rank.QUESTION or (
                before.rank is Rank.SET_POINT and any(key == (new.rank, new.about) for new in given)
            ):
                places[key] = one
                kept.append(one)
            else:
                self.replaced += 1
        self.waiting = kept
        for new in given:
            if self.out is not None and self.out.owner == owner and new.same_as(self.out.exchange):
                continue  # it is under way
            old = places.get((new.rank, new.about)) if new.about and new.rank is not Rank.RELEASE else None
            if old is not None:
                old.exchange, old.left = new, new.tries
                self.replaced += 1
            else:
                self.waiting.append(Waiting(owner, new, new.tries, self.round + 1))
        mine = [one for one in self.waiting if one.owner == owner and one.exchange.rank >= Rank.QUESTION]
        for extra in mine[: max(0, len(mine) - CAPACITY)]:
            self.waiting.remove(extra)
            self.full += 1

    def blocked(self, held_back: Exchange) -> None:
        """Note that the guard has held back what was handed over last: no answer will come."""
        if self.out is not None and self.out.exchange is held_back:
            self.out, self.held = None, b""

    def take(self, now: Nanos) -> list[tuple[int, Exchange]]:
        """Return what is sent now, each with the number of its driver."""
        taken: list[tuple[int, Exchange]] = []
        if now < self.free or (self.out is not None and self.half_duplex):
            return taken
        size = 0
        while (one := self._next(now)) is not None:
            self.waiting.remove(one)
            taken.append((one.owner, one.exchange))
            size += len(one.exchange)
            self.sent += 1
            answer = one.exchange.answer
            if answer is not None:
                one.left -= 1
                self.out, self.held = one, b""
                self.overdue = now + self.time(size + answer.size) + answer.delay + self.slack
                break
        self.free = now + self.time(size)
        return taken

    def _next(self, now: Nanos) -> Waiting | None:
        """Return what is next: what disarms; else of this round the first by rank, drivers in turn."""
        ready = [one for one in self.waiting if self._is_ready(now, one)]
        if not ready:
            return None
        for one in ready:
            if one.exchange.rank is Rank.RELEASE:
                return one
        mine = self._of_this_round(ready)
        if not mine:
            self.round, self.background = self.round + 1, False
            for one in ready:
                one.round = min(one.round, self.round)
            mine = ready
        rank = min(one.exchange.rank for one in mine)
        mine = [one for one in mine if one.exchange.rank is rank]
        last = self.last_owner.get(rank, -1)
        first = min(mine, key=lambda one: (one.owner <= last, one.owner))
        self.last_owner[rank] = first.owner
        self.background |= rank is Rank.BACKGROUND
        return first

    def _is_ready(self, now: Nanos, one: Waiting) -> bool:
        """True unless it must wait for an answer that is under way, or its device has been silent."""
        if one.exchange.answer is None:
            return True
        if self.out is not None:
            return False
        return one.exchange.rank is Rank.RELEASE or self.silence.get(one.subject, (0, now))[1] <= now

    def _of_this_round(self, ready: Sequence[Waiting]) -> list[Waiting]:
        return [
            one
            for one in ready
            if one.round <= self.round and not (self.background and one.exchange.rank is Rank.BACKGROUND)
        ]

    def receive(self, t: Nanos, data: bytes) -> tuple[list[Ended], bytes]:
        """Take bytes that have come; return what they complete, and what nobody asked for."""
        if self.out is None:  # of one that is late: it has the line until it is silent
            self.stray += len(data)
            if data and self.half_duplex:
                self.free = max(self.free, t + self.quiet)
            return [], data
        self.held += data
        asked = self.out.exchange
        found = asked.answer.find(asked, self.held) if asked.answer is not None else None
        if found is None:
            return [], b""
        start, end = found
        held = self.held
        self.stray += len(held) - end + start
        self.answered += 1
        self.silence.pop(self.out.subject, None)
        return [self._end(t, held[start:end], complete=True)], held[:start] + held[end:]

    def _end(self, t: Nanos, data: bytes, *, complete: bool) -> Ended:
        one = self.out
        assert one is not None
        self.out, self.held, self.free = None, b"", max(self.free, t + (self.gap if complete else self.quiet))
        return Ended(one.owner, one.exchange, data, complete)

    def expire(self, now: Nanos) -> list[Ended]:
        """Return the exchange whose answer is overdue, or put it back if it may be tried again."""
        one = self.out
        if one is None or now < self.overdue:
            return []
        self.lost += 1
        lost = min(self.silence.get(one.subject, (0, 0))[0] + 1, 20)
        pause = min((1 << max(lost - SILENT, 0)) * MILLISECOND, LONGEST_BACKOFF) if lost >= SILENT else 0
        self.silence[one.subject] = lost, now + pause
        ended = self._end(now, self.held, complete=False)
        if one.left <= 0 or any(other.subject == one.subject for other in self.waiting if one.exchange.about):
            return [ended]
        one.round = self.round + 1
        self.waiting.append(one)  # behind the others: one that is silent keeps nobody waiting
        return [ended] if ended.data else []

    def drop(self, owner: int | None = None) -> None:
        """Forget what waits, of one driver or (None) of all: the line is lost, or a driver has failed."""
        self.waiting = [one for one in self.waiting if owner is not None and one.owner != owner]
        if self.out is not None and owner in (None, self.out.owner):
            self.out, self.held = None, b""

    def due(self) -> Nanos | None:
        """Return when there is something to hand over, or an answer is overdue."""
        if self.out is not None:
            unanswered = any(one.exchange.answer is None for one in self.waiting)
            return self.free if unanswered and not self.half_duplex else self.overdue
        ready = [self.silence.get(one.subject, (0, 0))[1] for one in self.waiting]
        return max(self.free, min(ready)) if ready else None
