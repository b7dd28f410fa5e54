"""The test bench: a driver, its command decoder, and the twins of its devices, stepped in one loop.

Rules. Virtual time, one step per millisecond; the bus delays replies by one step, loses nothing and keeps
the order. Shafts and sensors are as simple as can be and have no randomness. Each step returns a
`StepResult` with all that was transferred, so that two runs can be compared. No protocol is known here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeAlias, TypeVar

from protocols import messages as msg
from protocols import sensors
from protocols.conformance.random import Random
from protocols.frames import BusState, CanFrame, Frame
from protocols.line import Ended, Line
from protocols.messages import MILLISECOND, Command, Event, Message, Mode, Nanos, Obeyed, Request, seconds
from protocols.plugin import (
    CommandDecoder,
    Device,
    Driver,
    LineDriver,
    Plugin,
    Range,
    RxCounters,
    Spec,
    Twin,
    join,
)

T = TypeVar("T")
Messages: TypeAlias = Sequence[Command | Request]
"""The messages given to a driver in one step."""

STEP: Nanos = MILLISECOND
START: Nanos = 1_000_000 * MILLISECOND
"""The clock does not begin at zero: nothing may take 0 for "never"."""
ALPHA, BETA = NAMES = ("alpha", "beta")
STRANGER = "stranger"
NO_ADDRESS = 1 << 20
"""An address that no device can have."""
ADDRESSES = (1, 2, 3)
"""Of alpha, beta, and the stranger, which the driver of alpha and beta does not know."""
LINE_RATE = 1_000_000
"""bit/s of a serial line on which devices speak only when asked"""
ARMING = 5000
"""Steps within which a device must become ready, or be armed."""


@dataclass(slots=True)
class Shaft:
    """A disc with viscous friction, at the device's shaft. Stands still while it is `locked`."""

    position: float = 0.0
    """rad"""
    velocity: float = 0.0
    """rad/s"""
    inertia: float = 2e-3
    """kg·m²"""
    friction: float = 1e-3
    """N·m·s/rad"""
    locked: bool = False
    load: float = 0.0
    """N·m, the external torque on the shaft"""

    def turn(self, torque: float, span: Nanos) -> None:
        """Integrate by semi-implicit Euler with implicit friction: stable at any torque."""
        if self.locked or not math.isfinite(torque):
            return
        dt = seconds(span)
        pushed = self.velocity + (torque + self.load) / self.inertia * dt
        self.velocity = pushed / (1.0 + self.friction / self.inertia * dt)
        self.position += self.velocity * dt


@dataclass(frozen=True, slots=True)
class StepResult:
    """All that was transferred in one step."""

    now: Nanos
    events: tuple[Event, ...]
    """Reported by the driver, from received frames and by itself."""
    down: tuple[Frame, ...]
    """Sent by the driver."""
    received: tuple[Obeyed, ...]
    """`down` as decoded by the command decoder."""
    up: tuple[Frame, ...]
    """Sent by the devices."""
    torques: tuple[msg.Torque, ...]
    due: tuple[Nanos | None, ...]
    """Of the driver and of each twin, after the step."""


