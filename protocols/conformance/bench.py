"""A driver and its devices' twins in one for-loop: what the conformance kit plays with.

Rules. Virtual time, one step a millisecond; the wire takes one step, loses nothing and keeps the order.
Shafts and sensors are as simple as can be and have no randomness. Everything that was said is kept in
`Said`, so that two rehearsals can be compared. Nothing here knows any device language.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Message, Mode, Nanos, Request, seconds
from protocols.plugin import CommandDecoder, Device, Driver, Plugin, Range, Spec, Twin

T = TypeVar("T")

STEP: Nanos = MILLISECOND
START: Nanos = 1_000_000 * MILLISECOND
"""The clock does not begin at zero: nothing may take 0 for "never"."""
NAMES = ("alpha", "beta")
STRANGER = "stranger"
ADDRESSES = (1, 2, 3)
"""Of alpha, beta, and of the stranger, whom alpha's and beta's driver does not know."""
ARMING = 5000
"""Steps in which a device must be armed."""


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
    """N·m that the world puts on the shaft"""

    def turn(self, torque: float, span: Nanos) -> None:
        """Semi-implicit Euler, friction taken implicitly: stable at any torque."""
        if self.locked or not math.isfinite(torque):
            return
        dt = seconds(span)
        pushed = self.velocity + (torque + self.load) / self.inertia * dt
        self.velocity = pushed / (1.0 + self.friction / self.inertia * dt)
        self.position += self.velocity * dt


@dataclass(frozen=True, slots=True)
class StepResult:
    """What happened in one step."""

    now: Nanos
    events: tuple[Event, ...]
    """What the driver told, from the wire and by itself."""
    down: tuple[Frame, ...]
    received: tuple[Command | Request, ...]
    """What the ear made of `down`."""
    up: tuple[Frame, ...]
    torques: tuple[msg.Torque, ...]
    due: tuple[Nanos | None, ...]
    """Of the driver and of each twin, after the step."""


@dataclass(slots=True)
class Bench:
    """The driver, the ear and the twins of some devices, and the shafts that the twins turn."""

    specs: tuple[Spec, ...]
    devices: tuple[Device, ...]
    driver: Driver
    decoder: CommandDecoder
    twins: list[Twin]
    shafts: dict[str, Shaft]
    now: Nanos = START
    count: int = 0
    """Steps taken."""
    on_the_way: tuple[Frame, ...] = ()
    """What the devices have said and the driver has not heard yet."""
    armed: dict[str, Mode] = field(default_factory=dict)
    """What the driver last told of each device's mode."""
    tearing: Random | None = None
    """On a serial line: tears messages, so that an end of them comes a step later. None: all come whole."""
    torn: dict[str, bytes] = field(default_factory=dict)
    """The ends that are still to come, by direction."""

    def step(
        self,
        words: Sequence[Command | Request] = (),
        stray_up: Sequence[Frame] = (),
        stray_down: Sequence[Frame] = (),
        truth: Sequence[Event] = (),
    ) -> StepResult:
        """One step. Stray wires reach the driver or the devices besides; `truth` is shown besides."""
        self.now += STEP
        self.count += 1
        arrived = (*stray_up, *self._tear("up", self.on_the_way))
        events = [event for frame in arrived for event in self.driver.receive(self.now, frame)]
        own, down = self.driver.send(self.now, words)
        down = self._tear("down", down)
        events += own
        for event in events:
            if isinstance(event, msg.State):
                self.armed[event.motor] = event.mode
        received = [word for frame in (*stray_down, *down) for word in self.decoder.decode(self.now, frame)]
        up: list[Frame] = []
        torques: list[msg.Torque] = []
        for at, twin in enumerate(self.twins):
            for frame in (*stray_down, *down):
                twin.receive(self.now, frame)
            said = twin.step(self.now, (*self._shown(at), *truth))
            torques += said[0]
            up += said[1]
            self._share(at, said[1])
        for torque in torques:
            self.shafts[torque.motor].turn(torque.torque, STEP)
        self.on_the_way = tuple(up)
        due = (self.driver.due(), *(twin.due() for twin in self.twins))
        return StepResult(
            self.now, tuple(events), tuple(down), tuple(received), tuple(up), tuple(torques), due
        )

    def steps(self, count: int, words: Sequence[Command | Request] = ()) -> list[StepResult]:
        """So many steps with the same words."""
        return [self.step(words) for _ in range(count)]

    def arm(self, make: Callable[[str], Command]) -> bool:
        """Say a gentle command until every motor is armed; False if one is not in `ARMING` steps.

        A device that tells nothing of its state is taken to be armed after a tenth of them."""
        motors = [d.name for d in self.devices]
        for count in range(ARMING):
            self.step([make(name) for name in motors])
            if all(self.armed.get(name) == Mode.ARMED for name in motors):
                return True
            if count > ARMING // 10 and not self.armed:
                return True
        return False

    def _tear(self, way: str, frames: Sequence[Frame]) -> Sequence[Frame]:
        """What of these wires and of what was torn before arrives in this step."""
        if self.tearing is None or not all(isinstance(frame, bytes) for frame in frames):
            return frames
        stream = self.torn.get(way, b"") + b"".join(frame for frame in frames if isinstance(frame, bytes))
        at = len(stream) - self.tearing.below(min(len(stream), 9) + 1)
        self.torn[way] = stream[at:]
        return [stream[:at]] if at else []

    def _shown(self, at: int) -> list[Event]:
        """What the world shows to a device in this step."""
        device, spec = self.devices[at], self.specs[at]
        if spec.kind == "motor":
            shaft = self.shafts[device.name]
            return [msg.Feedback(device.name, self.now, shaft.position, shaft.velocity)]
        return list(sights(device.name, self.now, self.count)) if self.count % 10 == 1 else []

    def _share(self, at: int, frames: Sequence[Frame]) -> None:
        """On a CAN bus every node hears every other; a serial line has two directions."""
        for other, twin in enumerate(self.twins):
            if other != at:
                for frame in frames:
                    if isinstance(frame, CanFrame):
                        twin.receive(self.now, frame)


