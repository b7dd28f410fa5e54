"""A serial line on which devices speak only when asked: what its drivers want to exchange, one at a time.

Rules. A driver gives an `Exchange` in place of a frame. The line hands over any number of frames that nobody
answers, and behind them one that is answered; nothing more until that answer has come, or is overdue. What
disarms goes first, and waits for no answer that does not come. The rest goes in rounds: all that waited when
a round began, set-points first, of the background one; a round that takes long is left for set-points, and
gone on with behind them. So none starves. Of what waits about one thing only the newest is kept, in its
place. Set-points are levels: those that a driver gives in a step take the place of all that it gave before,
in the order given, so that nothing arms a device later. What answers goes to who asked, with what was asked;
an exchange that is replaced, taken back or blocked ends without a word. Who has been silent is asked less
often. All that is kept is bounded, whatever is given and whatever comes. The line knows of no echo: a port
that receives itself takes that out. No clock, no bus: plain data, in virtual time as on a port.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TypeAlias

from protocols.messages import MILLISECOND, SECOND, Nanos, value

BITS = 10
"""Bits per byte: start, 8 of data, no parity, stop."""
CAPACITY = 256
"""Exchanges of one driver that may wait: those that disarm, set-points, and questions."""
SILENT = 3
"""Answers in a row that are lost before a device is asked less often;"""
LONGEST_BACKOFF: Nanos = 250 * MILLISECOND
"""the longest pause between two of these questions,"""
LONGEST_RELEASE: Nanos = 20 * MILLISECOND
"""and between two of what disarms."""
PATIENCE: Nanos = 20 * MILLISECOND
"""Silence within an answer, or before it, after which it is given up if something that disarms waits."""
ROUND: Nanos = 20 * MILLISECOND
"""Time for the questions of a round before set-points that wait have their turn; more if those of this round
took longer."""

LONGEST_QUIET: Nanos = 2 * MILLISECOND
"""While unrequested bytes go on coming, silence is waited for longer each time, at most so long."""
UNANSWERED = 8
"""Exchanges without an answer that are remembered, since it may come late."""


class Rank(IntEnum):
    """What goes first."""

    RELEASE = 0
    """It disarms: it goes before everything, and waits until it is sent, once for all that have its bytes.
    Where it has not been answered for long, it takes turns with set-points."""
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
    usual: int = 0
    """Bytes, if nothing is wrong and nothing stuffed: it is not looked for before so many can have
    come. 0: it is looked for whenever something comes."""
    alike: str = ""
    """Of answers that do not say what they answer: whose they are. Where one has not come, another question
    with this name is not asked until that one cannot come any more, and a copy answers none."""


class Exchange(bytes):
    """A frame to a device on a serial line, and what comes back.

    Args:
        frame: the bytes.
        answer: what comes back; None: nothing answers.
        rank: what it goes before.
        about: of those of a rank that wait about the same, only the newest is sent, and less often while
            nothing answers it. "": each is; of set-points, each that is given again.
        tries: how often it is sent at most, if no answer comes.
    """

    answer: Answer | None
    rank: Rank
    about: str
    tries: int
    key: Key
    """What two of one driver have in common of which only the newer one is sent; None: each is."""

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
        if rank is Rank.RELEASE:
            made.key = rank, frame
        else:
            made.key = (rank, about or frame) if about or rank is Rank.SET_POINT else None
        return made

    def __deepcopy__(self, memo: object) -> Exchange:
        """It is a constant."""
        return self


def exchange(frame: bytes) -> Exchange:
    """Return a frame as an exchange: without more, it is a set-point without an answer."""
    return frame if isinstance(frame, Exchange) else Exchange(frame, None, Rank.SET_POINT)


@dataclass(slots=True, eq=False)
class Waiting:
    """An exchange that waits, or is under way."""

    owner: int
    exchange: Exchange
    left: int
    """How often it may still be sent."""
    round: int


@value
class Ended:
    """An exchange that is over: what has come goes to its driver (with nothing: the answer is lost)."""

    owner: int
    exchange: Exchange
    data: bytes
    complete: bool


Silence: TypeAlias = tuple[int, Nanos]
"""Answers lost in a row, and when the last was."""
Key: TypeAlias = tuple[Rank, str | bytes] | None
"""As `Exchange.key`"""


@dataclass(slots=True)
class Line:
    """One serial line, shared by all drivers on it. `owner`: the number of a driver."""

    rate: int
    """bit/s"""
    half_duplex: bool = True
    """Both directions share one wire. False: what has no answer need not wait for an answer to end."""
    slack: Nanos = 300_000
    """What an answer may be late: latency of the port both ways, period of the loop's readings."""
    quiet: Nanos = 100_000
    """Silence that is waited for after unrequested bytes, and after an answer that did not come."""
    gap: Nanos = 0
    """From the end of an answer to the next frame: a device must have released the line."""
    waiting: list[Waiting] = field(default_factory=list)
    out: Waiting | None = None
    """The exchange under way,"""
    given: Nanos = 0
    """when it was handed over, and"""
    latest: Nanos = 0
    """when its answer is overdue if it has not begun, and"""
    held: bytes = b""
    """what has come of it."""
    last_byte: Nanos = 0
    """When the last byte of it was sent, or has come."""
    free: Nanos = 0
    """When the wire is idle again."""
    round: int = 0
    """What waited when it began is sent in it."""
    began: Nanos = 0
    """When it began,"""
    asked: Nanos | None = None
    """and when the first question was sent in it."""
    background: bool = False
    """In this round, one of the background was sent."""
    last_owner: dict[Rank, int] = field(default_factory=dict)
    """The driver that was last in turn, by rank."""
    silence: dict[tuple[int, object], Silence] = field(default_factory=dict)
    """By driver and `Exchange.key`."""
    missed: dict[tuple[int, str], tuple[Key, Nanos]] = field(default_factory=dict)
    """By driver and `Answer.alike`: what was not answered, and until when that may come late."""
    last: tuple[Key, bytes, Nanos] = (None, b"", 0)
    """What was answered last, the answer, and when it came."""
    sent: int = 0
    answered: int = 0
    lost: int = 0
    full: int = 0
    """Exchanges dropped, since too many wait."""
    replaced: int = 0
    """Exchanges that were not sent: a newer one took the place, or a set-point was not given again."""
    overtaken: int = 0
    """Steps of drivers in which a set-point of the step before was not sent yet: the line is too slow."""
    stray: int = 0
    """Bytes that were not requested,"""
    pieces: int = 0
    """and since something was sent, in how many pieces."""
    cut: int = 0
    """Of the answers that are lost: those of which something came, or in whose place something else did."""
    late: int = 0
    """Answers that came when they had been given up."""
    unanswered: list[Exchange] = field(default_factory=list)
    """The last that were given up, the newest at the end."""
    searched: tuple[bytes, tuple[int, int] | None] = (b"", None)
    """Where the answer under way was last looked for, and found: it is looked for once."""

    def time(self, size: int) -> Nanos:
        """Return the time that this many bytes take."""
        return size * BITS * SECOND // self.rate

    @property
    def overdue(self) -> Nanos:
        """When the answer under way is. One that has begun is sent to its end, whoever sends in the meantime:
        while it comes it is waited for, once more as long as it may take."""
        if not self.held or self.out is None or self.out.exchange.answer is None:
            return self.latest
        more = self.time(self.out.exchange.answer.size) + self.slack
        return max(self.latest, min(self.last_byte + self.slack, self.latest + more))

    # -- what waits ---------------------------------------------------------------------------

    def put(self, owner: int, frames: Sequence[bytes]) -> None:
        """Take what a driver gives in a step."""
        places = {one.exchange.key: one for one in self.waiting if one.owner == owner}
        places.pop(None, None)
        before = len(self.waiting)
        self.waiting = [
            one for one in self.waiting if one.owner != owner or one.exchange.rank is not Rank.SET_POINT
        ]
        taken_back = before - len(self.waiting)
        self.overtaken += taken_back > 0
        given = _newest([exchange(frame) for frame in frames])
        sent = self.out.exchange if self.out is not None and self.out.owner == owner else None
        for new in given:
            if sent is not None and new.rank is Rank.SET_POINT and (new, new.key) == (sent, sent.key):
                continue  # it is under way
            old = places.get(new.key)
            if old is None or new.rank is Rank.SET_POINT:
                self.waiting.append(Waiting(owner, new, new.tries, old.round if old else self.round + 1))
            else:
                old.exchange, old.left = new, new.tries
                self.replaced += 1
        self.replaced += taken_back + len(frames) - len(given)
        self._bound(owner)

    def _bound(self, owner: int) -> None:
        """Drop the oldest, where too many wait."""
        mine = [one for one in self.waiting if one.owner == owner]
        if len(mine) <= CAPACITY:
            return
        for ranks in ((Rank.RELEASE,), (Rank.SET_POINT,), (Rank.QUESTION, Rank.BACKGROUND)):
            those = [one for one in mine if one.exchange.rank in ranks]
            for extra in those[: max(0, len(those) - CAPACITY)]:
                self.waiting.remove(extra)
                self.full += 1

    def drop(self, owner: int | None = None) -> None:
        """Forget what waits, of one driver or (None) of all: the line is lost, or a driver has failed. A
        device that was asked has the line until its answer would be overdue."""
        self.waiting = [one for one in self.waiting if owner is not None and one.owner != owner]
        self.silence = {key: each for key, each in self.silence.items() if owner not in (None, key[0])}
        self.missed = {key: each for key, each in self.missed.items() if owner not in (None, key[0])}
        if self.out is not None and owner in (None, self.out.owner):
            self.stray += len(self.held)
            self.out, self.held, self.free = None, b"", max(self.free, self.overdue)

    # -- out ----------------------------------------------------------------------------------

    def releases(self) -> bool:
        """True while something that disarms waits, or is to be answered."""
        every = self.waiting if self.out is None else [self.out, *self.waiting]
        return any(one.exchange.rank is Rank.RELEASE for one in every)

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
                self.out, self.held, self.given, self.last_byte = one, b"", now, now + self.time(size)
                self.searched = b"", None
                self.latest = self.last_byte + self.time(answer.size) + answer.delay + self.slack
                break
        self.free = max(self.free, now + self.time(size))
        self.pieces = 0 if taken else self.pieces
        return taken

    def written(self, now: Nanos) -> None:
        """Note that what was handed over last was written by now: what made it took its time, and the answer
        is waited for from here on."""
        if self.out is not None and not self.held:
            late = max(0, now - self.given)
            self.last_byte, self.latest = self.last_byte + late, self.latest + late

    def blocked(self, held_back: Exchange) -> None:
        """Note that the guard has held back what was handed over last: no answer will come."""
        if self.out is not None and self.out.exchange is held_back:
            self.out, self.held = None, b""

    def _next(self, now: Nanos) -> Waiting | None:
        """Return what is next: what disarms; else of this round the first by rank, drivers in turn."""
        ready = self.waiting
        if self.silence or self.missed:
            ready = [one for one in ready if self._may_be_sent(one) <= now]
        if self.out is not None:
            ready = [one for one in ready if one.exchange.answer is None]
        if not ready:
            return None
        for one in ready:
            if self._goes_first(one):
                return one
        mine = self._of_this_round(now, ready)
        if not mine and self.out is not None:
            mine = ready  # what is asked in this round waits for the answer under way: it goes on
        elif not mine:
            self.round, self.background, self.began, self.asked = self.round + 1, False, now, None
            for one in ready:
                one.round = min(one.round, self.round)
            mine = ready
        rank = min(_turn(one) for one in mine)
        mine = [one for one in mine if _turn(one) is rank]
        last = self.last_owner.get(rank, -1)
        first = min(mine, key=lambda one: (one.owner <= last, one.owner))
        self.last_owner[rank] = first.owner
        self.background |= rank is Rank.BACKGROUND
        if rank is not Rank.SET_POINT and self.asked is None:
            self.asked = now
        return first

    def _of_this_round(self, now: Nanos, ready: Sequence[Waiting]) -> list[Waiting]:
        """Return what is sent in this round; none if it is over, or set-points have waited long enough."""
        is_long = self.asked is not None and now - self.asked >= max(ROUND, self.asked - self.began)
        if is_long and any(_turn(one) is Rank.SET_POINT for one in ready):
            return []
        return [
            one
            for one in ready
            if one.round <= self.round and not (self.background and one.exchange.rank is Rank.BACKGROUND)
        ]

    def _goes_first(self, one: Waiting) -> bool:
        """True for what disarms a device that has not been silent for long."""
        return one.exchange.rank is Rank.RELEASE and self._silence(one)[0] < SILENT

    def _silence(self, one: Waiting) -> Silence:
        return self.silence.get((one.owner, one.exchange.key), (0, 0))

    def _may_be_sent(self, one: Waiting) -> Nanos:
        """Return from when on it may be sent: who has been silent is asked less often, and not for something
        else while its answer may still come."""
        lost, at = self._silence(one)
        answer, key = one.exchange.answer, one.exchange.key
        if answer is not None and answer.alike and one.exchange.rank is not Rank.RELEASE:
            missed, until = self.missed.get((one.owner, answer.alike), (key, 0))
            if missed != key:
                return until
        if lost < SILENT or answer is None:
            return 0
        longest = LONGEST_RELEASE if one.exchange.rank is Rank.RELEASE else LONGEST_BACKOFF
        return at + min((1 << (lost - SILENT)) * MILLISECOND, longest)

    # -- in -----------------------------------------------------------------------------------

    def receive(self, t: Nanos, data: bytes) -> tuple[list[Ended], bytes]:
        """Take bytes that have come; return what they complete, and what was not requested."""
        if self.out is None:  # of one that is late: it has the line until it is silent
            self._on_stray(t, data)
            return [], data
        asked = self.out.exchange
        size = asked.answer.size if asked.answer is not None else 0
        # An answer that has not ended yet began within its size; twice that leaves room for noise in it.
        oldest = max(0, len(self.held) - 2 * size)
        self.stray += oldest
        self.held, self.last_byte = (
            self.held[oldest:] + data,
            max(self.last_byte, t) if data else self.last_byte,
        )
        found = self._answer_in(self.held)
        if found is None:
            return [], b""
        start, end = found
        before, answer, behind = self.held[:start], self.held[start:end], self.held[end:]
        if self._is_copy(t, answer):
            self.held, self.searched = behind, (b"", None)
            self.stray += end
            return [], before + answer
        self.last = asked.key, answer, t
        self.answered += 1
        self.silence.pop((self.out.owner, asked.key), None)
        ended = self._end(t, answer, complete=True)
        self.stray += len(before)
        self._on_stray(t, behind)
        return [ended], before + behind

    def _on_stray(self, t: Nanos, data: bytes) -> None:
        self.stray += len(data)
        self._note_late(data)
        if data and self.half_duplex:
            quiet = max(self.quiet, min(self.quiet << min(self.pieces, 16), LONGEST_QUIET))
            self.free = max(self.free, t + quiet)
            self.pieces += 1

    def _is_copy(self, t: Nanos, answer: bytes) -> bool:
        """True if this has just answered another question, and does not say what it answers."""
        key, before, at = self.last
        asked = self.out.exchange if self.out is not None else None
        if asked is None or asked.answer is None or not asked.answer.alike:
            return False
        return answer == before and asked.key != key and t - at <= LONGEST_QUIET

    def _note_late(self, data: bytes) -> None:
        """Count an answer that comes when it has been given up."""
        for old in self.unanswered if data else ():
            if _find(old, data) is not None:
                self.unanswered.remove(old)
                self.late += 1
                return

    def completes(self, data: bytes) -> bool:
        """True if these bytes, behind those that have come, complete what is awaited. Decides nothing."""
        return self.out is not None and self._answer_in(self.held + data) is not None

    def _answer_in(self, held: bytes) -> tuple[int, int] | None:
        """Return where in these bytes the answer under way begins and ends."""
        if self.searched[0] != held:
            self.searched = held, _find(self.out.exchange, held) if self.out is not None else None
        return self.searched[1]

    def time_to_complete(self, size: int) -> Nanos:
        """Return in which time, after so many bytes more than those that have come, the answer under way can
        be complete."""
        answer = self.out.exchange.answer if self.out is not None else None
        return 0 if answer is None else self.time(max(0, answer.usual - len(self.held) - size))

    def _end(self, t: Nanos, data: bytes, *, complete: bool) -> Ended:
        one = self.out
        assert one is not None
        self.out, self.held, self.free = None, b"", max(self.free, t + (self.gap if complete else self.quiet))
        return Ended(one.owner, one.exchange, data, complete)

    def expire(self, now: Nanos) -> list[Ended]:
        """Return the exchange whose answer is overdue, or put it back if it may be tried again."""
        one = self.out
        if one is None or now < self._given_up():
            return []
        key = one.owner, one.exchange.key
        if now >= self.overdue:
            self.lost += 1
            self.cut += bool(self.held)
            self._note_late(self.held)
            self.unanswered = [*self.unanswered, one.exchange][-UNANSWERED:]
            self._miss(now, one)
            if key[1] is not None:
                self.silence[key] = min(self._silence(one)[0] + 1, 20), now
                if len(self.silence) > CAPACITY:  # who was asked with ever new words is forgotten
                    del self.silence[min(self.silence, key=lambda each: self.silence[each][1])]
        ended = self._end(now, self.held, complete=False)
        newer = one.exchange.key is not None and any(
            (other.owner, other.exchange.key) == key for other in self.waiting
        )
        if one.left <= 0 or newer:
            return [ended]
        one.round = self.round + 1
        self.waiting.append(one)  # behind the others: one that is silent keeps none waiting
        return [ended] if ended.data else []

    def _miss(self, now: Nanos, one: Waiting) -> None:
        """Note until when an answer may come late that does not say what it answers: once more as long."""
        answer = one.exchange.answer
        if answer is not None and answer.alike:
            self.missed = {key: each for key, each in self.missed.items() if each[1] > now}
            until = now + self.latest - self.given
            self.missed[one.owner, answer.alike] = one.exchange.key, until

    def _given_up(self) -> Nanos:
        """Return when the answer under way is not waited for any longer."""
        if any(self._goes_first(one) for one in self.waiting):
            return min(self.overdue, self.last_byte + PATIENCE)
        return self.overdue

    def due(self) -> Nanos | None:
        """Return when there is something to hand over, or an answer is overdue."""
        if self.out is None:
            held_back = self.waiting and (self.silence or self.missed)
            soonest = min(map(self._may_be_sent, self.waiting)) if held_back else 0
            return max(self.free, soonest) if self.waiting else None
        unanswered = any(one.exchange.answer is None for one in self.waiting)
        return min(self.free, self._given_up()) if unanswered and not self.half_duplex else self._given_up()


def _find(asked: Exchange, held: bytes) -> tuple[int, int] | None:
    """Return where the answer begins and ends. A plugin that raises has found none: the wire never raises."""
    try:
        return asked.answer.find(asked, held) if asked.answer is not None else None
    except (Exception, SystemExit):  # noqa: BLE001 -- a plugin's; it learns that the answer is lost
        return None


def _turn(one: Waiting) -> Rank:
    """Return as what it takes its turn: what disarms a device that is silent, with set-points."""
    return max(one.exchange.rank, Rank.SET_POINT)


def _newest(given: Sequence[Exchange]) -> list[Exchange]:
    """Return those that no later one replaces, in order."""
    last = {one.key: at for at, one in enumerate(given)}
    return [one for at, one in enumerate(given) if one.key is None or last[one.key] == at]
