"""The part of `benchmarks.peer` that runs in the peer's own environment: `python peer_yag_slam.py IN OUT`.

Rules. Nothing of this project is imported. The peer has its default settings, for both of its matchers, of
which one looks for loops. As Karto does, from which it comes, it takes a scan once the odometry has moved by
0.2 m or 10 degrees; in between its newest pose is carried on by the odometry, which costs it nothing here.
What a scan costs is the processor's time, of all threads, from its arrival until its pose is known.

IN (.npz): n × 3 poses of the lidar by odometry, n × m ranges [m], the first bearing and the step [rad], the
least and the largest range [m]. OUT: its poses as it went and in the end, n × 3; ms of each scan it took.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from yag_slam.graph_slam import GraphSlam
from yag_slam.helpers import default_config, default_config_loop
from yag_slam.models import LocalizedRangeScan
from yag_slam.scan_matching import Scan2DMatcherCpp

Pose: TypeAlias = npt.NDArray[np.float64]
"""x, y, yaw"""
FAR, TURNED = 0.2, math.radians(10.0)
"""m, rad"""


def after(a: Pose, d: Pose) -> Pose:
    """Return the pose at `d` in the frame of `a`."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([a[0] + c * d[0] - s * d[1], a[1] + s * d[0] + c * d[1], a[2] + d[2]])


def between(a: Pose, b: Pose) -> Pose:
    """Return the pose `b` in the frame of `a`."""
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return np.array([c * dx + s * dy, c * dy - s * dx, math.remainder(b[2] - a[2], 2.0 * math.pi)])


def pose_of(scan: Any) -> Pose:  # noqa: ANN401 -- the peer has no types
    """Return where a scan was taken, as it is known now."""
    there = scan.corrected_pose
    return np.array([there.x, there.y, there.euler[-1]])


def main() -> None:
    """Give it the scans of a file, write what it made of them."""
    given = np.load(sys.argv[1])
    odometry, ranges = given["odometry"], given["ranges"]
    first, step, least, most = (float(one) for one in given["lidar"])
    last = first + step * (ranges.shape[1] - 1)
    slam = GraphSlam(Scan2DMatcherCpp(default_config), Scan2DMatcherCpp(default_config_loop, loop=True))
    taken: list[Any] = []
    taken_at: list[int] = []
    as_it_went: list[Pose] = []
    spent: list[float] = []
    for pose, seen in zip(odometry, ranges, strict=True):
        moved = between(odometry[taken_at[-1]], pose) if taken else None
        if moved is None or math.hypot(moved[0], moved[1]) >= FAR or abs(moved[2]) >= TURNED:
            began = time.process_time()
            scan = LocalizedRangeScan(
                seen.tolist(),
                first,
                last,
                step,
                least,
                most,
                default_config["range_threshold"],
                *pose.tolist(),
            )
            slam.process_scan(scan)
            spent.append(1e3 * (time.process_time() - began))
            taken.append(scan)
            taken_at.append(len(as_it_went))
            moved = np.zeros(3)
        as_it_went.append(after(pose_of(taken[-1]), moved))
    newest = np.searchsorted(taken_at, np.arange(len(odometry)), side="right") - 1
    known = [pose_of(scan) for scan in taken]
    in_the_end = [
        after(known[at], between(odometry[taken_at[at]], pose))
        for at, pose in zip(newest.tolist(), odometry, strict=True)
    ]
    np.savez(sys.argv[2], as_it_went=as_it_went, in_the_end=in_the_end, spent=spent)


if __name__ == "__main__":
    main()
