"""Acceleration limits: from the commanded twist towards the wanted one.

Rules. A pure function of (previous, wanted, dt). The linear speed has priority; while the base speeds up the
angular speed follows it at the wanted curvature, so that the base stays on its arc. Previous is the
*commanded* twist, not the measured one.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite


@dataclass(frozen=True, slots=True)
class Twist:
    """Motion of a base: m/s forward, rad/s to the left."""

    linear: float = 0.0
    angular: float = 0.0


REST = Twist()


def approach(
    previous: Twist, wanted: Twist, dt: float, linear_acceleration: float, angular_acceleration: float
) -> Twist:
    """Return the next twist, dt [s] after the previous, within both accelerations [m/s², rad/s²].

    A wanted twist that is not finite counts as rest; a dt that is not positive changes nothing."""
    if not (isfinite(wanted.linear) and isfinite(wanted.angular)):
        wanted = REST
    if not dt > 0.0:
        return previous
    linear = step(previous.linear, wanted.linear, linear_acceleration * dt)
    angular = wanted.angular
    if abs(wanted.linear) > 1e-6 and abs(linear) < abs(wanted.linear):
        angular *= linear / wanted.linear
    return Twist(linear, step(previous.angular, angular, angular_acceleration * dt))


def step(previous: float, wanted: float, largest: float) -> float:
    """Move from previous towards wanted, by at most `largest`."""
    return min(max(wanted, previous - largest), previous + largest)
