"""No bytes that a driver sends bring a motor beyond its limits, or change it: a sample, 1.3 million by `./go
prove`."""

from __future__ import annotations

import pytest

from tests.gateway.core.starts import MOTORS
from tests.prove.fuzz_guard import fuzz
from tests.sampled import sampled

SAMPLE, ALL = 1_000, 100_000
"""Frames for each motor."""


@pytest.mark.parametrize("motor", sampled(MOTORS, 6))
def test_no_bytes_of_a_driver_bring_a_motor_beyond_its_limits(motor: str) -> None:
    fuzz(motor, 0, SAMPLE).check()


@pytest.mark.prove
@pytest.mark.parametrize("motor", MOTORS)
def test_a_hundred_thousand_frames_for_each_motor(motor: str) -> None:
    done = fuzz(motor, 1, ALL)
    print(f"{motor}: {done}")
    done.check()
