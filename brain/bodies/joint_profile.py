"""Jerk-limited profiles of joints, alone or synchronised: from any state to rest at a goal, in closed form.

Rules. A profile is at most seven parts of constant jerk (the double S: Biagiotti and Melchiorri 2008,
"Trajectory Planning for Automatic Machines and Robots", chapter 3): the velocity changes to that of the
cruise as fast as the limits allow, stays, and changes to 0. The cruise's velocity is the one with which the
profile ends at the goal. From rest, and from a constant velocity, that is the fastest profile there is; where
the acceleration at the start is not 0 it may be a little longer than the fastest.
A start beyond a limit is brought within it at once, and never makes the goal be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import copysign, isfinite, sqrt
from typing import NamedTuple, TypeAlias

HALVINGS = 26
"""Of the velocities in question: more would not make a profile shorter by a part in a million"""
LEAST = 1e-12
"""rad or rad/s below which nothing is left to do"""


class JointState(NamedTuple):
    """Of one joint: rad, rad/s, rad/s²."""

    position: float
    velocity: float = 0.0
    acceleration: float = 0.0


class JointLimits(NamedTuple):
    """Magnitudes, all above 0: rad/s, rad/s², rad/s³."""

    velocity: float
    acceleration: float
    jerk: float


Part: TypeAlias = tuple[float, float]
"""Duration [s] and jerk [rad/s³]"""


@dataclass(frozen=True, slots=True)
class Profile:
    """The motion of one joint, from a state to rest at the goal."""

    start: JointState
    goal: float
    parts: tuple[Part, ...]
    slower: float = 1.0
    """By how much the time is stretched: 1 as planned, 2 takes twice as long"""

    @property
    def duration(self) -> float:
        """Time [s] until it rests."""
        return self.slower * sum(time for time, _ in self.parts)

    def at(self, t: float) -> JointState:
        """Return the state t [s] after the start; at the end exactly the goal, at rest."""
        if t >= self.duration:
            return JointState(self.goal)
        left, state = max(t, 0.0) / self.slower, self.start
        for time, jerk in self.parts:
            state = _after(state, min(time, left), jerk)
            left -= time
            if left <= 0.0:
                break
        slow = 1.0 / self.slower
        return JointState(state.position, state.velocity * slow, state.acceleration * slow * slow)


@dataclass(frozen=True, slots=True)
class Profiles:
    """The motion of several joints that end together."""

    joints: tuple[Profile, ...]

    @property
    def duration(self) -> float:
        """Time [s] until all of them rest."""
        return max((joint.duration for joint in self.joints), default=0.0)

    def at(self, t: float) -> tuple[JointState, ...]:
        """Return the state of each joint, t [s] after the start."""
        return tuple(joint.at(t) for joint in self.joints)


def fastest(start: JointState, goal: float, limits: JointLimits) -> Profile:
    """Return the profile that rests at the goal [rad] soonest.

    Raises ValueError if a number is not finite, or a limit not above 0."""
    _check(start, goal, limits)
    stop = _changed(start, 0.0, limits)
    rest = goal - _run(start, stop).position
    if abs(rest) <= LEAST:
        return Profile(start, goal, stop)
    way = copysign(1.0, rest)
    calm = start.velocity + start.acceleration * abs(start.acceleration) / (2.0 * limits.jerk)
    low, high = 0.0, way * limits.velocity
    # Between rest and the velocity that the joint has already the way is not monotonic: above, if possible.
    if 0.0 < way * calm < limits.velocity and way * (goal - _reached(start, calm, limits)) >= 0.0:
        low = calm
    return _with_cruise(start, goal, _cruise(start, goal, limits, low, high), limits)


def synchronised(
    start: Sequence[JointState], goal: Sequence[float], limits: Sequence[JointLimits]
) -> Profiles:
    """Return profiles of several joints that begin and end at the same times, as soon as the slowest can.

    From rest a joint is slowed evenly. One that moves already cruises more slowly; one for which there is no
    such profile ends earlier.
    Raises ValueError if a number is not finite, or a limit not above 0."""
    alone = [fastest(*each) for each in zip(start, goal, limits, strict=True)]
    duration = max((profile.duration for profile in alone), default=0.0)
    return Profiles(tuple(_stretched(p, duration, limit) for p, limit in zip(alone, limits, strict=True)))


def stopping(start: JointState, limits: JointLimits) -> Profile:
    """Return the profile that rests soonest, wherever that is."""
    _check(start, start.position, limits)
    parts = _changed(start, 0.0, limits)
    return Profile(start, _run(start, parts).position, parts)


def velocity_step(start: JointState, goal: float, dt: float, limits: JointLimits) -> JointState:
    """Return the state dt [s] later on the fastest way to a constant velocity [rad/s]."""
    left, state = dt, start
    for time, jerk in _changed(start, max(-limits.velocity, min(limits.velocity, goal)), limits):
        state = _after(state, min(time, left), jerk)
        left -= time
        if left <= 0.0:
            return state
    return _after(JointState(state.position, state.velocity), max(left, 0.0), 0.0)


# -- private --------------------------------------------------------------------------------------


def _check(start: JointState, goal: float, limits: JointLimits) -> None:
    if not all(map(isfinite, (*start, goal, *limits))):
        raise ValueError(f"a profile needs finite numbers, not {tuple(start)}, {goal}, {tuple(limits)}")
    if min(limits) <= 0.0:
        raise ValueError(f"limits must be above 0, not {tuple(limits)}")


def _after(state: JointState, t: float, jerk: float) -> JointState:
    position, velocity, acceleration = state
    return JointState(
        position + t * (velocity + t * (acceleration / 2.0 + t * jerk / 6.0)),
        velocity + t * (acceleration + t * jerk / 2.0),
        acceleration + t * jerk,
    )


def _run(state: JointState, parts: Sequence[Part]) -> JointState:
    for time, jerk in parts:
        state = _after(state, time, jerk)
    return state


def _changed(start: JointState, velocity: float, limits: JointLimits) -> tuple[Part, Part, Part]:
    """Return the fastest change to a velocity, with no acceleration at its end."""
    jerk, most, now = limits.jerk, limits.acceleration, start.acceleration
    calm = start.velocity + now * abs(now) / (2.0 * jerk)
    way = 1.0 if velocity >= calm else -1.0
    now, change = way * now, way * (velocity - start.velocity)
    peak = sqrt(max(jerk * change + now * now / 2.0, 0.0))
    hold = 0.0
    if peak > most:
        peak = most
        rise = abs(peak - now) * (peak + now) / (2.0 * jerk)
        hold = max((change - rise - peak * peak / (2.0 * jerk)) / peak, 0.0)
    peak = max(peak, 0.0)
    first = abs(peak - now) / jerk
    return (first, way * copysign(jerk, peak - now)), (hold, 0.0), (peak / jerk, -way * jerk)


def _reached(start: JointState, velocity: float, limits: JointLimits) -> float:
    """Return where a joint rests that changes to this velocity, and at once to 0 [rad]."""
    middle = _run(start, _changed(start, velocity, limits))
    calm = JointState(middle.position, velocity)
    return _run(calm, _changed(calm, 0.0, limits)).position


def _cruise(start: JointState, goal: float, limits: JointLimits, low: float, high: float) -> float:
    """Return the velocity between two with which the joint rests nearest before the goal [rad/s]."""
    if (goal - _reached(start, high, limits)) * copysign(1.0, high) >= 0.0:
        return high
    for _ in range(HALVINGS):
        middle = (low + high) / 2.0
        if (goal - _reached(start, middle, limits)) * copysign(1.0, high) >= 0.0:
            low = middle
        else:
            high = middle
    return low


def _with_cruise(start: JointState, goal: float, velocity: float, limits: JointLimits) -> Profile:
    """Return the profile with a cruise at this velocity, as long as the goal needs."""
    first = _changed(start, velocity, limits)
    rest = goal - _reached(start, velocity, limits)
    time = rest / velocity if velocity else 0.0
    last = _changed(JointState(0.0, velocity), 0.0, limits)
    return Profile(start, goal, (*first, (max(time, 0.0), 0.0), *last))


def _stretched(profile: Profile, duration: float, limits: JointLimits) -> Profile:
    """Return the profile, lasting this long [s]."""
    own, start = profile.duration, profile.start
    if own >= duration or own <= LEAST:
        return profile
    if not start.velocity and not start.acceleration:
        return Profile(start, profile.goal, profile.parts, duration / own)
    stop = _run(start, _changed(start, 0.0, limits)).position
    if abs(profile.goal - stop) <= LEAST:
        return profile
    way = copysign(1.0, profile.goal - stop)
    slow, fast = 0.0, limits.velocity
    for _ in range(HALVINGS):
        middle = (slow + fast) / 2.0
        reached = _reached(start, way * middle, limits)
        tried = _with_cruise(start, profile.goal, way * middle, limits)
        if way * (profile.goal - reached) < 0.0 or tried.duration < duration:
            fast = middle
            if way * (profile.goal - reached) >= 0.0:
                profile = tried
        else:
            slow = middle
    return profile
