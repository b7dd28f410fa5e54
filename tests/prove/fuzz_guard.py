"""A driver whose output is anything: random bytes, changed and old frames, frames that nobody asked for.

Rules. One joint under load, on a bench of each protocol, is given commands in turn, Idle among them, while
its driver sends anything in between. The judge sees what `starts` judges, what drives while the command is
Idle, and what the device keeps: each parameter that was the same at two times before is so afterwards. A
spring is given some more: the guard judges it at the feedback of the step, and the shaft moves on.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

from protocols import messages as msg
from protocols.conformance.bench import DriverWrapper, Messages
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Nanos
from tests.gateway.core.starts import FASTEST, HIGH, LOW, Bench, commands_of, robot_of

UNASKED = json.loads((Path(__file__).parents[1] / "gateway" / "core" / "unasked.json").read_text("utf-8"))
KEPT = 200
"""Frames of before that are sent again."""
EACH = (1, 3, 20)
"""Frames beside the driver's in each step: with few of them it is not disarmed at once, and drives longer."""
LOAD = 0.3
"""Share of the limit of torque that a load has at most."""
STEP = 0.005
"""s: one step of the robot"""
VELOCITY = 1.15
"""Share of its limit: a frame that is blocked may be the SYNC that would have ended a torque."""
SPRING = 1.25
"""Share of the limit of torque."""
LATELY = 20 * MILLISECOND
LOOPS = (msg.Velocity, msg.Position, msg.Hold)
"""Commands that a device's own loops do"""
SETTLED = 0.4
"""s after which nothing drives a shaft whose command is Idle"""
DRIVEN = 0.05
"""rad/s: a motor that drives a shaft beyond this is not idle"""


