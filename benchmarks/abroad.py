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
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.consistency import Trust
from brain.perception.loops import LoopSettings
from brain.perception.mount import Mount
from brain.perception.perception import Anchor, Perception, PerceptionSettings
from brain.perception.saved_keyframes import SavedKeyframes
from brain.perception.saved_map import SavedMap
from gateway.config.keyframes_file import keyframes_file
from gateway.config.map_file import saved_map
from gateway.rosbag.drawn import Drawn
from protocols.messages import SECOND, Event, Feedback, LaserScan, Nanos, seconds
from tests.data.carmen import BODY, SETTINGS, events

LOGS = ("aces", "intel")
SOON = 30.0
"""s: relations within this are judged by themselves, too"""
PARTS = 5
"""Steps without an event after a scan, as between two scans of a robot: its work is spread over them"""
AS_IT_IS = "as it is"
COPIES = """\
within 30 s: odometry, ours | all: odometry, as it went | odometry, in the end | lost, doubtful | NIS
                     m  deg       m  deg |       m  deg       m  deg |       m  deg       m  deg | % % |"""
SAME = 0.02
"""s between a relation's stamp and its scan's"""
HEAD = "log, path, which relations           n   raw m  raw deg  mean m  median   max m  mean deg"


Log: TypeAlias = list[Event]
Change: TypeAlias = Callable[[Log], Log]
WHEELS = (BODY.left, BODY.right)


def rolled(log: Log, change: Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]) -> Log:
    """Return a log with other angles of its wheels: `change` makes those of left and right [rad] of their
    times [s] and angles."""
    angles = {
        name: [one for one in log if isinstance(one, Feedback) and one.motor == name] for name in WHEELS
    }
    t = np.array([seconds(one.t - log[0].t) for one in angles[BODY.left]])
    left, right = (np.array([one.position or 0.0 for one in angles[name]]) for name in WHEELS)
    made = dict(zip(WHEELS, (iter(each.tolist()) for each in change(t, left, right)), strict=True))
    return [replace(one, position=next(made[one.motor])) if isinstance(one, Feedback) else one for one in log]


def seen(log: Log, change: Callable[[LaserScan], LaserScan]) -> Log:
    """Return a log with other scans."""
    return [change(one) if isinstance(one, LaserScan) else one for one in log]


def scaled(left: float, right: float) -> Change:
    """Odometry whose wheels count so many times as much."""
    return lambda log: rolled(log, lambda _, a, b: (left * a, right * b))


def drifting(log: Log) -> Log:
    """Odometry that turns by 0.5 degrees a second more, whether it moves or not: a gyro's bias."""
    more = math.radians(0.5) * BODY.wheel_separation / 2.0 / BODY.wheel_radius
    return rolled(log, lambda t, a, b: (a - more * t, b + more * t))


def lagging(lag: float) -> Change:
    """Scans whose odometry is so much older [s]."""
    return lambda log: rolled(log, lambda t, a, b: (np.interp(t - lag, t, a), np.interp(t - lag, t, b)))


def jittered(log: Log) -> Log:
    """Odometry that is up to 20 ms older or newer than its stamp."""
    rng = np.random.Generator(np.random.PCG64(1))

    def change(t: Floats, left: Floats, right: Floats) -> tuple[Floats, Floats]:
        then = t + rng.uniform(-0.02, 0.02, len(t))
        return np.interp(then, t, left), np.interp(then, t, right)

    return rolled(log, change)


def thinned(step: int) -> Change:
    """One beam of so many."""
    return lambda log: seen(
        log,
        lambda one: replace(one, ranges=one.ranges[::step], angle_increment=step * one.angle_increment),
    )


def near(farthest: float) -> Change:
    """A lidar that sees so far [m]."""

    def change(one: LaserScan) -> LaserScan:
        return replace(one, range_max=farthest, ranges=tuple(min(r, farthest) for r in one.ranges))

    return lambda log: seen(log, change)


def rarer(step: int) -> Change:
    """One scan of so many."""

    def change(log: Log) -> Log:
        count = [-1]

        def kept(one: Event) -> bool:
            count[0] += isinstance(one, LaserScan)
            return not isinstance(one, LaserScan) or count[0] % step == 0

        return [one for one in log if kept(one)]

    return change


