"""What is measured of a joint: the newest of each quantity, how old it is, and how it moves on meanwhile.

Rules. All at the output shaft. A position that is not reported any more while the device moves on is lost:
the device is beyond its range. What an open-loop joint does is presumed: it does as commanded.
"""

from __future__ import annotations

from dataclasses import replace

from gateway.core.limits import CLOSEST, Swing
from protocols.messages import MILLISECOND, SECOND, Feedback, Nanos

IN_FORCE: Nanos = 5 * MILLISECOND
"""After this time a set-point has arrived at its device."""


class Measured:
    """The measurements of one joint. State is plain data."""

    def __init__(
        self, motor: str, timeout: Nanos, fastest: float, *, open_loop: bool, start: float = 0.0
    ) -> None:
        self.feedback = Feedback(motor, 0)
        """The newest value of each quantity; t is the newest motion's."""
        self.open_loop = open_loop
        """Whether its device reports nothing: what it does is presumed to be what it is commanded."""
        self._presumed = start
        """rad where such a joint is, if it did as commanded, up to the last command."""
        self._timeout, self._fastest = timeout, fastest
        """At which age it counts as lost; the robot file's limit of velocity [rad/s]."""
        self.received_at: Nanos | None = None
        """Of the newest motion; None: the device has never reported any."""
        self._reports_since: Nanos | None = None
        self._position_at: Nanos | None = None
        self._velocity_at: Nanos | None = None
        self.position_lost = False
        """Whether the device moves on without reporting its position: that is beyond its range."""

    def take(self, moved: Feedback) -> float | None:
        """Store what was reported; return the velocity that it shows [rad/s], None if it shows none."""
        old, t, position, velocity = self.feedback, moved.t, moved.position, moved.velocity
        if velocity is not None:
            self._velocity_at = t
        elif position is not None:
            velocity = self._between(t, position)
        if position is None and velocity is None:
            t = old.t
        else:
            self.received_at = t
            self._reports_since = t if self._reports_since is None else self._reports_since
        if position is not None:
            self._position_at, self.position_lost = t, False
        self.feedback = Feedback(
            old.motor,
            t,
            old.position if position is None else position,
            old.velocity if velocity is None else velocity,
            old.torque if moved.torque is None else moved.torque,
            old.current if moved.current is None else moved.current,
            old.voltage if moved.voltage is None else moved.voltage,
            old.temperature if moved.temperature is None else moved.temperature,
        )
        return velocity

    def _between(self, t: Nanos, position: float) -> float | None:
        """Return the velocity since the last position [rad/s], if the device reports positions alone, as many
        do before they are commanded; None for a jump: whether the position is lost is judged by itself."""
        before, before_at, known = self.feedback.position, self._position_at, self._velocity_at
        if before is None or before_at is None or (known is not None and t - known <= self._timeout):
            return None
        velocity = (position - before) * SECOND / max(t - before_at, CLOSEST)
        return velocity if abs(velocity) <= self._fastest else None

    def age(self, now: Nanos) -> Nanos | None:
        """Return the age of the newest motion; None if the device has never reported any."""
        return None if self.received_at is None else max(0, now - self.received_at)

    def lost(self, now: Nanos) -> bool:
        """True if there is no feedback, or it is older than the timeout; never of an open-loop joint, which
        has none to lose."""
        if self.open_loop:
            return False
        return self.received_at is None or now - self.received_at > self._timeout

    def measures_no_position(self, now: Nanos) -> bool:
        """Whether the device has reported its motion for a while, and never a position."""
        since = self._reports_since
        return since is not None and now - since > self._timeout and self.feedback.position is None

    def loses_position(self, now: Nanos) -> bool:
        """Forget a position that is not reported any more; return whether that is new."""
        if self.received_at is not None and self.received_at > now:
            self.received_at = now  # a stamp from the future must not keep the joint from going blind
        known, newest = self._position_at, self.received_at
        if known is None or newest is None or newest - known <= self._timeout:
            return False
        self._position_at, self.position_lost = None, True
        self.feedback = replace(self.feedback, position=None)
        return True

    def expected(self, now: Nanos, swing: Swing) -> Feedback:
        """Return the motion as it is expected when what is sent now is in force."""
        here, age = self.feedback, self.age(now)
        if here.position is None or here.velocity is None or age is None:
            return here
        ahead = (age + IN_FORCE) / SECOND
        gained = swing.gained(ahead)
        older = max(0, here.t - (self._position_at or here.t)) / SECOND  # not every report has a position
        rest = here.torque, here.current, here.voltage, here.temperature
        position = here.position + here.velocity * (older + ahead) + 0.5 * gained * ahead
        return Feedback(here.motor, here.t, position, here.velocity + gained, *rest)

    def presumed(self, now: Nanos, commanded: float, span: float) -> Feedback | None:
        """Return the motion of an open-loop joint, commanded a velocity [rad/s] for a span [s]: nothing of it
        is measured. None: the device of another joint reports its motion."""
        position = self._presumed + commanded * span
        return Feedback(self.feedback.motor, now, position, commanded) if self.open_loop else None

    def presume(self, position: float) -> None:
        """Go on from there: it is commanded anew."""
        self._presumed = position