@dataclass
class Hostile(DriverWrapper):
    """Sends what its driver does, and more; what is received reaches the driver as it is."""

    random: Random = field(default_factory=Random)
    count: int = 0
    """Frames beside, in each step."""
    unasked: tuple[Frame, ...] = ()
    ids: list[tuple[int, bool, bool]] = field(default_factory=list)
    """Of frames that the driver has sent: id, whether extended, whether CAN FD."""
    before: list[Frame] = field(default_factory=list)
    made: int = 0

    def send(self, now: Nanos, messages: Messages) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode, and put others in between."""
        events, frames = self.driver.send(now, messages)
        for frame in frames:
            if isinstance(frame, CanFrame) and (key := (frame.id, frame.extended, frame.fd)) not in self.ids:
                self.ids.append(key)
        self.before = [*self.before, *frames][-KEPT:]
        others = [self._other() for _ in range(self.count)] if self.before else []
        self.made += len(others)
        mixed = [*frames, *others]
        self.random.shuffle(mixed)
        return events, mixed

    def _other(self) -> Frame:
        random = self.random
        old = random.choice(self.before)
        match random.randrange(5):
            case 0:
                return old
            case 1 if self.unasked:
                return random.choice(self.unasked)
            case 2 if isinstance(old, CanFrame):
                return CanFrame(random.randrange(1 << 29), random.randbytes(8), extended=True)
            case 3 if isinstance(old, CanFrame) and self.ids:
                number, extended, fd = random.choice(self.ids)
                return CanFrame(number, random.randbytes(random.randrange(9)), extended, False, fd, fd)
        data = bytearray(old.data if isinstance(old, CanFrame) else old)
        for _ in range(random.randrange(1, 4)):
            if data:
                data[random.randrange(len(data))] = random.randrange(256)
        return replace(old, data=bytes(data)) if isinstance(old, CanFrame) else bytes(data)


@dataclass(frozen=True, slots=True)
class Fuzzed:
    """What came of it."""

    frames: int
    velocity: float
    """Largest share of the limit at which the motor drove its shaft on."""
    torque: float
    """Largest share of the limit that it gave, where torque is what it is commanded."""
    idle: float
    """rad/s: fastest that it drove its shaft while its command was Idle."""
    changed: tuple[str, ...]
    """Parameters that were changed, with their values."""

    def check(self) -> None:
        """Raise AssertionError for what is beyond the limits."""
        assert self.velocity <= VELOCITY, f"{self.velocity:.3f} of the limit of velocity"
        assert self.torque <= SPRING, f"{self.torque:.3f} of the limit of torque"
        assert self.idle <= DRIVEN, f"driven at {self.idle:.3g} rad/s while it is to be idle"
        assert not self.changed, f"changed in the device: {self.changed}"


def fuzz(motor: str, seed: int, frames: int) -> Fuzzed:
    """Let a hostile driver send so many frames."""
    random = Random(f"{motor} {seed}")
    robot = robot_of(motor)
    bench = Bench.of(robot, seed, HIGH / 2.0)
    hostile = _hostile(bench, motor, random)
    bench.gateway._on_blocked = lambda *_: None  # type: ignore[method-assign]  # the guard alone: it drives on
    limits, gains = robot.motors["left"].joint.limits, robot.motors["left"].spec.gains
    shaft = bench.world.world._shafts._shafts[
        "left"
    ]  # a load that the limits suit: else nothing brakes it in time
    shaft.file = replace(shaft.file, inertia=limits.torque / (2.0 * limits.acceleration))
    bench.damping = LOAD * limits.torque / FASTEST  # a load alone does not bring it beyond its limit
    commands = commands_of(robot)
    rest = [commands.get("Hold") or msg.Velocity("left", 0.0), msg.Idle("left")]
    first = _kept(bench)
    for each in (*commands.values(), *rest):
        bench.run(0.3, each)
    kept = {name: value for name, value in _kept(bench).items() if first.get(name) == value}
    velocity = torque = idle = 0.0
    while hostile.made < frames:
        name = random.choice([*commands, "Idle"])
        hostile.count = 0
        _bring_back(bench, rest)
        hostile.count = random.choice(EACH)
        bench.load = 0.0 if name == "Idle" else random.uniform(-LOAD, LOAD) * limits.torque
        bench.run(SETTLED if name == "Idle" else 0.0, msg.Idle("left"))
        command = commands.get(name, msg.Idle("left"))
        for _ in range(random.randrange(10, 100)):
            stopping = bool(bench.gateway.joints["left"].faults)
            by_torque = gains is not None or _is_told_torque(bench)
            bench.fastest = bench.strongest = 0.0
            bench.run(STEP, command)
            velocity = max(velocity, bench.fastest / limits.velocity)
            if name == "Idle":
                idle = max(idle, bench.fastest)
            if by_torque and not stopping:  # a drive's own stop has a limit of its own
                torque = max(torque, bench.strongest / limits.torque)
    hostile.count = 0
    bench.load = 0.0
    bench.run(1.0, msg.Idle("left"))
    after = _kept(bench)
    changed = tuple(
        f"{name} {value} -> {after.get(name)}" for name, value in kept.items() if after.get(name) != value
    )
    return Fuzzed(hostile.made, velocity, torque, idle, changed)


def _bring_back(bench: Bench, rest: Sequence[Command]) -> None:
    """Bring the shaft to rest, back into its range, and its faults to an end."""
    bench.load = 0.0
    for each in rest:
        bench.run(0.2, each)
    if not LOW < bench.place < HIGH:
        bench.offset -= bench.place
        bench.run(0.2)
    bench.run(0.05, msg.ClearFault("left"), msg.Confirm("left"))


def _is_told_torque(bench: Bench) -> bool:
    """Whether the device was told only torques and springs of late: its own loops have their limits."""
    told = bench.gateway.guard._last
    loops = [at for (_, kind), (at, _) in told.items() if kind in LOOPS]
    last = told.get(("left", None))
    goes_on = last is None or isinstance(last[1], LOOPS)  # however old it is, as where each SYNC is blocked
    return not goes_on and all(bench.clock.now() - at > LATELY for at in loops)


def _hostile(bench: Bench, motor: str, random: Random) -> Hostile:
    [one] = bench.gateway._drivers
    names = (f"diffbot_{motor.split()[0]}", "bench" if motor == "odrive_can" else "")
    unasked = tuple(_frame(entry) for entry in UNASKED if entry["robot"] in names)
    hostile = Hostile(one.driver, random, 0, unasked)
    object.__setattr__(one, "driver", hostile)
    return hostile


def _kept(bench: Bench) -> dict[str, float]:
    """Read every parameter that the device answers for."""
    bench.parameters.clear()
    for name in bench.robot.motors["left"].spec.parameters:
        bench.run(0.05, msg.ReadParameter("left", name))
    return dict(bench.parameters)


def _frame(entry: dict[str, object]) -> CanFrame:
    data = bytes.fromhex(str(entry["data"]))
    return CanFrame(int(str(entry["id"]), 16), data, bool(entry["extended"]), fd=bool(entry.get("fd", False)))
