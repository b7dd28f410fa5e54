"""A sample of the random sessions (`./go prove -k sessions` runs 10,000), and that they find defects."""

from __future__ import annotations

import pytest

from protocols.plugin import Plugin
from tests.protocols.broken import motors
from tests.protocols.broken_all import BROKEN
from tests.protocols.sessions import MOTORS, Session
from tests.sampled import sampled

SAMPLE = 6
BY_NAME = {plugin.name: plugin for plugin, _ in BROKEN}
FOUND = {
    "forgets_idle": "something else",
    "SendsIdleOnce": "something else",
    "IdlesOnlyReportedArmed": "something else",
    "rounds_velocity": "not commanded",
    "FirstTorqueIsNotZero": "not commanded",
    "WaitsForEver": "not answered",
    "AnswersTwice": "answered twice",
}
"""Defects, each with what a session finds."""


@pytest.mark.sample(12)
@pytest.mark.parametrize("plugin", MOTORS, ids=lambda plugin: str(plugin.name))
@pytest.mark.parametrize("seed", sampled(range(SAMPLE), 2))
def test_after_all_that_a_line_can_do_the_devices_do_what_is_commanded(plugin: Plugin, seed: int) -> None:
    assert Session(plugin, seed).run() <= 1.0


@pytest.mark.sample(3)
@pytest.mark.parametrize("name", FOUND)
def test_a_defect_is_found_by_a_few_sessions(name: str) -> None:
    def run_some() -> None:
        for seed in range(20):
            Session(BY_NAME[name], seed).run()

    with pytest.raises(AssertionError, match=FOUND[name]):
        run_some()


def test_a_session_is_the_same_with_the_same_seed() -> None:
    first, again = Session(motors, 12), Session(motors, 12)
    assert (first.run(), first.now, str(first)) == (again.run(), again.now, str(again))
