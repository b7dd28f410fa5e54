"""What can go wrong with the devices of the simulated world: one table, for scenarios and campaigns.

Rules. A cause acts by `TwinWorld`, `TwinBus` and `tamper` alone: nothing above the buses is told. `inject`
sets it going once, on a `FaultSite`, whose `each` is called at every step from then on. Randomness is the
site's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeAlias

from gateway.buses.virtual.bus import HOST, TwinWorld
from gateway.buses.virtual.medium import Transmission
from gateway.core.robot import Robot
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import BusState, CanFrame
from protocols.messages import MILLISECOND, SECOND, Feedback, Instruction, LaserScan, Nanos

Arrived: TypeAlias = Sequence[Transmission]
Memory: TypeAlias = dict[str, Any]
"""Of one fault in one run."""
BOOT: Nanos = 150 * MILLISECOND
"""From a device's supply to its first frame: few are faster."""


def nothing(_now: Nanos) -> Sequence[Instruction]:
    """Do nothing more."""
    return ()


class FaultSite(Protocol):
    """Where a fault comes about."""

    robot: Robot
    world: TwinWorld
    target: str
    """The device that has the fault,"""
    bus: str
    """and its bus."""
    wheels: tuple[str, ...]
    """The motors of a base's wheels, if it has any"""
    random: Random
    since: Nanos
    """When it came."""
    ends: float
    """s from then on, after which it is over; infinite if it stays."""
    each: Callable[[Nanos], Sequence[Instruction]]
    """The part of the fault that goes on, called at every step."""


Inject: TypeAlias = Callable[[Any], None]
"""Sets a fault going on a `FaultSite`."""


@dataclass(slots=True)
class Site:
    """The site of one fault, by the names of the robot file."""

    robot: Robot
    world: TwinWorld
    target: str
    random: Random
    since: Nanos
    ends: float = math.inf
    bus: str = field(init=False)
    wheels: tuple[str, ...] = field(init=False)
    each: Callable[[Nanos], Sequence[Instruction]] = nothing

    def __post_init__(self) -> None:
        devices = {one.name: one for one in self.robot.devices()}
        self.bus = devices[self.target].bus
        self.wheels = self.robot.brain.abilities(self.robot.motors).wheels


@dataclass(frozen=True, slots=True)
class FaultCause:
    """How one fault comes about."""

    inject: Inject
    on: Literal["device", "motor", "wheel", "lidar", "imu"]
    """What can have it"""
    end: Inject = lambda _site: None
    """What makes it over, beside taking away what it has falsified"""


# -- frames ------------------------------------------------------------------------------------------------


def _over(run: FaultSite) -> float:
    """Return when it is over, on the robot's clock [ns]."""
    return run.since + run.ends * SECOND


def frames(change: Callable[[FaultSite, Transmission], Arrived]) -> Inject:
    """Change what arrives on the target's bus, for a while."""

    def inject(run: FaultSite) -> None:
        end = _over(run)
        run.world.tamper.transmission = lambda bus, one: (
            change(run, one) if bus == run.bus and one.t < end else (one,)
        )

    return inject


def later(one: Transmission, by: Nanos) -> Arrived:
    """Return a frame that is delayed."""
    return (replace(one, t=one.t + by),)


def damaged(run: FaultSite, one: Transmission) -> Arrived:
    """Change one bit of every tenth frame."""
    data = bytearray(one.frame.data if isinstance(one.frame, CanFrame) else one.frame)
    if not data or run.random.below(10):
        return (one,)
    data[run.random.below(len(data))] ^= 1 << run.random.below(8)
    changed = replace(one.frame, data=bytes(data)) if isinstance(one.frame, CanFrame) else bytes(data)
    return (replace(one, frame=changed),)


def received(data: bytes, ratio: float) -> bytes:
    """Return what a serial port makes of bytes that are sent at another rate: its own is `ratio` times as
    high. One without its stop bit counts as 0, as Linux gives it."""
    levels = [1] + [level for byte in data for level in (0, *(byte >> at & 1 for at in range(8)), 1)]
    got, at, last = bytearray(), 0.0, len(levels) - 1

    def level(time: float) -> int:
        return levels[int(time)] if time <= last else 1

    while at <= last:
        if level(at):
            at = math.floor(at) + 1.0
            continue
        byte = sum(level(at + (bit + 1.5) / ratio) << bit for bit in range(8))
        stop = at + 9.5 / ratio
        got.append(byte if level(stop) else 0)
        at = stop
        while at <= last and not level(at):  # a stop bit that is none: the next edge begins
            at = math.floor(at) + 1.0
    return bytes(got)


