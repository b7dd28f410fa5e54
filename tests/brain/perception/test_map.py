from __future__ import annotations

import copy
import math
import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from brain.belief import Pose
from brain.perception.body_scan import BodyScan, to_body, to_world
from brain.perception.lines import AREA, MAX_SCANS, PER_CELL, TILE, TURN, Lines
from brain.perception.map import FRACTION, MAX_RAY_CELLS, Map, MapSettings
from brain.perception.mount import Mount
from brain.perception.tiles import UNIT
from brain.region import MOST
from protocols.messages import LaserScan
from tests.brain.perception.office import MOUNTS, OFFICE, box, scan_at

HERE = Pose(0.0, 0.0, 0.0)
SURE = np.diag([1e-6, 1e-6, 1e-8])
SMALL = MapSettings(farthest=8.0)
EXACT = MapSettings(resolution=0.1, farthest=8.0, gap=0.0)
"""Without the gaps between beams"""
HIT, MISS, LOW, HIGH = (round(getattr(EXACT, name) / UNIT) for name in ("hit", "miss", "low", "high"))


def beams(*ranges: float, angle: float = 0.0, increment: float = 0.01, range_max: float = 8.0) -> BodyScan:
    return to_body(LaserScan("lidar", 0, angle, increment, 0.1, range_max, ranges), Mount())


def add(chart: Map, scan: BodyScan, pose: Pose = HERE) -> None:
    chart.add(pose, scan, SURE)


def seen(chart: Map, pose: Pose = HERE, walls: np.ndarray = OFFICE, mount: Mount = MOUNTS["lidar"]) -> Map:
    add(chart, to_body(scan_at(walls, pose, mount, 0), mount), pose)
    return chart


def value(chart: Map, x: float, y: float) -> int:
    chart.recenter(x, y)
    columns, rows = chart.cells(np.array([[x, y]])).T
    return int(chart.values(columns, rows)[0])


def everything(chart: Map, side: int = 8) -> np.ndarray:
    """All values of the tiles up to so many from the origin."""
    values = np.zeros((2 * side, TILE, 2 * side, TILE), np.int8)
    for row, column in np.ndindex(2 * side, 2 * side):
        tile = chart.tile(row - side, column - side)
        values[row, :, column] = 0 if tile is None else tile
    return values.reshape(2 * side * TILE, -1)


# -- the slow oracle ---------------------------------------------------------------------------


def line(start: np.ndarray, stop: np.ndarray) -> list[tuple[int, int]]:
    """Cells (row, column) from start to stop, one by one, without the last."""
    n = math.ceil(np.abs(stop - start).max())
    one = 1 << FRACTION
    return [
        (
            (math.floor(start[1] * one) + k * round((stop[1] - start[1]) * (one / n))) // one,
            (math.floor(start[0] * one) + k * round((stop[0] - start[0]) * (one / n))) // one,
        )
        for k in range(n)
    ]


def slow(settings: MapSettings, scans: list[tuple[Pose, BodyScan]]) -> dict[tuple[int, int], int]:
    """The same map, cell by cell in plain Python, without gaps."""
    values: dict[tuple[int, int], int] = {}
    for pose, scan in scans:
        start = to_world(np.array([scan.origin]), pose)[0] / settings.resolution
        stops = to_world(scan.ends, pose) / settings.resolution
        cells = [(math.floor(y), math.floor(x)) for x, y in stops]
        free = [bool(hit) and values.get(cell, 0) < 0 for hit, cell in zip(scan.hit, cells, strict=True)]
        hits = {cell for cell, hit in zip(cells, scan.hit, strict=True) if hit}
        agree = {c for i, c in enumerate(cells) if free[i] and any([*free, False][j] for j in (i - 1, i + 1))}
        passed = {c for i in range(len(stops)) if scan.ranges[i] for c in line(start, stops[i])}
        for cell in passed | hits:
            before = 0 if cell in agree else values.get(cell, 0)
            after = min(before + HIT, HIGH) if cell in hits else max(before - MISS, LOW)
            values[cell] = after or -1
    return values


