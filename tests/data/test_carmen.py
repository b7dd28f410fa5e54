"""Two long indoor logs of others: the believed path against relations between poses that people verified.

The mean error is of what lies minutes apart, too, and there the map is what helps: scans against it make
the path much better than the odometry that it is made of.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from brain.belief import Pose
from brain.perception.mount import Mount
from brain.perception.perception import Perception, PerceptionSettings
from protocols.messages import Feedback, Nanos
from tests.data.carmen import BODY, against_relations, events


@pytest.mark.parametrize(
    ("log", "relations", "ahead", "share"),
    [
        ("carmen/aces.clf.bz2", "carmen/aces.relations", 0.06, 0.4),
        pytest.param("carmen/intel.clf.bz2", "carmen/intel.relations", 0.09, 0.6, marks=pytest.mark.prove),
    ],
)
def test_the_path_is_better_than_its_odometry(
    recording: Callable[[str], Path], log: str, relations: str, ahead: float, share: float
) -> None:
    perception = Perception(BODY, {"lidar": Mount(x=ahead)}, PerceptionSettings())
    times: list[Nanos] = []
    believed: list[Pose] = []
    rolled: list[Pose] = []
    for event in events(recording(log)):
        perception.observe(event.t, [event])
        if isinstance(event, Feedback) and event.motor == "right" and perception.estimate:
            times.append(event.t)
            believed.append(perception.estimate.pose)
            rolled.append(perception.raw)
    ours, raw = (against_relations(recording(relations), times, path) for path in (believed, rolled))
    print(log, ours, raw)
    assert ours.mean < share * raw.mean
    assert ours.mean_turn < raw.mean_turn
