"""Two signals at random distances, at length: 200 runs over a pseudo-terminal, and 600 of pairs of
SIGINT, SIGTERM and SIGHUP in simulated time, 200 that begin with each."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from tests.gateway.runtime.test_two_signals import served
from tests.gateway.two_signals import ROBOT, Outcome, compare, one_run, summary
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


def test_after_two_hundred_runs_of_two_signals_every_motor_is_disarmed(tmp_path: Path) -> None:
    with served(tmp_path) as (start, twin):

        def case(seed: int, number: int) -> list[float]:
            one = one_run(start, twin, seed, number)
            return [*one.signals, one.waited, one.between, one.armed, one.hurried, one.closed, one.unreported]

        done = Campaign("two_signals", 200).run(case)
    outcomes = [Outcome((int(a), int(b)), *rest) for a, b, *rest in done.values()]
    print(summary(outcomes))
    assert sum(one.armed for one in outcomes) > 50
    assert sum(one.hurried for one in outcomes) > 20


def test_after_two_signals_nothing_turns_faster_than_after_one(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(ROBOT)
    count = 600  # 200 that begin with each kind
    done = Campaign("two_signals_speeds", count).run(partial(compare, str(tmp_path / "rig.toml")))
    turning = [speed for _, _, speed in done.values() if speed > 1.0]
    print(
        f"{count} pairs of signals, {len(turning)} while the motors turned, at up to {max(turning):.1f} rad/s"
    )
    assert len(turning) > count / 2
