"""Limits of a joint, and the set-points that keep them. At the output shaft, in SI.

Rules. A set-point never jumps: it starts at the measured position and velocity, and moves within the limits
of velocity, acceleration and, if there is one, jerk. A shaft that is outside its range is led inwards from
where it is, and no further out. The end of travel takes precedence over acceleration and jerk. Where the
position of the shaft must be known and is not, nothing moves.

A Position is a place to come to rest at; one that changes at every step, with the velocity that it has there,
is a sample of a trajectory, which is followed as it is given where the limits allow it. A velocity without a
change of the position means nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import copysign, sqrt
from typing import Annotated

from brain.bodies.joint_profile import JointLimits, JointState, fastest, velocity_step
from brain.bodies.joint_profile import Profile as JointProfile
from protocols.bounds import Bounds, Invalid
from protocols.messages import (
    SECOND,
    Command,
    Feedback,
    Hold,
    Idle,
    Impedance,
    Nanos,
    Position,
    Torque,
    Velocity,
)

FARTHEST = 1e5
"""rad: the farthest end of travel."""
TAPER = 0.25
"""Share of the limit of velocity over which an accelerating torque falls to nothing at the limit: measured
velocities are old."""
BEGINNING = 0.1
"""s in which a torque may grow to its limit, or ten reports: so it is seen how fast a shaft gathers speed."""
UNSEEN = 0.015
"""s, beside the period of its reports, until it is seen what a torque has done."""
CLOSEST: Nanos = 1_000_000
"""ns between two reports that tell an acceleration: closer ones have stamps that are too rough"""
HELD_UP, TURNING = 0.9, 0.98
"""What is kept, per report, of what a shaft did by a torque. One that is held up does nothing by it; one that
turns under a load seems to, and is as light as before once the torque is larger than the load."""
SOFTENED = 0.8
"""Share of the limit of torque that a softened spring may give: measured velocities are old."""
NEARING, SETTLING = 0.2, 0.07
"""Within this share of its limit a velocity nears it with this time constant [s], since a device's loops
overshoot where an acceleration ends at once."""
CATCHING_UP = 0.9
"""Share of the limit of velocity that a way to a position takes: its loop catches up by turning faster."""
SLOWER = 0.2
"""Share of the limit of acceleration with which a trajectory is caught up with, where the jerk is limited."""
REACHED = 1e-3
"""Share of the limit of velocity within which it is reached."""
LATEST_SAMPLE = 0.1
"""s: positions that change less often than that are no trajectory."""
EXACT = 1.0 + 1e-6
"""By how much a trajectory may exceed a limit by rounding."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Magnitudes at the joint's output shaft."""

    velocity: Annotated[float, Bounds(1e-3, 1e3)]
    """rad/s"""
    acceleration: Annotated[float, Bounds(1e-2, 1e5)]
    """rad/s²"""
    torque: Annotated[float, Bounds(1e-4, 1e5)]
    """N·m"""
    position: tuple[float, float] | None = None
    """rad, lowest and highest; None for a wheel"""
    jerk: Annotated[float, Bounds(0.1, 1e7)] | None = None
    """rad/s³; None: not limited"""
    margin: Annotated[float, Bounds(1e-3, 1.5)] = 0.1
    """rad beyond the range from which a joint is led back: farther out, its position is taken to be wrong"""

    def __post_init__(self) -> None:
        if self.position is None:
            return
        low, high = self.position
        if not -FARTHEST <= low < high <= FARTHEST:
            text = f"position is [{low:g}, {high:g}], expected the lowest first, within ±{FARTHEST:g}"
            raise Invalid(("position", text))

    def inside(self, position: float) -> float:
        """Return the nearest position within the range."""
        if self.position is None:
            return position
        low, high = self.position
        return position if low <= position <= high else max(low, min(high, position))

    def outside(self, position: float) -> float:
        """Return how far outside the range a position is [rad]; 0 within."""
        return abs(position - self.inside(position))

    def led_in(self, position: float, before: float) -> float:
        """Return the nearest position that is within the range, or no farther out than `before`."""
        if self.position is None:
            return position
        low, high = self.position
        return max(min(low, before), min(max(high, before), position))

    def torque_now(self, wanted: float, measured: Feedback) -> float:
        """Return a torque within its limit that accelerates no shaft beyond its velocity or end of travel."""
        if not wanted:
            return wanted
        torque = clamp(wanted, self.torque)
        velocity, position = measured.velocity, measured.position
        if velocity is not None and velocity * torque > 0.0:
            torque *= max(0.0, min(1.0, (self.velocity - abs(velocity)) / (TAPER * self.velocity)))
        if self.position is not None and position is not None:
            low, high = self.position
            if (position >= high and torque > 0.0) or (position <= low and torque < 0.0):
                return 0.0
        return torque

    def profile(self) -> JointLimits:
        """Return the limits of a motion; without one of jerk it is as good as none."""
        return JointLimits(self.velocity, self.acceleration, self.jerk or 1e7)

    def velocity_before_end(self, velocity: float, position: float) -> float:
        """Return a velocity from which the distance to the end of travel is enough to stop."""
        if self.position is None:
            return velocity
        low, high = self.position
        up = sqrt(2.0 * self.acceleration * max(0.0, high - position))
        down = sqrt(2.0 * self.acceleration * max(0.0, position - low))
        return max(-down, min(up, velocity))


