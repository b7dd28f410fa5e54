"""Positions and velocities by torque, where the device has no loops of its own, or shall not use them: with
feed-forward and anti-windup.

Rules. The position's error asks for a velocity, the velocity's error for a torque, and its integral removes
what load and friction leave. What is known is given in advance: the torque of inertia, damping and dry
friction at the set-point. The integral stands still while the torque is at its limit and would be pushed
further, and never exceeds its own bound (conditional integration: Astrom and Hagglund 2006, "Advanced PID
Control", section 3.5). The derivative is of the measurement, so that no step of a set-point kicks.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import copysign, inf
from typing import Annotated

from gateway.core.limits import Limits
from protocols.bounds import Bounds, check
from protocols.messages import SECOND, Command, Feedback, Nanos, Position, Torque, Velocity
from protocols.plugin import Spec

CREEP = 0.05
"""rad/s of a set-point below which its dry friction is given in proportion"""
ROUNDING = 1e-9
"""Share of a device's largest torque that is never asked for, lest it be refused after the gear."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """Gains at the joint's output shaft, SI."""

    position_gain: Annotated[float, Bounds(0.0, 1e3, "1/s")] = 8.0
    """rad/s of velocity per rad of error"""
    velocity_gain: Annotated[float, Bounds(0.0, 1e4, "N·m·s/rad")]
    """N·m per rad/s of error"""
    integral_gain: Annotated[float, Bounds(0.0, 1e5, "N·m/rad")] = 0.0
    """N·m per rad/s of error and s"""
    integral_most: Annotated[float, Bounds(0.0, 1e4, "N·m")] = 0.0
    """N·m of the integral, at most"""
    inertia: Annotated[float, Bounds(0.0, 1e3, "kg·m²")] = 0.0
    """kg·m², given in advance"""
    damping: Annotated[float, Bounds(0.0, 1e3, "N·m·s/rad")] = 0.0
    """N·m·s/rad, likewise,"""
    friction: Annotated[float, Bounds(0.0, 1e3, "N·m")] = 0.0
    """and N·m of dry friction"""

    def __post_init__(self) -> None:
        check(self)


class Loop:
    """The loop of one joint. State: the integral, and the last set-point; plain data."""

    def __init__(self) -> None:
        self.integral = 0.0
        """N·m"""
        self._velocity: float | None = None
        """rad/s, of the last set-point"""

    def reset(self) -> None:
        """Forget: the motor was disarmed, or is commanded otherwise."""
        self.integral, self._velocity = 0.0, None

    def step(
        self,
        position_error: float,
        velocity: float,
        measured: float,
        torque: float,
        dt: float,
        most: float,
        settings: LoopSettings,
    ) -> float:
        """Return the torque [N·m], within ± `most`, dt [s] after the last.

        `position_error` [rad]: how far the set-point is ahead; `velocity` [rad/s]: of the set-point;
        `measured` [rad/s]; `torque` [N·m]: given in advance besides."""
        before = velocity if self._velocity is None else self._velocity
        self._velocity = velocity
        rate = (velocity - before) / dt if dt > 0.0 else 0.0
        error = velocity + settings.position_gain * position_error - measured
        known = settings.inertia * rate + settings.damping * velocity
        known += settings.friction * max(-1.0, min(1.0, velocity / CREEP))
        free = torque + known + settings.velocity_gain * error
        step = settings.integral_gain * error * dt
        wanted = free + self.integral
        if abs(wanted) < most or wanted * step < 0.0:
            bound = settings.integral_most
            self.integral = max(-bound, min(bound, self.integral + step))
        wanted = free + self.integral
        return wanted if abs(wanted) <= most else copysign(most, wanted)


class TorqueLoop:
    """The loop of one joint. State is plain data."""

    def __init__(self, settings: LoopSettings, spec: Spec, gear: float, longest: Nanos) -> None:
        self._settings, self._loop = settings, Loop()
        able = spec.ranges.get("Torque.torque")
        most = min(-able.low, able.high) if able else inf
        self._strongest = gear * most * (1.0 - ROUNDING)
        """N·m at the output shaft that the device can be commanded"""
        self._longest = longest / SECOND
        """s that a step counts at most"""

    def torque(self, out: Command, dt: float, measured: Feedback, limits: Limits, *, armed: bool) -> Command:
        """Return the torque with which a set-point is reached, `dt` seconds after the last; any other command
        as it is."""
        loop = self._loop
        if not isinstance(out, (Position, Velocity)):
            loop.reset()
            return out
        ahead = 0.0
        if isinstance(out, Position):
            ahead = out.position - (measured.position or 0.0)
        dt, most, speed = (
            min(dt, self._longest),
            min(limits.torque, self._strongest),
            measured.velocity or 0.0,
        )
        torque = loop.step(ahead, out.velocity, speed, out.torque, dt, most, self._settings)
        if not armed:
            loop.reset()
            torque = 0.0
        return Torque(out.motor, limits.torque_now(torque, measured))
