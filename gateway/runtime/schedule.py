"""How much of its buses a robot takes: counted on its simulated devices, bit by bit.

Rules. What driver and device exchange decides, not a table: the robot runs in virtual time as in the live
loop, every motor commanded and at rest, on buses with true bit times, and is counted from when all motors
are armed and have reported. Twins answer at the world's steps, so an age or a latency may be a step longer
than on the wire. A robot fits if no wire is full, no frame was dropped, every frame ends within the
`command_timeout` of the bus's motors, every motor reports within its `feedback_timeout`, and all are armed.
Motors that are not armed at any rate up to its own are no matter of the buses: they are named, not refused.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields, replace
from math import floor
from typing import TypeAlias

from gateway import config
from gateway.buses.frame_time import padded
from gateway.buses.virtual import open_world
from gateway.buses.virtual.bus import HOST, TwinBus
from gateway.buses.virtual.medium import Transmission
from gateway.config.robot_file import HIGHEST_RATE, LOWEST_RATE
from gateway.core.clock import SimulatedClock
from gateway.core.robot import TWIN, Motor, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Outputs
from gateway.errors import UserError
from gateway.runtime.loop import Reader, moments, write
from gateway.runtime.timing import LoopStats
from gateway.sim import WorldError
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Drive, Feedback, Hold, Instruction, Nanos, Velocity
from protocols.plugin import FeedbackKind

SETTLING: Nanos = 5 * SECOND
"""The longest time to find the devices, set them up and arm them."""
REST: Nanos = 100 * MILLISECOND
"""The time after that for what is under way."""
CROWDED: Nanos = SECOND // 2
"""The time for which a wire must be full for a measurement to end sooner."""
LEAST: Nanos = 3 * CROWDED
"""How soon it may end so."""
FULL = 0.98
"""Share of the time from which on a wire is full."""
WINDOW: Nanos = SECOND
"""Time that is counted, after settling."""
GLANCE: Nanos = 300 * MILLISECOND
"""Time that refutes most rates that do not fit."""
FINENESS = 0.01
"""Share of a rate to which the highest is found."""
COUNTING = "load of the buses"
"""The name of this work, for those who wait."""

Simulated: TypeAlias = Callable[[Nanos], None]
"""Is given the virtual time that has passed since it was last called, to show how far the work is."""


def unseen(_: Nanos) -> None:
    """Show nothing."""


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
    overtaken: float = 0.0
    """On a line on which devices speak only when asked: the share of the steps in which a set-point of the
    step before had not been sent."""
    frames: Counter[str] = field(default_factory=Counter)
    """Frames in the window by identifier (hexadecimal; "→" and "←" of serial bytes, from and to the host)."""
    ages: dict[str, Nanos] = field(default_factory=dict)
    """The longest age of each motor's feedback at a step."""
    unarmed: list[str] = field(default_factory=list)
    """Motors that are commanded, and at the end are not armed or have never reported."""
    late: dict[str, Nanos] = field(default_factory=dict)
    """Motors that reported too late, with the age that is allowed."""
    asked: bool = False
    """It is a line on which devices speak only when asked: questions keep it busy, and it may be full."""
    readings: Counter[str] = field(default_factory=Counter)
    """Reports of each motor in the window."""
    replaced: int = 0
    """On such a line: exchanges in the window that were not sent, since a newer one took their place."""

    @property
    def crowded(self) -> bool:
        """True if the wire is full, or frames come too late."""
        late = self.latency > self.patience or bool(self.late)
        full = self.load >= FULL and not self.asked  # questions fill a line at any rate
        return full or late or self.dropped or self.overtaken > 1.0 - FULL

    @property
    def fits(self) -> bool:
        """True if the bus carries the robot at its rate."""
        return not (self.crowded or self.unarmed)


