"""Homing and zero: a drive's own procedure, begun by bit 4 of the controlword while it is armed and holds.

Rules. Zero is homing by a method that takes the present position, after which the method before is put back.
The end is taken from a statusword that came after the beginning.

Source: CiA 402-2 "homing mode"; package canopen 2.4.1 `profiles/p402.py` for the bits.
"""

from __future__ import annotations

from dataclasses import dataclass

from protocols.canopen import sdo
from protocols.canopen.client import Job, Outcome, Purpose
from protocols.canopen.objects import Type, from_bytes, to_bytes
from protocols.cia402 import objects as o
from protocols.cia402.profile import Control, Demand, Mode, Status
from protocols.cia402.setpoints import Values, standstill

METHODS = (37, 35)
"""Homing methods that take the present position (35 is the older number)."""
REPORTS = 3
"""Statuswords after the beginning before one is evaluated."""


@dataclass(slots=True)
class Homing:
    """A homing procedure. Plain data."""

    token: int
    zero: bool
    runs: bool = False
    """Its method is set."""
    method: int | None = None
    """The one before Zero."""
    tried: int = 0
    """Methods that Zero has tried."""
    began_at: int | None = None
    """Statuswords received when bit 4 rose."""
    failed: str = ""

    def job(self, method: int | None = None) -> Job:
        """Return the transfer that reads the method, or writes one."""
        data = None if method is None else to_bytes(Type.I8, method)
        return Job(Purpose.REQUEST, o.HOMING_METHOD, data, token=self.token)

    def on_method(self, outcome: Outcome) -> list[Job]:
        """Handle the end of a transfer of the method; return the next."""
        if outcome.job.data is None:
            self.method = from_bytes(Type.I8, outcome.value)
        elif outcome.abort is None:
            self.runs = True
            return []
        if outcome.abort in (sdo.NO_OBJECT, sdo.TIMEOUT) or self.tried >= len(METHODS):
            self.failed = f"it cannot take its present position as zero: {sdo.abort_text(outcome.abort or 0)}"
            return []
        self.tried += 1
        return [self.job(METHODS[self.tried - 1])]

    def values(self, position: int, mode_display: int | None, reports: int) -> Values:
        """Return the set-points; bit 4 rises once the drive displays the mode."""
        control = int(Demand.ENABLE_OPERATION)
        if mode_display == Mode.HM:
            self.began_at = reports if self.began_at is None else self.began_at
            control |= Control.START_HOMING
        return standstill(position) | {o.CONTROLWORD: control, o.MODE: int(Mode.HM)}

    def result(self, statusword: int, reports: int) -> tuple[bool, str] | None:
        """Return the end as (success, detail); None while it goes on."""
        if self.failed:
            return False, self.failed
        if self.began_at is None or reports < self.began_at + REPORTS:
            return None
        match statusword & (Status.BIT_13 | Status.BIT_12):
            case Status.BIT_12 if statusword & Status.REACHED:
                return True, "the present position is zero" if self.zero else "home is found"
            case Status.BIT_13:
                return False, "it reports a homing error (bit 13 of its statusword)"
        return None