def sights(sensor: str, t: Nanos, count: int) -> tuple[msg.Imu, msg.LaserScan, msg.Fix]:
    """Something to be seen for each kind of sensor, other numbers each time."""
    wave = math.sin(0.37 * count)
    ranges = tuple(2.0 + math.sin(0.37 * count + 0.1 * beam) for beam in range(36))
    return (
        msg.Imu(sensor, t, (0.1 * wave, -0.2 * wave, wave), (0.3 * wave, 0.2, 9.81)),
        msg.LaserScan(sensor, t, -math.pi, math.pi / 18, 0.1, 10.0, ranges),
        msg.Fix(sensor, t, 48.0 + 1e-6 * wave, 11.0, 500.0 + wave, 4.0),
    )


def make_bench(
    plugin: Plugin,
    options: object,
    addresses: Sequence[int],
    names: Sequence[str],
    settings: object = None,
) -> Bench:
    """A rehearsal of devices as they come out of the box (None), or with other settings on them."""
    devices = tuple(
        Device(name, address, options, plugin.settings() if settings is None else settings)
        for name, address in zip(names, addresses, strict=True)
    )
    return Bench(
        tuple(plugin.spec(device) for device in devices),
        devices,
        plugin.driver(devices),
        plugin.decoder(devices),
        [plugin.twin(device, seed) for seed, device in enumerate(devices)],
        {device.name: Shaft() for device in devices},
    )


# -- words to say --------------------------------------------------------------------------------------


def gentle(kind: type[Command], ranges: dict[str, Range]) -> Callable[[str], Command]:
    """A command of this kind that asks as little as the device's ranges allow."""

    def make(motor: str) -> Command:
        if kind is msg.Idle or kind is msg.Hold:
            return kind(motor)
        return build(kind, motor, {name: nearest(ranges[key], 0.0) for name, key in numbers(kind, ranges)})

    return make


def build(kind: type[Command], motor: str, values: dict[str, float]) -> Command:
    """A command with these numbers, zero for the others."""
    names = [f.name for f in fields(kind) if f.name != "motor"]
    return kind(motor, *[values.get(name, 0.0) for name in names])


def numbers(kind: type[Message], ranges: dict[str, Range]) -> list[tuple[str, str]]:
    """The fields of a word that the device's spec has a range for, and the names of the ranges."""
    keys = [(f.name, f"{kind.__name__}.{f.name}") for f in fields(kind)]
    return [(name, key) for name, key in keys if key in ranges]


def nearest(bounds: Range, value: float) -> float:
    """The value, or the limit that it lies behind."""
    return max(bounds.low, min(bounds.high, value))


