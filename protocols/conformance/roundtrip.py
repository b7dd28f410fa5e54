"""Round trips: commands and measurements arrive within the declared resolution.

Rules. Samples lie densely around the limits of each number and sparsely between; the simplest come
first, so that the first that fails is short. Alpha and beta always get different numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from typing import Any

from protocols import messages as msg
from protocols import sensors
from protocols.bounds import bounds_of, hints
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, NAMES, STEP, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, alternatives, valid
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.messages import SECOND, Command, Event, Message, Mode, Nanos, Obeyed
from protocols.plugin import Device, Range, Spec

SANE = 1e5
"""rad, rad/s: no shaft is given more, whatever number a frame could carry."""
UNREACHED = 1e30
"""rad, rad/s: the ends of floating-point numbers are beyond it, and no shaft gets there."""
SCALED = 60
"""Steps with each command, by which scales are found."""
STEPS = 30
"""Steps within which a command must arrive."""


def commands_arrive(case: Case) -> None:
    """Every command is decoded as it was given, densely around the limits of each of its numbers."""
    spec, random = case.spec, case.random()
    if not spec.commands:
        raise Inapplicable("the spec lists no commands")
    for kind in case.kinds:
        samples = list(_samples(kind, spec.ranges, random))
        _all_arrive(case, kind, case.sample(samples))
        _synonyms_are_the_same(case, kind, samples)
    if msg.Idle in spec.commands and case.kinds:
        bench = _armed(case, tools.gentle(case.kinds[0], spec.ranges))
        failure = bench and _not_received(bench, spec, [msg.Idle(name) for name in NAMES])
        if failure:
            raise failure


def _all_arrive(case: Case, kind: type[Command], samples: list[dict[str, float]]) -> None:
    bench, spec = None, case.spec
    for at, values in enumerate(samples):
        # Beta gets the next sample: the two must not be confused.
        other = samples[(at + 1) % len(samples)]
        commands = [tools.exactly(kind, NAMES[0], values), tools.exactly(kind, NAMES[1], other)]
        if bench and not _not_received(bench, spec, commands):
            continue
        # A device may have gone into fault over the last sample: once more, on a new one.
        bench = _armed(case, tools.gentle(kind, spec.ranges))
        if bench is None:
            raise Failure(f"{kind.__name__} does not arm within {tools.ARMING} ms")
        failure = _not_received(bench, spec, commands)
        if failure:
            raise failure


def _armed(case: Case, make: Callable[[str], Command]) -> Bench | None:
    """Return alpha and beta, armed, with locked shafts; None if they do not arm."""
    bench = case.start()
    for shaft in bench.shafts.values():
        shaft.locked = True
    return bench if bench.arm(make) else None


def _not_received(bench: Bench, spec: Spec, commands: Sequence[Command]) -> Failure | None:
    """Return None if each command is decoded within STEPS, else what was decoded."""
    missing, frames, received = list(commands), list[Frame](), list[Message]()
    for _ in range(STEPS):
        step = bench.step(commands)
        missing = [c for c in missing if not any(obeyed(bench, spec, c, r) for r in step.received)]
        if not missing:
            return None
        frames += [f for f in step.down if f not in frames]
        received += [r for r in step.received if r not in received]
    motor = missing[0].motor
    last = [message for message in received if getattr(message, "motor", motor) == motor][-2:]
    decoded = " and ".join(map(str, last)) or "nothing"
    return Failure(f"given {missing[0]}, decoded {decoded}", frames[-4:], (missing[0], *last))


def obeyed(bench: Bench, spec: Spec, given: Command, received: Obeyed) -> bool:
    """True if a device that obeys `received` does what was given."""
    if not isinstance(received, Command):
        return False
    ranges = spec.ranges
    if isinstance(given, msg.Hold) and not isinstance(received, msg.Hold):
        # Many devices have no Hold: the driver then sends the position at which the shaft was measured.
        given = msg.Position(given.motor, bench.shafts[given.motor].position, torque=given.torque)
        key = f"{type(spec.canonical(given)).__name__}.position"
        measured = ranges.get("Feedback.position", Range(0.0, 0.0, 0.0))
        bounds = ranges.get(key, measured)
        # A velocity that the device cannot tell from zero has turned the shaft since Hold was given.
        drift = ranges.get("Velocity.velocity", Range(0.0, 0.0, 0.0)).resolution * STEPS * tools.STEP / SECOND
        error = bounds.resolution + measured.resolution + drift
        ranges = {**ranges, key: replace(bounds, resolution=error)}
    return tools.same(spec.canonical(given), spec.canonical(received), ranges)


def _synonyms_are_the_same(case: Case, kind: type[Command], samples: Sequence[dict[str, float]]) -> None:
    """What has the same canonical form is decoded as the same, and that form is a command of the spec."""
    spec = case.spec
    for values in (samples[0], *samples[-2:]):
        command = tools.exactly(kind, NAMES[0], values)
        synonym = spec.canonical(command)
        if synonym == command:
            continue
        if type(synonym) not in spec.commands or spec.canonical(synonym) != synonym:
            text = "its canonical form is no command of the spec, or has another canonical form"
            raise Failure(text, (), (command, synonym))
        one, other = _last_received(case, command), _last_received(case, synonym)
        if one is None or other is None or not tools.same(one, other, spec.ranges):
            decoded = [message for message in (one, other) if message]
            text = "the spec's canonical form makes synonyms of commands that are decoded differently"
            raise Failure(text, (), (command, synonym, *decoded))


def _last_received(case: Case, command: Command) -> Command | None:
    """Return the last command decoded for an armed motor that gets this one."""
    bench = _armed(case, tools.gentle(type(command), case.spec.ranges))
    steps = bench.steps(STEPS, [command]) if bench else []
    decoded = [m for step in steps for m in step.received if isinstance(m, Command)]
    return next((each for each in reversed(decoded) if each.motor == command.motor), None)


# -- samples -----------------------------------------------------------------------------------------------


def _samples(kind: type[Message], ranges: dict[str, Range], random: Random) -> Iterator[dict[str, float]]:
    """Yield values for the numbers of a message: each densely around its limits, then all at random."""
    named = tools.numbers(kind, ranges)
    rest = {name: tools.nearest(ranges[key], 0.0) for name, key in named}
    yield rest
    for name, key in named:
        for value in _dense(ranges[key], random):
            yield {**rest, name: value}
    for _ in range(10 if named else 0):
        yield {name: _anywhere(ranges[key], random) for name, key in named}


def _dense(bounds: Range, random: Random) -> list[float]:
    """Return numbers in a range, the simplest first: round ones, limits and their neighbours, random ones."""
    low, high, fine = bounds.low, bounds.high, bounds.resolution
    values = [1.0, -1.0, 0.5, 0.1, -0.1, low, high, math.nextafter(low, high), math.nextafter(high, low)]
    values += [low + fine, high - fine, low + 3 * fine, high - 3 * fine, 0.5 * (low + high)]
    values += [fine, -fine, 0.5 * fine, 1.5 * fine, 1e-3, -1e-3, 1e-9, 1.0 / 3.0]
    values += [0.999 * low, 0.999 * high, 0.126, 0.128, -0.129, 32.767, 32.769]
    values += [_anywhere(bounds, random) for _ in range(6)]
    return list(dict.fromkeys(value for value in values if low <= value <= high))


def _anywhere(bounds: Range, random: Random) -> float:
    """Return a number in a range, small ones as likely as large ones."""
    size = max(abs(bounds.low), abs(bounds.high))
    value = size * 10.0 ** random.uniform(-9.0, 0.0) * random.choice((-1.0, 1.0))
    return tools.nearest(bounds, value)


# -- measurements ------------------------------------------------------------------------------------------


def measurements_arrive(case: Case) -> None:
    """What a device measures is reported as measured, of the right device, and not stamped in the future."""
    spec, random = case.spec, case.random()
    if spec.kind == "sensor":
        _sensors_arrive(case, spec, random)
        return
    if not {"Feedback.position", "Feedback.velocity"} & set(spec.ranges):
        raise Inapplicable("the spec has no range for position or velocity: the device measures neither")
    for name in ("position", "velocity"):
        bounds = spec.ranges.get(f"Feedback.{name}")
        values = _dense(_sane(bounds), random) if bounds else []
        values = values[: case.share(len(values))]
        for at in range(0, len(values), 2):
            pair = (values[at], values[at + 1 - len(values)])
            _is_reported(case, spec, name, dict(zip(NAMES, pair, strict=True)))


def _sane(bounds: Range) -> Range:
    return replace(bounds, low=max(bounds.low, -SANE), high=min(bounds.high, SANE))


def _is_reported(case: Case, spec: Spec, name: str, values: dict[str, float]) -> None:
    """The driver reports each motor's position or velocity, as soon as its filters have settled."""
    bench = case.reporting()
    for motor, value in values.items():
        bench.shafts[motor].locked = True
        setattr(bench.shafts[motor], name, value)
    settled = _settled(case, bench, name)
    for motor, value in values.items():
        event, bounds = settled.get(motor), spec.ranges[f"Feedback.{name}"]
        end = 3.0 * bounds.resolution
        if event is None and not bounds.low + end < value < bounds.high - end:
            continue  # it may as well be beyond its range
        if event is None:
            raise Failure(f"{name} of {motor} is {value!r}, and is not reported")
        reported = getattr(event, name)
        if not tools.close(value, reported, bounds):
            text = f"{name} of {motor} is {value!r}, reported {reported!r}"
            raise Failure(text, bench.in_flight, (event,))


