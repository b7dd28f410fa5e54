"""How much of its buses a robot takes: counted on its simulated devices, bit by bit.

Rules. What driver and device exchange decides, not a table: the robot runs in virtual time, every motor
commanded and at rest, on buses with true bit times. Twins answer at the world's steps, so an age or a latency
may be a step longer than on the wire. A robot fits if no wire is full, no frame was dropped, every frame ends
within the `command_timeout` of the bus's motors, every motor reports within its `feedback_timeout`, and all
are armed.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields, replace
from math import floor

from brain.bodies.body import Base
from gateway import config
from gateway.buses.virtual import open_world
from gateway.buses.virtual.bus import HOST
from gateway.buses.virtual.medium import Transmission
from gateway.config.robot_file import HIGHEST_RATE, LOWEST_RATE
from gateway.core.clock import SimulatedClock
from gateway.core.robot import TWIN, Motor, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.errors import UserError
from gateway.runtime.loop import LoopStats, moments, read, write
from gateway.sim import WorldError
from protocols.frames import CanFrame
from protocols.messages import SECOND, Drive, Feedback, Hold, Instruction, Nanos, Velocity

SETTLING: Nanos = 3 * SECOND // 2
"""Time to find the devices, set them up and arm them."""
FULL = 0.98
"""Share of the time from which on a wire is full."""
WINDOW: Nanos = SECOND
"""Time that is counted, after settling."""


class NotCounted(UserError):
    """The load of the buses could not be counted, for want of a world or of a twin that works: a robot on its
    own buses does without."""


@dataclass(slots=True)
class BusSchedule:
    """What was counted on one bus."""

    bus: str
    load: float = 0.0
    """The share of the time in which the wire is not idle."""
    latency: Nanos = 0
    """The longest time from a step to the end of a frame that it sends."""
    patience: Nanos = SECOND
    """The shortest `command_timeout` of its motors: the latency that is allowed."""
    dropped: bool = False
    """Whether frames of the host were dropped."""
    frames: Counter[str] = field(default_factory=Counter)
    """Frames per second by identifier (hexadecimal; "→" and "←" of serial bytes, from and to the host)."""
    ages: dict[str, Nanos] = field(default_factory=dict)
    """The longest age of each motor's feedback at a step."""
    unarmed: list[str] = field(default_factory=list)
    """Motors that are commanded and not armed at the end, as those are whose reports come too late."""
    late: dict[str, Nanos] = field(default_factory=dict)
    """Motors that reported too late, with the age that is allowed; 0: that did not report."""

    @property
    def crowded(self) -> bool:
        """True if the wire is full, or frames come too late."""
        return self.load >= FULL or self.latency > self.patience or self.dropped or bool(self.late)

    @property
    def fits(self) -> bool:
        """True if the bus carries the robot at its rate."""
        return not (self.crowded or self.unarmed)


@dataclass(slots=True)
class _Count:
    """What a run counts."""

    buses: dict[str, BusSchedule]
    began: Nanos
    sent: dict[str, deque[Nanos]] = field(default_factory=dict)
    """By bus: when the frames were given that have not ended."""
    last: dict[str, Nanos] = field(default_factory=dict)
    """By motor: time of the newest feedback."""

    def transmission(self, bus: str, one: Transmission) -> Iterable[Transmission]:
        """Count a frame that has ended."""
        count = self.buses[bus]
        given = self.sent[bus].popleft() if one.sender == HOST and self.sent.get(bus) else None
        if self.began <= one.t < self.began + WINDOW:
            arrow = "→" if one.sender == HOST else "←"
            frame = one.frame
            count.frames[str(frame).partition("#")[0] if isinstance(frame, CanFrame) else arrow] += 1
            count.latency = max(count.latency, 0 if given is None else one.t - given)
        return (one,)

    def step(self, now: Nanos, outputs: Outputs, motors: Mapping[str, Motor]) -> None:
        """Count a step."""
        for packet in outputs.packets:
            self.sent.setdefault(packet.bus, deque()).append(now)
        for event in outputs.events:
            if isinstance(event, Feedback):
                self.last[event.motor] = max(event.t, self.last.get(event.motor, 0))
        if now < self.began:
            return
        for name, motor in motors.items():
            ages = self.buses[motor.bus].ages
            ages[name] = max(ages.get(name, 0), now - self.last.get(name, 0))


