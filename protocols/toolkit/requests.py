"""What most drivers need for commands and requests: range checks, refusals, and pending requests.

Rules. Nothing here knows a protocol or a clock. A driver need not use it: conformance tests the
answers, not how they are made.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import isfinite
from typing import Any, Generic, TypeAlias

from protocols.frames import Frame
from protocols.messages import (
    MILLISECOND,
    Command,
    Done,
    Nanos,
    Refused,
    Request,
    Scan,
    Torque,
    Velocity,
)
from protocols.plugin import Range
from protocols.toolkit.host import Host, Own

SMALLEST = 2.0**-126
"""The smallest normal float32. Anything below it counts as zero."""
ANSWER = 200 * MILLISECOND
"""Time within which a frame may be an answer."""
SLICE, SLICE_PERIOD = 8, 10 * MILLISECOND
"""Questions of a scan that are sent at once (a usual queue holds ten), and how often."""


Bounds: TypeAlias = tuple[tuple[str, float, float], ...]
"""Name, lowest and highest value of each number of a command."""


def bounds_of(kind: type[Command], ranges: Mapping[str, Range]) -> Bounds:
    """Return the bounds of a type of command; `ranges` as in `Spec`. What has no range must be zero."""
    numbers = [(f.name, ranges.get(f"{kind.__name__}.{f.name}")) for f in fields(kind) if f.name != "motor"]
    return tuple((name, r.low if r else 0.0, r.high if r else 0.0) for name, r in numbers)


def outside(command: Command, bounds: Bounds) -> str:
    """Return which number of a command must not be sent, "" if all may."""
    for name, low, high in bounds:
        value = getattr(command, name)
        if low <= value <= high or (low == high == 0.0 and abs(value) < SMALLEST):
            continue
        if not isfinite(value):
            return f"{name} is {value}"
        if low == high:
            return f"the device has no {name} for {type(command).__name__}"
        return f"{name} {value:.6g} lies outside {low:.6g} … {high:.6g}"
    return ""


def still(command: Command) -> Command:
    """Return what arms a device for a command by velocity or torque, and does not move it."""
    return Torque(command.motor, 0.0) if isinstance(command, Torque) else Velocity(command.motor, 0.0)


class RejectionFilter:
    """Reports a refused command once: commands are repeated every tick, and only a new reason is reported.

    A request is made once, and reported whenever it is refused."""

    def __init__(self) -> None:
        self.reported: dict[str, str] = {}
        """By motor, the reason for which its last command was refused."""

    def filter(self, now: Nanos, message: Command | Request, reason: str) -> list[Refused]:
        """Return what to report of a message; `reason`: why it is refused, "" if it is not."""
        reported = ""
        if isinstance(message, Command):
            reported = self.reported.pop(message.motor, "")
            self.reported |= {message.motor: reason} if reason else {}
        return [] if reason == reported or not reason else [refusal(now, message, reason)]


@dataclass(slots=True)
class Pending(Generic[Own]):
    """A request that waits for a device."""

    request: Request
    name: str
    """The motor, or the bus if the request is for all devices on it."""
    began: Nanos
    deadline: Nanos
    next: Nanos
    """When its frames are sent next."""
    host: Host[Own] | None
    """None: it is for all devices on the bus."""
    frames: tuple[Frame, ...] = ()
    period: Nanos = 100 * MILLISECOND
    """Period in which the frames are sent again."""
    notes: dict[str, Any] = field(default_factory=dict)
    """What the protocol keeps about it."""
    sent: int = 0
    at_once: int = 0
    """How many of the frames are sent at once, of a scan; 0: all, each time."""
    found: dict[tuple[int, int | None], str] = field(default_factory=dict)
    """Devices found by a scan: their details, by address and serial number."""

    def send(self, now: Nanos, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Record that these frames are sent now; return them."""
        self.next = now + self.period
        self.sent += len(frames)
        return frames

    def expire(self, now: Nanos) -> None:
        """Have it end at the next look: it cannot be carried out any more."""
        self.deadline = now

    def restarted(self, t: Nanos, silence: Nanos) -> bool:
        """Record that its device has sent. True if it had been silent for so long before: it restarted."""
        last = self.notes.get("received", self.began)
        self.notes["received"] = t
        return bool(t - last >= silence)

    def slice(self) -> Sequence[Frame]:
        """Return the next questions of a scan."""
        return self.frames[self.sent : self.sent + (self.at_once or SLICE)]

    def done(self, t: Nanos, detail: str = "") -> Done:
        """Return the answer that it was carried out."""
        return Done(t, type(self.request).__name__, self.name, detail)

    def refuse(self, t: Nanos, reason: str) -> Refused:
        """Return the answer that it was not carried out."""
        return Refused(t, type(self.request).__name__, self.name, reason)


def scan(
    now: Nanos,
    request: Scan,
    questions: Iterable[Frame],
    times: int = 2,
    at_once: int = SLICE,
    period: Nanos = SLICE_PERIOD,
    last: Nanos = ANSWER,
) -> Pending[Own]:
    """Return a scan that asks all this, twice since a question may be lost, in slices; `last`: the time for
    the last answer."""
    frames = times * tuple(questions)
    end = now + period * (1 + len(frames) // at_once) + last
    return Pending(request, request.bus, now, end, now, None, frames, period, at_once=at_once)


class RequestQueue(Generic[Own]):
    """The pending requests of one driver, in the order in which they were begun."""

    CAPACITY = 32

    def __init__(self) -> None:
        self.waiting: list[Pending[Own]] = []
        """Those that are pending now, in the order in which they were begun. Never changed in place."""

    def __iter__(self) -> Iterator[Pending[Own]]:
        """Iterate over those that are pending now; they may end meanwhile."""
        return iter(self.waiting)

    def __len__(self) -> int:
        """Return how many are pending."""
        return len(self.waiting)

    def full(self) -> str:
        """Return why no other request can be begun, "" if one can."""
        return "too many requests are under way" if len(self.waiting) >= self.CAPACITY else ""

    def add(self, begun: Pending[Own] | Refused | Done) -> list[Refused | Done]:
        """Add a request that was begun; else return its answer, to be reported."""
        if isinstance(begun, Refused | Done):
            return [begun]
        self.waiting = [*self.waiting, begun]
        return []

    def end(self, ended: Pending[Own]) -> None:
        """Remove a request that has been answered."""
        self.waiting = [each for each in self.waiting if each is not ended]

    def expired(self, now: Nanos) -> list[Pending[Own]]:
        """Remove and return the requests whose deadline has passed."""
        expired = [each for each in self.waiting if now >= each.deadline]
        self.waiting = [each for each in self.waiting if now < each.deadline]
        return expired

    def refuse_all(self, t: Nanos, reason: str) -> list[Refused]:
        """Remove and refuse all requests."""
        removed, self.waiting = self.waiting, []
        return [each.refuse(t, reason) for each in removed]

    def due(self) -> list[Nanos]:
        """Return when there is something to do about each request."""
        return [min(each.next, each.deadline) for each in self.waiting]


def subject(message: Command | Request) -> str:
    """Return the motor that a message is for, or the bus; "" if neither."""
    name: str = getattr(message, "motor", "") or getattr(message, "bus", "")
    return name


def refusal(t: Nanos, message: Command | Request, reason: str) -> Refused:
    """Return the answer to a message that is not even begun."""
    return Refused(t, type(message).__name__, subject(message), reason)
