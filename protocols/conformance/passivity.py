"""Manners: who may speak to whom, and what must not be said at all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, STRANGER, Bench
from protocols.conformance.case import Case, Failure, Verdict, by_name, counts, difference
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Estop, Event, Feedback, Idle, Request
from protocols.plugin import Spec

LOOK = 800
"""Steps for which a driver is watched."""


def strangers_change_nothing(case: Case) -> Verdict:
    """Another device with its own host, unknown ids and other kinds of wire are counted, and no more.

    What the spec overhears is left out of what that host says: of a second host a driver may tell."""
    spec, sends, expects = case.spec, case.sends, case.expects
    alone, crowded, stranger = case.start(), case.start(), case.stranger()
    counter = case.stranger().driver
    odd, count = _odd(case), 0
    for at, words in enumerate(play.script(spec, NAMES)):
        theirs = stranger.step(_theirs(words))
        host = [frame for frame in theirs.down if not _overheard(spec, frame)]
        can = [*host, *theirs.up] if spec.bus != "serial" else []
        extra = [odd[at % len(odd)]] if at % 5 == 0 else []
        up = [w for w in can or theirs.up if not (isinstance(w, CanFrame) and w.id in expects)]
        down = [w for w in can or theirs.down if not (isinstance(w, CanFrame) and w.id in sends)]
        one, other = alone.step(words), crowded.step(words, [*up, *extra], down)
        if one != other:
            return difference(one, other, "alone", "among strangers", (*up, *extra, *down)[:4])
        for frame in up:
            counter.receive(crowded.now, frame)
        count += len(extra) + (len(up) if spec.bus != "serial" else 0)
    count += sum(counts(counter.counters)) if spec.bus == "serial" else 0
    counters, base = counts(crowded.driver.counters), counts(alone.driver.counters)
    understood = counters[0] - base[0]
    # A driver may well understand a stranger's answer to a discovery, as long as it tells nothing.
    if counters[1] != base[1] or sum(counters) != sum(base) + count or not 0 <= understood <= count // 100:
        text = f"(heard, bad, foreign) is {base} alone, {counters} with {count} foreign wires besides"
        return Failure(text, tuple(odd[:2]))
    return None


def _overheard(spec: Spec, frame: Frame) -> bool:
    return isinstance(frame, CanFrame) and any(frame.id & mask == bits for bits, mask in spec.receives_also)


def _theirs(words: Sequence[Command | Request]) -> list[Command | Request]:
    """What a stranger's host says: the same to its own motor, nothing to all."""
    named: list[Any] = [word for word in words[:1] if hasattr(word, "motor")]
    return [replace(word, motor=STRANGER) for word in named]


def _odd(case: Case) -> list[Frame]:
    """Wires that are nobody's: of another kind, of unknown ids, and known ids in the other format."""
    if case.spec.bus == "serial":
        return [CanFrame(1, b"\1\2"), CanFrame(0x12345678, b"", extended=True)]
    random, known = case.random(), case.sends | case.expects
    free = [i for i in (random.bits(11) for _ in range(200)) if i not in known][:8]
    turned = random.shuffled(noise.other_format(case))[:8]
    return [b"\1\2\3", *(CanFrame(i, random.bytes(8)) for i in free), *turned]


def uncommanded_is_read_only(case: Case) -> Verdict:
    """Before the first command other than Idle, a driver says only what the spec calls read-only.

    To devices as they come out of the box, to running ones that another host left, and to faulty ones."""
    for what, stage in _found(case):
        for count in range(case.part(LOOK)):
            idle = case.spec.commands and count % 3 == 0
            said = stage.step([Idle(name) for name in NAMES] if idle else [])
            for frame in said.down:
                if not harmless(stage.specs, frame):
                    received = tuple(case.plugin.decoder(stage.devices).decode(said.now, frame))
                    return Failure(f"an unclaimed driver, to devices {what}", (frame,), received)
    return None


def _found(case: Case) -> Iterator[tuple[str, Bench]]:
    """A fresh driver before devices in different states."""
    yield "as they come", case.start()
    if case.spec.kind != "motor":
        return
    armed = case.armed()
    if armed is not None:
        armed.driver, armed.decoder = case.start().driver, case.start().decoder
        yield "that run", armed
    faulty = case.armed()
    if faulty is not None and Estop in case.spec.requests:
        faulty.step([Estop(name) for name in NAMES])
        faulty.steps(300)
        faulty.driver, faulty.decoder = case.start().driver, case.start().decoder
        yield "in fault", faulty


def harmless(specs: Sequence[Spec], frame: Frame) -> bool:
    """Whether each device that a wire is for calls it read-only."""
    concerned = [spec for spec in specs if not isinstance(frame, CanFrame) or frame.id in spec.sends]
    return bool(concerned) and all(spec.read_only(frame) for spec in concerned)


