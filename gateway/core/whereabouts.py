"""Where a joint is: whether that is known, and whether it is near enough to its range for a motion to begin.

Rules. A reading that has jumped (`gateway.core.reference`) makes the position unknown; a device may give it
another value, and move by itself, only under a request. Beyond its range by more than the margin nothing is
armed, and what is driven further out is a fault. A wheel that was never commanded to a position has none.
"""

from __future__ import annotations

from math import inf

from gateway.core.faults import BEYOND_TRAVEL, UNREFERENCED, Finding
from gateway.core.limits import Limits
from gateway.core.measured import Measured
from gateway.core.reference import ANEW, Reference
from protocols import messages as msg
from protocols.messages import SECOND, Command, Nanos

HOMING_MOST: Nanos = 60 * SECOND
"""The longest own motion of a device, during which its set-points are not compared with what it measures."""
_REFERENCES = frozenset({"Zero", "Home"})
"""Requests after which the position is known."""
_TO_A_PLACE = msg.Position, msg.Impedance
_OWN_MOTION = _REFERENCES | {"Reboot"}
"""Requests under which a device moves, or gives its position another value, by itself."""


class Whereabouts:
    """The place of one joint, at the output shaft. State is plain data."""

    def __init__(self, limits: Limits, reference: Reference) -> None:
        self._limits, self._reference = limits, reference
        self._reading: tuple[Nanos, float] | None = None
        """The newest position of this step, with its time."""
        self._by_position = limits.position is not None
        """Whether it matters where its zero is: it has a range, or was commanded to positions."""
        self._reach = limits.margin
        """rad: how far outside its range it may be."""
        self._own_motion: tuple[str, Nanos] | None = None
        """The request under which the device moves by itself, and since when."""

    def on_position(self, t: Nanos, position: float) -> None:
        """Note a reading; the last of a step is judged."""
        self._reading = t, position

    def on_request(self, now: Nanos, request: str) -> None:
        """Note a request of this name that is passed to the device."""
        if request in _OWN_MOTION:
            self._own_motion = request, now
        if request in _REFERENCES:
            self._reference.give_anew(now + HOMING_MOST)

    def on_answer(self, now: Nanos, request: str, *, done: bool) -> tuple[bool, bool]:
        """Note the answer to a request; return whether its own motion is over, and its position known."""
        over = self._own_motion is not None and self._own_motion[0] == request
        self._own_motion = None if over else self._own_motion
        if request in _REFERENCES:
            self._reference.give_anew(now + ANEW if done else now)
        return over, done and request in _REFERENCES

    def moves_by_itself(self, now: Nanos) -> bool:
        """True if a request is under way by which the device moves; it cannot take for ever."""
        if self._own_motion is not None and now - self._own_motion[1] > HOMING_MOST:
            self._own_motion = None
        return self._own_motion is not None

    def confirm(self) -> None:
        """Take the reported position as the true one: it was zeroed, homed, or a person has looked."""
        self._reference.confirm()

    def outside(self, measured: Measured) -> float:
        """Return how far outside its range it is [rad]."""
        position = measured.feedback.position
        return 0.0 if position is None else self._limits.outside(position)

    def begin(self, measured: Measured) -> None:
        """Let it be as far outside its range as it is now, or within the margin."""
        self._reach = max(self._limits.margin, self.outside(measured))

    def check(self, measured: Measured, *, driven: bool) -> list[Finding]:
        """Return what is wrong: the reading has jumped, or the shaft has left its range under a command."""
        reading, self._reading = self._reading, None
        found: list[Finding] = []
        if reading is not None and self._by_position:
            t, position = reading
            if wrong := self._reference.read(t, position, measured.feedback.velocity or 0.0):
                found.append((UNREFERENCED, wrong))
        if not driven:
            self.begin(measured)
        elif (outside := self.outside(measured)) > self._reach and self._own_motion is None:
            self._reach = outside
            found.append((BEYOND_TRAVEL, self._text(measured)))
        return found

    def objection(self, now: Nanos, wanted: Command, measured: Measured, *, begins: bool) -> str:
        """Return why it must not move: where it is is not known, or it `begins` too far outside; else ""."""
        margin = self._limits.margin
        if self._reference.lost:
            return f"{self._reference.lost}: zero it or home it, or confirm it"
        if self._by_position and measured.measures_no_position(now):
            return "it reports no position, or one beyond what it measures: a turn lost? zero it or home it"
        if begins and self.outside(measured) > margin:
            return (
                f"{self._text(measured)}: a turn lost? zero it or home it; if it is there, "
                f"move it by hand to within {margin:g} rad of its range"
            )
        self._by_position = self._by_position or isinstance(wanted, _TO_A_PLACE)
        return ""

    def _text(self, measured: Measured) -> str:
        low, high = self._limits.position or (-inf, inf)
        return f"reads {measured.feedback.position or 0.0:.4g} rad, limits [{low:g}, {high:g}]"
