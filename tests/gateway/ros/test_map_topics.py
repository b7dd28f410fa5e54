"""The map and its updates, taken as RViz takes them: what is shown is always the newest version, whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
import numpy.typing as npt
import pytest

from brain.belief import MapView
from brain.perception.lines import TILE
from gateway.recording.ros_views import MAP_PERIOD
from gateway.ros import map_topics
from gateway.ros.map_topics import BAND, MAP, UPDATE, UPDATES, WHOLE_PERIOD, MapTopics
from gateway.ros.types import decode
from protocols.messages import MILLISECOND, Nanos
from tests.gateway.view.test_foxglove_map import chart, expected

STEP: Nanos = 5 * MILLISECOND
BOTH = {MAP: 1, UPDATES: 1}


class Display:
    """RViz's display of a map: a map replaces all, an update its rectangle, and one outside is an error.

    Each step is of 5 ms."""

    def __init__(self) -> None:
        self.topics = MapTopics(self._take, 1_000)
        self.now: Nanos = 0
        self.cells: npt.NDArray[np.int8] = np.empty((0, 0), np.int8)
        self.sent: list[tuple[str, int]] = []
        """Topics, with how many cells each message had"""

    def _take(self, topic: str, data: bytes) -> None:
        if topic == MAP:
            grid = decode("nav_msgs/msg/OccupancyGrid", data)
            self.cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
        else:
            one = decode(UPDATE, data)
            assert one.header.frame_id == "map"
            assert 0 <= one.x <= one.x + one.width <= self.cells.shape[1]
            assert 0 <= one.y <= one.y + one.height <= self.cells.shape[0]
            part = one.data.reshape(one.height, one.width)
            self.cells[one.y : one.y + one.height, one.x : one.x + one.width] = part
            grid = one
        self.sent.append((topic, len(grid.data)))

    def step(self, view: MapView, takers: dict[str, int], steps: int = 1) -> None:
        for _ in range(steps):
            before = len(self.sent)
            self.topics.show(self.now, self.now, view, takers)
            assert len(self.sent) - before <= 1, "one message in a step"
            self.now += STEP

    def until_sent(self, view: MapView, takers: dict[str, int]) -> list[tuple[str, int]]:
        """Take a version in, and return what was sent for it."""
        self.sent.clear()
        self.step(view, takers, (MAP_PERIOD + MAP_PERIOD // 2) // STEP)
        return list(self.sent)


def versions(view: MapView, seed: int = 2) -> Iterator[MapView]:
    """Some tiles change with each version; one comes, and one goes."""
    rng = np.random.default_rng(seed)
    for version in range(2, 100):
        tiles = dict(view.tiles)
        keys = sorted(tiles)
        for i in rng.integers(0, len(keys), 3):
            tiles[keys[i]] = rng.integers(-128, 128, (TILE, TILE)).astype(np.int8)
        inner = [key for key in keys if key not in (keys[0], keys[-1])]
        del tiles[inner[version % len(inner)]]
        view = replace(view, version=version, tiles=tiles)
        yield view


@pytest.mark.parametrize(("rows", "columns", "factor"), [(5, 9, 1), (16, 32, 2)])
def test_updates_make_the_newest_version_of_the_map_before(rows: int, columns: int, factor: int) -> None:
    view, display = chart(rows, columns), Display()
    assert [topic for topic, _ in display.until_sent(view, BOTH)] == [MAP]
    assert (display.cells == expected(view, factor)).all()
    for newer in islice(versions(view), 4):
        sent = display.until_sent(newer, BOTH)
        assert {topic for topic, _ in sent} == {UPDATES}
        assert all(cells <= BAND for _, cells in sent)
        assert (display.cells == expected(newer, factor)).all()


def test_one_tile_that_changes_is_all_that_is_sent() -> None:
    view, display = chart(8, 16), Display()
    display.until_sent(view, BOTH)
    changed = replace(view, version=2, tiles={**view.tiles, (0, 10): np.full((TILE, TILE), 9, np.int8)})
    assert display.until_sent(changed, BOTH) == [(UPDATES, TILE**2)]
    assert display.until_sent(changed, BOTH) == []


@pytest.mark.parametrize("takers", [{MAP: 1}, {MAP: 2, UPDATES: 1}])
def test_who_takes_no_updates_gets_each_version_whole(takers: dict[str, int]) -> None:
    view, display = chart(5, 9), Display()
    display.until_sent(view, BOTH)
    assert display.until_sent(next(versions(view)), takers) == [(MAP, 45 * TILE**2)]


def test_a_map_that_grows_and_one_for_who_comes_and_from_time_to_time_is_whole() -> None:
    view, display = chart(5, 9), Display()
    display.until_sent(view, BOTH)
    grown = chart(6, 9, version=2)
    assert display.until_sent(grown, BOTH) == [(MAP, 54 * TILE**2)]
    display.topics.anew()
    assert display.until_sent(grown, BOTH) == [(MAP, 54 * TILE**2)]
    changing = versions(grown)
    assert display.until_sent(next(changing), BOTH)[0][0] == UPDATES
    display.now += WHOLE_PERIOD
    assert display.until_sent(next(changing), BOTH)[0][0] == MAP


def test_who_comes_while_a_version_is_drawn_or_sent_gets_it_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_topics, "BAND", TILE**2)
    view, display = chart(16, 8), Display()
    display.until_sent(view, BOTH)
    for steps, newer in zip((1, 2, 5, 9), versions(view), strict=False):
        display.step(newer, BOTH, MAP_PERIOD // STEP + steps)
        display.topics.anew()
        display.step(newer, BOTH, MAP_PERIOD // STEP)
        assert (display.cells == expected(newer, 1)).all()
