"""What a scan says about the pose: where it places the robot, how surely, and whether it may be trusted.

Rules. A scan is placed among the newest keyframes first (`keyframes`): they are near, and agree with one
another however far the map as a whole is off. From there it is matched with the map (`match`), which ties
the pose to what was drawn long ago; where the two contradict each other, and the keyframes know the scan
well, they are right: the map is bent there. How far the odometry is off is no reason to refuse a good
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
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, to_world
from brain.perception.consistency import CERTAIN, OUTLIER, POOR, Agreement
from brain.perception.filter_inputs import Nis, PoseFix
from brain.perception.keyframes import Keyframes, KeyframeSettings, Motion, Placed
from brain.perception.map import Map
from brain.perception.match import WINDOWS, Match, MatchSettings, examine, match
from protocols.messages import SECOND, Nanos

LOUDER, LOUDEST = 0.1, 25.0
"""Share of one innovation in the factor on the noise of matches, and its bound"""
WORSE, BEST, WORST = 0.05, 1e-4, 25.0
"""The same of the factor on what real odometry makes of a motion (`keyframes.Motion`), and its bounds: on
clean ground wheels are a hundred times better"""
STILL, STANDS = 0.002, SECOND
"""m, rad: who has moved by less between two scans, for this time, stands: odometry may come late"""
MOVED, TURNED = 0.15, 0.09
"""m and rad: a match this near to the believed pose may correct it; a farther one if the pose is as
uncertain,"""
SLIPPED, SPUN = 0.5, 0.35
"""or this near, if the base moves and the scan is certain: so far wheels may slip between two scans,"""
LIKELY = 0.5
"""or as near as real odometry is since the last match, if this share of the scan is on the keyframes."""
BENT, BENT_YAW = 0.05, 0.01
"""m, rad: a match with the map that is farther from that with the keyframes contradicts it"""
CLOSE, COVERED, CAME = 0.5, 0.4, 0.5
"""m: beams that end nearer; share of them that may; and of them the share that ends where the map is free,
below which the place is narrow, or new"""


class Told(NamedTuple):
    """What a scan tells."""

    agreement: Agreement
    fix: PoseFix | None
    """For the filter; None: no match, or one that may not correct it"""
    pose: Pose | None
    """Where the match places the robot"""


class Placing:
    """The keyframes, and what was learnt of the noise. Plain data: a deep copy continues exactly as the
    original."""

    def __init__(self, matching: MatchSettings, keyframes: KeyframeSettings) -> None:
        self.keyframes = Keyframes(keyframes)
        self._settings = matching
        self._loud: dict[str, float] = {}
        """Factor on the noise of matches, by lidar; so are the next"""
        self._worse: dict[str, float] = {}
        """Factor on what real odometry makes of a motion"""
        self._moved: dict[str, Nanos] = {}
        """Time of the newest scan before which the base moved"""
        self._at: dict[str, Pose] = {}
        """Where the robot was at the newest scan"""
        self.driven = self.turned = 0.0
        """m, rad: since a scan last corrected the pose"""

    def forget(self) -> None:
        """Forget the keyframes: the robot is elsewhere."""
        self.keyframes.forget()
        self._at.clear()
        self.driven = self.turned = 0.0

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
        *,
        doubtful: bool,
    ) -> Told:
        """Return what a scan tells about the pose that is believed at its end, with that one's covariance
        (3 × 3). `doubtful`: the scans before have disagreed."""
        pose, covariance = believed
        before = self._at.get(name, pose)
        motion = Motion(math.dist((before.x, before.y), (pose.x, pose.y)), wrap(pose.yaw - before.yaw))
        if motion.distance > STILL or abs(motion.turn) > STILL:
            self._moved[name] = t
        stands = t - self._moved.get(name, t - STANDS) >= STANDS
        self._at[name] = pose
        self.driven, self.turned = self.driven + motion.distance, self.turned + abs(motion.turn)
        odometry = motion.noise()
        placed = self.keyframes.place(scan, pose, odometry)
        found = self._tied(chart, scan, placed, pose, covariance, doubtful=doubtful)
        if found is None:
            return Told(Agreement(t, examine(chart, scan, pose), matched=False), None, None)
        share = placed.share if placed is not None else None
        offset = math.dist((found.pose.x, found.pose.y), (pose.x, pose.y))
        turn = abs(wrap(found.pose.yaw - pose.yaw))
        known = share is not None and share > POOR and not doubtful
        seen = None if known else examine(chart, scan, found.pose)
        slips = share is not None and share > CERTAIN and not stands
        far, wide = (SLIPPED, SPUN) if slips else (MOVED, TURNED)
        if share is not None and share > LIKELY:
            since = Motion(self.driven, self.turned).noise()
            far, wide = max(far, 3.0 * math.sqrt(since[0, 0])), max(wide, 3.0 * math.sqrt(since[2, 2]))
        near = offset < max(3.0 * math.sqrt(max(covariance[0, 0], covariance[1, 1])), far)
        near = near and turn < max(3.0 * math.sqrt(covariance[2, 2]), wide)
        agreement = Agreement(t, seen, True, near, offset, turn, share)
        if agreement.disagrees:
            return Told(agreement, None, found.pose)
        value = np.array([found.pose.x, found.pose.y, found.pose.yaw])
        loud, worse = self._noise(name, nis.get(name), stands=stands)
        drift = 0.0 * odometry if stands else worse * odometry
        fix = PoseFix(name, t, value, loud * found.noise, found.shared, drift)
        return Told(agreement, fix, found.pose)

    def _tied(
        self,
        chart: Map,
        scan: BodyScan,
        placed: Placed | None,
        pose: Pose,
        covariance: Floats,
        *,
        doubtful: bool,
    ) -> Match | Placed | None:
        """Return the match with the map; that with the keyframes where there is none, or one that
        contradicts."""
        settings = self._settings
        sigma = math.sqrt(max(covariance[0, 0], covariance[1, 1])) if placed is None else 0.0
        near = pose if placed is None else placed.pose
        found = match(chart, scan, near, max(sigma, settings.widest) if doubtful else sigma, settings)
        if placed is None or found is None:
            return placed or found
        bent = math.dist((found.pose.x, found.pose.y), (near.x, near.y)) > BENT
        bent = bent or abs(wrap(found.pose.yaw - near.yaw)) > BENT_YAW
        return placed if bent and placed.share > CERTAIN else found

    def _noise(self, name: str, nis: Nis | None, *, stands: bool) -> tuple[float, float]:
        """Return the factors on the noise of a lidar's matches, and on that of the motion."""
        loud, worse = self._loud.get(name, 1.0), self._worse.get(name, 1.0)
        if nis is not None and nis.window:
            distance, freedom = nis.window[-1]
            change = min(distance / freedom, OUTLIER) - 1.0
            if stands:
                loud = min(max(loud * (1.0 + LOUDER * change), 1.0), LOUDEST)
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


def is_covered(chart: Map, scan: BodyScan, pose: Pose) -> bool:
    """Return whether somebody covers too much of a scan for it to show a place."""
    close = np.flatnonzero(scan.hit & (scan.ranges < CLOSE))
    if len(close) <= COVERED * np.count_nonzero(scan.ranges > 0.0):
        return False
    chart.recenter(*scan.place(pose))
    cells, beside = chart.cells(to_world(scan.ends[close], pose)), WINDOWS[1]
    values = chart.values(cells[:, 0, None] + beside[0], cells[:, 1, None] + beside[1])
    came = (chart.values(cells[:, 0], cells[:, 1]) < 0) & ~(values > 0).any(axis=1)
    return float(came.mean()) > CAME
