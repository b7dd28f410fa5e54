"""How a joint ends its motion by its stop action: braking until it is at rest, a load let down, then Idle.

Rules. Both are bounded in time, and begin once. A load is let down against the damping of its springs, with
less and less torque; by a device without springs, slowly to where it pulls, until it is not carried any more.
"""

from __future__ import annotations

from math import copysign

from gateway.core.arming import AT_REST
from gateway.core.limits import Limits
from gateway.core.load import FADING
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Idle, Impedance, Nanos, Velocity

BRAKING_MOST: Nanos = 2 * SECOND
"""The longest braking, whatever the limits are."""
REST_TIME: Nanos = 100 * MILLISECOND
"""At rest is what is slow for this long: a wheel that slips stands for a moment, and is turned again by its
base."""
LOWERING, LOWERED = 2500 * MILLISECOND, 0.05
"""After this time at most a load that is lowered is let go, or when it has come to rest: slower than that, in
rad/s."""
DOWNWARDS, CARRIED = 0.1, 0.05
"""Shares of the limits: of the velocity at which a load is followed down, of a torque that carries none."""


class Stopping:
    """The end of a motion of one joint. State is plain data."""

    def __init__(self, motor: str, limits: Limits, damping: float, *, turns_down: bool) -> None:
        self._motor, self._limits, self._turns_down = motor, limits, turns_down
        self._damping = damping
        """N·m·s/rad, of the last spring that was commanded, before that of the device's own Position"""
        self._since: Nanos | None = None
        """When the stop command began to brake, or to lower."""
        self._moved_at: Nanos = 0
        """When it was last not at rest since."""
        self._carried = 0.0
        """N·m, when its load began to be lowered"""

    @property
    def under_way(self) -> bool:
        """Whether it brakes, or lowers."""
        return self._since is not None

    @property
    def can_lower(self) -> bool:
        """Whether a load can be let down."""
        return self._damping > 0.0 or self._turns_down

    def end(self) -> None:
        """Note that the joint is not stopped any more."""
        self._since = None

    def on_spring(self, damping: float) -> None:
        """Note the damping of a spring that is commanded: it lowers the load."""
        self._damping = damping

    def braking_time(self) -> Nanos:
        """Return the longest time of braking: twice what the limits need, within a bound."""
        needed = 2.0 * self._limits.velocity / self._limits.acceleration
        return round(min(needed * SECOND, BRAKING_MOST))

    def hurried_braking_time(self, speed: float) -> Nanos:
        """Return the longest time that braking from a speed [rad/s] still takes, once that is hurried: half
        as much again as that needs, so that it comes to rest no later."""
        return round(1.5 * speed / self._limits.acceleration * SECOND) + REST_TIME

    def brakes(self, now: Nanos, speed: float, limit: float) -> bool:
        """Return whether to go on braking; `speed`, and its limit [rad/s]."""
        if self._since is None:
            self._since = self._moved_at = now
        if abs(speed) > AT_REST * limit:
            self._moved_at = now
        return now - self._moved_at < REST_TIME and now - self._since < self.braking_time()

    def lower(self, now: Nanos, held: float, here: Feedback, *, lost: bool) -> Command:
        """Return the next command of letting a load down.

        Args:
            now: the time of the step [ns].
            held: the torque that has carried the load so far [N·m]; 0: as measured.
            here: the motion,
            lost: which is not reported any more.
        """
        if self._since is None:
            self._since, self._carried = now, held or here.torque or 0.0
            self._moved_at = now + FADING if self._damping else now - REST_TIME
        since = now - self._since
        if not self._damping:
            return self._turn_down(now, since, here.torque or 0.0, lost)
        if abs(here.velocity or 0.0) > LOWERED:
            self._moved_at = max(self._moved_at, now)
        down = since >= LOWERING or now - self._moved_at >= REST_TIME
        if down or here.position is None or lost:
            return Idle(self._motor)
        torque = self._carried * max(0.0, 1.0 - since / FADING)
        return Impedance(self._motor, here.position, 0.0, torque, 0.0, self._damping)

    def _turn_down(self, now: Nanos, since: Nanos, measured: float, lost: bool) -> Command:
        """Return the next command of turning slowly to where a load pulls, until it is not carried any more;
        then Idle."""
        if measured * self._carried > 0.0 and abs(measured) > CARRIED * self._limits.torque:
            self._moved_at = now
        if since >= LOWERING or now - self._moved_at >= REST_TIME or lost:
            return Idle(self._motor)
        return Velocity(self._motor, -copysign(DOWNWARDS * self._limits.velocity, self._carried))
