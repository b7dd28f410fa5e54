"""Random sessions of a driver with its twins, over a line that loses, doubles, delays and reorders frames.

Rules. A session is a seed: the options and settings of the devices, how bad the line is, what is commanded.
It is judged by the torque of the twins and by what a command decoder reads in the frames that reached them,
never by what the driver believes; no protocol is known here. Its end is calm: the line is good, and what is
commanded must be done. What a device in fault does (its watchdog may brake) is not judged.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from heapq import heappop, heappush
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.conformance import variants
from protocols.conformance.bench import ADDRESSES, NAMES, START, STEP, Shaft, build, close, numbers, same
from protocols.conformance.case import Case, addresses_of, valid
from protocols.conformance.fault_injection import STILL, resting
from protocols.conformance.random import Random
from protocols.conformance.safety import leads_away
from protocols.conformance.timeouts import settings_with_watchdog
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plugin import Device, FeedbackKind, Plugin, Spec, load_all

Given: TypeAlias = Command | Request

DISTURBED, CALM, REST = 2500, 6000, 100
"""Steps: with a bad line; at most, with a good one, until what is commanded is done; for which it is then."""
PULL = 0.01
"""N·m on the shafts, to and fro: what is armed gives a torque against it."""
QUEUE = 4
"""Answers of one kind that a slow device keeps; further ones are lost."""
SLOW: Nanos = 1000 * MILLISECOND
"""Timeout of a watchdog that does not hide what the driver leaves undone."""
LOSSES = 3
"""Losses of feedback, as long as `Spec.offline_after`, until a device has certainly obeyed Idle."""


@dataclass(frozen=True, slots=True)
class Quality:
    """How bad a line is, both ways."""

    lost: float
    """Share of the frames."""
    doubled: float
    delay: Nanos
    """The longest; it differs from frame to frame, so that later ones overtake."""
    stored: float
    """Share of the frames to the devices of which a copy is delivered a second or more later."""
    slow: Nanos
    """Period in which a device serves its answers of one kind; 0: at once."""
    outage: Nanos
    """The longest time for which nothing passes."""
    period: Nanos
    """Of the host's steps."""

    @property
    def hidden(self) -> Nanos:
        """The longest time for which one end may know nothing of the other."""
        return self.outage + 2 * self.delay + QUEUE * self.slow + 2 * self.period


def quality(random: Random) -> Quality:
    """Draw how bad a line is: each kind of trouble in every second session, at least."""
    return Quality(
        lost=random.choice((0.0, 0.02, 0.2)),
        doubled=random.choice((0.0, 0.05, 0.3)),
        delay=random.choice((0, 0, 3, 15, 40)) * MILLISECOND,
        stored=random.choice((0.0, 0.02)),
        slow=random.choice((0, 0, 60)) * MILLISECOND,
        outage=random.choice((0, 60, 400, 900)) * MILLISECOND,
        period=random.choice((1, 5, 10)) * MILLISECOND,
    )


GOOD = Quality(0.0, 0.0, 0, 0.0, 0, 0, 0)


def bound(spec: Spec, line: Quality) -> Nanos:
    """Return for how long a device may give torque for anything but what is commanded, Idle above all."""
    return line.hidden + LOSSES * spec.offline_after


class Line:
    """One direction: frames that are under way."""

    def __init__(self, random: Random, way: Quality) -> None:
        self.random = random
        self.quality = way
        self.broken = False
        """Nothing passes."""
        self._queue: list[tuple[Nanos, int, Any]] = []
        self._count = 0
        self._served: dict[object, Nanos] = {}
        """When a slow device serves its last answer of each kind."""

    def send(self, now: Nanos, item: object, kind: object = None) -> None:
        """Take a frame; `kind`: that of a device's answer, None for one of the host."""
        random, way = self.random, self.quality
        if kind is not None and way.slow:
            at = max(now, self._served.get(kind, 0) + way.slow)
            if at - now > QUEUE * way.slow:
                return
            self._served[kind] = now = at
        if self.broken or random.uniform() < way.lost:
            return
        for _ in range(2 if random.uniform() < way.doubled else 1):
            self._put(now + (random.below(way.delay) if way.delay else 0), item)
        if kind is None and random.uniform() < way.stored:
            self._put(now + random.below(1000 * MILLISECOND) + 1000 * MILLISECOND, item)

    def _put(self, at: Nanos, item: object) -> None:
        self._count += 1
        heappush(self._queue, (at, self._count, item))

    def arrived(self, now: Nanos) -> list[Any]:
        """Return what arrives until now."""
        found = []
        while self._queue and self._queue[0][0] <= now:
            found.append(heappop(self._queue)[2])
        return found

    def mend(self, now: Nanos) -> None:
        """Be a good line from now on; copies that were stored are lost."""
        self._queue = [each for each in self._queue if each[0] <= now + self.quality.delay]
        self.quality, self.broken = GOOD, False


