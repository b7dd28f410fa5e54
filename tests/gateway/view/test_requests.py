"""What clients may ask, and what ends by itself."""

from __future__ import annotations

import pytest

from gateway.config import load_robot
from gateway.view.requests import AT_ONCE, HELD, PER_SECOND, READ_ONLY, Requests
from protocols.messages import SECOND, Drive, Goal, Set, Stop, Velocity

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
    asked, answer = requests.line(0, requests.enter(), line)
    assert (asked, answer.ok) == (instruction, True)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("goal 1", "an argument is missing"),
        ("goal nan 1", "not a finite number"),
        ("", "nothing was asked"),
        ("mission ../../etc/passwd", "files are for the gateway's own terminal"),
        ("quit", "for the gateway's own terminal"),
        ("status", "for the gateway's own terminal"),
        ("goal 1 " + "2" * 1000, "longer than 1000"),
        ("\x00\ud800", "no command"),
    ],
)
def test_what_is_no_request_gets_a_sentence(line: str, reason: str) -> None:
    requests = Requests(ROBOT, steer=True)
    asked, answer = requests.line(0, requests.enter(), line)
    assert asked is None
    assert not answer.ok
    assert reason in answer.text


def test_who_may_not_steer_may_stop_and_nothing_else() -> None:
    requests = Requests(ROBOT, steer=False)
    one = requests.enter()
    assert requests.line(0, one, "stop")[0] == Stop("")
    for line in ("release", "goal 1 1", "set left.limits.velocity 3", "clear"):
        assert requests.line(0, one, line) == (None, requests.line(0, one, "release")[1])
    assert requests.hold(0, one, "drive 0.1 0")[1].text == READ_ONLY


def test_too_many_requests_are_refused_and_a_stop_never_is() -> None:
    requests = Requests(ROBOT, steer=True)
    one, other = requests.enter(), requests.enter()
    heard = sum(requests.line(0, one, "goal 1 1")[0] is not None for _ in range(10 * AT_ONCE))
    assert heard == AT_ONCE
    assert requests.line(0, one, "stop")[0] == Stop("")
    assert requests.line(0, other, "goal 1 1")[0] == Goal(1.0, 1.0)
    heard = sum(requests.line(SECOND, one, "goal 1 1")[0] is not None for _ in range(10 * AT_ONCE))
    assert heard == PER_SECOND


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
        assert requests.hold(t, one, line)[0] == held
        assert requests.expired(t + HELD) == []
    assert requests.expired(3 * HELD + 1) == [end]
    assert requests.expired(4 * HELD) == []
    assert requests.hold(5 * HELD, one, line)[0] == held
    assert requests.hold(5 * HELD, one, "")[0] == end  # released
    assert requests.hold(6 * HELD, one, line)[0] == held
    assert requests.leave(one) == end  # gone
    assert requests.expired(9 * HELD) == []


def test_a_goal_cannot_be_held() -> None:
    requests = Requests(ROBOT, steer=True)
    assert requests.hold(0, requests.enter(), "goal 1 1")[0] is None
