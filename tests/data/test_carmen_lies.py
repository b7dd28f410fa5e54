"""What two long logs hold against their own sources: stamps of a host that stalled, and next to nothing else.

The robots' lidars stood ahead of the axle, by figures that the logs do not have and their turns show.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from brain.perception.body_scan import to_body
from brain.perception.motion_check import MotionCheck
from brain.perception.mount import Mount
from protocols.messages import Feedback, LaserScan, Nanos
from tests.brain.perception.rolling import shown
from tests.data.carmen import BODY, events


@pytest.mark.prove
@pytest.mark.parametrize(
    ("log", "ahead", "most"), [("carmen/aces.clf.bz2", 0.06, 2), ("carmen/intel.clf.bz2", 0.09, 1)]
)
def test_hardly_anything_contradicts(
    recording: Callable[[str], Path], log: str, ahead: float, most: int
) -> None:
    """Nor is the lidar's mounting doubted, where it is stated as it was."""
    check, wheels, last = MotionCheck(BODY), {"left": 0.0, "right": 0.0}, (0, 0.0, 0.0)
    found: list[tuple[Nanos, str]] = []
    before = mounted = 0
    for event in events(recording(log)):
        if isinstance(event, Feedback):
            wheels[event.motor] = event.position or 0.0
            if event.motor == "right":
                t, left, right = last
                last = event.t, wheels["left"], wheels["right"]
                check.on_wheels(t, event.t, *shown(BODY, (left, right), last[1:]))
        elif isinstance(event, LaserScan):
            check.on_scan("lidar", event.t, to_body(event, Mount(x=ahead), 20.0))
            confirmed = [one.reason for one in check.contradictions() if one.confirmed]
            mounted += any(one.flawed != "" for one in check.contradictions())
            found += [(event.t, reason) for reason in confirmed[before:]]
            before = len(confirmed)
    print(log, found, mounted)
    assert len(found) <= most
    assert mounted == 0
