"""A correction of the pose enters the motion gently: the path is carried over into "odom"."""

from __future__ import annotations

from math import hypot

import pytest

from brain.belief import Pose
from brain.bodies.plane import REST, Twist, arc, moved, seen_from, wrap
from brain.control.carry import LEAST, SHARE, TURN, Carry
from tests.brain.control.ride import PERIOD, Path, Ride, acceleration, jerk
from tests.brain.helpers import BODY

FAST = Twist(0.5)
HERE = Pose(1.0, 2.0, 0.5)


@pytest.mark.parametrize(
    ("aside", "turn"), [(0.05, 0.0), (0.1, 0.0), (0.3, 0.0), (0.5, 0.0), (0.0, 0.3), (0.2, 0.2), (-0.4, 0.1)]
)
def test_a_correction_on_a_path_neither_stops_the_base_nor_throws_it_about(aside: float, turn: float) -> None:
    ride = Ride(BODY, Pose(0.0, 0.0, 0.0))
    ride.follow(Path(((0.0, 0.0), (9.0, 0.0))))
    ride.run(4.0)
    was = ride.pose
    found = Pose(was.x, was.y + aside, was.yaw + turn)
    ride.seen = lambda pose: moved(found, seen_from(was, pose))
    count, errors = len(ride.commanded), len(ride.errors)
    assert ride.run(20.0)
    after = ride.commanded[count - 1 :]
    assert min(twist.linear for twist in after[:100]) > 0.9 * BODY.max_linear
    rates = [twist.angular for twist in after]
    assert max(map(abs, rates)) < 0.6
    assert acceleration(rates) < 0.5 * BODY.max_angular_acceleration
    assert jerk(rates) < 20.0  # 35 at most
    assert max(map(abs, ride.errors[errors:])) < 0.2
    end = ride.seen(ride.pose)
    assert hypot(end.x - 9.0, end.y) < ride.motion.settings.tolerance


def test_the_path_moves_to_its_place_within_bounds_while_the_base_drives_on() -> None:
    carry, odom, now = Carry(), Pose(0.0, 0.0, 0.0), HERE
    assert carry.pose(now, odom, FAST, PERIOD) == HERE
    wrong = Pose(0.3, -0.2, 0.4)
    for _ in range(200):
        before, was = now, odom
        odom = arc(odom, FAST.linear * PERIOD, 0.3 * PERIOD)
        believed = moved(moved(HERE, wrong), odom)
        now = carry.pose(believed, odom, FAST, PERIOD)
        on = moved(before, seen_from(was, odom))
        assert hypot(now.x - on.x, now.y - on.y) <= SHARE * FAST.linear * PERIOD + 1e-9
        assert abs(wrap(now.yaw - on.yaw)) <= TURN * PERIOD + 1e-9
        off = seen_from(believed, now)
        assert carry.settled == (hypot(off.x, off.y) < 1e-6 and abs(off.yaw) < 1e-6)
    assert carry.settled


def test_at_rest_and_for_a_new_path_the_pose_is_the_one_believed_at_once() -> None:
    carry, there = Carry(), Pose(5.0, 5.0, -1.0)
    carry.pose(HERE, HERE, FAST, PERIOD)
    assert (carry.pose(there, HERE, FAST, PERIOD) == there, carry.settled) == (False, False)
    assert (carry.pose(there, HERE, REST, PERIOD) == there, carry.settled) == (True, True)
    carry.pose(HERE, HERE, FAST, PERIOD)
    carry.begin()
    assert (carry.pose(HERE, HERE, FAST, PERIOD) == HERE, carry.settled) == (True, True)


def test_what_creeps_is_corrected_too() -> None:
    carry, slow = Carry(), Twist(0.01)
    carry.pose(HERE, HERE, slow, PERIOD)
    there, settled = Pose(HERE.x + 0.1, HERE.y, HERE.yaw), []
    for _ in range(400):
        carry.pose(there, HERE, slow, PERIOD)
        settled.append(carry.settled)
    assert settled.index(True) * PERIOD == pytest.approx(0.1 / LEAST, rel=0.1)
