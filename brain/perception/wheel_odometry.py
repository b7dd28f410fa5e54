"""Wheel odometry: joints with time stamps of their own, their angles at one time, the motion between two
times, and by how much it may be wrong.

Rules. Pure functions of values. A joint's angle is interpolated between its own samples; nothing is
extrapolated, so all angles are known up to the oldest of the newest samples. Angles telescope: the end of
one travel is the start of the next, interpolated or rounded alike, so no error of a reading adds up. An angle
that jumps by more than the joint can have turned (a device was reset) is a new zero, not a motion. A silent
joint's angle contains, when it comes back, all that it has turned meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

from brain.bodies.body import Base, Travel
from brain.bodies.plane import Twist, sinc
from protocols.messages import MILLISECOND, Nanos, seconds

Sample: TypeAlias = tuple[Nanos, float]
"""Time and angle [rad]."""
Samples: TypeAlias = tuple[Sample, ...]
"""Of one joint, oldest first: the last one at or before the base, and those since."""
Point: TypeAlias = tuple[float, float, float]
"""x, y [m] and yaw [rad], which is not wrapped."""

MAX_SAMPLES = 32
"""Samples of one joint that are kept while another is silent: the path between them is lost, no travel is."""
STAMP_ERROR: Nanos = 10 * MILLISECOND
"""Two samples may be stamped by this much closer together than their angles were measured."""


LEFT, RIGHT = 0, 1


Walks: TypeAlias = tuple[float, float, float, float]
Errors: TypeAlias = tuple[float, float, float, float, float, float, float, float, Walks | None]
"""What may be wrong with one travel:
rad that a slip of 1 turns the base by, on the left and on the right, and on both if only single wheels slip;
m that the wheels rolled, on the left, on the right, and all, on average;
rad that the turn is wrong by if each angle is by 1 rad, and rad that the joints turned it by: roots of sums
of squares;
of what single wheels that slip add to that, the variances of the turn [rad²/m], along and across the travel
[m], and their covariance, over 2 σ² λ: slip of standard deviation σ and correlation length λ makes a walk;
None if nothing."""


class Rolling:
    """A body's joints as the causes of errors. Plain data.

    A wheel's slip is a share of what it rolls; so is that of a leg. That of a joint that steers is the error
    of its angle [rad], or the slip angle of its tyre: the curvature is wrong, over any way. Slip that turns
    the base is kept for two sides: what turns the base to the right when it rolls straight ahead ("left"),
    and all else. Kept is the mean of the joints of a side, which slip independently of each other; what they
    add to that is a walk. What slips in turns (`Base.turn_slip`) does so as one."""

    def __init__(self, body: Base, turn_slip: float) -> None:
        rolling, count = body.rolling, len(body.joints)
        ahead = body.inverse(Twist(body.max_linear), (0.0,) * count)
        at = [one.position or 0.0 for one in ahead]
        rest = body.travel(at, at).by_turn
        by = body.travel(at, [a + 0.01 * (one.velocity or 0.0) for a, one in zip(at, ahead, strict=True)])
        sides = [LEFT if by.by_turn[j] < 0.0 else RIGHT for j in range(count)]
        moves = [rolling[j] > 0.0 or rest[j] != 0.0 for j in range(count)]
        self.wheels = tuple(j for j in range(count) if moves[j])
        """Those that are at rest if the base is: all but those that steer."""
        self._joints = tuple(zip(sides, rolling, moves, strict=True))
        on = [sides[j] for j in range(count) if rolling[j] > 0.0]
        self._left, self._right = on.count(LEFT), on.count(RIGHT)
        self._roots = math.sqrt(max(sides.count(LEFT), 1)), math.sqrt(max(sides.count(RIGHT), 1))
        self._any_way, self._slip = body.moves_sideways, body.turn_slip / turn_slip
        self._pair = rolling if sides == [LEFT, RIGHT] and all(rolling) and not self._slip else None
        """One wheel on each side: the same in fewer steps"""

    def errors(self, travel: Travel, turned: Sequence[float]) -> Errors:
        """Return what may be wrong with a travel in which the joints turned by this [rad]."""
        if self._pair is not None:
            (left, right), (a, b), (radius, other) = travel.by_turn, turned, self._pair
            on_left, on_right, one, two = left * a, right * b, radius * abs(a), other * abs(b)
            size, turning = math.hypot(left, right), math.hypot(on_left, on_right)
            return on_left, on_right, turning, one, two, 0.5 * (one + two), size, turning, None
        sums, squares, ways = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        rounding = turning = 0.0
        for (side, roll, moves), by, angle in zip(self._joints, travel.by_turn, turned, strict=True):
            share = by * angle
            turning += share * share
            if moves:
                ways[side] += roll * abs(angle)
                rounding += by * by
            else:
                share = 2.0 * by  # the same error at both ends of the travel
            sums[side] += share
            squares[side] += share * share
        way = (ways[0] + ways[1]) / max(self._left + self._right, 1)
        means = [total / root for total, root in zip(sums, self._roots, strict=True)]
        single = max(squares[0] + squares[1] - means[0] ** 2 - means[1] ** 2, 0.0) / way if way else 0.0
        walk = (0.0, 0.0, 0.0)
        if self._any_way:
            walk = self._walk(travel, turned, way)
        elif self._slip:
            slip = self._slip * abs(sums[0] + sums[1]) / max(abs(sums[0]) + abs(sums[1]), 1e-12)
            means = [math.copysign(math.hypot(a, slip * b), b) for a, b in zip(means, sums, strict=True)]
            walk = slip * slip * way, slip * slip * way, 0.0
        return (
            means[0],
            means[1],
            math.sqrt(squares[0] + squares[1]),
            ways[0] / self._left if self._left else way,
            ways[1] / self._right if self._right else way,
            way,
            math.sqrt(rounding),
            math.sqrt(turning),
            (single, *walk),
        )

    def _walk(self, travel: Travel, turned: Sequence[float], way: float) -> tuple[float, float, float]:
        """Return by how much single wheels that slip displace the base: the last three of the errors."""
        along = across = both = 0.0
        rows = zip(self._joints, travel.by_distance, travel.by_sideways, turned, strict=True)
        for (_, roll, moves), by_x, by_y, angle in rows:
            if moves:
                share = abs(angle) / roll if roll else 0.0
            else:
                share = 4.0 / way if way else 0.0
            along += share * by_x * by_x
            across += share * by_y * by_y
            both += share * by_x * by_y
        return along, across, both


def jumped(fastest: float, last: Sample, new: Sample, margin: float, resolution: float) -> bool:
    """Return whether a joint of this largest speed [rad/s] cannot have turned so far."""
    possible = fastest * margin * seconds(new[0] - last[0] + STAMP_ERROR) + 2.0 * resolution
    return abs(new[1] - last[1]) > possible


def added(samples: Samples, new: Sample, base: Nanos) -> Samples:
    """Return the samples with a new one, without those that no time from the base on needs."""
    drop = 0
    while drop + 1 < len(samples) and samples[drop + 1][0] <= base:
        drop += 1
    if len(samples) - drop >= MAX_SAMPLES:
        return (samples[drop], *samples[drop + 2 :], new)
    return (*samples[drop:], new)


def angle_at(samples: Samples, t: Nanos) -> float:
    """Return a joint's angle at a time within its samples."""
    after = samples[-1]
    if after[0] == t:
        return after[1]
    for before in reversed(samples[:-1]):
        if before[0] <= t:
            return before[1] + (after[1] - before[1]) * ((t - before[0]) / (after[0] - before[0]))
        after = before
    return after[1]


