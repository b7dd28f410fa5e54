"""Wheels on the floor: what each measures of the base's twist, and the twist that fits them all.

A row is the derivative of a wheel's speed on the floor by the twist: (forward, turn, to the left), in m/s per
m/s, rad/s and m/s (Lynch and Park 2017, section 13.2). There are more wheels than directions of motion, so
the twist is that of least squares: exact if all wheels roll without slipping. What is linear for speeds is
so for travelled angles: a constant twist turns each wheel at a constant speed.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, NamedTuple, TypeAlias

from brain.bodies.body import Base, Setpoint, Travel
from brain.bodies.parts import Wheel
from brain.bodies.plane import Twist
from protocols.bounds import Bounds
from protocols.messages import Command

Row: TypeAlias = tuple[float, float, float]
LEAST_PIVOT = 1e-9
"""Of the normal equations: below, the wheels do not determine the twist."""
STANDING = 1e-4
"""m/s: a wheel that shall roll more slowly is not steered."""


def rolling_row(x: float, y: float, direction: float) -> Row:
    """Return the row of a wheel at x, y [m] that rolls in a direction [rad] of the base."""
    c, s = math.cos(direction), math.sin(direction)
    return c, x * s - y * c, s


def sliding_row(x: float, y: float, direction: float) -> Row:
    """Return the row of the same wheel's speed across, to its left: 0 of a wheel that does not slip."""
    c, s = math.cos(direction), math.sin(direction)
    return -s, x * c + y * s, c


def roller_row(x: float, y: float, direction: float, roller: float) -> Row:
    """Return the row of a wheel with rollers: `roller` [rad] is the angle from across the wheel to the
    direction in which it moves freely; 0: an omni wheel, ± 45 degrees: a Mecanum wheel (equation 13.5)."""
    along, across, slope = rolling_row(x, y, direction), sliding_row(x, y, direction), math.tan(roller)
    return along[0] + slope * across[0], along[1] + slope * across[1], along[2] + slope * across[2]


def dot(row: Row, twist: Sequence[float]) -> float:
    """Return what a row measures of a twist (forward, turn, to the left)."""
    return row[0] * twist[0] + row[1] * twist[1] + row[2] * twist[2]


@lru_cache(maxsize=64)
def gains(rows: tuple[Row, ...], unknowns: int = 3) -> tuple[Row, ...]:
    """Return by wheel the derivative of the fitted twist by the wheel's speed: the columns of the
    pseudo-inverse. With 2 unknowns the base does not move sideways.

    Raises ValueError if the wheels do not determine the twist."""
    inverse = normal_inverse(rows, unknowns)
    return tuple(times(inverse, row) for row in rows)


def normal_inverse(rows: Sequence[Row], unknowns: int = 3) -> tuple[Row, Row, Row]:
    """Return the inverse of the normal equations, by Cramer's rule; symmetric. Raises ValueError."""
    a = b = c = d = e = f = 0.0
    for x, y, z in rows:
        a, b, c, d, e, f = a + x * x, b + x * y, c + x * z, d + y * y, e + y * z, f + z * z
    if unknowns == 2:
        c, e, f = 0.0, 0.0, 1.0
    one, two, three = d * f - e * e, c * e - b * f, b * e - c * d
    whole = a * one + b * two + c * three
    if not whole > LEAST_PIVOT * a * d * f:
        raise ValueError("the wheels do not determine how the base moves")
    four, five, six = (a * f - c * c) / whole, (b * c - a * e) / whole, (a * d - b * b) / whole
    one, two, three = one / whole, two / whole, three / whole
    if unknowns == 2:
        return (one, two, 0.0), (two, four, 0.0), (0.0, 0.0, 0.0)
    return (one, two, three), (two, four, five), (three, five, six)


def times(matrix: tuple[Row, Row, Row], vector: Row) -> Row:
    """Return a matrix times a vector."""
    return dot(matrix[0], vector), dot(matrix[1], vector), dot(matrix[2], vector)


def scaled(vector: Row, factor: float) -> Row:
    """Return a vector times a number."""
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


def weighted(columns: Sequence[Row], weights: Sequence[float]) -> Row:
    """Return the sum of columns times weights."""
    first = second = third = 0.0
    for column, weight in zip(columns, weights, strict=True):
        first += column[0] * weight
        second += column[1] * weight
        third += column[2] * weight
    return first, second, third