@dataclass(slots=True)
class _Settling:
    """When the counting begins."""

    gateway: Gateway
    buses: Mapping[str, TwinBus]
    checked: Nanos = 0
    busy: dict[str, Nanos] = field(default_factory=dict)
    """Of each bus, when it was last checked."""
    done: Nanos | None = None
    """When all motors were armed and had reported."""

    def ends(self, now: Nanos, reported: Iterable[str]) -> bool:
        """True if all is at rest, or that is not waited for any longer."""
        joints, silent = self.gateway.joints, self.gateway.robot.motors.keys() - reported
        if not (all(one.armed for one in joints.values()) and not any(map(self._reports, silent))):
            self.done = None
        elif self.done is None:
            self.done = now
        rests = self.done is not None and now - self.done >= REST
        return rests or now >= SETTLING or (self._is_full(now) and now >= LEAST)

    def _reports(self, name: str) -> bool:
        return self.gateway.robot.motors[name].spec.feedback is not FeedbackKind.NONE

    def _is_full(self, now: Nanos) -> bool:
        """True if a wire was full since the last check."""
        if (passed := now - self.checked) < CROWDED:
            return False
        before, self.busy = self.busy, {name: bus.busy for name, bus in self.buses.items()}
        self.checked = now
        return any(
            busy - before.get(name, 0) >= FULL * passed
            for name, busy in self.busy.items()
            if name not in self.gateway.lines
        )


@dataclass(slots=True)
class _Count:
    """What a run counts."""

    buses: dict[str, BusSchedule]
    window: Nanos
    began: Nanos | None = None
    """None while it settles."""
    given: dict[str, dict[Frame, deque[Nanos]]] = field(default_factory=dict)
    """By bus: the host's frames that have not ended, and when each was given."""
    last: dict[str, Nanos] = field(default_factory=dict)
    """By motor: time of the newest feedback."""

    def transmission(self, bus: str, one: Transmission) -> Iterable[Transmission]:
        """Count a frame that has ended."""
        count = self.buses[bus]
        given = self.given.get(bus, {}).get(one.frame) if one.sender == HOST else None
        taken = one.t - given.popleft() if given else 0
        if self.began is not None and self.began < one.t <= self.began + self.window:
            arrow = "→" if one.sender == HOST else "←"
            frame = one.frame
            count.frames[str(frame).partition("#")[0] if isinstance(frame, CanFrame) else arrow] += 1
            count.latency = max(count.latency, taken)
        return (one,)

    def dropped(self, bus: str) -> None:
        """Count that frames were dropped: which of those that wait is unknown."""
        self.given.pop(bus, None)
        self.buses[bus].dropped |= self.began is not None

    def step(self, now: Nanos, outputs: Outputs, motors: Mapping[str, Motor]) -> None:
        """Count a step."""
        for packet in outputs.packets:
            frame = padded(packet.frame) if isinstance(packet.frame, CanFrame) else packet.frame
            self.given.setdefault(packet.bus, {}).setdefault(frame, deque()).append(now)
        for event in outputs.events:
            if isinstance(event, Feedback):
                self.last[event.motor] = max(event.t, self.last.get(event.motor, 0))
                self.buses[motors[event.motor].bus].readings[event.motor] += self.began is not None
        for name in self.last if self.began is not None else ():
            ages = self.buses[motors[name].bus].ages
            ages[name] = max(ages.get(name, 0), now - self.last[name])


