"""What clients may ask, and what ends by itself."""

from __future__ import annotations

import pytest

from gateway.config import load_robot
from gateway.view.requests import (
    AT_ONCE,
    HELD,
    NO_ROBOT,
    OVERTAKEN,
    PER_POLL,
    PER_SECOND,
    READ_ONLY,
    SILENT,
    Asking,
    Requests,
    ViewAnswer,
)
from protocols.messages import SECOND, Drive, Goal, Nanos, Release, Set, Stop, Velocity

ROBOT, BENCH = load_robot("diffbot"), load_robot("bench")


@pytest.mark.parametrize(
    ("line", "instruction"),
    [
        ("goal 1 2", Goal(1.0, 2.0)),
        ("set left.limits.velocity 3", Set("left.limits.velocity", 3.0)),
        ("stop the cat", Stop("the cat")),
        ("stop \ud800", Stop("?")),  # what cannot be recorded
    ],
)
def test_a_line_is_an_operators_request(line: str, instruction: object) -> None:
    requests = Requests(ROBOT, steer=True)
    asked, answer = requests.line(0, requests.enter(), line, 0)
    assert (asked, answer.ok) == (instruction, True)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("goal 1", "an argument is missing"),
        ("goal nan 1", "not a finite number"),
        ("", "nothing was asked"),
        ("mission ../../etc/passwd", "files are for the gateway's own terminal"),
        ("Mission,/etc/passwd", "files are for the gateway's own terminal"),
        ("MISSION mine.toml", "files are for the gateway's own terminal"),
        ("quit", "for the gateway's own terminal"),
        ("status", "for the gateway's own terminal"),
        ("goal 1 " + "2" * 1000, "longer than 1000"),
        ("\x00\ud800", "no command"),
    ],
)
def test_what_is_no_request_gets_a_sentence(line: str, reason: str) -> None:
    requests = Requests(ROBOT, steer=True)
    asked, answer = requests.line(0, requests.enter(), line, 0)
    assert asked is None
    assert not answer.ok
    assert reason in answer.text


def test_who_may_not_steer_may_stop_and_nothing_else() -> None:
    requests = Requests(ROBOT, steer=False)
    one = requests.enter()
    assert requests.line(0, one, "stop", 0)[0] == Stop("")
    for line in ("release", "goal 1 1", "set left.limits.velocity 3", "clear"):
        assert requests.line(0, one, line, 0) == (None, requests.line(0, one, "release", 0)[1])
    assert requests.hold(0, one, "drive 0.1 0", 0)[1].text == READ_ONLY
    assert requests.line(0, one, "help", 0)[1].ok


def test_where_no_robot_runs_nothing_can_be_asked_not_even_a_stop() -> None:
    requests = Requests(ROBOT, steer=False, live=False)
    one = requests.enter()
    for line in ("stop", "goal 1 1"):
        assert requests.line(0, one, line, 0) == (None, ViewAnswer(ok=False, text=NO_ROBOT))


def taken(requests: Requests, now: Nanos, one: Asking, polls: int) -> int:
    """Return how many requests are taken of one who asks as often as possible."""
    times = [now + poll for poll in range(polls) for _ in range(10 * PER_POLL)]
    return sum(requests.line(t, one, "goal 1 1", t)[0] is not None for t in times)


def test_too_many_requests_are_refused_and_a_stop_never_is() -> None:
    requests = Requests(ROBOT, steer=True)
    one, other = requests.enter(), requests.enter()
    assert taken(requests, 0, one, polls=1) == PER_POLL
    assert taken(requests, 1, one, polls=10) == AT_ONCE - PER_POLL
    assert requests.line(0, one, "stop", 0)[0] == Stop("")
    assert requests.line(0, one, "stop", 0) == (
        None,
        ViewAnswer(ok=True, text="stopped"),
    )  # once in a poll is enough
    assert requests.line(1, one, "stop", 1)[0] == Stop("")
    assert requests.line(1, other, "goal 1 1", 1)[0] == Goal(1.0, 1.0)
    assert taken(requests, SECOND, one, polls=10) == PER_SECOND


def test_what_is_refused_is_not_even_parsed() -> None:
    requests = Requests(ROBOT, steer=False)
    one = requests.enter()
    for line in ("mission rounds", "gaol 1 1"):
        assert requests.line(0, one, line, 0)[1].text == READ_ONLY


