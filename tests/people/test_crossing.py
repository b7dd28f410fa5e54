"""A sample of the campaign (`./go prove -k people`), and what it counts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocols.messages import Velocity
from tests.people.crossing import RADIUS, Trial, Walk, alone, drawn, run
from tests.robustness.plant import Person
from tests.sampled import sampled


@pytest.mark.sample(1)
@pytest.mark.parametrize("seed", sampled(range(5), 3))
def test_people_in_the_doorway_are_not_struck(seed: int) -> None:
    result = run(seed, to_the_goal=False)
    assert len(result.walks) == 2, result.walks
    assert result.struck == [], result.line()


@pytest.mark.parametrize(("left", "right", "struck"), [(0.0, 0.0, 0), (4.0, 4.0, 1), (-3.0, 3.0, 1)])
def test_who_meets_a_base_that_moves_is_struck_and_who_meets_one_that_stands_is_not(
    left: float, right: float, struck: int
) -> None:
    """Ahead of it and at 1 m/s towards it; the base stands, drives and turns, and does not look."""
    person = Person(0.9, 0.0, -1.0, 0.0, RADIUS)
    trial = Trial(1, 0, [Walk("one", person, 0)], np.zeros((1, 3)))
    for _ in range(80):
        trial._commands = (Velocity("left", left), Velocity("right", right))
        trial.brain.step = lambda *_: trial._commands  # type: ignore[method-assign]
        trial.tick()
    result = trial.result
    assert (len(result.struck), result.stepped_aside) == (struck, 1 - struck)


def test_they_come_to_where_the_base_would_be() -> None:
    """At the tick for which they were drawn, whatever their speed, up to 0.3 m; from places free of walls."""
    for seed in range(40):
        track = alone(seed % 2)[1]
        for walk in drawn(seed):
            person = walk.person
            t = np.arange(len(track) - walk.after) / 100.0
            x, y = person.x + person.vx * t, person.y + person.vy * t
            away = np.hypot(x - track[walk.after :, 0], y - track[walk.after :, 1])
            assert away.min() <= 0.31, (seed, walk)
            assert 0.3 <= math.hypot(person.vx, person.vy) <= 1.2
