"""How right perception is on other people's logs: `python -m benchmarks.abroad [LOG …]`.

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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.consistency import Trust
from brain.perception.loops import LoopSettings
from brain.perception.mount import Mount
from brain.perception.perception import Anchor, Perception, PerceptionSettings
from protocols.messages import SECOND, Event, Feedback, LaserScan, Nanos, seconds
from tests.data.carmen import BODY, SETTINGS, events

LOGS = ("aces", "intel")
SOON = 30.0
"""s: relations within this are judged by themselves, too"""
PARTS = 5
"""Steps without an event after a scan, as between two scans of a robot: its work is spread over them"""
SAME = 0.02
"""s between a relation's stamp and its scan's"""
HEAD = "log, path, which relations           n   raw m  raw deg  mean m  median   max m  mean deg"


Change: TypeAlias = Callable[[Iterator[Event]], Iterator[Event]]


def scaled(log: Iterator[Event]) -> Iterator[Event]:
    """Odometry that is 3 % long, and turns by a wheel that is 1 % larger."""
    for one in log:
        if isinstance(one, Feedback) and one.position is not None:
            yield replace(one, position=one.position * (1.03 if one.motor == BODY.left else 1.04))
        else:
            yield one


def thinned(log: Iterator[Event]) -> Iterator[Event]:
    """Every second beam."""
    for one in log:
        if isinstance(one, LaserScan):
            yield replace(one, ranges=one.ranges[::2], angle_increment=2.0 * one.angle_increment)
        else:
            yield one


def halved(log: Iterator[Event]) -> Iterator[Event]:
    """Every second scan."""
    count = 0
    for one in log:
        count += isinstance(one, LaserScan)
        if count % 2 or not isinstance(one, LaserScan):
            yield one


def noisy(log: Iterator[Event]) -> Iterator[Event]:
    """Noise of 0.03 m more on each range."""
    rng = np.random.Generator(np.random.PCG64(1))
    for one in log:
        if isinstance(one, LaserScan):
            ranges = np.array(one.ranges)
            ranges += np.where(ranges < one.range_max, 0.03 * rng.normal(size=len(ranges)), 0.0)
            yield replace(one, ranges=tuple(np.clip(ranges, 0.0, one.range_max).tolist()))
        else:
            yield one


def late(log: Iterator[Event]) -> Iterator[Event]:
    """Odometry that is stamped 0.12 s early."""
    by = round(0.12 * SECOND)
    moved_log = (one if isinstance(one, LaserScan) else replace(one, t=one.t - by) for one in log)
    return iter(sorted(moved_log, key=lambda one: one.t))


CHANGES: dict[str, Change] = {
    "scaled": scaled, "thinned": thinned, "halved": halved, "noisy": noisy, "late": late
}  # fmt: skip


@dataclass(frozen=True)
class Run:
    """What was believed over a log."""

    times: list[Nanos]
    """Of the scans"""
    believed: list[Pose]
    """Of the lidar, at its time; so is the next"""
    known: list[Pose]
    """As it is known in the end"""
    rolled: list[Pose]
    trust: list[Trust]
    """After each scan"""
    spent: list[float]
    """ms of the processor, for each scan"""
    nis: float
    """Per degree of freedom, of the lidar's matches"""
    anomalies: dict[str, int]
    loops: str
    """In words"""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.abroad", description=__doc__)
    parser.add_argument("logs", nargs="*", default=LOGS, metavar="LOG", help="aces, intel; default: both")
    parser.add_argument("--until", type=float, default=math.inf, help="s: only the first part of each log")
    parser.add_argument("--alone", action="store_true", help="by matching alone: no loop is closed")
    parser.add_argument("--changed", choices=sorted(CHANGES), help="a copy of each log, changed in memory")
    parser.add_argument("--ahead", type=float, default=0.0, help="m from the robot's origin to the lidar")
    options = parser.parse_args()
    folder = Path(os.environ["MOTOR_GATEWAY_DATA"]) / "carmen"
    for log in options.logs:
        settings = replace(SETTINGS, loops=LoopSettings(close=not options.alone))
        run = drive(folder / f"{log}.clf.bz2", options.ahead, options.until, settings, options.changed)
        print(HEAD)
        for path, kind in ((run.believed, "as it went"), (run.known, "in the end")):
            for name, longest in (("all", math.inf), ("within 30 s", SOON)):
                rows = errors(run, path, folder / f"{log}.relations", longest)
                print(f"{f'{log}, {kind}, {name}':31}", text(rows))
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
        print(f"{log}: {run.loops}; not used {run.anomalies}", flush=True)


def drive(
    log: Path,
    ahead: float = 0.0,
    until: float = math.inf,
    settings: PerceptionSettings = SETTINGS,
    changed: str | None = None,
) -> Run:
    """Give a log to perception, or a copy of it that was changed."""
    perception = Perception(BODY, {"lidar": Mount(x=ahead)}, settings)
    run = Run([], [], [], [], [], [], 0.0, {}, "")
    anchors: list[Anchor | None] = []
    lidar, spent = Pose(ahead, 0.0, 0.0), 0.0
    known: Nanos = -1

    def note() -> None:
        estimate = perception.estimate
        assert estimate is not None, "wheels came first"
        run.times.append(known)
        run.believed.append(moved(estimate.pose, lidar))
        anchors.append(perception.anchor(estimate.pose))
        run.rolled.append(moved(perception.raw, lidar))
        run.trust.append(perception.verdict.trust)
        run.spent.append(1e3 * spent)

    whole = list(events(log) if changed is None else CHANGES[changed](events(log)))
    began = time.process_time()
    for event in whole:
        if seconds(event.t - whole[0].t) > until:
            break
        if event.t != known and known >= 0:
            spent = time.process_time() - began  # once a scan: asking costs as much as a part of the work
            note()
            known, began = -1, time.process_time()
        perception.observe(event.t, [event])
        if isinstance(event, LaserScan):
            known = event.t
            for _ in range(PARTS):
                perception.observe(event.t, [])
    nis = perception.nis.get("lidar")
    anomalies = {reason: count for each in perception.anomalies.values() for reason, count in each.items()}
    known_now = [
        there if anchor is None else moved(perception.anchored(anchor), lidar)
        for there, anchor in zip(run.believed, anchors, strict=True)
    ]
    return replace(
        run, known=known_now, nis=nis.mean if nis else 0.0, anomalies=anomalies, loops=perception.loops
    )


def errors(run: Run, path: list[Pose], relations: Path, longest: float = math.inf) -> Floats:
    """Return the errors over relations `t1 t2 x y z roll pitch yaw`, at most so many seconds long, whose
    scans were seen: n × 4, m and degrees of the odometry, then of a path."""
    found, times = [], np.array(run.times) / SECOND
    for line in relations.read_text().splitlines():
        first, second, x, y, _, _, _, yaw = map(float, line.split())
        at = [int(np.abs(times - t).argmin()) for t in (first, second)]  # scans may be 0.3 ms apart
        off = max(abs(float(times[i]) - t) for i, t in zip(at, (first, second), strict=True))
        if abs(second - first) > longest or off > SAME:
            continue
        row: list[float] = []
        for one in (run.rolled, path):
            a, b = (one[i] for i in at)
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