@pytest.mark.parametrize(
    ("robot", "line", "held", "end"),
    [
        (ROBOT, "drive 0.3 0.1", Drive(0.3, 0.1), Drive(0.0, 0.0)),
        (BENCH, "velocity left 2", Velocity("left", 2.0), Velocity("left", 0.0)),
    ],
)
def test_what_is_held_ends_without_its_client(robot: object, line: str, held: object, end: object) -> None:
    requests = Requests(robot, steer=True)  # type: ignore[arg-type]
    one = requests.enter()
    for t in (0, HELD, 2 * HELD):  # repeated in time
        assert requests.hold(t, one, line, t)[0] == [held]
        assert requests.expired(t + HELD) == []
    assert requests.expired(3 * HELD + 1) == [end]
    assert requests.expired(4 * HELD) == []
    assert requests.hold(5 * HELD, one, line, 5 * HELD)[0] == [held]
    assert requests.hold(5 * HELD, one, "", 5 * HELD)[0] == [end]  # released
    assert requests.hold(6 * HELD, one, line, 6 * HELD)[0] == [held]
    assert requests.leave(one) == [end]  # gone
    assert requests.expired(9 * HELD) == []


def test_what_is_held_ends_with_what_is_held_next() -> None:
    requests = Requests(BENCH, steer=True)
    one = requests.enter()
    assert requests.hold(0, one, "velocity left 2", 0)[0] == [Velocity("left", 2.0)]
    assert requests.hold(1, one, "velocity left 3", 1)[0] == [Velocity("left", 3.0)]
    assert requests.hold(2, one, "velocity right 2", 2)[0] == [Velocity("left", 0.0), Velocity("right", 2.0)]
    assert requests.hold(3, one, "goal 1 1", 3)[0] == [Velocity("right", 0.0)]  # which cannot be held
    assert requests.ends() == []


def test_after_a_stop_it_must_be_let_go_before_it_is_held_again() -> None:
    requests = Requests(ROBOT, steer=True)
    holds, silent, lets_go = (requests.enter() for _ in range(3))
    for one in (holds, silent, lets_go):
        assert requests.hold(0, one, "drive 0.3 0", 0)[0] == [Drive(0.3, 0.0)]
    requests.on_stop("another operator")
    assert requests.expired(10 * HELD) == []  # the stop has ended it
    for t in range(0, 10 * HELD, HELD // 2):
        assert requests.hold(t, holds, "drive 0.3 0", t) == ([], SILENT)
        requests.on_stop("another operator" if t < 5 * HELD else "")
    assert requests.hold(10 * HELD, silent, "drive 0.3 0", 10 * HELD)[0] == [Drive(0.3, 0.0)]
    assert requests.hold(10 * HELD, lets_go, "", 10 * HELD)[0] == []
    assert requests.hold(10 * HELD, lets_go, "drive 0.3 0", 10 * HELD)[0] == [Drive(0.3, 0.0)]


def test_nothing_is_held_while_it_is_stopped_and_that_is_answered_once() -> None:
    requests = Requests(ROBOT, steer=True)
    one = requests.enter()
    requests.on_stop("enough")
    assert requests.hold(0, one, "drive 0.3 0", 0) == ([], ViewAnswer(ok=False, text="stopped: enough"))
    assert requests.hold(HELD // 2, one, "drive 0.3 0", HELD // 2) == ([], SILENT)


def test_a_flood_holds_nothing_until_it_calms_down() -> None:
    requests = Requests(ROBOT, steer=True)
    one = requests.enter()
    assert requests.hold(0, one, "drive 0.3 0", 0, count=60)[0] == [Drive(0.3, 0.0)]
    begun, answer = requests.hold(1, one, "drive 0.3 0", 1, count=60)
    assert (begun, answer.ok) == ([Drive(0.0, 0.0)], False)
    for t in range(1, 5):
        assert requests.hold(t * HELD // 2, one, "drive 0.3 0", t * HELD // 2, count=60)[0] == []
    assert requests.hold(5 * SECOND, one, "drive 0.3 0", 5 * SECOND)[0] == [Drive(0.3, 0.0)]


def test_what_was_asked_before_its_client_could_know_of_a_stop_does_not_undo_it() -> None:
    requests = Requests(ROBOT, steer=True)
    late, there = requests.enter(), requests.enter()
    for line in ("release", "goal 1 1", "set left.limits.velocity 3"):
        assert requests.line(SECOND, late, line, 0)[0] is not None
    requests.line(2 * SECOND, there, "stop", 2 * SECOND)
    for heard in (None, 0, 2 * SECOND - 1):
        for line in ("release", "goal 1 1", "set left.limits.velocity 3"):
            assert requests.line(3 * SECOND, late, line, heard) == (
                None,
                ViewAnswer(ok=False, text=OVERTAKEN),
            )
    assert requests.line(3 * SECOND, late, "release", 2 * SECOND)[0] == Release()
    requests.expired(4 * SECOND)
    requests.on_stop("a terminal", pressed=True)
    requests.on_stop("a terminal")
    assert requests.line(5 * SECOND, late, "release", 4 * SECOND - 1)[0] is None
    assert requests.line(5 * SECOND, late, "help", None)[1].ok
