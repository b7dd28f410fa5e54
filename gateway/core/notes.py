"""The notes of a step for a person; the same refusal again and again is noted once, then counted."""

from __future__ import annotations

from typing import Literal, TypeAlias

from gateway.core.tick import Note
from protocols.messages import SECOND, Nanos

Level: TypeAlias = Literal["info", "warning", "error"]

REPEAT: Nanos = SECOND
"""A refusal that comes again sooner is counted, not noted: a driver may refuse the command of every step."""


class Notes:
    """What is noted since the last step. State is plain data."""

    def __init__(self) -> None:
        self._notes: list[Note] = []
        self._refused: dict[tuple[str, str, str], tuple[Nanos, int]] = {}
        """By request, source and reason: when the refusal was last noted, and how often it has come since."""

    def add(self, level: Level, source: str, text: str) -> None:
        """Add a note."""
        self._notes.append(Note(level, source, text))

    def refuse(self, t: Nanos, source: str, request: str, reason: str) -> None:
        """Add a note of a refusal; not if the same was noted within `REPEAT`."""
        refusal = request, source, reason
        last, left_out = self._refused.get(refusal, (None, 0))
        if last is not None and t - last < REPEAT:
            self._refused[refusal] = last, left_out + 1
            return
        self._refused = {key: value for key, value in self._refused.items() if t - value[0] < REPEAT}
        self._refused[refusal] = t, 0
        more = f" ({left_out} times more in the meantime)" if left_out else ""
        self.add("warning", source, f"{request}: refused: {reason}{more}")

    def take(self) -> tuple[Note, ...]:
        """Return the notes, once."""
        notes, self._notes = tuple(self._notes), []
        return notes