def request(kind: type[Request], motor: str) -> Request | None:
    """A request of this kind that a device may well get, or None: it is no device's business."""
    if kind is msg.Scan:
        return msg.Scan("bus")
    if kind is msg.SetId:
        return msg.SetId("bus", 987_654_321, 9)
    if kind is msg.ReadParameter:
        return msg.ReadParameter(motor, "no such parameter")
    if kind is msg.WriteParameter:
        return msg.WriteParameter(motor, "no such parameter", 1.0)
    if kind in (msg.ClearFault, msg.Estop, msg.Zero, msg.Home, msg.Reboot):
        return kind(motor)
    return None


def script(spec: Spec, names: Sequence[str]) -> Iterator[tuple[Command | Request, ...]]:
    """A busy day, step by step: listening, every command, every request, silence, and Idle."""
    quiet: tuple[Command | Request, ...] = ()
    yield from [quiet] * 150
    for kind in sorted(spec.commands, key=lambda kind: kind.__name__):
        for step in range(60):
            # The device at the end of the line lags behind, so that the two are not always in step.
            speaking = names if step > 20 else names[:1]
            yield tuple(_mild(kind, name, spec, step) for name in speaking)
    for asked in sorted(spec.requests, key=lambda kind: kind.__name__):
        for name in names:
            word = request(asked, name)
            yield (word,) if word else ()
            yield from [quiet] * 25
    if spec.commands:
        yield from [tuple(msg.Idle(name) for name in names)] * 50
    yield from [quiet] * 300


def _mild(kind: type[Command], motor: str, spec: Spec, step: int) -> Command:
    if kind in (msg.Idle, msg.Hold):
        return gentle(kind, spec.ranges)(motor)
    size = {"stiffness": 0.5, "damping": 0.05, "torque": 0.01}
    values = {
        name: nearest(spec.ranges[key], size.get(name, 1.0) * math.sin(0.1 * step + len(motor)))
        for name, key in numbers(kind, spec.ranges)
    }
    return build(kind, motor, values)


# -- looking at words and wires ------------------------------------------------------------------------


def finite(word: Message) -> bool:
    """Whether every number in a word is finite."""
    return all(math.isfinite(number) for number in _floats(word))


def _floats(value: object) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _floats(item)
    elif is_dataclass(value):
        for f in fields(value):
            yield from _floats(getattr(value, f.name))


def within(word: Command, ranges: dict[str, Range]) -> bool:
    """Whether every number of a command lies in the range that the spec has for it."""
    named = [(getattr(word, name), ranges[key]) for name, key in numbers(type(word), ranges)]
    return all(bounds.low <= number <= bounds.high for number, bounds in named)


def close(said: float, received: float | None, bounds: Range) -> bool:
    """Whether a number came through within the declared resolution (and a few bits of float64)."""
    if received is None:
        return False
    slack = bounds.resolution + bounds.relative * abs(said) + 4 * math.ulp(said)
    return abs(said - received) <= slack


def same(said: Message, received: Message, ranges: dict[str, Range]) -> bool:
    """Whether a word came through: its kind, its name, and each number that the spec has a range for."""
    if type(said) is not type(received) or _name(said) != _name(received):
        return False
    return all(
        _close(getattr(said, name), getattr(received, name), ranges[key])
        for name, key in numbers(type(said), ranges)
    )


def _close(said: Any, received: Any, bounds: Range) -> bool:  # noqa: ANN401 -- a field of any word
    if said is None or received is None:
        return said is received
    if isinstance(said, tuple):
        return len(said) == len(received) and all(
            close(one, other, bounds) for one, other in zip(said, received, strict=True)
        )
    return close(said, received, bounds)


def _name(word: Message) -> object:
    return getattr(word, "motor", getattr(word, "sensor", None))


def with_data(frame: Frame, data: bytes) -> Frame:
    """The same wire with other bytes in it."""
    return replace(frame, data=data) if isinstance(frame, CanFrame) else data


def data_of(frame: Frame) -> bytes:
    """The bytes in a wire."""
    return frame.data if isinstance(frame, CanFrame) else frame


def fewest(items: Sequence[T], fails: Callable[[Sequence[T]], bool]) -> Sequence[T]:
    """As few of these, in their order, as still fail. `fails` must be true of all of them."""
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
    """A wire with as few and as plain bytes as still fail. `fails` must be true of `wire`."""
    data = bytes(fewest(data_of(frame), lambda data: fails(with_data(frame, bytes(data)))))
    for at in range(len(data)):
        plainer = data[:at] + b"\0" + data[at + 1 :]
        if plainer != data and fails(with_data(frame, plainer)):
            data = plainer
    return with_data(frame, data)