@dataclass(slots=True)
class Motor:
    """One device, what it is given, and what it truly does."""

    device: Device
    spec: Spec
    twin: Any
    shaft: Shaft
    given: Command
    until: Nanos = 0
    """When something else is commanded."""
    given_at: dict[Command, Nanos] = field(default_factory=dict)
    """All that was commanded, and when last."""
    obeys: Command | None = None
    """As its decoder reads it."""
    at_rest: bool = True
    """What it obeys keeps the shaft where it was."""
    fits: bool = True
    """What it obeys is what is given."""
    torque: float = 0.0
    tripped: bool = False
    """It reports a fault, to whoever listens."""
    wrong: int = 0
    """Steps for which it has given torque for something else."""
    worst: int = 0
    places: deque[float] = field(default_factory=deque)
    """rad where the shaft was in the last steps."""
    ever: tuple[float, float] = (0.0, 0.0)
    """Ends of where it ever was."""

    @property
    def name(self) -> str:
        """Its name."""
        return self.device.name

    def command(self, now: Nanos, given: Command, until: Nanos) -> None:
        """Give it a command until then."""
        self.given, self.until = given, until
        self.given_at[given] = now
        self.judge()

    def obey(self, now: Nanos, received: Command, age: Nanos) -> None:
        """Record what it obeys. Raises AssertionError if that was not commanded since `age`."""
        if received == self.obeys:
            return
        self.obeys = received
        recent = [each for each, at in self.given_at.items() if at >= now - age]
        assert self.was_said(received, recent), f"not commanded: {received}; but {recent}"
        self.judge()

    def judge(self) -> None:
        """Compare what it obeys with what is given."""
        if self.obeys is None:
            return
        self.at_rest = self.stays(self.obeys, (min(self.places), max(self.places)))
        still = self.at_rest and not isinstance(self.given, msg.Idle)
        self.fits = still or self.same(self.given, self.obeys)

    def same(self, given: Command, received: Command) -> bool:
        """True if what is received does what was given. A velocity may also go on from where the shaft is."""
        canonical, ranges = self.spec.canonical, self.spec.ranges
        if same(canonical(given), canonical(received), ranges):
            return True
        if not isinstance(given, msg.Velocity) or not isinstance(received, msg.Position):
            return False
        still = replace(received, velocity=0.0, torque=0.0)
        onwards = msg.Velocity(given.motor, received.velocity, received.torque)
        return self.stays(still, self.ever) and same(given, onwards, ranges)

    def was_said(self, received: Command, recent: Sequence[Command]) -> bool:
        """True if what is received was commanded, keeps the shaft where it has been, or has only numbers that
        were commanded: where mode and set-points are messages of their own, old and new ones mix."""
        if isinstance(received, msg.Idle) or self.stays(received, self.ever):
            return True
        if any(self.same(each, received) for each in recent):
            return True
        wanted = [self.spec.canonical(each) for each in recent]
        for name, key in numbers(type(received), self.spec.ranges):
            value, bounds = getattr(received, name), self.spec.ranges[key]
            if name == "position" and self.stays(msg.Position(self.name, value), self.ever):
                continue
            if not any(close(getattr(each, name, 0.0), value, bounds) for each in wanted):
                return False
        return True

    def stays(self, received: Command, places: tuple[float, float]) -> bool:
        """True if what is received keeps a shaft where it is, if that is between these places."""
        there = min(max(getattr(received, "position", 0.0), places[0]), places[1])
        return not leads_away(received, self.spec, there)

    @property
    def does(self) -> bool:
        """True if it truly does what is given."""
        if abs(self.torque) <= STILL or isinstance(self.given, msg.Idle):
            return abs(self.torque) <= STILL and isinstance(self.given, msg.Idle)
        if self.tripped:
            return False
        match self.given:
            case msg.Velocity(_, velocity):
                return self.fits and abs(self.shaft.velocity - velocity) < 0.5 * abs(velocity)
            case msg.Position(_, position):
                return self.fits and abs(self.shaft.position - position) < 0.2
            case msg.Torque():
                return self.obeys is not None and self.same(self.given, self.obeys)
        return self.fits


