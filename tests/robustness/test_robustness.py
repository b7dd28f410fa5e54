"""The plant's contacts and beams, and a sample of the campaign (`./go prove -k robustness`)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.differential import Differential
from tests.robustness.judge import Case, diffbot, run
from tests.robustness.plant import HALF_LENGTH, HALF_WIDTH, Base, Figures, Person, cast, rectangle, scene
from tests.robustness.variations import MORE, TABLE, carried, office


def base() -> Base:
    """A base in the office, alone with one box."""
    body = diffbot().brain.body
    assert isinstance(body, Differential)
    built = Base(scene("office"), body, (0.1, 0.0, 0.0), Figures(), 1)
    for name in list(built.solids):
        built.remove(name)
    built.add("box", rectangle(1.0, 0.5, 0.4, 0.6, 0.3))
    return built


def test_a_touch_is_where_outline_and_box_or_disc_share_a_point() -> None:
    """Against points spread over the outline."""
    here, random, disagreed = base(), np.random.default_rng(1), 0
    here.people["person"] = Person(0.0, -0.5, 0.0, 0.0)
    lengths, widths = np.linspace(-HALF_LENGTH, HALF_LENGTH, 41), np.linspace(-HALF_WIDTH, HALF_WIDTH, 25)
    along, across = np.meshgrid(lengths, widths)
    for _ in range(400):
        x, y, yaw = random.uniform((0.0, -1.0, -math.pi), (2.0, 1.0, math.pi))
        here.pose, here.touches, here._touching = Pose(x, y, yaw), [], frozenset()
        here._touch()
        px = x + math.cos(yaw) * along - math.sin(yaw) * across
        py = y + math.sin(yaw) * along + math.cos(yaw) * across
        dx, dy = px - 1.0, py - 0.5
        u, v = math.cos(0.4) * dx + math.sin(0.4) * dy, math.cos(0.4) * dy - math.sin(0.4) * dx
        wanted = {
            "box": np.any((abs(u) < 0.3) & (abs(v) < 0.15)),
            "person": np.any(px**2 + (py + 0.5) ** 2 < 0.04),
        }
        disagreed += {what for what, _ in here.touches} != {name for name, met in wanted.items() if met}
    assert disagreed <= 4, "points 10 mm apart miss corners that only just touch"


def test_beams_end_at_the_nearest_wall_or_person_each_from_its_own_origin() -> None:
    walls = np.array([[2.0, -1.0, 2.0, 1.0], [3.0, -9.0, 3.0, 9.0]])
    origins, angles = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 2.0], [0.0, 0.0]]), np.array([0, 0, 0, math.pi])
    ahead = np.array([[1.0, 0.1, 0.2]] * 4)
    assert cast(walls, [], origins, angles, 9.0).tolist() == [2.0, 1.5, 3.0, 9.0]
    reach = 1.0 - math.sqrt(0.2**2 - 0.1**2)
    assert np.allclose(cast(walls, [ahead], origins, angles, 9.0), [reach, reach - 0.5, 3.0, 9.0])


def test_a_case_repeats_exactly() -> None:
    short = office("short", goals=((0.6, 0.2),), limit=4.0)
    assert repr(run(short, 3)) == repr(run(short, 3)) != repr(run(short, 4))


@pytest.mark.parametrize("name", ["by hand against a screen", "moved 0.5 m"])
def test_the_first_seconds_of_a_case_of_the_table_are_good(name: str) -> None:
    case: Case = next(each for each in (*TABLE, *MORE) if each.name == name)
    row = run(replace(case, limit=8.0), 1)
    assert row.good, row.line()


@pytest.mark.parametrize("seed", [0, 20])
def test_who_is_carried_away_is_found_while_its_goals_are_kept(seed: int) -> None:
    """The steps of a robot that is lost belong to the search, not to loops; and half of a doorway looks the
    same from its other side (20), so that it was never noticed."""
    row = run(carried(seed), seed)
    assert row.good, row.line()
    assert row.found <= 5.0