def count_buses(
    robot: Robot, rate: float | None = None, window: Nanos = WINDOW, simulated: Simulated = unseen
) -> list[BusSchedule]:
    """Run a robot in virtual time, and count what is on its buses.

    Args:
        robot: its interfaces do not matter.
        rate: steps per second; None: as in the robot file.
        window: time that is counted.
        simulated: is shown how far it is.

    Returns:
        list[BusSchedule]: of every bus, in the order of the robot file.
    """
    robot = config.with_interfaces(robot, dict.fromkeys(robot.buses, TWIN))
    if rate is not None:
        robot = replace(robot, period=round(SECOND / rate))
    gateway, world = Gateway(robot), open_world(robot, robot.seed)
    count = _Count({name: BusSchedule(name) for name in robot.buses}, window)
    world.tamper.transmission = count.transmission
    clock, wanted, last, busy = SimulatedClock(), commands(robot), 0, dict[str, Nanos]()
    overtaken = dict[str, int]()
    reader, settling = Reader(gateway, world.buses, clock), _Settling(gateway, world.buses)
    for now in moments(clock, robot.period, gateway.due, LoopStats(), reader.wait, reader.least):
        inputs = reader.inputs(now, () if gateway.between(now) else wanted)
        simulated(now - last)
        last = now
        if count.began is None and settling.ends(now, count.last):
            count.began, busy = now, {name: bus.busy for name, bus in world.buses.items()}
            overtaken = {name: line.overtaken for name, line in gateway.lines.items()}
            for name, line in gateway.lines.items():
                count.buses[name].asked, count.buses[name].replaced = True, -line.replaced
        if count.began is not None and now >= count.began + window:
            break
        outputs = gateway.step(now, inputs)
        count.step(now, outputs, robot.motors)
        write(world.buses, now, outputs.packets)
        for name in (name for name, bus in world.buses.items() if bus.full):
            count.dropped(name)
    for name, line in gateway.lines.items():
        count.buses[name].replaced += line.replaced
    for name, bus in world.buses.items():
        count.buses[name].load = (bus.busy - busy[name]) / (last - (count.began or 0))
    for name, line in gateway.lines.items():
        steps = max(1.0, (last - (count.began or 0)) / robot.period)
        count.buses[name].overtaken = (line.overtaken - overtaken.get(name, 0)) / steps
    for name, motor in robot.motors.items():
        one = count.buses[motor.bus]
        silent = name not in one.ages and motor.spec.feedback is not FeedbackKind.NONE
        one.unarmed += [name] if silent or not gateway.joints[name].armed else []
        one.patience = min(one.patience, motor.joint.command_timeout)
        allowed = motor.joint.feedback_timeout
        if one.ages.get(name, 0) > allowed:
            one.late[name] = allowed
    return list(count.buses.values())


