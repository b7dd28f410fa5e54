"""A shorter recording: a stretch of another, and before it what the state at its beginning follows from.

Rules. A state is never stored in a file: it follows from inputs alone. So before the stretch stand ticks that
lead to its state (the lead-in), with their inputs and outputs, but without views. The shortest is tried
first: none; the last before the stretch; the first of the recording, in which devices are found, and the
last, with whole seconds between them cut out, so that what is periodic keeps its phase. Each is run by the
code of today from a new gateway, and the first after which every packet, event and note of the stretch is the
recorded one stays. Where none is, all that was before stays, as it was written. The trimmed file replays as
the whole did.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from gateway.core.tick import Outputs, Tick
from gateway.errors import RecordingError, UserError
from gateway.recording import Recording
from gateway.recording.layout import FORMAT, VIEWS_FROM
from gateway.recording.tick_writer import LATCHED
from gateway.replay.compare import replay_recording
from gateway.replay.input_log import MADE_FROM, Given, InputLog, RecordingFile, input_log, run
from protocols.messages import MILLISECOND, SECOND, Fault, Nanos, Stop, seconds

LEADS: Sequence[Nanos] = tuple(500 * MILLISECOND << power for power in range(12))
"""Lengths that are tried, of what stays of the beginning and of the end: up to 17 minutes"""


def _has_fault(tick: Tick) -> bool:
    return any(isinstance(event, Fault) for event in tick.outputs.events) or any(
        note.level == "error" for note in tick.outputs.notes
    )


def _has_warning(tick: Tick) -> bool:
    return any(note.level != "info" for note in tick.outputs.notes)


def _has_stop(tick: Tick) -> bool:
    return any(isinstance(one, Stop) for one in tick.inputs.instructions)


AROUND: Mapping[str, Callable[[Tick], bool] | None] = {
    "fault": _has_fault,
    "warning": _has_warning,
    "stop": _has_stop,
    "difference": None,
}
"""What a stretch may lie around, each the first of its kind: a fault of a device or a note that is an error;
a note that is a warning or an error; a person's stop; the first difference from the code of today"""


class Stretch(NamedTuple):
    """Ticks by their place in the file."""

    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Trimmed:
    """What was written."""

    ticks: int
    """In the stretch,"""
    lead: int
    """and before it."""
    lead_time: Nanos
    left_out: int
    """Ticks of the whole recording that are not in it"""

    def text(self) -> str:
        """Return it in words."""
        before = f"{self.lead} ticks ({seconds(self.lead_time):.2f} s) before them lead to the state there"
        if not self.lead:
            before = "no tick before them is needed: a gateway that begins there sends the same"
        return f"{self.ticks} ticks; {before}; {self.left_out} ticks are left out"


def stretch_between(recording: Recording, begin: float | None, end: float | None) -> Stretch:
    """Return the ticks between two times [s since the first tick]; None: the beginning, or the end.

    Raises UserError if there is none."""
    start: Nanos | None = None
    inside: list[int] = []
    last = 0.0
    for place, tick in enumerate(recording.ticks):
        start = tick.now if start is None else start
        last = seconds(tick.now - start)
        if (begin is None or last >= begin) and (end is None or last <= end):
            inside = [*inside[:1], place]
    if not inside:
        wanted = f"from {begin or 0.0:g} s to {last if end is None else end:g} s"
        raise UserError(f"{recording.path}: no tick {wanted}: it is {last:.2f} s long")
    return Stretch(inside[0], inside[-1])


def stretch_around(recording: Recording, what: str, margin: float) -> Stretch:
    """Return the ticks around the first of what is in `AROUND`, and `margin` [s] on both sides.

    Raises UserError if there is nothing of it."""
    is_it = AROUND[what]
    if is_it is None:
        first = replay_recording(recording).first
        at = None if first is None else first.since
    else:
        at, start = None, None
        for tick in recording.ticks:
            start = tick.now if start is None else start
            if is_it(tick):
                at = tick.now - start
                break
    if at is None:
        raise UserError(
            f"{recording.path}: there is no {what} in it; --from and --to name a stretch by its times"
        )
    return stretch_between(recording, max(0.0, seconds(at) - margin), seconds(at) + margin)