@dataclass(slots=True)
class Bench:
    """The driver, the command decoder and the twins of some devices, and the shafts that the twins turn."""

    specs: tuple[Spec, ...]
    devices: tuple[Device, ...]
    driver: Driver
    decoder: CommandDecoder
    twins: list[Twin]
    shafts: dict[str, Shaft]
    now: Nanos = START
    count: int = 0
    """Steps taken."""
    in_flight: tuple[Frame, ...] = ()
    """Frames of the devices that the driver has not received yet."""
    modes: dict[str, Mode] = field(default_factory=dict)
    """The mode of each device that the driver reported last."""
    armed: set[str] = field(default_factory=set)
    """The motors for which Arm was decoded."""
    splitting: Random | None = None
    """On a serial bus: splits messages, so that their ends arrive a step later. None: all arrive whole."""
    split_off: dict[str, bytes] = field(default_factory=dict)
    """The ends that have not arrived yet, by direction."""

    def step(
        self,
        messages: Messages = (),
        extra_up: Sequence[Frame] = (),
        extra_down: Sequence[Frame] = (),
        truth: Sequence[Event] = (),
    ) -> StepResult:
        """Advance one step. Extra frames reach the driver or the devices; sensors also observe `truth`."""
        self.now += STEP
        self.count += 1
        arrived = (*extra_up, *self._split("up", self.in_flight))
        events = [event for frame in arrived for event in self.driver.receive(self.now, frame)]
        own, down = self.driver.send(self.now, messages)
        down = self._split("down", down)
        events += own
        for event in events:
            if isinstance(event, msg.State):
                self.modes[event.motor] = event.mode
        received = [m for frame in (*extra_down, *down) for m in self.decoder.decode(self.now, frame)]
        self.armed |= {message.motor for message in received if isinstance(message, msg.Arm)}
        up: list[Frame] = []
        torques: list[msg.Torque] = []
        for at, twin in enumerate(self.twins):
            for frame in (*extra_down, *down):
                twin.receive(self.now, frame)
            applied, sent = twin.step(self.now, (*self._observed(at), *truth))
            torques += applied
            up += sent
            self._distribute(at, sent)
        for torque in torques:
            self.shafts[torque.motor].turn(torque.torque, STEP)
        self.in_flight = tuple(up)
        due = (self.driver.due(), *(twin.due() for twin in self.twins))
        return StepResult(
            self.now, tuple(events), tuple(down), tuple(received), tuple(up), tuple(torques), due
        )

    def steps(self, count: int, messages: Messages = ()) -> list[StepResult]:
        """Advance `count` steps with the same messages."""
        return [self.step(messages) for _ in range(count)]

    def arm(self, make: Callable[[str], Command]) -> bool:
        """Command every motor until all are armed; False if one is not within `ARMING` steps.

        A device that reports no state is assumed to be armed after a tenth of them."""
        motors = [d.name for d in self.devices]
        for count in range(ARMING):
            self.step([make(name) for name in motors])
            if all(self.modes.get(name) == Mode.ARMED for name in motors):
                return True
            if count > ARMING // 10 and not self.modes:
                return True
        return False

    def _split(self, direction: str, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Return what of these frames and of earlier ends arrives in this step."""
        if self.splitting is None or not all(isinstance(frame, bytes) for frame in frames):
            return frames
        sent = b"".join(frame for frame in frames if isinstance(frame, bytes))
        stream = self.split_off.get(direction, b"") + sent
        at = len(stream) - self.splitting.below(min(len(stream), 9) + 1)
        self.split_off[direction] = stream[at:]
        return [stream[:at]] if at else []

    def _observed(self, at: int) -> list[Event]:
        """Return what a device measures in this step."""
        device, spec = self.devices[at], self.specs[at]
        if spec.kind == "motor":
            shaft = self.shafts[device.name]
            return [msg.Feedback(device.name, self.now, shaft.position, shaft.velocity)]
        return list(sensor_events(device.name, self.now, self.count)) if self.count % 10 == 1 else []

    def _distribute(self, at: int, frames: Sequence[Frame]) -> None:
        """Pass CAN frames on to the other devices: on CAN all receive all, on serial only the host does."""
        for other, twin in enumerate(self.twins):
            if other != at:
                for frame in frames:
                    if isinstance(frame, CanFrame) or self.specs[other].line == "half-duplex":
                        twin.receive(self.now, frame)


def make_bench(
    plugin: Plugin,
    options: object,
    addresses: Sequence[int],
    names: Sequence[str],
    settings: object = None,
) -> Bench:
    """Set up new devices with these settings (None: as delivered)."""
    devices = tuple(
        Device(name, address, options, plugin.settings() if settings is None else settings)
        for name, address in zip(names, addresses, strict=True)
    )
    specs = tuple(plugin.spec(device) for device in devices)
    twins = [plugin.twin(device, seed) for seed, device in enumerate(devices)]
    join(twins)
    return Bench(
        specs,
        devices,
        make_driver(plugin, devices),
        plugin.decoder(devices),
        twins,
        {device.name: Shaft() for device in devices},
    )


def make_driver(plugin: Plugin, devices: Sequence[Device]) -> Driver:
    """Return a new driver of these devices, with its line before it, if they speak only when asked."""
    driver, kinds = plugin.driver(devices), {plugin.spec(device).line for device in devices}
    if kinds == {"free"}:
        return driver
    return OnLine(driver, Line(LINE_RATE, half_duplex="half-duplex" in kinds, slack=2 * STEP, quiet=0))


def sensor_events(sensor: str, t: Nanos, count: int) -> list[msg.Measurement]:
    """Return a measurement for each kind of sensor, with other numbers for each count."""
    return [kind.sample(sensor, t, count) for kind in sensors.kinds().by_type.values()]


# -- wrappers, put between driver and twins to disturb them ----------------------------------------------


@dataclass(slots=True)
class DriverWrapper:
    """A driver in the place of another, to which it forwards every call; subclasses change some."""

    driver: Driver

    @property
    def counters(self) -> RxCounters:
        """The driver's counters."""
        return self.driver.counters

    @counters.setter
    def counters(self, counters: RxCounters) -> None:
        self.driver.counters = counters

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Forward the call."""
        return self.driver.receive(t, frame)

    def bus(self, t: Nanos, state: BusState) -> None:
        """Forward the call."""
        self.driver.bus(t, state)

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Forward the call."""
        return self.driver.send(now, messages)

    def due(self) -> Nanos | None:
        """Forward the call."""
        return self.driver.due()

    def awaits(self) -> bool:
        """Forward the call."""
        return self.driver.awaits()


@dataclass(slots=True)
class OnLine(DriverWrapper):
    """A driver of devices that speak only when asked, with its line before it: what is sent is what the line
    hands over in each step, and what is received goes to who asked."""

    line: Line

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Pass on what is an answer as such, and the rest as it is."""
        if not isinstance(frame, bytes):
            return self.driver.receive(t, frame)
        ended, rest = self.line.receive(t, frame)
        events = [event for each in ended for event in self.answered(t, each)]
        return [*events, *self.driver.receive(t, rest)] if rest else events

    def answered(self, t: Nanos, ended: Ended) -> Sequence[Event]:
        """Give the driver what has come as answer to an exchange of its own."""
        driver: LineDriver = self.driver  # type: ignore[assignment]
        return driver.answer(t, ended.exchange, ended.data)

    def bus(self, t: Nanos, state: BusState) -> None:
        """Forward the call; forget what waits, as the gateway does."""
        if state in (BusState.OFF, BusState.GONE, BusState.BACK):
            self.line.drop()
        self.driver.bus(t, state)

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Let the driver give what it has to send; hand over what the line sends now."""
        late = [event for each in self.line.expire(now) for event in self.answered(now, each)]
        events, frames = self.driver.send(now, messages)
        self.line.put(0, [frame for frame in frames if isinstance(frame, bytes)])
        more, sent = self.go_on(now)
        return [*late, *events, *more], sent

    def go_on(self, now: Nanos) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Hand over what waits, as between two steps of the brain: the driver is given nothing."""
        late = [event for each in self.line.expire(now) for event in self.answered(now, each)]
        return late, [bytes(frame) for _, frame in self.line.take(now)]

    def due(self) -> Nanos | None:
        """Return when driver or line have something to do."""
        times = [due for due in (self.driver.due(), self.line.due()) if due is not None]
        return min(times, default=None)


@dataclass(slots=True)
class TwinWrapper:
    """A twin in the place of another, to which it forwards every call; subclasses change some."""

    twin: Twin

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Forward the call."""
        self.twin.receive(t, frame)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Forward the call."""
        return self.twin.step(now, truth)

    def due(self) -> Nanos | None:
        """Forward the call."""
        return self.twin.due()

    def provoke(self, code: int) -> None:
        """Forward the call."""
        self.twin.provoke(code)


# -- messages to give to a driver ------------------------------------------------------------------------


def build(
    kind: type[Command], motor: str, ranges: dict[str, Range], values: dict[str, float] | None = None
) -> Command:
    """Return a command with these values, 0.0 for the others, each limited to the device's range.

    Without values it is the gentlest command of its kind. Numbers without a range are 0.0."""
    limited = {
        name: nearest(ranges[key], (values or {}).get(name, 0.0)) for name, key in numbers(kind, ranges)
    }
    return exactly(kind, motor, limited)


def exactly(kind: type[Command], motor: str, values: dict[str, float]) -> Command:
    """Return a command with exactly these values, 0.0 for the others."""
    names = [f.name for f in fields(kind) if f.name != "motor"]
    return kind(motor, *[values.get(name, 0.0) for name in names])


def gentle(kind: type[Command], ranges: dict[str, Range]) -> Callable[[str], Command]:
    """Return a function from a motor to its gentlest command of this kind."""
    return lambda motor: build(kind, motor, ranges)


def numbers(kind: type[Message], ranges: dict[str, Range]) -> list[tuple[str, str]]:
    """Return the fields of a message that the device's spec has a range for, with the ranges' names."""
    keys = [(f.name, f"{kind.__name__}.{f.name}") for f in fields(kind)]
    return [(name, key) for name, key in keys if key in ranges]


def nearest(bounds: Range, value: float) -> float:
    """Limit a value to a range."""
    return max(bounds.low, min(bounds.high, value))


def request(kind: type[Request], motor: str) -> Request | None:
    """Return a request of this kind that a device may get; None if it is not for a device."""
    if kind is msg.Scan:
        return msg.Scan("bus")
    if kind is msg.SetId:
        return msg.SetId("bus", 987_654_321, 9)
    if kind is msg.SetAddress:
        return msg.SetAddress(motor, NO_ADDRESS)
    if kind is msg.ReadParameter:
        return msg.ReadParameter(motor, "no such parameter")
    if kind is msg.WriteParameter:
        return msg.WriteParameter(motor, "no such parameter", 1.0)
    if kind in (msg.ClearFault, msg.Estop, msg.Zero, msg.Home, msg.Reboot):
        return kind(motor)
    return None


def script(spec: Spec, names: Sequence[str]) -> Iterator[tuple[Command | Request, ...]]:
    """Yield the messages of each step: none, every command, every request, none, and Idle."""
    nothing: tuple[Command | Request, ...] = ()
    yield from [nothing] * 150
    for kind in sorted(spec.commands, key=lambda kind: kind.__name__):
        for step in range(60):
            # The second device starts later, so that the two are not always in the same state.
            commanded = names if step > 20 else names[:1]
            yield tuple(_slow(kind, name, spec, step) for name in commanded)
    for requested in sorted(spec.requests, key=lambda kind: kind.__name__):
        for name in names:
            message = request(requested, name)
            yield (message,) if message else ()
            yield from [nothing] * 25
    if spec.commands:
        yield from [tuple(msg.Idle(name) for name in names)] * 50
    yield from [nothing] * 300


def _slow(kind: type[Command], motor: str, spec: Spec, step: int) -> Command:
    """Return a command that varies slowly with the step."""
    size = {"stiffness": 0.5, "damping": 0.05, "torque": 0.01}
    wave = math.sin(0.1 * step + len(motor))
    values = {name: size.get(name, 1.0) * wave for name, _ in numbers(kind, spec.ranges)}
    return build(kind, motor, spec.ranges, values)


# -- comparing messages, and shortening counterexamples --------------------------------------------------


def finite(message: Message) -> bool:
    """True if every number in a message is finite."""
    return all(math.isfinite(number) for number in floats(message))


def floats(value: object) -> Iterator[float]:
    """Yield every float in a message."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from floats(item)
    elif is_dataclass(value):
        for f in fields(value):
            yield from floats(getattr(value, f.name))


def within(command: Command, ranges: dict[str, Range]) -> bool:
    """True if every number of a command is within the range that the spec has for it."""
    named = [(getattr(command, name), ranges[key]) for name, key in numbers(type(command), ranges)]
    return all(bounds.low <= number <= bounds.high for number, bounds in named)


def close(sent: float, received: float | None, bounds: Range) -> bool:
    """True if a number arrived within the declared resolution (and a few bits of float64)."""
    if received is None:
        return False
    slack = bounds.resolution + bounds.relative * abs(sent) + 4 * math.ulp(sent)
    return abs(sent - received) <= slack


def same(sent: Message, received: Message, ranges: dict[str, Range]) -> bool:
    """True if a message arrived: its type, its subject, and each number that the spec has a range for."""
    if type(sent) is not type(received) or _subject(sent) != _subject(received):
        return False
    return all(
        _close(getattr(sent, name), getattr(received, name), ranges[key])
        for name, key in numbers(type(sent), ranges)
    )


def _close(sent: Any, received: Any, bounds: Range) -> bool:  # noqa: ANN401 -- a field of any message
    if sent is None or received is None:
        return sent is received
    if isinstance(sent, tuple):
        return len(sent) == len(received) and all(
            close(one, other, bounds) for one, other in zip(sent, received, strict=True)
        )
    return close(sent, received, bounds)


def _subject(message: Message) -> object:
    return getattr(message, "motor", getattr(message, "sensor", None))


def with_data(frame: Frame, data: bytes) -> Frame:
    """Return the same frame with other data."""
    return replace(frame, data=data) if isinstance(frame, CanFrame) else data


def data_of(frame: Frame) -> bytes:
    """Return the data of a frame."""
    return frame.data if isinstance(frame, CanFrame) else frame


def fewest(items: Sequence[T], fails: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """Return as few of these, in their order, as still fail. `fails` must be true of all of them."""
    kept = list(items)
    size = max(len(kept) // 2, 1)
    while size:
        at = 0
        while at < len(kept):
            fewer = kept[:at] + kept[at + size :]
            if len(fewer) < len(kept) and fails(fewer):
                kept = fewer
            else:
                at += size
        size //= 2
    return kept


def shortest(frame: Frame, fails: Callable[[Frame], bool]) -> Frame:
    """Return a frame with as few bytes, most of them zero, as still fails. `fails(frame)` must be true."""
    data = bytes(fewest(data_of(frame), lambda data: fails(with_data(frame, bytes(data)))))
    for at in range(len(data)):
        simpler = data[:at] + b"\0" + data[at + 1 :]
        if simpler != data and fails(with_data(frame, simpler)):
            data = simpler
    return with_data(frame, data)
