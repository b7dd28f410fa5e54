"""What a scan says about the pose: where it places the robot, how surely, and whether it may be trusted.

Rules. A scan is placed among the newest keyframes (`keyframes`): they are near, and agree with one another
however far the map as a whole is off. What was drawn long ago has no say: it moves the pose as a loop that
closes, with all since (`loops`). Without keyframes, after the robot was found anew, a scan is matched with
the map (`match`). How far the odometry is off is no reason to refuse a good
match: real wheels slip by 5 to 20° within a second. What is learnt instead, within bounds, is how good the
odometry is: by the innovations of a base that moves; those of one that stands show how good the matches are.
A scan of which somebody covers too much shows no place: most of its beams end at once, at nothing that was
there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.body_scan import BodyScan, Bools, to_world
from brain.perception.consistency import CERTAIN, OUTLIER, POOR, Agreement
from brain.perception.filter_inputs import Nis, PoseFix
from brain.perception.graph import in_axes
from brain.perception.keyframes import NEW_GROUND, Keyframes, KeyframeSettings, Motion, Placed
from brain.perception.lag import Lag
from brain.perception.loops import GROUP, TORN, Loops, LoopSettings
from brain.perception.map import Map
from brain.perception.match import WINDOWS, Match, MatchSettings, examine, match
from brain.perception.saved_keyframes import SavedKeyframe, SavedKeyframes
from brain.perception.saved_map import SavedMap
from protocols.messages import SECOND, Nanos

LOUDER, QUIETER, QUIETEST, LOUDEST = 0.1, 0.01, 0.1, 25.0
"""Share of one innovation in the factor on the noise of matches, of a base that stands and of one that moves,
and its bounds"""
WORSE, BEST, WORST = 0.05, 1e-4, 25.0
"""The same of the factor on what real odometry makes of a motion (`keyframes.Motion`), and its bounds: on
clean ground wheels are a hundred times better"""
STILL, STANDS = 0.002, SECOND
"""m, rad: who has moved by less between two scans, for this time, stands: odometry may come late"""
MOVED, TURNED = 0.15, 0.09
"""m and rad: a match this near to the believed pose may correct it; a farther one if the pose is as
uncertain,"""
SLIPPED, SPUN = 0.5, 0.35
"""or this near, if the base moves and the scan is certain: so far wheels may slip between two scans, and as
far as they have turned,"""
FLOOR = np.diag([0.004**2, 0.004**2, 0.0015**2])
"""Covariance of a keyframe's pose from the one before, at least"""
TEARS = 20.0
"""By which its standard deviation grows with the share that a scan between them lacks: there it may tear"""
LIKELY = 0.5
"""or as near as real odometry is since the last match, if this share of the scan is on the keyframes."""
DROP, NEARBY = 0.3, 0.2
"""By how much less of a scan is on the keyframes than of one before it, within m and rad, the map is asked:
who was carried sees another place at once"""
CLOSE, COVERED, CLOSED, CAME = 0.5, 0.4, 0.85, 0.5
"""m: beams that end nearer; share of them that may, and that no map begins with; and of them the share that
ends where nothing was, below which the place is narrow, or new"""


class Told(NamedTuple):
    """What a scan tells."""

    agreement: Agreement
    fix: PoseFix | None
    """For the filter; None: no match, or one that may not correct it"""
    pose: Pose | None
    """Where the match places the robot"""
    placed: Placed | None = None
    """The same, among the keyframes"""


