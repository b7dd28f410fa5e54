"""The motion that scans alone show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.plane import arc, wrap
from brain.perception.keyframes import KeyframeSettings
from brain.perception.mount import Mount
from gateway.rosbag.scan_odometry import by_scans
from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos
from tests.brain.perception.office import OFFICE, scan_at

MOUNT = Mount(x=0.1, y=0.02, yaw=0.3)
PERIOD: Nanos = 100 * MILLISECOND


def carried(length: float) -> Iterator[tuple[Pose, LaserScan]]:
    """Yield the true pose and the scan of a lidar that somebody carries about, also to the side."""
    rng = np.random.Generator(np.random.PCG64(7))
    pose = Pose(0.0, 0.0, 0.0)
    for n in range(round(length * SECOND / PERIOD)):
        noise = rng.normal(0.0, 0.01, 360)
        yield pose, scan_at(OFFICE, pose, MOUNT, SECOND + n * PERIOD, noise)
        phase = n * PERIOD / SECOND
        pose = arc(
            pose, 0.04 * math.sin(0.5 * phase), 0.05 * math.sin(0.9 * phase), 0.02 * math.sin(0.7 * phase)
        )


@pytest.mark.parametrize("bursts", [0.0, 0.09], ids=["even stamps", "stamps in bursts"])
def test_a_lidar_that_is_carried_about_is_followed(bursts: float) -> None:
    """Every second scan comes as much later as it may: the next one at once. Defect: the speed of that was
    tenfold, and the place lost."""
    truth, scans = zip(*carried(40.0), strict=True)
    late = [replace(one, t=one.t + round((n % 2) * bursts * SECOND)) for n, one in enumerate(scans)]
    found = list(by_scans(late, {"lidar": MOUNT}, KeyframeSettings()))
    assert len(found) == len(scans)
    way = sum(math.dist((a.x, a.y), (b.x, b.y)) for a, b in pairwise(truth))
    assert way > 8.0
    for one, there in zip(found, truth, strict=True):
        assert math.dist((one.pose.x, one.pose.y), (there.x, there.y)) < 0.06
        assert abs(wrap(one.pose.yaw - there.yaw)) < 0.02


def test_who_shows_nothing_for_long_begins_anew() -> None:
    """A lidar that is covered stands; then what it shows is followed again."""
    (_, first), *rest = carried(20.0)
    dark = tuple([first.range_max] * len(first.ranges))
    hidden = [replace(one, ranges=dark) if 2 < n < 60 else one for n, (_, one) in enumerate(rest)]
    found = list(by_scans([first, *hidden], {"lidar": MOUNT}, KeyframeSettings()))
    assert found[50].pose == found[40].pose
    (a, _), (b, _) = rest[70], rest[-1]
    turned = wrap(found[-1].pose.yaw - found[71].pose.yaw)
    assert turned == pytest.approx(wrap(b.yaw - a.yaw), abs=0.02)
