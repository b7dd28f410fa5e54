"""Two long indoor logs of others: the believed path against relations between poses that people verified.

The mean error is of what lies minutes apart, too, and there the map is what helps: scans against it make
the path much better than the odometry that it is made of.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.abroad import SOON, drive, errors, text
from brain.perception.consistency import Trust


@pytest.mark.parametrize(
    ("log", "relations", "most"),
    [
        ("carmen/aces.clf.bz2", "carmen/aces.relations", 0.35),
        pytest.param("carmen/intel.clf.bz2", "carmen/intel.relations", 0.5, marks=pytest.mark.prove),
    ],
)
def test_the_path_is_better_than_its_odometry_and_never_lost(
    recording: Callable[[str], Path], log: str, relations: str, most: float
) -> None:
    """Defect: a good match was refused where the odometry was wrong, and the robot was lost for that."""
    run, verified = drive(recording(log)), recording(relations)
    raw, raw_turn, ours, turn = errors(run, verified).mean(axis=0)
    print(log, text(errors(run, verified)), f"NIS {run.nis:.2f}, ms {np.percentile(run.spent, (50, 99))}")
    assert ours < most < raw
    assert turn < 2.0 < raw_turn
    raw, raw_turn, ours, turn = errors(run, verified, SOON).mean(axis=0)
    print(log, text(errors(run, verified, SOON)), run.anomalies)
    assert ours < min(raw, 0.045)
    assert turn < min(raw_turn, 0.7)
    assert sum(one is Trust.LOST for one in run.trust) < 0.005 * len(run.trust)
