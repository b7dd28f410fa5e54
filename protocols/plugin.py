"""The plugin interface: what a protocol must provide, and how an installed protocol is found.

Rules for who writes a plugin. Drivers, command decoders and twins own no socket, no clock, no thread and
no random generator of their own: time is an argument, randomness is seeded, and frames to be sent are
returned. Their state is plain data that `copy.deepcopy` can copy (no generators, no open files).
`receive` and `decode` never raise, on any bytes; malformed bytes are counted in `counters` and change
nothing. All numbers are SI at the device's own shaft, before any gear. `protocols.conformance` tests this.

A distribution of a third party is found by one entry point in its pyproject.toml:

    [project.entry-points."motor_gateway.protocols"]
    foo = "their_package:plugin"
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, lru_cache
from importlib.metadata import EntryPoint
from itertools import groupby
from math import inf
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

from protocols.entry_points import OURS, is_ours, offered, owner
from protocols.frames import BusState, Frame, IdMask
from protocols.line import Exchange
from protocols.messages import Command, Event, Nanos, Obeyed, Request, Torque
from protocols.suggest import did_you_mean

GROUP = "motor_gateway.protocols"


# -- what a plugin describes ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Device:
    """One device of a protocol on one bus, as the robot file describes it."""

    name: str
    """Name of the motor or sensor in the robot file."""
    address: int
    options: Any
    """An instance of the plugin's `options` dataclass: how our driver should behave."""
    settings: Any
    """An instance of the plugin's `settings` dataclass: what is configured on the device itself.
    The twin is built with it; a driver must not need it."""
    line_rate: int = 0
    """bit/s of the serial line that the device is on; 0 on a CAN bus, or if unknown"""


@dataclass(slots=True)
class RxCounters:
    """Exact counts of what was received: every frame (on a stream, every message) is counted once."""

    accepted: int = 0
    """Valid, and from or for one of the driver's devices."""
    malformed: int = 0
    """Of one of the driver's devices, and without effect, as its length, checksum or content was wrong."""
    ignored: int = 0
    """Of another device or protocol, or another kind of frame."""

    def add(self, *, accepted: int = 0, malformed: int = 0, ignored: int = 0) -> None:
        """Count."""
        self.accepted += accepted
        self.malformed += malformed
        self.ignored += ignored


class FeedbackKind(StrEnum):
    """How the device reports its feedback."""

    NONE = "none"
    POLLED = "polled"
    CYCLIC = "cyclic"
    REPLY = "reply"
    """Only in replies to its commands: nothing read-only makes it report."""


@dataclass(frozen=True, slots=True)
class Range:
    """The range and resolution of a quantity as transferred on the bus, at the device's shaft, in SI."""

    low: float
    high: float
    resolution: float
    """The largest error between the two ends: absolute, in the quantity's unit. For feedback the
    device's own steps (of its encoder, as configured) are part of it."""
    relative: float = 0.0
    """The largest error relative to the value, in addition (float32: 2**-24)."""


@dataclass(frozen=True, slots=True)
class Watchdog:
    """What the device does when its host stops sending."""

    timeout: Nanos | None
    """None: the device has no watchdog."""
    enabled: bool
    """True if the watchdog is on, according to the options and settings of the device."""
    note: str = ""
    """What a person must know, printed at every start until the robot file acknowledges it."""
    fed_by: Literal["its commands", "any command", "any frame"] = "its commands"
    """What keeps it from tripping: a command to this device; a command to any device of its driver (a
    heartbeat that the driver sends while it is commanded); or any frame of the host, polling included: then
    it detects a host that is gone, not one that has stopped commanding."""


@dataclass(frozen=True, slots=True)
class FaultInfo:
    """The description of one fault of a device, for a person."""

    name: str
    """The vendor's name for the fault."""
    cause: str
    """The likely cause."""
    remedy: str
    """What to do."""
    latching: bool = True
    """True if the device keeps the fault until it is cleared. False: the device withdraws it by itself,
    such as the result of a request that the next request replaces; the joint latches it all the same."""


