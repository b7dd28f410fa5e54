"""Limits of a joint, and the set-points that keep them. At the output shaft, in SI.

Rules. A set-point never jumps: it starts at the measured position, and moves within the limits of velocity,
acceleration and, if there is one, jerk. The end of travel takes precedence over acceleration and jerk. Where
the position of the shaft must be known and is not, nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, sqrt
from typing import Annotated

from brain.control.joint_profile import JointLimits, JointState, fastest, velocity_step
from brain.control.joint_profile import Profile as JointProfile
from gateway.core.bounds import Bounds
from protocols.messages import Command, Feedback, Hold, Idle, Impedance, Position, Torque, Velocity

FARTHEST = 1e5
"""rad: the farthest end of travel."""
TAPER = 0.25
"""Share of the limit of velocity over which an accelerating torque falls to nothing at the limit: measured
velocities are old."""


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

    def __post_init__(self) -> None:
        if self.position is None:
            return
        low, high = self.position
        if not -FARTHEST <= low < high <= FARTHEST:
            raise ValueError(
                f"position is [{low:g}, {high:g}], expected the lowest first, within ±{FARTHEST:g}"
            )

    def inside(self, position: float) -> float:
        """Return the nearest position within the range."""
        if self.position is None:
            return position
        low, high = self.position
        return position if low <= position <= high else max(low, min(high, position))

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


class Profile:
    """The current set-point of a joint. Its state is plain data."""

    def __init__(self) -> None:
        self._position: float | None = None
        self._velocity: float | None = None
        self._acceleration = 0.0
        """rad/s², where the jerk is limited"""
        self._plan: tuple[JointProfile, JointLimits, float] | None = None
        """The motion to a position with limited jerk, its limits, and how far it is [s]."""

    def forget(self) -> None:
        """Start the next set-point at the measured position and velocity."""
        self._position = self._velocity = self._plan = None
        self._acceleration = 0.0

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
                self.forget()
                return Torque(wanted.motor, limits.torque_now(wanted.torque, measured))
            case Impedance():
                self.forget()
                return _spring(wanted, measured, limits)

    def _velocity_command(self, wanted: Velocity, dt: float, measured: Feedback, limits: Limits) -> Velocity:
        before = self._velocity
        if before is None:
            before = clamp(measured.velocity or 0.0, limits.velocity)
        goal = clamp(wanted.velocity, limits.velocity)
        if limits.jerk is not None:
            velocity = self._smooth(before, goal, dt, measured, limits)
        elif limits.position is None:
            velocity = toward(before, goal, limits.acceleration * dt)
        else:
            here = measured.position or 0.0
            velocity = toward(before, limits.velocity_before_end(goal, here), limits.acceleration * dt)
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
        """Follow a trapezoidal profile from the measured position; one of seven parts if jerk is limited."""
        if self._position is None or self._velocity is None:
            self._position = measured.position or 0.0
            self._velocity = clamp(measured.velocity or 0.0, limits.velocity)
        if limits.jerk is not None:
            self._follow_plan(limits.inside(wanted.position), dt, limits)
            torque = limits.torque_now(wanted.torque, measured)
            return Position(wanted.motor, limits.inside(self._position), self._velocity, torque)
        rest = limits.inside(wanted.position) - self._position
        move = velocity = 0.0
        if rest or self._velocity:  # it is not there yet
            # the highest speed from which the remaining distance, less this step's, is enough to stop
            change = limits.acceleration * dt
            reach = 0.5 * change
            stopping = max(0.0, sqrt(reach * reach + 2.0 * limits.acceleration * abs(rest)) - reach)
            speed = copysign(min(limits.velocity, stopping), rest)
            velocity = toward(self._velocity, speed, change)
            move = velocity * dt
            if abs(move) >= abs(rest) and move * rest >= 0.0 and abs(velocity) <= 2.0 * change:
                move, velocity = rest, 0.0
        self._position, self._velocity = self._position + move, velocity
        ahead = velocity if velocity else clamp(wanted.velocity, limits.velocity) if rest == 0.0 else 0.0
        torque = limits.torque_now(wanted.torque, measured)
        return Position(wanted.motor, limits.inside(self._position), ahead, torque)


def _spring(wanted: Impedance, measured: Feedback, limits: Limits) -> Impedance:
    """Return a spring whose torque at the measured position and velocity is within the limits.

    Where it would give more, it is softer: set-points that were moved could leave the range."""
    position = limits.inside(wanted.position)
    velocity = clamp(wanted.velocity, limits.velocity)
    torque = limits.torque_now(wanted.torque, measured)
    pull = wanted.stiffness * (position - (measured.position or 0.0))
    drag = wanted.damping * (velocity - (measured.velocity or 0.0))
    stiffness = wanted.stiffness * _share(pull, clamp(pull, limits.torque))
    damping = wanted.damping * _share(drag, clamp(drag, limits.torque))
    total = torque + clamp(pull, limits.torque) + clamp(drag, limits.torque)
    share = _share(total, limits.torque_now(total, measured))
    return Impedance(wanted.motor, position, velocity, share * torque, share * stiffness, share * damping)


def _share(value: float, allowed: float) -> float:
    return allowed / value if value else 1.0


def clamp(value: float, limit: float) -> float:
    """Return the value within ± limit."""
    return limit if value > limit else -limit if value < -limit else value


def toward(value: float, goal: float, step: float) -> float:
    """Return the value after a step towards the goal."""
    return value + clamp(goal - value, step)
