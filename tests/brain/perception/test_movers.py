"""What moves, against the kinematic base in the office: people, and that nothing else does."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.differential import Differential
from brain.perception.mount import Mount
from brain.perception.movers import Moving
from brain.perception.perception import Perception, PerceptionSettings
from protocols.messages import Velocity
from tests.brain.bodies.kinematics import speeds
from tests.robustness.plant import Base, Figures, Person, scene

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.25,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
)


@dataclass
class Walk:
    """A base in the office that turns to and fro as it drives slowly on, and what it sees move."""

    figures: Figures = field(default_factory=Figures)
    seed: int = 1
    doubts: bool = False

    def __post_init__(self) -> None:
        self.base = Base(scene("office"), BODY, (0.12, 0.0, 0.0), self.figures, self.seed)
        mounts = {"lidar": Mount(x=0.12), "imu": Mount()}
        self.perception = Perception(BODY, mounts, PerceptionSettings())
        self.seen: list[tuple[float, tuple[Moving, ...]]] = []

    def drive(self, span: float, linear: float, angular: float) -> None:
        """Drive for a time [s], and note what moves at its end in the world's frame."""
        for i in range(round(100 * span)):
            share = min(1.0, 0.02 * i)
            wheels = speeds(BODY, share * linear, share * angular * math.cos(0.02 * i))
            commands = [Velocity(m, w) for m, w in zip(("left", "right"), wheels, strict=True)]
            self.perception.observe(self.base.now, self.base.step(commands))
            self.seen.append((0.01 * i, self.perception.moving(self.base.pose, doubts=self.doubts)))


@pytest.mark.parametrize(("vx", "vy"), [(0.0, -0.35), (0.2, -1.1)])
def test_a_person_is_known_within_a_second_and_well(vx: float, vy: float) -> None:
    """While the base turns: 0.15 m, 0.25 m/s, once it has been seen for 2 s."""
    walk = Walk()
    walk.drive(1.1, 0.05, 0.4)
    walk.base.people["person"] = person = Person(1.6, 1.2, vx, vy, 0.25)
    walk.seen.clear()
    walk.drive(2.0, 0.1, 0.6)
    first = next((t for t, moving in walk.seen if moving), math.inf)
    assert first < 1.3
    (one,) = walk.seen[-1][1]
    assert math.dist((one.x, one.y), (person.x, person.y)) < 0.15
    assert math.dist((one.vx, one.vy), (vx, vy)) < 0.25
    assert one.radius == pytest.approx(0.25, abs=0.08)


@pytest.mark.parametrize("figures", [Figures(slip=0.1, range_noise=0.02), Figures(imu=False)])
def test_walls_corners_and_boxes_do_not_move(figures: Figures) -> None:
    walk = Walk(figures, seed=3)
    walk.drive(2.5, 0.3, 1.2)
    assert not [moving for _, moving in walk.seen if moving]


@pytest.mark.parametrize(("x", "y", "vx", "vy"), [(2.25, 0.0, -0.1, 0.7), (1.9, 2.3, -0.7, -0.5)])
def test_who_comes_along_a_wall_is_noticed_at_once(x: float, y: float, vx: float, vy: float) -> None:
    """What the lidar sees of them goes over into a wall, a door frame, a box: within 0.3 s something may move
    there, within 0.7 s it is known to."""
    walk = Walk(doubts=True)
    walk.drive(1.2, 0.0, 0.3)
    walk.base.people["person"] = person = Person(x, y, vx, vy, 0.25)
    walk.seen.clear()
    walk.drive(0.35, 0.0, 0.3)
    assert min(math.dist((one.x, one.y), (person.x, person.y)) for one in walk.seen[-1][1]) < 0.3
    walk.doubts = False
    walk.drive(0.4, 0.0, 0.3)
    assert min(math.dist((one.x, one.y), (person.x, person.y)) for one in walk.seen[-1][1]) < 0.3


@pytest.mark.parametrize(("x", "y", "vy"), [(3.0, -1.67, 0.82), (3.05, 4.33, -1.1)])
def test_who_steps_out_from_behind_a_frame_is_known_by_the_part_that_is_seen(
    x: float, y: float, vy: float
) -> None:
    """The base drives towards the doorway; from 0.25 s after he is first seen on."""
    walk = Walk(doubts=True)
    walk.base.pose = Pose(1.3, 1.0, 0.0)
    walk.base.people["person"] = Person(x, y, 0.0, vy, 0.25)
    walk.drive(2.6, 0.5, 0.0)
    seen = [(t, one) for t, moving in walk.seen for one in moving][:60]
    off = [
        (math.dist((one.x, one.y), (x, y + (t + 0.01) * vy)), math.dist((one.vx, one.vy), (0.0, vy)))
        for t, one in seen
    ]
    assert max(place for place, _ in off[25:]) < 0.12
    assert max(speed for _, speed in off[25:]) < 0.4


def test_a_person_leaves_no_trace_in_the_map() -> None:
    """Where one has walked for 2.5 s the map is free again, though the base stands."""
    walk = Walk()
    walk.drive(1.2, 0.0, 0.3)
    walk.base.people["person"] = person = Person(1.4, 1.2, 0.0, -0.6, 0.25)
    walk.drive(2.5, 0.0, 0.0)
    view = walk.perception.map.view()
    row = [(y, walk.base.scene.start) for y in np.arange(person.y + 0.6, 0.9, 0.05)]
    occupied = 0
    for y, start in row:
        j, i = (
            int((v - o) / view.resolution)
            for v, o in ((1.4 - start.x, view.origin_x), (y - start.y, view.origin_y))
        )
        occupied += bool((view.log_odds[i - 2 : i + 3, j - 2 : j + 3] > 0.0).any())
    assert occupied == 0
