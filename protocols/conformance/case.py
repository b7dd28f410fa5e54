"""What a clause is given and what it gives back. Values, but for the rehearsals that a case starts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from itertools import zip_longest
from typing import Any, TypeAlias, TypeVar

from protocols.conformance import rehearsal as play
from protocols.conformance.dice import Dice
from protocols.conformance.rehearsal import NAMES, START, STEP, STRANGER, Rehearsal, Said
from protocols.plugin import Plugin, Spec, Tally
from protocols.wire import Wire
from protocols.words import Idle, Word

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Failure:
    """What is wrong, and the shortest bytes and words that show it."""

    text: str
    wires: tuple[Wire, ...] = ()
    words: tuple[Word, ...] = ()


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

    def start(self) -> Rehearsal:
        """Alpha and beta, as they come out of the box."""
        return play.rehearse(self.plugin, self.options, self.addresses[:2], NAMES)

    def stranger(self) -> Rehearsal:
        """A third device with a driver of its own."""
        return play.rehearse(self.plugin, self.options, self.addresses[2:], (STRANGER,))

    def armed(self) -> Rehearsal | None:
        """Alpha and beta with motors armed by the gentlest command there is; None if they do not arm."""
        stage, spec = self.start(), self.spec
        kinds = by_name(spec.commands - {Idle})
        if kinds and not stage.arm(play.gentle(kinds[0], spec.ranges)):
            return None
        return stage

    @property
    def specs(self) -> tuple[Spec, ...]:
        """Of alpha and beta."""
        return self.start().specs

    @property
    def spec(self) -> Spec:
        """Alpha's; beta's differs in its ids only."""
        return self.specs[0]

    @property
    def sends(self) -> frozenset[int]:
        """The ids that the driver may send to alpha or beta."""
        return frozenset(i for spec in self.specs for i in spec.sends)

    @property
    def expects(self) -> frozenset[int]:
        """The ids that alpha or beta may send."""
        return frozenset(i for spec in self.specs for i in spec.expects)

    def dice(self) -> Dice:
        """A generator that starts anew for each clause."""
        return Dice(self.seed)


def by_name(kinds: Iterable[type[T]]) -> list[type[T]]:
    """Kinds of words in an order that is always the same."""
    return sorted(kinds, key=lambda kind: kind.__name__)


def counts(tally: Tally) -> tuple[int, int, int]:
    """(heard, bad, foreign), a value that can be kept and compared."""
    return tally.heard, tally.bad, tally.foreign


def difference(one: Said, other: Said, this: str, that: str, wires: Sequence[Wire] = ()) -> Failure:
    """Where two steps that should be alike are not: the first part, and in it the first thing."""
    for f in fields(Said):
        left, right = getattr(one, f.name), getattr(other, f.name)
        if left == right:
            continue
        if isinstance(left, tuple):
            left, right = _first(left, right)
        text = f"{f.name} in ms {(one.now - START) // STEP} {this}: {shown(left)}; {that}: {shown(right)}"
        return Failure(text, tuple(wires) or (*one.down, *other.down)[:4])
    return Failure(f"{this} and {that} differ")


def _first(left: tuple[object, ...], right: tuple[object, ...]) -> tuple[object, object]:
    """The first two things that differ; "nothing" where one side is shorter."""
    pairs = zip_longest(left, right, fillvalue="nothing")
    return next((a, b) for a, b in pairs if a != b)


def shown(thing: object) -> str:
    """A wire as a person reads it (bytes in hex, a frame as candump has it), or a word."""
    return (thing.hex(" ") or "(no bytes)") if isinstance(thing, bytes) else str(thing)
