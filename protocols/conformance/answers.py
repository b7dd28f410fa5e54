"""Requests are answered: each once, under its own name, with a reason if it is refused, and in whole words.

Rules. Asked are the requests that the spec lists, of alpha, then of alpha and beta at once, and those that it
does not list, which must be refused; at last all at once of an alpha that has fallen silent, by a host that
calls its driver only when that is due: what nobody answers is given up. Parameters have the names that the
ear hears in the plugin's vectors. A word is whole if each of its fields is of the kind that `protocols.messages`
declares, if it is about a device that there is, and if its time has come.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from protocols import messages as msg
from protocols.conformance import bench as play
from protocols.conformance.bench import NAMES, START, Bench, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, by_name
from protocols.conformance.fault_injection import scene
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Message, Nanos, Request
from protocols.plugin import Device
from protocols.reference_vectors import vectors_of

ALPHA = NAMES[0]
KNOWN = 1200
"""Steps after which a driver knows its devices."""
PATIENCE = 8000
"""Steps in which a request must be answered, but for Home, which may take a way."""
RESTART = 4000
"""Steps more that a device may be awaited after Reboot."""
OVERDUE: Nanos = 20 * MILLISECOND
"""What is due may wait for its turn so long, where the driver is called each millisecond."""
AFTER = 60
"""Steps in which nothing may be answered a second time."""
NOBODY = 987_654_321
"""A serial number that no device has."""
SPARED = (msg.Scan, msg.ReadParameter, msg.ClearFault, msg.Estop)
"""What may be done without a word to a device, since nothing is in fault or moves, or in other words."""
LINE_REQUESTS = (msg.Scan, msg.SetId)
MOTOR_REQUESTS = (msg.ClearFault, msg.Estop, msg.Zero, msg.Home, msg.Reboot)
ALL_REQUESTS = (*LINE_REQUESTS, *MOTOR_REQUESTS, msg.ReadParameter, msg.WriteParameter)
HINTS: dict[type, dict[str, Any]] = {kind: get_type_hints(kind) for kind in get_args(Message)}


def requests_are_answered(case: Case) -> Verdict:
    """Each request has one answer; all that is told and heard is whole."""
    for said in case.day:
        for word in (*said.events, *said.received):
            if wrong := broken(word, said.now):
                return Failure(wrong, said.down, (word,))
        if said.due[0] is not None and said.due[0] < said.now - OVERDUE:
            return Failure(f"called at {said.now}, the driver says it was due at {said.due[0]}", said.down)
    if not case.spec.requests:
        return Inapplicable("the spec lists no requests")
    stage = case.start()
    stage.steps(KNOWN)
    found: list[msg.Found] = []
    for words in _asked(case, found):
        failure = _answered(stage, words, found, case)
        if failure:
            return failure
    return _given_up(case)


def _given_up(case: Case) -> Failure | None:
    """None if all that is asked of a silent device is answered by the driver."""
    on = scene(case, len(NAMES))
    on.stage.steps(KNOWN)
    on.cables[ALPHA].up = on.cables[ALPHA].down = False
    on.stage.step()
    on.host.lazy = True
    kinds = [kind for kind in by_name(case.spec.requests) if kind in ALL_REQUESTS]
    words = tuple(_request(kind, ALPHA) for kind in kinds if case.usual or kind is not msg.Reboot)
    failure = _answered(on.stage, words, [], case)
    return replace(failure, text=f"{ALPHA} is silent: {failure.text}") if failure else None


def _asked(case: Case, found: list[msg.Found]) -> Iterator[tuple[Request, ...]]:
    """What is asked in one step each; `found` fills while this goes on."""
    listed, names = case.spec.requests, [*parameters(case), "no such parameter"]
    for kind in (kind for kind in ALL_REQUESTS if kind not in listed):
        yield (_request(kind, ALPHA),)
    if msg.Scan in listed:
        yield (msg.Scan("bus"),)
    if msg.ReadParameter in listed:
        yield from ((msg.ReadParameter(ALPHA, name),) for name in names)
        yield tuple(msg.ReadParameter(name, names[0]) for name in NAMES)
    if msg.SetId in listed:
        yield (msg.SetId("bus", NOBODY, 9),)
        serials = [word.serial for word in found if word.address == case.addresses[0]]
        yield from ((msg.SetId("bus", serial, case.addresses[0]),) for serial in serials[:1] if serial)
    for kind in (kind for kind in by_name(listed) if kind in MOTOR_REQUESTS and kind is not msg.Reboot):
        yield (_request(kind, ALPHA),)
        yield tuple(_request(kind, name) for name in NAMES)
    if msg.WriteParameter in listed:
        yield from ((msg.WriteParameter(ALPHA, name, value),) for name in names for value in (1.0, math.nan))
    if msg.Reboot in listed:
        yield (msg.Reboot(ALPHA),)


def _request(kind: type[Request], motor: str) -> Request:
    word = play.request(kind, motor)
    return msg.WriteParameter(motor, "no such parameter", 1.0) if word is None else word


def parameters(case: Case) -> list[str]:
    """The names of parameters that an ear hears in the plugin's vectors, whichever device they are to."""
    names: dict[str, None] = {}
    listeners = list(_listeners(case))
    for vector in vectors_of(case.plugin):
        frame = vector.frame
        if vector.direction == "to_device" and not vector.wrong:
            serial = not isinstance(frame, CanFrame)
            meant = [
                device for sends, device in listeners if not isinstance(frame, CanFrame) or frame.id in sends
            ]
            for device in meant[: 16 if serial else 1]:
                received = case.plugin.decoder([device]).decode(START, frame)
                names.update(
                    (w.parameter, None)
                    for w in received
                    if isinstance(w, msg.ReadParameter | msg.WriteParameter)
                )
    return sorted(names)


