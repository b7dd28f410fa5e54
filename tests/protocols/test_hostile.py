"""Hostile frames: no end of a protocol raises, at a bounded number of calls; nor does a gateway or a monitor.

`./go prove -k hostile_frames` takes ten million per protocol (tests/prove/test_hostile.py).
"""

from __future__ import annotations

from random import Random

import pytest

from protocols.conformance.noise import valid_frames
from tests.protocols import hostile
from tests.protocols.hostile import PLUGINS


@pytest.mark.parametrize("name", sorted(PLUGINS))
def test_hostile_frames_do_not_raise(name: str) -> None:
    for seed in range(2):
        hostile.line(name, seed, 1000)


@pytest.mark.parametrize("name", sorted(PLUGINS))
def test_a_gateway_and_a_monitor_take_hostile_frames(name: str) -> None:
    hostile.robot(name, 1, 800)


def test_the_frames_reach_what_they_are_to_reach() -> None:
    """Sealed messages are accepted often enough to matter, and not always."""
    case = hostile._cases("plain")[0]
    draw = hostile.Hostile(valid_frames(case), Random(1))
    driver = case.start().driver
    for _ in range(2000):
        driver.receive(0, draw.frame())
    counters = driver.counters
    assert min(counters.accepted, counters.malformed) > 300, counters
