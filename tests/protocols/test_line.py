"""A serial line with drivers that want more than it can carry, and devices whose answers are lost, late, or
come twice. A failure names its seed: `Session(seed)` repeats it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random

import pytest

from protocols.line import CAPACITY, LONGEST_QUIET, PATIENCE, SILENT, Answer, Ended, Exchange, Line, Rank
from protocols.messages import MILLISECOND, SECOND, Nanos

RATE = 1_000_000
FINE = 50_000
DELAY = 200_000
SPAN = 300 * MILLISECOND


def echoed(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """An answer is A5 and the question's first six bytes."""
    at = held.find(b"\xa5" + asked[:6])
    return (at, at + 7) if at >= 0 else None


def never(asked: bytes, held: bytes) -> None:
    """Nothing ends the answer."""


def ask(
    owner: int, number: int, count: int = 0, rank: Rank = Rank.QUESTION, *, answered: bool = True
) -> Exchange:
    """A frame that names its driver, what it is about, and which it is."""
    frame = bytes((owner, rank, number)) + count.to_bytes(3) + b"\0" * (number % 5)
    return Exchange(frame, Answer(7, echoed, DELAY) if answered else None, rank, f"{owner} {number}")


@dataclass
class Session:
    """Two drivers on a line. What each gives is drawn anew from time to time."""

    seed: int
    half_duplex: bool = True
    disturbed: tuple[str, ...] = ("lost", "late", "doubled")
    dead: tuple[int, int] | None = None
    """A device that never answers: owner and number."""
    now: Nanos = 0
    sent: list[tuple[Nanos, int, Exchange]] = field(default_factory=list)
    ended: list[tuple[Nanos, Ended]] = field(default_factory=list)
    coming: list[tuple[Nanos, Nanos, bytes]] = field(default_factory=list)
    """Answers: when they begin, when they end."""
    overlaps: int = 0
    wanted: list[list[Exchange]] = field(default_factory=lambda: [[], []])
    """What each driver has last given."""

    def __post_init__(self) -> None:
        self.random = Random(self.seed)
        self.line = Line(RATE, half_duplex=self.half_duplex, slack=FINE + 100_000)
        self.most = self.held = self.count = 0

    def run(self, span: Nanos = SPAN) -> None:
        """Step every millisecond, and the line every 50 µs."""
        end = self.now + span
        while self.now < end:
            if self.now % MILLISECOND == 0:
                self.give()
            self.fine()

    def give(self) -> None:
        """Let each driver give set-points, questions, what disarms, or nothing."""
        for owner in range(2):
            self.count += 1
            levels = [
                ask(owner, number, self.count, Rank.SET_POINT, answered=bool(number % 2))
                for number in range(3)
                if self.is_on(owner)
            ]
            questions = [ask(owner, 10 + number, self.count) for number in range(4)]
            background = [ask(owner, 20, self.count, Rank.BACKGROUND)] if self.random.random() < 0.5 else []
            release = [ask(owner, 30, self.count, Rank.RELEASE, answered=False)] * (
                self.random.random() < 0.02
            )
            self.wanted[owner] = [*levels, *release]
            self.line.put(owner, [*levels, *questions, *background, *release])

    def is_on(self, owner: int) -> bool:
        """A driver commands for 100 ms, and then does not."""
        return (self.now // (100 * MILLISECOND) + owner) % 2 == 0

    def fine(self) -> None:
        """Hand over, carry, answer, and expire."""
        for owner, each in self.line.take(self.now):
            self.on_sent(owner, each)
        self.now += FINE
        for begins, ends, data in [each for each in self.coming if each[1] <= self.now]:
            self.coming.remove((begins, ends, data))
            done, _ = self.line.receive(ends, data)
            self.ended += [(ends, one) for one in done]
        self.ended += [(self.now, one) for one in self.line.expire(self.now)]
        self.most, self.held = max(self.most, len(self.line.waiting)), max(self.held, len(self.line.held))

    def on_sent(self, owner: int, each: Exchange) -> None:
        start = max(self.now, max((t + self.line.time(len(x)) for t, _, x in self.sent[-1:]), default=0))
        end = start + self.line.time(len(each))
        if self.half_duplex:
            self.overlaps += any(begins < end and start < ends for begins, ends, _ in self.coming)
        self.sent.append((start, owner, each))
        if each.answer is None or self.dead == (owner, each[2]):
            return
        kind = self.random.choice(self.disturbed) if self.random.random() < 0.1 and self.disturbed else ""
        begins = end + self.random.randint(10_000, DELAY) + (3 * MILLISECOND if kind == "late" else 0)
        answer = (b"\xa5" + each[:6]) * (2 if kind == "doubled" else 1)
        if kind != "lost":
            self.coming.append((begins, begins + self.line.time(len(answer)), answer))


SEEDS = pytest.mark.parametrize("seed", range(6))


@SEEDS
@pytest.mark.parametrize("half_duplex", [True, False])
def test_what_is_sent_is_the_newest_and_what_is_wanted_now(seed: int, half_duplex: bool) -> None:
    session, newest = Session(seed, half_duplex), dict[tuple[int, Rank, str], int]()
    taken = session.line.take

    def checked(now: Nanos) -> list[tuple[int, Exchange]]:
        found = taken(now)
        for owner, each in found:
            assert each in session.wanted[owner] or each.rank is not Rank.SET_POINT, f"seed {seed}"
            count, key = int.from_bytes(each[3:6]), (owner, each.rank, each.about)
            assert count >= newest.get(key, 0), f"seed {seed}"
            newest[key] = count
        return found

    session.line = _Watched(session.line, checked)  # type: ignore[assignment]
    session.run()
    assert any(each.rank is Rank.SET_POINT for _, _, each in session.sent)


class _Watched:
    """A line of which what it hands over is checked."""

    def __init__(self, line: Line, take: object) -> None:
        self._line, self.take = line, take

    def __getattr__(self, name: str) -> object:
        return getattr(self._line, name)


@SEEDS
@pytest.mark.parametrize("half_duplex", [True, False])
def test_none_starves_whatever_is_lost(seed: int, half_duplex: bool) -> None:
    session = Session(seed, half_duplex)
    session.run()
    for owner in range(2):
        for number in (10, 11, 12, 13, 20):
            times = [t for t, one, each in session.sent if (one, each[2]) == (owner, number)]
            gaps = [b - a for a, b in zip([0, *times], [*times, SPAN], strict=True)]
            assert max(gaps) < 60 * MILLISECOND, f"seed {seed}: {owner} {number}"
        for number in range(3):
            times = [t for t, one, each in session.sent if (one, each[2]) == (owner, number)]
            gaps = [b - a for a, b in pairwise(times) if b - a < 90 * MILLISECOND]
            assert max(gaps) < 40 * MILLISECOND, f"seed {seed}: {owner} {number}"
    assert session.most < 40
    assert session.held <= 3 * 14
    assert len(session.line.silence) <= 20


@SEEDS
def test_of_honest_devices_nothing_overlaps_and_one_lost_answer_costs_one(seed: int) -> None:
    session = Session(seed, disturbed=("lost",))
    session.run()
    assert session.overlaps == 0, f"seed {seed}"
    lost = sum(not each.complete for _, each in session.ended)
    answered = sum(each.complete for _, each in session.ended)
    assert 0 < lost < answered
    assert session.line.stray == 0, f"seed {seed}"
    assert all(each.data[1:] == each.exchange[:6] for _, each in session.ended if each.complete)


@SEEDS
def test_an_answer_goes_to_who_asked_also_if_it_is_late_or_comes_twice(seed: int) -> None:
    session = Session(seed, disturbed=("late", "doubled"))
    session.run()
    for _, each in session.ended:
        assert not each.complete or each.data == b"\xa5" + each.exchange[:6], f"seed {seed}"
        assert each.owner == each.exchange[0]
    assert session.line.stray > 0


@pytest.mark.parametrize("seed", range(4))
def test_one_that_is_dead_takes_little_of_the_line(seed: int) -> None:
    whole, less = Session(seed, disturbed=()), Session(seed, disturbed=(), dead=(0, 11))
    counts = []
    for session in (whole, less):
        session.run()
        counts.append(sum(each.complete and each.exchange[2] == 12 for _, each in session.ended))
    assert counts[1] > 0.8 * counts[0], f"seed {seed}"
    asked = [t for t, owner, each in less.sent if (owner, each[2]) == (0, 11)]
    assert 6 < len(asked) < 14


@SEEDS
def test_what_disarms_is_sent_soon(seed: int) -> None:
    session = Session(seed)
    given: dict[bytes, Nanos] = {}
    put = session.line.put

    def noted(owner: int, frames: list[Exchange]) -> None:
        given.update({each: session.now for each in frames if each.rank is Rank.RELEASE})
        put(owner, frames)

    watched = _Watched(session.line, session.line.take)
    watched.put = noted  # type: ignore[attr-defined]
    session.line = watched  # type: ignore[assignment]
    session.run()
    sent = {bytes(each): t for t, _, each in session.sent if each.rank is Rank.RELEASE}
    assert given
    for frame, t in given.items():
        if t < SPAN - 10 * MILLISECOND:
            assert sent[bytes(frame)] - t < MILLISECOND, f"seed {seed}"


def test_a_copy_goes_on_as_the_line() -> None:
    session = Session(3)
    session.run(37 * MILLISECOND)
    other = copy.deepcopy(session)
    session.run(100 * MILLISECOND)
    other.run(100 * MILLISECOND)
    assert session.sent == other.sent
    assert (session.line.lost, session.line.answered) == (other.line.lost, other.line.answered)


# -- rule by rule --------------------------------------------------------------------------------------


def frames(line: Line, now: Nanos) -> list[bytes]:
    return [bytes(each) for _, each in line.take(now)]


SLOW = Exchange(b"slow", Answer(4, never, SECOND), Rank.QUESTION, "slow")
GOAL = Exchange(b"goal", None, Rank.SET_POINT, "goal")
OFF = Exchange(b"off", None, Rank.RELEASE, "off")


def test_a_set_point_that_waits_is_not_sent_after_idle() -> None:
    line = Line(RATE)
    line.put(0, [SLOW])
    assert frames(line, 0) == [b"slow"]
    line.put(0, [GOAL, b"a frame"])
    assert frames(line, MILLISECOND) == []
    line.put(0, [OFF])
    assert line.due() == 40_000 + PATIENCE
    (ended,) = line.expire(40_000 + PATIENCE)
    assert not ended.complete
    assert frames(line, SECOND) == [b"off"]
    assert not line.waiting


def test_an_answer_that_comes_is_not_given_up_for_what_disarms() -> None:
    line = Line(RATE)
    line.put(0, [SLOW])
    line.take(0)
    line.put(0, [OFF])
    line.receive(10 * MILLISECOND, b"part")
    assert line.expire(25 * MILLISECOND) == []
    (ended,) = line.expire(30 * MILLISECOND)
    assert (ended.data, ended.complete, line.lost) == (b"part", False, 0)


def test_set_points_are_sent_in_the_order_in_which_they_were_last_given() -> None:
    line = Line(RATE)
    line.put(0, [SLOW])
    line.take(0)
    mode = Exchange(b"mode", None, Rank.SET_POINT, "mode")
    line.put(0, [GOAL])
    line.put(0, [mode, GOAL])
    line.drop()
    line.put(0, [GOAL])
    line.put(0, [mode, GOAL])
    assert frames(line, 2 * SECOND) == [b"mode", b"goal"]


def test_of_two_given_at_once_about_the_same_the_later_one_is_sent() -> None:
    line = Line(RATE)
    line.put(0, [GOAL, Exchange(b"newer", None, Rank.SET_POINT, "goal")])
    assert frames(line, 0) == [b"newer"]
    assert line.replaced == 1


def test_frames_that_are_about_nothing_do_not_pile_up() -> None:
    line = Line(RATE)
    line.put(0, [SLOW])
    line.take(0)
    for count in range(1000):
        line.put(0, [b"%d" % count, Exchange(b"?%d" % count), Exchange(b"off%d" % count, None, Rank.RELEASE)])
    ranks = [each.exchange.rank for each in line.waiting]
    assert [ranks.count(rank) for rank in Rank] == [CAPACITY, 1, CAPACITY, 0]
    assert line.full == 2 * (1000 - CAPACITY)


def test_every_device_is_disarmed_also_if_one_does_not_answer_and_all_are_given_again() -> None:
    line, sent, now = Line(RATE), list[bytes](), 0
    off = [Exchange(b"off%d" % n, Answer(4, never), Rank.RELEASE, f"off {n}") for n in range(3)]
    for now in range(0, 200 * MILLISECOND, MILLISECOND // 4):
        line.expire(now)
        line.put(0, [*off, GOAL])
        sent += frames(line, now)
    assert min(sent.count(each) for each in off) > 5
    assert sent.count(b"goal") > 20
    first = sent.index(b"goal")
    assert {b"off0", b"off1", b"off2"} <= set(sent[:first])


def test_who_is_silent_is_asked_less_often_until_it_answers() -> None:
    line, sent = Line(RATE), list[Nanos]()
    ping = Exchange(b"ping", Answer(4, never), Rank.QUESTION, "ping")
    for now in range(0, SECOND, MILLISECOND):
        line.expire(now)
        line.put(0, [ping])
        sent += [now] * len(line.take(now))
    pauses = [b - a for a, b in pairwise(sent)]
    assert pauses[: SILENT - 1] == [2 * MILLISECOND] * (SILENT - 1)
    assert pauses == sorted(pauses)
    assert max(pauses) > 200 * MILLISECOND
    line.drop()
    line.put(0, [ping])
    assert line.take(2 * SECOND)


def test_a_question_may_be_asked_again_behind_the_others() -> None:
    line = Line(RATE)
    line.put(0, [Exchange(b"once", Answer(1, never), tries=2), Exchange(b"then", Answer(1, never))])
    sent, ended = [], []
    for now in range(0, 10 * MILLISECOND, FINE):
        ended += line.expire(now)
        sent += frames(line, now)
    assert sent == [b"once", b"then", b"once"]
    assert [bytes(each.exchange) for each in ended] == [b"then", b"once"]


def test_many_questions_keep_no_set_point_waiting_for_long() -> None:
    line, sent = Line(RATE), list[tuple[Nanos, bytes]]()
    line.put(0, [ask(0, number, answered=True) for number in range(200)])
    for now in range(0, 100 * MILLISECOND, FINE):
        line.expire(now)
        if line.out is None or now % MILLISECOND == 0:
            line.put(0, [Exchange(b"goal", None, Rank.SET_POINT, "goal")])
        sent += [(now, each) for each in frames(line, now)]
    goals = [t for t, each in sent if each == b"goal"]
    assert max(b - a for a, b in pairwise(goals)) < 25 * MILLISECOND
    assert len({each for _, each in sent}) > 100


def test_noise_before_an_answer_is_bounded_and_counted() -> None:
    line = Line(RATE)
    line.put(0, [ask(0, 10)])
    line.take(0)
    for now in range(100):
        assert line.receive(now, b"noise" * 20) == ([], b"")
        assert len(line.held) <= 2 * 7 + 100
    (ended,), rest = line.receive(100, b"\xa5\x00\x02\x0a\x00\x00\x00behind")
    assert ended.complete
    assert rest.endswith(b"behind")
    assert line.stray == 100 * 100 + 6


def test_a_driver_that_fails_leaves_the_line_to_the_others_when_its_answer_is_over() -> None:
    line = Line(RATE)
    line.put(0, [SLOW, GOAL])
    line.put(1, [Exchange(b"other", None, Rank.SET_POINT, "goal")])
    line.take(0)
    line.put(1, [Exchange(b"other", None, Rank.SET_POINT, "goal")])
    line.drop(0)
    assert frames(line, line.overdue - 1) == []
    assert frames(line, line.overdue) == [b"other"]


def test_a_question_that_the_guard_holds_back_is_not_waited_for() -> None:
    line = Line(RATE)
    line.put(0, [SLOW])
    ((_, each),) = line.take(0)
    line.blocked(each)
    assert line.out is None
    assert line.expire(2 * SECOND) == []


# -- what is counted for those who look on -----------------------------------------------------------------


def _framed(asked: bytes, held: bytes) -> tuple[int, int] | None:
    start = held.find(b"<")
    end = held.find(b">", start)
    return (start, end + 1) if 0 <= start < end and held[start + 1 : start + 2] == asked[:1] else None


def _asked(line: Line, now: int, question: bytes) -> None:
    line.put(0, [Exchange(question, Answer(4, _framed), about=question.decode())])
    assert [exchange for _, exchange in line.take(now)] == [question]


def test_an_answer_that_comes_when_it_was_given_up_is_counted_as_late() -> None:
    line = Line(1_000_000)
    _asked(line, 0, b"a")
    assert line.expire(line.overdue)
    assert (line.lost, line.cut, line.late) == (1, 0, 0)
    line.receive(line.overdue + 1, b"<a>")
    assert (line.lost, line.late) == (1, 1)
    line.receive(line.overdue + 2, b"<a>")
    assert line.late == 1


def test_an_answer_that_has_begun_is_waited_for_while_it_comes_but_not_for_ever() -> None:
    line = Line(1_000_000)
    _asked(line, 0, b"a")
    before = line.overdue
    line.receive(before - 1, b"<")
    assert line.expire(before) == []
    assert line.overdue == before - 1 + line.slack
    longest = before + line.time(4) + line.slack
    for now in range(before, longest + 1_000_000, 100_000):
        line.receive(now, b"x")
        if line.expire(now):
            break
    assert longest <= now < longest + 100_000


def test_what_took_its_time_until_it_was_written_is_waited_for_from_then_on() -> None:
    line = Line(1_000_000)
    _asked(line, 0, b"a")
    before = line.overdue
    line.written(2_000_000)
    assert (line.overdue, line.expire(before)) == (before + 2_000_000, [])


def test_an_answer_that_is_cut_or_garbage_is_counted_as_that() -> None:
    line = Line(1_000_000)
    _asked(line, 0, b"a")
    line.receive(100_000, b"<a")
    assert not line.completes(b"x")
    assert line.completes(b"x>")
    assert line.held == b"<a"
    (ended,) = line.expire(line.overdue)
    assert (ended.data, line.lost, line.cut, line.late) == (b"<a", 1, 1, 0)


def test_while_bytes_come_that_nobody_asked_for_silence_is_waited_for_longer() -> None:
    line, waits = Line(1_000_000), []
    for number in range(10):
        now = number * 10_000_000
        line.receive(now, b"noise")
        waits.append(line.free - now)
    assert waits == [100_000 << n for n in range(5)] + [LONGEST_QUIET] * 5
    _asked(line, 10**9, b"a")
    line.receive(10**9 + 1_000_000, b"<a>")
    line.receive(2 * 10**9, b"noise")
    assert line.free == 2 * 10**9 + line.quiet


def test_an_answer_that_has_begun_is_complete_when_its_usual_bytes_can_have_come() -> None:
    line = Line(1_000_000)
    line.put(0, [Exchange(b"ask", Answer(40, never, usual=30))])
    assert line.time_to_complete(0) == 0  # nothing is asked
    line.take(0)
    assert (line.time_to_complete(10), line.time_to_complete(30), line.time_to_complete(50)) == (
        200_000,
        0,
        0,
    )
    line.receive(100_000, b"0123456789")
    assert line.time_to_complete(10) == 100_000


def by_size(asked: bytes, held: bytes) -> tuple[int, int] | None:
    """An answer is its device's number and two bytes: it does not say what it answers."""
    return (0, 3) if len(held) >= 3 and held[0] == asked[0] else None


def alike(device: int, kind: str, rank: Rank = Rank.QUESTION) -> Exchange:
    return Exchange(
        bytes((device, ord(kind))), Answer(3, by_size, DELAY, alike=f"{device}"), rank, f"{device} {kind}"
    )


def test_where_an_answer_may_come_late_that_does_not_say_what_it_answers_nothing_else_is_asked() -> None:
    line = Line(RATE, slack=FINE)
    line.put(0, [alike(1, "a")])
    line.take(0)
    missed = line.overdue
    assert [one.data for one in line.expire(missed)] == [b""]
    late = missed + (missed - 0)  # once more as long
    line.put(0, [alike(1, "b"), alike(2, "b")])
    line.put(1, [alike(1, "b")])  # another driver's: other devices
    now = missed + line.quiet
    for owner, device in ((1, 1), (0, 2)):
        assert line.take(now) == [(owner, alike(device, "b"))]
        now += 30_000
        assert line.receive(now, bytes((device, 0, 0)))[0]
    assert line.take(now) == []
    assert line.due() == late
    line.put(0, [alike(1, "a")])  # the same again may have the answer that is late
    assert line.take(now) == [(0, alike(1, "a"))]
    assert line.receive(now + 10, b"\1\0\0")[0]
    assert line.take(late) == [(0, alike(1, "b"))]


def test_what_disarms_waits_for_no_late_answer() -> None:
    line = Line(RATE, slack=FINE)
    line.put(0, [alike(1, "a")])
    line.take(0)
    missed = line.overdue
    line.expire(missed)
    line.put(0, [alike(1, "b", Rank.RELEASE)])
    assert line.take(missed + line.quiet) == [(0, alike(1, "b", Rank.RELEASE))]


def test_a_copy_of_an_answer_that_does_not_say_what_it_answers_answers_nothing_else() -> None:
    line = Line(RATE, slack=FINE)
    for kind, answers in (("a", [b"\1\2\3"]), ("b", [b"\1\2\3", b"\1\4\5"])):
        line.put(0, [alike(1, kind)])
        line.take(line.free)
        found = [line.receive(line.free + at, each) for at, each in enumerate(answers)]
    assert [[one.data for one in ended] for ended, _ in found] == [[], [b"\1\4\5"]]
    assert line.stray == 3
    line.put(0, [alike(1, "a")])  # long after it, the same bytes are an answer
    line.take(line.free + SECOND)
    assert line.receive(line.free + SECOND, b"\1\4\5")[0]