DRIVER_WRITES = "the driver writes it before it arms"
"""Why a `Setting` is protected that may differ at any time."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter of a device's configuration, by its name for ReadParameter."""

    expected: float | None = None
    """The value that the robot file states; None: none."""
    low: float = -inf
    high: float = inf
    """The lowest and highest value that may be written."""
    protected: str = ""
    """Why a tool never writes it (an address, a calibration); "" if it may."""
    limit: Literal["", "velocity", "torque"] = ""
    """The limit of the joint that it must not be below."""
    unit: float = 1.0
    """One unit of the parameter at the device's shaft, in the limit's unit in SI."""


Declared: TypeAlias = float | tuple[float, float] | tuple[float, type[Command]] | str
"""A value; the lowest and the highest one; a value that goes with this command alone; or the number of the
command that it is, as in `Spec.ranges`: "Velocity.velocity"."""
Written: TypeAlias = Mapping[str, tuple[Declared, ...]]
"""What is written, by the name in the WriteParameter or Kept that the command decoder makes of it: a
parameter's, or the vendor's name of a message that is none."""
ANY: tuple[tuple[float, float]] = ((-inf, inf),)
"""Any value but NaN."""


def as_it_is(parameter: str) -> str:
    """Return the name: the device has one for each parameter."""
    return parameter


def unchanged(command: Command) -> Command:
    """Return the command: to the device, no two commands are the same."""
    return command


