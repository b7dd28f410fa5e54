"""What drivers of most languages answer in the same way: commands that must not reach a wire, and requests.

Rules. No language, wire or clock in here. A driver need not use it: the contract asks for what is answered,
not for how.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Generic, TypeVar

from protocols.messages import Command, Done, Nanos, Refused, Request
from protocols.plugin import Range

SMALLEST = 2.0**-126
"""The smallest normal float32. What lies below it is as good as zero."""


def out_of_range(command: Command, ranges: Mapping[str, Range]) -> str:
    """Why the numbers of a command must not reach a wire; "" if they may.

    `ranges` as in `Spec`. A number that has no range there must be zero."""
    kind = type(command).__name__
    for name in command.__slots__:
        value = getattr(command, name)
        if isinstance(value, str):
            continue
        if not isfinite(value):
            return f"{name} is {value}"
        allowed = ranges.get(f"{kind}.{name}")
        if allowed is None:
            if abs(value) >= SMALLEST:
                return f"the device has no {name} for {kind}"
        elif not allowed.low <= value <= allowed.high:
            return f"{name} {value:.6g} lies outside {allowed.low:.6g} … {allowed.high:.6g}"
    return ""


class RejectionFilter:
    """Commands come anew every tick: one that is refused for the same reason as before is not told again.

    A request comes once, and is told whenever it is refused."""

    def __init__(self) -> None:
        self._reported: dict[str, str] = {}
        """By motor, the reason for which its last command was refused."""

    def handle(self, now: Nanos, word: Command | Request, reason: str) -> list[Refused]:
        """What is to be told of a word; `reason`: why it is refused, "" if it is not."""
        reported = ""
        if isinstance(word, Command):
            reported = self._reported.pop(word.motor, "")
            self._reported |= {word.motor: reason} if reason else {}
        return [] if reason == reported or not reason else [refusal(now, word, reason)]


@dataclass(slots=True)
class PendingRequest:
    """A request that waits for a device. Languages add what they wait for."""

    request: Request
    name: str
    """Of the motor, or of the bus if all on it are asked."""
    began: Nanos
    deadline: Nanos
    next: Nanos
    """When there is something to do about it."""

    def done(self, t: Nanos, detail: str = "") -> Done:
        """It was carried out."""
        return Done(t, type(self.request).__name__, self.name, detail)

    def refuse(self, t: Nanos, reason: str) -> Refused:
        """It was not."""
        return Refused(t, type(self.request).__name__, self.name, reason)


Kind = TypeVar("Kind", bound=PendingRequest)


class RequestQueue(Generic[Kind]):
    """The requests of one driver that are under way, in the order in which they were begun."""

    MOST = 32

    def __init__(self) -> None:
        self._all: list[Kind] = []

    def __iter__(self) -> Iterator[Kind]:
        """Those that are under way now; they may end meanwhile."""
        return iter(tuple(self._all))

    def full(self) -> str:
        """Why no other can be begun; "" if one can."""
        return "too many requests are under way" if len(self._all) >= self.MOST else ""

    def add(self, begun: Kind | Refused) -> list[Refused]:
        """One more, if it was begun at all; else what is to be told."""
        if isinstance(begun, Refused):
            return [begun]
        self._all.append(begun)
        return []

    def end(self, ended: Kind) -> None:
        """It has its answer."""
        self._all = [each for each in self._all if each is not ended]

    def late(self, now: Nanos) -> list[Kind]:
        """Those whose deadline has passed: they wait no longer."""
        late = [each for each in self._all if now >= each.deadline]
        self._all = [each for each in self._all if now < each.deadline]
        return late

    def drop(self, t: Nanos, reason: str) -> list[Refused]:
        """None can be answered any more."""
        dropped, self._all = self._all, []
        return [each.refuse(t, reason) for each in dropped]

    def due(self) -> list[Nanos]:
        """When there is something to do about each of them."""
        return [min(each.next, each.deadline) for each in self._all]


def subject(word: Command | Request) -> str:
    """The motor that a word is about, or the bus."""
    name: str = getattr(word, "motor", "") or getattr(word, "bus", "")
    return name


def refusal(t: Nanos, word: Command | Request, reason: str) -> Refused:
    """A word that is not even begun."""
    return Refused(t, type(word).__name__, subject(word), reason)
