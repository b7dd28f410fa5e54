"""One shaft or two, by where they are told to be."""

from __future__ import annotations

import math

import pytest

from protocols.odrive_can.places import Places
from protocols.words import MILLISECOND

MS = MILLISECOND


def heard(told: list[tuple[int, float, float]]) -> bool:
    places = Places()
    return any([places.hear(*one) for one in told])


@pytest.mark.parametrize("bunch", [1, 2, 3, 5])
def test_one_shaft_that_turns_fast_is_one_however_its_frames_are_handed_over(bunch: int) -> None:
    """An adapter without stamps: so many frames bear the moment at which they were read."""
    speed = 12.7
    steady = [(10 * MS * (n // bunch * bunch + bunch), speed * 0.01 * n, speed) for n in range(200)]
    assert not heard(steady)
    swing = [(t, 0.5 * math.sin(0.06 * n), 3.0 * math.cos(0.06 * n)) for n, (t, _, _) in enumerate(steady)]
    assert not heard(swing)


def test_two_shafts_that_speak_in_turn_are_two() -> None:
    assert heard([(5 * MS * n, 0.3 if n % 2 else 0.001 * n, 0.1) for n in range(40)])
    assert heard(
        [(5 * MS * n, -2.0 if n % 2 else 12.7 * 0.005 * n, 0.0 if n % 2 else 12.7) for n in range(40)]
    )
