"""Requests are answered: each once, by its own name, with a reason if it is refused, in well-formed events.

Rules. Made are the requests that the spec lists, of alpha, then of alpha and beta at once, and those that it
does not list, which must be refused; at last all at once of an alpha that has fallen silent, by a host that
calls its driver only when that is due: a request that no device answers must be given up. Names of parameters
are those that the decoder decodes in the plugin's vectors. A message is well-formed if each of its fields has
the type that `protocols.messages` declares, if its device exists, and if its time is not in the future.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from protocols import messages as msg
from protocols import sensors
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, NAMES, START, Bench, StepResult
from protocols.conformance.case import Case, Failure, Inapplicable, all_devices, among, by_name
from protocols.conformance.fault_injection import make_rig
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Message, Nanos, Request
from protocols.plugin import Spec
from protocols.reference_vectors import vectors_of

KNOWN = 1200
"""Steps after which a driver knows its devices."""
ANSWERED = 8000
"""Steps within which a request must be answered, but for Home, which may take longer."""
RESTART = 4000
"""Steps more that a device may take after Reboot."""
OVERDUE: Nanos = 20 * MILLISECOND
"""How long a message that is due may wait for its turn, where the driver is called each millisecond."""
AFTER = 60
"""Steps in which no request may be answered again."""
UNKNOWN_SERIAL = 987_654_321
"""A serial number that no device has."""
NOT_DECODED = (msg.Scan, msg.ReadParameter, msg.ClearFault, msg.Estop)
"""Requests that may be done without being decoded: by other messages, or since nothing is to do."""
LISTED = 3
"""Parameters of the spec that are read."""
_ANSWERS = (msg.Done, msg.Refused, msg.Parameter)
MOTOR_REQUESTS = (msg.ClearFault, msg.Estop, msg.Zero, msg.Home, msg.Reboot)
ALL_REQUESTS = (
    msg.Scan,
    msg.SetId,
    msg.SetAddress,
    *MOTOR_REQUESTS,
    msg.ReadParameter,
    msg.WriteParameter,
)
HINTS: dict[type, dict[str, Any]] = {
    kind: get_type_hints(kind) for kind in (*get_args(Message), *(kind.message for kind in sensors.OURS))
}


def requests_are_answered(case: Case) -> None:
    """Each request has an answer; all events and decoded messages are well-formed."""
    for step in case.baseline:
        for message in (*step.events, *step.received):
            if wrong := ill_formed(message, step.now):
                raise Failure(wrong, step.down, (message,))
        if step.due[0] is not None and step.due[0] < step.now - OVERDUE:
            text = f"called at {step.now}, the driver returns that it was due at {step.due[0]}"
            raise Failure(text, step.down)
    if not case.spec.requests:
        raise Inapplicable("the spec lists no requests")
    bench = case.start()
    bench.steps(KNOWN)
    found: list[msg.Found] = []
    for requests in _requests(case, found):
        _must_answer(bench, requests, found, case)
    _must_give_up(case)
    if msg.SetAddress in case.spec.requests:
        _takes_its_address(case)


def _takes_its_address(case: Case) -> None:
    """A device that is given an address that is free is found there, one that is not is not given."""
    bench = case.start()
    bench.steps(KNOWN)
    taken = msg.SetAddress(ALPHA, bench.devices[-1].address)
    if not isinstance(_answer_to(bench, taken), msg.Refused):
        raise Failure("it is given an address that another device has", (), (taken,))
    given = msg.SetAddress(ALPHA, case.addresses[-1])
    answer = _answer_to(bench, given)
    if not isinstance(answer, msg.Done):
        raise Failure("it is not given an address that is free", (), (given, *((answer,) if answer else ())))
    there = (replace(bench.devices[0], address=given.address), *bench.devices[1:])
    bench.driver, bench.modes = tools.make_driver(case.plugin, there), {}
    events = [event for step in bench.steps(KNOWN) for event in step.events]
    if not any(isinstance(event, msg.Feedback) and event.motor == ALPHA for event in events):
        raise Failure("it is not found at its new address", (), (given,))


def _must_give_up(case: Case) -> None:
    """The driver itself answers all requests to a silent device."""
    rig = make_rig(case, len(NAMES))
    rig.wait(KNOWN)
    rig.cables[ALPHA].up = rig.cables[ALPHA].down = False
    rig.bench.step()
    rig.host.lazy = True
    kinds = [kind for kind in by_name(case.spec.requests) if kind in ALL_REQUESTS]
    requests = tuple(_request(kind, ALPHA) for kind in kinds if case.default or kind is not msg.Reboot)
    try:
        _must_answer(rig.bench, requests, [], case)
    except Failure as failure:
        text = f"{ALPHA} is silent: {failure.text}"
        raise Failure(text, failure.frames, failure.messages) from failure


def _requests(case: Case, found: list[msg.Found]) -> Iterator[tuple[Request, ...]]:
    """Yield the requests of one step each; `found` fills while this goes on."""
    listed, names = case.spec.requests, [*_parameters(case), "no such parameter"]
    for kind in (kind for kind in ALL_REQUESTS if kind not in listed):
        yield (_request(kind, ALPHA),)
    if msg.Scan in listed:
        yield (msg.Scan("bus"),)
    if msg.ReadParameter in listed:
        yield from ((msg.ReadParameter(ALPHA, name),) for name in names)
        yield tuple(msg.ReadParameter(name, names[0]) for name in NAMES)
    if msg.SetId in listed:
        yield (msg.SetId("bus", UNKNOWN_SERIAL, 9),)
        serials = [event.serial for event in found if event.address == case.addresses[0]]
        yield from ((msg.SetId("bus", serial, case.addresses[0]),) for serial in serials[:1] if serial)
    for kind in (kind for kind in by_name(listed) if kind in MOTOR_REQUESTS and kind is not msg.Reboot):
        yield (_request(kind, ALPHA),)
        yield tuple(_request(kind, name) for name in NAMES)
    if msg.WriteParameter in listed:
        yield from ((msg.WriteParameter(ALPHA, name, 1.0),) for name in names)
    if msg.Reboot in listed:
        yield (msg.Reboot(ALPHA),)


def _request(kind: type[Request], motor: str) -> Request:
    return tools.request(kind, motor) or msg.WriteParameter(motor, "no such parameter", 1.0)


def _parameters(case: Case) -> list[str]:
    """Return the names of parameters that are decoded in the plugin's vectors to any device."""
    names = set[str]()
    devices = list(all_devices(case, case.options))
    for vector in vectors_of(case.plugin):
        frame = vector.frame
        if vector.direction != "to_device" or vector.wrong:
            continue
        can = isinstance(frame, CanFrame)
        receivers = [d for d, spec in devices if among(spec.sends, frame)]
        for device in receivers[: 1 if can else 16]:
            for message in case.plugin.decoder([device]).decode(START, frame):
                if isinstance(message, msg.ReadParameter | msg.WriteParameter):
                    names.add(message.parameter)
    return sorted(names)


