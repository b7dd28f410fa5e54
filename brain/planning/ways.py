"""Ways of a footprint that has a heading: their cost, and the way from a pose to another in one go.

Rules. What cannot turn on the spot goes as Reeds and Shepp do; what can turns, goes straight, and turns
again. A metre costs the multiplier of the cell, times `reverse` backward; each change of direction costs
`switch`. A turn on the spot costs what the outline's farthest corner moves, times `TURN_PRICE`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, hypot, inf, pi, remainder
from typing import NamedTuple

import numpy as np

from brain.belief import Floats, Pose
from brain.planning.footprint import TURN_STEP, Footprint
from brain.planning.reeds_shepp import Arc, poses, words_to
from brain.planning.snapshot import Snapshot

AUTHORITY = 1.1
"""Turning radius that is planned with, over the body's: a follower must be able to turn more tightly."""
TRIED, ENDS = 2, 2
"""Words that are tried of each way, the cheapest first; ends, the soonest first"""
TURN_PRICE = 0.5
SAME = 1e-9
"""m, rad"""
POSE_WORK, WORDS_WORK = 14, 4500
"""A pose that is checked; all words between two: in expansions of A*."""
CHECKED, TINY = 50, 1e-12
"""Poses of a way that are checked together, the rest not if one is blocked; m of a step, at least"""
SHORTCUTS = 150
"""Ways that are tried to shorten a path"""
APART = 8
"""Poses of a path between two from which that is tried"""


@dataclass(frozen=True, slots=True)
class Prices:
    """What motion costs beside its length."""

    reverse: float = 2.0
    """A metre backward, over one forward"""
    switch: float = 0.5
    """m for each change between forward and backward"""


@dataclass(frozen=True, slots=True)
class Way:
    """Poses close to each other (n × 3: m, m, rad), without the first."""

    poses: Floats
    gears: tuple[int, ...]
    """Of the step to each: 1 forward, -1 backward, 0 a turn on the spot"""
    costs: tuple[float, ...]
    """m of the step to each"""

    @property
    def cost(self) -> float:
        """m, all of it"""
        return sum(self.costs)


class WayShape(NamedTuple):
    """A way before it is known what it costs here."""

    price: float
    """m, on open ground: at least"""
    poses: Floats
    """As those of `Way`, with the first"""
    gears: list[int]


class Ways:
    """What it costs to be and to move somewhere, of one query. State: the work done, in expansions of A*."""

    def __init__(self, ground: Snapshot, footprint: Footprint, prices: Prices) -> None:
        self.ground, self.footprint, self.prices = ground, footprint, prices
        self.radius = AUTHORITY * footprint.shape.turning_radius
        """m, of arcs; 0: it turns on the spot"""
        self.work = 0

    def spend(self, work: int) -> None:
        """Count work that is done for it elsewhere."""
        self.work += work

    def factors(self, x: Floats, y: Floats, yaw: Floats) -> Floats:
        """Return the cost of a metre at each of these poses; infinite where the footprint does not fit."""
        self.work += POSE_WORK * len(x)
        ground = self.ground
        rows, columns = (np.floor(at / ground.resolution).astype(np.int64) for at in (y, x))
        factor: Floats = ground.multiplier[ground.levels(rows, columns)]
        open_ = np.flatnonzero(factor < inf)
        hit = self.footprint.collides(ground, x[open_], y[open_], yaw[open_])
        factor[open_[hit]] = inf
        return factor

    def connect(self, start: Pose, end: Pose, gear: int) -> Way | None:
        """Return the cheapest way from a pose to another, of those that are cheapest on open ground; None
        if all of them are blocked. `gear` is the one before."""
        ways = [self.priced(track, gear) for track in self.tracks(start, (end,), gear)]
        best = min(ways, key=lambda way: way.cost)
        return best if best.cost < inf else None

    def tracks(self, start: Pose, ends: Sequence[Pose], gear: int) -> list[WayShape]:
        """Return ways that are cheapest on open ground, to each of the ends that are reached soonest."""
        step = 1.5 * self.ground.resolution
        if not self.radius:
            return [WayShape(0.0, *_turn_go_turn(start, end, step)) for end in ends[:ENDS]]
        self.work += WORDS_WORK
        tried = []
        for found in words_to(start, ends, self.radius, ENDS):
            cheapest = sorted((self._price(parts, gear), i) for i, parts in enumerate(found))[:TRIED]
            tried += [WayShape(price, *poses(start, found[i], step)) for price, i in cheapest]
        return tried

    def _price(self, parts: tuple[Arc, ...], gear: int) -> float:
        """Return what a path costs on open ground [m], after a gear."""
        moves = sum(
            -part.distance * self.prices.reverse if part.distance < 0.0 else part.distance for part in parts
        )
        gears = (gear, *(1 if part.distance > 0.0 else -1 for part in parts))
        return moves + self.prices.switch * sum(a * b < 0 for a, b in pairwise(gears))

    def priced(self, track: WayShape, gear: int) -> Way:
        """Return a way with what it costs here, infinite if it is blocked. `gear` is the one before."""
        (x, y, yaw), gears = track.poses.T, track.gears
        steps = np.hypot(np.diff(x), np.diff(y))
        turned = np.abs(np.diff(np.unwrap(yaw))) * self.footprint.shape.outer * TURN_PRICE
        kind = np.array(gears)
        steps = np.where(kind == 0, turned, steps * np.where(kind < 0, self.prices.reverse, 1.0))
        factors = np.full(len(x), inf)
        for first in range(1, len(x), CHECKED):
            part = slice(first, first + CHECKED)
            factors[part] = self.factors(x[part], y[part], yaw[part])
            if factors[part].max() == inf:
                break
        costs = (factors[1:] * np.maximum(steps, TINY)).tolist()
        for i, (before, after) in enumerate(pairwise((gear, *gears))):
            if before * after < 0:
                costs[i] += self.prices.switch
        return Way(track.poses[1:], tuple(gears), tuple(costs))