def count_buses(robot: Robot, rate: float | None = None) -> list[BusSchedule]:
    """Run a robot in virtual time, and count what is on its buses.

    Args:
        robot: its interfaces do not matter.
        rate: steps per second; None: as in the robot file.

    Returns:
        list[BusSchedule]: of every bus, in the order of the robot file.
    """
    robot = config.with_interfaces(robot, dict.fromkeys(robot.buses, TWIN))
    if rate is not None:
        robot = replace(robot, period=round(SECOND / rate))
    gateway, world = Gateway(robot), open_world(robot, robot.seed)
    count = _Count({name: BusSchedule(name) for name in robot.buses}, SETTLING)
    world.tamper.transmission = count.transmission
    clock, commands, busy = SimulatedClock(), _commands(robot), dict[str, Nanos]()
    for now in moments(clock, robot.period, gateway.due, LoopStats()):
        states, packets = read(world.buses, now)
        for name, bus in world.buses.items():
            one = count.buses[name]
            if now >= SETTLING:
                one.load = (bus.busy - busy.setdefault(name, bus.busy)) / WINDOW
                one.dropped = one.dropped or bus.full
        if now >= SETTLING + WINDOW:
            break
        outputs = gateway.step(now, Inputs(tuple(states), tuple(packets), tuple(commands)))
        count.step(now, outputs, robot.motors)
        write(world.buses, now, outputs.packets)
    for name, motor in robot.motors.items():
        one = count.buses[motor.bus]
        one.unarmed += [] if gateway.joints[name].armed else [name]
        one.patience = min(one.patience, motor.joint.command_timeout)
        allowed, age = motor.joint.feedback_timeout, one.ages.get(name)
        if name not in count.last or age is None:
            one.late[name] = 0
        elif age > allowed:
            one.late[name] = allowed
    return list(count.buses.values())


def highest_rate(robot: Robot, counted: Sequence[BusSchedule]) -> float:
    """Return the highest rate [Hz] at which the robot fits its buses; 0.0 if it does not at any.

    What a step sends, and is answered with, grows with the rate; the rest does not: a second count gives a
    first guess, which is confirmed, or else halved in on."""
    rate = SECOND / robot.period
    busier = count_buses(robot, min(2.0 * rate, HIGHEST_RATE))
    guess = HIGHEST_RATE
    for one, more in zip(counted, busier, strict=True):
        if not more.fits:
            per_hertz = max((more.load - one.load) / rate, 1e-6)
            guess = min(guess, rate + (1.0 - one.load) / per_hertz if one.fits else rate)
    low, high = LOWEST_RATE, float(floor(guess))
    if _fits(robot, high):
        return high
    if not _fits(robot, low):
        return 0.0
    while high - low > max(1.0, low / 100.0):
        middle = float(floor((low + high) / 2.0))
        low, high = (middle, high) if _fits(robot, middle) else (low, middle)
    return low


def _fits(robot: Robot, rate: float) -> bool:
    return all(one.fits for one in count_buses(robot, rate))


