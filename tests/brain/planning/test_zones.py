"""Zones: kept out of, left, slowed in; refused if they make no sense."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from brain.belief import Pose
from brain.planning.costmap import PlannerSettings
from brain.planning.planner import NoPath, Path
from brain.planning.polyline import Point, Polyline
from brain.planning.zones import Zone, Zones
from tests.brain.planning.maps import DIFFBOT, ask

EMPTY = np.zeros((120, 120), bool)
SQUARE = ((2.0, 1.0), (4.0, 1.0), (4.0, 3.0), (2.0, 3.0))
BEHIND = ((2.0, -9.0), (4.0, -9.0), (4.0, 3.0), (2.0, 3.0))
START = Pose(1.0, 2.0, 0.0)


def samples(found: Path) -> list[Point]:
    line = Polyline(found.points)
    return [line.point(float(at)) for at in np.arange(0.0, line.length, 0.02)]


def settings(**zones: Zone) -> PlannerSettings:
    return PlannerSettings(zones=zones)


def test_the_whole_robot_keeps_out() -> None:
    zone = Zone(SQUARE, "keep_out")
    found, _ = ask(EMPTY, DIFFBOT, START, (5.0, 2.0, None), settings(lab=zone))
    assert isinstance(found, Path)
    x, y = np.array(samples(found)).T
    assert zone.distances(x, y).min() >= DIFFBOT.outer - 0.05


def test_a_goal_inside_is_refused() -> None:
    found, _ = ask(EMPTY, DIFFBOT, START, (3.0, 2.0, None), settings(lab=Zone(SQUARE, "keep_out")))
    assert isinstance(found, NoPath)


def test_a_robot_inside_leaves_the_short_way() -> None:
    found, _ = ask(
        EMPTY, DIFFBOT, Pose(2.4, 2.0, 0.0), (5.0, 2.0, None), settings(lab=Zone(SQUARE, "keep_out"))
    )
    assert isinstance(found, Path)
    zone = Zone(SQUARE, "keep_out")
    inside = [zone.contains(*place) for place in samples(found)]
    assert inside[0]
    assert sum(inside) * 0.02 < 1.2
    assert not any(inside[inside.index(False) :])


@pytest.mark.parametrize(("speed", "around"), [(0.1, True), (0.9, False)])
def test_a_slow_zone_is_gone_around_if_that_is_quicker(speed: float, around: bool) -> None:
    found, _ = ask(EMPTY, DIFFBOT, START, (5.0, 2.0, None), settings(ramp=Zone(SQUARE, "slow", speed)))
    assert isinstance(found, Path)
    inside = [Zone(SQUARE, "slow", speed).contains(*place) for place in samples(found)]
    assert (sum(inside) * 0.02 < 0.1) == around


def test_a_slow_zone_that_cannot_be_gone_around_is_passed() -> None:
    across = ((2.0, -9.0), (4.0, -9.0), (4.0, 30.0), (2.0, 30.0))
    found, _ = ask(EMPTY, DIFFBOT, START, (5.0, 2.0, None), settings(ramp=Zone(across, "slow", 0.1)))
    assert isinstance(found, Path)
    assert Polyline(found.points).length == pytest.approx(4.0, abs=0.05)


def test_the_limit_of_speed_is_that_of_the_slowest_zone() -> None:
    zones = Zones(
        {"a": Zone(SQUARE, "slow", 0.5), "b": Zone(BEHIND, "slow", 0.2), "c": Zone(SQUARE, "keep_out")},
        0.05,
        0.25,
        64,
        1.0,
    )
    assert [zones.limit(*at) for at in ((3.0, 2.0), (3.0, 0.0), (5.0, 2.0))] == [0.2, 0.2, inf]


def test_a_zone_need_not_be_convex() -> None:
    hook = Zone(((0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (2.0, 3.0), (2.0, 1.0), (0.0, 1.0)), "keep_out")
    assert [hook.contains(*at) for at in ((1.0, 0.5), (2.5, 2.5), (1.0, 2.0))] == [True, True, False]
    assert hook.distances(np.array([1.0]), np.array([2.0]))[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("corners", "kind", "speed", "text"),
    [
        (SQUARE[:2], "keep_out", None, "from 3 to 50 corners, not 2"),
        (((0.0, 0.0), (1.0, 0.0), (inf, 1.0)), "keep_out", None, "corners must be within 10000 m"),
        (SQUARE, "slow", None, "speed belongs to a slow zone"),
        (SQUARE, "keep_out", 0.5, "speed belongs to a slow zone"),
        (SQUARE, "slow", 0.0, "speed must be from 0.01 to 20 m/s"),
    ],
)
def test_a_zone_that_makes_no_sense_is_refused(
    corners: tuple[Point, ...], kind: str, speed: float | None, text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        Zone(corners, kind, speed)  # type: ignore[arg-type]
