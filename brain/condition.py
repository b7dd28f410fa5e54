"""The brain's own state, its reason, and what there is to say to a person.

Rules. Each change of state is said once; a reason that changes within a state is not, so that a source that
is lost does not fill the terminal. A stop from above has been told by those who made it, with their level:
here it is a warning, an operator's own stop being no error.
"""

from __future__ import annotations

from brain.belief import BrainState
from brain.planning.mission import Level, Note

_LEVELS: dict[BrainState, Level] = {
    BrainState.INITIALISING: "info",
    BrainState.READY: "info",
    BrainState.RUNNING: "info",
    BrainState.DEGRADED: "warning",
    BrainState.STOPPED: "error",
}


class StatusReporter:
    """State, reason, remarks. Plain data."""

    def __init__(self) -> None:
        self.state = BrainState.INITIALISING
        self.reason = "waiting for the first measurements"
        self._remarks: list[Note] = []

    def become(self, state: BrainState, reason: str) -> None:
        """Be in this state, for this reason."""
        self._become(state, reason, _LEVELS[state])

    def obey(self, reason: str) -> None:
        """Be stopped, because those above say so."""
        self._become(BrainState.STOPPED, reason, "warning")

    def say(self, level: Level, text: str) -> None:
        """Have something said to the operator."""
        self._remarks.append((level, text))

    def _become(self, state: BrainState, reason: str, level: Level) -> None:
        if state is not self.state:
            self.say(level, f"{state}: {reason}" if reason else f"{state}")
        self.state, self.reason = state, reason

    def take_notes(self) -> list[Note]:
        """What there is to say since this was last asked."""
        remarks, self._remarks = self._remarks, []
        return remarks
