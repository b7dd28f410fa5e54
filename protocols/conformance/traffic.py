"""Bytes: none raise, each is counted, a damaged one changes nothing, and a stream may be cut anywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, START, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, counts
from protocols.conformance.random import Random
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Event, Feedback, Request

Poke = Callable[[Bench, Frame], object]
Fed = tuple[list[Event], tuple[int, int, int]]
"""The events of a driver, and how it counted: heard, bad, foreign."""
TAIL = 40
"""Sound messages behind a damaged one, by which a reader must have found its way back."""


def no_bytes_raise(case: Case) -> Verdict:
    """Driver, ear and twin take any wire: random, cut, too long, of another kind; disarmed or armed."""
    samples = noise.frames(case, case.part(500))
    for start in (case.start, case.armed):
        for who, poke in POKES:
            stage = start()
            if stage is None:
                continue
            for at, frame in enumerate(samples):
                error = _raised(poke, stage, frame)
                if error:
                    series = samples[max(at - 7, 0) : at + 1]
                    return _raising(start, who, poke, series, error)
    return None


def _raising(
    start: Callable[[], Bench | None], who: str, poke: Poke, series: list[Frame], error: str
) -> Failure:
    """The failure, with the one wire that suffices, if one does."""

    def alone(frame: Frame) -> bool:
        stage = start()
        return stage is not None and bool(_raised(poke, stage, frame))

    if not alone(series[-1]):
        return Failure(f"{who} raises {error} at the last of these", tuple(series))
    return Failure(f"{who} raises {error}", (play.shortest(series[-1], alone),))


def _poke_driver(stage: Bench, frame: Frame) -> object:
    return stage.driver.receive(stage.now, frame), stage.driver.send(stage.now, ()), stage.driver.due()


def _poke_decoder(stage: Bench, frame: Frame) -> object:
    return stage.decoder.decode(stage.now, frame)


def _poke_twin(stage: Bench, frame: Frame) -> object:
    twin = stage.twins[0]
    twin.receive(stage.now, frame)
    return twin.step(stage.now, [Feedback(NAMES[0], stage.now, 0.0, 0.0)]), twin.due()


POKES: tuple[tuple[str, Poke], ...] = (
    ("the driver", _poke_driver),
    ("the ear", _poke_decoder),
    ("the twin", _poke_twin),
)


def _raised(poke: Poke, stage: Bench, frame: Frame) -> str:
    try:
        poke(stage, frame)
    except Exception as error:  # noqa: BLE001 -- whatever a plugin raises here is the finding
        return f"{type(error).__name__}: {error}"
    return ""


def frames_are_counted(case: Case) -> Verdict:
    """Every wire is counted once, as what it is; what is not understood tells and changes nothing."""
    stage = case.start()
    said = [stage.step(words) for words in play.script(case.spec, NAMES)]
    first = next((step.up for step in said if step.up), ())
    counters = stage.driver.counters
    if counters.malformed or (first and not counters.accepted):
        return Failure(f"with nothing wrong on the bus: {counters}", first)
    return _messages_counted(case) if case.spec.bus == "serial" else _frames_counted(case)


def _frames_counted(case: Case) -> Failure | None:
    """On CAN: one driver hears all, another only what the first has counted as heard."""
    every, some = case.armed(), case.armed()
    if every is None or some is None:
        return Failure(f"does not arm in {play.ARMING} ms")
    for frame in noise.conversation(case)[:9]:
        first = _fed(case, [frame])[1]
        if sum(first) != 1:
            return Failure(f"the first wire ever heard is counted as (heard, bad, foreign) {first}", (frame,))
    now, other = every.now, noise.other_format(case)
    for frame in [*other, *noise.frames(case, case.part(1500))]:
        before = counts(every.driver.counters)
        events = list(every.driver.receive(now, frame))
        more = tuple(a - b for a, b in zip(counts(every.driver.counters), before, strict=True))
        if more not in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
            return Failure(f"one wire is counted as (heard, bad, foreign) {more}", (frame,))
        if not more[2] and (frame in other or not isinstance(frame, CanFrame)):
            return Failure(f"no frame of these devices, counted as (heard, bad, foreign) {more}", (frame,))
        if not more[0] and events:
            return Failure("not understood, and yet it told something", (frame,), tuple(events))
        if more[0] and list(some.driver.receive(now, frame)) != events:
            return Failure("what was not understood before changes what this tells", (frame,), tuple(events))
        if every.driver.send(now, ()) != some.driver.send(now, ()):
            return Failure("what was not understood changes what the driver says", (frame,))
    return _cut_frames(case, every)


def _cut_frames(case: Case, stage: Bench) -> Failure | None:
    """A frame that lacks its end tells no number that the whole frame did not tell."""
    for shaft, position in zip(stage.shafts.values(), (1.25, -2.75), strict=True):
        shaft.position, shaft.velocity, shaft.locked = position, 0.5 * position, True
    for frame in dict.fromkeys(frame for said in stage.steps(300)[-100:] for frame in said.up):
        data = play.data_of(frame)
        whole = _numbers(_fed(case, [frame])[0])
        for size in range(len(data)):
            short = play.with_data(frame, data[:size])
            events = _fed(case, [short])[0]
            if not _numbers(events) <= whole:
                return Failure("a frame cut short tells other numbers", (frame, short), tuple(events))
    return None


def _numbers(events: Sequence[Event]) -> set[tuple[str, str, float]]:
    """What was measured: motor, quantity, number."""
    measured = [event for event in events if isinstance(event, Feedback)]
    named = [(event.motor, f.name, getattr(event, f.name)) for event in measured for f in fields(event)]
    return {each for each in named if each[1] not in ("motor", "t") and each[2] is not None}


def _messages_counted(case: Case) -> Failure | None:
    """On a stream: a damaged message counts once, and all is as if it had not been sent."""
    random, frames = case.random(), _upward(case)
    if len(frames) < 2 * TAIL:
        return Failure(f"in a second the devices say {len(frames)} wires: too few to tell")
    strange = CanFrame(1, b"\0")
    if _fed(case, [strange])[1] != (0, 0, 1):
        return Failure("a CAN frame on a serial line is not counted as foreign", (strange,))
    for _ in range(case.part(30)):
        at = random.below(len(frames) - TAIL)
        frame = frames[at]
        cut, flipped = (
            frame[: 1 + random.below(max(len(frame) - 1, 1))],
            noise.flipped(frame, random.below(8 * len(frame))),
        )
        for damage, what in ((flipped, "one bit flipped"), (cut, "cut short")):
            failure = _counted_once(case, frames, at, damage, what)
            if failure:
                return failure
    return None


def _counted_once(case: Case, frames: list[bytes], at: int, damage: bytes, what: str) -> Failure | None:
    without, base = _fed(case, [b"".join(frames[:at] + frames[at + 1 :])])
    events, counters = _fed(case, [b"".join([*frames[:at], damage, *frames[at + 1 :]])])
    shown = (frames[at], damage)
    if counters[0] != base[0] or counters[1] + counters[2] != base[1] + base[2] + 1:
        return Failure(f"{what}: (heard, bad, foreign) is {counters}, and {base} without that message", shown)
    if events != without:
        new = tuple(event for event in events if event not in without)[:2]
        return Failure(f"{what}: the others tell something else than without that message", shown, new)
    return None


def _upward(case: Case) -> list[bytes]:
    """What the devices say in a second, up to 200 wires."""
    stage = case.armed() or case.start()
    said = [frame for _ in range(1000) for frame in stage.step().up][:200]
    return [frame for frame in said if isinstance(frame, bytes) and frame]


def _fed(case: Case, frames: Sequence[Frame]) -> Fed:
    """What a fresh driver makes of these wires."""
    driver = case.start().driver
    events = [event for frame in frames for event in driver.receive(START, frame)]
    return events, counts(driver.counters)


def streams_may_be_cut(case: Case) -> Verdict:
    """A serial stream, with rubbish in it, gives the same whole, byte by byte, and cut anywhere."""
    if case.spec.bus != "serial":
        return Inapplicable(f"the spec's bus is {case.spec.bus}: frames come whole")
    random, said = case.random(), [play.data_of(frame) for frame in noise.conversation(case)]
    for count in (20, 150):
        clean = said[:: max(len(said) // count, 1)]
        rubbish = [noise.damaged(random.choice(clean), random) for _ in range(count // 2)]
        rubbish += [random.bytes(1 + random.below(20)) for _ in range(count // 4)]
        for pieces in (clean, random.shuffled([*clean, *rubbish])):
            failure = _cut(case, b"".join(pieces), random)
            if failure:
                return failure
    return None


def _cut(case: Case, stream: bytes, random: Random) -> Failure | None:
    whole = _both(case, [stream])
    for longest in (1, 7, 300):
        other = _both(case, _pieces(stream, longest, random))
        if other == whole:
            continue

        def differs(frame: Frame) -> bool:
            data = play.data_of(frame)
            return _both(case, [data]) != _both(case, [data[at : at + 1] for at in range(len(data))])

        short = play.shortest(stream, differs) if differs(stream) else stream[:64]
        text = f"whole: {_brief(whole)}; in pieces of up to {longest}: {_brief(other)}"
        return Failure(text, (short,))
    return None


def _both(case: Case, frames: Sequence[Frame]) -> tuple[Fed, list[Command | Request]]:
    """What driver and ear make of the same bytes."""
    decoder = case.start().decoder
    return _fed(case, frames), [word for frame in frames for word in decoder.decode(START, frame)]


def _brief(both: tuple[Fed, list[Command | Request]]) -> str:
    (events, counters), words = both
    return f"{len(events)} events, (heard, bad, foreign) {counters}, the ear {len(words)} words"


def _pieces(stream: bytes, longest: int, random: Random) -> list[bytes]:
    pieces, at = [], 0
    while at < len(stream):
        size = 1 + random.below(longest)
        pieces.append(stream[at : at + size])
        at += size
    return pieces
