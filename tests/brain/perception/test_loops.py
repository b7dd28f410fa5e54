"""Loops: a robot that sees no farther than its corridor comes round, and all it believes moves into place."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.bodies.plane import moved, wrap
from brain.perception.consistency import Trust
from brain.perception.filter import Filter
from brain.perception.filter_inputs import Input, PoseFix
from brain.perception.filter_settings import FilterSettings
from brain.perception.filter_state import moved_fix
from brain.perception.keyframes import KeyframeSettings
from brain.perception.loops import MUCH, LoopSettings
from brain.perception.map import MapSettings
from brain.perception.perception import Anchor, Perception, PerceptionSettings
from protocols.messages import SECOND, Imu
from tests.brain.perception.office import BODY, MOUNTS, OFFICE, SETTINGS, Rover, _towards, box, clearance
from tests.brain.perception.rolling import BODY as ROLLING
from tests.brain.perception.rolling import MS, Floor, roll

RING: Floats = np.array(
    box(-1.0, -1.0, 13.0, 9.0)
    + box(1.0, 1.0, 11.0, 7.0)
    + [wall for x in (2.0, 5.5, 8.0) for wall in box(x, -1.0, x + 0.4, -0.7)]
    + [wall for x in (3.0, 6.0, 9.5) for wall in box(x, 8.6, x + 0.3, 9.0)]
    + [wall for y in (2.0, 5.0) for wall in box(12.6, y, 13.0, y + 0.5)]
    + [wall for y in (1.5, 3.5, 6.0) for wall in box(-1.0, y, -0.6, y + 0.4)]
)
"""A corridor of 2 m around a block of 10 m by 6 m, with pillars"""
ROUND = [(12.0, 0.0), (12.0, 8.0), (0.0, 8.0), (0.0, 0.0), (3.0, 0.0)]
SHORT = replace(
    SETTINGS,
    keyframes=KeyframeSettings(farthest=2.5),
    map=MapSettings(farthest=2.5),
    loops=LoopSettings(keyframes=100),
)
"""It sees 2.5 m far"""


@dataclass
class Lap:
    """What a way round came to."""

    rover: Rover
    perception: Perception
    copy: Perception
    """Made on the way, and given the same since"""
    true: list[Pose] = field(default_factory=list)
    """Once a second; so is the next"""
    anchors: list[Anchor | None] = field(default_factory=list)
    leaps: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """m that the pose in "odom" and in "map" moved within a step, at most"""

    def error(self) -> float:
        """m: of the path as it is known in the end, at most."""
        pairs = zip(self.anchors, self.true, strict=True)
        known = [(self.perception.anchored(anchor), true) for anchor, true in pairs if anchor is not None]
        return max(math.dist((a.x, a.y), (b.x, b.y)) for a, b in known)


def lap(settings: PerceptionSettings, seed: int = 1) -> Lap:
    """Drive round on the true pose, without a gyro."""
    rover = Rover(seed, walls=RING, lidar_noise=0.03)
    first = Perception(BODY, {"lidar": MOUNTS["lidar"]}, settings)
    result = Lap(rover, first, first)
    for step, speeds in enumerate(_round(rover)):
        before = result.perception.estimate
        events = [one for one in rover.step(*speeds) if not isinstance(one, Imu)]
        if step == COPIED:
            result.copy = copy.deepcopy(result.perception)
        for one in {id(each): each for each in (result.perception, result.copy)}.values():
            one.observe(rover.now, events)
        after = result.perception.estimate
        if before is not None and after is not None:
            for k, (a, b) in enumerate(((before.odom, after.odom), (before.pose, after.pose))):
                result.leaps[k] = max(result.leaps[k], math.dist((a.x, a.y), (b.x, b.y)))
        if step % 200 == 0:
            result.true.append(rover.truth)
            result.anchors.append(None if after is None else result.perception.anchor(after.pose))
    return result


COPIED = 15_500
"""Step, of some 17,800, before the loop is closed"""


def test_lost_on_the_way_to_new_ground_the_map_goes_on_in_doubt_until_a_loop_ties_it() -> None:
    """For 3.5 m its lidar shows another place, as in a crowd; what is seen after that is on no map."""
    rover = Rover(1, walls=RING, lidar_noise=0.03)
    perception = Perception(BODY, {"lidar": MOUNTS["lidar"]}, SHORT)
    seen, off = [(perception.verdict.trust, "")], [0.0]
    for speeds in _round(rover):
        rover.walls = OFFICE + [rover.truth.x, 0.5] * 2 if 5.0 < rover.length < 8.5 else RING
        perception.observe(rover.now, [one for one in rover.step(*speeds) if not isinstance(one, Imu)])
        if perception.verdict.trust is not seen[-1][0]:
            seen.append((perception.verdict.trust, perception.verdict.reason))
            off.append(apart(perception, rover))
    trusts = [trust for trust, _ in seen]
    assert trusts == [Trust.CONSISTENT, Trust.DOUBTFUL, Trust.LOST, Trust.DOUBTFUL, Trust.CONSISTENT]
    assert seen[3][1].startswith("its place in the map is doubtful: it drove ")
    assert any("does not have this ground" in note for note in perception.take_notes())
    assert max(off) > 0.5
    assert off[-1] < 0.05  # as soon as it is tied
    assert apart(perception, rover) < 2.0 * MUCH  # m, from which on loops are solved at once


def apart(perception: Perception, rover: Rover) -> float:
    """m, of the believed place from the true one."""
    estimate, truth = perception.estimate, rover.truth
    assert estimate is not None
    return math.dist((estimate.pose.x, estimate.pose.y), (truth.x, truth.y))


def _round(rover: Rover) -> Iterator[tuple[float, float]]:
    speeds, left = (0.0, 0.0), list(ROUND)
    for _ in range(200):
        yield speeds
    while left:
        speeds = _towards(rover.truth, left[0], speeds)
        yield speeds
        if math.dist((rover.truth.x, rover.truth.y), left[0]) < 0.1:
            left.pop(0)


@pytest.fixture(scope="module")
def closed() -> Lap:
    return lap(SHORT)


def test_a_loop_moves_all_that_is_believed_into_place(closed: Lap) -> None:
    """Without it the end is 0.10 m and 3.4 degrees off, and the path up to 0.54 m."""
    estimate, truth = closed.perception.estimate, closed.rover.truth
    assert estimate is not None
    assert math.dist((estimate.pose.x, estimate.pose.y), (truth.x, truth.y)) < 0.05
    assert abs(wrap(estimate.pose.yaw - truth.yaw)) < 0.01
    assert closed.error() < 0.4


def test_the_map_moves_and_odom_does_not(closed: Lap) -> None:
    in_odom, in_map = closed.leaps
    assert in_map > 0.1
    assert in_odom < 0.004  # 5 ms of driving


def test_the_map_is_drawn_again_where_the_loop_is_closed(closed: Lap) -> None:
    chart = closed.perception.map
    for x, y in ((0.0, -1.0), (-1.0, 0.0), (2.0, 1.0), (2.2, -0.7)):
        assert clearance(chart, x, y) < 0.1, (x, y)
    ways = np.array([(x, y) for x in np.arange(-0.5, 3.0, 0.1) for y in (-0.4, 0.0, 0.4)])
    assert (chart.values(*chart.cells(ways).T) < 0).all()


def test_a_copy_goes_on_as_the_original(closed: Lap) -> None:
    one, other = closed.perception, closed.copy
    assert one is not other
    assert one.estimate is not None
    assert other.estimate is not None
    assert one.estimate.pose == other.estimate.pose
    assert one.loops == other.loops
    tiles, others = one.map.view().tiles, other.map.view().tiles
    assert tiles.keys() == others.keys()
    assert all((tiles[at] == others[at]).all() for at in tiles)


def test_keyframes_are_bounded(closed: Lap) -> None:
    """There were more, of which some were of one place."""
    count = int(closed.perception.loops.split()[0])
    assert count <= 110
    newest = closed.perception.anchor(Pose(0.0, 0.0, 0.0))
    assert newest is not None
    assert newest.keyframe > 120


@pytest.mark.sample(2)
@pytest.mark.parametrize("seed", range(6))
def test_a_shift_of_the_map_is_none_of_what_was_measured(seed: int) -> None:
    """Whether the map was shifted on the way, or what is believed in the end: it is the same."""
    by, inputs = Pose(3.0, -2.0, 1.2), roll(seed, 4 * SECOND, Floor(fixes=200 * MS)).inputs
    fixes = [replace(one, drift=np.diag([1e-6, 1e-6, 1e-8])) for one in inputs if isinstance(one, PoseFix)]
    rest = [one for one in inputs if not isinstance(one, PoseFix)]
    late: list[Input] = sorted([*rest, *fixes], key=lambda one: one.t)
    shifted, plain = Filter(ROLLING, FilterSettings()), Filter(ROLLING, FilterSettings())
    for start in range(0, len(late), 50):
        some = late[start : start + 50]
        behind, before = some[::2], some[1::2]
        plain.observe(before)
        plain.observe(behind)
        turned = start >= len(late) // 2
        shifted.observe([_shifted(one, by) if turned else one for one in before])
        if start <= len(late) // 2 < start + 50:
            shifted.shift(by)
            turned = True
        shifted.observe([_shifted(one, by) if turned else one for one in behind])
    assert plain.t == shifted.t
    assert plain.t is not None
    (there, P), (here, Q) = plain.at(plain.t) or (by, P0), shifted.at(plain.t) or (by, P0)
    expected = moved(by, there)
    assert (here.x, here.y, wrap(here.yaw - expected.yaw)) == pytest.approx(
        (expected.x, expected.y, 0.0), abs=1e-9
    )
    assert np.trace(P) == pytest.approx(np.trace(Q))
    assert shifted.odom == pytest.approx(plain.odom)


P0: Floats = np.zeros((3, 3))


def _shifted(item: Input, by: Pose) -> Input:
    return moved_fix(item, by) if isinstance(item, PoseFix) else item