@dataclass(frozen=True, slots=True)
class Spec:
    """The properties of one device: the one source for joint, guard, doctor and conformance tests."""

    bus: Literal["can", "canfd", "serial", "i2c", "camera"]
    kind: Literal["motor", "sensor"]
    sends: tuple[IdMask, ...]
    """CAN ids that the driver may send for this device (empty on serial). Where the mask leaves bits open,
    these carry data (a torque, a fault), and are the message's own matter."""
    expects: tuple[IdMask, ...]
    """CAN ids that the device sends (empty on serial)."""
    read_only: Callable[[Frame], bool]
    """True if a frame neither moves, arms, clears nor configures anything."""
    feedback: FeedbackKind
    feedback_period: Nanos
    """The period at which the device reports its motion or, if polled, at which the driver polls it; if it
    only replies, that of a device commanded at every step."""
    offline_after: Nanos
    """The timeout after which a silent device is offline, and its joint has lost its feedback."""
    commands: frozenset[type[Command]]
    requests: frozenset[type[Request]]
    ranges: dict[str, Range]
    """By "Message.field", for each number that a command or measurement can carry: "Velocity.velocity",
    "Feedback.position"."""
    watchdog: Watchdog
    holds_unattended: bool
    """True if the device keeps holding its load after a last Hold, when no host feeds it."""
    stop_clears_faults: bool
    """True if disarming clears the device's own faults (then a joint must latch them)."""
    faults: Mapping[int, FaultInfo] = field(default_factory=dict)
    """By `Fault.code`: every fault that the device can report, as its driver reports it."""
    parameters: tuple[str, ...] = ()
    """Parameters that ReadParameter reads, by the device's names for them: all, or some of each kind."""
    configuration: Mapping[str, Setting] = field(default_factory=dict)
    """By parameter: what is configured on the device, all of which ReadParameter reads."""
    set_up: Written = field(default_factory=dict)
    """What the driver writes to the device unasked, before it arms it or with its set-points; to a sensor,
    what starts it, which Idle at the end of a run stops. The guard passes nothing else that nobody asked
    for."""
    stop: tuple[Frame, ...] = ()
    """Frames that disarm the device whatever it does, the gentlest first: the gateway sends them itself, one
    after the other, if the driver does not stop a device that is to stand."""
    writes: Mapping[type[Request], Written] = field(default_factory=dict)
    """What it writes, beside that, while one of these requests is under way."""
    decoded: Callable[[str], str] = as_it_is
    """The name that the command decoder has for a parameter of WriteParameter, where a device has several for
    one. A function of a module."""
    save: str = ""
    """The parameter that saves the configuration when 1 is written; "": none is needed, or there is none."""
    id_parameter: str = ""
    """The parameter that is its address, where WriteParameter gives it another; "": SetId, SetAddress, or
    nothing does."""
    first_address: bool = False
    """Whether a device may have no address yet: SetAddress of the motor's own gives it that."""
    calibration: tuple[str, float] = ("", 0.0)
    """The parameter, and what is written to it, by which the device calibrates itself: its shaft turns. "":
    it does not, or not over this bus."""
    canonical: Callable[[Command], Command] = unchanged
    """Commands of which it returns the same are the same to the device, such as Torque and an Impedance
    without gains. It returns one of `commands`, with ranges of its own. A function of a module or a frozen
    dataclass with `__call__`, so that equal specs are equal and can be copied."""
    unprotected: frozenset[str] = frozenset()
    """Names of messages (`Plugin.messages`) that the device accepts though no checksum protects them.
    Conformance does not test damage to them, and a driver must not rely on them."""
    receives_also: tuple[IdMask, ...] = ()
    """What the driver understands of any device, in the robot file or not (answers to a scan, devices
    with a duplicate address), or of a second host."""
    obeys_also: tuple[IdMask, ...] = ()
    """Ids that the device obeys beside `sends`, from any sender. Other protocols on its bus must not use
    them."""
    unread: tuple[IdMask, ...] = ()
    """Ids of set-points whose content is as the device is configured: where the command decoder has not seen
    that written, since a device was taken over as it was, a commanded device is sent them unread."""
    gains: tuple[float, float] | None = None
    """Stiffness [N·m/rad] and damping [N·m·s/rad], if the device has Impedance, and makes a spring and damper
    of Position and Hold, and a damper of Velocity: their torque is limited as that of an Impedance is."""
    ramps: Mapping[type[Command], float] = field(default_factory=dict)
    """By command for which the device has a ramp of its own, by its options: how fast it lets its velocity
    change [rad/s²]. A joint that is limited to more runs ahead of it, and brakes longer than is expected."""
    scales: Mapping[str, str] = field(default_factory=dict)
    """By option that decides what a number in a frame means (pole pairs, a model): how the driver learns of
    the device that it is right; "": it does not, and a robot file that leaves it out is warned of. An option
    whose default is 0 need not be here: there another one decides."""
    tells_serial: bool = False
    """Whether the device's answer to a scan has its serial number."""
    line: Literal["free", "asked", "half-duplex"] = "free"
    """On a serial line, and on I²C, which is always "asked" (`protocols.toolkit.i2c`). "free": both ends send
    when they like. "asked": the device sends only answers, and one question is under way at a time: `send`
    gives an `Exchange` for each frame that is answered, and `answer` takes what came. "half-duplex": the
    same, on one wire for both directions."""
    holds_idle: bool = False
    """True if it holds its load when it is disarmed: closed ports, a brake."""
    caution: str = ""
    """What else a person must know of its options, printed at every start."""

    def __deepcopy__(self, memo: object) -> Spec:
        """It is a constant."""
        return self


REMEMBERED = 512
"""Specs of a protocol that are remembered: those of all addresses, with one choice of options."""


@cache
def remembered(spec: Callable[[Device], Spec]) -> Callable[[Device], Spec]:
    """Return a plugin's `spec`, which makes that of one device once: driver, decoder and those who ask share
    it. A spec is a constant."""
    return lru_cache(REMEMBERED)(spec)


# -- what a plugin implements --------------------------------------------------------------------------


