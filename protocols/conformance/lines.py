"""What must hold on a serial line on which devices speak only when asked (`Spec.line`), with a true wire.

Rules. The host may send and read every 100 µs, as often as a loop on a real port; the driver is asked every
millisecond; devices answer when their answer is due, take the time of their bytes, and everybody receives
everybody ("asked": host and devices have a wire each). Two that send at once garble each other. Answers may
be disturbed on their way to the host: the wire is as before, but what the host reads is not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeAlias

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance.bench import ALPHA, BETA, NAMES, STEP, Bench, Messages, OnLine
from protocols.conformance.case import Case, Failure, Inapplicable
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.line import Exchange, Line
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos
from protocols.wire import Arrived, Wire

FINE: Nanos = 100_000
"""Period at which the host reads and sends."""
SLOW = 115_200
"""bit/s of a line that carries less than a driver wants"""
WAITING = 24
"""Exchanges that may wait, of two devices."""
SETTLED = 400
"""Steps of the usual exchange before a device is disturbed: what is read once has been read."""
PLACES = {ALPHA: 0.5, BETA: -0.5}
"""rad, where the shafts stand: no device is taken for another."""
HOST = ""
Disturb: TypeAlias = Callable[[int, str, bytes], Sequence[tuple[Nanos, bytes]]]
"""From the number of an answer, who sends it, and its bytes: what the host reads in its place, how late."""


def undisturbed(_number: int, _sender: str, data: bytes) -> Sequence[tuple[Nanos, bytes]]:
    """Return what is sent."""
    return ((0, data),)


@dataclass(slots=True)
class OnWire:
    """Two devices of one driver on a wire."""

    bench: Bench
    line: Line
    down: Wire
    up: Wire
    """The same as `down` on a half-duplex line."""
    disturb: Disturb = undisturbed
    now: Nanos = tools.START
    answers: int = 0
    unasked: int = 0
    """Answers that came while none was awaited."""
    late: list[tuple[Nanos, bytes]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    measured: dict[str, list[Nanos]] = field(default_factory=lambda: {name: [] for name in NAMES})
    """When each device has reported its motion."""
    sent: list[tuple[Nanos, Exchange]] = field(default_factory=list)
    most: int = 0
    """Exchanges that waited at once."""
    absent: set[str] = field(default_factory=set)
    """Devices that neither receive nor answer."""
    stepped: dict[str, Nanos] = field(default_factory=dict)
    dues: dict[int, Nanos | None] = field(default_factory=dict)
    """When each device does something by itself, as it said since it was last stepped or sent anything."""
    quiet: Nanos = 0
    """Until when nothing ends on the wire, and no device does anything."""

    def step(self, messages: Messages = ()) -> None:
        """Advance a millisecond."""
        own, frames = self.driver.driver.send(self.now, messages)
        self._on_events(own)
        self.line.put(0, [frame for frame in frames if isinstance(frame, bytes)])
        for at in range(len(self.bench.twins)):
            self._step_twin(at, self.now, STEP)
        for _ in range(STEP // FINE):
            for _, each in self.line.take(self.now):
                self.down.send(self.now, HOST, bytes(each))
                self.sent.append((self.now, each))
                self.quiet = 0
            self.now += FINE
            if self.now >= self.quiet:
                self._run(self.now)
            while self.late and self.late[0][0] <= self.now:
                self._read(*self.late.pop(0))
            if self.line.out is not None:
                for ended in self.line.expire(self.now):
                    self._on_events(self.driver.answered(self.now, ended))
        self.most = max(self.most, len(self.line.waiting))

    def steps(self, count: int, messages: Messages = ()) -> None:
        """Advance `count` milliseconds with the same messages."""
        for _ in range(count):
            self.step(messages)

    @property
    def driver(self) -> OnLine:
        """The driver, with the line of its bench."""
        driver = self.bench.driver
        assert isinstance(driver, OnLine)
        return driver

    def arm(self, commands: Sequence[Command]) -> None:
        """Command until both are armed. Raises Failure."""
        for count in range(tools.ARMING):
            self.step(commands)
            modes = self.bench.modes
            if all(modes.get(name) is Mode.ARMED for name in NAMES):
                return
            if count > tools.ARMING // 10 and not modes:
                return
        overlaps = len(self.down.collisions)
        raise Failure(f"not armed in {tools.ARMING} ms on a line that takes its time; {overlaps} overlaps")

    # -- the wire -------------------------------------------------------------------------------------

    def _run(self, until: Nanos) -> None:
        """Let devices receive, answer and send up to a time, in order."""
        while True:
            ends = [t for wire in self.wires if (t := wire.first_end()) is not None]
            end = min(ends) if ends else until + 1
            due, at = min([(self._due(at), at) for at in range(len(self.bench.twins))])
            if end > until and due > until:
                self.quiet = min(end, due) if ends else due
                return
            if due <= end:
                self._step_twin(at, due, 0)
            else:
                for wire in self.wires:
                    for arrived in wire.run(end):
                        self._arrive(wire, arrived)

    @property
    def wires(self) -> Sequence[Wire]:
        """Each wire once."""
        return (self.down,) if self.up is self.down else (self.down, self.up)

    def _due(self, at: int) -> Nanos:
        """Return when a device next does something by itself; far away if it has just been asked to."""
        if at not in self.dues:
            self.dues[at] = self.bench.twins[at].due()
        due, name = self.dues[at], self.bench.devices[at].name
        return self.now + 2 * STEP if due is None or due <= self.stepped.get(name, -1) else due

    def _step_twin(self, at: int, now: Nanos, span: Nanos) -> None:
        name = self.bench.devices[at].name
        shaft = self.bench.shafts[name]
        self.stepped[name] = now
        self.dues.pop(at, None)
        self.quiet = 0
        measured = [msg.Feedback(name, now, shaft.position, shaft.velocity)]
        torques, frames = self.bench.twins[at].step(now, measured)
        for torque in torques:
            shaft.turn(torque.torque, span)
        for frame in frames:
            if isinstance(frame, bytes) and name not in self.absent:
                self.up.send(now, name, frame)

    def _arrive(self, wire: Wire, arrived: Arrived) -> None:
        if arrived.sender != HOST:
            self.answers += 1
            for delay, data in self.disturb(self.answers, arrived.sender, arrived.data):
                if delay or self.late:  # what a device sends comes in its order
                    last = self.late[-1][0] if self.late else 0
                    self.late.append((max(arrived.t + delay, last), data))
                else:
                    self._read(arrived.t, data)
        for at, twin in enumerate(self.bench.twins):
            name = self.bench.devices[at].name
            if name != arrived.sender and wire is self.down and name not in self.absent:
                twin.receive(arrived.t, arrived.data)
                self.stepped.pop(name, None)
                self.dues.pop(at, None)

    def _read(self, t: Nanos, data: bytes) -> None:
        self.unasked += self.line.out is None
        self._on_events(self.driver.receive(t, data))

    def _on_events(self, events: Sequence[Event]) -> None:
        for event in events:
            self.events.append(event)
            if isinstance(event, msg.Feedback) and event.motor in self.measured:
                self.measured[event.motor].append(event.t)
            elif isinstance(event, msg.State):
                self.bench.modes[event.motor] = event.mode


def on_wire(case: Case, rate: int = tools.LINE_RATE) -> OnWire:
    """Set up alpha and beta on a wire. Raises Inapplicable if their line is another."""
    if case.spec.line == "free":
        raise Inapplicable("the spec says that its devices send when they like")
    bench = case.start()
    if not isinstance(bench.driver, OnLine):
        raise Failure("the devices of one driver differ in `line`")
    half = case.spec.line == "half-duplex"
    line = bench.driver.line = Line(rate, half_duplex=half, slack=3 * FINE)
    down = Wire(rate)
    for name, place in PLACES.items():
        bench.shafts[name].position, bench.shafts[name].locked = place, True
    return OnWire(bench, line, down, down if half else Wire(rate))


def commands_of(case: Case) -> list[Command]:
    """Return the command for each device by which it stands."""
    for kind in (msg.Hold, msg.Velocity, msg.Torque, *case.kinds):
        if kind in case.kinds:
            return [tools.build(kind, name, case.spec.ranges) for name in NAMES]
    raise Inapplicable("the spec lists no commands that arm")


def settled(case: Case) -> tuple[OnWire, list[Command]]:
    """Set up both, armed, and let them report for a while."""
    wire = on_wire(case)
    commands = commands_of(case)
    wire.arm(commands)
    wire.steps(SETTLED, commands)
    return wire, commands


# -- clauses ---------------------------------------------------------------------------------------------


def one_sends(case: Case) -> None:
    """Of host and devices never two send at once, in any conversation."""
    wire = on_wire(case)
    for messages in tools.script(case.spec, case.names):
        wire.step(messages)
        for each in wire.wires:
            for t, one, other in each.collisions:
                who = f"{one or 'the host'} and {other or 'the host'}"
                last = [bytes(sent) for _, sent in wire.sent[-3:]]
                raise Failure(f"{who} send at once in ms {(t - tools.START) // STEP}", last, messages)


def answers_as_declared(case: Case) -> None:
    """Each exchange is over when its answer is: nothing comes behind it, and none is awaited in vain."""
    wire, commands = settled(case)
    line, unasked = wire.line, wire.unasked
    lost, stray = line.lost, line.stray
    wire.steps(SETTLED, commands)
    lost, stray, unasked = line.lost - lost, line.stray - stray, wire.unasked - unasked
    if lost or stray or unasked:
        text = (
            f"in {SETTLED} ms {lost} answers were awaited in vain, {stray} bytes and {unasked} frames came "
        )
        raise Failure(text + "behind an answer", [bytes(sent) for _, sent in wire.sent[-4:]])
    _ends_are_found_in_any_bytes(case, [sent for _, sent in wire.sent if sent.answer is not None])


def _ends_are_found_in_any_bytes(case: Case, asked: Sequence[Exchange]) -> None:
    """Whatever comes, an `Answer.find` returns a place in it, or None."""
    random = case.random()
    for each in asked[:: max(1, len(asked) // 40)]:
        held = random.bytes(random.below(60)) + bytes(each)[: random.below(len(each) + 1)]
        assert each.answer is not None
        try:
            found = each.answer.find(each, held)
        except Exception as error:
            raise Failure(f"`find` raises {type(error).__name__}: {error}", (bytes(each), held)) from error
        if found is not None and not 0 <= found[0] < found[1] <= len(held):
            raise Failure(f"`find` returns {found}, in {len(held)} bytes", (bytes(each), held))


def lost_costs_one(case: Case) -> None:
    """One answer that is lost costs one reading of its device, and no other more than a cycle."""
    wire, commands = settled(case)
    usual = {name: _longest(times[len(times) // 2 :]) for name, times in wire.measured.items()}
    silent = {name for name, times in wire.measured.items() if len(times) < 4}
    if silent == set(NAMES):
        raise Inapplicable("its devices do not report their motion")
    for number in range(1, 20):
        wire.disturb = _once(wire.answers + number)
        begun = wire.now
        wire.steps(60, commands)
        wire.disturb = undisturbed
        for name in NAMES:
            times = [t for t in wire.measured[name] if t > begun - usual[name]]
            gap = _longest([*times, wire.now])
            if gap > 3 * usual[name] + 2 * STEP:
                text = f"one answer of alpha is lost: {name} is silent for {gap / MILLISECOND:.1f} ms"
                raise Failure(f"{text}, usually for {usual[name] / MILLISECOND:.1f}")
        _must_be_sound(wire, "one answer of alpha is lost")


def _once(first: int) -> Disturb:
    """Return what loses one answer of alpha: the first from this number on."""
    lost = list[int]()

    def disturb(number: int, sender: str, data: bytes) -> Sequence[tuple[Nanos, bytes]]:
        if sender == ALPHA and number >= first and not lost:
            lost.append(number)
        return () if lost == [number] else ((0, data),)

    return disturb


def _longest(times: Sequence[Nanos]) -> Nanos:
    return max((b - a for a, b in pairwise(times)), default=0)


def _must_be_sound(wire: OnWire, why: str) -> None:
    """No device has a fault, or is disarmed. Raises Failure."""
    for event in wire.events:
        if isinstance(event, msg.Fault):
            raise Failure(f"{why}: a fault", (), (event,))
        if isinstance(event, msg.State) and event.mode in (Mode.OFFLINE, Mode.FAULT):
            raise Failure(f"{why}: {event.motor} is {event.mode}", (), (event,))


def dead_costs_little(case: Case) -> None:
    """A device that is gone takes at most half of the line from the others."""
    wire, commands = settled(case)
    before = len(wire.measured[BETA])
    wire.steps(250, commands)
    usual = len(wire.measured[BETA]) - before
    wire.absent.add(ALPHA)
    wire.steps(450, commands)
    before = len(wire.measured[BETA])
    wire.steps(250, commands)
    count = len(wire.measured[BETA]) - before
    if 2 * count < usual:
        raise Failure(f"alpha is gone: beta reports {count} times in 250 ms, not {usual}")


def newest_wins(case: Case) -> None:
    """On a line that is too slow what waits is bounded, and set-points that are sent are the newest."""
    wire, commands = settled(case)
    bench, wire.most = wire.bench, 0
    wire.line.rate = SLOW
    for each in wire.wires:
        each.byte = Wire(SLOW).byte
    kind = type(commands[0])
    named = tools.numbers(kind, case.spec.ranges)
    count, seen = len(wire.sent), dict[str, float]()
    for step in range(500):
        values = {name: 1e-3 * (step + 1) for name, _ in named}
        given = [tools.build(kind, name, case.spec.ranges, values) for name in NAMES] if named else commands
        wire.step(given)
        for t, sent in wire.sent[count:]:
            for one in bench.decoder.decode(t, bytes(sent)):
                if type(one) is kind and named:
                    _must_be_newer(one, named, seen, case, bytes(sent))
        count = len(wire.sent)
    if wire.most > WAITING:
        raise Failure(f"{wire.most} exchanges wait on a line of {SLOW} bit/s")


def _must_be_newer(
    one: Command, named: Sequence[tuple[str, str]], seen: dict[str, float], case: Case, sent: Frame
) -> None:
    """A set-point is not older than the one before. Raises Failure."""
    name, key = named[0]
    number, bounds = getattr(one, name), case.spec.ranges[key]
    motor = one.motor
    if number < seen.get(motor, number) - 2 * bounds.resolution - 4 * bounds.relative:
        raise Failure(
            f"{one} is sent behind {name} = {seen[motor]:g}, which was given later", (sent,), (one,)
        )
    seen[motor] = number


def not_later(case: Case) -> None:
    """What waited when Idle was given is not sent any more: nothing arms a device later."""
    wire, commands = settled(case)
    if msg.Idle not in case.spec.commands:
        raise Inapplicable("the spec does not list Idle")
    idle = [msg.Idle(name) for name in NAMES]
    wire.steps(SETTLED, idle)
    for held in range(1, 12):
        wire.line.slack = 60 * MILLISECOND
        wire.disturb = lambda *_: ()  # the line is held by an answer that does not come
        for _ in range(200):
            wire.step(idle)
            if wire.line.out is not None and not wire.line.held:
                break
        wire.steps(held, commands)
        wire.disturb, wire.line.slack = undisturbed, 3 * FINE
        since = wire.now
        wire.steps(100, idle)
        for t, sent in wire.sent:
            for one in wire.bench.decoder.decode(t, bytes(sent)) if t >= since else ():
                if isinstance(one, msg.Arm):
                    text = f"Idle was given in ms {(since - tools.START) // STEP}, and after it is sent"
                    raise Failure(text, (bytes(sent),), (one,))
        wire.steps(200, idle)


def _late(data: bytes, _: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return ((4 * MILLISECOND, data),)


def _doubled(data: bytes, _: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return (0, data), (2 * FINE, data)


def _of_another(data: bytes, other: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return (0, other), (FINE, data)


def _cut(data: bytes, _: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return ((0, data[: len(data) * 2 // 3]),)


def _behind_garbage(data: bytes, other: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return ((0, b"\x00\xff" + other[: len(other) // 2] + data),)


def _in_two(data: bytes, _: bytes) -> Sequence[tuple[Nanos, bytes]]:
    return (0, data[: len(data) // 2]), (FINE, data[len(data) // 2 :])


DISTURBED = {
    "late": _late,
    "doubled": _doubled,
    "preceded by another device's": _of_another,
    "cut": _cut,
    "behind garbage": _behind_garbage,
    "in two pieces": _in_two,
}


def answer_alike(case: Case) -> bool:
    """True if two devices in the same state send the same: their answers say neither whose they are, nor what
    they answer."""
    wire = on_wire(case)
    sent: dict[str, set[bytes]] = {name: set() for name in NAMES}

    def note(_: int, sender: str, data: bytes) -> Sequence[tuple[Nanos, bytes]]:
        sent[sender].add(data)
        return ((0, data),)

    for shaft in wire.bench.shafts.values():
        shaft.position = PLACES[ALPHA]
    wire.disturb = note
    wire.steps(SETTLED)
    both = sent[ALPHA] & sent[BETA]  # one alone may have answered for both, as an axis of a board does
    return 2 * len(both) > len(sent[BETA])


def wrong_answers_are_none(case: Case) -> None:
    """An answer that is late, doubled, of another device, cut or behind garbage trips nothing, and is taken
    for no other's. Where devices answer with the same bytes, nothing shows that one is another's."""
    alike = answer_alike(case)
    for what, change in DISTURBED.items():
        if alike and change in (_doubled, _of_another):
            continue
        wire, commands = settled(case)
        random, last = case.random(), dict[str, bytes]()

        def disturb(
            _: int,
            sender: str,
            data: bytes,
            change: Callable[[bytes, bytes], Sequence[tuple[Nanos, bytes]]] = change,
            random: Random = random,
            last: dict[str, bytes] = last,
        ) -> Sequence[tuple[Nanos, bytes]]:
            other = last.get(BETA if sender == ALPHA else ALPHA, b"")
            last[sender] = data
            return change(data, other) if sender == ALPHA and not random.below(8) else ((0, data),)

        first = len(wire.events)
        wire.disturb = disturb
        wire.steps(SETTLED, commands)
        _must_be_sound(wire, f"some of alpha's answers are {what}")
        for event in wire.events[first:]:
            if not isinstance(event, msg.Feedback) or event.position is None:
                continue
            if abs(event.position - PLACES.get(event.motor, event.position)) > 0.1:
                raise Failure(f"some of alpha's answers are {what}: a wrong position", (), (event,))
