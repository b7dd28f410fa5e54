"""What a clause is given and what it gives back. Values, but for the rehearsals that a case starts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import zip_longest
from typing import Any, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

from protocols.conformance import bench as play
from protocols.conformance.bench import NAMES, START, STEP, STRANGER, Bench, StepResult
from protocols.conformance.random import Random
from protocols.frames import Frame
from protocols.messages import Idle, Message
from protocols.plugin import Device, Plugin, RxCounters, Spec

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Failure:
    """What is wrong, and the shortest bytes and words that show it."""

    text: str
    frames: tuple[Frame, ...] = ()
    words: tuple[Message, ...] = ()


@dataclass(frozen=True, slots=True)
class Inapplicable:
    """Why the spec makes a clause say nothing of the device."""

    reason: str


Verdict: TypeAlias = Failure | Inapplicable | None
"""None: the clause is kept."""


@dataclass(frozen=True, slots=True)
class Case:
    """A plugin to be tried, with one set of options."""

    plugin: Plugin
    options: Any
    seed: int
    addresses: tuple[int, int, int]
    """Of alpha and beta, who have one driver, and of a stranger whom it does not know."""
    kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """What is worked out once: the specs, and a busy day."""

    def start(self) -> Bench:
        """Alpha and beta, as they come out of the box."""
        return play.make_bench(self.plugin, self.options, self.addresses[:2], NAMES)

    def stranger(self) -> Bench:
        """A third device with a driver of its own."""
        return play.make_bench(self.plugin, self.options, self.addresses[2:], (STRANGER,))

    def armed(self) -> Bench | None:
        """Alpha and beta with motors armed by the gentlest command there is; None if they do not arm."""
        stage, spec = self.start(), self.spec
        kinds = by_name(spec.commands - {Idle})
        if kinds and not stage.arm(play.gentle(kinds[0], spec.ranges)):
            return None
        return stage

    @property
    def specs(self) -> tuple[Spec, ...]:
        """Of alpha and beta."""
        if "specs" not in self.kept:
            self.kept["specs"] = self.start().specs
        specs: tuple[Spec, ...] = self.kept["specs"]
        return specs

    @property
    def day(self) -> tuple[StepResult, ...]:
        """Alpha's and beta's busy day, over a wire without faults."""
        if "day" not in self.kept:
            stage = self.start()
            self.kept["day"] = tuple(stage.step(words) for words in play.script(self.spec, NAMES))
        day: tuple[StepResult, ...] = self.kept["day"]
        return day

    @property
    def usual(self) -> bool:
        """Whether this is the plugin with its default options: the first of `variants`."""
        return bool(self.options == self.plugin.options())

    @property
    def spec(self) -> Spec:
        """Alpha's; beta's differs in its ids only."""
        return self.specs[0]

    def part(self, count: int) -> int:
        """So many with the plugin's usual options, or where these make a device of another kind; else a
        quarter of them: other options seldom make another device."""
        usual = Device(NAMES[0], self.addresses[0], self.plugin.options(), self.plugin.settings())
        if "whole" not in self.kept:
            self.kept["whole"] = self.usual or self.plugin.spec(usual).kind != self.spec.kind
        return count if self.kept["whole"] else -(-count // 4)

    @property
    def sends(self) -> frozenset[int]:
        """The ids that the driver may send to alpha or beta."""
        return frozenset(i for spec in self.specs for i in spec.sends)

    @property
    def expects(self) -> frozenset[int]:
        """The ids that alpha or beta may send."""
        return frozenset(i for spec in self.specs for i in spec.expects)

    def random(self) -> Random:
        """A generator that starts anew for each clause."""
        return Random(self.seed)


def variants(plugin: Plugin) -> Iterator[Any]:
    """The plugin's default options, then those that differ in one Literal or bool each."""
    default = plugin.options()
    yield default
    hints = get_type_hints(plugin.options)
    for f in fields(plugin.options):
        literal = get_origin(hints[f.name]) is Literal
        values = get_args(hints[f.name]) if literal else (False, True) if hints[f.name] is bool else ()
        for value in values:
            if value != getattr(default, f.name):
                try:
                    yield plugin.options(**{f.name: value})
                except ValueError:
                    continue  # It does not stand alone; the plugin says so itself.


def by_name(kinds: Iterable[type[T]]) -> list[type[T]]:
    """Kinds of words in an order that is always the same."""
    return sorted(kinds, key=lambda kind: kind.__name__)


def counts(counters: RxCounters) -> tuple[int, int, int]:
    """(heard, bad, foreign), a value that can be kept and compared."""
    return counters.accepted, counters.malformed, counters.ignored


def difference(
    one: StepResult, other: StepResult, this: str, that: str, frames: Sequence[Frame] = ()
) -> Failure:
    """Where two steps that should be alike are not: the first part, and in it the first thing."""
    for f in fields(StepResult):
        left, right = getattr(one, f.name), getattr(other, f.name)
        if left == right:
            continue
        if isinstance(left, tuple):
            left, right = _first(left, right)
        text = f"{f.name} in ms {(one.now - START) // STEP} {this}: {shown(left)}; {that}: {shown(right)}"
        return Failure(text, tuple(frames) or (*one.down, *other.down)[:4])
    return Failure(f"{this} and {that} differ")


def _first(left: tuple[object, ...], right: tuple[object, ...]) -> tuple[object, object]:
    """The first two things that differ; "nothing" where one side is shorter."""
    pairs = zip_longest(left, right, fillvalue="nothing")
    return next((a, b) for a, b in pairs if a != b)


def shown(thing: object) -> str:
    """A wire as a person reads it (bytes in hex, a frame as candump has it), or a word."""
    return (thing.hex(" ") or "(no bytes)") if isinstance(thing, bytes) else str(thing)
