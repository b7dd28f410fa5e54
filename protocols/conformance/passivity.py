"""Passivity: foreign traffic has no effect, and a driver sends only what it may, when it may."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from protocols.asked import Asked, Reported
from protocols.conformance import bench as tools
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, STRANGER, Bench, Messages
from protocols.conformance.case import Case, Failure, Inapplicable, among, counts, difference
from protocols.frames import OF_BYTES, CanFrame, Frame, IdMask, any_matches
from protocols.messages import Command, Estop, Idle, Obeyed, Request, Scan
from protocols.plugin import Spec

ENDED = 20
"""Steps within which the answer that is under way on a line has come."""
WATCHED = 800
"""Steps for which a driver is watched."""


def foreign_traffic_changes_nothing(case: Case) -> None:
    """Another device with its own host, unknown ids and other kinds of frame are counted, and no more.

    What the spec lists in `receives_also` is left out of what that host sends: a driver may report it."""
    spec, sends, expects = case.spec, case.sends, case.expects
    if case.says_nothing_unasked:
        raise Inapplicable("the spec's line is asked, and answers do not say whose they are: it has one host")
    try:
        stranger = case.stranger()
    except ValueError as error:
        if spec.bus not in OF_BYTES:
            raise
        raise Inapplicable(f"no other device can be on its line: {error}") from error
    alone, crowded = case.start(), case.start()
    counter = case.stranger().driver
    foreign, count, waiting = _foreign(case), 0, list[Frame]()
    ours = {frame for step in case.baseline for frame in step.down}
    for at, messages in enumerate(tools.script(spec, case.names)):
        if spec.line != "free":  # a stranger's answer while its address is asked would be one to that
            messages = tuple(each for each in messages if not isinstance(each, Scan))
        theirs = stranger.step(_theirs(messages))
        can = [*_without(theirs.down, spec.receives_also), *theirs.up] if spec.bus not in OF_BYTES else []
        extra = [foreign[at % len(foreign)]] if at % 5 == 0 else []
        up, down = _without(can or theirs.up, expects), _without(can or theirs.down, sends)
        if isinstance(crowded.driver, tools.OnLine):
            # On its line, a host's question is the only one: what comes meanwhile comes when it is answered.
            waiting += up
            up, waiting = ([], waiting) if crowded.driver.line.out is not None else (waiting, [])
        if spec.line == "asked":  # what has no address is not a stranger's
            down = [frame for frame in down if frame not in ours]
        one, other = alone.step(messages), crowded.step(messages, [*up, *extra], down)
        if one != other:
            raise difference(one, other, "alone", "among strangers", (*up, *extra, *down)[:4])
        for frame in up:
            counter.receive(crowded.now, frame)
        count += len(extra) + (len(up) if spec.bus not in OF_BYTES else 0)
    for bench in (alone, crowded):
        bench.steps(ENDED)  # what a line holds may be part of an answer: its driver has not been given it
    count += sum(counts(counter.counters)) if spec.bus in OF_BYTES else 0
    counters, base = counts(crowded.driver.counters), counts(alone.driver.counters)
    accepted = counters[0] - base[0]
    # A driver may accept a stranger's answer to a scan, as long as it reports nothing.
    if counters[1] != base[1] or sum(counters) != sum(base) + count or not 0 <= accepted <= count // 100:
        text = f"(accepted, malformed, ignored) is {base} alone, {counters} with {count} foreign frames"
        raise Failure(text, foreign[:2])


def _without(frames: Sequence[Frame], ids: Sequence[IdMask]) -> list[Frame]:
    """Return the frames that are not CAN frames of these ids."""
    return [frame for frame in frames if not (isinstance(frame, CanFrame) and any_matches(ids, frame))]


def _theirs(messages: Messages) -> list[Command | Request]:
    """Return what a stranger's host is given: the same for its own motor, nothing for all."""
    first: list[Any] = [message for message in messages[:1] if hasattr(message, "motor")]
    return [replace(message, motor=STRANGER) for message in first]


