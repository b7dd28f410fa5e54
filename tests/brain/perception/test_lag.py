"""Stamps of a lidar that are late or early: found, told, and counted for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from protocols.messages import SECOND, Event, LaserScan
from tests.brain.perception.office import STEP, TOUR, Rover, drive


@dataclass
class Late(Rover):
    lag: float = 0.0
    """s by which the stamps of scans are late; below 0: early"""

    def sense(self) -> list[Event]:
        by = round(self.lag * SECOND)
        return [replace(one, t=one.t + by) if isinstance(one, LaserScan) else one for one in super().sense()]


@pytest.mark.sample(1)
@pytest.mark.parametrize(("lag", "seed"), [(0.12, 1), (-0.1, 2), (0.05, 3), (0.2, 4)])
def test_a_lag_is_found_told_and_counted_for(lag: float, seed: int) -> None:
    delay = 4 + max(0, round(lag * SECOND) // STEP)
    driven = drive(Late(seed, lag=lag, scan_delay=delay), TOUR[:5])
    assert driven.perception.lags["lidar"] == pytest.approx(lag, abs=0.01)
    late = "late" if lag > 0.0 else "early"
    note = f"lidar: its stamps are {abs(lag):.2f} s {late}, beside those of the wheels: counted for"
    assert note in driven.perception.take_notes()
    for _ in range(300):
        driven.perception.observe(driven.rover.now, driven.rover.step(0.0, 0.0))
    assert driven.apart < 0.03  # it stands: no lag matters


def test_there_is_none_where_there_is_none() -> None:
    driven = drive(Rover(6), TOUR[:4])
    assert driven.perception.lags == {}