def lowest_rate(robot: Robot) -> float:
    """Return the lowest rate [Hz] that the robot file may state: a command must not be too old before the
    next."""
    shortest = min((motor.joint.command_timeout for motor in robot.motors.values()), default=SECOND)
    return max(LOWEST_RATE, float(SECOND // shortest + 1))


def highest_rate(robot: Robot, fitting: float = 0.0, simulated: Simulated = unseen) -> float:
    """Return the highest rate [Hz] at which the robot fits its buses; 0.0 if none was found.

    `fitting`: a rate that is known to fit, if one is."""
    if _fits(robot, HIGHEST_RATE, GLANCE, simulated) and _fits(robot, HIGHEST_RATE, WINDOW, simulated):
        return HIGHEST_RATE
    return _highest_between(robot, fitting, HIGHEST_RATE, simulated)


def _highest_between(robot: Robot, fitting: float, high: float, simulated: Simulated) -> float:
    """Return the highest rate that fits below one that does not: halved until one fits, then bisected, at a
    glance; then lowered, further each time, until it fits over the whole window."""
    low, lowest = high, max(fitting, lowest_rate(robot))
    while low > lowest:
        low, high = max(float(floor(low / 2.0)), lowest), low
        if low == fitting or _fits(robot, low, GLANCE, simulated):
            break
    else:
        return fitting
    while high - low > FINENESS * low and (middle := float(floor((low + high) / 2.0))) > low:
        low, high = (middle, high) if _fits(robot, middle, GLANCE, simulated) else (low, middle)
    less = FINENESS
    while low != fitting and not _fits(robot, low, WINDOW, simulated):
        if low <= lowest:
            return 0.0
        low, less = max(float(floor((1.0 - less) * low)), lowest), 2.0 * less
    return low


def _fits(robot: Robot, rate: float, window: Nanos, simulated: Simulated) -> bool:
    return all(one.fits for one in count_buses(robot, rate, window, simulated))


def refuse_overload(robot: Robot, simulated: Simulated = unseen) -> list[BusSchedule]:
    """Return what was counted. Raises UserError if a bus does not carry the robot, with what would fit, and
    NotCounted."""
    try:
        counted = count_buses(robot, None, WINDOW, simulated)
    except Exception as error:
        kind = "" if isinstance(error, WorldError) else f"{type(error).__name__}: "
        raise NotCounted(f"the load of the buses was not counted: {kind}{error}") from error
    full = [one for one in counted if not one.fits]
    if not full:
        return counted
    rate = SECOND / robot.period
    lower = _highest_between(robot, 0.0, rate, simulated)
    if not lower and not any(one.crowded for one in full):
        return counted  # what is not armed at a lower rate either has another reason than the wire
    text = [f"{robot.name} does not fit its buses at {rate:g} steps per second:"]
    text += [f"  {one.bus}: {reason(one)}" for one in full]
    crowded = [one.bus for one in full if len(robot.devices_on(one.bus)) > 1]
    slower = feedback_that_fits(robot, {one.bus for one in full}, simulated)
    ways = [f"lower the rate (rate_hz = {lower:g}, the highest that fits)"] if lower else []
    ways += [f"ask for feedback less often (feedback_ms = {slower} fits)"] if slower else []
    ways += [f"split {', '.join(crowded)}: devices on a bus of their own"] if crowded else []
    none = "" if lower else "no lower rate_hz fits; "
    raise UserError("\n".join([*text, none + "; or ".join([*ways, "raise the bit rate"])]))


def not_armed(counted: Sequence[BusSchedule]) -> str:
    """Return which motors are not armed, though their buses carry them; "" if none."""
    if not (names := [name for one in counted for name in one.unarmed]):
        return ""
    what = f"not armed on simulated devices, though commanded: {', '.join(names)}"
    return f"{what}; it is not for want of room on their buses"


def feedback_that_fits(robot: Robot, buses: Set[str], simulated: Simulated = unseen) -> int:
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
        slower, rate = replace(robot, motors=robot.motors | changed), SECOND / robot.period
        if _fits(slower, rate, GLANCE, simulated) and _fits(slower, rate, WINDOW, simulated):
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
    if one.overtaken > 1.0 - FULL:
        reasons.append(f"in {one.overtaken:.0%} of the steps a set-point of the step before was not sent yet")
    if one.latency > one.patience:
        patience = f"command_timeout allows {one.patience / 1e6:g} ms"
        reasons.append(f"a frame takes up to {one.latency / 1e6:.1f} ms; {patience}")
    if one.unarmed:
        reasons.append(f"not armed, though commanded: {', '.join(one.unarmed)}")
    for name, allowed in one.late.items():
        age = f"is up to {one.ages[name] / 1e6:.1f} ms old"
        reasons.append(f"the feedback of {name} {age}; feedback_timeout allows {allowed / 1e6:g} ms")
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
        if one.asked:
            each = ", ".join(f"{name} {n * SECOND // WINDOW}" for name, n in one.readings.items())
            lines.append(f"{'':12} readings/s: {each or '-'}; replaced by newer ones/s: {one.replaced}")
    return "\n".join([*lines, *filter(None, [not_armed(counted)])])


def commands(robot: Robot) -> Sequence[Instruction]:
    """Return what keeps every motor commanded, at rest."""
    able = robot.brain.abilities(robot.motors)
    joints = [
        Hold(name) if Hold in motor.joint.commands(motor.spec) else Velocity(name, 0.0)
        for name, motor in robot.motors.items()
        if name in able.joints
    ]
    return (Drive(0.0, 0.0), *joints) if able.wheels else joints
