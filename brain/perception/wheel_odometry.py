"""Wheel odometry: two wheels with time stamps of their own, their angles at one time, and the arc between two
times.

Rules. Pure functions of values. A wheel's angle is interpolated between its own samples; nothing is
extrapolated, so both angles are known up to the older of the two newest samples. Angles telescope: the end of
one travel is the start of the next, interpolated or rounded alike, so no error of a reading adds up. An angle
that jumps by more than the wheel can have turned (a device was reset) is a new zero, not a motion. A silent
wheel's angle contains, when it comes back, all that it has turned meanwhile.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from brain.bodies.differential import Differential, sinc
from protocols.messages import MILLISECOND, Nanos, seconds

Sample: TypeAlias = tuple[Nanos, float]
"""Time and angle [rad]."""
Samples: TypeAlias = tuple[Sample, ...]
"""Of one wheel, oldest first: the last one at or before the base, and those since."""
Point: TypeAlias = tuple[float, float, float]
"""x, y [m] and yaw [rad], which is not wrapped."""

MAX_SAMPLES = 32
"""Samples of one wheel that are kept while the other is silent: the path between them is lost, no travel is.
"""
STAMP_ERROR: Nanos = 10 * MILLISECOND
"""Two samples may be stamped by this much closer together than their angles were measured."""


def jumped(body: Differential, last: Sample, new: Sample, margin: float, resolution: float) -> bool:
    """Return whether a wheel cannot have turned so far."""
    possible = body.wheel_speed * margin * seconds(new[0] - last[0] + STAMP_ERROR) + 2.0 * resolution
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
    """Return a wheel's angle at a time within its samples."""
    after = samples[-1]
    if after[0] == t:
        return after[1]
    for before in reversed(samples[:-1]):
        if before[0] <= t:
            return before[1] + (after[1] - before[1]) * ((t - before[0]) / (after[0] - before[0]))
        after = before
    return after[1]


def arc_end(start: Point, distance: float, turn: float) -> Point:
    """Return the end of an arc of this length and turn; exact, also if straight."""
    half = turn / 2.0
    chord = distance * sinc(half)
    x, y, yaw = start
    return x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half), yaw + turn


def arc_slopes(yaw: float, distance: float, turn: float) -> tuple[float, float, float, float, float, float]:
    """Return an arc's end relative to its start, dx and dy; and the derivatives of x and y by the arc's
    length (also the direction of its chord, if short) and by its turn."""
    half = turn / 2.0
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    if abs(half) < 1e-4:
        chord, slope = 1.0 - half * half / 6.0, -half / 3.0
    else:
        chord = math.sin(half) / half
        slope = (half * math.cos(half) - math.sin(half)) / (half * half)
    across = 0.5 * distance
    by_x, by_y = chord * c, chord * s
    return (
        distance * by_x,
        distance * by_y,
        by_x,
        by_y,
        across * (slope * c - by_y),
        across * (slope * s + by_x),
    )