@pytest.mark.parametrize("seed", range(3))
def test_the_map_equals_the_slow_one(seed: int) -> None:
    random = np.random.Generator(np.random.PCG64(seed))
    scans: list[tuple[Pose, BodyScan]] = []
    for _ in range(6):
        x, y, yaw = (float(n) for n in random.uniform([-1.0, -1.2, -3.0], [3.5, 2.0, 3.0]))
        scan = scan_at(OFFICE, Pose(x, y, yaw), MOUNTS["lidar"], 0, 0.02 * random.normal(size=180), beams=180)
        scans.append((Pose(x, y, yaw), to_body(scan, MOUNTS["lidar"], 8.0)))
    chart = Map(EXACT)
    for pose, swept in scans:
        add(chart, swept, pose)
    expected = slow(EXACT, scans)
    cells = np.array(list(expected))
    assert chart.values(cells[:, 1], cells[:, 0]).tolist() == list(expected.values()), f"seed {seed}"
    assert np.count_nonzero(everything(chart)) == len(expected) > 2000


# -- evidence ----------------------------------------------------------------------------------


def test_the_map_lasts_from_scan_to_scan() -> None:
    chart = seen(Map(SMALL))
    before, version = everything(chart), chart.version
    seen(chart, Pose(1.5, 1.0, 1.0))
    known = before != 0
    assert np.count_nonzero(everything(chart)) > np.count_nonzero(known) + 100
    assert (everything(chart)[known] != 0).all()
    assert chart.version > version


@pytest.mark.parametrize("mount", [Mount(), Mount(0.3, -0.1, yaw=1.2), Mount(-0.2, 0.0, yaw=math.pi)])
@pytest.mark.parametrize("pose", [HERE, Pose(1.0, 0.5, 2.5), Pose(5.5, 2.0, -1.0)])
def test_a_scan_lands_where_the_walls_are(mount: Mount, pose: Pose) -> None:
    chart = seen(Map(SMALL), pose, OFFICE, mount)
    rows, columns = np.nonzero(everything(chart) > 0)
    x, y = ((k - 8 * TILE + 0.5) * chart.resolution for k in (columns, rows))
    dx = np.maximum(OFFICE[:, [0, 2]].min(1) - x[:, None], x[:, None] - OFFICE[:, [0, 2]].max(1))
    dy = np.maximum(OFFICE[:, [1, 3]].min(1) - y[:, None], y[:, None] - OFFICE[:, [1, 3]].max(1))
    away = np.hypot(np.maximum(dx, 0.0), np.maximum(dy, 0.0)).min(axis=1)
    assert len(rows) > 150
    assert away.max() <= chart.resolution * math.sqrt(0.5) + 1e-9


def test_unknown_is_neither_free_nor_occupied() -> None:
    chart = seen(Map(SMALL))
    assert value(chart, 4.3, 3.0) == 0  # behind the wall between the rooms
    assert value(chart, 0.5, 0.0) < 0


