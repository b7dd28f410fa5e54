"""Random sessions on a line of questions and answers, some of which are lost, late, or come twice.

Rules. Driver, line and two twins run on a true wire (`protocols.conformance.lines`), at a rate that is drawn;
commands change at random. Up to a tenth of the answers is lost, or reaches the host late or twice. Judged are
the wire (two never send at once, as long as answers come within the time that is declared for them, and
copies with them: what comes later may be taken for the answer to the next question), the events (no fault, no
device offline or disarmed), each position that is reported (the shaft was there a moment ago, as finely as it
is measured: nothing jumps, none is taken for another's), that nothing disarms, and the pauses: a lost answer
costs one reading. Where answers name neither sender nor question, a copy cannot be told from the next answer,
and none is made. Another kind of command may pass through a mode without a value: there a device is let go
until it gets one.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from random import Random

from protocols import messages as msg
from protocols.conformance import bench as tools
from protocols.conformance.bench import NAMES, STEP
from protocols.conformance.case import Case, addresses_of
from protocols.conformance.lines import DISTURBED, OnWire, answer_alike, on_wire
from protocols.messages import MILLISECOND, Command, Mode, Nanos
from protocols.plugin import Plugin, load_all
from tests.protocols.broken_lines import sound

RATES = (115_200, 460_800, 1_000_000, 3_000_000)
SPAN = 300
"""ms of disturbance"""
PAST: Nanos = 60 * MILLISECOND
"""How long ago a shaft may have been where it is reported."""
WITHIN: Nanos = 200_000
"""What an answer may be late, and still is in time."""
QUESTIONED: list[Plugin] = [
    sound,
    *(
        each
        for each in load_all()[0]
        if Case(each, each.tried(), 0, addresses_of(each)).spec.line != "free" and each.name != sound.name
    ),
]
"""The installed protocols whose devices speak only when asked."""


@cache
def names_nothing(name: str) -> bool:
    """True for a protocol whose answers name neither their sender nor what they answer."""
    (plugin,) = (each for each in QUESTIONED if each.name == name)
    return answer_alike(Case(plugin, plugin.tried(), 0, addresses_of(plugin)))


class LineSession:
    """One session. `run` raises AssertionError, with the seed, if something is wrong."""

    def __init__(self, plugin: Plugin, seed: int) -> None:
        self.name, self.seed, self.random = plugin.name, seed, Random(seed)
        self.case = Case(plugin, plugin.tried(), seed, addresses_of(plugin))
        self.wire: OnWire = on_wire(self.case, self.random.choice(RATES))
        self.share = self.random.uniform(0.0, 0.1)
        self.in_time = self.random.random() < 0.8
        """No answer comes later than is declared."""
        self.alike = names_nothing(plugin.name)
        self.disturbed: dict[str, list[Nanos]] = {name: [] for name in NAMES}
        """When an answer of each device was lost or late."""
        self.past: dict[str, list[tuple[Nanos, float]]] = {name: [] for name in NAMES}
        """Where each shaft was."""
        near = self.case.spec.ranges.get("Feedback.position")
        self.near = 0.02 + (near.resolution if near is not None else 0.0)
        """rad, by which a measurement may be off"""
        self.kind: type[Command] | None = None
        self.changing = set[str]()
        """Devices that have not been sent a command of the kind that is given now."""
        self.decoded = 0
        """Of what was sent."""
        for name in NAMES:
            self.wire.bench.shafts[name].locked = False

    def run(self) -> int:
        """Run it; return how many answers were disturbed."""
        commands = self.commands()
        self.wire.arm(commands)
        self.decode(judged=False)
        self.steps(60, commands)
        usual = {name: self.longest(times[len(times) // 2 :]) for name, times in self.wire.measured.items()}
        begun = self.wire.now
        self.wire.disturb = self.disturb
        for _ in range(SPAN // 50):
            commands = self.commands()
            self.steps(50, commands)
        for name, times in self.wire.measured.items():
            self.judge_pauses(name, [t for t in times if t >= begun], usual[name])
        overlaps = len(self.wire.down.collisions) + len(self.wire.up.collisions)
        self.must(not overlaps or not self.in_time, "two send at once")
        return sum(map(len, self.disturbed.values()))

    def commands(self) -> list[Command]:
        """Draw a command for each device: slow, small, or near."""
        kinds = [k for k in (msg.Velocity, msg.Position, msg.Torque) if k in self.case.kinds]
        kind = self.random.choice(kinds)
        if kind is not self.kind:
            self.kind, self.changing = kind, set(NAMES)
        size = {msg.Velocity: 1.0, msg.Position: 0.05, msg.Torque: 0.02}[kind]
        made = []
        for name in NAMES:
            at = self.wire.bench.shafts[name].position if kind is msg.Position else 0.0
            field = kind.__name__.lower()
            values = {field: at + size * self.random.uniform(-1.0, 1.0)}
            made.append(tools.build(kind, name, self.case.spec.ranges, values))
        return made

    def steps(self, count: int, commands: Sequence[Command]) -> None:
        """Advance, and judge what is reported and sent."""
        for _ in range(count):
            events = len(self.wire.events)
            for name in NAMES:
                here = self.wire.bench.shafts[name].position
                self.past[name] = [*self.past[name][-PAST // STEP :], (self.wire.now, here)]
            self.wire.step(commands)
            for event in self.wire.events[events:]:
                self.judge(event)
            self.decode()

    def decode(self, *, judged: bool = True) -> None:
        """Decode what was sent: it disarms nothing."""
        for t, each in self.wire.sent[self.decoded :]:
            for one in self.wire.bench.decoder.decode(t, bytes(each)):
                if isinstance(one, msg.Idle):
                    self.must(not judged or one.motor in self.changing, f"{one} is sent")
                elif self.kind is not None and isinstance(one, self.kind):
                    self.changing.discard(one.motor)
        self.decoded = len(self.wire.sent)

    def judge(self, event: msg.Event) -> None:
        """No fault, no state but armed, no position where the shaft was not."""
        self.must(not isinstance(event, msg.Fault), f"{event}")
        if isinstance(event, msg.State):
            self.must(event.mode is Mode.ARMED, f"{event}")
        if isinstance(event, msg.Feedback) and event.position is not None:
            places = [place for _, place in self.past[event.motor]]
            places.append(self.wire.bench.shafts[event.motor].position)
            low, high = min(places) - self.near, max(places) + self.near
            self.must(low <= event.position <= high, f"{event}, but it was at {low:.3f} to {high:.3f} rad")

    def disturb(self, _: int, sender: str, data: bytes) -> Sequence[tuple[Nanos, bytes]]:
        """Disturb some answers."""
        if self.random.random() >= self.share:
            return ((0, data),)
        hows = ["lost", "within", *(() if self.alike else ("doubled",)), *(() if self.in_time else ("late",))]
        how = self.random.choice(hows)
        if how == "within":
            return ((WITHIN, data),)
        if how == "doubled" and self.in_time:
            return (0, data), (0, data)
        if how != "doubled":
            self.disturbed[sender].append(self.wire.now)
        return () if how == "lost" else DISTURBED[how](data, b"")

    def judge_pauses(self, name: str, times: Sequence[Nanos], usual: Nanos) -> None:
        """No pause is longer than those that its lost answers, and the other's time-outs, account for."""
        line = self.wire.line
        for before, after in pairwise(times):
            lost = sum(before - usual <= t <= after for each in self.disturbed.values() for t in each)
            allowed = (lost + 2) * (usual + 2 * STEP) + lost * line.time(64)
            text = f"{name} is silent for {(after - before) / MILLISECOND:.1f} ms, {lost} answers were lost"
            self.must(after - before <= allowed, f"{text}; usually for {usual / MILLISECOND:.1f} ms")

    @staticmethod
    def longest(times: Sequence[Nanos]) -> Nanos:
        """Return the longest pause."""
        return max((b - a for a, b in pairwise(times)), default=0)

    def must(self, holds: bool, text: str) -> None:
        """Raise AssertionError unless something holds."""
        assert holds, f"{self.name}, seed {self.seed}, {self.wire.line.rate} bit/s: {text}"
