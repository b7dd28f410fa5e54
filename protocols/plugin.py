"""The plugin interface, whole: what a device language must bring, and how it is found.

Rules. A driver, an ear and a twin own no socket, no clock, no thread and no randomness of their
own: time is an argument, randomness is seeded, what is to be sent is returned. Their state is plain
data that `copy.deepcopy` copies (no generators, no open files). `receive` and `hear` never raise, on
any bytes; bad bytes are counted in `tally` and change nothing. `protocols.conformance` proves all this.

A third party's distribution is found by one line in its pyproject.toml:

    [project.entry-points."motor_gateway.protocols"]
    foo = "their_package:plugin"
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.metadata import EntryPoint, distributions, entry_points
from itertools import groupby
from typing import Any, Literal, Protocol

from protocols.frames import BusState, Frame
from protocols.messages import Command, Event, Nanos, Request, Torque

GROUP = "motor_gateway.protocols"
OURS = "motor-gateway"
"""The distribution that this interface belongs to."""


@dataclass(frozen=True, slots=True)
class Device:
    """One device of a language on one bus, as the robot file has it."""

    name: str
    """Name of the motor or sensor in the robot file."""
    address: int
    options: Any
    """An instance of the plugin's `options` dataclass: what our driver should do."""
    settings: Any
    """An instance of the plugin's `settings` dataclass: what is configured on the device itself.
    The twin is built with it; a driver must not need it."""


@dataclass(slots=True)
class RxCounters:
    """Exact counts of what was received: every frame (on a stream, every message) is counted once."""

    accepted: int = 0
    """Understood, and for one of the driver's devices."""
    malformed: int = 0
    """Addressed to one of the driver's devices, but with a wrong length, checksum or content: it had no effect."""
    ignored: int = 0
    """For another device or protocol, or another kind of frame."""


class FeedbackKind(StrEnum):
    """How the device tells its state."""

    NONE = "none"
    POLLED = "polled"
    CYCLIC = "cyclic"


@dataclass(frozen=True, slots=True)
class Range:
    """What a quantity may be on the wire at the device's shaft, in SI."""

    low: float
    high: float
    resolution: float
    """The largest error between the two ends: absolute, in the quantity's unit. For feedback the
    device's own steps (of its encoder, as configured) are part of it."""
    relative: float = 0.0
    """And relative to the value (float32: 2**-24)."""


@dataclass(frozen=True, slots=True)
class Watchdog:
    """What the device does when its host falls silent."""

    timeout: Nanos | None
    """None: the device has no watchdog."""
    enabled: bool
    """Whether it is on as the device stands, as far as options and settings tell."""
    note: str = ""
    """What a person must know, said at every start until the robot file acknowledges it."""
    fed_by: Literal["its commands", "any command", "any wire"] = "its commands"
    """What keeps it from tripping: a command to this device; a command to any device of its driver (a
    heartbeat that the driver sends while it is commanded); or whatever the host says, questions too: then it
    tells a host that is gone, not one that has nothing to say."""


@dataclass(frozen=True, slots=True)
class FaultInfo:
    """What a device says is wrong with it, as a person should read it."""

    name: str
    """In the vendor's words."""
    cause: str
    """The likely cause."""
    remedy: str
    """What to do."""
    latching: bool = True
    """Whether the device itself keeps it until it is cleared. False: what the device takes back by itself,
    such as the verdict on a request that the next request replaces; the joint remembers it all the same."""


@dataclass(frozen=True, slots=True)
class Spec:
    """The contract of one device: the one source for joint, guard, doctor and conformance kit."""

    bus: Literal["can", "canfd", "serial"]
    kind: Literal["motor", "sensor"]
    sends: frozenset[int]
    """CAN ids that the driver may send for this device (empty on serial)."""
    expects: frozenset[int]
    """CAN ids that the device sends (empty on serial)."""
    read_only: Callable[[Frame], bool]
    """Whether a wire neither moves, arms, clears nor configures anything."""
    feedback: FeedbackKind
    feedback_period: Nanos
    """How often the device reports its motion or, if polled, how often the driver asks."""
    offline_after: Nanos
    """Silence of the device after which its joint is blind."""
    commands: frozenset[type[Command]]
    requests: frozenset[type[Request]]
    ranges: dict[str, Range]
    """By "Word.field" for each number that can stand in a command or feedback: "Velocity.velocity",
    "Feedback.position"."""
    watchdog: Watchdog
    holds_unattended: bool
    """Whether the device keeps its load after Hold as the last word, with nobody feeding it."""
    stop_clears_faults: bool
    """Whether disarming clears the device's own faults (then a joint must remember them)."""
    faults: Mapping[int, FaultInfo] = field(default_factory=dict)
    """By code (`Fault.code`): everything that the device may complain of, as its driver tells it."""
    unprotected: frozenset[str] = frozenset()
    """Names of messages (`Plugin.messages`) that the device takes though nothing in them guards against a
    wrong bit. Where they are damaged the contract is silent, and a driver must not lean on them."""
    receives_also: tuple[tuple[int, int], ...] = ()
    """What the driver understands of any device, named in the robot file or not (answers to a scan,
    devices with an address that is held twice), or of a second host: CAN ids as (id, mask), whose masked bits
    are these."""
    extended: frozenset[int] | None = None
    """Those of its ids that are 29-bit ones. None: those above 0x7FF, which can be nothing else."""
    obeys_also: tuple[tuple[int, int], ...] = ()
    """Which ids the device heeds beside `sends`, whoever uses them: as (id, mask), with bit 31 for the format
    (1: 29 bits), as the kernel's filters have them. Other languages on its bus must keep off."""

    def is_extended(self, number: int) -> bool:
        """Whether an id of `sends` or `expects` is a 29-bit one."""
        return number > 0x7FF if self.extended is None else number in self.extended


