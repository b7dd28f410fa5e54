"""Our side of SDO with one device: one transfer at a time, repeated when no answer comes, given up at last.

Rules. Plain data; `say` gives what is to be sent, `hear` takes an answer, and a `Job` that ended comes back
as an `Outcome`. Only a RELEASE takes the place of what is under way, which is then forgotten (its late answer
is nobody's). Segments that another host broke off are begun anew at once. An answer that nobody waits for
changes nothing; it is counted where it repeats the last one, for two devices with one node id answer
everything twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from protocols.cia402 import sdo
from protocols.cia402.objects import Key
from protocols.cia402.transfer import Transfer
from protocols.messages import Nanos

TRIES = 3
"""So often a transfer is begun before it is given up."""
IDENTITY = 0x1018
DOUBLED = 3
"""So many transfers in a row that were each answered twice are two devices."""


class Purpose(IntEnum):
    """What a transfer is for; the lower, the more pressing."""

    RELEASE = 0
    """Disarming, quick stop, clearing: takes the place of what is under way."""
    SETUP = 1
    """What a device must be told before it can be armed."""
    SETPOINT = 2
    """Set-points that stand in no PDO."""
    ASKED = 3
    """A person's question."""
    POLL = 4
    """Feedback."""
    READING = 5
    """What must be known of a device."""
    ROLL_CALL = 6
    """Who is there: a serial number, again."""


@dataclass(frozen=True, slots=True)
class Job:
    """Read an object (`data` None), or write it."""

    purpose: Purpose
    key: Key
    data: bytes | None = None
    token: int = 0
    """Of the request that it is for."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a job ended."""

    job: Job
    value: bytes = b""
    """What was read."""
    abort: int | None = None
    """Why the device did not do it; `sdo.TIMEOUT` if it did not answer."""

    @property
    def silent(self) -> bool:
        """Whether no answer came at all."""
        return self.abort == sdo.TIMEOUT


@dataclass(slots=True)
class Client:
    """The transfers with one device."""

    timeout: Nanos
    job: Job | None = None
    transfer: Transfer | None = None
    next: sdo.Request | None = None
    """To be sent at once."""
    last: sdo.Answer | None = None
    """The answer that ended the last transfer, if it was begun once only: it should not come again."""
    sent_at: Nanos = 0
    tries: int = 0
    doubled: int = 0
    """Transfers in a row that were answered twice."""
    repeated: bool = False
    """The last transfer's answer came again."""

    def free(self, purpose: Purpose) -> bool:
        """Whether a job of this purpose may begin now."""
        return self.job is None or (purpose is Purpose.RELEASE and self.job.purpose is not Purpose.RELEASE)

    def begin(self, job: Job) -> None:
        """Begin a job, in the place of what is under way."""
        self.job, self.transfer = job, Transfer(*job.key, job.data)
        self.next, self.tries = self.transfer.first(), 1

    def drop(self) -> None:
        """Forget what is under way: the device may have restarted."""
        self.job = self.transfer = self.next = self.last = None
        self.repeated, self.doubled = False, 0

    def handle(self, answer: sdo.Answer) -> Outcome | None:
        """Take an answer; the outcome if it ends the job."""
        transfer, job = self.transfer, self.job
        if transfer is None or job is None:
            self._on_again(answer)
            return None
        if self._overtaken(transfer, answer):
            self.next, self.tries = transfer.first(), self.tries + 1
            return None
        before = transfer.value, transfer.toggle, transfer.sent, transfer.expecting
        request = transfer.handle(answer)
        if transfer.done:
            self.job = self.transfer = self.next = None
            if self.last is not None:
                self.doubled = self.doubled + 1 if self.repeated else 0
            self.last, self.repeated = answer if self.tries == 1 else None, False
            return Outcome(job, transfer.value, transfer.abort)
        if request is not None:
            self.next = request
        elif before == (transfer.value, transfer.toggle, transfer.sent, transfer.expecting):
            self._on_again(answer)
        return None

    def _overtaken(self, transfer: Transfer, answer: sdo.Answer) -> bool:
        """Whether another host's request took the place of our segments (a device serves one at a time), and
        they can be asked for anew. The refusal of a segment names the object of that request."""
        if transfer.expecting is None or not isinstance(answer, sdo.Abort) or self.tries >= TRIES:
            return False
        return (answer.index, answer.sub) != (transfer.index, transfer.sub)

    def _on_again(self, answer: sdo.Answer) -> None:
        """An answer that nobody waits for: late, or the last one again, or a second device's."""
        last = self.last
        if last is None or not _same_question(last, answer):
            return
        self.repeated = True
        if isinstance(last, sdo.Uploaded) and last.index == IDENTITY and last != answer:
            self.doubled = DOUBLED  # one device does not have two serial numbers

    def say(self, now: Nanos) -> tuple[sdo.Request | None, Outcome | None]:
        """What is to be sent now, and the outcome of a job that is given up."""
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
        """When `say` next has something to do; None if nothing is under way."""
        if self.next is not None:
            return 0
        return None if self.job is None else self.sent_at + self.timeout


def _same_question(one: sdo.Answer, other: sdo.Answer) -> bool:
    """Whether two answers are to the same question."""
    if isinstance(one, _PIECES) or isinstance(other, _PIECES):
        return one == other
    return (one.index, one.sub) == (other.index, other.sub)


_PIECES = (sdo.UploadedSegment, sdo.SegmentDownloaded)