def misread(_run: FaultSite, one: Transmission) -> Arrived:
    """Let a device on a serial line send at half the rate at which it is received."""
    if one.sender == HOST or isinstance(one.frame, CanFrame):
        return (one,)
    return (replace(one, frame=received(one.frame, 2.0)),)


# -- motors ------------------------------------------------------------------------------------------------


def provoked(run: FaultSite) -> None:
    """Trip a fault that the device's specification lists."""
    codes = sorted(run.robot.motors[run.target].spec.faults)
    run.world.twin(run.target).provoke(run.random.choice(codes))


def encoder(change: Callable[[FaultSite, Feedback, Memory], Feedback]) -> Inject:
    """Falsify what the target's encoder measures."""

    def inject(run: FaultSite) -> None:
        memory: Memory = {}
        run.world.tamper.measured = lambda motor, true: (
            change(run, true, memory) if motor == run.target else true
        )

    return inject


def restarted(run: FaultSite) -> None:
    """Switch the target off and on: it begins anew, and is silent until it has booted."""
    run.world.reset(run.target)
    run.world.disconnect(run.target)
    booted = run.since + BOOT

    def wait(now: Nanos) -> Sequence[Instruction]:
        if now >= booted:
            run.world.reconnect(run.target)
        return ()

    run.each = wait


def same_again(_run: FaultSite, true: Any, memory: Memory) -> Any:  # noqa: ANN401 -- of any kind
    """Return the first one again and again."""
    return replace(memory.setdefault("as", true), t=true.t)


def jumped(run: FaultSite, true: Feedback, memory: Memory) -> Feedback:
    """Move what is measured by some turns, once."""
    by = memory.setdefault("by", run.random.choice((-1, 1)) * run.random.uniform(2.0, 30.0))
    return replace(true, position=(true.position or 0.0) + by * run.robot.motors[run.target].joint.gear)


def scaled(factor: float) -> Inject:
    """Let the target's encoder count this share from now on."""

    def change(_run: FaultSite, true: Feedback, memory: Memory) -> Feedback:
        at, velocity = true.position or 0.0, true.velocity or 0.0
        begin = memory.setdefault("at", at)
        return replace(true, position=begin + factor * (at - begin), velocity=factor * velocity)

    return encoder(change)


def swapped(run: FaultSite) -> None:
    """Exchange the encoders of the two wheels."""
    other = dict(zip(run.wheels, reversed(run.wheels), strict=True))

    def function(motor: str, true: Feedback) -> Feedback:
        if motor not in other:
            return true
        (position, velocity), joint = run.world.world.shaft(other[motor]), run.robot.motors[motor].joint
        ratio = joint.gear * joint.sign
        return replace(true, position=position * ratio, velocity=velocity * ratio)

    run.world.tamper.measured = function


def torque(change: Callable[[float], float]) -> Inject:
    """Change the torque of the target."""

    def inject(run: FaultSite) -> None:
        name = run.target
        run.world.tamper.torques = lambda given: given | {name: change(given.get(name, 0.0))}

    return inject


def runaway(run: FaultSite) -> None:
    """Make the target give half of its largest torque, whatever it is commanded."""
    half = run.random.choice((-0.5, 0.5)) * run.robot.motors[run.target].joint.limits.torque
    torque(lambda _given: half)(run)


# -- buses -------------------------------------------------------------------------------------------------


def lost(state: BusState) -> Inject:
    """Take the host's interface away, for a while."""

    def inject(run: FaultSite) -> None:
        bus, back = run.world.buses[run.bus], [_over(run)]
        bus.lose(state)

        def each(now: Nanos) -> Sequence[Instruction]:
            if back and now >= back[0]:
                back.clear()
                bus.restore()
            return ()

        run.each = each

    return inject


def saturated(run: FaultSite) -> None:
    """Fill the bus with frames of the highest priority, as a babbling device does."""

    def each(now: Nanos) -> Sequence[Instruction]:
        run.world.buses[run.bus].intrude(now, "babbler", [CanFrame(0, bytes(8))] * 60)
        return ()

    run.each = each


# -- clock and steps of the host ---------------------------------------------------------------------------


def stamps(offset: Nanos) -> Inject:
    """Let the clock step by which is stamped what the host receives, on all buses."""

    def inject(run: FaultSite) -> None:
        run.world.tamper.stamp = lambda t: t + offset

    return inject


def slow_steps(run: FaultSite) -> None:
    """Let every twentieth step take 50 … 550 ms."""
    run.world.tamper.takes = lambda _now: (
        0 if run.random.below(20) else (50 + run.random.below(450)) * MILLISECOND
    )