class Driver(Protocol):
    """Our end of the wire, for all devices of a language on one bus. Keeps no clock and no bus."""

    counters: RxCounters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """What the wire says. `t` is the packet's own stamp. Never raises; [] to what is not ours."""
        ...

    def bus(self, t: Nanos, state: BusState) -> None:
        """The bus changed its state: what was sent may be lost, devices may have restarted."""
        ...

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Say the words: at most one Command per motor, and what the driver has to say by itself.

        Returns the events that need no answer of the device (Refused, a timeout, State offline) and
        what is to be sent, in order. A command holding a value that is not finite, or outside
        the spec's range, puts no frame on the wire."""
        ...

    def due(self) -> Nanos | None:
        """When the driver next has something to say by itself (polling, keep-alive, a timeout)."""
        ...


class CommandDecoder(Protocol):
    """What the devices would obey. Remembers what it has heard (mode, mapping), touches nothing else."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        """The words that a device would obey on hearing this wire; [] if it would do nothing."""
        ...


class Twin(Protocol):
    """One device: an ear, and the firmware behind it. The shaft belongs to the world."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """A wire reached the device. Never raises."""
        ...

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`, given what the world says of the shaft (Feedback) or shows
        to the sensor (Imu, LaserScan). Returns the torque on the shaft, at the device's side of
        the gear, and what the device has put on the wire. Steps may be as short as the world's."""
        ...

    def due(self) -> Nanos | None:
        """When the device next has something to say by itself."""
        ...

    def provoke(self, code: int) -> None:
        """The firmware trips this fault of `Spec.faults` now, as if it had found it by itself.

        For rehearsals: no wire leads here. ValueError if the device has no such fault."""
        ...


@dataclass(frozen=True, slots=True)
class Plugin:
    """One device language."""

    name: str
    title: str
    """One line: which devices, which firmware lines."""
    trust: str
    """Which bytes were checked against which package@version or repository@commit."""
    options: type
    """Dataclass of typed options with defaults: what the driver should do. Checked by `config`
    (types, unknown names); its `__post_init__` may raise ValueError with a sentence."""
    settings: type
    """Dataclass of typed settings with defaults: what is configured on the device (for the twin)."""
    spec: Callable[[Device], Spec]
    driver: Callable[[Sequence[Device]], Driver]
    decoder: Callable[[Sequence[Device]], CommandDecoder]
    twin: Callable[[Device, int], Twin]
    """From the device and a seed."""
    messages: Callable[[Frame], Sequence[str]]
    """The names, in the vendor's words, of the messages to a device that a wire holds; () if none.
    Messages of one name differ in their values only: an independent vector of it speaks for all."""
    vectors: tuple[str, str] | None = None
    """Bytes from an independent source: a package and the path of a JSON file in it (protocols.reference_vectors).
    None: there are none, and then the contract accepts no message that moves a motor."""


@dataclass(frozen=True, slots=True)
class Broken:
    """An installed plugin that could not be loaded: named and left out, it hinders nobody."""

    name: str
    distribution: str
    reason: str


