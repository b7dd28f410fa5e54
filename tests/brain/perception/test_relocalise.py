"""Where in its map a robot is that does not know it: found, or not, but never wrongly."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from brain.belief import Floats, Pose
from brain.bodies.plane import wrap
from brain.perception.body_scan import BodyScan, to_body
from brain.perception.map import Map, MapSettings
from brain.perception.match import MatchSettings
from brain.perception.mount import Mount
from brain.perception.relocalise import (
    Ambiguous,
    NoPoseFits,
    PoseFound,
    PoseSearch,
    PoseSearching,
    RelocaliseSettings,
    Result,
    agreement,
)
from tests.brain.helpers import ROOMS, Box
from tests.brain.perception.office import OFFICE, box, ranges, scan_at

LIDAR = Mount(0.08, 0.0, 0.15, yaw=0.3)
FARTHEST = 12.0
SURE = np.diag([1e-4, 1e-4, 1e-5])
"""Covariance of the poses that the maps are drawn from"""
Random = np.random.Generator


def generator(seed: int) -> Random:
    return np.random.Generator(np.random.PCG64(seed))


def walls(*boxes: Box) -> Floats:
    return np.array([wall for each in boxes for wall in box(*each)])


def room(random: Random, width: float, height: float) -> Floats:
    """Two rooms with a doorway, and six boxes at random."""
    x, y = float(random.uniform(0.3, 0.7) * width), float(random.uniform(0.5, height - 1.7))
    boxes = [(0.0, 0.0, width, height), (x, 0.0, x + 0.1, y), (x, y + 1.0, x + 0.1, height)]
    for _ in range(6):
        left, low = (float(random.uniform(0.3, side - 1.2)) for side in (width, height))
        wide, high = (float(n) for n in random.uniform(0.3, 0.9, 2))
        boxes.append((left, low, left + wide, low + high))
    return walls(*boxes)


def clearance(where: Floats, x: float, y: float) -> float:
    """From a place to the nearest wall [m]."""
    return float(ranges(where, x, y, np.linspace(0.0, 2.0 * math.pi, 90), 30.0).min())


def poses(where: Floats, random: Random, count: int) -> list[Pose]:
    """Poses in the open that a robot can get to from a corner, by short straight ways."""
    found = [Pose(float(where[:, 0].min()) + 0.3, float(where[:, 1].min()) + 0.3, 0.0)]
    while len(found) <= count:
        here = found[int(random.integers(len(found)))]
        way, ahead = float(random.uniform(-math.pi, math.pi)), float(random.uniform(0.3, 3.0))
        x, y = here.x + ahead * math.cos(way), here.y + ahead * math.sin(way)
        free = ranges(where, here.x, here.y, np.array([way]), 30.0)[0]
        if free > ahead + 0.25 and clearance(where, x, y) > 0.25:
            found.append(Pose(x, y, float(random.uniform(-math.pi, math.pi))))
    return found[1:]


def seen(where: Floats, pose: Pose, random: Random, noise: float = 0.02, beams: int = 360) -> BodyScan:
    """A scan with noise [m] in which one beam of ten gives no reading."""
    scan = scan_at(where, pose, LIDAR, 0, noise * random.normal(size=beams), beams, FARTHEST)
    read = np.where(random.random(beams) < 0.1, 0.0, scan.ranges)
    return to_body(replace(scan, ranges=tuple(read.tolist())), LIDAR, FARTHEST)


def drawn(where: Floats, at: Sequence[Pose], random: Random) -> Map:
    """The map as drawn by a robot that stood at these poses."""
    drawing = Map(MapSettings(farthest=FARTHEST))
    for pose in at:
        for _ in range(4):
            drawing.add(pose, seen(where, pose, random, 0.01), SURE)
    return drawing


def changed(where: Floats, pose: Pose, random: Random, share: float) -> Floats:
    """The walls with boxes of 0.4 m put about the pose, until about this share of the hits is new."""
    angles = np.linspace(-math.pi, math.pi, 360)
    before, new = ranges(where, pose.x, pose.y, angles, FARTHEST), 0.0
    for _ in range(300):
        way, ahead = float(random.uniform(-math.pi, math.pi)), float(random.uniform(0.6, 4.0))
        x, y = pose.x + ahead * math.cos(way), pose.y + ahead * math.sin(way)
        fuller = np.vstack([where, walls((x - 0.2, y - 0.2, x + 0.2, y + 0.2))])
        after = ranges(fuller, pose.x, pose.y, angles, FARTHEST)
        would_be = float(np.sum(before - after > 0.1) / np.sum(after < FARTHEST))
        if would_be <= share + 0.02:
            where, new = fuller, would_be
        if new >= share - 0.03:
            break
    return where


def search(drawing: Map, scan: BodyScan) -> PoseSearch:
    return PoseSearch(drawing, scan, RelocaliseSettings(), MatchSettings())


def finish(searching: PoseSearch, operations: int = RelocaliseSettings().operations) -> tuple[Result, int]:
    """Advance to the end; return the result and the number of steps."""
    for step in range(1, 100_000):
        result = searching.advance(operations)
        if not isinstance(result, PoseSearching):
            return result, step
    raise AssertionError("the search does not end")


def error(pose: Pose, truth: Pose) -> Floats:
    return np.array([pose.x - truth.x, pose.y - truth.y, wrap(pose.yaw - truth.yaw)])


def verdict(result: Result, truth: Pose) -> str:
    """ "right" is within 0.05 m, 1°, and what the covariance allows to one in a thousand."""
    if not isinstance(result, PoseFound):
        return type(result).__name__
    off = error(result.pose, truth)
    apart, turn = math.hypot(*off[:2]), math.degrees(abs(off[2]))
    if apart > 0.3 or turn > 10.0:
        return "wrong"
    likely = float(off @ np.linalg.solve(result.covariance, off)) < 16.3
    return "right" if apart < 0.05 and turn < 1.0 and likely else "inexact"


OFFICES = {"office": OFFICE, "rooms": walls(*ROOMS), "random": room(generator(3), 8.0, 6.0)}


@pytest.mark.sample(2)
@pytest.mark.parametrize(
    ("name", "noise", "beams", "new"),
    [
        ("office", 0.03, 90, 0.0),
        ("rooms", 0.01, 360, 0.0),
        ("random", 0.02, 360, 0.0),
        ("random", 0.02, 360, 0.2),
    ],
)
def test_a_pose_is_found_within_the_steps_of_a_second_and_a_half(
    name: str, noise: float, beams: int, new: float
) -> None:
    """Anywhere in the map, at 100 steps a second; also if a fifth of what is seen is new."""
    random, where = generator(21), OFFICES[name]
    drawing = drawn(where, poses(where, random, 40), random)
    verdicts = []
    for pose in poses(where, random, 8):
        around = changed(where, pose, random, new) if new else where
        result, steps = finish(search(drawing, seen(around, pose, random, noise, beams)))
        verdicts.append(verdict(result, pose))
        assert steps <= 150
    assert "wrong" not in verdicts
    assert verdicts.count("right") >= (6 if new else 7)


def test_a_place_that_is_not_in_the_map_is_not_found() -> None:
    random, where = generator(5), OFFICES["random"]
    drawing = drawn(where, poses(where, random, 40), random)
    for number in range(12):
        other = room(generator(100 + number), *(float(n) for n in random.uniform(5.0, 12.0, 2)))
        result, _ = finish(search(drawing, seen(other, poses(other, random, 3)[-1], random)))
        assert not isinstance(result, PoseFound), number


TWINS = walls((0.0, 0.0, 8.0, 4.0), (3.95, 0.0, 4.05, 1.5), (3.95, 2.5, 4.05, 4.0))
CORRIDOR = walls((0.0, 0.0, 40.0, 2.0))


def test_of_places_far_apart_the_one_looked_at_last_is_searched() -> None:
    """Two houses that are alike, kilometres apart."""
    random = generator(3)
    house = room(random, 7.0, 5.0)
    at = poses(house, random, 12)

    def shifted(pose: Pose, by: float) -> Pose:
        return replace(pose, x=pose.x + by, y=pose.y + by)

    drawing = drawn(house, at, random)
    for far in (3000.0, 0.0):
        for pose in at:
            drawing.add(shifted(pose, far), seen(house, pose, random, 0.01), SURE)
        looking = search(drawing, seen(house, at[0], random))
        result, _ = finish(looking)
        assert looking._cells.size < 4096 * 4096
        assert verdict(result, shifted(at[0], far)) == "right", result


@pytest.mark.parametrize("where", [TWINS, CORRIDOR, walls((0.0, 0.0, 4.0, 4.0))])
def test_what_looks_alike_is_ambiguous(where: Floats) -> None:
    """Two rooms that are alike, a corridor whose ends are out of sight, a square."""
    random = generator(6)
    drawing = drawn(where, poses(where, random, 40), random)
    pose = Pose(float(where[:, 0].max()) * 0.55, 1.1, 0.4)
    result, _ = finish(search(drawing, seen(where, pose, random)))
    assert isinstance(result, Ambiguous), result
    assert len(result.poses) > 1


def test_the_end_of_a_corridor_settles_its_length_but_not_which_end() -> None:
    random = generator(7)
    drawing = drawn(CORRIDOR, [Pose(x + 0.5, 1.0, 0.0) for x in range(40)], random)
    pose = Pose(3.0, 1.1, 0.4)
    result, _ = finish(search(drawing, seen(CORRIDOR, pose, random)))
    assert isinstance(result, Ambiguous)
    opposite = Pose(40.0 - pose.x, 2.0 - pose.y, wrap(pose.yaw + math.pi))
    for each in (pose, opposite):
        assert min(np.hypot(*error(one, each)[:2]) for one in result.poses) < 0.05


def test_the_result_depends_neither_on_the_slices_nor_on_copies() -> None:
    random, where = generator(8), OFFICES["rooms"]
    drawing = drawn(where, poses(where, random, 40), random)
    started = search(drawing, seen(where, poses(where, random, 1)[0], random))
    whole, steps = finish(copy.deepcopy(started), 10**9)
    assert steps == 1
    parts = 0
    while isinstance(started.advance(1), PoseSearching):
        parts += 1
        if parts % 150 == 0:
            started = copy.deepcopy(started)
    assert parts > 500
    assert repr(started.result) == repr(whole)


def test_with_few_hits_or_without_a_map_nothing_is_found() -> None:
    random, where = generator(9), OFFICES["rooms"]
    drawing = drawn(where, poses(where, random, 3), random)
    nothing = seen(where + 100.0, Pose(0.0, 0.0, 0.0), random)
    assert isinstance(finish(search(drawing, nothing))[0], NoPoseFits)
    empty = Map(MapSettings())
    assert isinstance(finish(search(empty, seen(where, Pose(0.0, 0.0, 0.0), random)))[0], NoPoseFits)


def test_a_screen_shortens_beams_and_a_wrong_pose_sends_them_through_walls() -> None:
    """What tells that the robot was moved from what stands before it."""
    random, where = generator(10), OFFICES["random"]
    drawing = drawn(where, poses(where, random, 40), random)
    for pose in poses(where, random, 12):
        x, y = pose.x + 0.6 * math.cos(pose.yaw), pose.y + 0.6 * math.sin(pose.yaw)
        dx, dy = 1.0 * math.sin(pose.yaw), 1.0 * math.cos(pose.yaw)
        screened = np.vstack([where, (x - dx, y + dy, x + dx, y - dy)])
        _, agrees, through = agreement(drawing, seen(screened, pose, random), pose)
        assert agrees > 0.5
        assert through < 0.05
        turned = replace(pose, yaw=wrap(pose.yaw + math.radians(15.0)))
        _, agrees, through = agreement(drawing, seen(where, turned, random), pose)
        assert agrees < 0.5
        assert through > 0.05
