"""Bytes: none raise, each is counted, a damaged one changes nothing, and a stream may be cut anywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, START, Rehearsal
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, counts
from protocols.conformance.random import Dice
from protocols.frames import CanFrame, Wire
from protocols.messages import Command, Event, Feedback, Request

Poke = Callable[[Rehearsal, Wire], object]
Fed = tuple[list[Event], tuple[int, int, int]]
"""The events of a driver, and how it counted: heard, bad, foreign."""
TAIL = 40
"""Sound messages behind a damaged one, by which a reader must have found its way back."""


def no_bytes_raise(case: Case) -> Verdict:
    """Driver, ear and twin take any wire: random, cut, too long, of another kind; disarmed or armed."""
    samples = noise.wires(case, case.part(500))
    for start in (case.start, case.armed):
        for who, poke in POKES:
            stage = start()
            if stage is None:
                continue
            for at, wire in enumerate(samples):
                error = _raised(poke, stage, wire)
                if error:
                    series = samples[max(at - 7, 0) : at + 1]
                    return _raising(start, who, poke, series, error)
    return None


def _raising(
    start: Callable[[], Rehearsal | None], who: str, poke: Poke, series: list[Wire], error: str
) -> Failure:
    """The failure, with the one wire that suffices, if one does."""

    def alone(wire: Wire) -> bool:
        stage = start()
        return stage is not None and bool(_raised(poke, stage, wire))

    if not alone(series[-1]):
        return Failure(f"{who} raises {error} at the last of these", tuple(series))
    return Failure(f"{who} raises {error}", (play.shortest(series[-1], alone),))


def _poke_driver(stage: Rehearsal, wire: Wire) -> object:
    return stage.driver.receive(stage.now, wire), stage.driver.send(stage.now, ()), stage.driver.due()


def _poke_ear(stage: Rehearsal, wire: Wire) -> object:
    return stage.ear.hear(stage.now, wire)


def _poke_twin(stage: Rehearsal, wire: Wire) -> object:
    twin = stage.twins[0]
    twin.receive(stage.now, wire)
    return twin.step(stage.now, [Feedback(NAMES[0], stage.now, 0.0, 0.0)]), twin.due()


POKES: tuple[tuple[str, Poke], ...] = (
    ("the driver", _poke_driver),
    ("the ear", _poke_ear),
    ("the twin", _poke_twin),
)


def _raised(poke: Poke, stage: Rehearsal, wire: Wire) -> str:
    try:
        poke(stage, wire)
    except Exception as error:  # noqa: BLE001 -- whatever a plugin raises here is the finding
        return f"{type(error).__name__}: {error}"
    return ""


def wires_are_counted(case: Case) -> Verdict:
    """Every wire is counted once, as what it is; what is not understood tells and changes nothing."""
    stage = case.start()
    said = [stage.step(words) for words in play.script(case.spec, NAMES)]
    first = next((step.up for step in said if step.up), ())
    tally = stage.driver.tally
    if tally.bad or (first and not tally.heard):
        return Failure(f"with nothing wrong on the bus: {tally}", first)
    return _messages_counted(case) if case.spec.bus == "serial" else _frames_counted(case)


def _frames_counted(case: Case) -> Failure | None:
    """On CAN: one driver hears all, another only what the first has counted as heard."""
    every, some = case.armed(), case.armed()
    if every is None or some is None:
        return Failure(f"does not arm in {play.ARMING} ms")
    for wire in noise.conversation(case)[:9]:
        first = _fed(case, [wire])[1]
        if sum(first) != 1:
            return Failure(f"the first wire ever heard is counted as (heard, bad, foreign) {first}", (wire,))
    now, other = every.now, noise.other_format(case)
    for wire in [*other, *noise.wires(case, case.part(1500))]:
        before = counts(every.driver.tally)
        events = list(every.driver.receive(now, wire))
        more = tuple(a - b for a, b in zip(counts(every.driver.tally), before, strict=True))
        if more not in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
            return Failure(f"one wire is counted as (heard, bad, foreign) {more}", (wire,))
        if not more[2] and (wire in other or not isinstance(wire, CanFrame)):
            return Failure(f"no frame of these devices, counted as (heard, bad, foreign) {more}", (wire,))
        if not more[0] and events:
            return Failure("not understood, and yet it told something", (wire,), tuple(events))
        if more[0] and list(some.driver.receive(now, wire)) != events:
            return Failure("what was not understood before changes what this tells", (wire,), tuple(events))
        if every.driver.send(now, ()) != some.driver.send(now, ()):
            return Failure("what was not understood changes what the driver says", (wire,))
    return _cut_frames(case, every)


def _cut_frames(case: Case, stage: Rehearsal) -> Failure | None:
    """A frame that lacks its end tells no number that the whole frame did not tell."""
    for shaft, position in zip(stage.shafts.values(), (1.25, -2.75), strict=True):
        shaft.position, shaft.velocity, shaft.locked = position, 0.5 * position, True
    for wire in dict.fromkeys(wire for said in stage.steps(300)[-100:] for wire in said.up):
        data = play.data_of(wire)
        whole = _numbers(_fed(case, [wire])[0])
        for size in range(len(data)):
            short = play.with_data(wire, data[:size])
            events = _fed(case, [short])[0]
            if not _numbers(events) <= whole:
                return Failure("a frame cut short tells other numbers", (wire, short), tuple(events))
    return None


def _numbers(events: Sequence[Event]) -> set[tuple[str, str, float]]:
    """What was measured: motor, quantity, number."""
    measured = [event for event in events if isinstance(event, Feedback)]
    named = [(event.motor, f.name, getattr(event, f.name)) for event in measured for f in fields(event)]
    return {each for each in named if each[1] not in ("motor", "t") and each[2] is not None}


def _messages_counted(case: Case) -> Failure | None:
    """On a stream: a damaged message counts once, and all is as if it had not been sent."""
    dice, wires = case.dice(), _upward(case)
    if len(wires) < 2 * TAIL:
        return Failure(f"in a second the devices say {len(wires)} wires: too few to tell")
    strange = CanFrame(1, b"\0")
    if _fed(case, [strange])[1] != (0, 0, 1):
        return Failure("a CAN frame on a serial line is not counted as foreign", (strange,))
    for _ in range(case.part(30)):
        at = dice.below(len(wires) - TAIL)
        wire = wires[at]
        cut, flipped = (
            wire[: 1 + dice.below(max(len(wire) - 1, 1))],
            noise.flipped(wire, dice.below(8 * len(wire))),
        )
        for damage, what in ((flipped, "one bit flipped"), (cut, "cut short")):
            failure = _counted_once(case, wires, at, damage, what)
            if failure:
                return failure
    return None


def _counted_once(case: Case, wires: list[bytes], at: int, damage: bytes, what: str) -> Failure | None:
    without, base = _fed(case, [b"".join(wires[:at] + wires[at + 1 :])])
    events, tally = _fed(case, [b"".join([*wires[:at], damage, *wires[at + 1 :]])])
    shown = (wires[at], damage)
    if tally[0] != base[0] or tally[1] + tally[2] != base[1] + base[2] + 1:
        return Failure(f"{what}: (heard, bad, foreign) is {tally}, and {base} without that message", shown)
    if events != without:
        new = tuple(event for event in events if event not in without)[:2]
        return Failure(f"{what}: the others tell something else than without that message", shown, new)
    return None


def _upward(case: Case) -> list[bytes]:
    """What the devices say in a second, up to 200 wires."""
    stage = case.armed() or case.start()
    said = [wire for _ in range(1000) for wire in stage.step().up][:200]
    return [wire for wire in said if isinstance(wire, bytes) and wire]


def _fed(case: Case, wires: Sequence[Wire]) -> Fed:
    """What a fresh driver makes of these wires."""
    driver = case.start().driver
    events = [event for wire in wires for event in driver.receive(START, wire)]
    return events, counts(driver.tally)


def streams_may_be_cut(case: Case) -> Verdict:
    """A serial stream, with rubbish in it, gives the same whole, byte by byte, and cut anywhere."""
    if case.spec.bus != "serial":
        return Inapplicable(f"the spec's bus is {case.spec.bus}: frames come whole")
    dice, said = case.dice(), [play.data_of(wire) for wire in noise.conversation(case)]
    for count in (20, 150):
        clean = said[:: max(len(said) // count, 1)]
        rubbish = [noise.damaged(dice.choice(clean), dice) for _ in range(count // 2)]
        rubbish += [dice.bytes(1 + dice.below(20)) for _ in range(count // 4)]
        for pieces in (clean, dice.shuffled([*clean, *rubbish])):
            failure = _cut(case, b"".join(pieces), dice)
            if failure:
                return failure
    return None


def _cut(case: Case, stream: bytes, dice: Dice) -> Failure | None:
    whole = _both(case, [stream])
    for longest in (1, 7, 300):
        other = _both(case, _pieces(stream, longest, dice))
        if other == whole:
            continue

        def differs(wire: Wire) -> bool:
            data = play.data_of(wire)
            return _both(case, [data]) != _both(case, [data[at : at + 1] for at in range(len(data))])

        short = play.shortest(stream, differs) if differs(stream) else stream[:64]
        text = f"whole: {_brief(whole)}; in pieces of up to {longest}: {_brief(other)}"
        return Failure(text, (short,))
    return None


def _both(case: Case, wires: Sequence[Wire]) -> tuple[Fed, list[Command | Request]]:
    """What driver and ear make of the same bytes."""
    ear = case.start().ear
    return _fed(case, wires), [word for wire in wires for word in ear.hear(START, wire)]


def _brief(both: tuple[Fed, list[Command | Request]]) -> str:
    (events, tally), words = both
    return f"{len(events)} events, (heard, bad, foreign) {tally}, the ear {len(words)} words"


def _pieces(stream: bytes, longest: int, dice: Dice) -> list[bytes]:
    pieces, at = [], 0
    while at < len(stream):
        size = 1 + dice.below(longest)
        pieces.append(stream[at : at + size])
        at += size
    return pieces
