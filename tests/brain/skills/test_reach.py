"""Joints that are to reach a place: those that report no velocity, too."""

from __future__ import annotations

import pytest

from brain.skills.reach import LOOKED, STANDING, _Reaching
from protocols.messages import MILLISECOND, SECOND, Feedback, Position, Reach


@pytest.mark.parametrize("velocity", [0.0, None])
def test_a_joint_that_stands_is_seen_with_a_velocity_and_without(velocity: float | None) -> None:
    one = _Reaching(Reach((Position("lift", 0.7),)))
    stood = [
        one._stands(at * 10 * MILLISECOND, Feedback("lift", 0, 0.7, velocity), stood=False)
        for at in range(30)
    ]
    assert stood[-1] or any(stood[-11:])
    assert stood[0] is (velocity is not None)


def test_a_joint_that_moves_does_not_stand() -> None:
    one = _Reaching(Reach((Position("lift", 0.7),)))
    for at in range(100):
        now = at * 10 * MILLISECOND
        moved = 2.0 * STANDING * now / SECOND
        assert not one._stands(now, Feedback("lift", 0, 0.7 + moved), stood=False)
    assert not one._stands(0, None, stood=True)
    assert not one._stands(0, Feedback("lift", 0), stood=True)


def test_between_two_looks_it_is_as_before() -> None:
    one = _Reaching(Reach((Position("lift", 0.7),)))
    one._stands(0, Feedback("lift", 0, 0.7), stood=False)
    for stood in (True, False):
        assert one._stands(LOOKED // 2, Feedback("lift", 0, 0.9), stood=stood) is stood
