from __future__ import annotations

import math

import numpy as np
import pytest

from brain.belief import Pose
from brain.bodies.plane import arc, wrap
from brain.perception.body_scan import to_body, to_world
from brain.perception.mount import Mount
from protocols.messages import LaserScan
from tests.brain.perception.office import OFFICE, box, ranges, scan_at


def scan(*read: float, increment: float = math.pi / 2) -> LaserScan:
    return LaserScan("lidar", 0, 0.0, increment, 0.1, 10.0, read)


def test_beams_in_the_robots_frame() -> None:
    swept = to_body(scan(1.0, 2.0, 3.0, 4.0), Mount(0.5, 0.25, yaw=math.pi / 2))
    ends = [(0.5, 1.25), (-1.5, 0.25), (0.5, -2.75), (4.5, 0.25)]
    assert swept.ends == pytest.approx(np.array(ends), abs=1e-12)
    assert swept.bearings == pytest.approx(np.arange(1, 5) * math.pi / 2)
    assert swept.origin == (0.5, 0.25)
    assert swept.hit.all()


def test_a_lidar_upside_down_turns_the_other_way_and_a_tilted_one_is_foreshortened() -> None:
    swept = to_body(scan(1.0, 2.0, 3.0, 4.0), Mount(roll=math.pi))
    assert (np.diff(swept.bearings) > 0.0).all()
    assert swept.ends[::-1] == pytest.approx(np.array([(1, 0), (0, -2), (-3, 0), (0, 4)]), abs=1e-12)
    swept = to_body(scan(1.0, 2.0, 3.0, 4.0), Mount(pitch=math.pi / 3))
    assert swept.ends == pytest.approx(np.array([(0.5, 0), (0, 2), (-1.5, 0), (0, -4)]), abs=1e-12)
    assert swept.ranges.tolist() == pytest.approx([0.5, 2.0, 1.5, 4.0])


def test_what_is_no_hit() -> None:
    """Too near is no reading; at the end, or beyond it, is nothing met; and all is cut at `farthest`."""
    swept = to_body(scan(0.05, 10.0, 12.0, 7.0), Mount(), farthest=8.0)
    assert swept.hit.tolist() == [False, False, False, True]
    assert swept.ranges.tolist() == [0.0, 8.0, 8.0, 7.0]
    assert swept.ends[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("motion", [None, np.tile([0.1, 0.0, 0.2], (4, 1))])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1.0, 0.0])
def test_what_is_no_range_is_no_reading(bad: float, motion: np.ndarray | None) -> None:
    swept = to_body(scan(1.0, bad, 1.0, 1.0), Mount(0.5, 0.1), motion=motion)
    assert swept.ranges[1] == 0.0
    assert not swept.hit[1]
    assert swept.ends[1].tolist() == [0.5, 0.1]
    assert np.isfinite(swept.ends).all()
    assert (np.diff(swept.bearings) > 0.0).all()


@pytest.mark.parametrize("mount", [Mount(0.08, 0.0, yaw=0.3), Mount(0.2, 0.1, yaw=2.5, roll=math.pi)])
@pytest.mark.parametrize(("linear", "angular"), [(0.6, 0.0), (0.6, 2.0), (-0.3, -2.0), (0.0, 2.0)])
def test_a_sweep_equals_the_instant_scan_of_the_same_places(
    mount: Mount, linear: float, angular: float
) -> None:
    """100 ms: what each beam met, from where the robot was, lies where it is seen from the scan's end."""
    beams, end = 360, Pose(1.0, 0.4, 0.7)
    ago = (1.0 - np.arange(beams) / (beams - 1)) * 0.1
    motion = np.array(
        [(p.x, p.y, p.yaw) for p in (arc(Pose(0, 0, 0), -linear * t, -angular * t) for t in ago)]
    )
    read = []
    for i, (x, y, yaw) in enumerate(motion):
        at = to_world(np.array([[x, y]]), end)[0]
        there = Pose(float(at[0]), float(at[1]), wrap(end.yaw + yaw))
        lidar = to_world(np.array([[mount.x, mount.y]]), there)[0]
        (xx, xy, _), (yx, yy, _), _ = mount.rotation()
        angle = -math.pi + 2.0 * math.pi * i / beams
        c, s = math.cos(angle), math.sin(angle)
        heading = np.array([there.yaw + math.atan2(yx * c + yy * s, xx * c + xy * s)])
        read.append(float(ranges(OFFICE, lidar[0], lidar[1], heading, 20.0)[0]))
    swept = to_body(
        LaserScan("lidar", 0, -math.pi, 2 * math.pi / beams, 0.1, 20.0, tuple(read)), mount, motion=motion
    )
    assert (np.diff(swept.bearings) >= 0.0).all()
    lidar = to_world(np.array([swept.origin]), end)[0]
    instant = ranges(OFFICE, lidar[0], lidar[1], swept.bearings + end.yaw, 20.0)
    apart = np.abs(instant - swept.ranges)
    hidden = apart > 1e-3  # a corner that one of the two places sees past
    assert np.count_nonzero(hidden) < 15
    ends = to_world(swept.ends, end)
    assert np.min([_away(ends, wall) for wall in OFFICE], axis=0).max() < 1e-9


