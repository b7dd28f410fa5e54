"""Rays of a lidar that turns clockwise, as scans: what each beam is, however the rays were cut into runs."""

from __future__ import annotations

import math
from itertools import pairwise
from random import Random

import pytest

from protocols.messages import MILLISECOND, SECOND, LaserScan
from protocols.toolkit.rays import NEIGHBOURS, SURFACE, Beams, Rays, ascending

BEAMS = Beams("lidar", 90, 0.1, 12.0)
STEP, SPEED = 3.7, 3600.0
APART = STEP / SPEED * SECOND


def turning(random: Random, count: int) -> list[tuple[float, float]]:
    """Degrees from ahead that go on, and m: surfaces, edges, what is out of reach, and gaps of any size."""
    rays, angle, found = list[tuple[float, float]](), 170.0, 3.0
    for _ in range(count):
        angle += STEP * random.choice([1.0] * 40 + [0.6, 1.3, 1.6, 2.2, 9.0])
        found = random.choice(
            [found * random.uniform(0.95, 1.05)] * 12 + [0.0, 20.0, random.uniform(0.2, 8.0)]
        )
        rays.append((angle, found))
    return rays


def laid(rays: list[tuple[float, float]], random: Random, longest: int) -> list[LaserScan]:
    """The scans of these rays, in runs of at most so many."""
    state, scans, at = Rays(), list[LaserScan](), 0
    while at < len(rays):
        run = rays[at : at + random.randint(1, longest)]
        at += len(run)
        angles = [
            angle % 360.0 + (angle - run[0][0] - (angle % 360.0 - run[0][0] % 360.0)) for angle, _ in run
        ]
        ended = round((run[-1][0] - 170.0) / SPEED * SECOND)
        scan = state.add(ended, APART, angles, [found * 1000.0 for _, found in run], STEP, SPEED, BEAMS)
        scans += [scan] if scan else []
    return scans


def expected(rays: list[tuple[float, float]], turn: int) -> list[float]:
    """The beams of a turn [m], from the rear, clockwise, as the module's rules say."""
    width, beams = 360.0 / BEAMS.count, list[float]()
    for beam in range(1, BEAMS.count + 1):
        place = 180.0 + 360.0 * turn + beam * width
        (a, before), (b, after) = next(pair for pair in pairwise(rays) if pair[0][0] < place <= pair[1][0])
        before, after = (each if BEAMS.nearest <= each <= BEAMS.farthest else 0.0 for each in (before, after))
        nearer = before if place - a < b - place else after
        if b - a > NEIGHBOURS * STEP:
            beams.append(nearer if min(place - a, b - place) <= STEP else 0.0)
        elif before and after and max(before, after) <= SURFACE * min(before, after):
            beams.append(before + (after - before) * (place - a) / (b - a))
        else:
            beams.append(nearer)
    return beams


@pytest.mark.parametrize("seed", range(6))
def test_a_beam_is_what_the_rays_beside_it_say_however_they_were_cut(seed: int) -> None:
    random = Random(seed)
    rays = turning(random, 500)
    turns = [expected(rays, turn) for turn in range(4)]
    for longest in (1, 12, 48):
        scans = laid(rays, random, longest)
        assert len(scans) >= 4
        for scan, beams in zip(scans, turns, strict=False):
            assert list(reversed(scan.ranges)) == pytest.approx(beams, abs=1e-9)
            assert scan.angle_min == -math.pi


def test_a_scan_has_the_time_at_which_its_rear_was_passed() -> None:
    rays = [(170.0 + STEP * number, 3.0) for number in range(400)]
    for longest in (1, 12, 48):
        for turn, scan in enumerate(laid(rays, Random(longest), longest)):
            rear = 180.0 + 360.0 * (turn + 1)
            assert scan.t == pytest.approx((rear - 170.0) / SPEED * SECOND, abs=1000)
            assert scan.duration == pytest.approx(-89 / 90 * 100 * MILLISECOND, abs=1000)


def test_a_run_that_begins_behind_the_last_ray_goes_on_at_it() -> None:
    rays = [(170.0 + STEP * number, 3.0) for number in range(300)]
    state, scans = Rays(), list[LaserScan]()
    for at in range(0, 288, 12):
        run = rays[max(0, at - 2) : at + 12]  # two of them come twice
        angles = [angle - 360.0 * (run[0][0] // 360.0) for angle, _ in run]
        ended = round((run[-1][0] - 170.0) / SPEED * SECOND)
        again = [9000.0 if at and not each else 3000.0 for each in range(len(run))]
        scan = state.add(ended, APART, angles, again, STEP, SPEED, BEAMS)
        scans += [scan] if scan else []
    assert len(scans) >= 2
    assert {*scans[-1].ranges} == {3.0}


def test_angles_of_a_turn_ascend_beyond_its_end() -> None:
    assert ascending([350.0, 355.0, 2.0, 1.5, 8.0]) == [350.0, 355.0, 362.0, 362.0, 368.0]
