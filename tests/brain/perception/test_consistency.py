"""When a lost robot knows its place again."""

from __future__ import annotations

import pytest

from brain.perception.consistency import RECOGNISED_SCANS, Agreement, Consistency
from brain.perception.match import MatchShares
from protocols.messages import MILLISECOND


def agreement(number: int, fit: float, crossed: float) -> Agreement:
    """A scan that fits 0.3 m off the believed pose."""
    seen = MatchShares(fit=fit, denied=1.0 - fit, known=0.8, crossed=crossed)
    return Agreement(number * 100 * MILLISECOND, seen, matched=True, near=False, offset=0.3)


def lost() -> Consistency:
    consistency = Consistency()
    for number in range(5):
        consistency.on_scan("lidar", agreement(number, 0.5, 0.3))
    assert consistency.lost
    return consistency


@pytest.mark.parametrize("crossed", [0.0, 0.10])
def test_a_place_is_recognised_though_a_door_was_shut_when_it_was_drawn(crossed: float) -> None:
    """A tenth of the rays through walls is no contradiction while the pose is believed: nor is it here."""
    consistency = lost()
    found = [consistency.recognised(agreement(number, 0.95, crossed)) for number in range(RECOGNISED_SCANS)]
    assert found == [*[False] * (RECOGNISED_SCANS - 1), True]


@pytest.mark.parametrize(("fit", "crossed"), [(0.8, 0.0), (0.95, 0.2)])
def test_a_place_that_only_looks_alike_is_not(fit: float, crossed: float) -> None:
    consistency = lost()
    assert not any(consistency.recognised(agreement(number, fit, crossed)) for number in range(50))


def test_scans_that_fit_must_follow_each_other() -> None:
    consistency = lost()
    fits = [0.6 if number % RECOGNISED_SCANS == 0 else 0.95 for number in range(50)]
    assert not any(consistency.recognised(agreement(number, fit, 0.0)) for number, fit in enumerate(fits))
