"""Our perception beside another program's on the same logs: `python -m benchmarks.peer PYTHON [LOG …]`.

Rules. PYTHON is the interpreter of an environment of its own in which the peer is installed (`pip install
yag-slam opencv-python-headless`): Karto's matcher and graph, in C++, called from Python. Both get the same
scans with the same odometry, and are judged by the same relations, as `benchmarks.abroad` does; the time of
both is their processor's, on this machine, one after the other. What a scan costs the peer is of the scans
that it takes, one in four or five; of ours it is of all, wheels included.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.abroad import LOGS, Run, drive, row
from brain.belief import Floats, Pose
from protocols.messages import LaserScan
from tests.data.carmen import events

PEER = Path(__file__).with_name("peer_yag_slam.py")
HEAD = """\
log, path: within 30 s | all | lost | ms of the processor for a scan, median and 99 %
                      odometry    path  |   odometry    path  | in the end
"""


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(prog="benchmarks.peer", description=__doc__)
    parser.add_argument("python", metavar="PYTHON", help="of the environment with the peer")
    parser.add_argument("logs", nargs="*", default=LOGS, metavar="LOG", help="aces, intel; default: both")
    parser.add_argument("--until", type=float, default=math.inf, help="s: only up to here")
    options = parser.parse_args()
    folder = Path(os.environ["MOTOR_GATEWAY_DATA"]) / "carmen"
    for log in options.logs:
        path, relations = folder / f"{log}.clf.bz2", folder / f"{log}.relations"
        ours = drive(path, part=(0.0, options.until))
        for name, run in (("ours", ours), ("yag-slam", beside(options.python, path, ours))):
            median, p99 = np.percentile(run.spent, (50, 99))
            count = f"{len(run.spent)} scans, ms {median:.2f}, 99 % {p99:.1f}"
            print(f"{f'{log}, {name}':16}", row(run, relations).rsplit("|", 2)[0], count, flush=True)


def beside(python: str, log: Path, ours: Run) -> Run:
    """Return what the peer believes over the scans of a run of ours, from the same odometry."""
    scans = {one.t: one for one in events(log) if isinstance(one, LaserScan)}
    first = scans[ours.times[0]]
    with tempfile.TemporaryDirectory() as folder:
        given, made = Path(folder, "given.npz"), Path(folder, "made.npz")
        np.savez(
            given,
            odometry=[(pose.x, pose.y, pose.yaw) for pose in ours.rolled],
            ranges=[scans[t].ranges for t in ours.times],
            lidar=(first.angle_min, first.angle_increment, first.range_min, first.range_max),
        )
        subprocess.run([python, PEER, given, made], check=True)
        found = dict(np.load(made))
    believed, known = (_poses(found[name]) for name in ("as_it_went", "in_the_end"))
    return replace(ours, believed=believed, known=known, spent=found["spent"].tolist())


def _poses(rows: Floats) -> list[Pose]:
    return [Pose(x, y, yaw) for x, y, yaw in rows.tolist()]


if __name__ == "__main__":
    main()