# -- one round ---------------------------------------------------------------------------------------------


def _must_answer(bench: Bench, requests: tuple[Request, ...], found: list[msg.Found], case: Case) -> None:
    """Each of these requests, made in one step, is answered once, and nothing else is. Raises Failure."""
    pending, frames, received = list(requests), list[Frame](), list[Message]()
    most = ANSWERED + (RESTART if any(isinstance(each, msg.Reboot) for each in requests) else 0)
    for count in range(most):
        step = bench.step(requests if count == 0 else ())
        frames += [*step.down, *step.up] if len(frames) < 4 else []
        received += step.received
        if arming := [message for message in step.received if isinstance(message, msg.Arm)]:
            raise Failure("a request arms", step.down, (*requests, *arming))
        found += [event for event in step.events if isinstance(event, msg.Found)]
        _take_answers(step, pending, requests, case)
        _check_done(step, requests, received, case)
        if not pending:
            break
    late = [each for each in pending if not isinstance(each, msg.Home)]
    if late:
        raise Failure(f"not answered within {most} ms", frames[:4], late[:1])
    for step in bench.steps(AFTER):
        _take_answers(step, [], requests, case)


def _take_answers(step: StepResult, pending: list[Request], requests: Sequence[Request], case: Case) -> None:
    """Remove what is answered in a step from the pending requests."""
    for event in step.events:
        if wrong := ill_formed(event, step.now):
            raise Failure(wrong, step.down, (*requests, event))
        if not isinstance(event, msg.Done | msg.Refused | msg.Parameter):
            continue
        answered = next((request for request in pending if _answers(event, request)), None)
        if answered is None and any(_answers(event, request) for request in requests):
            continue  # a second answer: the clause "once"
        if answered is None:
            raise Failure("an answer to no request", step.up[:2], (*requests, event))
        if type(answered) not in case.spec.requests and not isinstance(event, msg.Refused):
            text = f"the spec does not list {type(answered).__name__}, and yet it is not refused"
            raise Failure(text, step.down, (answered, event))
        pending.remove(answered)