def noisy(sigma: float) -> Change:
    """Noise of so many m more on each range."""

    def change(log: Log) -> Log:
        rng = np.random.Generator(np.random.PCG64(1))

        def one(scan: LaserScan) -> LaserScan:
            ranges = np.array(scan.ranges)
            ranges += np.where(ranges < scan.range_max, sigma * rng.normal(size=len(ranges)), 0.0)
            return replace(scan, ranges=tuple(np.clip(ranges, 0.0, scan.range_max).tolist()))

        return seen(log, one)

    return change


def slipping(log: Log) -> Log:
    """Odometry whose wheels slip by a tenth of their way (standard deviation), each anew every second."""
    rng = np.random.Generator(np.random.PCG64(1))

    def change(t: Floats, left: Floats, right: Floats) -> tuple[Floats, Floats]:
        at = np.arange(t[0], t[-1] + 2.0)

        def one(angle: Floats) -> Floats:
            factors = 1.0 + 0.1 * np.interp(t, at, rng.normal(size=len(at)))
            turned: Floats = np.cumsum(np.diff(angle, prepend=angle[:1]) * factors) + angle[0]
            return turned

        return one(left), one(right)

    return rolled(log, change)


def mirrored(log: Log) -> Log:
    """Left is right."""

    def change(one: LaserScan) -> LaserScan:
        first = -one.angle_min - (len(one.ranges) - 1) * one.angle_increment
        return replace(one, angle_min=first, ranges=one.ranges[::-1])

    return seen(rolled(log, lambda _, a, b: (b, a)), change)


def backward(log: Log) -> Log:
    """From its end to its beginning."""
    both = log[0].t + log[-1].t
    turned = (replace(one, t=both - one.t) for one in log)
    return sorted(turned, key=lambda one: (one.t, isinstance(one, LaserScan)))


