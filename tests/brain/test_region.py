from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brain.region import about, joined, region_of

rows = st.integers(-(10**6), 10**6)
tiles = st.tuples(rows, rows)


@given(st.lists(tiles, min_size=1, max_size=5), tiles, st.integers(1, 10_000))
def test_a_region_about_a_tile_is_within_bounds_and_holds_it(
    some: list[tuple[int, int]], here: tuple[int, int], most: int
) -> None:
    whole = region_of(some)
    part = about(here, whole, most)
    assert 0 < len(part[0]) * len(part[1]) <= most
    for axis in (0, 1):
        assert {part[axis][0], part[axis][-1]} <= {*whole[axis]}
        assert (here[axis] in part[axis]) == (here[axis] in whole[axis])
    if len(whole[0]) * len(whole[1]) <= most:
        assert part == whole


@pytest.mark.parametrize(
    ("high", "wide", "expected"), [(20, 300, (20, 204)), (300, 10, (300, 10)), (500, 500, (64, 64))]
)
def test_a_long_region_stays_long(high: int, wide: int, expected: tuple[int, int]) -> None:
    part = about((5, 5), (range(high), range(wide)))
    assert (len(part[0]), len(part[1])) == expected


@given(st.lists(tiles, min_size=1, max_size=5))
def test_regions_grow_by_a_tile(some: list[tuple[int, int]]) -> None:
    region = None
    for tile in some:
        region = joined(region, tile)
    assert region == region_of(some)
