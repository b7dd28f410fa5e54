"""The brain's own state, its reason, and its notes for the operator.

Rules. Each change of state is reported once, and of a base that stays degraded each new reason, apart from
its figures, so that a lost source does not fill the terminal. A stop from above was reported, with its level,
where it was issued: here it is a warning, since an operator's own stop is no error.
"""

from __future__ import annotations

import re
from typing import Literal, TypeAlias

from brain.belief import BrainState

NoteLevel: TypeAlias = Literal["info", "warning", "error"]
Note: TypeAlias = tuple[NoteLevel, str]
"""(level, sentence) for the operator."""

_LEVELS: dict[BrainState, NoteLevel] = {
    BrainState.INITIALISING: "info",
    BrainState.READY: "info",
    BrainState.RUNNING: "info",
    BrainState.DEGRADED: "warning",
    BrainState.STOPPED: "error",
}


class StatusReporter:
    """State, reason and pending notes. Plain data."""

    def __init__(self) -> None:
        self.state = BrainState.INITIALISING
        self.reason = "waiting for the first measurements"
        self._notes: list[Note] = []
        self._noted: set[str] = set()
        """The beginnings of the reasons reported in this state."""

    def enter(self, state: BrainState, reason: str, level: NoteLevel | None = None) -> None:
        """Enter a state, or stay in it with another reason; `level` is the state's own by default."""
        if state is not self.state:
            self._noted.clear()
        words = re.split(r"[-+\d]", reason.removeprefix("just recovered: "), maxsplit=1)[0]
        if state is not self.state or (state is BrainState.DEGRADED and words not in self._noted):
            self._noted.add(words)
            self.add_note(level or _LEVELS[state], f"{state}: {reason}" if reason else f"{state}")
        self.state, self.reason = state, reason

    def wait(self, reason: str) -> None:
        """Stay in the state, for another reason, without a note."""
        self.reason = reason

    def add_note(self, level: NoteLevel, text: str) -> None:
        """Add a note for the operator."""
        self._notes.append((level, text))

    def take_notes(self) -> list[Note]:
        """Return the notes added since the last call."""
        notes, self._notes = self._notes, []
        return notes
