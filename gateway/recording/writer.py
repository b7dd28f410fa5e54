"""Writes a recording. What cannot be written is counted in `lost` and told in `trouble`.

Rules. No error of a disk reaches the loop, and nothing is written after the first one: what lies before it
stays readable. What was handed over is on disk at most 100 ms later (so much may be lost on a kill), with a
warning or an error at once.
"""

from __future__ import annotations

import os
import queue
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from brain.belief import Belief
from brain.perception.mount import Mount
from gateway import journal, machine
from gateway.recording.layout import FACTS, FORMAT, METADATA, ROBOT_FILE, RecordingError, digest
from gateway.tick import Tick
from gateway.views import Views
from protocols.words import MILLISECOND, Nanos

if TYPE_CHECKING:
    from mcap.writer import Writer

FLUSH_PERIOD: Nanos = 80 * MILLISECOND
"""Between two flushes, by the ticks' own time. More would break the promise of 100 ms, less costs memory:
the index of a chunk stays in the writer, about 1 kB each."""
IDLE = 0.02
"""s without a tick after which is flushed too, so that the promise holds at any period."""
CHUNK = 64 * 1024
DEPTH = 1024
"""Ticks that may wait for the writer: 5 s at 200 Hz."""
CLOSE_WITHIN = 10.0
"""s that closing waits for a slow disk"""

# Their subscribers come late: rosbag2 must offer them what was sent before (QoS as rosbag2 writes it).
_LATCHED = frozenset({"/tf_static", "/map", "/plan", "/goal_pose"})
_LATCHED_QOS = """\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: automatic
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""


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
        self._file = _File(path, robot_text, {**machine.facts(), **facts}, Views(mounts))
        self._queue: queue.Queue[tuple[Tick, Belief] | None] = queue.Queue(depth)
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Ticks that are not in the file although they were handed over."""
        return self._refused + self._file.lost

    def record(self, tick: Tick, belief: Belief, *, patient: bool = False) -> None:
        """Hand over a tick and the belief after it. Never waits, unless `patient` (in simulated time)."""
        try:
            # The counts are the one part of a belief that its owner goes on writing to.
            self._put((tick, replace(belief, rejected=dict(belief.rejected))), patient)
        except queue.Full:
            if not self._refused:
                why = "the disk is too slow" if self._thread.is_alive() else "it is closed"
                self.trouble = (
                    f"ticks from {tick.number} on are missing in {self.path}: {why}; the robot drives on"
                )
            self._refused += 1

    def close(self) -> None:
        """Write what is waiting, and the file's index. May be called again."""
        if self._closed:
            return
        self._closed = True
        try:
            self._put(None, patient=True)
        except queue.Full:
            pass
        else:
            self._thread.join(CLOSE_WITHIN)
        if self._thread.is_alive() and not self.trouble:
            self.trouble = f"{self.path} has no end: the disk did not take it within {CLOSE_WITHIN:g} s"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, item: tuple[Tick, Belief] | None, patient: bool) -> None:
        """Raises queue.Full if nobody takes it: at once, or if patient, when nobody ever will."""
        while self._thread.is_alive():
            try:
                self._queue.put(item, block=patient, timeout=CLOSE_WITHIN)
            except queue.Full:
                if not patient or item is None:
                    raise
            else:
                return
        raise queue.Full

    def _run(self) -> None:
        while True:
            try:
                item = self._queue.get(timeout=IDLE if self._file.pending else None)
            except queue.Empty:
                self._tell(self._file.flush())
                continue
            if item is None:
                break
            self._tell(self._file.add(*item))
        self._tell(self._file.finish())

    def _tell(self, trouble: str) -> None:
        if trouble:
            self.trouble = trouble


class _File:
    """The file, seen by the writer's thread only. Each method returns what went wrong, or ""."""

    def __init__(self, path: Path, robot_text: str, facts: Mapping[str, str], views: Views) -> None:
        from mcap.writer import CompressionType, Writer

        self.path = path
        self.lost = 0
        self._views = views
        self._seals = journal.UNSEALED
        self._channels: dict[tuple[str, str], int] = {}
        self.pending = 0
        """Ticks not yet flushed,"""
        self._since: Nanos = 0
        """the first of them from then."""
        self._broken = False
        try:
            self._stream = path.open("wb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer: Writer = Writer(self._stream, chunk_size=CHUNK, compression=CompressionType.LZ4)
        try:
            self._begin(robot_text, facts)
        except OSError as error:
            self._abandon()
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error

    def _begin(self, robot_text: str, facts: Mapping[str, str]) -> None:
        robot = robot_text.encode(errors="surrogateescape")
        self._writer.start(profile="ros2", library=f"motor-gateway {facts.get('package motor-gateway', '')}")
        self._writer.add_metadata(METADATA, {"format": FORMAT, "robot digest": digest(robot)})
        self._writer.add_metadata(FACTS, dict(sorted(facts.items())))
        self._writer.add_attachment(0, 0, ROBOT_FILE, "application/toml", robot)
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap annotates arguments only

    def add(self, tick: Tick, belief: Belief) -> str:
        """One tick and its views."""
        if self._broken:
            self.lost += 1
            return ""
        try:
            data, seals = journal.encode(tick, self._seals)
        except (ValueError, struct.error) as error:
            self.lost += 1
            return f"tick {tick.number} is not in the recording: {error}"
        self._since = self._since if self.pending else tick.now
        self.pending += 1
        self._seals = seals
        try:
            self._message(tick, journal.TOPIC, journal.TYPE, tick.now, data)
            for view in self._views.messages(tick, belief):
                self._message(tick, *view)
        except OSError as error:
            return self._break(error)
        urgent = any(note.level != "info" for note in tick.outputs.notes)
        return self.flush() if urgent or tick.now - self._since >= FLUSH_PERIOD else ""

    def flush(self) -> str:
        """Everything so far, out of this process."""
        if self._broken or not self.pending:
            return ""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]  # mcap annotates arguments only
        except OSError as error:
            return self._break(error)
        self.pending = 0
        return ""

    def finish(self) -> str:
        """The index, and the end."""
        trouble = self.flush()
        if self._broken:
            return trouble
        try:
            with self._stream:
                self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates arguments only
                self._stream.flush()
                os.fsync(self._stream.fileno())
        except OSError as error:
            return self._break(error)
        return ""

    def _break(self, error: OSError) -> str:
        """Nothing is written after the first error: what lies before it stays readable."""
        self._broken = True
        self.lost += self.pending
        self._abandon()
        return f"the recording ends here: {self.path}: {error.strerror}; the robot drives on"

    def _abandon(self) -> None:
        with suppress(OSError):  # the same error again: what is still buffered cannot be written
            self._stream.close()

    def _message(self, tick: Tick, topic: str, type_: str, t: Nanos, data: bytes) -> None:
        channel = self._channels.get((topic, type_))
        if channel is None:
            channel = self._channels[topic, type_] = self._channel(topic, type_)
        self._writer.add_message(
            channel,
            log_time=max(0, tick.now),
            data=data,
            publish_time=max(0, t),
            sequence=tick.number & 0xFFFFFFFF,
        )

    def _channel(self, topic: str, type_: str) -> int:
        definition = journal.DEFINITION if type_ == journal.TYPE else self._views.definition(type_)
        schema = self._writer.register_schema(type_, "ros2msg", definition.encode())
        qos = {"offered_qos_profiles": _LATCHED_QOS} if topic in _LATCHED else {}
        return self._writer.register_channel(topic, "cdr", schema, qos)
