"""Bytes: none raise an exception, all are counted, damage changes nothing, a stream may be cut anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace

from protocols.conformance import bench as tools
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, START, STEP, Bench, Messages
from protocols.conformance.case import Case, Failure, Inapplicable, counts, difference
from protocols.conformance.random import Random
from protocols.conformance.states import Situation, situations
from protocols.frames import OF_BYTES, CanFrame, Frame
from protocols.messages import Event, Feedback, Obeyed
from protocols.plugin import FeedbackKind

Feed = Callable[[Bench, Frame, Messages], object]
Received = tuple[list[Event], tuple[int, int, int]]
"""The events of a driver, and its counts: accepted, malformed, ignored."""
COUNTED = "(accepted, malformed, ignored)"
TAIL = 40
"""Valid messages behind a damaged one, by which a reader must be in step again."""
MOST_BY_CHANCE = 3
"""Damaged messages that may pass for whole ones by their checksum, of 60"""
KINDS = 12
"""Different messages of each direction that are damaged."""
LONGEST = 120
"""Bytes of a message of which every bit is tried; of a longer one, as many bytes at its two ends together."""
SETTLED, SETTLED_ON_LINE = 20, 60
"""Steps after which a reader has dropped a message that did not end; on a line of questions, where the answer
that it may spoil is waited for, and what waited meanwhile has been asked."""
COMPARED = 5
"""Steps that are compared then."""
ROUND = 16
"""Frames that one driver gets before another one is in its place, which has learnt nothing of them."""
MOST, FEW = 2000, 160
"""Shapes of frames that are tried in a usual state, and in another."""


# -- no bytes raise --------------------------------------------------------------------------------------


def no_bytes_raise(case: Case) -> None:
    """Driver, decoder and twin take any frame, in every state: random, cut, too long, of another kind."""
    random, spec = case.random(), case.spec
    up, down = noise.shapes(case, spec.expects), random.shuffled(noise.shapes(case, spec.sends))[:MOST]
    for situation in situations(case):
        usual = situation.name in ("fresh", "armed")
        series = noise.frames(case, case.share(500 if usual else 60))
        for receiver, feed in RECEIVERS:
            _take(situation, receiver, feed, series)
        for receiver, feed in RECEIVERS[1:]:
            _take(situation, receiver, feed, down if usual else random.shuffled(down)[:FEW])
        # A new driver knows least of what it receives: it gets every shape.
        some = random.shuffled(up)[: len(up) if situation.name == "fresh" else case.share(FEW)]
        for at in range(0, len(some), ROUND):
            _take(situation, *RECEIVERS[0], some[at : at + ROUND])


def _take(situation: Situation, receiver: str, feed: Feed, series: Sequence[Frame]) -> None:
    """Give one end, in this state, a series of frames."""
    bench = situation.again()
    for at, frame in enumerate(series):
        bench.now += STEP
        error = _raised(feed, bench, frame, situation.given)
        if error:
            raise _shortened(situation, receiver, feed, series[max(at - 7, 0) : at + 1], error)


def _shortened(
    situation: Situation, receiver: str, feed: Feed, series: Sequence[Frame], error: str
) -> Failure:
    """Return the failure, with the one frame that suffices, if one does."""

    def alone(frame: Frame) -> bool:
        return bool(_raised(feed, situation.again(), frame, situation.given))

    if not alone(series[-1]):
        return Failure(f"{receiver}, {situation.name}, raises {error} at the last of these", series)
    return Failure(f"{receiver}, {situation.name}, raises {error}", (tools.shortest(series[-1], alone),))


def _feed_driver(bench: Bench, frame: Frame, given: Messages) -> object:
    driver = bench.driver
    return driver.receive(bench.now, frame), driver.send(bench.now, given), driver.due(), driver.awaits()


def _feed_decoder(bench: Bench, frame: Frame, _given: Messages) -> object:
    return bench.decoder.decode(bench.now, frame)


def _feed_twin(bench: Bench, frame: Frame, _given: Messages) -> object:
    twin = bench.twins[0]
    twin.receive(bench.now, frame)
    return twin.step(bench.now, [Feedback(NAMES[0], bench.now, 0.0, 0.0)]), twin.due()


RECEIVERS: tuple[tuple[str, Feed], ...] = (
    ("the driver", _feed_driver),
    ("the decoder", _feed_decoder),
    ("the twin", _feed_twin),
)


def _raised(feed: Feed, bench: Bench, frame: Frame, given: Messages) -> str:
    try:
        feed(bench, frame, given)
    except Exception as error:  # noqa: BLE001 -- whatever a plugin raises here is the finding
        return f"{type(error).__name__}: {error}"
    return ""


# -- counters --------------------------------------------------------------------------------------------


def frames_are_counted(case: Case) -> None:
    """Every frame is counted once, in its class; what is not accepted reports and changes nothing."""
    bench = case.start()
    steps = [bench.step(messages) for messages in tools.script(case.spec, case.names)]
    first = next((step.up for step in steps if step.up), ())
    counters = bench.driver.counters
    if counters.malformed or (first and not counters.accepted):
        raise Failure(f"with nothing wrong on the bus: {counters}", first)
    if case.spec.bus in OF_BYTES:
        _messages_are_counted(case)
    else:
        _can_frames_are_counted(case)


def _can_frames_are_counted(case: Case) -> None:
    """On CAN: one driver receives all frames, another only those that the first counts as accepted."""
    every, some = case.armed(), case.armed()
    if every is None or some is None:
        raise Failure(f"does not arm within {tools.ARMING} ms")
    for frame in noise.valid_frames(case)[:9]:
        first = _received(case, [frame])[1]
        if sum(first) != 1:
            raise Failure(f"the first frame ever received is counted as {COUNTED} {first}", (frame,))
    now, other = every.now, noise.other_format(case)
    for frame in [*other, *noise.frames(case, case.share(1500))]:
        before = counts(every.driver.counters)
        events = list(every.driver.receive(now, frame))
        more = tuple(a - b for a, b in zip(counts(every.driver.counters), before, strict=True))
        if more not in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
            raise Failure(f"one frame is counted as {COUNTED} {more}", (frame,))
        if not more[2] and (frame in other or not isinstance(frame, CanFrame)):
            raise Failure(f"a foreign frame is counted as {COUNTED} {more}", (frame,))
        if not more[0] and events:
            raise Failure("not accepted, and yet something is reported", (frame,), events)
        if more[0] and list(some.driver.receive(now, frame)) != events:
            raise Failure("a frame not accepted before changes what is reported of this", (frame,), events)
        if every.driver.send(now, ()) != some.driver.send(now, ()):
            raise Failure("a frame not accepted changes what the driver sends", (frame,))
    _cut_frames_report_nothing(case, every)


def _cut_frames_report_nothing(case: Case, bench: Bench) -> None:
    """A frame that lacks its end reports no number that the whole frame does not report."""
    for shaft, position in zip(bench.shafts.values(), (1.25, -2.75), strict=True):
        shaft.position, shaft.velocity, shaft.locked = position, 0.5 * position, True
    for frame in dict.fromkeys(frame for step in bench.steps(300, case.prompt)[-100:] for frame in step.up):
        data = tools.data_of(frame)
        whole = _numbers(_received(case, [frame])[0])
        for size in range(len(data)):
            short = tools.with_data(frame, data[:size])
            events = _received(case, [short])[0]
            if not _numbers(events) <= whole:
                raise Failure("a frame cut short reports other numbers", (frame, short), events)


def _numbers(events: Sequence[Event]) -> set[tuple[str, str, float]]:
    """Return what was measured: motor, quantity, number."""
    measured = [event for event in events if isinstance(event, Feedback)]
    named = [(event.motor, f.name, getattr(event, f.name)) for event in measured for f in fields(event)]
    return {each for each in named if each[1] not in ("motor", "t") and each[2] is not None}


def _messages_are_counted(case: Case) -> None:
    """On a stream: a damaged message counts once, and all is as if it had not been sent."""
    random, messages = case.random(), _messages_of_devices(case)
    if case.spec.feedback is FeedbackKind.NONE and not messages:
        raise Inapplicable("the spec's feedback is none: the devices send no messages")
    if len(messages) < 2 * TAIL:
        raise Failure(
            f"in a second, or in 30 periods, the devices send {len(messages)} messages: too few to test"
        )
    can = CanFrame(1, b"\0")
    if _received(case, [can])[1] != (0, 0, 1):
        raise Failure("a CAN frame on a serial bus is not counted as ignored", (can,))
    if case.says_nothing_unasked:
        events, counters = _received(case, messages)
        if events or not counters[2]:
            raise Failure(
                f"what nobody has asked for is counted as {COUNTED} {counters}", messages[:1], events
            )
        return
    found = [at for at in range(len(messages) - TAIL) if noise.protected(case, messages[at])]
    by_chance = 0
    for at in (random.choice(found) for _ in range(case.share(30) if found else 0)):
        whole = messages[at]
        cut = whole[: 1 + random.below(max(len(whole) - 1, 1))]
        flipped = noise.flipped(whole, random.below(8 * len(whole)))
        for damaged, what in ((flipped, "one bit flipped"), (cut, "cut short")):
            try:
                _is_counted_once(case, messages, at, damaged, what)
            except Failure:
                by_chance += 1
                if by_chance > MOST_BY_CHANCE or not _is_whole_by_chance(case, messages, at, damaged):
                    raise


def _is_whole_by_chance(case: Case, messages: list[bytes], at: int, damaged: bytes) -> bool:
    """Return whether what is left of a message is, with the first bytes of the next one, a message by its
    checksum: of 8 bits, each 256th is."""
    stream, lengths = damaged + messages[at + 1], {len(message) for message in messages}
    return any(
        _received(case, [stream[first : first + length]])[1] in ((1, 0, 0), (0, 0, 1))
        for length in lengths
        for first in range(max(0, len(damaged) - length + 1), len(damaged))
        if first + length <= len(stream)
    )


def _is_counted_once(case: Case, messages: list[bytes], at: int, damaged: bytes, what: str) -> None:
    without, base = _received(case, [b"".join(messages[:at] + messages[at + 1 :])])
    events, counters = _received(case, [b"".join([*messages[:at], damaged, *messages[at + 1 :]])])
    frames = (messages[at], damaged)
    if counters[0] != base[0] or counters[1] + counters[2] != base[1] + base[2] + 1:
        raise Failure(f"{what}: {COUNTED} is {counters}, and {base} without that message", frames)
    if events != without:
        new = [event for event in events if event not in without][:2]
        raise Failure(f"{what}: the other messages report something else than without it", frames, new)


def _messages_of_devices(case: Case) -> list[bytes]:
    """Return what the devices send in a second, or in 30 of their periods, up to 200 messages."""
    bench, frames = case.armed() or case.start(), list[Frame]()
    for at in range(max(1000, 30 * (case.spec.feedback_period // STEP))):
        if len(frames) >= 200 or (at >= 1000 and len(frames) >= 2 * TAIL):
            break
        frames += bench.step(case.prompt).up
    return [frame for frame in frames[:200] if isinstance(frame, bytes) and frame]


def _received(case: Case, frames: Sequence[Frame]) -> Received:
    """Return the events and counts of a new driver that receives these frames."""
    driver = case.start().driver
    events = [event for frame in frames for event in driver.receive(START, frame)]
    return events, counts(driver.counters)


# -- streams ---------------------------------------------------------------------------------------------


def streams_may_be_cut(case: Case) -> None:
    """A serial stream, also with garbage in it, gives the same whole, byte by byte, and cut anywhere."""
    if case.spec.bus != "serial":
        raise Inapplicable(f"the spec's bus is {case.spec.bus}: frames arrive whole")
    random, valid = case.random(), [tools.data_of(frame) for frame in noise.valid_frames(case)]
    if case.spec.feedback is FeedbackKind.NONE and not valid:
        raise Inapplicable("the spec's feedback is none, and nothing is sent")
    for count in (20, 150):
        clean = valid[:: max(len(valid) // count, 1)]
        garbage = [noise.damaged(random.choice(clean), random) for _ in range(count // 2)]
        garbage += [random.bytes(1 + random.below(20)) for _ in range(count // 4)]
        for pieces in (clean, random.shuffled([*clean, *garbage])):
            _may_be_cut(case, b"".join(pieces), random)


def _may_be_cut(case: Case, stream: bytes, random: Random) -> None:
    whole = _both(case, [stream])
    for longest in (1, 7, 300):
        cut = _both(case, _pieces(stream, longest, random))
        if cut == whole:
            continue

        def differs(frame: Frame) -> bool:
            data = tools.data_of(frame)
            return _both(case, [data]) != _both(case, [data[at : at + 1] for at in range(len(data))])

        short = tools.shortest(stream, differs) if differs(stream) else stream[:64]
        raise Failure(f"whole: {_brief(whole)}; in pieces of up to {longest}: {_brief(cut)}", (short,))


def _both(case: Case, frames: Sequence[Frame]) -> tuple[Received, list[Obeyed]]:
    """Return what driver and decoder make of the same bytes."""
    decoder = case.start().decoder
    return _received(case, frames), [m for frame in frames for m in decoder.decode(START, frame)]


def _brief(both: tuple[Received, list[Obeyed]]) -> str:
    (events, counters), messages = both
    return f"{len(events)} events, {COUNTED} {counters}, {len(messages)} decoded messages"


def _pieces(stream: bytes, longest: int, random: Random) -> list[bytes]:
    pieces, at = [], 0
    while at < len(stream):
        size = 1 + random.below(longest)
        pieces.append(stream[at : at + size])
        at += size
    return pieces


# -- checksums -------------------------------------------------------------------------------------------


def wrong_bits_change_nothing(case: Case) -> None:
    """No message on a stream in which one bit is wrong has an effect in driver, decoder or device.

    One message of each kind, every bit of it, at both ends, but for those that the spec calls unprotected.
    What a reader keeps of a message that never ends may cost the next one, never more."""
    if case.spec.bus != "serial":
        why = (
            "its transfers have no checksum"
            if case.spec.bus == "i2c"
            else "its controller drops damaged frames"
        )
        raise Inapplicable(f"the spec's bus is {case.spec.bus}: {why}")
    one, other = _running(case), _running(case)
    for downward in (True, False):
        for frame in _one_of_each_kind(case, downward):
            damaged = list(_each_bit_flipped(frame))
            try:
                _change_nothing(case, one, other, damaged, downward)
            except Failure as failure:

                def fails(some: Sequence[bytes], downward: bool = downward) -> bool:
                    try:
                        _change_nothing(case, _running(case), _running(case), some, downward)
                    except Failure:
                        return True
                    return False

                few = tools.fewest(damaged, fails) if fails(damaged) else damaged[:1]
                raise Failure(failure.text, (frame, *few), failure.messages) from failure


def _running(case: Case) -> Bench:
    return case.armed() or case.start()


def _one_of_each_kind(case: Case, downward: bool) -> list[bytes]:
    """Return one message of each kind (down: name, up: length), the shortest first."""
    frames = [frame for step in case.baseline for frame in (step.down if downward else step.up)]
    stream = [f for f in frames if isinstance(f, bytes) and f and noise.protected(case, f)]
    kinds = {(len(f), *(case.plugin.messages(f) if downward else ())): f for f in reversed(stream)}
    chosen = [kinds[kind] for kind in sorted(kinds)]
    return chosen[:: max(-(-len(chosen) // KINDS), 1)]


def _each_bit_flipped(frame: bytes) -> Iterator[bytes]:
    bits: Sequence[int] = range(8 * len(frame))
    if len(frame) > LONGEST:
        bits = [*bits[: 4 * LONGEST], *bits[-4 * LONGEST :]]
    for bit in bits:
        yield noise.flipped(frame, bit)


def _change_nothing(case: Case, one: Bench, other: Bench, damaged: Sequence[bytes], downward: bool) -> None:
    """Give one of two equal benches damaged messages as well: soon after the two are equal again."""
    for frame in damaged:
        _has_no_effect(other, downward, frame)
    messages = [tools.build(kind, name, case.spec.ranges) for kind in case.kinds[:1] for name in NAMES]
    settled = SETTLED if case.spec.line == "free" else SETTLED_ON_LINE
    for step in range(settled + COMPARED):
        left, right = one.step(messages), other.step(messages)
        if step >= settled and replace(left, due=()) != replace(right, due=()):
            raise difference(left, right, "without", "with a message in which one bit is wrong")


def _has_no_effect(bench: Bench, downward: bool, damaged: bytes) -> None:
    """Pass a damaged message to one end."""
    if not downward:
        events = bench.driver.receive(bench.now, damaged)
        if events:
            raise Failure("one bit is wrong, and yet something is reported", (damaged,), events)
        return
    messages = bench.decoder.decode(bench.now, damaged)
    for twin in bench.twins:
        twin.receive(bench.now, damaged)
    if messages:
        raise Failure("one bit is wrong, and yet it is obeyed", (damaged,), messages)
