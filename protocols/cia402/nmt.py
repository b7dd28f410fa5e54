"""The NMT state of one drive, as far as it reports that, and the NMT start that makes it operational.

Source: CiA 301 "NMT".
"""

from __future__ import annotations

from protocols.canopen.services import Nmt, NmtCommand, NmtState, encode
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Nanos
from protocols.toolkit.duplicates import StateCheck

START_AGAIN = 100 * MILLISECOND
"""Period at which NMT start is repeated until the drive is operational."""
STARTS = 3
"""NMT starts to a drive that sends no NMT state, before it is assumed to be operational."""


class NmtStatus:
    """The NMT state of one drive since it began. Plain data."""

    def __init__(self, state: NmtState | None = None) -> None:
        self.state = state
        """None: it was not reported."""
        self._beats = StateCheck()
        self._starts = 0
        self._start_next: Nanos = 0

    def on_heartbeat(self, t: Nanos, state: NmtState) -> str:
        """Handle its heartbeat; return why there must be two devices, if so."""
        self.state = state
        two = self._beats.add(t, state, self._start_next - START_AGAIN)
        return "its heartbeats alternate between contradictory states" if two else ""

    def on_tpdo(self) -> None:
        """Note a TPDO: only an operational drive sends any."""
        self.state = NmtState.OPERATIONAL

    @property
    def operational(self) -> bool:
        """True if it is in NMT operational, as far as it reports that."""
        return self.state is NmtState.OPERATIONAL or (self.state is None and self._starts >= STARTS)

    def start(self, now: Nanos, address: int) -> list[CanFrame]:
        """Return the NMT start, if it is due."""
        if now < self._start_next:
            return []
        self._start_next, self._starts = now + START_AGAIN, self._starts + 1
        return [encode(Nmt(NmtCommand.START, address))]
