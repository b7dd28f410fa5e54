"""From the twist that was commanded to the twist that is wanted, no faster than the base can.

Rules. A pure function of (previous, wanted, dt): no state, so it can be tested and replayed by itself.
The linear speed goes first; while the base speeds up the angular speed follows it at the wanted curvature,
so that it stays on its arc. Previous is what was *commanded*, not what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite


@dataclass(frozen=True, slots=True)
class Twist:
    """The motion of a base: m/s forward, rad/s to the left."""

    linear: float = 0.0
    angular: float = 0.0


REST = Twist()


def approach(
    previous: Twist, wanted: Twist, dt: float, linear_acceleration: float, angular_acceleration: float
) -> Twist:
    """The next twist, dt [s] after the previous, within both accelerations [m/s², rad/s²].

    A wanted twist that is not finite is rest; a dt that is not positive changes nothing."""
    if not (isfinite(wanted.linear) and isfinite(wanted.angular)):
        wanted = REST
    if not dt > 0.0:
        return previous
    linear = step(previous.linear, wanted.linear, linear_acceleration * dt)
    angular = wanted.angular
    if abs(wanted.linear) > 1e-6 and abs(linear) < abs(wanted.linear):
        angular *= linear / wanted.linear
    return Twist(linear, step(previous.angular, angular, angular_acceleration * dt))


def step(previous: float, wanted: float, most: float) -> float:
    """From previous to wanted, by at most so much."""
    return min(max(wanted, previous - most), previous + most)
