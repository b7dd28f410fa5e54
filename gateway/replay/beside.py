"""Two recordings beside each other: the first tick in which they differ, in words.

Rules. Ticks are paired by their place, times are counted from the first tick of each. Two runs on real wires
never have the same time stamps: that is noted, and no reason to end, as long as the same frames arrive, the
same is asked, decoded, sent and noted in the same ticks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

from gateway.core.message_text import escaped
from gateway.core.tick import Tick
from gateway.errors import RecordingError
from gateway.recording import Recording
from gateway.recording.tick_codec import packet_text
from gateway.replay import diff
from gateway.replay.compare import Difference, Kind
from protocols.messages import Message, Nanos, seconds

_SIDES = ("in the first", "in the second")


class Beside:
    """Compares two recordings, in slices, up to the first tick in which they differ.

    Args:
        one: what `read_recording` returned.
        two: another.
    """

    def __init__(self, one: Recording, two: Recording) -> None:
        self.settings = diff.settings(one.robot_text, two.robot_text, _SIDES)
        """The keys in which the two robot files differ, with both values."""
        self.times: Difference | None = None
        """The first time stamp that differs, if one did before the end."""
        self.found: tuple[Difference, ...] = ()
        """What differs in the first tick in which anything does, one of each kind; () so far."""
        self.ticks = 0
        """Ticks that are the same."""
        self._pairs = zip_longest(_ticks(one), _ticks(two))
        self._starts: tuple[Nanos, Nanos] | None = None

    def advance(self, budget_ticks: int) -> bool:
        """Compare so many ticks more; return True if that was all, or if they differ."""
        for _ in range(budget_ticks):
            if self.found:
                break
            pair = next(self._pairs, None)
            if pair is None:
                return True
            self._compare(*pair)
        return bool(self.found)

    @property
    def first(self) -> Difference | None:
        """What differs first in anything but time stamps; without that, the first time stamp that differs."""
        return self.found[0] if self.found else self.times

    def _compare(self, one: Tick | str | None, two: Tick | str | None) -> None:
        if not isinstance(one, Tick) or not isinstance(two, Tick):
            given = one if isinstance(one, Tick) else two
            since = given.now - self._start(given, one is given) if isinstance(given, Tick) else 0
            ends = (
                f"tick {side.number}" if isinstance(side, Tick) else side or "its end" for side in (one, two)
            )
            self.found = (Difference("recording", self.ticks, since, _both("what follows", *ends)),)
            return
        self._starts = self._starts or (one.now, two.now)
        since = one.now - self._starts[0]
        ours, theirs = (_plain(tick, start) for tick, start in zip((one, two), self._starts, strict=True))
        differ = [
            Difference(kind, self.ticks, since, _in_words(kind, ours[kind], theirs[kind]))
            for kind in ours
            if ours[kind] != theirs[kind]
        ]
        self.times = self.times or next((each for each in differ if each.kind == "times"), None)
        self.found = tuple(each for each in differ if each.kind != "times")
        self.ticks += not self.found

    def _start(self, tick: Tick, first: bool) -> Nanos:
        return tick.now if self._starts is None else self._starts[0 if first else 1]


def first_difference(one: Recording, two: Recording) -> Difference | None:
    """Compare two recordings tick by tick.

    Args:
        one: what `read_recording` returned.
        two: another.

    Returns:
        Difference: `Beside.first`; None if all is the same.
    """
    beside = Beside(one, two)
    while not beside.advance(1000):
        pass
    return beside.first


def _ticks(recording: Recording) -> Iterator[Tick | str]:
    """Yield the ticks; where one cannot be read, why, and no more."""
    try:
        yield from recording.ticks
    except RecordingError as error:
        yield f"nothing that can be read: {error}"


def _plain(tick: Tick, start: Nanos) -> dict[Kind, Sequence[Any]]:
    """Return what a tick holds by kind, and its time stamps since the start of the recording apart."""
    packets = (*tick.inputs.packets, *tick.outputs.packets)
    stamped = (tick.now, *(packet.t for packet in packets), *(event.t for event in tick.outputs.events))
    return {
        "times": [t - start for t in stamped],
        "states": tick.inputs.states,
        "received": [replace(packet, t=0) for packet in tick.inputs.packets],
        "instructions": tick.inputs.instructions,
        "events": [replace(event, t=0) for event in tick.outputs.events],
        "packets": [replace(packet, t=0) for packet in tick.outputs.packets],
        "notes": tick.outputs.notes,
    }


def _in_words(kind: Kind, one: Sequence[Any], two: Sequence[Any]) -> str:
    """Return the first pair that differs, in words."""
    a, b = next(pair for pair in zip_longest(one, two) if pair[0] != pair[1])
    match kind:
        case "times":
            return _both("time since the start", *(_time(t) for t in (a, b)))
        case "states":
            return _both(
                "state of a bus", *(f"{side[0]}: {side[1].value}" if side else "" for side in (a, b))
            )
        case "received" | "packets":
            what = "received" if kind == "received" else "sent"
            return _both(what, *(f"{side.bus}: {packet_text(side)}" if side else "" for side in (a, b)))
        case "notes":
            texts = (f"{side.source}: {side.text} ({side.level})" if side else "" for side in (a, b))
            return _both("note", *texts)
        case _:
            messages: list[list[Message]] = [[side] if side is not None else [] for side in (a, b)]
            what = "instruction" if kind == "instructions" else "event of a device"
            return _both(what, *diff.message_texts(*messages))


def _time(t: Nanos | None) -> str:
    return "" if t is None else f"{seconds(t):.9f} s"


def _both(what: str, *sides: str) -> str:
    one, two = (escaped(side) or "nothing more" for side in sides)
    return f"{what}\n  {_SIDES[0]}:  {one}\n  {_SIDES[1]}: {two}"