def test_what_appears_is_occupied_at_once_and_what_went_is_cleared_after_a_known_number_of_scans() -> None:
    chart = Map(SMALL)
    room, screen = np.array(box(-2.0, -2.0, 3.0, 2.0)), np.array([(1.02, -0.5, 1.02, 0.5)])
    for _ in range(20):
        seen(chart, HERE, room)
    spots = [(1.02, y) for y in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    assert [value(chart, *spot) for spot in spots] == [round(SMALL.low / UNIT)] * 5
    seen(chart, HERE, np.concatenate([room, screen]))
    assert all(value(chart, *spot) > 0 for spot in spots)
    for _ in range(10):
        seen(chart, HERE, np.concatenate([room, screen]))
    for i in range(math.ceil(SMALL.high / SMALL.miss)):
        assert value(chart, 1.02, 0.0) > 0, f"gone after {i} scans"
        seen(chart, HERE, room)
    assert all(value(chart, *spot) < 0 for spot in spots)


def test_a_single_hit_in_free_ground_is_noise_until_it_comes_again() -> None:
    chart = Map(EXACT)
    for _ in range(10):
        add(chart, beams(4.0, 4.0, 4.0))
    add(chart, beams(4.0, 2.05, 4.0))
    assert value(chart, 2.05, 0.02) < 0
    for _ in range(2):
        add(chart, beams(4.0, 2.05, 4.0))
    assert value(chart, 2.05, 0.02) > 0


@pytest.mark.parametrize(
    ("distance", "range_max", "cleared", "hits"),
    [
        (2.05, 4.0, 20, 1),
        (99.0, 3.0, 30, 0),  # it meets nothing: cleared as far as it sees
        (99.0, 50.0, 80, 0),  # and as far as is used
        (0.05, 4.0, 0, 0),  # no reading
    ],
)
def test_a_beam_clears_its_way_and_marks_its_end(
    distance: float, range_max: float, cleared: int, hits: int
) -> None:
    chart = Map(EXACT)
    add(chart, beams(distance, range_max=range_max))
    expected = np.array([-MISS] * cleared + [HIT] * hits + [0] * (90 - cleared - hits))
    assert (chart.values(np.arange(90), np.zeros(90, np.int64)) == expected).all()
    assert np.count_nonzero(everything(chart)) == cleared + hits


def test_a_cell_counts_once_per_scan_within_its_bounds() -> None:
    """A hundred beams into one cell are one hit, and one of them passing through does not clear it."""
    chart = Map(EXACT)
    scan = beams(*(1.05,) * 50, 3.0, *(1.05,) * 50, angle=-0.005, increment=0.0001)
    add(chart, scan)
    assert (value(chart, 1.05, 0.0), value(chart, 0.5, 0.0)) == (HIT, -MISS)
    for _ in range(30):
        add(chart, scan)
    assert (value(chart, 1.05, 0.0), value(chart, 0.5, 0.0)) == (HIGH, LOW)


def test_a_known_cell_is_never_exactly_nought() -> None:
    """Hits and misses that cancel do not make a cell unknown again."""
    chart = Map(MapSettings(resolution=0.1, hit=0.5, miss=0.5))
    add(chart, beams(2.05))
    add(chart, beams(3.05))
    assert value(chart, 2.05, 0.0) < 0
    chart = Map(MapSettings(resolution=0.1, hit=0.5, miss=0.5))
    add(chart, beams(3.05))
    add(chart, beams(2.05))
    assert value(chart, 2.05, 0.0) < 0


def test_narrow_gaps_between_beams_become_free_in_turn() -> None:
    """At 6 m the beams of a lidar of 360 lie two cells apart: a goal between them is not unknown."""
    walls = np.array(box(-6.0, -6.0, 6.0, 6.0))
    inside = np.arange(-116, 116)
    unknown = []
    for gap in (0.0, 0.2):
        chart = Map(MapSettings(gap=gap))
        for _ in range(16):
            seen(chart, HERE, walls)
        unknown.append(int(np.count_nonzero(chart.values(inside, inside[:, None]) == 0)))
        assert value(chart, 6.2, 0.0) == 0
    assert unknown[0] > 5_000
    assert unknown[1] < unknown[0] / 20


def test_gaps_never_clear_and_wide_ones_or_those_behind_the_shorter_beam_stay_unknown() -> None:
    chart = Map(SMALL)
    add(chart, beams(5.0, angle=math.radians(0.5)))
    for _ in range(50):
        add(chart, beams(7.0, 7.0, angle=math.radians(-1.0), increment=math.radians(2.0)))
        add(chart, beams(2.0, 7.0, angle=1.0, increment=math.radians(1.0)))
        add(chart, beams(6.0, 6.0, angle=-2.0, increment=0.6))
    assert value(chart, 5.0 * math.cos(math.radians(0.5)), 5.0 * math.sin(math.radians(0.5))) > 0
    assert value(chart, 4.0, 0.0) < 0
    assert value(chart, 4.0 * math.cos(1.008), 4.0 * math.sin(1.008)) == 0
    assert value(chart, 3.0 * math.cos(-1.7), 3.0 * math.sin(-1.7)) == 0


def test_the_work_of_a_scan_is_bounded() -> None:
    chart = Map(MapSettings(resolution=0.01))
    scan = beams(*(7.5,) * 10_000, increment=2.0 * math.pi / 10_000)
    start, stops = np.zeros(2), scan.ends / 0.01
    assert 0.9 * MAX_RAY_CELLS < len(chart._rays(start, stops)) < 1.1 * MAX_RAY_CELLS
    add(chart, scan)
    columns, rows = chart.cells(scan.ends).T
    assert (chart.values(columns, rows) > 0).all()  # every hit counts


# -- tiles -------------------------------------------------------------------------------------

CORRIDOR = np.array(box(-1.0, -1.0, 150.0, 1.0) + [(x, 1.0, x, 0.6) for x in range(0, 150, 3)])
"""150 m"""


def driven(chart: Map, *ends: float) -> Map:
    """Along the corridor, from one of the places to the next."""
    for start, end in pairwise(ends):
        for x in np.arange(start, end, math.copysign(0.5, end - start)).tolist():
            pose = Pose(x + 0.0137, 0.0113, 0.01)
            add(chart, to_body(scan_at(CORRIDOR, pose, Mount(), 0, farthest=8.0), Mount(), 7.9), pose)
    return chart


def test_nothing_is_forgotten_on_a_long_way_and_back() -> None:
    """After 180 m the map is that of one whose window holds all of the corridor."""
    small, whole = (driven(Map(MapSettings(farthest=far)), 0.0, 90.0, 0.0) for far in (8.0, 95.0))
    assert small.settings.across * TILE * small.resolution < 30.0
    assert whole.settings.across * TILE * whole.resolution > 200.0
    assert small.forgotten == 0
    assert (everything(small, 32) == everything(whole, 32)).all()
    for x in (1.02, 88.02):
        cells = np.meshgrid(np.arange(20) + round(x / 0.05), np.arange(-25, 25))
        for chart in (small, whole):
            chart.recenter(x, 1.0)
        assert np.count_nonzero(small.lines_at(*cells)["scans"]) > 10
        assert (small.lines_at(*cells) == whole.lines_at(*cells)).all()


def test_of_too_many_tiles_the_farthest_is_forgotten() -> None:
    few, whole = (driven(Map(replace(SMALL, tiles=count)), 0.0, 140.0) for count in (64, 4096))
    gone = {*whole.known()} - {*few.known()}
    assert len(few.known()) == 64
    assert len(gone) == few.forgotten > 20
    assert max(column for _, column in gone) <= min(column for _, column in few.known())
    assert {at for at in few.changed(0) if few.tile(*at) is None} == gone
    assert {*few.view().tiles} == {*few.known()}
    assert value(few, 1.0, 1.02) == drawn(few, 1.5, 1.02)[3] == 0
    assert value(few, 139.0, 1.02) == value(whole, 139.0, 1.02) > 0
    driven(few, 5.0, 0.0)  # seen again
    assert value(few, 1.0, 1.02) > 0
    assert drawn(few, 1.5, 1.02)[3] > 0
    assert value(few, 139.0, 1.02) == 0


@pytest.mark.parametrize("far", [500.0, -3e5, 8e5])
def test_the_plane_has_no_border(far: float) -> None:
    chart, walls = Map(SMALL), np.array(box(-2.0, -2.0, 3.0, 2.0))
    seen(chart, HERE, walls)
    before = everything(chart)
    seen(chart, Pose(far, far, 0.0), walls + far)
    assert value(chart, far + 3.02, far) > 0
    assert value(chart, far + 2.0, far) < 0
    assert (everything(chart) == before).all()
    view = chart.view()
    assert view.log_odds.size <= MOST * AREA
    assert (view.log_odds > 0).any()


def test_changed_tells_the_tiles_whose_classes_changed() -> None:
    random = np.random.Generator(np.random.PCG64(3))
    chart = Map(SMALL)
    for _ in range(30):
        before, version = np.sign(everything(chart)), chart.version
        x, y, yaw = (float(n) for n in random.uniform([-1.0, -1.2, -3.0], [2.5, 2.0, 3.0]))
        seen(chart, Pose(x, y, yaw))
        rows, columns = np.nonzero(np.sign(everything(chart)) != before)
        tiles = {(r // TILE - 8, c // TILE - 8) for r, c in zip(rows.tolist(), columns.tolist(), strict=True)}
        assert set(chart.changed(version)) >= tiles
        assert len(chart.changed(version)) <= len(tiles) + 2  # cells that changed, and back in the same scan
    assert chart.changed(chart.version) == []


def test_tiles_and_view_show_the_same_values() -> None:
    chart = seen(Map(SMALL), Pose(-0.5, 0.5, 0.3))
    view = chart.view()
    top, left = round(view.origin_y / 0.05), round(view.origin_x / 0.05)
    rows, columns = view.log_odds.shape
    values = chart.values(np.arange(left, left + columns), np.arange(top, top + rows)[:, None])
    assert (view.log_odds == values * np.float32(UNIT)).all()
    assert view is chart.view()
    assert np.count_nonzero(values) == np.count_nonzero(everything(chart))
    for row, column in chart.changed(0):
        tile = chart.tile(row, column)
        assert tile is not None
        inner = np.arange(TILE)
        assert (tile == chart.values(column * TILE + inner, (row * TILE + inner)[:, None])).all()
        tile[0, 0] = 1 - tile[0, 0]  # it is a copy
        assert np.count_nonzero(chart.tile(row, column) != tile) == 1
    for x in (-0.5, -0.4, 0.3):
        seen(chart, Pose(x, 0.5, 0.3))
        later = chart.view()
        assert all((tile == chart.tile(*at)).all() for at, tile in later.tiles.items())
        assert {*later.tiles} == {*chart.changed(0)}
    assert later.tiles[0, 0] is not view.tiles[0, 0]
    before, tiles = chart.version, chart.changed(0)
    chart.forget()
    assert chart.changed(before) == tiles
    assert not chart.view().log_odds.any()
    assert (view.log_odds == values * np.float32(UNIT)).all()


def test_a_copy_continues_as_the_original() -> None:
    one = seen(Map(SMALL))
    two = copy.deepcopy(one)
    for chart in (one, two):
        for x in (0.0, 0.5, 9.0):
            seen(chart, Pose(x, 0.0, x))
    assert (everything(one) == everything(two)).all()
    cells = np.meshgrid(np.arange(-40, 200), np.arange(-40, 110))
    assert (one.lines_at(*cells) == two.lines_at(*cells)).all()


def test_memory_is_bounded() -> None:
    """As many tiles as there may be, every cell observed and lines wherever they may be."""
    tracemalloc.start()
    chart = Map(MapSettings(farthest=95.0))
    side = chart.settings.across * TILE
    places = AREA + np.arange(side * side // 256) * 256
    tiles = np.arange(chart.settings.across**2)
    chart._placed(tiles, np.zeros_like(tiles))
    normals = np.tile(np.eye(1, 2), (len(places), 1))
    blocks = (places & -AREA) + (places >> 8 & 15) // 4 * 16 * TILE + (places >> 8 & 3) * 16
    for some in np.array_split(blocks, 16):
        chart.lines.draw(some, np.zeros((len(some), 2)), normals[: len(some)], HERE, SURE)
    chart._values[AREA:] = -5
    chart._stamps[1:] = chart._touched[1:] = chart.version = 1
    assert len(chart.view().tiles) == len(chart.known()) == 4096
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert 20e6 < held < 100e6
    assert np.count_nonzero(chart.lines.at(blocks)["scans"]) == len(blocks) * 3 // 8 - 1


# -- lines -------------------------------------------------------------------------------------


def drawn(chart: Map, x: float, y: float) -> tuple[float, float, float, int]:
    """x and y of the point of a cell's line nearest to its centre, direction of its normal, scans."""
    columns, rows = chart.cells(np.array([[x, y]])).T
    chart.recenter(x, y)
    found = chart.lines_at(columns, rows)[0]
    angle, offset = found["angle"] * TURN, found["offset"] / PER_CELL
    middle = (
        np.array([columns[0], rows[0]]) + 0.5 + offset * np.array([np.cos(angle), np.sin(angle)])
    ) * 0.05
    return float(middle[0]), float(middle[1]), float(angle), int(found["scans"])


def test_lines_are_finer_than_cells_and_belong_to_the_first_scans() -> None:
    chart, room = Map(SMALL), np.array(box(-2.0, -2.0, 2.013, 2.0))
    seen(chart, HERE, room)
    x, _, angle, scans = drawn(chart, 2.013, 0.0)
    assert scans == 1
    assert x == pytest.approx(2.013, abs=1e-4)
    assert abs(angle) == pytest.approx(math.pi, abs=1e-3)
    scan = to_body(scan_at(room, HERE, MOUNTS["lidar"], 0), MOUNTS["lidar"])
    for _ in range(MAX_SCANS):
        add(chart, scan, Pose(0.01, 0.0, 0.0))
    x, _, _, scans = drawn(chart, 2.013, 0.0)
    assert scans == MAX_SCANS
    assert x == pytest.approx(2.013 + 0.01 * (MAX_SCANS - 1) / MAX_SCANS, abs=1e-4)
    add(chart, scan, Pose(0.005, 0.0, 0.0))
    assert drawn(chart, 2.013, 0.0)[0] == pytest.approx(x)


def test_a_line_keeps_the_side_it_was_seen_from_and_goes_with_its_cell() -> None:
    chart, wall = Map(SMALL), np.array([(1.02, -2.0, 1.02, 2.0)])
    seen(chart, HERE, wall)
    before = drawn(chart, 1.02, 0.0)
    seen(chart, Pose(2.0, 0.0, 0.0), wall)
    assert drawn(chart, 1.02, 0.0) == before
    for _ in range(20):
        seen(chart, HERE, wall + np.array([2.0, 0.0, 2.0, 0.0]))
    assert drawn(chart, 1.02, 0.0)[3] == 0


def test_anchors_are_where_new_lines_were_drawn() -> None:
    lines = Lines(4)
    lines.extend(2 * AREA)

    def draw(row: int, x: float, sigma: float) -> int:
        places, normals = AREA + row * TILE + np.arange(10), np.tile([0.0, 1.0], (10, 1))
        lines.draw(places, np.zeros((10, 2)), normals, Pose(x, 0.0, 0.0), np.eye(3) * sigma**2)
        return int(lines.at(places)["anchor"][0])

    assert [draw(row, x, 0.1) for row, x in enumerate((0.0, 0.2, 0.4, 0.5, 0.8))] == [0, 0, 1, 1, 2]
    assert draw(0, 5.0, 0.3) == 0  # an old line keeps its own
    assert lines.poses[2].tolist() == [0.8, 0.0, 0.0]
    assert lines.covariances[2] == pytest.approx(np.eye(3) * 0.01)