def _foreign(case: Case) -> list[Frame]:
    """Return frames of no device: of another kind, of unknown ids, and of known ids in the other format or
    of 29 bits with another bit."""
    if case.spec.bus in OF_BYTES:
        return [CanFrame(1, b"\1\2"), CanFrame(0x12345678, b"", extended=True)]
    random, known = case.random(), (*case.sends, *case.expects)
    free = [i for i in (random.bits(11) for _ in range(200)) if not any_matches(known, i)][:8]
    turned = random.shuffled(noise.other_format(case))[:8]
    unknown = [CanFrame(i, random.bytes(8)) for i in free]
    return [b"\1\2\3", *unknown, *turned, *noise.other_ids(case)]


def uncommanded_is_read_only(case: Case) -> None:
    """Before the first command other than Idle, a driver sends only what the spec calls read-only.

    To devices as delivered, to running ones that another host left, and to faulty ones. A sensor, which is
    never commanded, may also be sent what stops it, and what its spec declares as set-up."""
    for what, bench in _benches(case):
        for count in range(case.share(WATCHED)):
            idle = case.spec.commands and count % 3 == 0
            step = bench.step([Idle(name) for name in NAMES] if idle else [])
            for frame in step.down:
                if not read_only(bench.specs, frame):
                    received = case.plugin.decoder(bench.devices).decode(step.now, frame)
                    if case.spec.kind == "sensor" and _is_declared(bench, received):
                        continue
                    raise Failure(f"sent before the first command, to devices {what}", (frame,), received)


def _is_declared(bench: Bench, received: Sequence[Obeyed]) -> bool:
    asked = Asked({device.name: spec for device, spec in zip(bench.devices, bench.specs, strict=True)})
    return bool(received) and not any(asked.objection(bench.now, each, Reported()) for each in received)


def _benches(case: Case) -> Iterator[tuple[str, Bench]]:
    """Yield a new driver with devices in different states."""
    yield "as delivered", case.start()
    if case.spec.kind != "motor":
        return
    running = case.armed()
    if running is not None:
        running.driver, running.decoder = case.start().driver, case.start().decoder
        yield "that run", running
    faulty = case.armed()
    if faulty is not None and Estop in case.spec.requests:
        faulty.step([Estop(name) for name in NAMES])
        faulty.steps(300)
        faulty.driver, faulty.decoder = case.start().driver, case.start().decoder
        yield "in fault", faulty


def read_only(specs: Sequence[Spec], frame: Frame) -> bool:
    """True if each device that a frame is for calls it read-only."""
    concerned = [spec for spec in specs if among(spec.sends, frame)]
    return bool(concerned) and all(spec.read_only(frame) for spec in concerned)


def only_declared_frames(case: Case) -> None:
    """All frames in both directions are of the bus's kind, and of an id that the spec lists."""
    for messages, step in zip(tools.script(case.spec, case.names), case.baseline, strict=True):
        for sender, frames, ids in (("driver", step.down, case.sends), ("device", step.up, case.expects)):
            for frame in frames:
                wrong = _undeclared(case.spec, frame, ids)
                if wrong:
                    raise Failure(f"the {sender} sends {wrong}", (frame,), messages)


def _undeclared(spec: Spec, frame: Frame, ids: Sequence[IdMask]) -> str:
    """Return what is wrong with a frame that was sent, "" if nothing."""
    if spec.bus in OF_BYTES:
        return "" if isinstance(frame, bytes) and frame else "something other than bytes"
    if not isinstance(frame, CanFrame):
        return "something other than a CAN frame"
    if frame.fd and spec.bus != "canfd":
        return "a CAN FD frame on a classic bus"
    if len(frame.data) > (64 if frame.fd else 8) or (frame.remote and (frame.data or frame.fd)):
        return "an impossible frame"
    if not frame.extended and frame.id > 0x7FF:
        return "an id that is too long for its format"
    return "" if any_matches(ids, frame) else f"an id that the spec does not list: {frame.id:#x}"
