"""The shafts of real motors in the simulated world: they turn as they are measured.

Rules. Until something is measured a shaft stands. Between two measurements it turns on at the last velocity,
for `SILENT` at most; then it is taken to stand, since nothing better is known. A joint with a range stands
where its device says; of a wheel only how far it has turned counts, and a leap that no motor can make (a
device that restarts at zero) counts for nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.robot import Motor
from gateway.sim.files import STEP
from gateway.sim.world import World
from protocols.messages import MILLISECOND, SECOND, Feedback, Nanos

SILENT: Nanos = 100 * MILLISECOND
"""After this time without a measurement a shaft is taken to stand."""
LEAP, LEAPING = 0.5, 2.0
"""rad, and a factor of the limit of velocity: what a wheel turns more between two measurements is a leap."""


AVERAGED: Nanos = 30 * MILLISECOND
"""Time constant with which the world's torque on a shaft is averaged: a contact is stiff."""


@dataclass(slots=True)
class Followed:
    """One real motor's shaft in the world."""

    motor: Motor
    world: World
    measured_at: Nanos | None = None
    """In the world's time"""
    resistance: float = 0.0
    """N·m, that the world puts on it, averaged; none while nothing is measured"""
    _measured: float = 0.0
    """rad, the last position"""
    _offset: float = 0.0
    """rad, from there to the world's"""
    _stands: bool = False

    def measure(self, feedback: Feedback, age: Nanos) -> None:
        """Take what was measured so long ago."""
        now, shaft = self.world.now, self.world.shaft(self.motor.name)[0]
        velocity, position = feedback.velocity or 0.0, feedback.position
        if position is not None:
            self._align(position, shaft, now)
            shaft = position + self._offset + velocity * min(age, SILENT) / SECOND
            self._measured = position
        self.measured_at, self._stands = now, False
        self.world.follow(self.motor.name, shaft, velocity)

    def _align(self, position: float, shaft: float, now: Nanos) -> None:
        """Set the offset of a wheel where its shaft in the world is right: at first, and after a leap."""
        if self.motor.joint.limits.position is not None:
            return
        most = LEAP
        if self.measured_at is not None:
            most += LEAPING * self.motor.joint.limits.velocity * (now - self.measured_at) / SECOND
        if self.measured_at is None or abs(position - self._measured) > most:
            self._offset = shaft - position

    def look(self) -> None:
        """Let it stand if it is not measured any more; feel the world's torque."""
        silent = self.measured_at is None or self.world.now - self.measured_at > SILENT
        if silent and not self._stands:
            self._stands = True
            self.world.hold(self.motor.name)
        felt = 0.0 if silent else self.world.resistance(self.motor.name)
        self.resistance += (felt - self.resistance) * STEP / AVERAGED
