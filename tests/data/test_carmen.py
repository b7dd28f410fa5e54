"""Two long indoor logs of others: the believed path against relations between poses that people verified.

The mean error is of what lies minutes apart, too, and there loops are what helps.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.abroad import SOON, drive, errors, text
from brain.perception.consistency import Trust


@pytest.mark.parametrize(
    ("log", "relations", "went", "known"),
    [
        ("carmen/aces.clf.bz2", "carmen/aces.relations", 0.2, 0.06),
        pytest.param("carmen/intel.clf.bz2", "carmen/intel.relations", 0.15, 0.04, marks=pytest.mark.prove),
    ],
)
def test_the_path_is_better_than_its_odometry_and_never_lost(
    recording: Callable[[str], Path], log: str, relations: str, went: float, known: float
) -> None:
    """As it went, and as it is known in the end. Defect: a good match was refused where the odometry was
    wrong, and the robot was lost for that; no loop was closed."""
    run, verified = drive(recording(log)), recording(relations)
    for path, most in ((run.believed, went), (run.known, known)):
        raw, raw_turn, ours, turn = errors(run, path, verified).mean(axis=0)
        print(log, text(errors(run, path, verified)), f"NIS {run.nis:.2f}, {run.loops}, {run.anomalies}")
        assert ours < most < raw
        assert turn < 0.8 < raw_turn
        raw, raw_turn, ours, turn = errors(run, path, verified, SOON).mean(axis=0)
        print(log, text(errors(run, path, verified, SOON)))
        assert ours < min(raw, 0.045)
        assert turn < min(raw_turn, 0.7)
    assert sum(one is Trust.LOST for one in run.trust) < 0.005 * len(run.trust)
