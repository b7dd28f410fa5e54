"""Two signals at random distances, at length: 200 runs over a pseudo-terminal."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.gateway.runtime.test_two_signals import served
from tests.gateway.two_signals import Outcome, one_run, summary
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


def test_after_two_hundred_runs_of_two_signals_every_motor_is_disarmed(tmp_path: Path) -> None:
    with served(tmp_path) as (start, twin):

        def case(seed: int, number: int) -> list[float]:
            one = one_run(start, twin, seed, number)
            return [*one.signals, one.waited, one.between, one.armed, one.at_once, one.closed, one.unreported]

        done = Campaign("two_signals", 200).run(case)
    outcomes = [Outcome((int(a), int(b)), *rest) for a, b, *rest in done.values()]
    print(summary(outcomes))
    assert sum(one.armed for one in outcomes) > 50
    assert sum(one.at_once for one in outcomes) > 20
