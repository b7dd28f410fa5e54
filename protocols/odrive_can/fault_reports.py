"""The faults of one device: the error bits already reported, and the error words still awaited.

Rules. A bit is reported once for as long as it is set. An error word that a heartbeat shows to be set is
requested, and so is the reason why an axis disarmed by itself; one without a reply to `ATTEMPTS` requests is
no longer awaited.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from protocols.messages import Event, Fault, Nanos
from protocols.odrive_can.codec import cmd_of
from protocols.odrive_can.dialect import Dialect, Status
from protocols.odrive_can.faults import bits, fault_info
from protocols.odrive_can.faults05 import BASE_SHIFT
from protocols.odrive_can.messages import GetError
from protocols.plugin import FaultInfo

ATTEMPTS = 5


@dataclass(slots=True)
class FaultReports:
    """The reported and awaited faults of one device. Plain data."""

    motor: str
    reported: set[int] = field(default_factory=set)
    """Codes of error bits that were reported and are still set."""
    awaited: dict[int, int] = field(default_factory=dict)
    """Error words that are awaited, by command, and how often each was requested."""

    def on_status(
        self, t: Nanos, dialect: Dialect, before: Status, status: Status, disarmed_itself: bool
    ) -> list[Event]:
        """Handle a heartbeat, given the one before it."""
        self.awaited |= dict.fromkeys(dialect.disarm_reasons, 0) if disarmed_itself else {}
        self.awaited |= {cmd: 0 for cmd in status.components if cmd not in before.components}
        errors = status.error & ~dialect.initializing if dialect.axis_faults else 0  # else of unknown meaning
        events = self._report(t, errors, dialect.axis_faults, dialect.axis_base)
        words = {dialect.component_faults[cmd][0] for cmd in status.components}
        axis = {dialect.axis_base + bit for bit in bits(status.error)}
        # A bit that is no longer set is reported anew when it is set again.
        self.reported = {
            code for code in self.reported if code in axis or code >> BASE_SHIFT << BASE_SHIFT in words
        }
        return events

    def on_errors(self, t: Nanos, dialect: Dialect, active: int, reason: int) -> list[Event]:
        """Handle Get_Error: the disarm reason counts only after a disarming that was observed."""
        table, base = dialect.axis_faults, dialect.axis_base
        events = self._report(t, active & ~dialect.initializing, table, base)
        if self.awaited.pop(cmd_of(GetError), None) is not None:
            events += self._report(t, reason & ~dialect.initializing, table, base, "it disarmed the axis: ")
        return events

    def on_component(self, t: Nanos, dialect: Dialect, cmd: int, errors: int) -> list[Event]:
        """Handle the error word of a component (0.5.x)."""
        self.awaited.pop(cmd, None)
        base, table = dialect.component_faults[cmd]
        return self._report(t, errors, table, base)

    def on_requests(self, cmds: Sequence[int]) -> None:
        """Count the requests just sent, of awaited words and others."""
        counts = {cmd: count + cmds.count(cmd) for cmd, count in self.awaited.items()}
        self.awaited = {cmd: count for cmd, count in counts.items() if count < ATTEMPTS}

    def _report(
        self, t: Nanos, errors: int, table: Mapping[int, FaultInfo], base: int, prefix: str = ""
    ) -> list[Event]:
        """Return the faults of the bits that are not reported yet."""
        new = [bit for bit in bits(errors) if base + bit not in self.reported]
        self.reported |= {base + bit for bit in new}
        found = [(bit, fault_info(bit, table)) for bit in new]
        return [Fault(self.motor, t, base + bit, x.name, prefix + x.cause, x.remedy) for bit, x in found]
