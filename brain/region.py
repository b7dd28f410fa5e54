"""A part of a plane of tiles that is small enough to lie in memory as one array."""

from __future__ import annotations

from collections.abc import Iterable
from math import isqrt
from typing import TypeAlias

Tile: TypeAlias = tuple[int, int]
"""Row and column: those of its cells, divided by the cells along its side"""
Region: TypeAlias = tuple[range, range]
"""Rows and columns of tiles"""

MOST = 4096
"""Tiles of a region: 205 m × 205 m, if they are of 64 × 64 cells of 5 cm"""


def region_of(tiles: Iterable[Tile]) -> Region:
    """Return the smallest region that holds all of these, at least one."""
    rows, columns = zip(*tiles, strict=True)
    return range(min(rows), max(rows) + 1), range(min(columns), max(columns) + 1)


def joined(region: Region | None, tile: Tile) -> Region:
    """Return the smallest region that holds a region and a tile."""
    if region is None:
        return region_of([tile])
    rows, columns = region
    return region_of([tile, (rows[0], columns[0]), (rows[-1], columns[-1])])


def about(here: Tile, region: Region, most: int = MOST) -> Region:
    """Return a region or, if it has more tiles than this, the part of it about one of them."""
    rows, columns = region
    high = min(len(rows), max(isqrt(most), most // len(columns)))
    wide = min(len(columns), most // high)
    return _part(rows, here[0], high), _part(columns, here[1], wide)


def _part(span: range, middle: int, length: int) -> range:
    first = min(max(middle - length // 2, span.start), span.stop - length)
    return range(first, first + length)
