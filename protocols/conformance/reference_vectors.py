"""Reference vectors: every message that moves a motor has bytes from an independent source.

Rules. A source is accepted if it names a version of a package, a commit, or a paragraph. A frame that is more
than read-only must hold named messages only, each of which has a vector to the device with that name. Vectors
are understood at both ends; what one records as a mistake is never sent. Addresses are the vectors' own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from protocols.conformance import bench as tools
from protocols.conformance.bench import Bench, OnLine
from protocols.conformance.case import Case, Failure, Inapplicable, all_devices, variants
from protocols.frames import OF_BYTES, CanFrame, Frame, any_matches
from protocols.line import Exchange
from protocols.messages import Command, Request
from protocols.plugin import Device, Plugin, Spec
from protocols.reference_vectors import Vector, vectors_of

SOURCE = re.compile(
    r"\d+\.\d+|@[0-9a-f]{7}|§|\b(CiA|DSP|ISO|IEC) ?\d|\b(manual|paragraph|chapter)\b", re.IGNORECASE
)
"""A version, a commit, or a place in a manual."""
KNOWN = 800
"""Steps after which a driver knows its devices."""


def motion_is_in_reference_vectors(case: Case) -> None:
    """Each message that is more than read-only has an independent vector; vectors are understood."""
    vectors = vectors_of(case.plugin)
    if not vectors and case.spec.kind == "sensor":
        raise Inapplicable("the spec's kind is sensor: nothing moves (and the plugin has no vectors)")
    right = [vector for vector in vectors if not vector.wrong]
    to_device = [vector for vector in right if vector.direction == "to_device"]
    _commanding_frames_have_vectors(case, to_device)
    _mistakes_are_not_sent(case, vectors)
    if case.default:
        _vectors_to_devices_are_valid(case, right)
        _vectors_from_devices_are_accepted(case, [v for v in right if v.direction == "from_device"])


# -- to the device ---------------------------------------------------------------------------------------


def _commanding_frames_have_vectors(case: Case, vectors: Sequence[Vector]) -> None:
    """There is a vector for each frame of the baseline that is more than read-only."""
    known = {name: v.frame for v in reversed(vectors) for name in case.plugin.messages(v.frame)}
    formats = {_format(vector.frame) for vector in vectors}
    for frame, given in _commanding(case):
        names = tuple(case.plugin.messages(frame))
        if not names:
            raise Failure("no read-only frame, and `messages` has no name for it", (frame,), given)
        for name in names:
            if name not in known:
                raise Failure(
                    f"not a read-only frame, and no vector of {name!r} to a device", (frame,), given
                )
            if _format(frame) not in formats:
                text = f"{name!r} in a kind of frame, or width of id, that no vector to a device has"
                raise Failure(text, (frame, known[name]), given)


def _format(frame: Frame) -> tuple[bool, ...]:
    """Return the width of the id and the kind of the frame."""
    return (frame.extended, frame.remote, frame.fd, frame.brs) if isinstance(frame, CanFrame) else ()


def _commanding(case: Case) -> Iterator[tuple[Frame, tuple[Command | Request, ...]]]:
    """Yield what the driver sends in the baseline that is not read-only, with the messages of its step."""
    seen = set[Frame]()
    for messages, step in zip(tools.script(case.spec, case.names), case.baseline, strict=True):
        for frame in step.down:
            if frame not in seen and not all(spec.read_only(frame) for spec in _receivers(case, frame)):
                yield frame, messages
            seen.add(frame)


def _receivers(case: Case, frame: Frame) -> Sequence[Spec]:
    """Return the specs of the devices that a frame may be for; all, where the frame has no id."""
    if not isinstance(frame, CanFrame):
        return case.specs
    return [spec for spec in case.specs if any_matches(spec.sends, frame)] or case.specs


def _mistakes_are_not_sent(case: Case, vectors: Sequence[Vector]) -> None:
    """The driver sends no frame that is recorded as a mistake."""
    wrong = {_body(v.frame): v for v in vectors if v.wrong and v.direction == "to_device"}
    right = {_body(v.frame) for v in vectors if not v.wrong}
    for step in case.baseline if wrong else ():
        for frame in step.down:
            vector = wrong.get(_body(frame))
            if vector and _body(frame) not in right:
                raise Failure(f"the driver sends what {vector.name} records as a mistake", (frame,))


def _body(frame: Frame) -> Frame:
    """Return a frame without its address, where that is not among its bytes."""
    if not isinstance(frame, CanFrame):
        return frame
    return CanFrame(0, frame.data, frame.extended, frame.remote, frame.fd, frame.brs)


def _vectors_to_devices_are_valid(case: Case, vectors: Sequence[Vector]) -> None:
    """Each vector has a source and the right bus; those to a device can be decoded and have a name."""
    decoder = case.start().decoder
    for vector in vectors:
        wrong = ""
        if not SOURCE.search(vector.source):
            wrong = (
                f"the source of vector {vector.name} names no version, commit or paragraph: {vector.source}"
            )
        elif (case.spec.bus in OF_BYTES) != isinstance(vector.frame, bytes):
            wrong = f"vector {vector.name} is of another kind of bus than the spec"
        elif vector.direction == "to_device":
            decoder.decode(tools.START, vector.frame)
            if not case.plugin.messages(vector.frame):
                wrong = f"`messages` has no name for vector {vector.name}"
        if wrong:
            raise Failure(wrong, (vector.frame,))


# -- from the device -------------------------------------------------------------------------------------


def _vectors_from_devices_are_accepted(case: Case, vectors: Sequence[Vector]) -> None:
    """Each vector is counted as accepted by a driver with some options."""
    left = {vector.name: vector for vector in vectors}
    every = [(options, list(all_devices(case, options))) for options in variants(case.plugin)]
    unexpected = (v.name for v in vectors if not any(_senders(each, v.frame) for _, each in every))
    for name in sorted(unexpected):
        raise Failure(f"no device would send vector {name}: no spec expects it", (left[name].frame,))
    for apart in (False, True):  # at last each alone: an earlier one may have changed the driver
        for options, devices in every:
            benches: dict[tuple[int, ...], Bench] = {}
            for vector in list(left.values()):
                if apart:
                    benches.clear()
                addresses = _senders(devices, vector.frame)
                if addresses and _accepted(benches, case.plugin, options, addresses, vector):
                    del left[vector.name]
        if not left:
            return
    vector = next(iter(left.values()))
    raise Failure(f"vector {vector.name} is not counted as accepted", (vector.frame,))


def _accepted(
    benches: dict[tuple[int, ...], Bench],
    plugin: Plugin,
    options: object,
    addresses: tuple[int, ...],
    vector: Vector,
) -> bool:
    """True if a driver that knows its devices counts a frame as accepted: if it does not say what it
    answers, as the answer to that."""
    if addresses not in benches:
        names = [f"m{address}" for address in addresses]
        benches[addresses] = tools.make_bench(plugin, options, addresses, names)
        benches[addresses].steps(KNOWN)
    driver = benches[addresses].driver
    driver = driver.driver if isinstance(driver, OnLine) else driver  # nobody has asked
    before, now = driver.counters.accepted, benches[addresses].now
    if vector.asked and isinstance(vector.frame, bytes):
        line: Any = driver
        line.answer(now, Exchange(vector.asked), vector.frame)
    else:
        driver.receive(now, vector.frame)
    return driver.counters.accepted == before + vector.count


def _senders(devices: Sequence[tuple[Device, Spec]], frame: Frame) -> tuple[int, ...]:
    """Return addresses of those that may send a frame: on CAN the first whose spec expects it."""
    if not isinstance(frame, CanFrame):
        return tuple(device.address for device, _ in devices)[:10]
    return tuple(device.address for device, spec in devices if any_matches(spec.expects, frame))[:1]
