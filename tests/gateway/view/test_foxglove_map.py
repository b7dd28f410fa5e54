"""The map as it is drawn for Foxglove: in slices, and coarser where it is large."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest

from brain.belief import MapView
from brain.perception.lines import TILE
from brain.perception.tiles import UNIT
from brain.region import MOST
from gateway.config import load_robot
from gateway.core.step import Gateway
from gateway.recording.ros_messages import UNKNOWN, occupancy, percent
from gateway.recording.ros_views import MAP_PERIOD, typestore
from gateway.view import Access, Address, Scene, View, foxglove_map, parse_address
from gateway.view.foxglove_map import Drawing, coarser
from protocols.messages import MILLISECOND
from tests.gateway.view.test_foxglove import App

GRID = "nav_msgs/msg/OccupancyGrid"


def chart(rows: int, columns: int, *, seed: int = 1, version: int = 1, corner: float = 0.0) -> MapView:
    """Return a map of so many tiles, of which every seventh is missing."""
    rng = np.random.default_rng(seed)
    places = [(row - 3, column + 2) for row in range(rows) for column in range(columns)]
    values = [rng.integers(-128, 128, (TILE, TILE)).astype(np.int8) * rng.integers(0, 2) for _ in places]
    tiles = {place: tile for i, (place, tile) in enumerate(zip(places, values, strict=True)) if i % 7 != 1}
    return MapView(version, 0.05, tiles, UNIT, (corner, -corner))


def drawn(drawing: Drawing, view: MapView, at: int = 0) -> int:
    """Draw until it is whole; return in how many steps."""
    for step in count(1):
        if drawing.draw(at, at, view):
            return step
    raise AssertionError


def expected(view: MapView, factor: int) -> Any:
    """Return the percents, from the whole map at once."""
    odds = view.log_odds
    rows, columns = odds.shape
    blocks = odds.reshape(rows // factor, factor, columns // factor, factor)
    most, least = blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3))
    return percent(np.where(most > 0, most, least))


def test_a_map_is_that_of_a_recording() -> None:
    view, drawing = chart(5, 9, corner=1.25), Drawing()
    drawn(drawing, view)
    whole: Any = occupancy(typestore().types, 0, view)
    assert drawing.cells.tobytes() == whole.data.tobytes()
    assert drawing.layout.origin == (view.origin_x, view.origin_y)
    assert drawing.layout.resolution == view.resolution


@pytest.mark.parametrize(
    ("rows", "columns", "factor"), [(8, 16, 1), (8, 17, 2), (16, 32, 2), (33, 16, 4), (64, 64, 8)]
)
def test_a_large_map_is_coarser(rows: int, columns: int, factor: int) -> None:
    view, drawing = chart(rows, columns), Drawing()
    assert rows * columns <= MOST
    drawn(drawing, view)
    assert drawing.cells.size <= foxglove_map.MAX_CELLS
    assert drawing.layout.resolution == pytest.approx(0.05 * factor)
    assert (drawing.cells == expected(view, factor)).all()


def test_of_the_cells_that_become_one_the_most_occupied_counts() -> None:
    tile = np.array([[[0, -3, 0, 0], [5, -9, 0, 0], [-1, -2, 0, 0], [-4, 0, 0, -1]]], np.int8)
    assert coarser(tile, 2).tolist() == [[[5, 0], [-4, -1]]]
    assert coarser(tile, 4).tolist() == [[[5]]]
    assert coarser(tile, 1) is not None
    assert (coarser(tile, 1) == tile).all()


def test_the_work_of_a_step_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    cells: list[int] = []

    def counted(tiles: Any, factor: int) -> Any:
        cells.append(tiles.size)
        return coarser(tiles, factor)

    monkeypatch.setattr(foxglove_map, "coarser", counted)
    view, drawing = chart(64, 64), Drawing()
    steps = drawn(drawing, view)
    assert len(cells) == steps == -(-len(view.tiles) // foxglove_map.TILES)
    assert max(cells) == foxglove_map.TILES * TILE**2
    cells.clear()
    changed = dict(view.tiles)
    changed[0, 10] = np.full((TILE, TILE), 9, np.int8)
    del changed[2, 6]
    after = replace(view, version=2, tiles=changed)
    assert not drawing.draw(MAP_PERIOD - 1, 0, after)
    assert drawing.draw(MAP_PERIOD, 7, after)
    assert cells == [TILE**2]  # what has changed, alone
    assert drawing.t == 7
    assert (drawing.cells == expected(after, 8)).all()


def test_a_version_is_drawn_to_its_end_and_then_the_newest() -> None:
    first, drawing = chart(8, 16), Drawing()
    second, third = chart(8, 16, seed=2, version=2), chart(8, 9, seed=3, version=3)
    assert not drawing.draw(0, 0, first)
    steps = drawn(drawing, second, at=3 * MAP_PERIOD)
    assert steps > 1
    assert drawing.t == 0
    assert (drawing.cells == expected(first, 1)).all()
    assert not drawing.draw(MAP_PERIOD // 2, 0, third)
    drawn(drawing, third, at=MAP_PERIOD)
    assert (drawing.cells == expected(third, 1)).all()
    assert not any(drawing.draw(at * MAP_PERIOD, 0, third) for at in range(2, 9))
    drawing.anew()
    assert drawing.draw(MAP_PERIOD, 0, third)
    assert (drawing.cells == UNKNOWN).any()


def test_a_client_gets_a_large_map_whole_and_again_when_it_has_changed() -> None:
    scene = Scene(Gateway(load_robot("diffbot")), "live", dict)
    view = chart(36, 40)  # 5.9 million cells
    with View([scene], Address(port=0), Access()) as served:
        app = App(parse_address(served.url.removeprefix("http://").rstrip("/")))
        times = count(0, 5 * MILLISECOND)

        def steps(most: int) -> None:
            for now, _ in zip(times, range(most), strict=False):
                served.poll(now)
                served.show(now)
                app.poll()

        steps(20)
        scene.belief = replace(scene.belief, map=view)
        app.subscribe("/map")
        steps(20 + len(view.tiles) // foxglove_map.TILES)
        steps(20)
        assert len(app.of("/map")) == 1
        scene.belief = replace(scene.belief, map=replace(view, version=2))
        steps(300)
        assert len(app.of("/map")) == 2
        message: Any = typestore().deserialize_cdr(app.of("/map")[-1][1], GRID)
        assert (message.info.width, message.info.height) == (40 * TILE // 4, 36 * TILE // 4)
        assert message.info.resolution == pytest.approx(0.2)
        assert message.data.tobytes() == expected(view, 4).tobytes()
        app.close()