class Session:
    """A driver, its twins, and the line between them."""

    def __init__(self, plugin: Plugin, seed: int) -> None:
        self.plugin, self.random = plugin, Random(seed)
        motors = _moved(plugin)
        options = motors[0] if self.random.below(2) else self.random.choice(motors)
        settings = plugin.settings()
        if self.random.below(2):
            options, settings = _unwatched(plugin, options)
        elif self.random.below(2):
            settings = settings_with_watchdog(Case(plugin, options, seed, ADDRESSES)) or settings
        pairs = zip(NAMES, ADDRESSES, strict=False)
        self.devices = [Device(name, address, options, settings) for name, address in pairs]
        self.quality = quality(self.random)
        self.driver = plugin.driver(self.devices)
        self.decoder = plugin.decoder(self.devices)
        self.listener = plugin.driver(self.devices)
        """Receives all that the devices send, and sends nothing."""
        self.motors = {
            each.name: Motor(
                each,
                plugin.spec(each),
                plugin.twin(each, self.random.below(1000)),
                Shaft(friction=0.01),
                msg.Idle(each.name),
            )
            for each in self.devices
        }
        self.bounds = {m.name: bound(m.spec, self.quality) // STEP for m in self.motors.values()}
        for motor in self.motors.values():
            motor.places = deque([0.0], self.bounds[motor.name])
        self.down, self.up = Line(self.random, self.quality), Line(self.random, self.quality)
        self.now = START
        self.due = START
        self.asked: Counter[tuple[str, str]] = Counter()
        """Requests that were not answered yet, by kind and motor."""
        self.stopped_until: Nanos = 0
        self.outage_ends: Nanos = 0
        self.noticed = BusState.UP
        """What the host is notified of when the outage ends."""
        self.modes: dict[str, Mode] = {}
        """As the driver reports them: an operator clears faults that he is shown."""

    def run(self) -> float:
        """Run the session. Returns the longest wrong torque as a share of its bound.

        Raises AssertionError."""
        for _ in range(DISTURBED):
            self.step(self.disturb())
        self.down.mend(self.now)
        self.up.mend(self.now)
        self.calm()
        return max(motor.worst / self.bounds[motor.name] for motor in self.motors.values())

    def calm(self) -> None:
        """Whatever has happened: what is now commanded is done, at last Idle; requests are answered."""
        if self.noticed is not BusState.UP:
            self.driver.bus(self.now, self.noticed)
        for motor in self.motors.values():
            self.command(motor, self.drawn(motor, armed=True), CALM)
        done = at = 0
        while done < REST:
            requests: list[Given] = []
            for name, motor in self.motors.items():
                if at % 1000 == 300 and not motor.does and msg.ClearFault in motor.spec.requests:
                    requests += self.ask(msg.ClearFault(name))
                if at % 2000 == 1999 and not motor.does and motor.spec.feedback is FeedbackKind.REPLY:
                    # That it is not in motor mode shows in its torque alone: not at every small set-point.
                    self.command(motor, self.drawn(motor, armed=True), CALM)
            self.step(requests)
            done = done + 1 if all(motor.does for motor in self.motors.values()) else 0
            at += 1
            assert at < CALM, f"stalled: {self}"
        for motor in self.motors.values():
            self.command(motor, msg.Idle(motor.name), CALM)
        for at in range(CALM):
            self.step(())
            if at > max(self.bounds.values()) + REST and not +self.asked:
                break
        assert all(motor.does for motor in self.motors.values()), f"Idle: {self}"
        assert not +self.asked, f"not answered: {self.asked}"

    def __str__(self) -> str:
        """Return what is needed to understand a failure."""
        head = f"{self.plugin.name} at {(self.now - START) // STEP} ms {self.quality} {self.devices[0]}"
        tail = [
            f"{m.name} {m.given}, obeys {m.obeys}, {m.torque:.3g} N·m, {m.shaft}, tripped {m.tripped}"
            f" at rest {m.at_rest} reported {self.modes.get(m.name)}"
            for m in self.motors.values()
        ]
        return "\n    ".join([head, *tail])

    # -- what is commanded and what goes wrong ---------------------------------------------------------

    def disturb(self) -> Sequence[Given]:
        """Draw what happens in this step; return the requests that are made."""
        random, requests = self.random, list[Given]()
        if self.quality.outage and self.now >= self.outage_ends and random.below(600) == 0:
            self.outage_ends = self.now + random.below(self.quality.outage)
            self.noticed = random.choice((BusState.UP, BusState.BACK, BusState.FULL))
            self.down.broken = True
            self.up.broken = self.noticed is not BusState.FULL and random.below(3) > 0
            if self.noticed is BusState.BACK:
                self.driver.bus(self.now, BusState.GONE)
        elif self.down.broken and self.now >= self.outage_ends:
            self.down.broken = self.up.broken = False
            if self.noticed is not BusState.UP:
                self.driver.bus(self.now, self.noticed)
                self.noticed = BusState.UP
        if random.below(2000) == 0:
            self.stopped_until = self.now + random.below(600 * MILLISECOND)
            requests.append(msg.Stop("a session"))
            for motor in self.motors.values():
                self.command(motor, msg.Idle(motor.name), random.below(600))
        for motor in self.motors.values():
            if self.now >= motor.until:
                self.command(motor, self.drawn(motor), 20 + random.below(700))
            if random.below(300) == 0 and msg.ReadParameter in motor.spec.requests:
                names = [*motor.spec.parameters, "no such parameter"]
                requests += self.ask(msg.ReadParameter(motor.name, random.choice(names)))
            faulty = self.modes.get(motor.name) is Mode.FAULT
            if random.below(200 if faulty else 2000) == 0 and msg.ClearFault in motor.spec.requests:
                requests += self.ask(msg.ClearFault(motor.name))
        return requests

    def command(self, motor: Motor, given: Command, steps: int) -> None:
        """Command something for some steps."""
        motor.command(self.now, given, self.now + steps * STEP)

    def drawn(self, motor: Motor, *, armed: bool = False) -> Command:
        """Draw a command: every third is Idle, unless it must arm."""
        random, spec, shaft = self.random, motor.spec, motor.shaft
        if not armed and (self.now < self.stopped_until or random.below(3) == 0):
            return msg.Idle(motor.name)
        kind = random.choice(sorted(spec.commands - {msg.Idle}, key=lambda kind: kind.__name__))
        if kind is msg.Hold:
            return msg.Hold(motor.name)
        back = (
            -math.copysign(1.0, shaft.position) if abs(shaft.position) > 4.0 else random.choice((-1.0, 1.0))
        )
        place = max(-6.0, min(6.0, shaft.position + back * random.uniform()))
        if kind is msg.Velocity:
            return build(kind, motor.name, spec.ranges, {"velocity": back * random.uniform(1.0, 3.0)})
        if kind is msg.Torque:
            return build(kind, motor.name, spec.ranges, {"torque": back * random.uniform(0.01, 0.02)})
        return resting(kind, spec, motor.name, place)

    def ask(self, asked: Request) -> list[Given]:
        """Make a request, which will have one answer."""
        self.asked[type(asked).__name__, getattr(asked, "motor", "")] += 1
        if isinstance(asked, msg.ClearFault):  # it latches faults for us
            self.listener = self.plugin.driver(self.devices)
        return [asked]

    # -- one step --------------------------------------------------------------------------------------

    def step(self, requests: Sequence[Given]) -> None:
        """Advance driver, line, twins and shafts by one step, and judge."""
        self.now = now = self.now + STEP
        for frame in self.up.arrived(now):
            self._on_events(self.driver.receive(now, frame))
        due = self.driver.due()
        if requests or now >= self.due or (due is not None and now >= due):
            self.due = now + self.quality.period if now >= self.due else self.due
            given = [motor.given for motor in self.motors.values()]
            for motor in self.motors.values():
                motor.given_at[motor.given] = now
            events, frames = self.driver.send(now, [*requests, *given])
            self._on_events(events)
            for frame in frames:
                self.down.send(now, frame)
        for frame in self.down.arrived(now):
            self._deliver(frame)
        for motor in self.motors.values():
            self._turn(motor)

    def _deliver(self, frame: Frame) -> None:
        for message in self.decoder.decode(self.now, frame):
            if isinstance(message, Command):
                age = self.quality.hidden + 2000 * MILLISECOND * (self.quality.stored > 0.0)
                self.motors[message.motor].obey(self.now, message, age)
        for motor in self.motors.values():
            motor.twin.receive(self.now, frame)

    def _turn(self, motor: Motor) -> None:
        shaft = motor.shaft
        truth = msg.Feedback(motor.name, self.now, shaft.position, shaft.velocity)
        torques, frames = motor.twin.step(self.now, [truth])
        motor.torque = math.fsum(torque.torque for torque in torques)
        shaft.load = PULL * math.sin(20.0 * msg.seconds(self.now))
        shaft.turn(motor.torque, STEP)
        motor.places.append(shaft.position)
        motor.ever = min(motor.ever[0], shaft.position), max(motor.ever[1], shaft.position)
        for frame in frames:
            self.up.send(self.now, frame, (motor.name, getattr(frame, "id", None)))
            for event in self.listener.receive(self.now, frame):
                if isinstance(event, msg.State):
                    self.motors[event.motor].tripped = event.mode is Mode.FAULT
            for other in self.motors.values():
                if other is not motor and isinstance(frame, CanFrame):
                    other.twin.receive(self.now, frame)
        if abs(motor.torque) <= STILL or motor.fits or motor.tripped:
            motor.wrong = 0
            return
        motor.wrong += 1
        motor.worst = max(motor.worst, motor.wrong)
        assert motor.wrong <= self.bounds[motor.name], f"{motor.name} does something else: {self}"

    def _on_events(self, events: Sequence[Event]) -> None:
        for event in events:
            if isinstance(event, msg.State):
                self.modes[event.motor] = event.mode
            kind = "ReadParameter" if isinstance(event, msg.Parameter) else getattr(event, "request", "")
            name = getattr(event, "motor", "") or getattr(event, "name", "")
            if kind in ("ReadParameter", "ClearFault"):
                self.asked[kind, name] -= 1
                assert self.asked[kind, name] >= 0, f"answered twice: {event}"


def _moved(plugin: Plugin) -> list[Any]:
    """Return the options with which its devices take commands. On a line on which they speak only when asked
    there are sessions of their own (`line_sessions`)."""
    first, settings = addresses_of(plugin)[0], plugin.settings()
    specs = [(o, plugin.spec(Device(NAMES[0], first, o, settings))) for o in variants(plugin)]
    return [options for options, spec in specs if spec.commands and spec.line == "free"]


def _unwatched(plugin: Plugin, options: Any) -> tuple[Any, Any]:
    """Return options and settings of which at most one number is changed, so that the watchdog hides nothing;
    as they were if no number does that."""
    usual = {"options": options, "settings": plugin.settings()}
    for changed in (usual, *(usual | {part: other} for part in usual for other in _changed(usual[part]))):
        watchdog = plugin.spec(Device(NAMES[0], ADDRESSES[0], **changed)).watchdog
        if not watchdog.enabled or (watchdog.timeout or SLOW) >= SLOW:
            return changed["options"], changed["settings"]
    return options, usual["settings"]


def _changed(usual: Any) -> Iterator[Any]:
    """Yield a dataclass with one number as zero, or much larger."""
    numbers = {f.name: getattr(usual, f.name) for f in fields(usual)}
    for name, number in numbers.items():
        if type(number) in (int, float) and number:
            yield from valid(usual, [{name: type(number)(0)}, {name: 20 * number}])


MOTORS = [plugin for plugin in load_all()[0] if _moved(plugin)]
"""The installed protocols of motors."""
