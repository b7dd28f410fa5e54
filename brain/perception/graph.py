"""The pose graph: rigid groups of keyframes, what is known between them, and the poses that fit it best.

Rules. A few keyframes in a row are one rigid node: what drifts within them is far less than what loops
correct. An edge says where one group was seen from another, and how surely. Those between neighbours
(`joins`) are by odometry and matching; the others (`ties`) are loops, which may be false: each counts less
the more it contradicts the rest (Geman and McClure). Gauss-Newton, one assembly or one sparse solution at a
time, so that no step is long; the first group holds the frame. Sources: Grisetti et al. 2010 (a tutorial on
graph-based SLAM); Agarwal et al. 2013 (dynamic covariance scaling: the same kernel).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from brain.belief import Floats

DOUBT = 12.0
"""Squared Mahalanobis distance of a tie at which it counts a quarter"""
REFUSED = 0.1
"""Weight of a tie that speaks against the others, below which it is taken out"""
EASY = 2, 0.3
"""So many first steps, in which each tie counts at least this: all are far off before the first"""
SOLVED = 2e-3
"""m, rad: the largest change of a step after which there is no other"""
STEPS = 6
"""At most"""
HELD = 1e8
"""Information of the first group's pose"""
TIED = 1.0
"""m: length of a tie, as of a path"""
ALONG = np.arange(3)


class Edge(NamedTuple):
    """Where one group was seen from another."""

    first: int
    second: int
    pose: Floats
    """x, y, yaw of the second, in the frame of the first"""
    information: Floats
    """3 × 3, in the axes of the second"""


class Graph:
    """The groups' edges. Plain data."""

    def __init__(
        self, groups: Sequence[int] = (0,), joins: Sequence[Edge] = (), ties: Sequence[Edge] = ()
    ) -> None:
        self.groups = list(groups)
        """That there are, by number"""
        self.joins = list(joins)
        """From each group to the next"""
        self.ties = list(ties)
        self.lengths(np.zeros(len(self.groups)))  # the libraries are there before the first loop is

    def join(self, edge: Edge) -> None:
        """Add a group, seen from the newest one."""
        self.groups.append(edge.second)
        self.joins.append(edge)

    def remove(self, group: int) -> None:
        """Remove a group, neither the first nor the newest: what was seen from it is seen from the one
        before."""
        at = self.groups.index(group)
        to, onward = self.joins[at - 1 : at + 1]
        self.groups.pop(at)
        self.joins[at - 1 : at + 1] = [_joined(to, onward)]
        ties = []
        for tie in self.ties:
            if tie.first == group:
                tie = _joined(to, tie)
            elif tie.second == group:
                tie = _joined(
                    tie, Edge(group, to.first, inverse(to.pose), in_axes(to.information, -to.pose[2]))
                )
            if tie.first != tie.second:
                ties.append(tie)
        self.ties = ties

    def take_out(self, tie: Edge) -> None:
        """Take out a loop."""
        self.ties = [edge for edge in self.ties if edge is not tie]

    def lengths(self, ways: Floats) -> Floats:
        """Return the length of the shortest path in the graph [m] from the newest group to each; `ways`: m
        travelled up to each of them."""
        from scipy.sparse import csr_matrix  # here, because it takes half a second to import
        from scipy.sparse.csgraph import dijkstra

        count = len(ways)
        ends = np.array([(e.first, e.second) for e in self.ties], dtype=np.int64).reshape(-1, 2)
        ends = np.unique(np.searchsorted(self.groups, ends), axis=0)
        # neighbours' ties would be given twice: a sum, not the shorter
        ends = ends[np.abs(ends[:, 0] - ends[:, 1]) > 1]
        weights = np.concatenate([np.diff(ways) + 0.05, np.full(len(ends), TIED)])
        rows = np.concatenate([np.arange(count - 1), ends[:, 0]])
        columns = np.concatenate([np.arange(1, count), ends[:, 1]])
        paths = csr_matrix((weights, (rows, columns)), shape=(count, count))
        return np.asarray(dijkstra(paths, directed=False, indices=count - 1), dtype=np.float64)


def _joined(one: Edge, other: Edge) -> Edge:
    """Return the edge of one after the other."""
    lever = np.eye(3)
    lever[0, 2], lever[1, 2] = -other.pose[1], other.pose[0]
    spread = in_axes(lever @ np.linalg.inv(one.information) @ lever.T, float(other.pose[2]))
    spread = spread + np.linalg.inv(other.information)
    information: Floats = np.asarray(np.linalg.inv(spread), dtype=np.float64)
    return Edge(one.first, other.second, after(one.pose, other.pose), information)


