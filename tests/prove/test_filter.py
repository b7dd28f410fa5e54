"""The filter's covariance, without a map: is it as large as the errors are?"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brain.perception.filter_settings import FilterSettings
from protocols.messages import SECOND
from tests.brain.perception.rolling import Floor, consistency
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove

EXACT = FilterSettings(
    start_sigma=1e-6,
    start_yaw_sigma=1e-6,
    scale_sigma=1e-4,
    scale_walk=0.0,
    travel_noise=0.0055,
    sideways_noise=0.0,
)
COARSE = 2.0 * np.pi / 512.0
CASES = {
    "wheels and gyro": (Floor(), EXACT),
    "wheels alone": (Floor(gyro=False), EXACT),
    "fixes": (Floor(fixes=2 * SECOND), EXACT),
    "worn tyres": (Floor(fixes=2 * SECOND, radius_errors=(0.028, 0.022)), replace(EXACT, scale_sigma=0.03)),
    "coarse encoders": (Floor(resolution=COARSE), replace(EXACT, resolution=COARSE)),
    "noisy gyro": (Floor(gyro_noise=0.03), EXACT),
}


def case(seed: int, number: int) -> dict[str, Any]:
    floor, settings = list(CASES.values())[number % len(CASES)]
    nees, belief = consistency(seed + number // len(CASES), 20 * SECOND, floor, settings)
    return {"nees": nees, "nis": {name: (nis.total, nis.freedom) for name, nis in belief.nis.items()}}


def test_the_covariance_is_honest() -> None:
    """100 drives of 20 s for each kind of floor."""
    done = Campaign("filter", 100 * len(CASES)).run(case)
    for i, name in enumerate(CASES):
        results = [done[number] for number in sorted(done) if number % len(CASES) == i]
        nees = float(np.mean([result["nees"] for result in results]))
        sums = {s: np.sum([result["nis"][s] for result in results], axis=0) for s in results[0]["nis"]}
        ratios = {source: float(total / freedom) for source, (total, freedom) in sums.items()}
        print(f"{name}: NEES {nees:.2f} per number, NIS {ratios}")
        assert 0.5 < nees < 1.5, name
        assert all(0.5 < ratio < 2.0 for ratio in ratios.values()), name