class Driver(Protocol):
    """The host's end of the protocol, for all its devices on one bus. Owns no clock and no bus."""

    counters: RxCounters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Decode a frame received at `t`, the packet's own stamp. Never raises; [] for foreign frames."""
        ...

    def bus(self, t: Nanos, state: BusState) -> None:
        """Note that the bus changed its state: sent frames may be lost, devices may have restarted."""
        ...

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode at most one Command per motor, any requests, and what the driver itself has to send.

        Returns the events that do not come from a frame (Refused, a timeout, State offline) and the frames
        to be sent, in order. A command holding a value that is not finite, or outside the spec's range,
        is refused and sends nothing."""
        ...

    def due(self) -> Nanos | None:
        """Return when `send` must next be called without a message (polling, keep-alive, a timeout)."""
        ...

    def awaits(self) -> bool:
        """True while an answer is awaited to which `send` has something to add at once, as in a long set-up:
        then the loop steps when bytes come, and not only once per period."""
        ...


class LineDriver(Driver, Protocol):
    """A driver whose devices are on a half-duplex line."""

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        """Decode what came as answer to an exchange of its own; b"": nothing, or nothing more. Never
        raises."""
        ...


class CommandDecoder(Protocol):
    """What the devices would obey. Keeps what earlier frames have set up (mode, mapping), nothing else."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Decode what a device would obey on receiving this frame; [] if nothing. Never raises.

        A frame that arms a device gives Arm first; no other frame makes it give torque."""
        ...


class Twin(Protocol):
    """A simulated device: a command decoder, and the firmware behind it. The world simulates the shaft."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Accept a frame that reached the device at `t`. Never raises."""
        ...

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the firmware up to `now`; `truth` is the true motion of the shaft (Feedback) or what the
        sensor observes (a Measurement).

        Returns the torque on the shaft, at the device's side of the gear, and the frames that the device
        sends. Steps may be as short as the world's."""
        ...

    def due(self) -> Nanos | None:
        """Return when the device next sends something by itself; None if it does not."""
        ...

    def provoke(self, code: int) -> None:
        """Trip this fault of `Spec.faults` now, as if the firmware had detected it; for tests, since no
        frame leads here. Raises ValueError if the device has no such fault."""
        ...


@runtime_checkable
class PartTwin(Twin, Protocol):
    """A twin that is a part of a device, one of several motors of a board: what one part is asked may be
    about another."""

    def join(self, others: Sequence[Twin]) -> None:
        """Note the other twins of its bus, among which the other parts of its device may be."""
        ...


def join(twins: Sequence[Twin]) -> None:
    """Let the twins of a bus that are parts of one device find each other."""
    for twin in twins:
        if isinstance(twin, PartTwin):
            twin.join([other for other in twins if other is not twin])


@dataclass(frozen=True, slots=True)
class Plugin:
    """One protocol: the object that the entry point names."""

    name: str
    title: str
    """One line: which devices, which firmware lines."""
    trust: str
    """Which bytes were checked against which package@version or repository@commit."""
    options: type
    """Dataclass of typed options with defaults: how the driver should behave. Checked by `config`
    (types, unknown names); its `__post_init__` may raise `Invalid`, which names the option."""
    settings: type
    """Dataclass of typed settings with defaults: what is configured on the device (for the twin)."""
    spec: Callable[[Device], Spec]
    """May raise `Invalid`, for an address ("address") or options ("options.NAME") that no device can have."""
    driver: Callable[[Sequence[Device]], Driver]
    decoder: Callable[[Sequence[Device]], CommandDecoder]
    twin: Callable[[Device, int], Twin]
    """From the device and a seed."""
    messages: Callable[[Frame], Sequence[str]]
    """The vendor's names of the messages to a device that a frame holds; () if none. Messages of one name
    differ in their values only, so that one reference vector stands for all of them."""
    vectors: tuple[str, str] | None = None
    """Bytes from an independent source: a package and the path of a JSON file in it, as described in
    `protocols.reference_vectors`. None: there are none, and then conformance accepts no
    message that moves a motor."""
    example: Callable[[], Any] | None = None
    """Options of a device, for the contract, where the defaults describe none: a file of the user's does."""

    def tried(self) -> Any:  # noqa: ANN401 -- the plugin's own type
        """Return the options with which the contract tries it."""
        return self.options() if self.example is None else self.example()


# -- finding installed plugins -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Broken:
    """An installed plugin that could not be loaded: it is reported and left out; others are unaffected."""

    name: str
    distribution: str
    reason: str