def slow_step(run: FaultSite) -> None:
    """Let one step take 400 ms."""
    left = [400 * MILLISECOND]
    run.world.tamper.takes = lambda _now: left.pop() if left else 0


# -- sensors -----------------------------------------------------------------------------------------------


def reading(change: Callable[[FaultSite, Any, Memory], Any]) -> Inject:
    """Falsify what the target senses."""

    def inject(run: FaultSite) -> None:
        memory: Memory = {}
        run.world.tamper.reading = lambda true: (
            change(run, true, memory) if true.sensor == run.target else true
        )

    return inject


def ranges(change: Callable[[FaultSite, LaserScan], Sequence[float]]) -> Inject:
    """Change a scan's ranges, within what the lidar can report."""
    return reading(
        lambda run, scan, _memory: replace(
            scan, ranges=tuple(min(each, scan.range_max) for each in change(run, scan))
        )
    )


def elsewhere(where: Callable[[int, int], int]) -> Inject:
    """Let each beam read what was read last at another one: from its number of so many in a turn."""

    def change(_run: FaultSite, scan: LaserScan, memory: Memory) -> LaserScan:
        width, turn = scan.angle_increment, round(math.tau / abs(scan.angle_increment))
        first = round((scan.angle_min + math.pi) / width)
        kept: dict[int, float] = memory.setdefault("kept", {})
        beams = [(first + at) % turn for at in range(len(scan.ranges))]
        kept.update(zip(beams, scan.ranges, strict=True))
        seen = tuple(kept.get(where(beam, turn) % turn, scan.range_max) for beam in beams)
        return replace(scan, ranges=seen)

    return reading(change)


def turned(degrees: float) -> Inject:
    """Turn the lidar, which has come loose."""
    return elsewhere(lambda beam, turn: beam - round(degrees / 360.0 * turn))


def sector(
    width: float, change: Callable[[FaultSite, Memory, int, float], float], about: float = 0.0
) -> Inject:
    """Change what the beams of a sector read [rad, from ahead], by the beam's number and the true range."""

    def changed(run: FaultSite, scan: LaserScan, memory: Memory) -> LaserScan:
        found = list(scan.ranges)
        for beam, true in enumerate(scan.ranges):
            if (
                abs(math.remainder(scan.angle_min + beam * scan.angle_increment - about, math.tau))
                < width / 2
            ):
                found[beam] = min(change(run, memory, beam, true), scan.range_max)
        return replace(scan, ranges=tuple(found))

    return reading(changed)


def dust(run: FaultSite, scan: LaserScan) -> Sequence[float]:
    """Let dust swallow 60 % of the beams, and send 10 % back from within 0.5 m."""
    found = list(scan.ranges)
    for beam in range(len(found)):
        what = run.random.below(10)
        found[beam] = 0.0 if what < 6 else run.random.uniform(0.15, 0.5) if what == 6 else found[beam]
    return found


def quarter(change: Callable[[Memory, int, float], float]) -> Inject:
    """Change what the front quarter of a lidar reads."""
    return sector(math.pi / 2, lambda _run, memory, beam, true: change(memory, beam, true))


def phantom(run: FaultSite) -> None:
    """Hang something before the lidar, 20° wide, on any side."""
    side = run.random.uniform(-math.pi, math.pi)
    sector(math.radians(20.0), lambda run, *_: 0.25 + run.random.uniform(-0.01, 0.01), side)(run)


def gyro(change: Callable[[float], float]) -> Inject:
    """Change the rate about the vertical axis."""

    def changed(_run: FaultSite, true: msg.Imu, _memory: Memory) -> msg.Imu:
        x, y, z = true.angular_velocity
        return replace(true, angular_velocity=(x, y, change(z)))

    return reading(changed)


def silent(_run: FaultSite, _true: object, _memory: Memory) -> None:
    """Return nothing."""


def blocked(run: FaultSite) -> None:
    """Hold the target's shaft where it is, whatever its torque."""
    run.world.world.hold(run.target)


