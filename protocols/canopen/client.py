"""The host's SDO client for one device: jobs by purpose, one transfer at a time, repeated without a response.

Rules. Plain data. A transfer that was begun ends before another begins, an urgent one too, which is then the
next. Else polls take turns with everything else, so that neither keeps a slow device from the other.

A response names an object, and no request: a copy, or one that is late, looks like the response to the next
request for that object. So an object is not transferred again (but urgently) while more responses about it
may be under way: QUIET after a response that nothing asked for, a timeout after a request that was repeated.
Nor is anything else until a device has served what was repeated: else it would never catch up.

Source: CiA 301 "SDO protocols"; package canopen 2.4.1 `sdo/client.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

from protocols.canopen import sdo
from protocols.canopen.objects import Key
from protocols.messages import MILLISECOND, Nanos

TRIES = 3
"""Attempts before a transfer is given up."""
QUIET = 20 * MILLISECOND
"""Time in which a copy of a response comes."""
SHARE = 2
"""Other jobs between two polls."""
DOUBLED = 5
"""This many transfers in a row that were each answered twice prove two devices."""
NEVER: Nanos = 1 << 62


class Purpose(IntEnum):
    """What a transfer is for; the first goes first."""

    URGENT = 0
    """Disarming, quick stop, fault reset."""
    SETUP = 1
    """What is written, and read back, before a device is armed."""
    SETPOINT = 2
    """Set-points that are in no PDO."""
    REQUEST = 3
    """A request from outside."""
    STARTUP = 4
    """What is read of a device once."""
    CHECK = 5
    """What is read again from time to time, as the serial number."""
    POLL = 6
    """Feedback."""


_SEQUENCES = (Purpose.URGENT, Purpose.SETUP, Purpose.REQUEST, Purpose.STARTUP)
"""Purposes of transfers of which one waits for the other."""


@dataclass(frozen=True, slots=True)
class Job:
    """An upload of an object (`data` None), or a download."""

    purpose: Purpose
    key: Key
    data: bytes | None = None
    patience: int = 1
    """Timeouts for which a response is waited for."""
    token: int = 0
    """Of the request that it is for."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """The end of a job."""

    job: Job
    value: bytes = b""
    """What was read."""
    abort: int | None = None
    """The abort code; `sdo.TIMEOUT` without a response."""


@dataclass(slots=True)
class SdoClient:
    """The transfers with one device."""

    timeout: Nanos
    waiting: dict[Purpose, list[Job]] = field(default_factory=dict)
    job: Job | None = None
    """The present one."""
    doubled: int = 0
    """Transfers in a row that were answered twice."""
    _next: sdo.Request | None = None
    """To be sent."""
    _sent_at: Nanos = 0
    _tries: int = 0
    _others: int = 0
    """Jobs since the last poll."""
    _urgent: bool = False
    """The last job was urgent."""
    _suspects: dict[Key, tuple[Nanos, Nanos]] = field(default_factory=dict)
    """Objects about which a response may still come: since when, and until when."""
    _owed: int = 0
    """Responses to repeated requests that may still come, before the device serves another request."""
    _owed_until: Nanos = 0
    _last: sdo.Response | None = None
    """What ended the last transfer, if that was begun once only: it should not be repeated."""
    _ended_at: Nanos = 0
    _repeated: bool = False
    """It was."""
    # a segmented transfer
    _segments: bool = False
    _toggle: bool = False
    _value: bytes = b""
    _size: int | None = None
    _sent: int = 0

    # -- jobs -----------------------------------------------------------------------------------------

    def put(self, *jobs: Job) -> None:
        """Add jobs, each behind the others of its purpose."""
        for job in jobs:
            self.waiting.setdefault(job.purpose, []).append(job)

    def has(self, purpose: Purpose) -> bool:
        """True if a job of this purpose waits, or is under way."""
        return bool(self.waiting.get(purpose)) or (self.job is not None and self.job.purpose is purpose)

    def drop(self, *purposes: Purpose) -> None:
        """Forget the jobs of these purposes that are not begun."""
        for purpose in purposes:
            self.waiting.pop(purpose, None)

    def forget(self, t: Nanos) -> None:
        """Forget all jobs: the device may have restarted."""
        if self.job is not None:
            self._suspect(t, self.job.key, QUIET)
        self.waiting.clear()
        self.job = self._next = self._last = None
        self.pardon()

    def pardon(self) -> None:
        """Forget which responses came twice."""
        self._repeated, self.doubled = False, 0

    # -- responses ------------------------------------------------------------------------------------

    def handle(self, t: Nanos, response: sdo.Response) -> Outcome | None:
        """Handle a response; return the outcome if it ends the job."""
        job = self.job
        if job is None or self._next is not None:  # nothing is asked
            self._on_unexpected(t, response)
            return None
        reading = job.data is None
        match response:
            case sdo.Abort(index, sub, code) if (index, sub) == job.key:
                return self._end(t, response, code)
            case sdo.Abort() if self._segments and self._tries < TRIES:
                self._tries += 1  # another host's request: a device serves one transfer at a time
                self.resend()
            case sdo.Uploaded(index, sub, data) if reading and (index, sub) == job.key and not self._segments:
                self._value = data
                return self._end(t, response)
            case sdo.UploadStart(index, sub, size) if reading and (index, sub) == job.key:
                if not self._segments:
                    self._segments, self._size, self._next = True, size, sdo.UploadSegment(False)
            case sdo.UploadedSegment(toggle, data, last) if reading and self._segments:
                return self._on_segment(t, response, data, last=last) if toggle == self._toggle else None
            case sdo.Downloaded(index, sub) if not reading and (index, sub) == job.key:
                self._segments = True
                return self._next_segment(t, response, job.data or b"")
            case sdo.SegmentDownloaded(toggle) if not reading and self._segments:
                if toggle == self._toggle:
                    self._toggle = not toggle
                    return self._next_segment(t, response, job.data or b"")
            case _:
                self._on_unexpected(t, response)
        return None

    def _on_segment(self, t: Nanos, response: sdo.Response, data: bytes, *, last: bool) -> Outcome | None:
        self._value, self._toggle = self._value + data, not self._toggle
        if last:
            wrong = self._size is not None and self._size != len(self._value)
            return self._end(t, response, sdo.LENGTH_MISMATCH if wrong else None)
        self._next = sdo.UploadSegment(self._toggle)
        return None

    def _next_segment(self, t: Nanos, response: sdo.Response, data: bytes) -> Outcome | None:
        if self._sent and self._sent >= len(data):
            return self._end(t, response)
        segment = data[self._sent : self._sent + sdo.SEGMENT]
        self._sent += max(len(segment), 1)
        self._next = sdo.DownloadSegment(self._toggle, segment, self._sent >= len(data))
        return None

    def _end(self, t: Nanos, response: sdo.Response | None, abort: int | None = None) -> Outcome | None:
        job, self.job = self.job, None
        if job is None:
            return None
        if self._tries > 1:
            self._suspect(t, job.key, self.timeout)
            self._owed, self._owed_until = self._tries - (response is not None), t + self.timeout
        if self._last is not None:
            self.doubled = self.doubled + 1 if self._repeated else 0
        self._last, self._repeated, self._ended_at = response if self._tries == 1 else None, False, t
        return Outcome(job, self._value if abort is None else b"", abort)

    def _on_unexpected(self, t: Nanos, response: sdo.Response) -> None:
        """Note a response that is late, or repeats the last one, or is a second device's."""
        key, self._owed = _key_of(response), max(0, self._owed - 1)
        if key is not None:
            self._suspect(t, key, QUIET)
        self._repeated = self._repeated or (t <= self._ended_at + QUIET and self.repeats(response))

    def _suspect(self, t: Nanos, key: Key, time: Nanos) -> None:
        """Let an object rest for this time, though not for longer than a timeout: others may use it, too."""
        since, until = self._suspects.get(key, (t, t))
        self._suspects[key] = since, min(max(until, t + time), since + self.timeout)

    def repeats(self, response: sdo.Response) -> bool:
        """True if a response is to the request that was answered last."""
        if self._last is None:
            return False
        key = _key_of(response)
        return self._last == response if key is None else key == _key_of(self._last)

    # -- requests -------------------------------------------------------------------------------------

    def poll(self, now: Nanos) -> tuple[sdo.Request | None, Outcome | None]:
        """Return the request to be sent now, and the outcome of a job that is given up."""
        if self.job is None and self.waiting:
            self._begin(now)
        job = self.job
        if job is not None and self._next is None and now >= self._sent_at + self.timeout * job.patience:
            if self._tries >= TRIES:
                return None, self._end(now, None, sdo.TIMEOUT)
            self._tries += 1
            self.resend()
        request, self._next = self._next, None
        self._sent_at = self._sent_at if request is None else now
        return request, None

    def _begin(self, now: Nanos) -> None:
        """Begin the job whose turn it is."""
        self._suspects = {key: times for key, times in self._suspects.items() if times[1] > now}
        first = {purpose: jobs[0] for purpose, jobs in sorted(self.waiting.items()) if jobs}
        if self._owed and now < self._owed_until and Purpose.URGENT not in first:
            return
        ready = {purpose: job for purpose, job in first.items() if job.key not in self._suspects}
        urgent = None if self._urgent and Purpose.POLL in ready else first.get(Purpose.URGENT)
        poll = ready.get(Purpose.POLL) if self._urgent or self._others >= SHARE else None
        job = urgent or poll or next(iter(ready.values()), None)
        if job is not None:
            self.waiting[job.purpose] = self.waiting[job.purpose][1:]
            self.job, self._tries = job, 1
            self._others = 0 if job.purpose is Purpose.POLL else self._others + 1
            self._urgent = job.purpose is Purpose.URGENT
            self.resend()

    def resend(self) -> None:
        """Begin the present transfer, or begin it anew: a request may have been lost on our side."""
        if self.job is None:
            return
        (index, sub), data = self.job.key, self.job.data
        self._segments = self._toggle = False
        self._value, self._size, self._sent = b"", None, 0
        if data is None:
            self._next = sdo.Upload(index, sub)
        elif 1 <= len(data) <= sdo.EXPEDITED:
            self._next, self._sent = sdo.Download(index, sub, data), len(data)
        else:
            self._next = sdo.DownloadStart(index, sub, len(data))

    def awaits(self) -> bool:
        """True while a response is awaited on which others wait: in a set-up or a request, not in polling."""
        return self.job is not None and self._next is None and self.job.purpose in _SEQUENCES

    def due(self) -> Nanos:
        """Return when `poll` next has something to do."""
        if self.job is not None:
            return 0 if self._next is not None else self._sent_at + self.timeout * self.job.patience
        first = [jobs[0] for jobs in self.waiting.values() if jobs]
        if not first:
            return NEVER
        until = min(self._suspects.get(job.key, (0, 0))[1] * (job.purpose > 0) for job in first)
        return max(until, self._owed_until) if self._owed and not self.waiting.get(Purpose.URGENT) else until


def _key_of(response: sdo.Response) -> Key | None:
    """Return the object that a response names; segments name none."""
    return (response.index, response.sub) if isinstance(response, sdo.Named) else None