def _check_done(
    step: StepResult, requests: Sequence[Request], received: Sequence[Message], case: Case
) -> None:
    """A request to a device that is done was decoded: as such, or as what the spec says that is written for
    it. Raises Failure."""
    for event in (event for event in step.events if isinstance(event, msg.Done)):
        for request in requests:
            if isinstance(request, NOT_DECODED) or not _answers(event, request):
                continue
            written = case.spec.writes.get(type(request), ())
            changes = [each for each in received if isinstance(each, msg.WriteParameter)]
            writes = any(each.motor == event.name and each.parameter in written for each in changes)
            if not writes and not any(_equivalent(request, each) for each in received):
                raise Failure("done, and yet it was not decoded", step.down, (request, event))


def _equivalent(made: Request, decoded: Message) -> bool:
    """True if a decoded message is the request that was made; frames do not carry the name of a bus."""
    if isinstance(made, msg.WriteParameter) and isinstance(decoded, msg.WriteParameter):
        same = (made.motor, made.parameter) == (decoded.motor, decoded.parameter)
        return same and math.isclose(made.value, decoded.value, rel_tol=1e-6, abs_tol=1e-6)
    if isinstance(made, msg.SetId) and isinstance(decoded, msg.SetId):
        return (made.serial, made.address) == (decoded.serial, decoded.address)
    return made == decoded


def _answers(event: msg.Done | msg.Refused | msg.Parameter, request: Request) -> bool:
    """True if an event is an answer to this request."""
    subject = getattr(request, "motor", getattr(request, "bus", ""))
    if isinstance(event, msg.Parameter):
        asked = isinstance(request, msg.ReadParameter) and request.parameter
        return asked == event.parameter and event.motor == subject
    return event.request == type(request).__name__ and event.name == subject


# -- exactly one answer ------------------------------------------------------------------------------------


def requests_are_answered_once(case: Case) -> None:
    """Each request has one answer; that of a parameter which the spec lists is its value."""
    spec = case.spec
    if not spec.requests:
        raise Inapplicable("the spec lists no requests")
    reads = msg.ReadParameter in spec.requests
    if reads and not spec.parameters:
        raise Failure("the spec lists ReadParameter, and no parameter that it reads")
    bench = case.start()
    bench.steps(KNOWN)
    names = [*spec.parameters[:LISTED], "no such parameter"] if reads else []
    kinds = [kind for kind in by_name(spec.requests) if kind in MOTOR_REQUESTS]
    requests: list[Request] = [msg.ReadParameter(ALPHA, name) for name in names]
    requests += [_request(kind, ALPHA) for kind in kinds if kind not in (msg.Home, msg.Reboot)]
    for request in requests:
        _must_answer_once(bench, request, spec)


