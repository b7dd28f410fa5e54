"""Checksums: a message on a stream in which one bit is wrong tells nothing, moves nothing, changes nothing.

Rules. One message of each kind that was seen, every bit of it, at both ends, but for those that the spec
calls unsealed. What a reader keeps of a message that never ends may cost the next one, never more: sound
messages follow, and then all is as it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from protocols.conformance import bench as play
from protocols.conformance import noise
from protocols.conformance.bench import NAMES, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, by_name, difference
from protocols.messages import Command, Idle, Request

KINDS = 12
"""Different messages of each direction that are damaged."""
LONGEST = 120
"""Bytes of a message of which every bit is tried; of a longer one, so many bytes at both ends together."""
SETTLED = 20
"""Steps after which a reader has forgotten a message that did not end."""
WATCHED = 5
"""Steps that are compared then."""


def bad_checksums_change_nothing(case: Case) -> Verdict:
    """No single wrong bit gets past driver, ear or device."""
    if case.spec.bus != "serial":
        return Inapplicable(f"the spec's bus is {case.spec.bus}: its controller drops damaged frames")
    one, other = _running(case), _running(case)
    for downward in (True, False):
        for frame in _kinds(case, downward):
            damaged = list(_each_bit(frame))
            failure = _tried(case, one, other, damaged, downward)
            if failure is None:
                continue

            def fails(some: Sequence[bytes], down: bool = downward) -> bool:
                return _tried(case, _running(case), _running(case), some, down) is not None

            few = play.fewest(damaged, fails) if fails(damaged) else damaged[:1]
            return replace(failure, frames=(frame, *few))
    return None


def _kinds(case: Case, downward: bool) -> list[bytes]:
    """One message of each kind (down: name, up: length), the shortest first."""
    frames = [frame for said in case.day for frame in (said.down if downward else said.up)]
    stream = [frame for frame in frames if isinstance(frame, bytes) and frame and noise.sealed(case, frame)]
    kinds = {(len(w), *(case.plugin.messages(w) if downward else ())): w for w in reversed(stream)}
    chosen = [kinds[kind] for kind in sorted(kinds)]
    return chosen[:: max(-(-len(chosen) // KINDS), 1)]


def _each_bit(frame: bytes) -> Iterator[bytes]:
    bits: Sequence[int] = range(8 * len(frame))
    if len(frame) > LONGEST:
        bits = [*bits[: 4 * LONGEST], *bits[-4 * LONGEST :]]
    for bit in bits:
        yield noise.flipped(frame, bit)


def _tried(case: Case, one: Bench, other: Bench, damaged: Sequence[bytes], downward: bool) -> Failure | None:
    """Of two rehearsals alike the other gets damaged messages besides: they tell nothing, and soon after
    the two are alike again."""
    for frame in damaged:
        failure = _nothing(other, downward, frame)
        if failure:
            return failure
    words = _said(case)
    for step in range(SETTLED + WATCHED):
        left, right = one.step(words), other.step(words)
        if step >= SETTLED and replace(left, due=()) != replace(right, due=()):
            return difference(left, right, "without", "with a message in which one bit is wrong")
    return None


def _running(case: Case) -> Bench:
    return case.armed() or case.start()


def _said(case: Case) -> list[Command | Request]:
    """What is said while messages are damaged: a gentle command, if there is one."""
    kinds = by_name(case.spec.commands - {Idle})
    return [play.gentle(kinds[0], case.spec.ranges)(name) for name in NAMES] if kinds else []


def _nothing(stage: Bench, downward: bool, damaged: bytes) -> Failure | None:
    """A damaged message reaches one end; what that end makes of it."""
    if not downward:
        events = tuple(stage.driver.receive(stage.now, damaged))
        return Failure("one bit is wrong, and yet it tells something", (damaged,), events) if events else None
    words = tuple(stage.decoder.decode(stage.now, damaged))
    for twin in stage.twins:
        twin.receive(stage.now, damaged)
    return Failure("one bit is wrong, and yet it is obeyed", (damaged,), words) if words else None
