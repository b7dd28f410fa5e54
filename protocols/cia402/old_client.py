"""The host's SDO client for one device: one transfer at a time, repeated without a response, given up at
last.

Rules. Plain data; `poll` returns what is to be sent, `handle` takes a response, and a `Job` that ended is
returned as an `Outcome`. Only an URGENT job replaces the present one, which is then forgotten (its late
response is ignored). Segments that another host interrupted are begun anew at once. An unexpected response
changes nothing; it is counted if it repeats the last one, for two devices with one node id respond to
everything twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from protocols.canopen import sdo
from protocols.canopen.objects import SERIAL_NUMBER, Key
from protocols.cia402.old_transfer import Transfer
from protocols.messages import Nanos

TRIES = 3
"""Attempts before a transfer is given up."""
DUPLICATES = 3
"""This many transfers in a row that were each answered twice prove two devices."""


class Purpose(IntEnum):
    """What a transfer is for."""

    URGENT = 0
    """Disarming, quick stop, fault reset: replaces the present transfer."""
    SETUP = 1
    """Configuration before a device is armed."""
    SETPOINT = 2
    """Set-points that are in no PDO."""
    REQUEST = 3
    """A request from outside: a parameter, the homing method."""
    POLL = 4
    """Feedback."""
    STARTUP = 5
    """Units, identity and PDOs of a device."""
    IDENTITY_CHECK = 6
    """The serial number, periodically."""


@dataclass(frozen=True, slots=True)
class Job:
    """An upload of an object (`data` None), or a download."""

    purpose: Purpose
    key: Key
    data: bytes | None = None
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

    @property
    def timed_out(self) -> bool:
        """True if there was no response at all."""
        return self.abort == sdo.TIMEOUT


@dataclass(slots=True)
class SdoClient:
    """The transfers with one device."""

    timeout: Nanos
    job: Job | None = None
    transfer: Transfer | None = None
    next: sdo.Request | None = None
    """To be sent at once."""
    last: sdo.Response | None = None
    """The response that ended the last transfer, if that was begun once only: it should not be repeated."""
    sent_at: Nanos = 0
    tries: int = 0
    duplicates: int = 0
    """Transfers in a row that were answered twice."""
    repeated: bool = False
    """The last transfer's response was repeated."""

    def free(self, purpose: Purpose) -> bool:
        """True if a job of this purpose may begin now."""
        return self.job is None or (purpose is Purpose.URGENT and self.job.purpose is not Purpose.URGENT)

    def begin(self, job: Job) -> None:
        """Begin a job, in place of the present one."""
        self.job, self.transfer = job, Transfer(*job.key, job.data)
        self.next, self.tries = self.transfer.first(), 1

    def drop(self) -> None:
        """Forget the present job: the device may have restarted."""
        self.job = self.transfer = self.next = self.last = None
        self.repeated, self.duplicates = False, 0

    def handle(self, response: sdo.Response) -> Outcome | None:
        """Handle a response; return the outcome if it ends the job."""
        transfer, job = self.transfer, self.job
        if transfer is None or job is None:
            self._on_unexpected(response)
            return None
        if self._interrupted(transfer, response):
            self.next, self.tries = transfer.first(), self.tries + 1
            return None
        before = transfer.value, transfer.toggle, transfer.sent, transfer.expecting
        request = transfer.handle(response)
        if transfer.done:
            self.job = self.transfer = self.next = None
            if self.last is not None:
                self.duplicates = self.duplicates + 1 if self.repeated else 0
            self.last, self.repeated = response if self.tries == 1 else None, False
            return Outcome(job, transfer.value, transfer.abort)
        if request is not None:
            self.next = request
        elif before == (transfer.value, transfer.toggle, transfer.sent, transfer.expecting):
            self._on_unexpected(response)
        return None

    def _interrupted(self, transfer: Transfer, response: sdo.Response) -> bool:
        """True if another host's request interrupted our segments (a device serves one transfer at a time),
        and they can be requested anew. The abort of a segment names the object of that other request."""
        if transfer.expecting is None or not isinstance(response, sdo.Abort) or self.tries >= TRIES:
            return False
        return (response.index, response.sub) != (transfer.index, transfer.sub)

    def _on_unexpected(self, response: sdo.Response) -> None:
        """Note a response that is late, or repeats the last one, or is a second device's."""
        last = self.last
        if last is None or not _same_request(last, response):
            return
        self.repeated = True
        if isinstance(last, sdo.Uploaded) and last.index == SERIAL_NUMBER[0] and last != response:
            self.duplicates = DUPLICATES  # one device does not have two serial numbers

    def poll(self, now: Nanos) -> tuple[sdo.Request | None, Outcome | None]:
        """Return the request to be sent now, and the outcome of a job that is given up."""
        if self.next is not None:
            request, self.next, self.sent_at = self.next, None, now
            return request, None
        if self.job is None or self.transfer is None or now < self.sent_at + self.timeout:
            return None, None
        if self.tries < TRIES:
            self.tries, self.sent_at = self.tries + 1, now
            return self.transfer.first(), None
        given_up, self.job, self.transfer = self.job, None, None
        return None, Outcome(given_up, abort=sdo.TIMEOUT)

    def due(self) -> Nanos | None:
        """Return when `poll` next has something to do; None without a job."""
        if self.next is not None:
            return 0
        return None if self.job is None else self.sent_at + self.timeout


def _same_request(one: sdo.Response, other: sdo.Response) -> bool:
    """True if two responses are to the same request."""
    if isinstance(one, _SEGMENTS) or isinstance(other, _SEGMENTS):
        return one == other
    return (one.index, one.sub) == (other.index, other.sub)


_SEGMENTS = (sdo.UploadedSegment, sdo.SegmentDownloaded)