def _must_answer_once(bench: Bench, request: Request, spec: Spec) -> None:
    answers: list[Message] = []
    left = ANSWERED
    for count in range(ANSWERED + AFTER):
        step = bench.step((request,) if count == 0 else ())
        answers += [e for e in step.events if isinstance(e, _ANSWERS) and _answers(e, request)]
        left = min(left - 1, AFTER) if answers else left - 1
        if not left:
            break
    if len(answers) > 1:
        raise Failure(f"it has {len(answers)} answers", (), (request, *answers))
    listed = isinstance(request, msg.ReadParameter) and request.parameter in spec.parameters
    if listed and not any(isinstance(answer, msg.Parameter) for answer in answers):
        raise Failure("the spec lists this parameter, and it is not read", (), (request, *answers))


# -- configuration -----------------------------------------------------------------------------------------


SAMPLE = 12
"""Parameters that are tried with one seed."""


def configuration_is_read_and_written(case: Case) -> None:
    """What is configured is read; another value, written where it is not protected, is read back."""
    if not case.spec.configuration:
        raise Inapplicable("the spec lists no configuration")
    bench = case.start()
    bench.steps(KNOWN)
    for name in case.random().shuffled([*case.spec.configuration])[:SAMPLE]:
        setting, held = case.spec.configuration[name], _value_of(bench, name)
        ends = [(held + max(-1e6, min(1e6, end))) / 2.0 for end in (setting.low, setting.high)]
        others = [each for each in (held + 1.0, held - 1.0, *ends) if setting.low <= each <= setting.high]
        written = [msg.WriteParameter(ALPHA, name, each) for each in others if not setting.protected]
        done = next((each for each in written if isinstance(_answer_to(bench, each), msg.Done)), None)
        if written and (done is None or not math.isclose(_value_of(bench, name), done.value, rel_tol=1e-6)):
            wrong = "no other value is accepted" if done is None else "what was written is not read back"
            raise Failure(f"{name} is configuration, and not protected: {wrong}", (), written)
        if done is not None:
            _answer_to(bench, msg.WriteParameter(ALPHA, name, held))


def _value_of(bench: Bench, name: str) -> float:
    answer = _answer_to(bench, msg.ReadParameter(ALPHA, name))
    if not isinstance(answer, msg.Parameter):
        raise Failure(f"{name} is listed as configuration, and is not read", (), (answer,) if answer else ())
    return answer.value


def _answer_to(bench: Bench, request: Request) -> msg.Done | msg.Refused | msg.Parameter | None:
    """Return the first answer to a request; None: none came."""
    for count in range(ANSWERED):
        for event in bench.step((request,) if count == 0 else ()).events:
            if isinstance(event, _ANSWERS) and _answers(event, request):
                return event
    return None


# -- well-formed messages ------------------------------------------------------------------------------------


def ill_formed(message: Message, now: Nanos) -> str:
    """Return what is wrong with the form of a message reported or decoded at `now`, "" if nothing."""
    hints = HINTS.get(type(message)) or get_type_hints(type(message))
    for f in fields(message):
        value = getattr(message, f.name)
        if not _fits(value, hints[f.name]):
            return f"{f.name} is {value!r}, and should be {_type_name(hints[f.name])}"
    for name in ("motor", "sensor"):
        if getattr(message, name, ALPHA) not in NAMES:
            return f"there is no {name} of this name"
    time = getattr(message, "t", now)
    if not START <= time <= now:
        return f"its time is {time}; it was reported at {now}, and nothing was before {START}"
    if isinstance(message, msg.Refused) and not message.reason.strip():
        return "refused without a reason"
    known = {kind.__name__ for kind in ALL_REQUESTS}
    if isinstance(message, msg.Done | msg.Refused) and message.request not in known:
        return "an answer to an unknown request"
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


def _type_name(hint: Any) -> str:  # noqa: ANN401 -- any annotation
    parts = [part.__name__ for part in get_args(hint) if part is not NoneType and isinstance(part, type)]
    return " or ".join(parts) or str(getattr(hint, "__name__", hint))
