"""A recording in several files: the next begins after a time or a size; of a ring, the last minutes stay.

Rules. No tick is lost between two files, and the run goes on whatever the disk says: where the next file
cannot be made, the present one goes on. Only files that this run has made are ever removed, and none that was
there when something went wrong: an error in the notes keeps what the ring holds, and the file in which it
happened.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.errors import RecordingError, UserError
from gateway.recording import Recorder, prepare
from protocols.bounds import Bounds
from protocols.messages import SECOND, Nanos

log = logging.getLogger("gateway")

LOOK: Nanos = SECOND
"""Period in which time and size are looked at."""
PIECES = 4
"""In so many files a ring is cut, if nothing else is asked for: it is a quarter too long at most."""


@dataclass(frozen=True, slots=True)
class Rotation:
    """When another file begins, and what stays. 0: no such bound."""

    seconds: Annotated[float, Bounds(0.0, 1e7)] = 0.0
    """Longest time in one file [s]"""
    size: Annotated[int, Bounds(0, 1 << 50)] = 0
    """Largest file [bytes], and what comes within a second"""
    keep: Annotated[float, Bounds(0.0, 1e7)] = 0.0
    """Only so much of the past stays [s]: a ring; 0: all"""

    @property
    def span(self) -> Nanos:
        """Longest time in one file; 0: no bound."""
        return round((self.seconds or (0.0 if self.size else self.keep / PIECES)) * SECOND)


class Recording(Protocol):
    """What records, and can be told to go on in another file."""

    recorder: Recorder | None

    def start_recording(self, path: Path | str) -> None:
        """Record into another file from the next tick on."""
        ...


class Rotator:
    """Rotates the recording of one run."""

    def __init__(self, recording: Recording, rotation: Rotation) -> None:
        prepare()
        self._recording, self._rotation = recording, rotation
        self._first = recording.recorder.path if recording.recorder is not None else Path()
        self._number = 1
        self._began: Nanos | None = None
        """When the present file began,"""
        self._looked: Nanos = 0
        """and when it was last looked at."""
        self._past: list[tuple[Nanos, Path]] = []
        """Of a ring, the files before, and when each ended."""
        self._kept = False
        """Whether something went wrong in the present file."""

    def take(self, tick: Tick, _: Belief) -> None:
        """Take a tick before it is recorded."""
        if self._began is None:
            self._began = self._looked = tick.now
        if tick.now - self._looked >= LOOK:
            self._looked = tick.now
            self._look(tick.now, tick.now - self._began)
        if any(note.level == "error" for note in tick.outputs.notes):
            self._keep()

    def _look(self, now: Nanos, span: Nanos) -> None:
        recorder, rotation = self._recording.recorder, self._rotation
        if recorder is None:
            return
        full = 0 < rotation.size <= recorder.size or 0 < rotation.span <= span
        if full and self._go_on():
            if rotation.keep and not self._kept:
                self._past.append((now, recorder.path))
            self._began, self._kept = now, False
        while self._past and now - self._past[0][0] >= rotation.keep * SECOND:
            self._remove(self._past.pop(0)[1])

    def _go_on(self) -> bool:
        """Begin the next file; False if it cannot be made."""
        path = self._first.with_name(f"{self._first.stem}-{self._number + 1:04}{self._first.suffix}")
        try:
            self._recording.start_recording(path)
        except (RecordingError, UserError) as error:
            log.error("the recording goes on in the same file: %s", error)
            return False
        self._number += 1
        return True

    def _keep(self) -> None:
        if self._rotation.keep and not self._kept:
            log.warning("recordings kept, since something went wrong: %s", ", ".join(self._files()))
        self._past.clear()
        self._kept = True

    def _files(self) -> list[str]:
        recorder = self._recording.recorder
        present = [] if recorder is None else [recorder.path]
        return [path.name for path in (*(path for _, path in self._past), *present)]

    def _remove(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            log.error("%s: is not removed: %s", path, error.strerror)