class UnknownProtocol(LookupError):
    """No such protocol is installed, or it is broken."""

    def __init__(self, name: str, installed: Sequence[str], broken: Broken | None = None) -> None:
        self.name, self.installed, self.broken = name, tuple(installed), broken
        if broken:
            text = f"protocol {name!r} of {broken.distribution} is broken: {broken.reason}"
        else:
            hint = did_you_mean(name, self.installed)
            text = f"no protocol {name!r}; installed: {', '.join(self.installed)}{hint}"
        super().__init__(text)


def installed() -> tuple[EntryPoint, ...]:
    """Return the entry points of every installed protocol, by name. Takes milliseconds: call it at start."""
    return offered(GROUP).points


def load(name: str) -> Plugin:
    """Load the plugin of this name, and import no other. Raises UnknownProtocol."""
    points = installed()
    plugins, broken = _load_one_name([point for point in points if point.name == name])
    if plugins:
        return plugins[0]
    names = tuple(dict.fromkeys(point.name for point in points))
    raise UnknownProtocol(name, names, broken[0] if broken else None)


def load_all() -> tuple[tuple[Plugin, ...], tuple[Broken, ...]]:
    """Load every installed plugin; also return those that could not be loaded, with the reason."""
    found, unreadable = offered(GROUP)
    broken = [Broken("?", one.distribution, one.reason) for one in unreadable]
    plugins: list[Plugin] = []
    for _, points in groupby(found, key=lambda point: point.name):
        loaded, failed = _load_one_name(list(points))
        plugins += loaded
        broken += failed
    return tuple(plugins), tuple(broken)


def _load_one_name(points: Sequence[EntryPoint]) -> tuple[list[Plugin], list[Broken]]:
    """Load the plugin that the entry points of one name lead to.

    Where several distributions use the name, ours has it; among others none has, since which of them
    moves a motor must not depend on the order of folders."""
    broken: list[Broken] = []
    if len(points) > 1:
        owners = [owner(point) for point in points]
        for at, point in enumerate(points):
            others = " and ".join(owners[:at] + owners[at + 1 :])
            if not is_ours(point):
                broken.append(Broken(point.name, owners[at], f"{others} has a protocol of that name too"))
        points = [point for point in points if is_ours(point)][:1]
    loaded = [_load(point) for point in points]
    failed = [each for each in loaded if isinstance(each, Broken)]
    return [each for each in loaded if isinstance(each, Plugin)], failed + broken


def _load(point: EntryPoint) -> Plugin | Broken:
    """Load a plugin, and try it as far as is possible without a device."""
    if not point.pattern.match(point.value):
        return Broken(point.name, owner(point), f"{point.value!r} is not MODULE:NAME")
    try:
        plugin = point.load()
        mistake = _mistake(point, plugin)
    except KeyboardInterrupt:  # a person's, who wants to leave
        raise
    except BaseException as error:  # noqa: BLE001 -- a third party's module may raise anything, SystemExit too
        mistake = f"{type(error).__name__}: {error}{_required_version(point, error)}"
    return Broken(point.name, owner(point), mistake) if mistake else plugin


def _mistake(point: EntryPoint, plugin: object) -> str:
    """Return what is wrong with a loaded object, "" if nothing. Raises whatever the plugin raises."""
    if not isinstance(plugin, Plugin):
        return f"{point.value} is not a protocols.plugin.Plugin"
    if plugin.name != point.name:
        return f"its entry point is called {point.name!r}, and it calls itself {plugin.name!r}"
    device = Device("motor", 1, plugin.options(), plugin.settings())
    try:
        spec = plugin.spec(device)
    except ValueError:  # an address, or options, that it cannot have: the robot file must give others
        return ""
    wrong = f"its spec gives {type(spec).__name__}, not protocols.plugin.Spec"
    return "" if isinstance(spec, Spec) else wrong


def _required_version(point: EntryPoint, error: BaseException) -> str:
    """Name the version of the gateway that a distribution requires, where another one may be the reason."""
    requirements = (point.dist.requires if point.dist else None) or ()
    ours = [each for each in requirements if re.match(rf"{OURS}\b", each, re.IGNORECASE)]
    if not ours or not isinstance(error, TypeError | ImportError | AttributeError):
        return ""
    return f" (it requires {ours[0]})"