class Placing:
    """The keyframes, and what was learnt of the noise. Plain data: a deep copy continues exactly as the
    original."""

    def __init__(
        self,
        matching: MatchSettings,
        keyframes: KeyframeSettings,
        loops: LoopSettings,
        saved: SavedMap | None = None,
    ) -> None:
        self.keyframes = Keyframes(keyframes, saved)
        before = None if saved is None else saved.keyframes
        self.loops = Loops(loops, before)
        self._settings = matching
        self._loud: dict[str, float] = {}
        """Factor on the noise of matches, by lidar; so are the next"""
        self._worse: dict[str, float] = {}
        """Factor on what real odometry makes of a motion"""
        self._moved: dict[str, Nanos] = {}
        """Time of the newest scan before which the base moved"""
        self._at: dict[str, Pose] = {}
        """Where the robot was at the newest scan"""
        self._last: dict[str, tuple[Nanos, Pose]] = {}
        """Time of the newest scan, and where it was placed"""
        self._usual: dict[str, float] = {}
        """Share of the newest scan on the keyframes that did not disagree"""
        self.driven = self.turned = 0.0
        """m, rad: since a scan last corrected the pose"""
        ways = [one.way for one in self.keyframes.kept.values()]
        self._way = max(ways) + loops.away if ways else 0.0
        """m: travelled so far"""
        self._rolled: Floats = np.zeros((3, 3))
        """Covariance of the motion since the newest keyframe, by real odometry"""
        self._worst = 1.0
        """Least share of a scan on the keyframes since then"""
        self._torn = bool(ways)
        """The robot was carried since then"""

    def saved(self) -> SavedKeyframes:
        """Return the keyframes and their graph, in whole groups: what is kept later begins another one."""
        poses, graph = self.keyframes.poses, self.loops.graph
        poses = np.concatenate([poses, np.repeat(poses[-1:], -len(poses) % GROUP, axis=0)])
        kept = {
            number: SavedKeyframe(one.way, one.covariance, one.scan)
            for number, one in self.keyframes.kept.items()
        }
        return SavedKeyframes(poses, kept, tuple(graph.groups), tuple(graph.joins), tuple(graph.ties))

    def forget(self, *, carried: bool = True) -> None:
        """Forget the keyframes: the robot is elsewhere; `carried`: it was found there."""
        self.keyframes.forget_local()
        self.loops.forget_search()
        self._way, self._torn = self._way + self.loops.settings.away, True
        self._at.clear()
        self._last.clear()
        self._usual.clear()
        if carried:
            self.driven = self.turned = 0.0

    def shift(self, by: Pose) -> None:
        """Turn and shift the frame "map"."""
        self._at = {name: moved(by, pose) for name, pose in self._at.items()}
        self._last = {name: (t, moved(by, pose)) for name, (t, pose) in self._last.items()}

    def keep(
        self, pose: Pose, covariance: Floats, scan: BodyScan, static: Bools, told: Placed | None
    ) -> None:
        """Keep a scan that was taken at a pose, if it is the next keyframe; `static`: the beams that may be
        kept, `told`: where it was placed."""
        keyframes, share = self.keyframes, 0.0 if told is None else told.share
        if not keyframes.wants(pose, share) or not keyframes.add(pose, covariance, scan, static, self._way):
            return
        edge = TORN
        if told is not None and not self._torn:
            known = np.linalg.inv(told.noise) + np.linalg.inv(self._rolled)
            lacking = max(0.0, NEW_GROUND - self._worst)
            edge = (np.linalg.inv(known) + FLOOR) * (1.0 + TEARS * lacking) ** 2
        self.loops.added(keyframes, in_axes(edge, pose.yaw))
        self._rolled, self._worst, self._torn = np.zeros((3, 3)), 1.0, False

    def is_at(self, name: str, pose: Pose) -> None:
        """Take note of where the robot is believed to be, after the newest scan of a lidar has counted."""
        self._at[name], self.driven, self.turned = pose, 0.0, 0.0

    def tell(
        self,
        name: str,
        t: Nanos,
        scan: BodyScan,
        chart: Map,
        believed: tuple[Pose, Floats],
        nis: Mapping[str, Nis],
        lag: Lag,
        *,
        doubtful: bool,
        alone: bool,
    ) -> Told:
        """Return what a scan tells about the pose that is believed at its end, with that one's covariance
        (3 × 3). `lag`: what is known of the lidar's stamps; `doubtful`: the scans before have disagreed;
        `alone`: by the keyframes alone, since the map does not have this ground."""
        pose, covariance = believed
        before = self._at.get(name, pose)
        motion = Motion(math.dist((before.x, before.y), (pose.x, pose.y)), wrap(pose.yaw - before.yaw))
        if motion.distance > STILL or abs(motion.turn) > STILL:
            self._moved[name] = t
        stands = t - self._moved.get(name, t - STANDS) >= STANDS
        earlier, last = self._last.get(name, (t, pose))
        by = lag.motion(name, earlier, t)
        start = pose if by is None else moved(last, by)
        self._at[name] = pose
        self.driven, self.turned = self.driven + motion.distance, self.turned + abs(motion.turn)
        self._way += motion.distance
        odometry = motion.noise()
        self._rolled = self._rolled + odometry
        placed = self.keyframes.place(scan, start, odometry)
        if by is not None and (placed is None or placed.share < LIKELY):
            placed = self.keyframes.place(scan, pose, odometry)
        self._last[name] = t, start if placed is None else placed.pose
        found: Placed | Match | None = placed
        if found is None and not alone:
            found = self._found(chart, scan, pose, covariance, doubtful=doubtful)
        if found is None:
            return Told(Agreement(t, examine(chart, scan, pose), matched=False), None, None)
        share = placed.share if placed is not None else None
        self._worst = min(self._worst, share or 0.0)
        offset = math.dist((found.pose.x, found.pose.y), (pose.x, pose.y))
        turn = abs(wrap(found.pose.yaw - pose.yaw))
        usual = self._usual.get(name, 0.0) if share is not None else 0.0
        dropped = share is not None and share < usual - DROP and _is_nearby(motion)
        known = share is not None and share > POOR and not doubtful and not dropped
        seen = None if known else examine(chart, scan, found.pose)
        slips = share is not None and share > CERTAIN and not stands
        far, wide = (min(max(MOVED, self.driven), SLIPPED), SPUN) if slips else (MOVED, TURNED)
        if share is not None and share > POOR:
            since = Motion(self.driven, self.turned).noise()
            far, wide = max(far, 3.0 * math.sqrt(since[0, 0])), max(wide, 3.0 * math.sqrt(since[2, 2]))
        near = offset < max(3.0 * math.sqrt(max(covariance[0, 0], covariance[1, 1])), far)
        near = near and turn < max(3.0 * math.sqrt(covariance[2, 2]), wide)
        agreement = Agreement(t, seen, True, near, offset, turn, share, dropped)
        if agreement.disagrees:
            return Told(agreement, None, found.pose)
        self._usual[name] = share or 0.0
        value = np.array([found.pose.x, found.pose.y, found.pose.yaw])
        loud, worse = self._noise(name, nis.get(name), stands=stands)
        drift = motion.if_none() if stands else worse * odometry  # a gyro's bias turns who stands
        fix = PoseFix(name, t, value, loud * found.noise, found.shared, drift)
        return Told(agreement, fix, found.pose, placed)

    def _found(
        self, chart: Map, scan: BodyScan, pose: Pose, covariance: Floats, *, doubtful: bool
    ) -> Match | None:
        """Return the match of a scan with the map."""
        settings = self._settings
        sigma = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
        return match(chart, scan, pose, max(sigma, settings.widest) if doubtful else sigma, settings)

    def _noise(self, name: str, nis: Nis | None, *, stands: bool) -> tuple[float, float]:
        """Return the factors on the noise of a lidar's matches, and on that of the motion."""
        loud, worse = self._loud.get(name, 1.0), self._worse.get(name, 1.0)
        if nis is not None and nis.window:
            distance, freedom = nis.window[-1]
            change = min(distance / freedom, OUTLIER) - 1.0
            if stands:  # one place, again and again: that they agree is no proof
                loud = min(max(loud * (1.0 + LOUDER * change), min(loud, 1.0)), LOUDEST)
            elif worse <= BEST:
                loud = min(max(loud * (1.0 + QUIETER * change), QUIETEST), LOUDEST)
                worse *= 1.0 + WORSE * max(change, 0.0)
            else:
                worse = min(max(worse * (1.0 + WORSE * change), BEST), WORST)
        self._loud[name], self._worse[name] = loud, worse
        return loud, worse

    def stays(self, scan: BodyScan, pose: Pose) -> Placed | None:
        """Return the match of a scan with the keyframes, from before it was lost, if it shows that the
        robot is where it was believed to be; else None."""
        placed = self.keyframes.place(scan, pose, np.diag([MOVED, MOVED, TURNED]) ** 2)
        if placed is None or placed.share < CERTAIN:
            return None
        offset = math.dist((placed.pose.x, placed.pose.y), (pose.x, pose.y))
        return placed if offset < MOVED and abs(wrap(placed.pose.yaw - pose.yaw)) < TURNED else None


def _is_nearby(motion: Motion) -> bool:
    return motion.distance < NEARBY and abs(motion.turn) < NEARBY


def is_covered(chart: Map, keyframes: Keyframes, scan: BodyScan, pose: Pose) -> bool:
    """Return whether somebody covers too much of a scan for it to show a place: where most of its near ends
    are, the newest keyframes saw farther. The map soon has who came; it is asked where there are none."""
    close = np.flatnonzero(scan.hit & (scan.ranges < CLOSE))
    share = len(close) / max(int(np.count_nonzero(scan.ranges > 0.0)), 1)
    if share <= COVERED:
        return False
    ends = to_world(scan.ends[close], pose)
    if len(keyframes):
        return float(keyframes.seen_through(ends).mean()) > CAME
    if share > CLOSED:
        return True
    chart.recenter(*scan.place(pose))
    cells, beside = chart.cells(ends), WINDOWS[1]
    values = chart.values(cells[:, 0, None] + beside[0], cells[:, 1, None] + beside[1])
    came = (chart.values(cells[:, 0], cells[:, 1]) < 0) & ~(values > 0).any(axis=1)
    return float(came.mean()) > CAME
