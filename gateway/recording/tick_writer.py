"""Writing ticks to a file, and handling of disk errors. Used by one thread.

Rules. A disk error is never raised but returned as a sentence. What cannot be written is counted in `lost`,
whole chunks at a time, and reported once; writing is tried again after a second, so a recording continues
when there is space again. The file is complete and readable at any moment; a gap shows in the ticks' numbers.
The digest chain of the first tick after a gap continues from the last one before it, and map, plan and
mountings are written again.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.errors import RecordingError
from gateway.recording import tick_codec
from gateway.recording.layout import FACTS, FORMAT, METADATA, ROBOT_FILE, digest
from gateway.recording.mcap_file import McapFile
from gateway.recording.ros_views import ViewMessage, Views
from protocols.messages import MILLISECOND, SECOND, Nanos

FLUSH_PERIOD: Nanos = 40 * MILLISECOND
"""Period of flushes, by the ticks' own time, if not requested sooner: what a kill may lose, and with the time
that ticks are queued less than 100 ms, on a busy machine too. Chunks of twice that pack 4 % better."""
RETRY_PERIOD: Nanos = SECOND
"""Time from a failed write to the next attempt."""

# Subscribers may come late: rosbag2 must offer them what was sent before (QoS as rosbag2 writes it).
LATCHED = frozenset({"/tf_static", "/map", "/plan", "/goal_pose"})
"""Topics of which what was sent last holds on."""
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


class TickWriter:
    """A recording being written. Methods that return text return a new problem or its end, or "".

    Raises RecordingError if the file cannot be created. `add` is the whole cost of recording a tick."""

    def __init__(
        self, path: Path, robot_text: str, facts: Mapping[str, str], views: Views, *, small: bool = False
    ) -> None:
        """Begin it; `small`: for what can be made again, with chunks of a second, which pack better."""
        self.path, self._small = path, small
        self.lost = 0
        """Ticks that were added and are not in the file."""
        self.pending = 0
        """Ticks not yet flushed,"""
        self._since: Nanos = 0
        """and the time of the first of them."""
        self._views = views
        views.prepare()
        self._written = self._chain = tick_codec.CHAIN_START
        """Digest chain after the last tick in the file, and after the last tick added."""
        self._retry_at: Nanos | None = None
        """When to try again after a failed write; None: no failure."""
        self._missing = 0
        """Ticks lost since the failure."""
        robot = robot_text.encode(errors="surrogateescape")
        try:
            self._file = McapFile(path, f"motor-gateway {facts.get('package motor-gateway', '')}")
        except OSError as error:
            raise _not_created(path, error) from error
        try:
            self._file.metadata(METADATA, {"format": FORMAT, "robot digest": digest(robot)})
            self._file.metadata(FACTS, dict(sorted(facts.items())))
            self._file.attachment(ROBOT_FILE, "application/toml", robot)
        except OSError as error:
            self._file.abandon()
            raise _not_created(path, error) from error

    @property
    def descriptor(self) -> int:
        """File descriptor of the open file."""
        return self._file.descriptor

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def add(self, tick: Tick, belief: Belief) -> str:
        """Add a tick and its views; flush if that is due, or after a warning or error."""
        return self.put(tick, lambda: self._views.messages(tick, belief))

    def put(self, tick: Tick, views: Callable[[], Iterable[ViewMessage]]) -> str:
        """Add a tick and what views a function returns, which is asked only if the tick can be written."""
        if self._file.broken or (self._retry_at is not None and tick.now < self._retry_at):
            return self._count_lost(1)
        try:
            data, self._chain = tick_codec.encode(tick, self._chain)
        except (ValueError, struct.error) as error:
            self.lost += 1
            return f"tick {tick.number} is not in the recording: {error}"
        self._since = self._since if self.pending else tick.now
        self.pending += 1
        self._put(tick, tick_codec.TOPIC, tick_codec.TYPE, tick.now, data)
        for topic, type_, t, data in views():
            self._put(tick, topic, type_, t, data)
        period = RETRY_PERIOD if self._small else FLUSH_PERIOD
        told = not self._small and any(n.level != "info" for n in tick.outputs.notes)
        return self.flush() if told or tick.now - self._since >= period else ""

    def flush(self) -> str:
        """Write all ticks so far to the file."""
        if not self.pending:
            return ""
        try:
            self._file.flush()
        except OSError as error:
            return self._write_failed(error)
        finally:
            self.pending = 0
        self._written = self._chain
        if self._retry_at is None:
            return ""
        missing, self._retry_at, self._missing = self._missing, None, 0
        return f"the recording {self.path} continues; {missing} ticks are missing in it"

    def finish(self) -> str:
        """Write the index and the end, and close."""
        problem = self.flush()
        if self._file.broken:
            self._file.abandon()
            return problem
        try:
            self._file.finish()
        except OSError as error:
            return f"{self.path} has no index: {error.strerror}; repair it with: gateway recover {self.path}"
        return problem

    def _count_lost(self, count: int) -> str:
        self.lost += count
        self._missing += count
        return ""

    def _write_failed(self, error: OSError) -> str:
        """Handle a chunk that was not written: its ticks are lost, the next one continues the file."""
        repeated = self._retry_at is not None
        self._count_lost(self.pending)
        self._chain = self._written
        self._views.reset()
        self._retry_at = self._since + RETRY_PERIOD
        if self._file.broken:
            return f"the recording ends here: {self.path}: {error.strerror}; the robot continues"
        if repeated:
            return ""
        return f"nothing can be recorded in {self.path}: {error.strerror}; the robot continues"

    def _put(self, tick: Tick, topic: str, type_: str, t: Nanos, data: bytes) -> None:
        file = self._file
        channel = file.channel(topic, type_)
        if channel is None:
            definition = tick_codec.DEFINITION if type_ == tick_codec.TYPE else self._views.definition(type_)
            channel = file.open_channel(topic, type_, definition, _LATCHED_QOS if topic in LATCHED else "")
        file.message(channel, tick.number & 0xFFFFFFFF, max(0, tick.now), max(0, t), data)


def _not_created(path: Path, error: OSError) -> RecordingError:
    exists = isinstance(error, FileExistsError)
    return RecordingError(f"{path}: {'' if exists else 'cannot be written: '}{error.strerror}")