def refuse_overload(robot: Robot) -> list[BusSchedule]:
    """Return what was counted. Raises UserError if a bus does not carry the robot, with what would fit, and
    NotCounted."""
    try:
        counted = count_buses(robot)
    except Exception as error:
        kind = "" if isinstance(error, WorldError) else f"{type(error).__name__}: "
        raise NotCounted(f"the load of the buses was not counted: {kind}{error}") from error
    full = [one for one in counted if not one.fits]
    if not full:
        return counted
    rate, fits = SECOND / robot.period, highest_rate(robot, counted)
    if not fits and not any(one.crowded for one in full):
        return counted  # what is not armed at any rate has another reason than the wire
    text = [f"{robot.name} does not fit its buses at {rate:g} steps per second:"]
    text += [f"  {one.bus}: {reason(one)}" for one in full]
    crowded = [one.bus for one in full if len(robot.devices_on(one.bus)) > 1]
    lower = f"rate_hz = {fits:g}, the highest that fits" if fits else "no rate_hz fits"
    slower = feedback_that_fits(robot, {one.bus for one in full})
    ask = f"; or ask for feedback less often (feedback_ms = {slower} fits)" if slower else ""
    split = f"; or split {', '.join(crowded)}: devices on a bus of their own" if crowded else ""
    raise UserError("\n".join([*text, f"lower the rate ({lower}){ask}{split}; or raise the bit rate"]))


def feedback_that_fits(robot: Robot, buses: Set[str]) -> int:
    """Return a period for the option `feedback_ms` of the motors on these buses with which the robot fits at
    its rate: two, four or eight times the longest of them; 0 if none does, or none of them has the option."""
    asked = {
        name: motor
        for name, motor in robot.motors.items()
        if motor.bus in buses and "feedback_ms" in (one.name for one in fields(motor.device.options))
    }
    longest = max((motor.device.options.feedback_ms for motor in asked.values()), default=0)
    for milliseconds in (2 * longest, 4 * longest, 8 * longest) if longest else ():
        try:
            changed = {name: _asked_every(motor, milliseconds) for name, motor in asked.items()}
        except ValueError:  # more than a driver or a device can have
            return 0
        if all(one.fits for one in count_buses(replace(robot, motors=robot.motors | changed))):
            return milliseconds
    return 0


def _asked_every(motor: Motor, milliseconds: int) -> Motor:
    """Return a motor whose driver asks for feedback at this period. Raises ValueError."""
    device = replace(motor.device, options=replace(motor.device.options, feedback_ms=milliseconds))
    return replace(motor, device=device, spec=motor.plugin.spec(device))


def reason(one: BusSchedule) -> str:
    """Return why a bus does not carry the robot."""
    reasons = []
    if one.dropped:
        reasons.append("frames are dropped, since more are sent than it carries")
    elif one.load >= FULL:
        reasons.append("the wire is full")
    if one.latency > one.patience:
        patience = f"command_timeout allows {one.patience / 1e6:g} ms"
        reasons.append(f"a frame takes up to {one.latency / 1e6:.1f} ms; {patience}")
    if one.unarmed:
        reasons.append(f"not armed, though commanded: {', '.join(one.unarmed)}")
    for name, allowed in one.late.items():
        age = f"is up to {one.ages[name] / 1e6:.1f} ms old; feedback_timeout allows {allowed / 1e6:g} ms"
        reasons.append(f"the feedback of {name} {age if allowed else 'does not come'}")
    return f"{min(one.load, 1.0):.0%} busy; " + "; ".join(reasons)


def table(counted: Sequence[BusSchedule]) -> str:
    """Return what was counted as text, a line for each bus."""
    lines = [f"{'bus':12} {'busy':>6} {'frames/s':>9} {'a command ends':>15}   feedback is at most"]
    for one in counted:
        ages = ", ".join(f"{name} {age / 1e6:.1f}" for name, age in one.ages.items())
        ends = f"{one.latency / 1e6:.2f} ms" if one.latency else "-"
        frames = one.frames.total() * SECOND // WINDOW
        lines.append(
            f"{one.bus:12} {one.load:6.1%} {frames:9} {ends:>15}   {ages + ' ms old' if ages else '-'}"
        )
    return "\n".join(lines)


def _commands(robot: Robot) -> Sequence[Instruction]:
    """Return what keeps every motor commanded, at rest."""
    body = robot.brain.body
    wheels = body.joints if isinstance(body, Base) else ()
    joints = [
        Hold(name) if Hold in motor.spec.commands else Velocity(name, 0.0)
        for name, motor in robot.motors.items()
        if name not in wheels
    ]
    return (Drive(0.0, 0.0), *joints) if wheels else joints