class UnknownProtocol(LookupError):
    """No such protocol is installed, or it is broken."""

    def __init__(self, name: str, installed: Sequence[str], broken: Broken | None = None) -> None:
        self.name, self.installed, self.broken = name, tuple(installed), broken
        if broken:
            said = f"protocol {name!r} of {broken.distribution} is broken: {broken.reason}"
        else:
            near = difflib.get_close_matches(name, self.installed, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            said = f"no protocol {name!r}; installed: {', '.join(self.installed)}{hint}"
        super().__init__(said)


def installed() -> tuple[EntryPoint, ...]:
    """The entry points of every installed protocol, by name. Takes milliseconds: call it at start."""
    return _found()[0]


def _found() -> tuple[tuple[EntryPoint, ...], list[Broken]]:
    """The entry points by name, and the distributions that cannot be read."""
    unread: list[Broken] = []
    try:
        points = list(entry_points(group=GROUP))
    except Exception:  # noqa: BLE001 -- one ill-formed file spoils it for all: so one by one
        points, seen = [], set[str]()
        for distribution in distributions():
            name = distribution.name or "?"
            try:
                own = distribution.entry_points.select(group=GROUP)
            except Exception as error:  # noqa: BLE001 -- whatever is wrong with it
                unread.append(Broken("?", name, f"its entry points cannot be read: {error}"))
                continue
            points += own if name not in seen else ()
            seen.add(name)
    return tuple(sorted(points, key=lambda point: (point.name, _owner(point)))), unread


def load(name: str) -> Plugin:
    """The plugin of this name; no other is imported. Raises UnknownProtocol with what there is."""
    points = installed()
    names = tuple(dict.fromkeys(point.name for point in points))
    plugins, broken = _settle([point for point in points if point.name == name])
    if plugins:
        return plugins[0]
    raise UnknownProtocol(name, names, broken[0] if broken else None)


def load_all() -> tuple[tuple[Plugin, ...], tuple[Broken, ...]]:
    """Every installed plugin, and those that could not be loaded with the reason."""
    found, broken = _found()
    plugins: list[Plugin] = []
    for _, points in groupby(found, key=lambda point: point.name):
        good, bad = _settle(list(points))
        plugins += good
        broken += bad
    return tuple(plugins), tuple(broken)


def _settle(points: Sequence[EntryPoint]) -> tuple[list[Plugin], list[Broken]]:
    """What the entry points of one name come to.

    Where several distributions bring the name, ours has it; among others none has, since which of them
    moves a motor must not hang on the order of folders."""
    if len(points) > 1:
        owners = [_owner(point) for point in points]
        broken = []
        for at, owner in enumerate(owners):
            others = " and ".join(owners[:at] + owners[at + 1 :])
            if owner != OURS:
                broken.append(Broken(points[at].name, owner, f"{others} has a protocol of that name too"))
        ours = [point for point in points if _owner(point) == OURS]
        plugins, bad = _settle(ours[:1])
        return plugins, bad + broken
    loaded = [_load(point) for point in points]
    return [p for p in loaded if isinstance(p, Plugin)], [p for p in loaded if isinstance(p, Broken)]


def _load(point: EntryPoint) -> Plugin | Broken:
    """The plugin, tried as far as it can be without a device."""
    if not point.pattern.match(point.value):
        return Broken(point.name, _owner(point), f"{point.value!r} is not MODULE:NAME")
    try:
        plugin = point.load()
        wrong = _wrong(point, plugin)
    except KeyboardInterrupt:  # a person's, who wants to leave
        raise
    except BaseException as error:  # noqa: BLE001 -- a third party's module may raise anything, SystemExit too
        wrong = f"{type(error).__name__}: {error}{_wanted(point, error)}"
    return Broken(point.name, _owner(point), wrong) if wrong else plugin


def _wrong(point: EntryPoint, plugin: object) -> str:
    """What is wrong with what an entry point gave; "" if nothing. Raises what the plugin raises."""
    if not isinstance(plugin, Plugin):
        return f"{point.value} is not a protocols.plugin.Plugin"
    if plugin.name != point.name:
        return f"its entry point is called {point.name!r}, and it calls itself {plugin.name!r}"
    device = Device("motor", 1, plugin.options(), plugin.settings())
    try:
        spec = plugin.spec(device)
    except ValueError:  # an address, or options, that it cannot have: that is a robot file's affair
        return ""
    return (
        "" if isinstance(spec, Spec) else f"its spec gives {type(spec).__name__}, not protocols.plugin.Spec"
    )


def _wanted(point: EntryPoint, error: BaseException) -> str:
    """Which version of the gateway a distribution asks for, where it may fail for want of it."""
    requirements = (point.dist.requires if point.dist else None) or ()
    asked = [r for r in requirements if re.match(rf"{OURS}\b", r, re.IGNORECASE)]
    if not asked or not isinstance(error, TypeError | ImportError | AttributeError):
        return ""
    return f" (it asks for {asked[0]})"


def _owner(point: EntryPoint) -> str:
    """The distribution that an entry point belongs to."""
    return (point.dist.name if point.dist else None) or "?"