def coordinates(track: Iterable[Pose]) -> Floats:
    """Return poses as rows of numbers."""
    return np.array([(pose.x, pose.y, pose.yaw) for pose in track])


def _turn_go_turn(start: Pose, end: Pose, step: float) -> tuple[Floats, list[int]]:
    """Return the poses of a turn on the spot, a straight line, and another turn; and the gears."""
    far = hypot(end.x - start.x, end.y - start.y)
    way = atan2(end.y - start.y, end.x - start.x) if far > SAME else start.yaw
    first, last = _turn(start.yaw, way), _turn(way, end.yaw)
    count = 1 + int(far / step) if far > SAME else 0
    share = np.concatenate(
        [np.zeros(1 + len(first)), np.arange(1, count + 1) / max(count, 1), np.ones(len(last))]
    )
    yaw = np.concatenate([[start.yaw], first, np.full(count, way), last])
    track = np.stack([start.x + (end.x - start.x) * share, start.y + (end.y - start.y) * share, yaw], axis=1)
    return track, [0] * len(first) + [1] * count + [0] * len(last)


def _turn(before: float, after: float) -> Floats:
    """Return the headings of a turn on the spot, without the first."""
    turn = remainder(after - before, 2.0 * pi)
    count = 1 + int(abs(turn) / TURN_STEP) if abs(turn) > SAME else 0
    return before + turn * np.arange(1, count + 1) / max(count, 1)


class Shortcuts:
    """A way that is made shorter: ways in one go replace parts of it where they cost less. After `SHORTCUTS`
    of them the rest stays as it is."""

    def __init__(self, start: Pose, way: Way) -> None:
        self._given, self._start = way, start
        self._poses: list[Floats] = []
        self._gears: list[int] = []
        self._costs: list[float] = []
        self._at, self._ahead, self._left = 0, APART, SHORTCUTS
        """Poses of the given way that are done with; up to where the next shortcut would lead."""
        self._best: tuple[int, Way] | None = None

    @property
    def finished(self) -> bool:
        """True if the whole way was seen."""
        return self._at >= len(self._given.poses)

    @property
    def way(self) -> Way:
        """The way so far."""
        return Way(np.concatenate(self._poses), tuple(self._gears), tuple(self._costs))

    def advance(self, ways: Ways) -> None:
        """Try one shortcut."""
        given, last = self._given, len(self._given.poses)
        ahead = min(self._ahead, last)
        here = Pose(*self._poses[-1][-1].tolist()) if self._poses else self._start
        gear = next((each for each in reversed(self._gears) if each), 0)
        short = None
        if self._left > 0:
            self._left -= 1
            short = ways.connect(here, Pose(*given.poses[ahead - 1].tolist()), gear)
        usual = sum(given.costs[self._at : ahead])
        if short is not None and short.cost < usual - 1e-6:
            self._best = ahead, short
        if short is not None and ahead < last and short.cost < 1.5 * usual:
            self._ahead = ahead + APART
            return
        if self._best:
            at, taken = self._best
        else:
            at = min(self._at + APART, last)
            own = slice(self._at, at)
            taken = Way(given.poses[own], given.gears[own], given.costs[own])
        self._poses.append(taken.poses)
        self._gears += taken.gears
        self._costs += taken.costs
        self._at, self._ahead, self._best = at, at + 2 * APART, None