@dataclass(frozen=True, slots=True, kw_only=True)
class WheeledBase(Base):
    """A base on wheels of one radius."""

    wheel_radius: Annotated[float, Bounds(0.005, 2.0, "m")]
    max_wheel_speed: Annotated[float, Bounds(1e-3, 1e4, "rad/s")] | None = None
    """rad/s of a wheel; None: what the largest speeds of the base together need"""

    def top_speed(self, row: Row) -> float:
        """Return the largest speed [rad/s] of a wheel with this row."""
        if self.max_wheel_speed is not None:
            return self.max_wheel_speed
        lateral = (self.max_lateral or self.max_linear) if self.moves_sideways else 0.0
        angular = self.max_angular
        if self.turning_radius > 0.0:
            angular = min(angular, self.max_linear / self.turning_radius)
        most = math.hypot(row[0] * self.max_linear, row[2] * lateral) + abs(row[1]) * angular
        return max(most, 1e-3) / self.wheel_radius


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedWheels(WheeledBase):
    """A base whose wheels do not steer: their speeds are linear in the twist."""

    def __post_init__(self) -> None:
        Base.__post_init__(self)
        gains(self.rows, self.unknowns)

    @property
    @abstractmethod
    def rows(self) -> tuple[Row, ...]:
        """The row of each wheel, in the order of `joints`."""

    @property
    def unknowns(self) -> int:
        """Directions of motion."""
        return 3 if self.moves_sideways else 2

    @property
    def top_speeds(self) -> tuple[float, ...]:
        """Largest speed of each wheel [rad/s]."""
        return tuple(map(self.top_speed, self.rows))

    @property
    def rolling(self) -> tuple[float, ...]:
        """The radius of each wheel [m]."""
        return (self.wheel_radius,) * len(self.joints)

    def inverse(self, twist: Twist, positions: Sequence[float | None] = ()) -> tuple[Setpoint, ...]:
        """Return the wheels' speeds [rad/s]."""
        lateral = twist.lateral if self.moves_sideways else 0.0
        able = (twist.linear, twist.angular, lateral)
        return tuple(Setpoint(dot(row, able) / self.wheel_radius) for row in self.rows)

    def travel(self, before: Sequence[float], after: Sequence[float]) -> Travel:
        """Return the motion that fits the angles rolled, by least squares; exact without slip."""
        columns, radius = gains(self.rows, self.unknowns), self.wheel_radius
        rolled = [radius * (b - a) for a, b in zip(before, after, strict=True)]
        first, second, third = (tuple(radius * column[i] for column in columns) for i in range(3))
        return Travel(*weighted(columns, rolled), first, second, third)


class Contact(NamedTuple):
    """A wheel of a base whose wheels steer: where it touches the floor, and its joints."""

    x: float
    """m"""
    y: float
    drive: int | None
    """Index of the joint that turns it; None: it is not driven,"""
    steering: int | None
    """and of the one that steers it, about a vertical axis through its point of contact; None: forward."""


