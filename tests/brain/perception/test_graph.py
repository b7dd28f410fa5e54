"""The pose graph: what loops make of a path that drifts, and what a false one does not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brain.belief import Floats
from brain.perception.graph import Edge, Graph, Solution, after, between, inverse

SURE = np.diag([1 / 0.05**2, 1 / 0.05**2, 1 / 0.01**2])


def square(seed: int, count: int = 80) -> tuple[Graph, Floats, Floats]:
    """Twice around a square of 10 m: the graph without ties, the true poses, and those that drifted."""
    rng = np.random.Generator(np.random.PCG64(seed))
    true, believed, graph = [np.zeros(3)], [np.zeros(3)], Graph()
    for i in range(1, count):
        step = np.array([1.0, 0.0, math.pi / 2.0 if i % 10 == 0 else 0.0])
        true.append(after(true[-1], step))
        seen = after(step, rng.normal(size=3) * [0.03, 0.03, 0.01])
        graph.join(Edge(i - 1, i, seen, SURE))
        believed.append(after(believed[-1], seen))
    return graph, np.array(true), np.array(believed)


def tie(true: Floats, first: int, second: int) -> Edge:
    return Edge(first, second, between(true[first], true[second]), 4.0 * SURE)


def solved(graph: Graph, poses: Floats) -> Solution:
    solution = Solution(graph, poses)
    for _ in range(100):
        if solution.advance():
            return solution
    raise AssertionError("it does not end")


def error(poses: Floats, true: Floats) -> float:
    return float(np.hypot(*(poses - true)[:, :2].T).max())


def test_a_pose_and_its_inverse() -> None:
    a, b = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.25, -2.0])
    assert after(a, between(a, b)) == pytest.approx(b)
    assert after(a, inverse(a)) == pytest.approx(np.zeros(3), abs=1e-12)
    assert between(np.stack([a, b]), np.stack([b, a]))[1] == pytest.approx(between(b, a))


@pytest.mark.parametrize("seed", range(5))
def test_loops_mend_a_path_that_drifts(seed: int) -> None:
    graph, true, believed = square(seed)
    graph.ties += [tie(true, i - 40, i) for i in range(40, 80, 5)]
    solution = solved(graph, believed)
    assert solution.refused() is None
    assert error(solution.poses, true) < 0.4 * error(believed, true)
    assert solution.poses[0] == pytest.approx(believed[0], abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_false_loop_is_refused_and_pulls_nothing(seed: int) -> None:
    graph, true, believed = square(seed)
    graph.ties += [tie(true, i - 40, i) for i in range(40, 80, 5)]
    right = solved(graph, believed).poses
    false = Edge(3, 60, np.array([2.0, 3.0, 1.0]), 4.0 * SURE)
    graph.ties.append(false)
    solution = solved(graph, believed)
    while (refused := solution.refused()) is not None:
        graph.take_out(refused)
        solution = solved(graph, believed)
    assert len(graph.ties) >= 7
    assert all(edge is not false for edge in graph.ties)
    assert error(solution.poses, right) < 0.2


def test_a_group_that_is_forgotten_leaves_what_was_seen_from_it() -> None:
    graph, true, believed = square(1)
    graph.ties += [tie(true, i - 40, i) for i in range(40, 80, 5)]
    whole = solved(graph, believed).poses
    for group in (12, 40, 5, 41, 33):
        graph.remove(group)
    assert len(graph.groups) == 75
    assert len(graph.joins) == 74
    assert all({edge.first, edge.second} <= set(graph.groups) for edge in (*graph.joins, *graph.ties))
    kept = np.array(graph.groups)
    assert error(solved(graph, believed[kept]).poses, whole[kept]) < 0.15


def test_the_shortest_path_goes_through_loops() -> None:
    graph, true, _ = square(1)
    ways = np.arange(80.0)
    assert graph.lengths(ways)[0] == pytest.approx(79.0, abs=5.0)
    graph.ties += [tie(true, 0, 78)]
    lengths = graph.lengths(ways)
    assert lengths[0] == pytest.approx(2.0, abs=0.2)
    assert lengths[39] == pytest.approx(39.0, abs=5.0)
