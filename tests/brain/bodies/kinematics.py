"""Kinematics of a base as plain numbers, for the tests."""

from __future__ import annotations

from brain.bodies.body import Base
from brain.bodies.plane import Twist


def speeds(body: Base, linear: float, angular: float, lateral: float = 0.0) -> tuple[float, ...]:
    """The wheels' speeds [rad/s] for a twist, of a body without steering."""
    setpoints = body.inverse(Twist(linear, angular, lateral), (None,) * len(body.joints))
    return tuple(one.velocity for one in setpoints if one.velocity is not None)


def rolled(body: Base, *angles: float) -> tuple[float, float]:
    """Distance and turn [m, rad] after these wheel angles [rad]."""
    travel = body.travel((0.0,) * len(angles), angles)
    return travel.distance, travel.turn
