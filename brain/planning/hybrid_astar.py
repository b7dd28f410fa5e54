"""Hybrid A*: paths of a footprint that has a heading, a bounded number of operations at a time.

Sources: Dolgov, Thrun, Montemerlo and Diebel 2008, "Practical search techniques in path planning for
autonomous driving", and 2010, IJRR 29(5).

Rules. A node is a pose; of all in one cell of the lattice (x, y, heading) the cheapest counts. What cannot
turn on the spot moves on arcs and straight lines, forward and backward; what can moves straight and turns.
The heuristic is the larger of the shortest way without obstacles (near the goal) and the cost to go of a
point on the grid, in cells twice as large, which exceeds the true one by at most 8.3 % (the octile metric).
From promising nodes the goal is tried in one go (analytic expansion). The search ends when no node can lead
to a path that is cheaper by `GOOD_ENOUGH`, or soon after the first path was found; that is then made shorter
by more such ways.
Equal queries have equal results; the state is plain data.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from math import atan2, floor, hypot, inf, pi, remainder

import numpy as np

from brain.belief import Floats, Pose
from brain.planning.astar import CellSearch, Searching, Unreachable
from brain.planning.reeds_shepp import Arc, lengths, poses
from brain.planning.snapshot import Halved
from brain.planning.ways import TURN_PRICE, Shortcuts, Way, Ways, WayShape, coordinates

GOOD_ENOUGH = 1.05
"""A path is taken if no other can be cheaper than by this factor."""
AFTER = 10
"""After so many more batches it is taken in any case."""
BATCH, BATCH_WORK = 16, 4000
"""Nodes expanded at once, at most; what that costs beside the poses, in expansions of A*"""
EVERY = 4
"""Batches from one try of the goal to the next, near it; more when farther away"""
BINS, COARSE = 72, 24
"""Headings of the lattice: of what moves on arcs, and of what turns on the spot"""
FREE_YAWS, NEAR = 8, 8.0
"""Headings tried at a goal that has none; radii from the goal from where on they matter"""
MOST_NODES = 60_000
"""After these there is no way."""


@dataclass(frozen=True, slots=True)
class _Node:
    pose: Pose
    cost: float
    parent: int
    gear: int
    """The last that was not 0."""
    move: int


class HybridSearch:
    """One search from a pose to a place; one without yaw is reached with any."""

    def __init__(self, ways: Ways, start: Pose, goal: tuple[float, float, float | None]) -> None:
        self.ways, self.start, self.goal = ways, start, goal
        self._field_work = 0
        self._pitch = max(2.0 * ways.ground.resolution, ways.radius / 8.0)
        self._bins = BINS if ways.radius else COARSE
        self._moves = _Moves(ways, self._pitch, 2.0 * pi / self._bins)
        self._ground = Halved(ways.ground)
        """For the cost to go"""
        self._field: CellSearch | None = None
        self._ahead: Floats = np.zeros(0)
        """m, cost to go of each cell"""
        self._nodes: list[_Node] = []
        self._open: list[tuple[float, int]] = []
        self._best: dict[int, float] = {}
        """m, the least cost of each cell of the lattice"""
        self._found: tuple[float, int, Way] | None = None
        """Cost of the best path, its last node, and the way from there."""
        self._tries: list[tuple[int, WayShape]] = []
        """Nodes, and ways from there to the goal that are not priced yet, the cheapest last"""
        self._batches = self._since = 0
        """In all, and since the first path was found."""
        self._short: Shortcuts | None = None
        self._result: Way | Unreachable | None = None

    @property
    def work(self) -> int:
        """Done so far, in expansions of A*."""
        return self.ways.work + self._field_work

    def advance(self, work: int) -> Way | Unreachable | Searching:
        """Continue for about this much work. Once finished, the result does not change."""
        end = self.work + work
        while self.work < end and self._result is None:
            if not self._nodes:
                self._spread(end - self.work)
            elif self._short is None:
                self._step()
            elif self._short.finished:
                self._result = self._short.way
            else:
                self._short.advance(self.ways)
        return Searching(self.work) if self._result is None else self._result

    # -- private ------------------------------------------------------------------------------

    def _spread(self, work: int) -> None:
        """Find the cost to go of each cell."""
        ground = self._ground
        if not ground.complete:
            self._field_work += work - ground.halve(work)
            return
        if self._field is None:
            here, there = ground.index(self.start.x, self.start.y), ground.index(*self.goal[:2])
            assert here is not None
            assert there is not None
            self._field = CellSearch(ground, there, here, spread=True)
        field, before = self._field, self._field.work
        outcome = field.advance(work)
        self._field_work += field.work - before + 1
        if isinstance(outcome, Unreachable):
            self._result = outcome
        elif not isinstance(outcome, Searching):
            most = min(field.most, float(field.cost.max()))
            self._ahead = np.where(field.cost > 0.0, field.cost, most) * ground.resolution
            self._best[self._key(self.start)] = 0.0
            self._push([_Node(self.start, 0.0, -1, 0, -1)])

    def _step(self) -> None:
        """Price one way to the goal; or expand a batch, and find ways to the goal from the best of it."""
        if self._tries:
            self._price(*self._tries.pop())
            return
        cheapest = self._open[0][0] if self._open else inf
        if self._found and (cheapest * GOOD_ENOUGH >= self._found[0] or self._since >= AFTER):
            self._short = Shortcuts(self.start, self._traced(self._found[1], self._found[2]))
            return
        if cheapest == inf or len(self._nodes) > MOST_NODES:
            self._result = Unreachable()
            return
        taken: list[int] = []
        while self._open and len(taken) < BATCH:
            number = heappop(self._open)[1]
            if self._nodes[number].cost <= self._best[self._key(self._nodes[number].pose)]:
                taken.append(number)
        self.ways.spend(BATCH_WORK)
        if taken:
            here = self._nodes[taken[0]].pose
            away = hypot(self.goal[0] - here.x, self.goal[1] - here.y)
            if self._batches % (EVERY * (1 + int(away / max(NEAR * self.ways.radius, 2.0)))) == 0:
                self._try(taken[0])
            self._batches += 1
            self._since += self._found is not None
            self._push(self._expanded(taken))

    def _try(self, number: int) -> None:
        """Find ways to the goal from a node in one go."""
        node, (x, y, yaw) = self._nodes[number], self.goal
        if yaw is not None:
            ends = [Pose(x, y, yaw)]
        elif self.ways.radius:
            ends = [Pose(x, y, 2.0 * pi * i / FREE_YAWS) for i in range(FREE_YAWS)]
        else:
            ends = [Pose(x, y, atan2(y - node.pose.y, x - node.pose.x))]
        tracks = self.ways.tracks(node.pose, ends, node.gear)
        self._tries = [(number, track) for track in reversed(tracks)]

    def _price(self, number: int, track: WayShape) -> None:
        """Take a way to the goal, if the path is cheaper with it than the best so far."""
        node, best = self._nodes[number], self._found[0] if self._found else inf
        if node.cost + track.price < best:
            way = self.ways.priced(track, node.gear)
            if node.cost + way.cost < best:
                self._found = node.cost + way.cost, number, way

    def _lengths(self, at: Floats, to: Floats) -> Floats:
        """Return the length of the shortest way from each pose to the goal with a heading [m]."""
        x, y, yaw = at
        dx, dy, c, s = self.goal[0] - x, self.goal[1] - y, np.cos(yaw), np.sin(yaw)
        return lengths(c * dx + s * dy, c * dy - s * dx, to - yaw, self.ways.radius)

    def _key(self, pose: Pose) -> int:
        column, row = floor(pose.x / self._pitch), floor(pose.y / self._pitch)
        turn = round(pose.yaw * self._bins / (2.0 * pi)) % self._bins
        return (row * (1 << 20) + column) * self._bins + turn

    def _expanded(self, numbers: list[int]) -> list[_Node]:
        """Return the nodes that are reached from these without a collision, and at less cost than before."""
        moves, nodes, prices = self._moves, [self._nodes[number] for number in numbers], self.ways.prices
        at = coordinates(node.pose for node in nodes)
        x, y, yaw = moves.from_(at)
        shape = x.shape
        cost = self.ways.factors(x.reshape(-1), y.reshape(-1), yaw.reshape(-1)).reshape(shape).mean(axis=2)
        cost *= moves.price
        from_, by = np.nonzero(cost < inf)
        ends = np.stack([x[:, :, -1], y[:, :, -1], yaw[:, :, -1]], axis=-1)[from_, by].tolist()
        found = []
        for i, move, (ex, ey, eyaw), price in zip(
            from_.tolist(), by.tolist(), ends, cost[from_, by].tolist(), strict=True
        ):
            gear, node = moves.gears[move], nodes[i]
            total = node.cost + price + (prices.switch if gear * node.gear < 0 else 0.0)
            end = Pose(ex, ey, remainder(eyaw, 2.0 * pi))
            if total < self._best.get(key := self._key(end), inf) - 1e-9:
                self._best[key] = total
                found.append(_Node(end, total, numbers[i], gear or node.gear, move))
        return found

    def _push(self, nodes: list[_Node]) -> None:
        """Open these nodes."""
        if not nodes:
            return
        at, ground = coordinates(node.pose for node in nodes).T, self._ground
        columns, rows = np.floor(at[:2] / ground.resolution).astype(np.int64)
        ahead = self._ahead[(rows - ground.corner[0]) * ground.stride + columns - ground.corner[1]]
        near = np.flatnonzero(ahead < NEAR * self.ways.radius)
        if len(near) and self.goal[2] is not None:
            to = np.full(len(near), self.goal[2])
            ahead[near] = np.maximum(ahead[near], self._lengths(at[:, near], to))
        for node, rest in zip(nodes, ahead.tolist(), strict=True):
            heappush(self._open, (node.cost + rest, len(self._nodes)))
            self._nodes.append(node)

    def _traced(self, number: int, last: Way) -> Way:
        """Return the whole way to the end of the last one, which begins at a node."""
        legs = [last]
        while (node := self._nodes[number]).parent >= 0:
            before = self._nodes[node.parent]
            moved = self._moves.from_(coordinates([before.pose]))
            track = np.stack([each[0, node.move] for each in moved], axis=1)
            gear, share = self._moves.gears[node.move], (node.cost - before.cost) / len(track)
            legs.append(Way(track, (gear,) * len(track), (share,) * len(track)))
            number = node.parent
        legs.reverse()
        return Way(
            np.concatenate([leg.poses for leg in legs]),
            tuple(gear for leg in legs for gear in leg.gears),
            tuple(cost for leg in legs for cost in leg.costs),
        )


class _Moves:
    """The moves from a node: poses by move and sample. Constant."""

    def __init__(self, ways: Ways, pitch: float, angle: float) -> None:
        length = max(1.5 * pitch, 1.01 * ways.radius * angle)
        count = max(2, round(length / (1.5 * ways.ground.resolution)))
        if ways.radius:
            bends = [(gear, bend / ways.radius) for gear in (1, -1) for bend in (0.0, 1.0, -1.0)]
            parts = [Arc(bend, gear * length) for gear, bend in bends]
            tracks = [poses(Pose(0.0, 0.0, 0.0), (part,), length / count)[0][1:] for part in parts]
            self.gears = tuple(gear for gear, _ in bends)
        else:
            shares = np.arange(1, count + 1) / count
            ends = ((length, 0.0, 0.0), (-length, 0.0, 0.0), (0.0, 0.0, angle), (0.0, 0.0, -angle))
            tracks = [np.multiply.outer(shares, end) for end in ends]
            self.gears = (1, -1, 0, 0)
        self._x, self._y, self._yaw = np.array(tracks).transpose(2, 0, 1)
        turn = angle * ways.footprint.shape.outer * TURN_PRICE
        prices = {1: length, -1: length * ways.prices.reverse, 0: turn}
        self.price: Floats = np.array([prices[gear] for gear in self.gears])

    def from_(self, at: Floats) -> tuple[Floats, Floats, Floats]:
        """Return x, y and yaw of each sample of each move from each of these poses."""
        x, y, yaw = at.T[:, :, None, None]
        c, s = np.cos(yaw), np.sin(yaw)
        return x + c * self._x - s * self._y, y + s * self._x + c * self._y, yaw + self._yaw