class SetpointProfile:
    """The current set-point of a joint. Its state is plain data."""

    def __init__(self, period: float = 0.0) -> None:
        """Begin; `period`: s between two reports of the device."""
        self._beginning = max(BEGINNING, 10.0 * period)
        self._position: float | None = None
        self._velocity: float | None = None
        self._acceleration = 0.0
        """rad/s², where the jerk is limited"""
        self._sample: Position | None = None
        """The last position that was wanted"""
        self._age = 0.0
        """The age of that position [s]"""
        self._apart = 0.0
        """The time [s] from the position before to that one; 0: it is not one of a trajectory."""
        self._begun = 0.0
        """s since a torque is commanded"""
        self._plan: tuple[JointProfile, JointLimits, float] | None = None
        """The motion to a position with limited jerk, its limits, and how far it is [s]."""

    def forget(self) -> None:
        """Start the next set-point at the measured position and velocity."""
        self._position = self._velocity = self._plan = self._sample = None
        self._acceleration = self._age = self._apart = self._begun = 0.0

    def departs(self, measured: Feedback, limits: Limits) -> bool:
        """True if the shaft's velocity is not the set-point's, by more than that changes while a torque
        begins."""
        if self._velocity is None or measured.velocity is None:
            return False
        apart = abs(self._velocity - clamp(measured.velocity, limits.velocity))
        return apart > limits.acceleration * 0.5 * self._beginning

    def limited(self, wanted: Command, dt: float, measured: Feedback, limits: Limits) -> Command:
        """Return the command that is within the limits, `dt` seconds after the previous one."""
        if isinstance(wanted, (Idle, Hold)):
            self.forget()
            if isinstance(wanted, Hold) and wanted.torque:
                return Hold(wanted.motor, limits.torque_now(wanted.torque, measured))
            return wanted
        if measured.position is None and (
            limits.position is not None or isinstance(wanted, (Position, Impedance))
        ):
            self.forget()
            return Idle(wanted.motor)
        match wanted:
            case Velocity():
                return self._velocity_command(wanted, dt, measured, limits)
            case Position():
                return self._position_command(wanted, dt, measured, limits)
            case Torque():
                begun = self._begun + dt
                self.forget()
                self._begun = begun
                most = limits.torque * min(1.0, begun / self._beginning)
                return Torque(wanted.motor, limits.torque_now(clamp(wanted.torque, most), measured))
            case Impedance():
                self.forget()
                return spring_within(wanted, measured, limits)

    def _velocity_command(self, wanted: Velocity, dt: float, measured: Feedback, limits: Limits) -> Velocity:
        before = self._velocity
        if before is None:
            before = clamp(measured.velocity or 0.0, limits.velocity)
        goal = clamp(wanted.velocity, limits.velocity)
        if limits.jerk is not None:
            velocity = self._smooth(before, goal, dt, measured, limits)
        elif limits.position is None:
            velocity = faster(before, goal, dt, limits)
        else:
            here = measured.position or 0.0
            velocity = faster(before, limits.velocity_before_end(goal, here), dt, limits)
            velocity = limits.velocity_before_end(velocity, here)
        self._position, self._velocity, self._plan = None, velocity, None
        return Velocity(wanted.motor, velocity, limits.torque_now(wanted.torque, measured))

    def _smooth(self, before: float, goal: float, dt: float, measured: Feedback, limits: Limits) -> float:
        """Return the next velocity within the limit of jerk; before an end of travel it brakes earlier."""
        here = measured.position or 0.0
        jerk = limits.jerk or 1e7
        if limits.position is not None:
            # braking takes acceleration / jerk longer than without a limit of jerk
            ahead = here + before * limits.acceleration / jerk
            goal = limits.velocity_before_end(goal, ahead)
        state = velocity_step(JointState(0.0, before, self._acceleration), goal, dt, limits.profile())
        velocity = limits.velocity_before_end(state.velocity, here)
        self._acceleration = state.acceleration if velocity == state.velocity else 0.0
        return velocity

    def _follow_plan(self, goal: float, dt: float, limits: Limits) -> None:
        """Move on along the jerk-limited motion to the goal; begin another if goal or limits are others."""
        own = limits.profile()
        plan = self._plan
        if plan is None or plan[0].goal != goal or plan[1] != own:
            start = JointState(self._position or 0.0, self._velocity or 0.0, self._acceleration)
            plan = fastest(start, goal, own), own, 0.0
        motion, _, t = plan
        self._plan = motion, own, t + dt
        self._position, self._velocity, self._acceleration = motion.at(t + dt)

    def _position_command(self, wanted: Position, dt: float, measured: Feedback, limits: Limits) -> Position:
        """Follow a trajectory as it is given; else come to rest at a position, by a trapezoidal profile from
        the measured one, or one of seven parts if jerk is limited."""
        if self._position is None or self._velocity is None:
            self._begin(measured, limits)
        before = self._position or 0.0
        place, moving = self._sampled(wanted, dt)
        goal = limits.inside(place)
        if dt and self._reaches(goal, moving, dt, limits):
            self._acceleration = (moving - (self._velocity or 0.0)) / dt
            self._position, self._velocity, self._plan = goal, moving, None
        elif limits.jerk is not None and not self._apart:
            self._follow_plan(goal, dt, limits)
        else:
            self._approach(goal, moving, dt, limits)
        self._position = limits.led_in(self._position or 0.0, before)
        torque = limits.torque_now(wanted.torque, measured)
        return Position(wanted.motor, self._position, self._velocity or 0.0, torque)

    def _begin(self, measured: Feedback, limits: Limits) -> None:
        """Begin at the measured position and velocity; outside the range, with none that leads outwards."""
        here, velocity = measured.position or 0.0, clamp(measured.velocity or 0.0, limits.velocity)
        outwards = velocity * (here - limits.inside(here)) > 0.0
        self._position, self._velocity = here, 0.0 if outwards else velocity

    def _sampled(self, wanted: Position, dt: float) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] that a trajectory has now: those of its newest sample,
        or a moment later; the position at rest, if it is none."""
        last = self._sample
        self._age += dt
        if last is None or wanted.position != last.position:
            apart = 0.0 if last is None else self._age
            moves = last is not None and bool(last.velocity or wanted.velocity) and apart <= LATEST_SAMPLE
            self._sample, self._apart, self._age = wanted, apart if moves else 0.0, 0.0
        if self._age > self._apart:
            self._apart = 0.0
            return wanted.position, 0.0
        return wanted.position + wanted.velocity * self._age, wanted.velocity if self._apart else 0.0

    def _reaches(self, goal: float, velocity: float, dt: float, limits: Limits) -> bool:
        """True if a sample can be reached in this step within the limits: it is followed as it is given."""
        here, before = self._position or 0.0, self._velocity or 0.0
        change = limits.acceleration * dt * EXACT
        if not self._apart or abs(velocity) > limits.velocity or abs(velocity - before) > change:
            return False
        if limits.jerk is not None:
            bend = (velocity - before) / dt - self._acceleration
            if abs(bend) > limits.jerk * dt * EXACT:
                return False
        return abs(goal - here - 0.5 * (before + velocity) * dt) <= 0.5 * change * dt

    def _approach(self, goal: float, velocity: float, dt: float, limits: Limits) -> None:
        """Move on towards a position, to have there the velocity of a trajectory, or none."""
        here, before = self._position or 0.0, self._velocity or 0.0
        rest = goal - here
        if not rest and not before and not velocity:
            return
        # the highest speed from which the remaining distance, less this step's, is enough to slow down
        change = limits.acceleration * dt
        reach = 0.5 * change
        slowing = limits.acceleration if limits.jerk is None else SLOWER * limits.acceleration
        stopping = max(0.0, sqrt(reach * reach + 2.0 * slowing * abs(rest)) - reach)
        wanted = clamp(velocity + copysign(stopping, rest), CATCHING_UP * limits.velocity)
        if limits.jerk is not None:
            state = velocity_step(JointState(0.0, before, self._acceleration), wanted, dt, limits.profile())
            now, self._acceleration, self._plan = state.velocity, state.acceleration, None
        else:
            now = faster(before, wanted, dt, limits)
        move = now * dt
        if not velocity and abs(move) >= abs(rest) and move * rest >= 0.0 and abs(now) <= 2.0 * change:
            move, now = rest, 0.0
        self._position, self._velocity = here + move, now


class Swing:
    """How fast a shaft gathers speed, by the torques that it is given and by its load; torques are limited
    before it is too fast.

    What is measured is old: a light shaft passes its limit of velocity before that is reported. Known are the
    torque given since then, what torque did to the velocity between two reports, and how the velocity changed
    between them, by whatever it was. State is plain data."""

    def __init__(self, period: float) -> None:
        self._period = period
        """s between two reports of the device"""
        self._velocity = 0.0
        """rad/s, as last reported"""
        self._reported_at: Nanos = 0
        self._given = self._unseen = 0.0
        """N·m·s: torque by time between the last two reports, and since the last"""
        self._per_impulse = 0.0
        """rad/s per N·m·s, as seen in the reports: the inverse of the inertia"""
        self._acceleration = 0.0
        """rad/s², between the last two reports"""
        self._age = 0.0
        """s since the last report, as far as torques were given since"""

    def on_velocity(self, t: Nanos, velocity: float) -> None:
        """Note what was measured at `t`: it shows what was given before the report that it follows."""
        if t <= self._reported_at:
            return
        change, given = velocity - self._velocity, self._given
        self._acceleration = (
            change * SECOND / max(t - self._reported_at, CLOSEST) if self._reported_at else 0.0
        )
        seen = change / given if change * given > 0.0 else 0.0
        turning = abs(velocity) > self._per_impulse * abs(given)
        self._per_impulse = max(seen, (TURNING if turning else HELD_UP) * self._per_impulse)
        self._given, self._unseen = self._unseen, 0.0
        self._reported_at, self._velocity, self._age = t, velocity, 0.0

    def gained(self, seconds: float) -> float:
        """Return by how much the velocity changes in a time after the last report [rad/s], if it goes on to
        change as between the last two."""
        return self._acceleration * seconds

    def within(self, torque: float, dt: float, limit: float) -> float:
        """Return a torque [N·m], given for the next `dt` seconds, by which the shaft stays within a limit of
        velocity [rad/s] until that is seen."""
        by_torque = self._per_impulse * (self._given + self._unseen)
        by_all = self.gained(self._age + UNSEEN)
        gains = max(by_torque, by_all) if torque > 0.0 else max(-by_torque, -by_all)
        room = max(0.0, limit - gains - copysign(1.0, torque) * self._velocity)
        span = self._per_impulse * (self._period + UNSEEN)
        if span * abs(torque) > room:
            torque = copysign(room / span, torque)
        self._unseen += torque * dt
        self._age += dt
        return torque


def spring_within(wanted: Impedance, measured: Feedback, limits: Limits) -> Impedance:
    """Return a spring whose torque at the measured position and velocity is within the limits.

    Where it would give more, it is softer, by more than that needs: moved set-points could leave it."""
    position = limits.inside(wanted.position)
    velocity = clamp(wanted.velocity, limits.velocity)
    torque = limits.torque_now(wanted.torque, measured)
    pull = wanted.stiffness * (position - (measured.position or 0.0))
    drag = wanted.damping * (velocity - (measured.velocity or 0.0))
    stiffness = wanted.stiffness * _share(pull, clamp(pull, limits.torque))
    damping = wanted.damping * _share(drag, clamp(drag, limits.torque))
    total = torque + clamp(pull, limits.torque) + clamp(drag, limits.torque)
    most = total if abs(total) <= limits.torque else copysign(SOFTENED * limits.torque, total)
    share = _share(total, limits.torque_now(most, measured))
    spring = Impedance(wanted.motor, position, velocity, share * torque, share * stiffness, share * damping)
    return _slowing(spring, measured, limits)


def _slowing(spring: Impedance, measured: Feedback, limits: Limits) -> Impedance:
    """Return a spring whose pull gives way to its damper once a shaft reaches its limit of velocity, if it
    will be faster: one that slows it down where it is expected may drive it on a little before."""
    speed = measured.velocity or 0.0
    if abs(speed) < limits.velocity:
        return spring
    pull = spring.torque + spring.stiffness * (spring.position - (measured.position or 0.0))
    push = pull * copysign(1.0, speed)
    drag = spring.damping * (limits.velocity - spring.velocity * copysign(1.0, speed))
    share = _share(push, min(push, max(0.0, drag))) if push > 0.0 else 1.0
    return replace(spring, torque=share * spring.torque, stiffness=share * spring.stiffness)


def no_stronger(spring: Impedance, measured: Feedback, limits: Limits) -> Impedance:
    """Return a spring that is within the limits elsewhere, so soft that it is so at this motion too: all of
    it by the same share, which leaves it within them there."""
    pull = spring.stiffness * (spring.position - (measured.position or 0.0))
    total = spring.torque + pull + spring.damping * (spring.velocity - (measured.velocity or 0.0))
    share = _share(total, limits.torque_now(clamp(total, limits.torque), measured))
    return replace(
        spring,
        torque=share * spring.torque,
        stiffness=share * spring.stiffness,
        damping=share * spring.damping,
    )


def softened(
    wanted: Position | Velocity | Hold,
    held: float | None,
    stiffness: float,
    damping: float,
    measured: Feedback,
    limits: Limits,
) -> Command:
    """Return what is wanted, or a softer spring where its own would pull with more than the limit of torque.

    Args:
        wanted: within the limits; the device makes a spring and damper of it.
        held: where Hold is [rad].
        stiffness, damping: of the device's own [N·m/rad, N·m·s/rad].
        measured: where the shaft is.
        limits: of the joint.
    """
    here = measured.position or 0.0
    place = held if isinstance(wanted, Hold) else getattr(wanted, "position", None)
    velocity = getattr(wanted, "velocity", 0.0)
    spring = 0.0 if place is None else stiffness
    goal = here if place is None else place
    drag = damping * (velocity - (measured.velocity or 0.0))
    pull = wanted.torque + spring * (goal - here)
    if abs(drag + pull) <= limits.torque:
        return wanted
    # what slows it down comes first: a spring without its damper would throw the shaft
    most = SOFTENED * limits.torque
    slowing = clamp(drag, most)
    left = limits.torque_now(clamp(pull, most - copysign(slowing, pull * slowing)), measured)
    share = _share(pull, left)
    damper = damping * _share(drag, slowing)
    return Impedance(wanted.motor, goal, velocity, share * wanted.torque, share * spring, damper)


def _share(value: float, allowed: float) -> float:
    return allowed / value if value else 1.0


def clamp(value: float, limit: float) -> float:
    """Return the value within ± limit."""
    return limit if value > limit else -limit if value < -limit else value


def faster(value: float, goal: float, dt: float, limits: Limits) -> float:
    """Return a velocity `dt` seconds further on its way to a goal within the limits of velocity and
    acceleration."""
    step, most = limits.acceleration * dt, limits.velocity
    if goal * value >= 0.0 and abs(goal) > abs(value):
        left = most - abs(value)
        if REACHED * most < left < NEARING * most:
            step = min(step, left * dt / (SETTLING + dt))
    return toward(value, clamp(goal, most), step)


def toward(value: float, goal: float, step: float) -> float:
    """Return the value after a step towards the goal."""
    return value + clamp(goal - value, step)