def _listeners(case: Case) -> Iterator[tuple[frozenset[int], Device]]:
    """A device at each address that there is, and the ids that are sent to it."""
    for address in range(256):
        device = Device(ALPHA, address, case.options, case.plugin.settings())
        try:
            yield case.plugin.spec(device).sends, device
        except ValueError:
            continue


# -- one round ------------------------------------------------------------------------------------------


def _answered(stage: Bench, words: tuple[Request, ...], found: list[msg.Found], case: Case) -> Failure | None:
    """None if each of these requests, said in one step, is answered once, and nothing else is."""
    open_, frames, received = list(words), list[Frame](), list[Message]()
    patience = PATIENCE + (RESTART if any(isinstance(word, msg.Reboot) for word in words) else 0)
    for count in range(patience):
        said = stage.step(words if count == 0 else ())
        frames += [*said.down, *said.up] if len(frames) < 4 else []
        received += said.received
        found += [event for event in said.events if isinstance(event, msg.Found)]
        failure = _sorted_out(said, open_, words, case) or _unsaid(said, words, received)
        if failure:
            return failure
        if not open_:
            break
    late = [word for word in open_ if not isinstance(word, msg.Home)]
    if late:
        return Failure(f"not answered in {patience} ms", tuple(frames[:4]), tuple(late[:1]))
    for said in stage.steps(AFTER):
        failure = _sorted_out(said, [], words, case)
        if failure:
            return failure
    return None


def _sorted_out(
    said: StepResult, open_: list[Request], words: Sequence[Request], case: Case
) -> Failure | None:
    """Take what is answered in a step out of what is open."""
    for event in said.events:
        if wrong := broken(event, said.now):
            return Failure(wrong, said.down, (*words, event))
        if not isinstance(event, msg.Done | msg.Refused | msg.Parameter):
            continue
        answered = next((word for word in open_ if answers(event, word)), None)
        if answered is None:
            return Failure(
                "an answer to what nobody has asked, or a second one", said.up[:2], (*words, event)
            )
        if type(answered) not in case.spec.requests and not isinstance(event, msg.Refused):
            text = f"the spec does not list {type(answered).__name__}, and yet it is not refused"
            return Failure(text, said.down, (answered, event))
        open_.remove(answered)
    return None


def _unsaid(said: StepResult, words: Sequence[Request], received: Sequence[Message]) -> Failure | None:
    """A request to a device that is done, though no ear has heard it."""
    for event in (event for event in said.events if isinstance(event, msg.Done)):
        for word in words:
            if isinstance(word, SPARED) or not answers(event, word):
                continue
            if not any(_meant(word, each) for each in received):
                return Failure("done, and yet the ear has not heard it", said.down, (word, event))
    return None


def _meant(said: Request, received: Message) -> bool:
    """Whether what an ear heard is what was said; a bus has no name on the wire."""
    if isinstance(said, msg.WriteParameter) and isinstance(received, msg.WriteParameter):
        same = (said.motor, said.parameter) == (received.motor, received.parameter)
        return same and math.isclose(said.value, received.value, rel_tol=1e-6, abs_tol=1e-6)
    if isinstance(said, msg.SetId) and isinstance(received, msg.SetId):
        return (said.serial, said.address) == (received.serial, received.address)
    return said == received


def answers(event: msg.Done | msg.Refused | msg.Parameter, word: Request) -> bool:
    """Whether an event is an answer to this request."""
    about = getattr(word, "motor", getattr(word, "bus", ""))
    if isinstance(event, msg.Parameter):
        return isinstance(word, msg.ReadParameter) and (event.motor, event.parameter) == (
            about,
            word.parameter,
        )
    return event.request == type(word).__name__ and event.name == about


# -- whole words ----------------------------------------------------------------------------------------


def broken(word: Message, now: Nanos) -> str:
    """What is wrong with the form of a word that was told or heard at `now`, or ""."""
    hints = HINTS[type(word)]
    for f in fields(word):
        value = getattr(word, f.name)
        if not _fits(value, hints[f.name]):
            return f"{f.name} is {value!r}, and should be {_said(hints[f.name])}"
    for name in ("motor", "sensor"):
        if getattr(word, name, ALPHA) not in NAMES:
            return f"there is no {name} of this name"
    time = getattr(word, "t", now)
    if not START <= time <= now:
        return f"its time is {time}; it was told at {now}, and nothing was before {START}"
    if isinstance(word, msg.Refused) and not word.reason.strip():
        return "refused without a reason"
    if isinstance(word, msg.Done | msg.Refused) and word.request not in {
        kind.__name__ for kind in ALL_REQUESTS
    }:
        return "an answer to no request that there is"
    return ""


def _fits(value: object, hint: Any) -> bool:  # noqa: ANN401 -- any annotation
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        if not isinstance(value, tuple) or (parts[-1] is not Ellipsis and len(value) != len(parts)):
            return False
        return all(_fits(item, parts[0]) for item in value)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return isinstance(value, hint)
    return type(value) is hint


def _said(hint: Any) -> str:  # noqa: ANN401 -- any annotation
    parts = [part.__name__ for part in get_args(hint) if part is not NoneType and isinstance(part, type)]
    return " or ".join(parts) or str(getattr(hint, "__name__", hint))
