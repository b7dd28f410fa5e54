"""Many plans for an outline and for a car: none touches an occupied cell; doors in many runs."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from brain.belief import Pose
from brain.planning.planner import Path
from protocols import messages as msg
from tests.brain.planning.maps import CAR, ask, touches
from tests.brain.planning.test_driven import through_the_door

pytestmark = pytest.mark.prove


@pytest.mark.parametrize("seed", range(25))
def test_a_car_touches_nothing_in_clutter(seed: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    occupied = rng.random((120, 120)) < 0.003
    occupied[[0, -1], :] = occupied[:, [0, -1]] = True
    ax, ay, bx, by = rng.uniform(0.8, 5.2, 4).tolist()
    start, goal = Pose(ax, ay, float(rng.uniform(-pi, pi))), (bx, by, float(rng.uniform(-pi, pi)))
    found, _ = ask(occupied, CAR, start, goal)
    if isinstance(found, Path) and found.escape == 0.0 and found.headings is not None:
        track = [(x, y, yaw) for (x, y), yaw in zip(found.points, found.headings, strict=True)]
        assert not touches(occupied, CAR, track), f"seed {seed}"


@pytest.mark.parametrize("seed", range(10))
def test_the_door_of_0_45_m_both_ways(seed: int) -> None:
    through_the_door(seed, msg.Goal(3.2, 2.5), msg.Goal(0.0, 1.5))