CHANGES: dict[str, Change] = {
    AS_IT_IS: lambda log: log,
    "lag 0.05": lagging(0.05), "lag 0.1": lagging(0.1), "lag 0.2": lagging(0.2), "lag -0.1": lagging(-0.1),
    "scaled 0.95": scaled(0.95, 0.95), "scaled 1.05": scaled(1.05, 1.05), "one wheel": scaled(1.03, 1.04),
    "drifting": drifting, "jittered": jittered, "thinned 2": thinned(2), "thinned 4": thinned(4),
    "thinned 8": thinned(8), "near 8": near(8.0), "near 5": near(5.0),
    "rarer 2": rarer(2), "rarer 3": rarer(3),
    "noisy 0.03": noisy(0.03), "noisy 0.05": noisy(0.05), "noisy 0.1": noisy(0.1), "noisy 0.2": noisy(0.2),
    "slipping": slipping,
    "mirrored": mirrored, "backward": backward,
}  # fmt: skip
"""What a log may be like, by name: made of another one, in memory"""


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
    lags: tuple[float, ...]
    """s, that were found"""
    anchors: list[Anchor | None] = field(default_factory=list)
    """Where the robot was, relative to keyframes"""
    files: dict[str, bytes] = field(default_factory=dict)
    """Of the map, as `gateway map` writes them"""
    keyframes: SavedKeyframes | None = None

    def share(self, least: Trust) -> float:
        """Return after how many scans the verdict was this, or worse, in percent."""
        return 100.0 * float(np.mean([one >= least for one in self.trust]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.abroad", description=__doc__)
    parser.add_argument("logs", nargs="*", default=LOGS, metavar="LOG", help="aces, intel; default: both")
    parser.add_argument("--since", type=float, default=0.0, help="s: without the first part of each log")
    parser.add_argument("--until", type=float, default=math.inf, help="s: only up to here")
    parser.add_argument("--alone", action="store_true", help="by matching alone: no loop is closed")
    parser.add_argument(
        "--changed", nargs="+", choices=("all", *CHANGES), metavar="NAME",
        help=f"copies of each log, changed in memory, a row each: all, {', '.join(CHANGES)}",
    )  # fmt: skip
    parser.add_argument(
        "--halves",
        action="store_true",
        help="as two recordings, of which the second is mapped in the map of the first",
    )
    parser.add_argument("--ahead", type=float, default=0.0, help="m from the robot's origin to the lidar")
    options = parser.parse_args()
    folder = Path(os.environ["MOTOR_GATEWAY_DATA"]) / "carmen"
    settings = replace(SETTINGS, loops=LoopSettings(close=not options.alone))
    part = options.since, options.until
    if options.changed:
        print(COPIES)
    for log in options.logs:
        path, relations = folder / f"{log}.clf.bz2", folder / f"{log}.relations"
        if options.halves:
            halves(log, path, relations, options.ahead, settings)
        elif options.changed:
            for name in CHANGES if "all" in options.changed else options.changed:
                run = drive(path, options.ahead, part, settings, name)
                print(f"{f'{log}, {name}':20}", row(run, relations), flush=True)
        else:
            describe(log, drive(path, options.ahead, part, settings), relations)


def describe(log: str, run: Run, relations: Path) -> None:
    """Print how right a run is, and what it cost."""
    print(HEAD)
    for path, kind in ((run.believed, "as it went"), (run.known, "in the end")):
        for name, longest in (("all", math.inf), ("within 30 s", SOON)):
            print(f"{f'{log}, {kind}, {name}':31}", text(errors(run, path, relations, longest)))
    lost, doubtful, sure = (run.share(least) for least in (Trust.LOST, Trust.DOUBTFUL, Trust.TOO_SURE))
    median, p99, most = np.percentile(run.spent, (50, 99, 100))
    print(
        f"{log}: {len(run.times)} scans, lost {lost:.2f} %, doubtful or lost {doubtful:.2f} %,"
        f" not consistent {sure:.2f} %; NIS per degree of freedom {run.nis:.2f};"
        f" ms a scan {median:.2f}, 99 % {p99:.2f}, max {most:.1f}"
    )
    print(f"{log}: {run.loops}; not used {run.anomalies}", flush=True)


def row(run: Run, relations: Path) -> str:
    """Return a run as a row of the table of changed logs."""
    cells = []
    for longest, path in ((SOON, run.believed), (math.inf, run.believed), (math.inf, run.known)):
        rows = errors(run, path, relations, longest)
        raw, raw_turn, ours, turn = rows.mean(axis=0)
        cells.append(f"{raw:7.4f} {raw_turn:5.2f} {ours:7.4f} {turn:5.2f}")
    lag = "".join(f"; lag {lag:.3f} s" for lag in run.lags)
    nis, lost, doubtful = run.nis, run.share(Trust.LOST), run.share(Trust.DOUBTFUL)
    return f"{' | '.join(cells)} | {lost:5.2f} {doubtful:5.2f} | {nis:5.2f} | {run.loops}{lag}"


def drive(
    log: Path,
    ahead: float = 0.0,
    part: tuple[float, float] = (0.0, math.inf),
    settings: PerceptionSettings = SETTINGS,
    changed: str = AS_IT_IS,
    saved: SavedMap | None = None,
    *,
    keep: bool = False,
) -> Run:
    """Give a part of a log to perception, or of a copy of it that was changed: from and up to, s after its
    first event. `saved`: a map in which it begins; then from when on its place there was found; `keep`: also
    the files of its map."""
    perception = Perception(BODY, {"lidar": Mount(x=ahead)}, settings, saved=saved)
    run = Run([], [], [], [], [], [], 0.0, {}, "", ())
    anchors: list[Anchor | None] = []
    lidar, spent = Pose(ahead, 0.0, 0.0), 0.0
    known: Nanos = -1

    def note() -> None:
        estimate = perception.estimate
        assert estimate is not None, "wheels came first"
        if not perception.is_placed:
            return
        run.times.append(known)
        run.believed.append(moved(estimate.pose, lidar))
        anchors.append(perception.anchor(estimate.pose))
        run.rolled.append(moved(perception.raw, lidar))
        run.trust.append(perception.verdict.trust)
        run.spent.append(1e3 * spent)

    whole = list(events(log))
    whole = [one for one in whole if part[0] <= seconds(one.t - whole[0].t) <= part[1]]
    both = whole[0].t + whole[-1].t
    began = time.process_time()
    for event in CHANGES[changed](whole):
        if event.t != known and known >= 0:
            spent = time.process_time() - began  # once a scan: asking costs as much as a part of the work
            note()
            known, began = -1, time.process_time()
        perception.observe(event.t, [event])
        if isinstance(event, LaserScan):
            known = event.t
            for _ in range(PARTS):
                perception.observe(event.t, [])
    if keep:
        perception.settle()
    nis = perception.nis.get("lidar")
    anomalies = {reason: count for each in perception.anomalies.values() for reason, count in each.items()}
    known_now = [
        there if anchor is None else moved(perception.anchored(anchor), lidar)
        for there, anchor in zip(run.believed, anchors, strict=True)
    ]
    run = replace(
        run,
        known=known_now,
        nis=nis.mean if nis else 0.0,
        anomalies=anomalies,
        loops=perception.loops,
        lags=tuple(perception.lags.values()),
        anchors=anchors,
        files=mapped(perception) if keep else {},
        keyframes=perception.saved_keyframes(),
    )
    if changed == "mirrored":
        believed, known_now, rolled_on = map(turned_over, (run.believed, run.known, run.rolled))
        return replace(run, believed=believed, known=known_now, rolled=rolled_on)
    return replace(run, times=[both - t for t in run.times]) if changed == "backward" else run


def mapped(perception: Perception) -> dict[str, bytes]:
    """Return the files of a map."""
    drawn = Drawn(perception.map.view(), [])
    kept = keyframes_file(perception.saved_keyframes(), drawn.pgm())
    return {"map.pgm": drawn.pgm(), "map.keyframes": kept, "map.yaml": drawn.yaml("map.keyframes").encode()}


def halves(log: str, path: Path, relations: Path, ahead: float, settings: PerceptionSettings) -> None:
    """Print how right two halves of a log are, each by itself, and between them."""
    whole = [one.t for one in events(path)]
    middle = seconds(whole[-1] - whole[0]) / 2.0
    first = drive(path, ahead, (0.0, middle), settings, keep=True)
    saved = saved_map(first.files["map.yaml"].decode(), first.files, settings.map, None)
    second = drive(path, ahead, (middle, math.inf), settings, saved=saved, keep=True)
    found = seconds(second.times[0] - whole[0]) - middle
    print(
        f"{log}: {len(first.files['map.keyframes'])} bytes of keyframes; the second found after {found:.1f} s"
    )
    assert second.keyframes is not None, "it was placed"
    poses, lidar = second.keyframes.poses, Pose(ahead, 0.0, 0.0)
    known = [
        there if anchor is None else moved(moved(Pose(*poses[anchor.keyframe].tolist()), anchor.pose), lidar)
        for there, anchor in zip(first.believed, first.anchors, strict=True)
    ]
    both = replace(second, times=first.times + second.times, rolled=first.rolled + second.rolled)
    print(HEAD)
    for name, run in (("first", first), ("second", second)):
        print(f"{f'{log}, {name}, as it went':31}", text(errors(run, run.believed, relations)))
        print(f"{f'{log}, {name}, in the end':31}", text(errors(run, run.known, relations)))
    print(f"{f'{log}, first, after the second':31}", text(errors(first, known, relations)))
    for name, believed in (
        ("as it went", first.believed + second.believed), ("in the end", known + second.known)
    ):  # fmt: skip
        print(f"{f'{log}, both, {name}':31}", text(errors(both, believed, relations)))
    print(f"{log}: {second.loops}; {second.share(Trust.LOST):.2f} % lost", flush=True)


def turned_over(path: list[Pose]) -> list[Pose]:
    """Return a path with left for right."""
    return [Pose(one.x, -one.y, -one.yaw) for one in path]


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
        off_by: list[float] = []
        for one in (run.rolled, path):
            a, b = (one[i] for i in at)
            c, s = math.cos(a.yaw), math.sin(a.yaw)
            dx, dy = b.x - a.x, b.y - a.y
            off_by.append(math.hypot(c * dx + s * dy - x, c * dy - s * dx - y))
            off_by.append(math.degrees(abs(wrap(b.yaw - a.yaw - yaw))))
        found.append(off_by)
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
