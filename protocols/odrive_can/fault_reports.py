"""What a device complains of: the error bits that were told, and the error words that are waited for.

Rules. A bit is told once for as long as it is there. A word that a heartbeat says to be not empty is asked
for, and so is why an axis disarmed by itself; one that is not told in `ATTEMPTS` is not waited for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from protocols.messages import Event, Fault, Nanos
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.dialect import Beat, Dialect
from protocols.odrive_can.faults import bits, text_of
from protocols.odrive_can.faults05 import BASE_SHIFT
from protocols.odrive_can.messages import GetError
from protocols.plugin import FaultInfo

ATTEMPTS = 5
"""An error word that is not told in so many tries is not waited for."""


@dataclass(slots=True)
class FaultReports:
    """The complaints of one device. Plain data."""

    motor: str
    reported: set[int] = field(default_factory=set)
    """Codes of error bits that are told, and still there."""
    wanted: dict[int, int] = field(default_factory=dict)
    """Error words that are waited for, by command, and how often they were asked for."""

    def on_beat(self, t: Nanos, dialect: Dialect, before: Beat, beat: Beat, fell: bool) -> list[Event]:
        """A heartbeat, and the one before it; `fell`: the axis has just disarmed by itself."""
        self.wanted |= dict.fromkeys(dialect.reasons, 0) if fell else {}
        self.wanted |= {cmd: 0 for cmd in beat.parts if cmd not in before.parts}
        errors = beat.error & ~dialect.initializing if dialect.axis else 0  # else nobody knows what they mean
        events = self._fresh(t, errors, dialect.axis, dialect.base)
        self._forget(dialect, beat)
        return events

    def on_errors(self, t: Nanos, dialect: Dialect, active: int, reason: int) -> list[Event]:
        """Get_Error: the disarm reason counts only where we saw it disarm; an old one is history."""
        events = self._fresh(t, active & ~dialect.initializing, dialect.axis, dialect.base)
        if self.wanted.pop(cmd_of(GetError), None) is not None:
            reason &= ~dialect.initializing
            events += self._fresh(t, reason, dialect.axis, dialect.base, "it disarmed the axis: ")
        return events

    def on_part(self, t: Nanos, dialect: Dialect, cmd: int, errors: int) -> list[Event]:
        """An error word of its own (0.5.x)."""
        self.wanted.pop(cmd, None)
        base, texts = dialect.parts[cmd]
        return self._fresh(t, errors, texts, base)

    def asked(self, cmds: Sequence[int]) -> None:
        """These were asked for, other commands among them."""
        counts = {cmd: count + cmds.count(cmd) for cmd, count in self.wanted.items()}
        self.wanted = {cmd: count for cmd, count in counts.items() if count < ATTEMPTS}

    def _fresh(
        self, t: Nanos, errors: int, texts: Mapping[int, FaultInfo], base: int = 0, prefix: str = ""
    ) -> list[Event]:
        fresh = [bit for bit in bits(errors) if base + bit not in self.reported]
        self.reported |= {base + bit for bit in fresh}
        said = [(bit, text_of(bit, texts)) for bit in fresh]
        return [Fault(self.motor, t, base + bit, x.name, prefix + x.cause, x.remedy) for bit, x in said]

    def _forget(self, dialect: Dialect, beat: Beat) -> None:
        """What is gone is told anew when it comes again."""
        words = {dialect.parts[cmd][0] for cmd in beat.parts}
        axis = {dialect.base + bit for bit in bits(beat.error)}
        self.reported = {
            code for code in self.reported if code in axis or code >> BASE_SHIFT << BASE_SHIFT in words
        }