CAUSES: dict[str, FaultCause] = {
    # frames
    "frames lost, 30 %": FaultCause(
        frames(lambda run, one: (one,) if run.random.below(10) > 2 else ()), "device"
    ),
    "frames doubled": FaultCause(frames(lambda _run, one: (one, one)), "device"),
    "frames 15 ms late": FaultCause(frames(lambda _run, one: later(one, 15 * MILLISECOND)), "device"),
    "frames reordered": FaultCause(
        frames(lambda run, one: later(one, run.random.below(12) * MILLISECOND)), "device"
    ),
    "feedback damaged": FaultCause(
        frames(lambda run, one: (one,) if one.sender == HOST else damaged(run, one)), "device"
    ),
    "commands damaged": FaultCause(
        frames(lambda run, one: damaged(run, one) if one.sender == HOST else (one,)), "device"
    ),
    "scans damaged": FaultCause(frames(damaged), "lidar"),
    "another baud rate": FaultCause(frames(misread), "device"),
    "host not received": FaultCause(frames(lambda _run, one: () if one.sender == HOST else (one,)), "device"),
    "devices not received": FaultCause(
        frames(lambda _run, one: (one,) if one.sender == HOST else ()), "device"
    ),
    "commands 300 ms late": FaultCause(
        frames(lambda _run, one: later(one, 300 * MILLISECOND) if one.sender == HOST else (one,)), "device"
    ),
    # motors
    "device resets": FaultCause(restarted, "motor", lambda run: run.world.reconnect(run.target)),
    "device silent": FaultCause(
        lambda run: run.world.disconnect(run.target), "device", lambda run: run.world.reconnect(run.target)
    ),
    "device in fault": FaultCause(provoked, "motor"),
    "encoder stuck": FaultCause(
        encoder(
            lambda _run, true, memory: replace(
                true, position=memory.setdefault("at", true.position), velocity=0.0
            )
        ),
        "motor",
    ),
    "feedback frozen": FaultCause(encoder(same_again), "motor"),
    "encoder jumps": FaultCause(encoder(jumped), "motor"),
    "encoder at half scale": FaultCause(scaled(0.5), "motor"),
    "encoder reversed": FaultCause(scaled(-1.0), "motor"),
    "encoders swapped": FaultCause(swapped, "wheel"),
    "motor blocked": FaultCause(blocked, "motor", lambda run: run.world.world.let_go(run.target)),
    "no torque": FaultCause(torque(lambda _given: 0.0), "motor"),
    "weak motor, 30 %": FaultCause(torque(lambda given: 0.3 * given), "motor"),
    "half torque": FaultCause(torque(lambda given: 0.5 * given), "motor"),
    "runaway": FaultCause(runaway, "motor"),
    # buses
    "bus-off": FaultCause(lost(BusState.OFF), "device"),
    "bus gone": FaultCause(lost(BusState.GONE), "device"),
    "bus saturated": FaultCause(saturated, "motor"),
    # clock and steps of the host, whatever device is named
    "stamps 1 s early": FaultCause(stamps(-SECOND), "device"),
    "stamps 1 h late": FaultCause(stamps(3600 * SECOND), "device"),
    "slow steps": FaultCause(slow_steps, "device"),
    "a step takes 400 ms": FaultCause(slow_step, "device"),
    # sensors
    "lidar: all zeros": FaultCause(ranges(lambda _run, scan: [0.0] * len(scan.ranges)), "lidar"),
    "lidar: all maxima": FaultCause(ranges(lambda _run, scan: [math.inf] * len(scan.ranges)), "lidar"),
    "lidar: 0.5 m too far": FaultCause(
        ranges(lambda _run, scan: [each and each + 0.5 for each in scan.ranges]), "lidar"
    ),
    "lidar: turned by 180°": FaultCause(turned(180.0), "lidar"),
    "lidar: turned by 5°": FaultCause(turned(5.0), "lidar"),
    "lidar: 90 % without a reading": FaultCause(
        ranges(lambda run, scan: [0.0 if run.random.below(10) else each for each in scan.ranges]), "lidar"
    ),
    "lidar: upside down": FaultCause(elsewhere(lambda beam, turn: turn - beam), "lidar"),
    "lidar: dust": FaultCause(ranges(dust), "lidar"),
    "lidar frozen": FaultCause(reading(same_again), "lidar"),
    "lidar: front quarter frozen": FaultCause(
        quarter(lambda memory, beam, true: memory.setdefault(str(beam), true)), "lidar"
    ),
    "lidar: front quarter blind": FaultCause(quarter(lambda *_: 0.0), "lidar"),
    "lidar: front quarter at maximum": FaultCause(quarter(lambda *_: math.inf), "lidar"),
    "lidar: a phantom at 0.25 m": FaultCause(phantom, "lidar"),
    "lidar silent": FaultCause(reading(silent), "lidar"),
    "IMU: bias of 0.3 rad/s": FaultCause(gyro(lambda rate: rate + 0.3), "imu"),
    "IMU saturated at 0.2 rad/s": FaultCause(gyro(lambda rate: max(-0.2, min(0.2, rate))), "imu"),
    "IMU constant": FaultCause(reading(same_again), "imu"),
    "IMU reversed": FaultCause(gyro(lambda rate: -rate), "imu"),
    "IMU silent": FaultCause(reading(silent), "imu"),
}
"""By name."""
