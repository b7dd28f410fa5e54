"""A boom: lengths of cylinders for angles of joints, both ways; forces; places for its tip."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from brain.bodies.arm import SerialArm
from brain.bodies.body import Placement
from brain.bodies.boom import Boom
from brain.bodies.cylinder import Cylinder
from gateway.config import load_robot
from protocols.bounds import Invalid


def shipped() -> Boom:
    body = load_robot("boom").brain.body
    assert isinstance(body, Boom)
    return body


BODY = shipped()
LIFT, FOLD = (BODY.cylinders[name] for name in ("lift", "fold"))
PLACES = [(-0.2, -2.1), (0.0, -1.6), (0.4, -0.9), (0.85, -0.4)]
"""Joint angles [rad]"""


@pytest.mark.parametrize("cylinder", [LIFT, FOLD], ids=["extends", "against"])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.8, 1.0])
def test_length_and_angle_are_inverse_and_the_lever_is_the_slope(cylinder: Cylinder, share: float) -> None:
    low, high = (-0.2, 0.85) if cylinder is LIFT else (-2.1, -0.4)
    angle = low + share * (high - low)
    assert cylinder.position(cylinder.length(angle)) == pytest.approx(angle)
    slope = (cylinder.length(angle + 1e-6) - cylinder.length(angle - 1e-6)) / 2e-6
    assert cylinder.lever(angle) == pytest.approx(slope, rel=1e-5)
    assert (cylinder.lever(angle) > 0.0) is (cylinder is LIFT)


def test_a_right_angle_by_hand() -> None:
    cylinder = Cylinder(base=3.0, rod=4.0, angle=math.pi / 2.0)
    assert cylinder.length(0.0) == pytest.approx(5.0)
    assert cylinder.lever(0.0) == pytest.approx(3.0 * 4.0 / 5.0)
    assert cylinder.position(5.0) == pytest.approx(0.0)
    assert cylinder.position(99.0) == pytest.approx(math.pi / 2.0)  # the longest there is


def test_its_joints_are_lengths_and_its_points_those_of_the_arm() -> None:
    arm = SerialArm(axes=BODY.axes, tip=BODY.tip, urdf=BODY.urdf)
    for angles in PLACES:
        lengths = BODY.lengths(angles)
        assert BODY.angles(lengths) == pytest.approx(angles)
        for point, other in zip(BODY.points(lengths), arm.points(angles), strict=True):
            assert point == pytest.approx(other)
    (low, high), (shortest, longest) = BODY.ranges
    assert (low, high) == pytest.approx((LIFT.length(-0.2), LIFT.length(0.85)))
    assert (shortest, longest) == pytest.approx((FOLD.length(-0.4), FOLD.length(-2.1)))


def test_forces_do_the_work_of_gravity() -> None:
    """Virtual work: what the centres of mass rise by is what the cylinders push."""

    def energy(angles: tuple[float, ...]) -> float:
        lift, fold = angles
        boom = 60.0 * 0.6 * math.sin(lift)
        return 9.81 * (boom + 30.0 * (1.2 * math.sin(lift) + 0.35 * math.sin(lift + fold)))

    for angles in PLACES:
        lengths = BODY.lengths(angles)
        forces = BODY.gravity(lengths)
        for joint in range(2):
            moved = list(lengths)
            moved[joint] += 1e-6
            work = (energy(BODY.angles(moved)) - energy(angles)) / 1e-6
            assert forces[joint] == pytest.approx(work, rel=1e-3, abs=0.1)


@pytest.mark.parametrize(("x", "z"), [(1.3, 0.5), (1.7, 1.2), (1.3, 0.95)])
def test_a_place_is_found_as_lengths(x: float, z: float) -> None:
    search = BODY.search(BODY.lengths((0.0, -1.6)), Placement(x, 0.0, z))
    while not search.advance(50):
        pass
    assert search.found is not None
    assert BODY.points(search.found)[-1] == pytest.approx((x, 0.0, z), abs=2e-4)
    assert all(low <= each <= high for each, (low, high) in zip(search.found, BODY.ranges, strict=True))


def test_a_place_out_of_reach_says_why() -> None:
    search = BODY.search(BODY.lengths((0.0, -1.6)), Placement(5.0, 0.0, 0.0))
    while not search.advance(500):
        pass
    assert search.found is None
    assert search.why


@pytest.mark.parametrize(
    ("cylinders", "wrong"),
    [
        ({"lift": replace(LIFT, angle=0.1)}, "its mounts are -0.1 to 0.95 rad apart"),
        ({"lift": replace(LIFT, angle=2.9)}, "its mounts are 2.7 to 3.75 rad apart"),
        ({"hoist": LIFT}, "no axis has a motor 'hoist'; there is lift, fold"),
    ],
)
def test_a_cylinder_that_cannot_be(cylinders: dict[str, Cylinder], wrong: str) -> None:
    with pytest.raises(Invalid, match=wrong):
        replace(BODY, cylinders=cylinders)
