"""The guard alone, on frames that somebody has sent: would they have been allowed?

Rules. What another program sent counts as asked for: the question is whether the devices may obey it, by
the limits of the robot file, by what they had reported by then, and by what they were sent before. What was
blocked counts as not obeyed, so what follows is held against what was allowed. On CAN alone, where the ids
tell who sends a frame to whom.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace

from gateway.core.bus_driver import BusDriver
from gateway.core.guard import Blocked, Guard
from gateway.core.joint import Joint
from gateway.core.message_text import message_text
from gateway.core.robot import Robot
from protocols import messages as msg
from protocols.asked import SET_POINTS
from protocols.frames import CanFrame, IdMask, Packet, any_matches
from protocols.messages import SECOND, Command, Nanos, Obeyed, Request
from protocols.plugin import Spec

RESTS: Sequence[type[Command]] = (msg.Hold, msg.Velocity, msg.Torque, msg.Position, msg.Impedance)
"""Commands by which a device rests, the plainest first"""
NUMBERS_OF: Mapping[str, tuple[type[Command], str]] = {
    f"{kind.__name__}.{one.name}": (kind, one.name) for kind in SET_POINTS for one in fields(kind)
}
"""By the name that a number of a set-point has in a spec"""
SHOWN = 8
"""Requests of a motor that are listed"""


@dataclass(slots=True)
class _Finding:
    """What was blocked for one reason."""

    first: Nanos
    example: Blocked
    count: int = 0


@dataclass(slots=True)
class _Counted:
    """What was sent to one motor."""

    frames: int = 0
    blocked: dict[str, _Finding] = field(default_factory=dict)
    """By rule"""
    requests: dict[str, int] = field(default_factory=dict)
    """What only a person may ask for: counted as asked"""


def _rest(spec: Spec) -> type[Command]:
    """Return the plainest kind of command of a device by which it rests."""
    return next((kind for kind in RESTS if kind in spec.commands), msg.Hold)


def _zero(kind: type[Command], motor: str) -> Command:
    """Return a command of this kind with all numbers 0."""
    return kind(motor, *[0.0] * (sum(one.default is MISSING for one in fields(kind)) - 1))


class _OwnedJoint(Joint):
    """The joint of a motor that somebody commands: it counts as ours."""

    @property
    def owned(self) -> bool:
        """True: somebody commands it."""
        return True


class GuardOnly:
    """A guard that hears both directions of a robot's CAN buses, and counts what it would have blocked.

    Args:
        robot: whose devices are on the buses.
        began: the time from which times are told [ns].
    """

    def __init__(self, robot: Robot, began: Nanos) -> None:
        self._robot, self._began = robot, began
        self._guard = Guard(robot)
        self._joints = {name: _OwnedJoint(name, one.joint, one.spec) for name, one in robot.motors.items()}
        self._drivers: list[tuple[BusDriver, tuple[IdMask, ...], tuple[IdMask, ...]]] = []
        specs = {one.name: one.spec for one in robot.devices()}
        for bus, settings in robot.buses.items():
            for plugin, devices in robot.by_protocol(bus) if not settings.carries_bytes else ():
                motors = frozenset(one.name for one in devices if one.name in self._joints)
                one = BusDriver(bus, plugin.name, motors, plugin.driver(devices), ())
                own = [specs[each.name] for each in devices]
                sends = tuple(mask for spec in own for mask in (*spec.sends, *spec.obeys_also))
                self._drivers.append((one, tuple(mask for spec in own for mask in spec.expects), sends))
        self._counted = {name: _Counted() for name in self._joints}
        self._unaddressed = _Counted()
        """Of frames that are for no motor in particular"""
        self.others = 0
        """Frames of devices that the robot does not have"""

    def take(self, packet: Packet) -> None:
        """Take a frame, of a device or to one."""
        frame = packet.frame
        known = False
        for driver, expects, sends in self._drivers:
            if packet.bus != driver.bus or not isinstance(frame, CanFrame):
                continue
            if any_matches(sends, frame) and not (any_matches(expects, frame) and not frame.remote):
                known = True
                self._judge(packet.t, driver, frame)
            elif any_matches(expects, frame):
                known = True
                self._hear(packet, driver)
        self.others += not known

    def _hear(self, packet: Packet, driver: BusDriver) -> None:
        for event in driver.driver.receive(packet.t, packet.frame):
            self._guard.answer(event)
            name = getattr(event, "motor", "")
            if name in self._joints and isinstance(event, msg.Feedback | msg.State | msg.Fault):
                self._joints[name].on_event(event)

    def _judge(self, now: Nanos, driver: BusDriver, frame: CanFrame) -> None:
        meant = self._guard.overhear(now, driver.bus, frame)
        named = {name for one in meant if (name := getattr(one, "motor", "")) in self._joints}
        if not meant and not self._guard.reads(driver.bus, driver.protocol, frame):
            named = {
                name for name in driver.motors if any_matches(self._robot.motors[name].spec.sends, frame)
            }
        for one in meant:
            for asked in self._meant(one):
                self._guard.ask(now, asked)
        _, blocked = self._guard.check(now, driver.bus, driver.protocol, [frame], self._joints, stopped=False)
        for counted in [self._counted[name] for name in sorted(named)] or [self._unaddressed]:
            counted.frames += 1
            for each in blocked:
                counted.blocked.setdefault(each.rule, _Finding(now, each)).count += 1

    def _meant(self, one: Obeyed) -> Iterator[Command | Request]:
        """Yield what was asked for, if somebody lets a device obey this."""
        motor = self._robot.motors.get(getattr(one, "motor", ""))
        if isinstance(one, Command | Request):
            yield one
        if motor is None:
            return
        declared = motor.spec.set_up
        if isinstance(one, msg.Arm):
            yield _zero(_rest(motor.spec), motor.name)
        elif isinstance(one, msg.Kept | msg.WriteParameter):
            name = one.name if isinstance(one, msg.Kept) else one.parameter
            if name in NUMBERS_OF:  # a set-point that waits
                kind, number = NUMBERS_OF[name]
                yield replace(_zero(kind, motor.name), **{number: one.value})  # type: ignore[arg-type]
            for each in declared.get(name, ()):  # a mode, for which set-points follow
                if isinstance(each, tuple) and isinstance(each[1], type) and each[0] == one.value:
                    yield _zero(each[1], motor.name)
            if isinstance(one, msg.Kept) or name in declared:
                return
        if isinstance(one, Request):
            requests, text = self._counted[motor.name].requests, message_text(one)
            requests[text] = requests.get(text, 0) + 1

    @property
    def sound(self) -> bool:
        """True if something was sent to a motor, and all of it would have been allowed."""
        all_ = [self._unaddressed, *self._counted.values()]
        return any(one.frames for one in self._counted.values()) and not any(one.blocked for one in all_)

    def lines(self) -> list[str]:
        """Return what would have been allowed, a line for each motor and each reason."""
        found: Mapping[str, _Counted] = self._counted | {"no motor in particular": self._unaddressed}
        lines = []
        for name, one in found.items():
            if not one.frames:
                lines += [f"{name}: no frame to it"] * (one is not self._unaddressed)
                continue
            blocked = sum(each.count for each in one.blocked.values())
            lines.append(f"{name}: {_frames(one.frames)} to it, {blocked} would have been blocked")
            asked = list(one.requests.items())
            lines += [f"  {_times(count)}, if a person asks for it: {text}" for text, count in asked[:SHOWN]]
            lines += [f"  and {len(asked) - SHOWN} more such requests"] * (len(asked) > SHOWN)
            for each in one.blocked.values():
                at = (each.first - self._began) / SECOND
                lines.append(f"  {_times(each.count)}, from {at:.3f} s on: {each.example.text}")
        lines += [f"left out: {_frames(self.others)} of no device of the robot"] * bool(self.others)
        serial = [name for name, bus in self._robot.buses.items() if bus.carries_bytes]
        lines += [f"not judged, since bytes do not tell who sent them: {', '.join(serial)}"] * bool(serial)
        return lines


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"
