"""The recorder: takes ticks from the loop and never hinders it. What is missing is counted and told.

Rules. Two threads beside the loop: one writes, one asks the disk to make it last. The writer is woken for
20 ms of ticks, which it puts into the file in one go, while the loop sleeps: to be woken for each would cost
more than the writing, and to wake by itself would hold up the loop. So a kill loses 25 ms, up to 100 ms if
the machine is busy; a note is written at once. All survives a loss of power after about a second. A disk
that is slow has 5 s of ticks to wait; then ticks are left out until half of these are written, so that a gap
is one gap. Trouble is told once, when it begins and when it ends, by whichever thread meets it: to the log
at once, and in `trouble`.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from brain.belief import Belief
from brain.perception.mount import Mount
from gateway.core.tick import Tick
from gateway.recording import environment
from gateway.recording.ros_views import Views
from gateway.recording.tick_writer import TickWriter
from protocols.messages import MILLISECOND, Nanos

log = logging.getLogger("gateway")

BATCH: Nanos = 20 * MILLISECOND
"""The writer is woken when ticks wait over so much of their own time;"""
LOOK_PERIOD = 0.025
"""s after which it looks by itself, if no tick comes."""
DEPTH = 1024
"""Ticks that may wait for the writer: 5 s at 200 Hz."""
SYNC_PERIOD = 1.0
"""s between two requests to the disk to keep what was written"""
CLOSE_WITHIN = 10.0
"""s that closing waits for a slow disk"""


class Recorder:
    """Takes ticks from the loop and gives them to the one thread that writes.

    Raises RecordingError if the file cannot be begun. Afterwards nothing raises."""

    def __init__(
        self,
        path: Path,
        robot_text: str,
        facts: Mapping[str, str],
        mounts: Mapping[str, Mount] | None = None,
        depth: int = DEPTH,
    ) -> None:
        self.path = path
        self.trouble = ""
        """What went wrong last, in a sentence; "" as long as nothing has. Changes at most a few times."""
        self._refused = 0
        self._gap = 0
        """Ticks refused since the queue was full; 0 if it is not."""
        self._depth = depth
        self._writer = TickWriter(path, robot_text, {**environment.facts(), **facts}, Views(mounts))
        self._waiting: deque[tuple[Tick, Belief, dict[str, int]]] = deque()
        """What was handed over. Both ends of a deque may be used by two threads at once."""
        self._woken: Nanos = 0
        """At which tick the writer was last woken."""
        self._look = threading.Event()
        """That the writer is to look now."""
        self._room = threading.Event()
        """That a tick was taken."""
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()
        self._syncer = _Syncer(self._writer.descriptor, path, self._report)

    @property
    def lost(self) -> int:
        """Ticks that are not in the file although they were handed over."""
        return self._refused + self._writer.lost

    def record(self, tick: Tick, belief: Belief, *, patient: bool = False) -> None:
        """Hand over a tick and the belief after it. Never waits, unless `patient` (in simulated time)."""
        if patient:
            self._wait_for_room()
        room = self._depth // 2 if self._gap else self._depth
        if len(self._waiting) >= room or self._closing or not self._thread.is_alive():
            self._refuse(tick)
            return
        # The counts are the one part of a belief that its owner goes on writing to.
        self._waiting.append((tick, belief, dict(belief.rejected)))
        if tick.outputs.notes or tick.now - self._woken >= BATCH:
            self._woken = tick.now
            self._look.set()
        if self._gap:
            self._report(f"{self.path} goes on with tick {tick.number}: {self._gap} ticks are missing")
            self._gap = 0

    def close(self) -> None:
        """Write what is waiting, and the file's index. May be called again."""
        if self._closing:
            return
        self._closing = True
        self._look.set()
        self._thread.join(CLOSE_WITHIN)
        self._syncer.close()
        if self._thread.is_alive():
            self._report(
                f"{self.path} has no index: the disk did not take the rest within {CLOSE_WITHIN:g} s; "
                f"mend it with: gateway recover {self.path}"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _wait_for_room(self) -> None:
        while len(self._waiting) >= self._depth and self._thread.is_alive():
            self._look.set()
            self._room.clear()
            self._room.wait(LOOK_PERIOD)

    def _refuse(self, tick: Tick) -> None:
        if not self._gap:
            why = "it is closed" if self._closing else "the disk is too slow"
            self._report(
                f"ticks from {tick.number} on are missing in {self.path}: {why}; the robot drives on"
            )
        self._refused += 1
        self._gap += 1

    def _run(self) -> None:
        closing = False
        while not closing:
            self._look.wait(LOOK_PERIOD)
            self._look.clear()
            closing = self._closing  # read before the last look: nothing is handed over after it
            while self._waiting:
                tick, belief, rejected = self._waiting[0]
                self._report(self._writer.add(tick, replace(belief, rejected=rejected)))
                self._waiting.popleft()  # only now: until it is in the sheet, it waits
                self._room.set()
            self._report(self._writer.flush())
        self._report(self._writer.finish())

    def _report(self, trouble: str) -> None:
        if trouble:
            self.trouble = trouble
            log.error("recording: %s", trouble)


class _Syncer:
    """Asks the disk once a second to make last what was written, in a thread of its own: a disk may take its
    time over that, and what is handed over must leave the process meanwhile."""

    def __init__(self, descriptor: int, path: Path, report: Callable[[str], None]) -> None:
        self._descriptor = os.dup(descriptor)  # so that it is still ours when the file is closed
        self._path, self._report = path, report
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder-sync", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask no more. Does not wait for a disk."""
        self._closing.set()

    def _run(self) -> None:
        try:
            _sync_folder(self._path.parent)
            while not self._closing.wait(SYNC_PERIOD):
                os.fdatasync(self._descriptor)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EROFS):  # a pipe or device, which cannot do that
                self._report(f"{self._path}: the disk says that it lost something: {error.strerror}")
        finally:
            os.close(self._descriptor)


def _sync_folder(folder: Path) -> None:
    """Make the file's name last."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
