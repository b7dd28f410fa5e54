"""The recorder: takes ticks from the loop without delaying it; lost ticks are counted and reported.

Rules. Two threads beside the loop: one writes, one syncs the file to disk. The writer is woken for 20 ms of
ticks, which it encodes at once, while the loop sleeps: to be woken for each would cost more than the writing,
and to wake by itself would delay the loop. It writes 40 ms of them as one chunk, and what it has when none
come. So a kill loses up to 65 ms; a warning is written at once. After about a second the data survive a loss
of power. For a slow disk 5 s of ticks are queued; then ticks are dropped until half of these are written, so
that a gap is one gap. A problem is reported once when it begins and once when it ends, by the thread that
meets it: to the log, and in `trouble`.
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
"""The writer is woken when the queued ticks span this time;"""
POLL_PERIOD = 0.025
"""s: it polls the queue with this period, if not woken."""
QUEUE_LENGTH = 1024
"""Ticks that may be queued for the writer: 5 s at 200 Hz."""
SYNC_PERIOD = 1.0
"""s: period of syncing the file to disk"""
CLOSE_TIMEOUT = 10.0
"""s that closing waits for a slow disk"""


def prepare() -> None:
    """Do now what only the first recording of a process has to do: it takes too long for a step."""
    TickWriter(Path(os.devnull), "", environment.facts(), Views()).finish()


class Recorder:
    """Queues ticks from the loop for the thread that writes them.

    Raises RecordingError if the file cannot be created. Afterwards nothing raises."""

    def __init__(
        self,
        path: Path,
        robot_text: str,
        facts: Mapping[str, str],
        mounts: Mapping[str, Mount] | None = None,
        depth: int = QUEUE_LENGTH,
    ) -> None:
        self.path = path
        self.trouble = ""
        """The last problem, in a sentence; "" if there was none. Changes at most a few times."""
        self._dropped = 0
        self._gap = 0
        """Ticks dropped since the queue was full; 0 if it is not."""
        self._depth = depth
        self._writer = TickWriter(path, robot_text, {**environment.facts(), **facts}, Views(mounts))
        self._queue: deque[tuple[Tick, Belief, dict[str, int]]] = deque()
        """Both ends of a deque may be used by two threads at once."""
        self._woken: Nanos = 0
        """Time of the tick at which the writer was last woken."""
        self._wake = threading.Event()
        """Wakes the writer."""
        self._room = threading.Event()
        """Set when a tick was taken from the queue."""
        self._closing = self._closed = False
        self._syncer = _Syncer(self._writer.descriptor, path, self._report)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Number of ticks that were recorded and are not in the file."""
        return self._dropped + self._writer.lost

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._writer.size

    @property
    def over(self) -> bool:
        """Whether it has ended, and all is written."""
        return self._closing and not self._thread.is_alive()

    def record(self, tick: Tick, belief: Belief, *, patient: bool = False) -> None:
        """Queue a tick and the belief after it. Never waits, unless `patient` (in simulated time)."""
        if patient:
            self._wait_for_room()
        room = self._depth // 2 if self._gap else self._depth
        if len(self._queue) >= room or self._closing or not self._thread.is_alive():
            self._drop(tick)
            return
        # The counts are the only part of a belief that its owner continues to change.
        self._queue.append((tick, belief, dict(belief.rejected)))
        if tick.outputs.notes or tick.now - self._woken >= BATCH:
            self._woken = tick.now
            self._wake.set()
        if self._gap:
            self._report(f"{self.path} continues with tick {tick.number}: {self._gap} ticks are missing")
            self._gap = 0

    def end(self) -> None:
        """Take no more ticks. What is queued is written, and the file's index; then both threads end. Does
        not wait for that."""
        self._closing = True
        self._wake.set()

    def close(self) -> None:
        """Write the queued ticks and the file's index. May be called again."""
        if self._closed:
            return
        self._closed = True
        self.end()
        self._thread.join(CLOSE_TIMEOUT)
        self._syncer.close()
        if self._thread.is_alive():
            self._report(
                f"{self.path} has no index: the disk did not take the rest within {CLOSE_TIMEOUT:g} s; "
                f"repair it with: gateway recover {self.path}"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for_room(self) -> None:
        while len(self._queue) >= self._depth and self._thread.is_alive():
            self._wake.set()
            self._room.clear()
            self._room.wait(POLL_PERIOD)

    def _drop(self, tick: Tick) -> None:
        if not self._gap:
            reason = "the disk is too slow" if self._thread.is_alive() else "nothing writes it any more"
            reason = "it is closed" if self._closing else reason
            self._report(
                f"ticks from {tick.number} on are missing in {self.path}: {reason}; the robot continues"
            )
        self._dropped += 1
        self._gap += 1

    def _run(self) -> None:
        try:
            self._syncer.start()  # here, since the loop must not wait for it
            self._write_until_closed()
        except Exception as error:  # noqa: BLE001 -- whatever it is, it is reported, and the robot continues
            self._report(f"the recording ends here: {self.path}: {error!r}; the robot continues")
        self._report(self._writer.finish())
        self._syncer.close()

    def _write_until_closed(self) -> None:
        closing = False
        while not closing:
            woken = self._wake.wait(POLL_PERIOD)
            self._wake.clear()
            closing = self._closing  # read before the last poll: nothing is queued after it
            while self._queue:
                tick, belief, rejected = self._queue[0]
                self._report(self._writer.add(tick, replace(belief, rejected=rejected)))
                self._queue.popleft()  # only now: until it is in the chunk, it is queued
                self._room.set()
            if closing or not woken:
                self._report(self._writer.flush())

    def _report(self, trouble: str) -> None:
        if trouble:
            self.trouble = trouble
            log.error("recording: %s", trouble)


class _Syncer:
    """Syncs the file to disk once a second, in its own thread: a disk may need long for that, and ticks must
    leave the process meanwhile."""

    def __init__(self, descriptor: int, path: Path, report: Callable[[str], None]) -> None:
        self._descriptor = os.dup(descriptor)  # so that it stays valid when the file is closed
        self._path, self._report = path, report
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder-sync", daemon=True)

    def start(self) -> None:
        """Begin. Waits until the thread runs."""
        self._thread.start()

    def close(self) -> None:
        """Stop syncing. Does not wait for the disk."""
        self._closing.set()

    def _run(self) -> None:
        try:
            _sync_folder(self._path.parent)
            while not self._closing.wait(SYNC_PERIOD):
                os.fdatasync(self._descriptor)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EROFS):  # a pipe or device, which cannot do that
                self._report(f"{self._path}: the disk reports lost data: {error.strerror}")
        finally:
            os.close(self._descriptor)


def _sync_folder(folder: Path) -> None:
    """Sync the folder, which holds the file's name."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
