"""Ticks into a file, and what happens when the disk does not take them. One thread's own.

Rules. No error of a disk gets out of here but as a sentence. What cannot be written is counted in `lost`,
whole chunks at a time, and told once; a second later it is tried again, so a recording goes on when there is
space again. What lies in the file is whole and readable at any moment; a gap shows in the ticks' numbers.
The first tick after a gap is sealed to the last one before it, and shows map, plan and mountings anew.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

from brain.belief import Belief
from gateway.core.tick import Tick
from gateway.errors import RecordingError
from gateway.recording import tick_codec
from gateway.recording.layout import FACTS, FORMAT, METADATA, ROBOT_FILE, digest
from gateway.recording.mcap_file import McapFile
from gateway.recording.ros_views import Views
from protocols.messages import MILLISECOND, SECOND, Nanos

FLUSH_PERIOD: Nanos = 50 * MILLISECOND
"""Between two flushes, by the ticks' own time, if nobody asks for them sooner."""
RETRY_PERIOD: Nanos = SECOND
"""After a write that failed."""

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


class TickWriter:
    """A recording that is being written. Each method returns what is to be told, or "".

    Raises RecordingError if the file cannot be begun. `add` is the whole cost of recording a tick."""

    def __init__(self, path: Path, robot_text: str, facts: Mapping[str, str], views: Views) -> None:
        self.path = path
        self.lost = 0
        """Ticks that were handed over and are not in the file."""
        self.pending = 0
        """Ticks not yet flushed,"""
        self._since: Nanos = 0
        """the first of them from then."""
        self._views = views
        views.prepare()
        self._written = self._seals = tick_codec.UNPROTECTED
        """The seals of the last tick in the file, and of the last tick of all."""
        self._again: Nanos | None = None
        """When to try again after a write that failed; None: all is well."""
        self._missing = 0
        """Ticks lost since then."""
        robot = robot_text.encode(errors="surrogateescape")
        try:
            self._file = McapFile(path, f"motor-gateway {facts.get('package motor-gateway', '')}")
        except OSError as error:
            raise _not_begun(path, error) from error
        try:
            self._file.metadata(METADATA, {"format": FORMAT, "robot digest": digest(robot)})
            self._file.metadata(FACTS, dict(sorted(facts.items())))
            self._file.attachment(ROBOT_FILE, "application/toml", robot)
        except OSError as error:
            self._file.abandon()
            raise _not_begun(path, error) from error

    @property
    def descriptor(self) -> int:
        """Of the open file."""
        return self._file.descriptor

    def add(self, tick: Tick, belief: Belief) -> str:
        """One tick and its views; flushes when it is time to, or when a note is more than news."""
        if self._file.broken or (self._again is not None and tick.now < self._again):
            return self._lose(1)
        try:
            data, self._seals = tick_codec.encode(tick, self._seals)
        except (ValueError, struct.error) as error:
            self.lost += 1
            return f"tick {tick.number} is not in the recording: {error}"
        self._since = self._since if self.pending else tick.now
        self.pending += 1
        self._put(tick, tick_codec.TOPIC, tick_codec.TYPE, tick.now, data)
        for topic, type_, t, data in self._views.messages(tick, belief):
            self._put(tick, topic, type_, t, data)
        if tick.now - self._since >= FLUSH_PERIOD or any(n.level != "info" for n in tick.outputs.notes):
            return self.flush()
        return ""

    def flush(self) -> str:
        """Everything so far, out of this process."""
        if not self.pending:
            return ""
        pending, self.pending = self.pending, 0
        try:
            self._file.flush()
        except OSError as error:
            return self._fail(error, pending)
        self._written = self._seals
        if self._again is None:
            return ""
        missing, self._again, self._missing = self._missing, None, 0
        return f"the recording {self.path} goes on; {missing} ticks are missing in it"

    def finish(self) -> str:
        """The index, and the end."""
        reported = self.flush()
        if self._file.broken:
            self._file.abandon()
            return reported
        try:
            self._file.finish()
        except OSError as error:
            return f"{self.path} has no index: {error.strerror}; mend it with: gateway recover {self.path}"
        return reported

    def _lose(self, count: int) -> str:
        self.lost += count
        self._missing += count
        return ""

    def _fail(self, error: OSError, pending: int) -> str:
        """A chunk was not written: what was in it is lost, and what comes follows what is in the file."""
        reported = self._again is not None
        self._lose(pending)
        self._seals = self._written
        self._views.show_again()
        self._again = self._since + RETRY_PERIOD
        if self._file.broken:
            return f"the recording ends here: {self.path}: {error.strerror}; the robot drives on"
        if reported:
            return ""
        return f"nothing can be recorded in {self.path}: {error.strerror}; the robot drives on"

    def _put(self, tick: Tick, topic: str, type_: str, t: Nanos, data: bytes) -> None:
        file = self._file
        channel = file.channel(topic, type_)
        if channel is None:
            definition = tick_codec.DEFINITION if type_ == tick_codec.TYPE else self._views.definition(type_)
            channel = file.open_channel(topic, type_, definition, _LATCHED_QOS if topic in _LATCHED else "")
        file.message(channel, tick.number & 0xFFFFFFFF, max(0, tick.now), max(0, t), data)


def _not_begun(path: Path, error: OSError) -> RecordingError:
    return RecordingError(f"{path}: cannot be written: {error.strerror}")
