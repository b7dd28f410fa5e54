"""Words survive the wire: commands downwards, measurements upwards, within the declared resolution.

Rules. Samples lie densely around the limits of each number and sparsely between; the simplest come
first, so that the first that fails is short. Alpha and beta are always told different numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from protocols import messages as msg
from protocols.conformance import bench as play
from protocols.conformance.bench import NAMES, STEP, Bench
from protocols.conformance.case import Case, Failure, Inapplicable, Verdict, by_name
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.messages import Command, Event, Message, Nanos, Request
from protocols.plugin import Range, Spec


def commands_survive(case: Case) -> Verdict:
    """Every command, dense around the limits of each of its numbers, is heard as it was said."""
    spec, random = case.spec, case.random()
    if not spec.commands:
        return Inapplicable("the spec lists no commands")
    for kind in by_name(spec.commands):
        if kind is msg.Idle:
            continue
        samples = [(kind, values) for values in _samples(kind, spec.ranges, random)]
        failure = _all_heard(case, spec, samples)
        if failure:
            return failure
    return _idle_heard(case, spec)


def _all_heard(
    case: Case, spec: Spec, samples: list[tuple[type[Command], dict[str, float]]]
) -> Failure | None:
    stage = None
    for at, (kind, values) in enumerate(samples):
        # Beta is told the next sample: the two must not be mixed up.
        other = samples[(at + 1) % len(samples)][1]
        commands = [play.build(kind, NAMES[0], values), play.build(kind, NAMES[1], other)]
        if stage and not _received(stage, spec, commands):
            continue
        # A device may have gone into fault over the last sample: once more, on a fresh one.
        stage = _armed(case, play.gentle(kind, spec.ranges))
        if stage is None:
            return Failure(f"{kind.__name__} does not arm in {play.ARMING} ms")
        failure = _received(stage, spec, commands)
        if failure:
            return failure
    return None


def _armed(case: Case, make: Callable[[str], Command]) -> Bench | None:
    """Alpha and beta, armed, with shafts that stand still."""
    stage = case.start()
    for shaft in stage.shafts.values():
        shaft.locked = True
    return stage if stage.arm(make) else None


def _received(stage: Bench, spec: Spec, commands: Sequence[Command]) -> Failure | None:
    """None if the ear hears each command within 30 steps, else what it heard."""
    missing, frames, received = list(commands), list[Frame](), list[Message]()
    for _ in range(30):
        said = stage.step(commands)
        missing = [w for w in missing if not any(obeyed(stage, spec, w, h) for h in said.received)]
        if not missing:
            return None
        frames += [w for w in said.down if w not in frames]
        received += [w for w in said.received if w not in received]
    said_to = missing[0].motor
    last = [word for word in received if getattr(word, "motor", said_to) == said_to][-2:]
    reported = " and ".join(map(str, last)) or "nothing"
    return Failure(f"said {missing[0]}, heard {reported}", tuple(frames[-4:]), (missing[0], *last))


def obeyed(stage: Bench, spec: Spec, said: Command, received: Command | Request) -> bool:
    """Whether a device that heard this does what was said."""
    if isinstance(said, msg.Hold) and isinstance(received, msg.Position) and received.motor == said.motor:
        # Many devices have no word for Hold: the driver then says where the shaft was measured to be.
        measured = spec.ranges.get("Feedback.position", Range(0.0, 0.0, 0.0))
        bounds = spec.ranges.get("Position.position", measured)
        both = replace(bounds, resolution=bounds.resolution + measured.resolution)
        return play.close(stage.shafts[said.motor].position, received.position, both)
    return play.same(said, received, spec.ranges)


def _idle_heard(case: Case, spec: Spec) -> Failure | None:
    kind = next((kind for kind in by_name(spec.commands) if kind is not msg.Idle), None)
    if msg.Idle not in spec.commands or kind is None:
        return None
    stage = _armed(case, play.gentle(kind, spec.ranges))
    return _received(stage, spec, [msg.Idle(name) for name in NAMES]) if stage else None


def _samples(kind: type[Message], ranges: dict[str, Range], random: Random) -> Iterator[dict[str, float]]:
    """Values for the numbers of a word: one at a time dense around its limits, then all at random."""
    named = play.numbers(kind, ranges)
    rest = {name: play.nearest(ranges[key], 0.0) for name, key in named}
    yield rest
    for name, key in named:
        for value in _dense(ranges[key], random):
            yield {**rest, name: value}
    for _ in range(10 if named else 0):
        yield {name: _anywhere(ranges[key], random) for name, key in named}


def _dense(bounds: Range, random: Random) -> list[float]:
    """Numbers in a range, the simplest first: round ones, both limits and what lies next to them, any."""
    low, high, fine = bounds.low, bounds.high, bounds.resolution
    values = [1.0, -1.0, 0.5, 0.1, -0.1, low, high, math.nextafter(low, high), math.nextafter(high, low)]
    values += [low + fine, high - fine, low + 3 * fine, high - 3 * fine, 0.5 * (low + high)]
    values += [fine, -fine, 0.5 * fine, 1.5 * fine, 1e-3, -1e-3, 1e-9, 1.0 / 3.0]
    values += [0.999 * low, 0.999 * high, 0.126, 0.128, -0.129, 32.767, 32.769]
    values += [_anywhere(bounds, random) for _ in range(6)]
    return list(dict.fromkeys(value for value in values if low <= value <= high))


def _anywhere(bounds: Range, random: Random) -> float:
    """A number in a range, small ones as likely as large ones."""
    size = max(abs(bounds.low), abs(bounds.high))
    value = size * 10.0 ** random.uniform(-9.0, 0.0) * random.choice((-1.0, 1.0))
    return play.nearest(bounds, value)


def measurements_survive(case: Case) -> Verdict:
    """What the world shows to a device comes up as it was shown, from the right device, not from later."""
    spec, random = case.spec, case.random()
    if spec.kind == "sensor":
        return _sights_survive(case, spec, random)
    if not {"Feedback.position", "Feedback.velocity"} & set(spec.ranges):
        return Inapplicable("the spec has no range for position or velocity: the device measures neither")
    for name in ("position", "velocity"):
        bounds = spec.ranges.get(f"Feedback.{name}")
        values = _dense(_sane(bounds), random) if bounds else []
        values = values[: case.part(len(values))]
        for at in range(0, len(values), 2):
            pair = (values[at], values[at + 1 - len(values)])
            failure = _reported(case, spec, name, dict(zip(NAMES, pair, strict=True)))
            if failure:
                return failure
    return None


SANE = 1e5
"""rad, rad/s: no shaft is shown more, whatever number the wire could carry."""


def _sane(bounds: Range) -> Range:
    return replace(bounds, low=max(bounds.low, -SANE), high=min(bounds.high, SANE))


def _reported(case: Case, spec: Spec, name: str, values: dict[str, float]) -> Failure | None:
    """None if each motor tells its position or velocity, as soon as its filters have settled."""
    stage = case.start()
    for motor, value in values.items():
        stage.shafts[motor].locked = True
        setattr(stage.shafts[motor], name, value)
    reported = _settled(stage, spec, name)
    if isinstance(reported, Failure):
        return reported
    for motor, value in values.items():
        event = reported.get(motor)
        if event is None:
            return Failure(f"{name} of {motor} is {value!r}, and is not told")
        received = getattr(event, name)
        if not play.close(value, received, spec.ranges[f"Feedback.{name}"]):
            return Failure(f"{name} of {motor} is {value!r}, told {received!r}", stage.on_the_way, (event,))
    return None


def _settled(stage: Bench, spec: Spec, name: str) -> dict[str, msg.Feedback] | Failure:
    """The last Feedback of each motor after ten periods and a tenth of a second, for its filters."""
    reported: dict[str, msg.Feedback] = {}
    count = 100 + 10 * (spec.feedback_period // STEP)
    for said in stage.steps(count):
        for event in said.events:
            if not isinstance(event, msg.Feedback):
                continue
            if not said.now - count * STEP <= event.t <= said.now:
                return Failure(f"told at {said.now} as if measured at {event.t}", said.up, (event,))
            if getattr(event, name) is not None:
                reported[event.motor] = event
    return reported


def _sights_survive(case: Case, spec: Spec, random: Random) -> Verdict:
    kinds = [kind for kind in (msg.Imu, msg.LaserScan, msg.Fix) if play.numbers(kind, spec.ranges)]
    if not kinds:
        return Inapplicable("the spec has no range for any measurement")
    stage = case.start()
    for kind in kinds:
        for values in _samples(kind, spec.ranges, random):
            shown = [_sight(kind, name, stage.now + STEP, values) for name in NAMES]
            step = stage.step(truth=shown)
            events = (*step.events, *stage.step().events)
            for word in shown:
                if not any(_seen(word, event, spec, step.now) for event in events):
                    reported = tuple(event for event in events if type(event) is kind)[-1:]
                    return Failure(
                        f"shown {word}, told {reported or 'nothing'}", step.up[-2:], (word, *reported)
                    )
    return None


def _sight(
    kind: type[msg.Imu | msg.LaserScan | msg.Fix], sensor: str, t: Nanos, values: dict[str, float]
) -> Event:
    get = values.get
    if kind is msg.Imu:
        rate, push = get("angular_velocity", 0.0), get("linear_acceleration", 0.0)
        turned = get("orientation")
        still = None if turned is None else (turned, 0.0, 0.0, turned)
        return msg.Imu(sensor, t, (rate, 0.0, -rate), (0.0, push, push), still)
    if kind is msg.LaserScan:
        near = get("ranges", 0.0)
        parts = [get(n, 0.0) for n in ("angle_min", "angle_increment", "range_min", "range_max")]
        return msg.LaserScan(sensor, t, parts[0], parts[1], parts[2], parts[3], (near, 0.5 * near, near))
    return msg.Fix(sensor, t, get("latitude", 0.0), get("longitude", 0.0), get("altitude"), get("variance"))


def _seen(shown: Event, reported: Event, spec: Spec, now: Nanos) -> bool:
    return play.same(shown, reported, spec.ranges) and now - 1000 * STEP <= reported.t <= now + STEP
