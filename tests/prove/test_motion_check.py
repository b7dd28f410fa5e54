"""Ordinary driving, at length: nothing is held against wheels, gyro or lidar."""

from __future__ import annotations

import pytest

from tests.brain.perception.test_motion_check import ORDINARY, ROUND, Drive
from tests.prove.campaign import Campaign


@pytest.mark.prove
@pytest.mark.parametrize("kind", ORDINARY)
def test_ordinary_driving_is_no_lie(kind: str) -> None:
    """With 100 seeds each."""

    def case(seed: int, number: int) -> str:
        drive = Drive(ORDINARY[kind], seed=seed + number)
        drive.tour(ROUND)
        return drive.found[0][1] if drive.found else ""

    found = Campaign(f"ordinary-{kind}", 100).run(case)
    assert not [reason for reason in found.values() if reason]
