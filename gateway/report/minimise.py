"""A recording made as small as it may be while something still holds of it (delta debugging).

Rules. What is taken away, in this order: what comes after it holds; what was before, as `trim` tries it;
whole kinds of inputs (an id on a bus, a kind of instruction); ticks, with the time they took; single inputs.
Whatever is left out, the rest is run by the code of today from a new gateway, and it stays out only if the
condition holds. Trials are bounded; what was reached by then is the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from gateway.core.tick import Inputs
from gateway.replay.input_log import Given, InputLog
from gateway.replay.trim import leads
from gateway.report.condition import Condition
from protocols.frames import CanFrame
from protocols.messages import Nanos, seconds

T = TypeVar("T")
TRIALS = 300


@dataclass(frozen=True, slots=True)
class Minimal:
    """What remains."""

    log: InputLog
    trials: int
    whole: int
    """Ticks of the recording,"""
    whole_inputs: int
    """and its inputs."""

    def text(self) -> str:
        """Return it in words."""
        ticks = self.log.ticks
        time = seconds(ticks[-1].now - ticks[0].now) if ticks else 0.0
        return (
            f"{len(ticks)} of {self.whole} ticks, {time:.2f} s, and {len(_inputs(ticks))} of "
            f"{self.whole_inputs} inputs still do, after {self.trials} trials"
        )


class _Trials:
    """Asks whether it holds, as often as it may: each step takes half of the trials that are left at most."""

    def __init__(self, holds: Condition, log: InputLog, most: int) -> None:
        self._holds, self._most = holds, most
        self._until = most
        self.log, self.count = log, 0

    def begin_step(self) -> None:
        """Begin a step."""
        self._until = self.count + (self._most - self.count + 1) // 2

    def take(self, ticks: Sequence[Given]) -> bool:
        """Keep these ticks if the condition holds of them; what comes after that goes at once."""
        if self.count >= self._until or not ticks:
            return False
        self.count += 1
        tried = self.log.with_ticks(ticks)
        first = self._holds.first(tried)
        if first is None:
            return False
        self.log = tried.with_ticks(ticks[: first + 1])
        return True


def minimise(
    log: InputLog, holds: Condition, most: int = TRIALS, told: Callable[[int], None] = lambda _count: None
) -> Minimal | None:
    """Return the fewest inputs that were found of which a condition holds; None if it does not of all.

    Args:
        log: the inputs of a recording.
        holds: the condition.
        most: trials.
        told: called with the number of trials, now and then.
    """
    trials = _Trials(holds, log, most)
    whole, inputs = len(log.ticks), len(_inputs(log.ticks))
    if not trials.take(log.ticks):
        return None
    for step in (_ends, _starts, _kinds, _ticks, _singly, _ticks):
        trials.begin_step()
        step(trials)
        told(trials.count)
    return Minimal(trials.log, trials.count, whole, inputs)


def _ends(trials: _Trials) -> None:
    """Leave out the end, half of what may go at a time: of conditions that are asked at the end."""
    part = len(trials.log.ticks) // 2
    while part:
        if not trials.take(trials.log.ticks[:-part]):
            part //= 2


def _starts(trials: _Trials) -> None:
    """Leave out what was before, as far as it is not needed."""
    ticks = trials.log.ticks
    last = ticks[-1]
    for lead in leads(ticks[:-1], last.now):
        if trials.take([*lead, last]):
            return


def _ticks(trials: _Trials) -> None:
    """Leave out ticks, and the time that they took."""
    _minimised(trials, trials.log.ticks, lambda kept: closed(trials.log.ticks, kept))


def _kinds(trials: _Trials) -> None:
    """Leave out all inputs of a kind."""
    ticks = trials.log.ticks
    kinds = list(dict.fromkeys(kind for _, kind, _ in _inputs(ticks)))

    def without(kept: Sequence[tuple[str, object]]) -> Sequence[Given]:
        stays = set(kept)
        return _with_inputs(ticks, [one for one in _inputs(ticks) if one[1] in stays])

    _minimised(trials, kinds, without)


def _singly(trials: _Trials) -> None:
    """Leave out single inputs."""
    ticks = trials.log.ticks
    _minimised(trials, _inputs(ticks), lambda kept: _with_inputs(ticks, kept))


def _minimised(trials: _Trials, parts: Sequence[T], made: Callable[[Sequence[T]], Sequence[Given]]) -> None:
    """Leave out parts: large pieces first, then ever smaller ones, as long as one of that size could go."""
    kept, size = list(parts), max(1, len(parts) // 2)
    while kept:
        before, place = len(kept), 0
        while place < len(kept):
            tried = kept[:place] + kept[place + size :]
            if trials.take(made(tried)):
                kept = tried
            else:
                place += size
        if size == 1 and len(kept) == before:
            return
        size = max(1, size // 2) if len(kept) == before or size > len(kept) else min(size, len(kept))


def closed(ticks: Sequence[Given], kept: Sequence[Given]) -> list[Given]:
    """Return some of these ticks, without the time that the others took."""
    stays = {id(one) for one in kept}
    found: list[Given] = []
    gone: Nanos = 0
    for one, after in zip(ticks, [*ticks[1:], ticks[-1]], strict=True):
        if id(one) in stays:
            found.append(one.later(-gone) if gone else one)
        else:
            gone += after.now - one.now
    return found


def _inputs(ticks: Sequence[Given]) -> list[tuple[int, tuple[str, object], object]]:
    """Return all inputs: the place of the tick, the kind, and the input."""
    return [(place, kind, one) for place, given in enumerate(ticks) for kind, one in _inputs_of(given.inputs)]


def _inputs_of(inputs: Inputs) -> Iterator[tuple[tuple[str, object], object]]:
    for state in inputs.states:
        yield ("state", state[0]), state
    for packet in inputs.packets:
        frame = packet.frame
        yield (packet.bus, frame.id if isinstance(frame, CanFrame) else ""), packet
    for instruction in inputs.instructions:
        yield ("asked", type(instruction).__name__), instruction


def _with_inputs(
    ticks: Sequence[Given], kept: Sequence[tuple[int, tuple[str, object], object]]
) -> list[Given]:
    """Return all ticks with only these inputs."""
    stays: dict[int, set[int]] = {}
    for place, _, one in kept:
        stays.setdefault(place, set()).add(id(one))

    def within(place: int, inputs: Inputs) -> Inputs:
        here = stays.get(place, set())

        def some(given: tuple[T, ...]) -> tuple[T, ...]:
            return tuple(one for one in given if id(one) in here)

        return Inputs(some(inputs.states), some(inputs.packets), some(inputs.instructions))

    return [given._replace(inputs=within(place, given.inputs)) for place, given in enumerate(ticks)]
