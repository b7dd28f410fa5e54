"""No bytes that a driver sends make a shaft faster than its limit: a sample, a million by `./go prove`."""

from __future__ import annotations

import pytest

from tests.prove.fuzz_guard import MARGIN, ROBOTS, fuzz
from tests.sampled import sampled

SAMPLE, ALL = 1_000, 100_000
"""Frames for each robot."""


@pytest.mark.parametrize("name", sampled(ROBOTS, 6))
def test_no_bytes_of_a_driver_drive_a_shaft_beyond_its_limit(name: str) -> None:
    made, worst = fuzz(name, 0, SAMPLE)
    assert made >= SAMPLE
    assert worst <= MARGIN, f"{name}: {worst:.3f} of the limit of velocity"


@pytest.mark.prove
@pytest.mark.parametrize("name", ROBOTS)
def test_a_hundred_thousand_frames_for_each_robot(name: str) -> None:
    made, worst = fuzz(name, 1, ALL)
    print(f"{name}: {made} frames, {worst:.3f} of the limit of velocity")
    assert worst <= MARGIN
