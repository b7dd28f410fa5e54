"""Vectors: no message moves a motor that nobody else has vouched for.

Rules. A vector vouches for a message if its source says which version of a package, which commit or which
paragraph it is from. A wire that is more than read-only must hold named messages only, each of which has a
vector to the device with that name. Vectors are understood at both ends; what one records as somebody's
mistake is never sent. Addresses are the vectors' own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from protocols.conformance import bench as play
from protocols.conformance.bench import NAMES, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, variants
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Request
from protocols.plugin import Device, Plugin, Spec
from protocols.reference_vectors import Vector, vectors_of

SOURCE = re.compile(
    r"\d+\.\d+|@[0-9a-f]{7}|§|\b(CiA|DSP|ISO|IEC) ?\d|\b(manual|paragraph|chapter)\b", re.IGNORECASE
)
"""A version, a commit, or a place in a manual."""
KNOWN = 800
"""Steps after which a driver knows its devices."""
ADDRESSES = range(256)


def motion_is_in_reference_vectors(case: Case) -> Verdict:
    """Each message that is more than read-only has an independent vector; vectors are understood."""
    vectors = vectors_of(case.plugin)
    if not vectors and case.spec.kind == "sensor":
        return Inapplicable("the spec's kind is sensor: nothing moves (and the plugin brings no vectors)")
    right = [vector for vector in vectors if not vector.wrong]
    failure = _unvouched(case, right) or _mistaken(case, vectors)
    if failure:
        return failure
    if not case.usual:
        return None
    return _unsound(case, right) or _not_heard(case, [v for v in right if v.direction == "from_device"])


def _vouched(plugin: Plugin, right: Sequence[Vector]) -> dict[str, Frame]:
    """By the name of a message: a vector that holds it."""
    to_device = [vector.frame for vector in right if vector.direction == "to_device"]
    return {name: frame for frame in reversed(to_device) for name in plugin.messages(frame)}


def _unvouched(case: Case, right: Sequence[Vector]) -> Failure | None:
    """A wire of a busy day that is more than read-only, and for which no vector speaks."""
    vouched = _vouched(case.plugin, right)
    formats = {_format(vector.frame) for vector in right if vector.direction == "to_device"}
    for frame, words in _commanding(case):
        messages = tuple(case.plugin.messages(frame))
        if not messages:
            return Failure("no read-only wire, and one that `messages` has no name for", (frame,), words)
        for name in messages:
            if name not in vouched:
                return Failure(f"no read-only wire, and no vector of {name!r} to a device", (frame,), words)
            if _format(frame) not in formats:
                text = f"{name!r} in a kind of frame, or width of id, that no vector to a device has"
                return Failure(text, (frame, vouched[name]), words)
    return None


def _format(frame: Frame) -> tuple[bool, ...]:
    """Width of the id and kind of the frame."""
    return (frame.extended, frame.remote, frame.fd, frame.brs) if isinstance(frame, CanFrame) else ()


def _commanding(case: Case) -> Iterator[tuple[Frame, tuple[Command | Request, ...]]]:
    """What the driver says in a day that is not read-only, each wire once, with the words of its step."""
    seen = set[Frame]()
    for words, said in zip(play.script(case.spec, NAMES), case.day, strict=True):
        for frame in said.down:
            if frame not in seen and not all(spec.read_only(frame) for spec in _concerned(case, frame)):
                yield frame, words
            seen.add(frame)


def _concerned(case: Case, frame: Frame) -> Sequence[Spec]:
    """The specs of those whom a wire may be for; all, where the wire does not tell."""
    if not isinstance(frame, CanFrame):
        return case.specs
    return [spec for spec in case.specs if frame.id in spec.sends] or case.specs


def _mistaken(case: Case, vectors: Sequence[Vector]) -> Failure | None:
    """A wire of the driver's that is recorded as somebody's mistake."""
    wrong = {_body(v.frame): v for v in vectors if v.wrong and v.direction == "to_device"}
    if not wrong:
        return None
    right = {_body(v.frame) for v in vectors if not v.wrong}
    for said in case.day:
        for frame in said.down:
            vector = wrong.get(_body(frame))
            if vector and _body(frame) not in right:
                return Failure(f"the driver says what {vector.name} records as a mistake", (frame,))
    return None


def _body(frame: Frame) -> Frame:
    """A wire without its address, where that is not among its bytes."""
    return (
        CanFrame(0, frame.data, frame.extended, frame.remote, frame.fd, frame.brs)
        if isinstance(frame, CanFrame)
        else frame
    )


def _unsound(case: Case, right: Sequence[Vector]) -> Failure | None:
    """A vector without a source, of another bus, or that our names and ears do not know."""
    decoder = case.start().decoder
    for vector in right:
        if not SOURCE.search(vector.source):
            said = (
                f"the source of vector {vector.name} names no version, commit or paragraph: {vector.source}"
            )
            return Failure(said, (vector.frame,))
        if (case.spec.bus == "serial") != isinstance(vector.frame, bytes):
            return Failure(
                f"vector {vector.name} is of another kind of bus than the spec says", (vector.frame,)
            )
        if vector.direction == "to_device":
            decoder.decode(play.START, vector.frame)
            if not case.plugin.messages(vector.frame):
                return Failure(f"`messages` has no name for vector {vector.name}", (vector.frame,))
    return None


# -- from the device -----------------------------------------------------------------------------------


def _not_heard(case: Case, vectors: Sequence[Vector]) -> Failure | None:
    """A vector from a device that no driver, with whatever options, counts as heard."""
    left = {vector.name: vector for vector in vectors}
    lost = {vector.name for vector in vectors if not _holders(case.plugin, vector.frame)}
    for name in sorted(lost):
        return Failure(f"no device would say vector {name}: no spec expects it", (left[name].frame,))
    for apart in (False, True):  # at last each for itself: what was heard before may have changed the driver
        for options in variants(case.plugin):
            stages: dict[tuple[int, ...], Bench] = {}
            for vector in list(left.values()):
                if apart:
                    stages.clear()
                addresses = _holders(case.plugin, vector.frame, options)
                if addresses and _received(stages, case.plugin, options, addresses, vector.frame):
                    del left[vector.name]
        if not left:
            return None
    vector = next(iter(left.values()))
    return Failure(f"vector {vector.name} is not counted as heard", (vector.frame,))


def _received(
    stages: dict[tuple[int, ...], Bench],
    plugin: Plugin,
    options: Any,  # noqa: ANN401 -- the plugin's own
    addresses: tuple[int, ...],
    frame: Frame,
) -> bool:
    """Whether a driver that knows its devices counts a wire as heard."""
    if addresses not in stages:
        names = [f"m{address}" for address in addresses]
        stages[addresses] = play.make_bench(plugin, options, addresses, names)
        stages[addresses].steps(KNOWN)
    driver = stages[addresses].driver
    before = driver.counters.accepted
    driver.receive(stages[addresses].now, frame)
    return driver.counters.accepted == before + 1


def _holders(plugin: Plugin, frame: Frame, options: Any = None) -> tuple[int, ...]:  # noqa: ANN401
    """Addresses of devices that may say a wire: on CAN the first whose spec expects it."""
    found: list[int] = []
    for address in ADDRESSES:
        device = Device("m", address, plugin.options() if options is None else options, plugin.settings())
        try:
            spec = plugin.spec(device)
        except ValueError:
            continue
        if not isinstance(frame, CanFrame):
            found.append(address)
        elif frame.id in spec.expects:
            return (address,)
    return tuple(found[:10])
