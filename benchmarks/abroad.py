"""How right perception is on other people's logs: `python -m benchmarks.abroad [LOG …] [--until SECONDS]`.

Rules. The settings are the same for every log (`tests.data.carmen`). The believed pose of the lidar, at each
scan, as it is known by the next one, is held against relations between poses that people verified (Kümmerle
et al. 2009, "On measuring the accuracy of SLAM algorithms"). The share lost is that of the scans after
which the verdict is "lost". What a scan costs is the processor's time from its arrival until the next
scan's, wheels included.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.consistency import Trust
from brain.perception.mount import Mount
from brain.perception.perception import Perception
from protocols.messages import MILLISECOND, SECOND, LaserScan, Nanos, seconds
from tests.data.carmen import BODY, SETTINGS, events

LOGS = ("aces", "intel")
SOON = 30.0
"""s: relations within this are judged by themselves, too"""
PARTS = 5
"""Steps without an event after a scan, as between two scans of a robot: its work is spread over them"""
SAME = 0.02
"""s between a relation's stamp and its scan's"""
HEAD = "log, which relations      n   raw m  raw deg  mean m  median   max m  mean deg"


@dataclass(frozen=True)
class Run:
    """What was believed over a log."""

    times: list[Nanos]
    """Of the scans"""
    believed: list[Pose]
    """Of the lidar; so is the next"""
    rolled: list[Pose]
    trust: list[Trust]
    """After each scan"""
    spent: list[float]
    """ms of the processor, for each scan"""
    nis: float
    """Per degree of freedom, of the lidar's matches"""
    anomalies: dict[str, int]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.abroad", description=__doc__)
    parser.add_argument("logs", nargs="*", default=LOGS, metavar="LOG", help="aces, intel; default: both")
    parser.add_argument("--until", type=float, default=math.inf, help="s: only the first part of each log")
    parser.add_argument("--ahead", type=float, default=0.0, help="m from the robot's origin to the lidar")
    options = parser.parse_args()
    folder = Path(os.environ["MOTOR_GATEWAY_DATA"]) / "carmen"
    for log in options.logs:
        run = drive(folder / f"{log}.clf.bz2", options.ahead, options.until)
        print(HEAD)
        for name, longest in (("all", math.inf), ("within 30 s", SOON)):
            print(f"{log}, {name:16}", text(errors(run, folder / f"{log}.relations", longest)))
        lost, doubtful, sure = (
            100.0 * np.mean([one >= least for one in run.trust])
            for least in (Trust.LOST, Trust.DOUBTFUL, Trust.TOO_SURE)
        )
        median, p99, most = np.percentile(run.spent, (50, 99, 100))
        print(
            f"{log}: {len(run.times)} scans, lost {lost:.2f} %, doubtful or lost {doubtful:.2f} %,"
            f" not consistent {sure:.2f} %; NIS per degree of freedom {run.nis:.2f};"
            f" ms a scan {median:.2f}, 99 % {p99:.2f}, max {most:.1f}"
        )
        print(f"{log}: not used {run.anomalies}", flush=True)


def drive(log: Path, ahead: float = 0.0, until: float = math.inf) -> Run:
    """Give a log to perception."""
    perception = Perception(BODY, {"lidar": Mount(x=ahead)}, SETTINGS)
    run = Run([], [], [], [], [], 0.0, {})
    lidar, spent, first = Pose(ahead, 0.0, 0.0), 0.0, -1
    known: Nanos = -1

    def note() -> None:
        estimate = perception.estimate
        assert estimate is not None, "wheels came first"
        run.times.append(known)
        run.believed.append(moved(estimate.pose, lidar))
        run.rolled.append(moved(perception.raw, lidar))
        run.trust.append(perception.verdict.trust)
        run.spent.append(1e3 * spent)

    for event in events(log):
        first = event.t if first < 0 else first
        if seconds(event.t - first) > until:
            break
        if event.t != known and known >= 0:
            note()
            known, spent = -1, 0.0
        began = time.process_time()
        perception.observe(event.t, [event])
        if isinstance(event, LaserScan):
            known = event.t
            for _ in range(PARTS):
                perception.observe(event.t, [])
        spent += time.process_time() - began
    nis = perception.nis.get("lidar")
    anomalies = {reason: count for each in perception.anomalies.values() for reason, count in each.items()}
    return Run(run.times, run.believed, run.rolled, run.trust, run.spent, nis.mean if nis else 0.0, anomalies)


def errors(run: Run, relations: Path, longest: float = math.inf) -> Floats:
    """Return the errors over relations `t1 t2 x y z roll pitch yaw`, at most so many seconds long, whose
    scans were seen: n × 4, m and degrees of the odometry, then of what was believed."""
    found = []
    for line in relations.read_text().splitlines():
        first, second, x, y, _, _, _, yaw = map(float, line.split())
        at = [bisect_right(run.times, round(t * SECOND) + MILLISECOND) - 1 for t in (first, second)]
        late = [seconds(round(t * SECOND) - run.times[i]) for i, t in zip(at, (first, second), strict=True)]
        if abs(second - first) > longest or max(map(abs, late)) > SAME:
            continue
        row: list[float] = []
        for path in (run.rolled, run.believed):
            a, b = (path[i] for i in at)
            c, s = math.cos(a.yaw), math.sin(a.yaw)
            dx, dy = b.x - a.x, b.y - a.y
            row.append(math.hypot(c * dx + s * dy - x, c * dy - s * dx - y))
            row.append(math.degrees(abs(wrap(b.yaw - a.yaw - yaw))))
        found.append(row)
    return np.array(found).reshape(-1, 4)


def text(rows: Floats) -> str:
    """Return errors as a line of the table."""
    if not len(rows):
        return "none"
    raw, raw_turn, ours, turn = rows.T
    return (
        f"{len(rows):6} {raw.mean():7.3f} {raw_turn.mean():8.2f} {ours.mean():7.4f} {np.median(ours):7.4f}"
        f" {ours.max():7.2f} {turn.mean():9.3f}"
    )


if __name__ == "__main__":
    main()
