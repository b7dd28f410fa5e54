"""Whether the position that a device reports can be trusted: that it is the one it had before.

Rules. A reading is compared with the one before: across a restart of the device, a silence, and arming. It
may have moved as far as the velocity allows: the measured one between two reports, that of the robot file in
a silence. After a silence two more things are no motion: whole turns of the device, and a reading of zero. A
request (`Zero`, `Home`) may give it any value. Once the reading has jumped, the position is unknown until it
is zeroed, homed, or confirmed by a person: to clear a fault is not enough.

What cannot be noticed: a loss in a silence in which the shaft could have turned as far; less than `ROOM`; the
very first reading of a run, but of a joint with a range, which must be within its margin
(`gateway.core.joint`). State is plain data.
"""

from __future__ import annotations

from math import pi

from gateway.core.limits import Limits
from protocols.messages import MILLISECOND, SECOND, Nanos
from protocols.plugin import Spec

ROOM = 0.05
"""rad at the output shaft, beside what the device resolves"""
JITTER = 0.05
"""s by which the stamps of reports may be wrong against each other"""
FASTER = 1.2
"""Share of the limit of velocity at which a shaft may turn in a silence"""
UNSTEADY = 0.1
"""Share of the limit of velocity by which it may turn faster than was measured"""
SILENCE: Nanos = 100 * MILLISECOND
"""Without a report, or three of the device's own periods, if that is longer"""
WHOLE = 0.02
"""Share of a turn within which turns are whole"""
ANEW: Nanos = 500 * MILLISECOND
"""How long after the answer to a request the reading may still change by it"""


class Reference:
    """The readings of one joint, at the output shaft."""

    def __init__(self, limits: Limits, spec: Spec, gear: float) -> None:
        place = spec.ranges.get("Feedback.position")
        self._limits = limits
        self._turn = 2.0 * pi / gear
        """rad at the output shaft in one turn of the device"""
        self._room = ROOM + (2.0 * place.resolution / gear if place else 0.0)
        self._silence = max(SILENCE, 3 * spec.feedback_period)
        self._last: tuple[Nanos, float, float] | None = None
        """Time, position and velocity of the reading that the next is compared with"""
        self._anew_until: Nanos = 0
        self.lost = ""
        """Why the position is unknown; "" if it is known"""

    def give_anew(self, until: Nanos) -> None:
        """Accept any reading up to a time: the device was asked to give its position another value."""
        self._anew_until = until

    def confirm(self) -> None:
        """Take the reading as the position, whatever it was before: zeroed, homed, or confirmed."""
        self.lost = ""

    def read(self, t: Nanos, position: float, velocity: float) -> str:
        """Compare the newest reading [rad, rad/s] with the one before; return what is wrong, or ""."""
        last, self._last = self._last, (t, position, velocity)
        if last is None or t <= self._anew_until:
            return ""
        before, place, speed = last
        silent, moved = t - before > self._silence, position - place
        limit = self._limits.velocity
        fastest = FASTER * limit if silent else max(abs(speed), abs(velocity)) + UNSTEADY * limit
        turns = moved / self._turn
        jumped = abs(moved) > fastest * ((t - before) / SECOND + JITTER) + self._room
        if silent and abs(moved) > self._room:
            whole = round(turns)
            jumped = jumped or bool(whole and abs(turns - whole) < WHOLE) or abs(position) < self._room
        if not jumped or self.lost:  # it is lost since the first jump
            return ""
        self.lost = (
            f"its position went from {place:.4g} to {position:.4g} rad, {turns:+.2f} turns of the device"
        )
        return self.lost
