"""The shortest path of a disc among convex polygons, exact up to the corners' roundness: an oracle of
planners.

A visibility graph: its nodes lie on arcs about the polygons' corners, at the disc's radius; its edges are the
straight lines along which the disc touches nothing; its shortest path is SciPy's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from gateway.sim.mjcf import Polygon

ROUND = 12
"""Nodes about a corner: the path is at most 1 / cos(pi / 12) times as long as round the arcs
themselves."""
Point = tuple[float, float]


def shortest(polygons: Sequence[Polygon], start: Point, end: Point, radius: float) -> float:
    """Return the length [m]; inf if there is no way."""
    edges = np.array([(*a, *b) for p in polygons for a, b in zip(p, p[1:] + p[:1], strict=True)])
    far = radius / math.cos(math.pi / ROUND) + 1e-9
    turns = [2.0 * math.pi * i / ROUND for i in range(ROUND)]
    corners = [(x, y) for polygon in polygons for x, y in polygon]
    nodes = [start, end, *((x + far * math.cos(a), y + far * math.sin(a)) for x, y in corners for a in turns)]
    free = [node for node in nodes if _clear(edges, np.array([[*node, *node]]), radius)[0]]
    if free[:2] != [start, end]:
        return math.inf
    places = np.array(free)
    i, j = np.triu_indices(len(free), 1)
    lines = np.hstack([places[i], places[j]])
    clear = np.concatenate(
        [_clear(edges, part, radius) for part in np.array_split(lines, len(lines) // 2000 + 1)]
    )
    lengths = np.hypot(*(places[i] - places[j]).T)[clear]
    graph = csr_matrix((lengths, (i[clear], j[clear])), shape=(len(free), len(free)))
    return float(dijkstra(graph, directed=False, indices=0)[1])


def _clear(edges: np.ndarray, lines: np.ndarray, radius: float) -> np.ndarray:
    """Return for each line (x0 y0 x1 y1) whether it keeps the distance from all edges."""
    a, b = lines[:, None, :2], lines[:, None, 2:]
    c, d = edges[None, :, :2], edges[None, :, 2:]
    near = np.minimum.reduce([_to(a, c, d), _to(b, c, d), _to(c, a, b), _to(d, a, b)])
    crossed = (_side(a, b, c) * _side(a, b, d) < 0.0) & (_side(c, d, a) * _side(c, d, b) < 0.0)
    clear: np.ndarray = (~crossed & (near >= radius - 1e-9)).all(axis=1)
    return clear


def _side(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
    side: np.ndarray = (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        p[..., 0] - a[..., 0]
    )
    return side


def _to(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of points from segments."""
    along = b - a
    square = np.maximum((along**2).sum(axis=-1), 1e-18)
    share = np.clip(((p - a) * along).sum(axis=-1) / square, 0.0, 1.0)
    foot: np.ndarray = np.hypot(*np.moveaxis(p - a - share[..., None] * along, -1, 0))
    return foot
