"""Crowds and open ground at length: no mirror image is taken for the place, nor few returns for certainty.

Halls of any size that look the same turned by 180°, with 4 to 12 people who walk to and fro, some of them
over the robot; and ground with a few posts, of which a scan sees one or two, or none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from brain.belief import Floats
from brain.bodies.plane import wrap
from brain.perception.perception import Perception, PerceptionSettings
from protocols.messages import MILLISECOND, SECOND, Event, Nanos, seconds
from tests.brain.perception.office import BODY, MOUNTS, SETTINGS, Rover, box, person
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove

DRIVES = ((1.0, 5.0), (13.0, 17.0))
"""s: from when until when; else it stands"""
FAR = 0.3
"""m: who is believed to be farther off is at another place"""


@dataclass
class Among(Rover):
    """A robot among people who walk to and fro."""

    place: Floats = field(default_factory=lambda: np.zeros((0, 4)))
    people: Floats = field(default_factory=lambda: np.zeros((0, 5)))
    """x, y of both ends of each way, and m/s"""

    def sense(self) -> list[Event]:
        t, walls = seconds(self.now), [self.place]
        for x, y, to_x, to_y, speed in self.people.tolist():
            part = abs((speed * t / max(math.dist((x, y), (to_x, to_y)), 1.0)) % 2.0 - 1.0)
            walls.append(person(to_x + part * (x - to_x), to_y + part * (y - to_y)))
        self.walls = np.concatenate(walls)
        return super().sense()


def ride(
    rover: Among, settings: PerceptionSettings = SETTINGS, until: Nanos = 18 * SECOND
) -> tuple[float, list[float]]:
    """Return how far the pose was off at most [m], and its NEES per number once a second."""
    belief, worst, nees = Perception(BODY, MOUNTS, settings), 0.0, list[float]()
    while rover.now < until:
        t = seconds(rover.now)
        driving = any(start < t < end for start, end in DRIVES)
        speeds = (0.45, 0.4 * math.sin(t)) if driving else (0.0, 0.0)
        belief.observe(rover.now + 5 * MILLISECOND, rover.step(*speeds))
        estimate, truth = belief.estimate, rover.truth
        if estimate is None:
            continue
        off = np.array(
            [estimate.pose.x - truth.x, estimate.pose.y - truth.y, wrap(estimate.pose.yaw - truth.yaw)]
        )
        worst = max(worst, math.hypot(off[0], off[1]))
        if rover.now % SECOND == 0:
            floor = np.diag([1e-6, 1e-6, 1e-6])  # the start is allowed as much
            nees.append(float(off @ np.linalg.solve(estimate.covariance + floor, off)) / 3.0)
    return worst, nees


def hall(random: np.random.Generator) -> Among:
    wide, high = random.uniform(8.0, 14.0), random.uniform(6.0, 9.0)
    block = random.uniform(0.4, 0.9)
    middle = wide / 2.0 - 1.5
    place = np.array(
        box(-1.5, -high / 2.0, wide - 1.5, high / 2.0) + box(middle - block, -block, middle + block, block)
    )
    count = int(random.integers(4, 13))
    ends = random.uniform([-1.2, 0.3 - high / 2.0] * 2, [wide - 1.8, high / 2.0 - 0.3] * 2, (count, 4))
    ends[:2, 2:] = (
        2.0 * random.uniform([0.3, -0.4], [1.8, 0.4], (2, 2)) - ends[:2, :2]
    )  # over where it stands
    people = np.column_stack([ends, random.uniform(0.3, 1.2, count)])
    return Among(int(random.integers(1 << 30)), place=place, people=people)


def test_in_a_hundred_crowds_nobody_is_elsewhere() -> None:
    def case(seed: int, number: int) -> str:
        worst, _ = ride(hall(np.random.Generator(np.random.PCG64([seed, number]))))
        return "elsewhere" if worst > FAR else "there"

    done = Campaign("crowds", 100).run(case)
    print(done)
    assert set(done.values()) == {"there"}


def field_of_posts(random: np.random.Generator) -> Among:
    posts = random.uniform([-8.0, -8.0], [12.0, 8.0], (8, 2))
    posts = posts[np.hypot(*posts.T) > 2.5]
    place = np.concatenate([person(x, y) for x, y in posts.tolist()])
    return Among(int(random.integers(1 << 30)), place=place)


def test_on_open_ground_few_returns_are_no_certainty() -> None:
    open_ground = replace(SETTINGS, least_returns=0.0)

    def case(seed: int, number: int) -> tuple[float, float]:
        rover = field_of_posts(np.random.Generator(np.random.PCG64([seed, 7, number])))
        worst, nees = ride(rover, open_ground)
        return worst, float(np.mean(nees))

    done = list(Campaign("open-ground", 50).run(case).values())
    print("worst, NEES", sorted(done)[-5:], float(np.mean([one for _, one in done])))
    assert max(worst for worst, _ in done) < FAR
    assert float(np.mean([one for _, one in done])) < 1.5
