"""A robot begins in a map from before: its cells, and where it finds itself in them."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.perception.consistency import Trust
from brain.perception.map import Map, MapSettings
from brain.perception.perception import Perception
from brain.perception.saved_map import Drawing, SavedMap, Start
from protocols.bounds import Invalid
from tests.brain.perception.office import BODY, MOUNTS, OFFICE, SETTINGS, Rover, _towards

FREE, OCCUPIED, UNKNOWN = 0, 100, -1


def drawn(resolution: float = 0.05, yaw: float = 0.0) -> Drawing:
    """The office as a person draws it: walls of one cell, all inside free; turned about its corner."""
    low, size = np.array([-2.0, -2.2]), (math.ceil(12.0 / resolution), math.ceil(8.0 / resolution))
    percents = np.full(size[::-1], UNKNOWN, dtype=np.int8)
    (left, bottom), (right, top) = (np.floor((corner - low) / resolution).astype(int) for corner in INSIDE)
    percents[bottom:top, left:right] = FREE
    for x0, y0, x1, y1 in OFFICE.tolist():
        along = np.linspace(0.0, 1.0, math.ceil(3.0 * math.dist((x0, y0), (x1, y1)) / resolution))
        at = np.column_stack([x0 + along * (x1 - x0), y0 + along * (y1 - y0)]) - low
        columns, rows = np.floor(at / resolution).astype(int).T
        percents[rows, columns] = OCCUPIED
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = low.tolist()
    return Drawing(percents, resolution, (c * x - s * y, s * x + c * y, yaw))


INSIDE = np.array([-1.5, -1.7]), np.array([9.5, 5.3])


def saved(drawing: Drawing, start: Start | None = None) -> SavedMap:
    return SavedMap(drawing, 0.05, -2.0, 3.5, start)


def kinds(chart: Map) -> Floats:
    """-1 free, 0 unknown, 1 occupied: the 160 x 240 cells of the drawing."""
    view = chart.view()
    row, column = round((-2.2 - view.origin_y) / 0.05), round((-2.0 - view.origin_x) / 0.05)
    padded = np.pad(np.sign(view.log_odds.astype(np.float64)), ((0, 240), (0, 240)))
    return padded[row : row + 160, column : column + 240]


def test_of_the_same_resolution_it_is_the_same_cells_again_when_all_is_forgotten() -> None:
    percents = drawn().percents
    chart = Map(MapSettings(), saved(drawn()))
    expected = np.where(percents == OCCUPIED, 1, np.where(percents == FREE, -1, 0))
    assert (kinds(chart) == expected).all()
    chart.forget()
    assert (kinds(chart) == expected).all()
    assert (kinds(chart.anew()) == expected).all()
    assert copy.deepcopy(chart)._saved is chart._saved


@pytest.mark.parametrize(("resolution", "yaw"), [(0.02, 0.0), (0.1, 0.0), (0.05, 0.4), (0.03, -2.0)])
def test_of_another_resolution_or_turned_no_wall_is_lost(resolution: float, yaw: float) -> None:
    made = Map(MapSettings(), saved(drawn(resolution, yaw))).view()
    c, s = math.cos(yaw), math.sin(yaw)
    for x0, y0, x1, y1 in OFFICE.tolist():
        for share in (0.1, 0.5, 0.9):
            x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
            row, column = (
                math.floor((at - origin) / 0.05)
                for at, origin in ((s * x + c * y, made.origin_y), (c * x - s * y, made.origin_x))
            )
            assert (made.log_odds[row - 1 : row + 2, column - 1 : column + 2] > 0).any()


def test_surfaces_lie_on_the_walls_and_face_where_it_is_free() -> None:
    one = saved(drawn())
    points, normals = one.near(0.0, 0.0, 30.0)
    x0, y0, x1, _ = OFFICE.T
    upright = x0 == x1
    off = np.where(upright, np.abs(points[:, :1] - x0), np.abs(points[:, 1:] - y0))
    assert np.quantile(off.min(axis=1), 0.9) < 0.03
    left = points[np.abs(points[:, 0] + 1.5) < 0.05], normals[np.abs(points[:, 0] + 1.5) < 0.05]
    assert len(left[0]) > 30
    assert np.median(left[1][:, 0]) > 0.99
    assert len(one.near(0.0, 0.0, 2.0)[0]) < len(points) / 3


@pytest.mark.parametrize(
    "start",
    [Start(5.4, 0.7, 2.3, sigma=0.4), None],
    ids=["0.3 m and 9° off", "not stated"],
)
def test_it_is_where_it_is_in_the_map(start: Start | None) -> None:
    """Two rooms; it begins in the second one, and drives 5 m, which are not on its own map."""
    rover = Rover(2)
    rover.truth = Pose(5.2, 0.9, 2.15)
    perception = Perception(BODY, MOUNTS, SETTINGS, saved=saved(drawn(), start))
    goals, speeds, off = [(5.2, 2.2), (8.2, 2.3), (8.3, 0.2)], (0.0, 0.0), list[float]()
    trusts = [perception.verdict.trust]
    while goals:
        perception.observe(rover.now, rover.step(*speeds))
        here = perception.estimate
        if perception.verdict.trust is not trusts[-1]:
            trusts.append(perception.verdict.trust)
        if here is None or len(off) < 400:
            off.append(1.0)
            continue
        off.append(math.dist((here.pose.x, here.pose.y), (rover.truth.x, rover.truth.y)))
        if math.dist((rover.truth.x, rover.truth.y), goals[0]) < 0.1:
            goals.pop(0)
        speeds = _towards(rover.truth, goals[0], speeds) if goals else speeds
    assert max(off[400:]) < 0.04
    assert trusts == ([Trust.CONSISTENT] if start else [Trust.CONSISTENT, Trust.LOST, Trust.CONSISTENT])
    assert perception.take_notes()[0].startswith("began in a saved map of 12.0 m x 8.0 m, ")


def test_nothing_known_is_no_map() -> None:
    with pytest.raises(Invalid, match="nothing to begin in"):
        saved(Drawing(np.full((10, 10), UNKNOWN, dtype=np.int8), 0.05, (0.0, 0.0, 0.0)))
    with pytest.raises(Invalid, match="expected at most"):
        saved(Drawing(np.zeros((5000, 10), dtype=np.int8), 5.0, (0.0, 0.0, 0.0)))
