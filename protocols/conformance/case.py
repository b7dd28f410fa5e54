"""A case, what a clause is given; and Failure and Inapplicable, which a clause raises."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import zip_longest
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints
from zlib import crc32

from protocols.conformance import bench as tools
from protocols.conformance.bench import NAMES, START, STEP, STRANGER, Bench, StepResult
from protocols.conformance.random import Random
from protocols.frames import CanFrame, Frame, IdMask, any_matches, id_number
from protocols.messages import Command, Idle, Message, Torque
from protocols.plugin import Device, FeedbackKind, Plugin, RxCounters, Spec

T = TypeVar("T")
SAMPLE = 3
"""With options other than the default ones, one in so many trials is made (`Case.sample`)."""


class Failure(Exception):
    """The plugin breaks a clause: what is wrong, and the shortest frames and messages that show it."""

    def __init__(self, text: str, frames: Sequence[Frame] = (), messages: Sequence[Message] = ()) -> None:
        super().__init__(text)
        self.text, self.frames, self.messages = text, tuple(frames), tuple(messages)


class Inapplicable(Exception):
    """The clause does not apply to the device, and which part of the spec makes it so."""


@dataclass(frozen=True)
class Case:
    """A plugin with one set of options."""

    plugin: Plugin
    options: Any
    seed: int
    addresses: tuple[int, int, int]
    """Of alpha and beta, which have one driver, and of a stranger, which it does not know."""
    brief: bool = False
    """A sample of the trials is made with the default options, too."""

    @property
    def names(self) -> tuple[str, ...]:
        """Alpha and beta; alpha alone, where a line has one device, since nothing on it is addressed."""
        return NAMES[: len(set(self.addresses[:2]))]

    def start(self) -> Bench:
        """Set up alpha and beta as delivered."""
        return tools.make_bench(self.plugin, self.options, self.addresses[: len(self.names)], self.names)

    def stranger(self) -> Bench:
        """Set up a third device with a driver of its own."""
        return tools.make_bench(self.plugin, self.options, self.addresses[2:], (STRANGER,))

    def armed(self) -> Bench | None:
        """Set up alpha and beta, armed by the gentlest command; None if they do not arm."""
        bench = self.start()
        kinds = self.kinds
        return None if kinds and not bench.arm(tools.gentle(kinds[0], self.spec.ranges)) else bench

    def reporting(self) -> Bench:
        """Set up alpha and beta so that they report, with `prompt`: armed, if they only reply to commands."""
        bench = self.start()
        if self.prompt and not bench.arm(tools.gentle(type(self.prompt[0]), self.spec.ranges)):
            raise Failure("does not arm, and reports only in replies to commands")
        return bench

    @property
    def prompt(self) -> list[Command]:
        """The commands that make the devices report: none, but for those that only reply to commands."""
        if self.spec.feedback is not FeedbackKind.REPLY or not self.kinds:
            return []
        gentlest = Torque if Torque in self.kinds else self.kinds[0]
        return [tools.build(gentlest, name, self.spec.ranges) for name in NAMES]

    @cached_property
    def specs(self) -> tuple[Spec, ...]:
        """Of alpha and beta."""
        return self.start().specs

    @property
    def spec(self) -> Spec:
        """Alpha's; beta's differs in its ids only."""
        return self.specs[0]

    @property
    def kinds(self) -> list[type[Command]]:
        """The commands that arm: all but Idle, by name."""
        return by_name(self.spec.commands - {Idle})

    @cached_property
    def baseline(self) -> tuple[StepResult, ...]:
        """The steps of the whole `script`, on a bus without faults."""
        bench = self.start()
        return tuple(bench.step(messages) for messages in tools.script(self.spec, self.names))

    @property
    def default(self) -> bool:
        """True for the plugin's default options: the first of `variants`."""
        return bool(self.options == self.plugin.tried())

    @cached_property
    def whole(self) -> bool:
        """True for the default options, and for options that make it another kind of device."""
        usual = Device(NAMES[0], self.addresses[0], self.plugin.tried(), self.plugin.settings())
        return self.default or self.plugin.spec(usual).kind != self.spec.kind

    def counts_otherwise(self, usual: Case) -> bool:
        """True if the options change ranges, or which commands are the same."""
        one, other = self.spec, usual.spec
        return (one.ranges, one.canonical) != (other.ranges, other.canonical)

    def converses_otherwise(self, usual: Case) -> bool:
        """True if the options change anything else of the spec but a text, or what is sent when."""
        one, other = self.spec, usual.spec
        watchdog = replace(one.watchdog, note=other.watchdog.note)
        same = replace(one, ranges=other.ranges, canonical=other.canonical, watchdog=watchdog)
        same = replace(same, read_only=other.read_only)  # what it returns is part of the conversation
        return same != other or self.conversation != usual.conversation

    @cached_property
    def conversation(self) -> tuple[object, ...]:
        """The messages of each step of the baseline, without their data, and what of them is read-only."""
        named, harmless = self.plugin.messages, self.spec.read_only
        return tuple(
            ([(named(frame), harmless(frame)) for frame in step.down], [_form(frame) for frame in step.up])
            for step in self.baseline
        )

    def share(self, count: int) -> int:
        """Return `count`, or a quarter of it with other options: these seldom make another device."""
        return count if self.whole and not self.brief else -(-count // 4)

    def sample(self, items: Sequence[T]) -> list[T]:
        """Return all of these, or with other options one in `SAMPLE` of them, chosen by the seed."""
        if self.whole and not self.brief:
            return list(items)
        first = crc32(f"{self.seed} {self.options}".encode()) % SAMPLE
        return list(items[first::SAMPLE]) or list(items[:1])

    @cached_property
    def sends(self) -> tuple[IdMask, ...]:
        """The ids that the driver may send to alpha or beta."""
        return tuple(dict.fromkeys(ids for spec in self.specs for ids in spec.sends))

    @cached_property
    def expects(self) -> tuple[IdMask, ...]:
        """The ids that alpha or beta may send."""
        return tuple(dict.fromkeys(ids for spec in self.specs for ids in spec.expects))

    @cached_property
    def says_nothing_unasked(self) -> bool:
        """True if what the devices send says nothing to who has not asked: neither whose it is, nor where it
        begins."""
        if self.spec.line == "free":
            return False
        driver = self.plugin.driver(self.start().devices)
        for frame in (frame for step in self.baseline for frame in step.up):
            driver.receive(START, frame)
        return not driver.counters.accepted

    def random(self) -> Random:
        """Return a new generator; each clause starts from the same seed."""
        return Random(self.seed)


def _form(frame: Frame) -> object:
    """Return a frame's id and length."""
    return (id_number(frame), len(frame.data)) if isinstance(frame, CanFrame) else len(frame)


def variants(plugin: Plugin) -> Iterator[Any]:
    """Yield the plugin's default options, then those that differ in one Literal or bool each."""
    default = plugin.tried()
    yield default
    yield from valid(default, [dict([each]) for each in alternatives(default)])


def alternatives(default: Any) -> list[tuple[str, object]]:  # noqa: ANN401 -- a dataclass of the plugin's
    """Return the fields that are a Literal or a bool, each with every other value."""
    hints = get_type_hints(type(default))
    found: list[tuple[str, object]] = []
    for f in fields(default):
        literal = get_origin(hints[f.name]) is Literal
        values = get_args(hints[f.name]) if literal else (False, True) if hints[f.name] is bool else ()
        found += [(f.name, value) for value in values if value != getattr(default, f.name)]
    return found


def valid(default: Any, changes: Iterable[dict[str, object]]) -> Iterator[Any]:  # noqa: ANN401 -- as above
    """Yield the default with each of these changes, but for those that the plugin itself rejects."""
    for change in changes:
        try:
            yield replace(default, **change)
        except ValueError:
            continue


def addresses_of(plugin: Plugin) -> tuple[int, int, int]:
    """Return three addresses that its devices can have: 1, 2 and 3, or else the lowest. If there is only one,
    it is given twice, and then one that none can have."""
    able: list[int] = []
    for address in (*tools.ADDRESSES, *range(256)):
        try:
            plugin.spec(Device(NAMES[0], address, plugin.tried(), plugin.settings()))
        except ValueError:
            continue
        except Exception:  # noqa: BLE001 -- a third party's plugin may raise anything: its clauses say so
            return tools.ADDRESSES
        able += [address] if address not in able else []
        if len(able) == len(tools.ADDRESSES):
            break
    if len(able) == 1:
        return able[0], able[0], able[0] + 1
    first, second, third, *_ = *able, *(each for each in tools.ADDRESSES if each not in able)
    return first, second, third


def all_devices(case: Case, options: object) -> Iterator[tuple[Device, Spec]]:
    """Yield a device at each possible address, and its spec."""
    for address in range(256):
        device = Device(NAMES[0], address, options, case.plugin.settings())
        try:
            yield device, case.plugin.spec(device)
        except ValueError:
            continue


def among(choices: Sequence[IdMask], frame: Frame) -> bool:
    """True if a frame is among these ids, or of a bus that has none."""
    return not isinstance(frame, CanFrame) or any_matches(choices, frame)


def by_name(kinds: Iterable[type[T]]) -> list[type[T]]:
    """Return types of messages in an order that is always the same."""
    return sorted(kinds, key=lambda kind: kind.__name__)


def counts(counters: RxCounters) -> tuple[int, int, int]:
    """Return (accepted, malformed, ignored), a value that can be kept and compared."""
    return counters.accepted, counters.malformed, counters.ignored


def difference(
    one: StepResult, other: StepResult, this: str, that: str, frames: Sequence[Frame] = ()
) -> Failure:
    """Return where two steps that should be equal differ: the first field, and in it the first item."""
    for f in fields(StepResult):
        left, right = getattr(one, f.name), getattr(other, f.name)
        if left == right:
            continue
        if isinstance(left, tuple):
            pairs = zip_longest(left, right, fillvalue="nothing")
            left, right = next((a, b) for a, b in pairs if a != b)
        text = f"{f.name} in ms {(one.now - START) // STEP} {this}: {shown(left)}; {that}: {shown(right)}"
        return Failure(text, frames or (*one.down, *other.down)[:4])
    return Failure(f"{this} and {that} differ")


def shown(thing: object) -> str:
    """Return a frame as a person reads it (bytes in hex, a CAN frame in candump's notation), or a message."""
    return (thing.hex(" ") or "(no bytes)") if isinstance(thing, bytes) else str(thing)