def _away(points: np.ndarray, wall: np.ndarray) -> np.ndarray:
    start, way = wall[:2], wall[2:] - wall[:2]
    along = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
    away: np.ndarray = np.hypot(*(points - start - along[:, None] * way).T)
    return away


def test_surfaces_are_finer_than_ranges_and_end_at_corners() -> None:
    random = np.random.Generator(np.random.PCG64(1))
    walls = np.array([*box(-2.0, -2.0, 3.0, 2.0), *box(1.0, -0.5, 1.6, 0.3)])
    read = scan_at(walls, Pose(0.0, 0.0, 0.0), Mount(), 0, 0.01 * random.normal(size=360))
    swept = to_body(read, Mount())
    middles, normals = swept.middles[swept.straight], swept.normals[swept.straight]
    assert len(middles) > 300
    assert (np.sum(middles * normals, axis=1) < 0.0).all()  # towards the lidar
    away = np.min([_away(middles, wall) for wall in walls], axis=0)
    assert math.sqrt(np.mean(away**2)) < 0.006
    tilt = np.abs(normals).min(axis=1)
    assert np.median(tilt) < 0.05
    assert np.quantile(tilt, 0.95) < 0.2
    corners = np.hypot(*(swept.ends - (1.0, 0.3)).T) < 0.01
    assert not (swept.straight & corners & (swept.ranges > 1.3)).any()


@pytest.mark.parametrize(("sigma", "beams"), [(0.003, 360), (0.06, 360), (0.1, 360), (0.2, 360), (0.06, 90)])
def test_a_scan_shows_what_its_ranges_have_of_noise_beyond_the_usual(sigma: float, beams: int) -> None:
    beyond = math.sqrt(max(sigma**2 - 0.03**2, 0.0))
    random = np.random.Generator(np.random.PCG64(2))
    for place in (Pose(0.0, 0.0, 0.3), Pose(2.6, 3.4, 1.0), Pose(5.2, -0.8, -2.0)):
        read = scan_at(OFFICE, place, Mount(), 0, sigma * random.normal(size=beams), beams)
        assert 0.7 * beyond <= to_body(read, Mount()).noise <= 1.25 * beyond


def test_the_noisier_the_ranges_the_longer_the_surfaces_that_are_fitted() -> None:
    """At 0.1 m they lie as the walls do; two hits beside each other would show any direction."""
    random = np.random.Generator(np.random.PCG64(1))
    walls = np.array(box(-4.0, -3.0, 5.0, 3.0))
    read = scan_at(walls, Pose(0.0, 0.0, 0.0), Mount(), 0, 0.1 * random.normal(size=360))
    swept = to_body(read, Mount())
    middles, normals = swept.middles[swept.straight], swept.normals[swept.straight]
    assert len(middles) > 200
    away = np.min([_away(middles, wall) for wall in walls], axis=0)
    assert math.sqrt(np.mean(away**2)) < 0.04
    tilt = np.abs(normals).min(axis=1)
    assert np.median(tilt) < 0.06
    assert np.quantile(tilt, 0.9) < 0.25


def test_what_lies_behind_one_another_is_no_surface() -> None:
    """Ends of posts in a row along the beams, and single ones, have no surface."""
    swept = to_body(scan(*(1.0 + 0.3 * (i % 3) for i in range(60)), increment=0.02), Mount())
    assert not swept.straight.any()
    for few in ((), (1.0,), (1.0, 1.0)):
        assert not to_body(scan(*few), Mount()).straight.any()