def only_declared_frames(case: Case) -> Verdict:
    """All that goes out or comes in is of the bus's kind, and of an id that the spec lists."""
    spec, sends, expects = case.spec, case.sends, case.expects
    for words, said in zip(play.script(spec, NAMES), case.day, strict=True):
        for who, frames, ids in (("driver", said.down, sends), ("device", said.up, expects)):
            for frame in frames:
                wrong = _undeclared(spec, frame, ids)
                if wrong:
                    return Failure(f"the {who} says {wrong}", (frame,), tuple(words))
    return None


def _undeclared(spec: Spec, frame: Frame, ids: frozenset[int]) -> str:
    """What is wrong with a wire that somebody said, or ""."""
    if spec.bus == "serial":
        return "" if isinstance(frame, bytes) and frame else "what is no run of bytes"
    if not isinstance(frame, CanFrame):
        return "what is no CAN frame"
    if frame.fd and spec.bus != "canfd":
        return "a CAN FD frame on a classic bus"
    if len(frame.data) > (64 if frame.fd else 8) or (frame.remote and (frame.data or frame.fd)):
        return "a frame that cannot be"
    if not frame.extended and frame.id > 0x7FF:
        return "an id that is too long for its format"
    return "" if frame.id in ids else f"an id that the spec does not list: {frame.id:#x}"


def nothing_non_finite(case: Case) -> Verdict:
    """NaN, infinities and what lies outside the range put no wire out, and none of them comes up."""
    for failure in (*_down(case), *_up(case)):
        return failure
    return None


def _down(case: Case) -> Iterator[Failure]:
    """Of two drivers alike one is told a bad command: it must say what the other says unasked.

    First while unclaimed, then armed and running."""
    spec = case.spec
    for make in (case.start, case.armed):
        for kind in by_name(spec.commands):
            bad = list(_bad(kind, spec))
            one, other = make(), make()
            if not bad or one is None or other is None:
                continue
            good = [play.gentle(kind, spec.ranges)(name) for name in NAMES] if make == case.armed else []
            for word in bad:
                quiet, reported = one.step(good[1:]), other.step([word, *good[1:]])
                if quiet.down != reported.down:
                    new = tuple(frame for frame in reported.down if frame not in quiet.down)
                    yield Failure("a number that must not pass put something on the wire", new, (word,))
                    return
                if one.step(good).down != other.step(good).down:
                    yield Failure("a number that must not pass changed what was said next", (), (word,))
                    return


def _bad(kind: type[Command], spec: Spec) -> Iterator[Command]:
    """Commands of this kind with one number that must not pass."""
    calm: Any = play.gentle(kind, spec.ranges)(NAMES[0])
    for name, key in play.numbers(kind, spec.ranges):
        bounds = spec.ranges[key]
        beyond = 1.0 + 0.01 * max(abs(bounds.low), abs(bounds.high))
        values = [math.nan, math.inf, -math.inf, bounds.high + beyond, bounds.low - beyond, 1e300, -1e300]
        for value in values:
            if not bounds.low <= value <= bounds.high:
                yield replace(calm, **{name: value})


def _up(case: Case) -> Iterator[Failure]:
    """Real wires with NaN and infinities patched in, and devices that measure such."""
    stage = case.armed() or case.start()
    for frame in case.random().shuffled(noise.conversation(case))[: case.part(120)]:
        for mad in _patched(frame):
            for event in stage.driver.receive(stage.now, mad):
                if not play.finite(event):
                    yield Failure("a number that is not finite came up", (mad,), (event,))
                    return
    stage = case.start()
    for value in (math.nan, math.inf, -math.inf):
        shown: list[Event] = [Feedback(name, stage.now, value, value) for name in NAMES]
        shown += [word for name in NAMES for word in _mad_sights(name, stage.now, value)]
        for step in [stage.step(truth=shown) for _ in range(30)]:
            for event in step.events:
                if not play.finite(event):
                    yield Failure("a number that is not finite came up", step.up[:2], (event,))
                    return


def _patched(frame: Frame) -> Iterator[Frame]:
    """A wire with each strange number at each place of its first 64 bytes."""
    data = play.data_of(frame)
    for number in noise.STRANGE:
        for at in range(min(len(data), 64) - len(number) + 1):
            yield play.with_data(frame, data[:at] + number + data[at + len(number) :])


def _mad_sights(sensor: str, t: int, value: float) -> list[Event]:
    imu, scan, fix = play.sights(sensor, t, 1)
    return [
        replace(imu, angular_velocity=(0.0, value, 0.0)),
        replace(imu, linear_acceleration=(value, 0.0, 0.0)),
        replace(scan, ranges=(1.0, value, 1.0)),
        replace(scan, range_max=value),
        replace(fix, altitude=value),
    ]
