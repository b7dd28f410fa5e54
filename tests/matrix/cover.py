"""Which cells cover all pairs: greedily, the first of those that cover most that is not covered yet."""

from __future__ import annotations

from collections.abc import Iterable

from gateway.recording.matrix import Cell, Levels


def cover(levels: Levels, there: Iterable[Cell] = ()) -> list[Cell]:
    """Return cells that, with those that are there, cover every pair that can be; by their names."""
    left = set(levels.pairs())
    for cell in there:
        left -= cell.pairs
    found: list[Cell] = []
    order = [*levels.bad_days]
    cells = sorted(levels.cells(), key=lambda cell: _diagonal(levels, cell, order))
    while left:
        best = max(cells, key=lambda cell: len(left & cell.pairs))
        left -= best.pairs
        found.append(best)
    return sorted(found)


def _diagonal(levels: Levels, cell: Cell, order: list[str]) -> tuple[bool, int, int]:
    """Return the place of a cell: first a Latin square, whose cells have no pair in common."""
    language, body = [*levels.languages].index(cell.language), [*levels.bodies].index(cell.body)
    return order.index(cell.bad_day) != (language + body) % len(order), language, body