def _settled(case: Case, bench: Bench, name: str) -> dict[str, msg.Feedback]:
    """Return the last Feedback of each motor after ten periods and a tenth of a second, for its filters."""
    last: dict[str, msg.Feedback] = {}
    count = 100 + 10 * (case.spec.feedback_period // STEP)
    for step in bench.steps(count, case.prompt):
        for event in step.events:
            if not isinstance(event, msg.Feedback):
                continue
            if not step.now - count * STEP <= event.t <= step.now:
                raise Failure(f"reported at {step.now} as measured at {event.t}", step.up, (event,))
            if getattr(event, name) is not None:
                last[event.motor] = event
    return last


def beyond_its_range_is_not_measured(case: Case) -> None:
    """A position or velocity beyond its range is not reported, and is again when it is back inside.

    A torque cannot be driven beyond its range from outside."""
    quantities = [
        (name, bounds)
        for name in ("position", "velocity")
        if (bounds := case.spec.ranges.get(f"Feedback.{name}")) and max(-bounds.low, bounds.high) < UNREACHED
    ]
    if not quantities:
        raise Inapplicable("the spec has no range for position or velocity that a shaft can leave")
    for name, bounds in case.sample(quantities):
        bench, middle = case.reporting(), 0.5 * (bounds.low + bounds.high)
        for shaft in bench.shafts.values():
            shaft.locked = True
        for end in case.sample([bounds.high, bounds.low]):
            inside, outside = 0.5 * (end + middle), end + 0.6 * (end - middle)
            for value in (inside, outside, end + 0.01 * (end - middle), inside):
                setattr(bench.shafts[ALPHA], name, value)
                _settled(case, bench, name)
                event = _settled(case, bench, name).get(ALPHA)
                reported = getattr(event, name) if event else None
                if reported is None and value == inside:
                    raise Failure(f"{name} is {value:.6g}, inside its range again, and is not reported")
                if reported is not None and not tools.close(value, reported, bounds):
                    text = f"{name} is {value:.6g}, beyond its range, and is reported as {reported:.6g}"
                    raise Failure(text, bench.in_flight, [event] if event else [])


def _sensors_arrive(case: Case, spec: Spec, random: Random) -> None:
    found = sensors.kinds().by_type.values()
    kinds = [kind for kind in found if tools.numbers(kind.message, spec.ranges)]
    if not kinds:
        raise Inapplicable("the spec has no range for any measurement")
    bench, within = case.start(), 2 + 3 * (spec.feedback_period // STEP)
    for kind in kinds:
        for values in case.sample(list(_samples(kind.message, spec.ranges, random))):
            missing, last = set(case.names), list[Event]()
            for _ in range(within):
                truth = [sensors.shaped(kind, name, bench.now + STEP, values) for name in case.names]
                step = bench.step(truth=truth)
                reported = [event for event in step.events if type(event) is kind.message]
                missing -= {
                    e.sensor for e in truth for event in reported if _arrived(kind, e, event, spec, step.now)
                }
                last = list(reported[-1:]) or last
                if not missing:
                    break
            else:
                text = f"measured {truth[0]}, reported {last or 'nothing'} within {within} ms"
                raise Failure(text, step.up[-2:], (truth[0], *last))


def _arrived(
    kind: sensors.SensorKind, true: msg.Measurement, reported: msg.Measurement, spec: Spec, now: Nanos
) -> bool:
    """True if this reading is reported as it was measured: exactly, or as by a device that measures at
    places of its own."""
    if not now - 1000 * STEP <= reported.t <= now + STEP or true.sensor != reported.sensor:
        return False
    named = tools.numbers(kind.message, spec.ranges)
    if kind.agrees is None or len(named) == len(kind.quantities):
        return tools.same(true, reported, spec.ranges)
    return kind.agrees(true, reported, max(spec.ranges[key].resolution for _, key in named))


# -- scales ----------------------------------------------------------------------------------------------


def scales_are_declared(case: Case) -> None:
    """An option that scales what a number in a frame means is listed in the spec, or its default is 0."""
    usual = case.plugin.spec(Device(ALPHA, case.addresses[0], case.plugin.tried(), case.plugin.settings()))
    if not case.whole and case.spec.scales == usual.scales:
        raise Inapplicable("the same options are scales as by default")
    steps = _conversation(case)
    meant = _meant(case, case.options, steps)
    for change in _other_scales(case.options):
        (name,) = change
        if name in case.spec.scales or not getattr(case.options, name):
            continue
        for options in valid(case.options, [change]):
            if scaled := _scaled(meant, _meant(case, options, steps)):
                why = f"depends on options.{name}, which is neither among the spec's scales nor 0 by default"
                raise Failure(f"what a frame says of {scaled} {why}")


def _other_scales(options: Any) -> Iterator[dict[str, object]]:  # noqa: ANN401 -- a dataclass of the plugin's
    """Yield another value of each option that may be a scale: a number, or a Literal."""
    yield from (dict([each]) for each in alternatives(options) if isinstance(each[1], str))
    for each in fields(options):
        value = getattr(options, each.name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            bounds = bounds_of(hints(type(options))[each.name])
            other = 2 * value if bounds is None or bounds.admit(2 * value) else value / 2
            yield {each.name: type(value)(other)}


def _conversation(case: Case) -> list[tuple[tools.Messages, tools.StepResult]]:
    """Arm the devices, let them turn by each command, and return each step with its messages."""
    bench, spec = case.start(), case.spec
    for shaft in bench.shafts.values():
        shaft.position, shaft.velocity = 0.7, 0.5
    steps: list[tuple[tools.Messages, tools.StepResult]] = []
    for kind in case.kinds:
        numbers = [name for name, _ in tools.numbers(kind, spec.ranges)]
        for at in range(tools.ARMING):
            values = dict.fromkeys(numbers, 0.1 * math.sin(0.1 * at))
            messages = [tools.build(kind, name, spec.ranges, values) for name in case.names]
            steps.append((messages, bench.step(messages)))
            armed = all(bench.modes.get(name, Mode.ARMED) is Mode.ARMED for name in case.names)
            if armed and at > SCALED:
                break
    return steps or [((), step) for step in bench.steps(SCALED)]


def _meant(
    case: Case, options: object, steps: Sequence[tuple[tools.Messages, tools.StepResult]]
) -> dict[str, dict[Nanos, float]]:
    """Return the numbers in the frames of a conversation, as these options read them, by name and time."""
    names = case.names
    bench = tools.make_bench(case.plugin, options, case.addresses[: len(names)], names)
    meant: dict[str, dict[Nanos, float]] = {}
    up: Sequence[Frame] = ()
    for messages, step in steps:
        read = [event for frame in up for event in bench.driver.receive(step.now, frame)]
        bench.driver.send(step.now, messages)  # what it asks was answered
        obeyed = [message for frame in step.down for message in bench.decoder.decode(step.now, frame)]
        for message in (*read, *obeyed):
            if isinstance(message, msg.Feedback | msg.Velocity | msg.Torque):
                for name in ("position", "velocity", "torque"):
                    if number := getattr(message, name, None):
                        meant.setdefault(f"{type(message).__name__}.{name}", {})[step.now] = number
        up = step.up
    return meant


def _scaled(one: dict[str, dict[Nanos, float]], other: dict[str, dict[Nanos, float]]) -> str:
    """Return a quantity of which most numbers are others, "" if there is none."""
    for name in sorted(one.keys() & other.keys()):
        ratios = sorted(one[name][t] / other[name][t] for t in one[name].keys() & other[name].keys())
        if ratios and abs(ratios[len(ratios) // 2] - 1.0) > 0.01:
            return name
    return ""
