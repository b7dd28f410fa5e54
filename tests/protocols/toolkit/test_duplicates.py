"""Two shafts at one address: positions that no one shaft can have."""

from __future__ import annotations

import math

import pytest

from protocols.messages import MILLISECOND, Nanos
from protocols.toolkit.duplicates import ShaftCheck

TOLERANCE = 0.05
NEEDED = 8
Samples = list[tuple[Nanos, float, float]]


def first(reported: Samples) -> int | None:
    """Return which of these made it certain that there are two shafts."""
    check = ShaftCheck(TOLERANCE, NEEDED)
    return next((at for at, sample in enumerate(reported) if check.add(*sample)), None)


def every(period_ms: int, samples: list[tuple[float, float]]) -> Samples:
    return [(at * period_ms * MILLISECOND + 1, *sample) for at, sample in enumerate(samples)]


def vibration(amplitude: float, hertz: float) -> list[tuple[float, float]]:
    """Return 100 Hz of samples of a shaft that vibrates."""
    turn = [math.tau * hertz * at * 0.01 + 0.3 for at in range(400)]
    return [(amplitude * math.sin(w), amplitude * math.tau * hertz * math.cos(w)) for w in turn]


@pytest.mark.parametrize(
    ("reported", "at"),
    [
        # Far apart, just apart, and two are noticed although one sends more often, or turns.
        (every(10, [(0.0, 0.0), (1.0, 0.0)] * 20), NEEDED + 1),
        (every(5, [(0.0, 0.0), (2.0 * TOLERANCE, 0.0)] * 20), NEEDED + 1),
        (every(10, [(3.0, 0.0), (3.0, 0.0), (3.0, 0.0), (-1.0, 0.0)] * 20), 4 * NEEDED),
        (every(5, [(at * 0.05, 10.0) if at % 2 else (7.5, 0.0) for at in range(40)]), NEEDED + 1),
        (every(250, [(0.0, 0.0), (1.0, 0.0)] * 20), NEEDED + 1),
        # One that turns, has a new zero, a loose encoder, noise, is seldom received, or vibrates, is one.
        (every(10, [(at * 0.3, 30.0) for at in range(500)]), None),
        (every(10, [(0.0, 0.0)] * 20 + [(5.0, 0.0)] * 20 + [(0.0, 0.0)] * 20), None),
        (every(10, [(float(at % 7), 0.0) for at in range(500)]), None),
        (every(10, [(0.0, 0.0), (TOLERANCE * 0.9, 0.0)] * 200), None),
        (every(251, [(0.0, 0.0), (1.0, 0.0)] * 50), None),
        *[(every(10, vibration(0.024, hertz)), None) for hertz in (3.0, 17.0, 41.0, 49.0, 50.0, 51.0)],
    ],
)
def test_two_shafts_are_noticed_and_one_is_not_taken_for_two(reported: Samples, at: int | None) -> None:
    assert first(reported) == at


@pytest.mark.parametrize("bunch", [1, 2, 3, 5])
def test_frames_that_are_delivered_in_bunches_make_no_second_shaft(bunch: int) -> None:
    """An adapter without time stamps: so many frames bear the moment at which they were read."""
    times = [10 * MILLISECOND * (at // bunch * bunch + bunch) for at in range(300)]
    assert first([(t, 12.7 * 0.01 * at, 12.7) for at, t in enumerate(times)]) is None
    swing = [(0.5 * math.sin(0.06 * at), 3.0 * math.cos(0.06 * at)) for at in range(300)]
    assert first([(t, *sample) for t, sample in zip(times, swing, strict=True)]) is None
