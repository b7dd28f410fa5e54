"""Relocalisation at length: 100 poses in each of several places, and 100 scans of other places."""

from __future__ import annotations

from collections import Counter

import pytest

from brain.perception.relocalise import PoseFound
from tests.brain.perception.test_relocalise import (
    OFFICES,
    changed,
    drawn,
    finish,
    generator,
    poses,
    room,
    search,
    seen,
    verdict,
)
from tests.prove.campaign import Campaign

pytestmark = pytest.mark.prove


@pytest.mark.parametrize("new", [0.0, 0.2])
@pytest.mark.parametrize(("noise", "beams"), [(0.01, 360), (0.03, 90)])
@pytest.mark.parametrize("name", OFFICES)
def test_of_a_hundred_poses_none_is_wrong(name: str, noise: float, beams: int, new: float) -> None:
    where = OFFICES[name]
    drawing = drawn(where, poses(where, generator(1), 40), generator(2))

    def case(seed: int, number: int) -> str:
        random = generator(seed + number)
        pose = poses(where, random, 30)[-1]
        around = changed(where, pose, random, new) if new else where
        return verdict(finish(search(drawing, seen(around, pose, random, noise, beams)))[0], pose)

    done = Counter(Campaign(f"relocalise-{name}-{beams}-{new:g}", 100).run(case).values())
    print(name, beams, new, dict(done))
    assert done["wrong"] == 0
    assert done["inexact"] <= 2
    # the rooms are nearly symmetric: without a fifth of what was there, some poses are ambiguous
    assert done["right"] >= (90 if new == 0.0 else 60)


@pytest.mark.parametrize("name", OFFICES)
def test_of_a_hundred_other_places_none_is_found(name: str) -> None:
    where = OFFICES[name]
    drawing = drawn(where, poses(where, generator(1), 40), generator(2))

    def case(seed: int, number: int) -> bool:
        random = generator(seed + number)
        other = room(random, *(float(side) for side in random.uniform(5.0, 12.0, 2)))
        return isinstance(
            finish(search(drawing, seen(other, poses(other, random, 5)[-1], random)))[0], PoseFound
        )

    done = Campaign(f"elsewhere-{name}", 100).run(case)
    assert sum(done.values()) <= 1