SteeringError: TypeAlias = Annotated[float, Bounds(0.02, math.pi / 2.0, "rad")]


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeredWheels(WheeledBase):
    """A base with wheels that steer, 0 being forward: it goes slowly until they point the right way, each
    wheel driven by what of its velocity lies in its direction; at rest they stay as they are."""

    max_steering: Annotated[float, Bounds(0.05, 1e4, "rad")] | None = None
    """rad, to either side; None: endless"""
    steering_error: SteeringError
    """rad: with its fastest wheel this far from its direction the base does not drive; from half of it on,
    its speed is scaled by a cosine"""
    steering_lag: Annotated[float, Bounds(0.0, 1.0, "s")] = 0.06
    """s from the command of a steering angle to the wheel being there: it is commanded as much earlier"""

    @property
    @abstractmethod
    def contacts(self) -> tuple[Contact, ...]:
        """Every wheel that drives or steers."""

    @property
    def stands_on(self) -> tuple[Wheel, ...]:
        """The wheels that drive or steer."""

        def motor(index: int | None) -> str:
            return "" if index is None else self.joints[index]

        radius = self.wheel_radius
        return tuple(
            Wheel(x, y, radius, motor(drive), motor(steers)) for x, y, drive, steers in self.contacts
        )

    @property
    def top_speeds(self) -> tuple[float, ...]:
        """Largest speed of each driven wheel [rad/s]; inf for those that steer."""
        most = [math.inf] * len(self.joints)
        for x, y, drive, steering in self.contacts:
            if drive is not None:
                arm = y if steering is None else math.hypot(x, y)
                most[drive] = self.top_speed((1.0, arm, 0.0))
                if steering is not None:
                    most[drive] = max(most[drive], self.top_speed((0.0, arm, 1.0)))
        return tuple(most)

    @property
    def rolling(self) -> tuple[float, ...]:
        """The radius of each driven wheel [m]; 0 for those that steer."""
        driven = {contact.drive for contact in self.contacts}
        return tuple(self.wheel_radius if i in driven else 0.0 for i in range(len(self.joints)))

    def inverse(self, twist: Twist, positions: Sequence[float | None]) -> tuple[Setpoint, ...]:
        """Return the joints' set-points for a twist."""
        return self._steer(twist, twist, positions)

    def actuate(
        self, twist: Twist, positions: Sequence[float | None], dt: float, memory: Any
    ) -> tuple[tuple[Command, ...], Any]:
        """Return one command per joint: steered for the twist when the wheels will be there, if it goes on
        changing as since the last command. The memory: the twist before."""
        ahead = self.steering_lag / dt
        soon = Twist(*(now + ahead * (now - was) for now, was in zip(twist, memory or twist, strict=True)))
        return self.commands(self._steer(twist, soon, positions)), twist

    def readiness(self, twist: Twist, positions: Sequence[float | None]) -> float:
        """Return the share of a twist, from 0 to 1, that may be driven with the wheels' present directions.

        The slower a wheel is to roll, the less its direction matters: what it slips, and what the base is
        pushed aside by it, both are in proportion to its speed."""
        share, fastest = 1.0, max(math.hypot(*self._at(one, twist)) for one in self.contacts)
        for contact in self.contacts:
            present = None if contact.steering is None else positions[contact.steering]
            forward, left = self._at(contact, twist)
            speed = math.hypot(forward, left)
            if present is None or speed < STANDING:
                continue
            error = nearest(math.atan2(left, forward), present, self.max_steering)[0] - present
            turned = min(max(2.0 * abs(error) / self.steering_error - 1.0, 0.0), 1.0)
            share = min(share, 1.0 - (speed / fastest) ** 2 * (1.0 - math.cos(turned * math.pi / 2.0)))
        return max(share, 0.0)

    def _at(self, contact: Contact, twist: Twist) -> tuple[float, float]:
        """Return the velocity of a wheel's axle [m/s]: forward, to the left."""
        lateral = twist.lateral if self.moves_sideways else 0.0
        return twist.linear - twist.angular * contact.y, lateral + twist.angular * contact.x

    def _steer(self, twist: Twist, soon: Twist, positions: Sequence[float | None]) -> tuple[Setpoint, ...]:
        """Return the set-points: steered for the twist soon, driven by this one as the wheels point now."""
        setpoints = [Setpoint()] * len(self.joints)
        for contact in self.contacts:
            forward, left = self._at(contact, twist)
            if contact.steering is not None:
                present, (ahead, aside) = positions[contact.steering], self._at(contact, soon)
                if math.hypot(ahead, aside) >= STANDING:
                    angle, _ = nearest(math.atan2(aside, ahead), present, self.max_steering)
                    setpoints[contact.steering] = Setpoint(position=angle)
                    present = angle if present is None else present
                forward = forward * math.cos(present or 0.0) + left * math.sin(present or 0.0)
            if contact.drive is not None:
                setpoints[contact.drive] = Setpoint(forward / self.wheel_radius)
        return tuple(setpoints)

    def travel(self, before: Sequence[float], after: Sequence[float]) -> Travel:
        """Return the motion that fits all wheels that roll, and do not slip sideways where they are steered,
        by least squares: exact while the steering does not turn, else with its angles midway."""
        rows: list[Row] = []
        values: list[float] = []
        sources: list[tuple[int | None, int | None, Row]] = []
        for x, y, drive, steering in self.contacts:
            turned = 0.0 if steering is None else (before[steering] + after[steering]) / 2.0
            along, across = rolling_row(x, y, turned), sliding_row(x, y, turned)
            if drive is not None:
                rows.append(along)
                values.append(self.wheel_radius * (after[drive] - before[drive]))
                sources.append((drive, steering, across))
            if steering is not None:
                rows.append(across)
                values.append(0.0)
                sources.append((None, steering, (-along[0], -along[1], -along[2])))
        inverse = normal_inverse(rows, 3 if self.moves_sideways else 2)
        motion = times(inverse, weighted(rows, values))
        by = [(0.0, 0.0, 0.0)] * len(self.joints)
        for row, value, (drive, steering, slope) in zip(rows, values, sources, strict=True):
            if drive is not None:
                by[drive] = scaled(times(inverse, row), self.wheel_radius)
            if steering is not None:  # derivative of M⁻¹ Aᵀ b; the angle midway moves by half
                missed, changed = (value - dot(row, motion)) / 2.0, dot(slope, motion) / -2.0
                both = weighted((slope, row), (missed, changed))
                by[steering] = weighted((by[steering], times(inverse, both)), (1.0, 1.0))
        return Travel(*motion, *zip(*by, strict=True))


def nearest(direction: float, present: float | None, most: float | None) -> tuple[float, bool]:
    """Return the steering angle [rad] nearest to the present one with which a wheel rolls in a direction,
    forward or backward, within ± `most` if there is such a limit; and whether backward."""
    turns = round(((present or 0.0) - direction) / math.pi)
    if most is None:
        return direction + turns * math.pi, turns % 2 == 1
    low = math.ceil((-most - direction) / math.pi - 1e-9)
    high = math.floor((most - direction) / math.pi + 1e-9)
    turns = min(max(turns, low), high) if low <= high else round(-direction / math.pi)
    return min(max(direction + turns * math.pi, -most), most), turns % 2 == 1