class Solution:
    """The poses of the groups on their way to where they fit their edges best. Plain data."""

    def __init__(self, graph: Graph, poses: Floats) -> None:
        """`poses`: of the groups, n × 3."""
        self.poses = poses.copy()
        self.done = False
        self.moved = 0.0
        """m, rad: of the last step"""
        self._ties = list(graph.ties)
        edges = [*graph.joins, *self._ties]
        self._first = np.searchsorted(graph.groups, [e.first for e in edges])
        self._second = np.searchsorted(graph.groups, [e.second for e in edges])
        self._seen = np.array([e.pose for e in edges])
        self._information = np.array([e.information for e in edges])
        self._joins = len(poses) - 1
        self._weights: Floats = np.ones(len(edges))
        self._step = 0
        self._system: tuple[Floats, Floats] | None = None

    def advance(self) -> bool:
        """Do the next part: assemble the equations, or solve them. Return whether it is done."""
        if self._system is None:
            self._system = self._assembled()
        else:
            change = self._solved(*self._system)
            self.poses = self.poses + change
            self._system, self._step = None, self._step + 1
            self.moved = float(np.abs(change).max())
            self.done = self.moved < SOLVED or self._step >= STEPS
        return self.done

    def refused(self) -> Edge | None:
        """Return the tie that speaks most against the others, if one does: only without it is it known of the
        next whether they do, too."""
        weights = self._weights[self._joins :]
        if not len(weights) or weights.min() > REFUSED:
            return None
        return self._ties[int(weights.argmin())]

    def _assembled(self) -> tuple[Floats, Floats]:
        """Return the blocks of the normal equations, by edge, and their right side."""
        first, second, seen = self._first, self._second, self._seen
        X = self.poses
        c, s = np.cos(X[first, 2]), np.sin(X[first, 2])
        dx, dy = (X[second, :2] - X[first, :2]).T
        cz, sz = np.cos(seen[:, 2]), np.sin(seen[:, 2])
        # in the axes of the second, as it was seen: error, and its slopes by both poses
        ex, ey = c * dx + s * dy - seen[:, 0], -s * dx + c * dy - seen[:, 1]
        turn = X[second, 2] - X[first, 2] - seen[:, 2]
        turn = np.remainder(turn + math.pi, 2.0 * math.pi) - math.pi
        e = np.column_stack([cz * ex + sz * ey, -sz * ex + cz * ey, turn])
        c, s = cz * c - sz * s, cz * s + sz * c  # of both turns
        B = np.zeros((len(e), 3, 3))
        B[:, 0, 0], B[:, 0, 1], B[:, 1, 0], B[:, 1, 1], B[:, 2, 2] = c, s, -s, c, 1.0
        A = -B
        A[:, 0, 2], A[:, 1, 2] = -s * dx + c * dy, -c * dx - s * dy
        distance = np.einsum("ni,nij,nj->n", e, self._information, e)
        ties = slice(self._joins, None)
        self._weights[ties] = 1.0 / (1.0 + distance[ties] / DOUBT) ** 2
        weights = self._weights
        if self._step < EASY[0]:
            weights = weights.copy()
            weights[ties] = np.maximum(weights[ties], EASY[1])
        W = self._information * weights[:, None, None]
        At, Bt = A.transpose(0, 2, 1) @ W, B.transpose(0, 2, 1) @ W
        blocks = np.stack([At @ A, At @ B, Bt @ A, Bt @ B])
        right = np.zeros((len(X), 3))
        np.add.at(right, first, (At @ e[:, :, None])[:, :, 0])
        np.add.at(right, second, (Bt @ e[:, :, None])[:, :, 0])
        return blocks, right

    def _solved(self, blocks: Floats, right: Floats) -> Floats:
        """Return the change of all poses, n × 3."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.linalg import splu

        first, second, count = self._first, self._second, 3 * len(self.poses)
        rows = _places(np.concatenate([first, first, second, second]), columns=False)
        columns = _places(np.concatenate([first, second, first, second]), columns=True)
        values = np.concatenate([blocks.ravel(), np.full(3, HELD)])
        places = np.concatenate([rows, ALONG]), np.concatenate([columns, ALONG])
        equations: Any = coo_matrix((values, places), shape=(count, count)).tocsc()
        options = {"SymmetricMode": True}
        factors = splu(equations, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return np.asarray(factors.solve(-right.ravel()), dtype=np.float64).reshape(-1, 3)


def _places(groups: npt.NDArray[np.int64], *, columns: bool) -> npt.NDArray[np.int64]:
    """Return the rows, or columns, of the elements of 3 × 3 blocks, in order."""
    along = ALONG[None, None, :] if columns else ALONG[None, :, None]
    return np.broadcast_to(3 * groups[:, None, None] + along, (len(groups), 3, 3)).ravel()


# -- poses as arrays x, y, yaw ---------------------------------------------------------------------------


def after(a: Floats, d: Floats) -> Floats:
    """Return the pose at `d` in the frame of `a`; of arrays n × 3, each."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * d[..., 0] - s * d[..., 1]
    y = a[..., 1] + s * d[..., 0] + c * d[..., 1]
    return np.stack([x, y, _wrapped(a[..., 2] + d[..., 2])], axis=-1)


def between(a: Floats, b: Floats) -> Floats:
    """Return the pose `b` in the frame of `a`: the inverse of `after`."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, c * dy - s * dx, _wrapped(b[..., 2] - a[..., 2])], axis=-1)


def inverse(d: Floats) -> Floats:
    """Return the pose of a frame, seen from a pose that is at `d` in it."""
    return between(d, np.zeros(3))


def in_axes(matrix: Floats, yaw: float) -> Floats:
    """Return a 3 × 3 covariance or information in axes that are turned by this."""
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ matrix @ R.T, dtype=np.float64)


def _wrapped(yaw: Any) -> Any:  # noqa: ANN401 -- a float or an array
    return np.remainder(yaw + math.pi, 2.0 * math.pi) - math.pi