def trim(recording: Recording, stretch: Stretch, target: Path) -> Trimmed:
    """Write a stretch of a recording, and what leads to it, as a new recording.

    Args:
        recording: of this gateway.
        stretch: the ticks.
        target: the file, which must not exist.

    Raises:
        RecordingError: the recording is of a former format, damaged, or the file cannot be written.
    """
    if recording.format != FORMAT:
        text = f"of format {recording.format}, which said things differently; format {FORMAT} can be trimmed"
        raise RecordingError(f"{recording.path}: {text}")
    log = input_log(recording)
    stretched = log.ticks[stretch.first : stretch.last + 1]
    recorded = [tick.outputs for tick in islice(recording.ticks, stretch.first, stretch.last + 1)]
    before = log.ticks[: stretch.first]
    lead = next(
        (one for one in leads(before, stretched[0].now) if _gives(log, one, stretched, recorded)), None
    )
    kept = before if lead is None else lead
    earlier = int(recording.facts.get(VIEWS_FROM, "0"))
    facts = {
        MADE_FROM: f"{recording.path.name}, ticks {stretch.first} to {stretch.last}",
        VIEWS_FROM: str(max(earlier - stretch.first + len(kept), len(kept))),
    }
    if lead is None:
        _copy(target, recording, log, stretch, facts)
    else:
        _write_anew(target, log.with_ticks([*lead, *stretched]), len(lead), facts)
    time = stretched[0].now - kept[0].now if kept else 0
    return Trimmed(len(stretched), len(kept), time, len(log.ticks) - len(kept) - len(stretched))


def leads(before: Sequence[Given], begin: Nanos) -> Iterator[Sequence[Given]]:
    """Yield what may lead to the state at a time, the shortest first; all of it is not among them."""
    if not before:
        return
    yield ()
    start = before[0].now
    for total in LEADS:
        if total >= begin - start:
            return
        yield [given for given in before if given.now >= begin - total]
        for tail in LEADS:
            head, cut = total - tail, (begin - start - total) // SECOND * SECOND
            if head <= 0 or not cut:
                break
            first = [given.later(cut) for given in before if given.now < start + head]
            yield [*first, *(given for given in before if given.now >= start + head + cut)]


def _gives(
    log: InputLog, lead: Sequence[Given], stretch: Sequence[Given], recorded: Sequence[Outputs]
) -> bool:
    """True if the code of today, begun anew with the lead-in, gives in the stretch what is recorded."""
    try:
        for tick, _ in run(log.with_ticks([*lead, *stretch])):
            if tick.number >= len(lead) and tick.outputs != recorded[tick.number - len(lead)]:
                return False
    except Exception:  # noqa: BLE001 -- a step that fails without what led to it: that is needed
        return False
    return True


def _write_anew(target: Path, log: InputLog, lead: int, facts: Mapping[str, str]) -> None:
    file = RecordingFile(target, log, facts)
    try:
        for tick, belief in run(log):
            file.add(tick, belief, None if tick.number >= lead else lambda view: view.topic in LATCHED)
    except BaseException:
        file.abandon()
        raise
    file.finish()


def _copy(
    target: Path, recording: Recording, log: InputLog, stretch: Stretch, facts: Mapping[str, str]
) -> None:
    for step in islice(recording.steps, stretch.last + 1):
        if step.damage:
            raise RecordingError(f"{recording.path}: damaged: {step.damage[0]}")
    file = RecordingFile(target, log, facts, anew=False)
    try:
        for place, step in enumerate(islice(recording.steps, stretch.last + 1)):
            lead = place < stretch.first
            file.copy(step.tick, [view for view in step.views if not lead or view.topic in LATCHED])
    except BaseException:
        file.abandon()
        raise
    file.finish()