def arc_end(start: Point, distance: float, turn: float, sideways: float = 0.0) -> Point:
    """Return the end of a motion of constant twist, as `brain.bodies.plane.arc`; yaw is not wrapped."""
    half = turn / 2.0
    chord = sinc(half)
    x, y, yaw = start
    c, s, along = math.cos(yaw + half), math.sin(yaw + half), distance * chord
    if sideways:
        across = sideways * chord
        return x + along * c - across * s, y + along * s + across * c, yaw + turn
    return x + along * c, y + along * s, yaw + turn


def arc_slopes(
    yaw: float, distance: float, turn: float, sideways: float = 0.0
) -> tuple[float, float, float, float, float, float]:
    """Return the end of a motion of constant twist relative to its start, dx and dy; their derivatives by
    the distance (of its chord, if short, also the direction); and by the turn."""
    half = turn / 2.0
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    if abs(half) < 1e-4:
        chord, slope = 1.0 - half * half / 6.0, -half / 3.0
    else:
        chord = math.sin(half) / half
        slope = (half * math.cos(half) - math.sin(half)) / (half * half)
    by_x, by_y = chord * c, chord * s
    turn_x, turn_y = slope * c - by_y, slope * s + by_x
    ahead = 0.5 * distance
    if sideways:
        aside = 0.5 * sideways
        return (
            distance * by_x - sideways * by_y,
            distance * by_y + sideways * by_x,
            by_x,
            by_y,
            ahead * turn_x - aside * turn_y,
            ahead * turn_y + aside * turn_x,
        )
    return distance * by_x, distance * by_y, by_x, by_y, ahead * turn_x, ahead * turn_y
