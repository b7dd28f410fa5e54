"""Positions and poses from outside: GPS fixes and pose readings as measurements for the filter.

Rules. A fix becomes metres in the tangent plane at a datum, the place of the origin of the frame "map",
whose x axis points east; without a datum in the settings the first fix is it. Heights are left out. A robot
whose start yaw is not known needs a large `FilterSettings.start_yaw_sigma`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from brain.perception.filter_inputs import PoseFix
from protocols.bounds import Bounds, Invalid, check
from protocols.messages import Fix, PoseReading

SEMI_MAJOR = 6_378_137.0
"""m; with SQUARE, the squared eccentricity, the ellipsoid of WGS 84 (NGA.STND.0036, table 3.1)"""
SQUARE = 6.694_379_990_141e-3


@dataclass(frozen=True, slots=True)
class FixSettings:
    """Datum, and the errors of sources that do not report any."""

    latitude: Annotated[float, Bounds(-90.0, 90.0, "deg")] | None = None
    """deg, of the origin of the frame "map"; None: the first fix"""
    longitude: Annotated[float, Bounds(-180.0, 180.0, "deg")] | None = None
    fix_sigma: Annotated[float, Bounds(1e-3, 1000.0, "m")] = 2.0
    """m, of a fix without a variance"""
    pose_sigma: Annotated[float, Bounds(1e-4, 100.0, "m")] = 0.02
    """m, of a pose reading without a variance"""
    yaw_sigma: Annotated[float, Bounds(1e-4, 4.0, "rad")] = 0.02
    """rad, of a pose reading without a variance of its yaw"""

    def __post_init__(self) -> None:
        check(self)
        if (self.latitude is None) != (self.longitude is None):
            stated = "longitude" if self.latitude is None else "latitude"
            raise Invalid((stated, "latitude and longitude: both or neither"))


LEAST_VARIANCE, MOST_VARIANCE = 1e-8, 1e12
"""m² and rad²: a smaller one is taken for the least; with a larger one nothing is known."""
FARTHEST = 1e6
"""m from the origin of the frame "map", along x and y"""


def is_possible(event: Fix | PoseReading) -> bool:
    """Return whether it is a place that a robot may be at, or one on the earth."""
    if isinstance(event, PoseReading):
        place = abs(event.x) <= FARTHEST and abs(event.y) <= FARTHEST and abs(event.yaw or 0.0) <= FARTHEST
        variances = [event.variance, event.yaw_variance]
    else:
        place, variances = abs(event.latitude) <= 90.0 and abs(event.longitude) <= 360.0, [event.variance]
    return place and all(one is None or 0.0 <= one <= MOST_VARIANCE for one in variances)


class Fixes:
    """Makes measurements of fixes and pose readings."""

    def __init__(self, settings: FixSettings) -> None:
        self.settings = settings
        self.datum: tuple[float, float] | None = None
        """Latitude and longitude [rad] of the origin."""
        if settings.latitude is not None and settings.longitude is not None:
            self.datum = math.radians(settings.latitude), math.radians(settings.longitude)

    def observe(self, event: Fix | PoseReading) -> PoseFix:
        """Return the measurement that an event is."""
        settings = self.settings
        if isinstance(event, PoseReading):
            variance = _variance(event.variance, settings.pose_sigma)
            variances, value = [variance, variance], [event.x, event.y]
            if event.yaw is not None:
                variances.append(_variance(event.yaw_variance, settings.yaw_sigma))
                value.append(event.yaw)
            return PoseFix(event.sensor, event.t, np.array(value), np.diag(variances))
        place = math.radians(event.latitude), math.radians(event.longitude)
        self.datum = self.datum or place
        variance = _variance(event.variance, settings.fix_sigma)
        return PoseFix(event.sensor, event.t, np.array(tangent(place, self.datum)), np.eye(2) * variance)


def tangent(place: tuple[float, float], datum: tuple[float, float]) -> tuple[float, float]:
    """Return a place (latitude, longitude [rad]) on the ellipsoid in the tangent plane at a datum: m east, m
    north."""
    (x, y, z), (x0, y0, z0) = _cartesian(*place), _cartesian(*datum)
    x, y, z = x - x0, y - y0, z - z0
    sp, cp, sl, cl = math.sin(datum[0]), math.cos(datum[0]), math.sin(datum[1]), math.cos(datum[1])
    return -sl * x + cl * y, -sp * cl * x - sp * sl * y + cp * z


def _cartesian(latitude: float, longitude: float) -> tuple[float, float, float]:
    normal = SEMI_MAJOR / math.sqrt(1.0 - SQUARE * math.sin(latitude) ** 2)
    across = normal * math.cos(latitude)
    return (
        across * math.cos(longitude),
        across * math.sin(longitude),
        normal * (1.0 - SQUARE) * math.sin(latitude),
    )


def _variance(measured: float | None, sigma: float) -> float:
    return max(measured if measured is not None else sigma * sigma, LEAST_VARIANCE)
