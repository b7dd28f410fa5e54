"""A log of a robot's CAN buses, held against its robot file: what was heard, and what was told.

Rules. Of each device: how long it was silent at most, which faults it reported. Of each motor also the
commands that it was sent, by whoever it was, held against the limits of the robot file; a guard asks more,
for it knows what was commanded. What was never heard is told as that. Values are at the output shaft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gateway.buses.log_file import LogSummary
from gateway.core.limits import Limits
from gateway.core.message_text import message_text
from gateway.core.robot import Motor, Robot
from gateway.errors import UserError
from gateway.monitor.state import DecodedPacket
from protocols.messages import COMMANDS, MILLISECOND, SECOND, Arm, Command, Event, Fault, Nanos

WIDER = 1.001
"""Times a limit: a number on the bus is rounded"""
MOST_FAULTS = 8
"""That are listed of a device"""


def places(robot: Robot, log: LogSummary, path: Path) -> dict[str, str]:
    """Return the robot's bus of each bus of a log: of the same name, or the only one. Raises UserError."""
    ours = [name for name, bus in robot.buses.items() if not bus.carries_bytes]
    same = {name: name for name in log.fd if name in ours}
    if same or (len(ours) == 1 and len(log.fd) == 1):
        return same or {next(iter(log.fd)): ours[0]}
    found, wanted = ", ".join(log.fd), ", ".join(ours) or "none"
    raise UserError(f"{path} has the buses {found}, {robot.name} has {wanted}: none has the same name")


@dataclass(slots=True)
class _Device:
    """What was heard of one device."""

    timeout: Nanos
    limits: Limits | None
    events: int = 0
    last: Nanos | None = None
    gap: tuple[Nanos, Nanos] = (0, 0)
    """The longest silence, and when it ended."""
    faults: dict[str, Nanos] = field(default_factory=dict)
    """By text, when each was first reported."""
    commands: dict[str, int] = field(default_factory=dict)
    """Set-points by kind."""
    arms: int = 0
    beyond: dict[str, tuple[int, Nanos, Command]] = field(default_factory=dict)
    """By number of a command that was beyond its limit: how often, when first, and that command."""

    def hear(self, t: Nanos, event: Event) -> None:
        """Take in what it sent."""
        before, self.last = t if self.last is None else self.last, t
        self.events += 1
        self.gap = max(self.gap, (t - before, t))
        if isinstance(event, Fault) and len(self.faults) < MOST_FAULTS:
            self.faults.setdefault(message_text(event), t)

    def tell(self, t: Nanos, command: Command) -> None:
        """Take in what it was sent."""
        kind = type(command).__name__
        self.commands[kind] = self.commands.get(kind, 0) + 1
        for name in _beyond(command, self.limits):
            count, first, one = self.beyond.get(name, (0, t, command))
            self.beyond[name] = (count + 1, first, one)


def _beyond(command: Command, limits: Limits | None) -> list[str]:
    """Return which numbers of a command are beyond their limits."""
    if limits is None:
        return []
    found = [
        name
        for name, most in (("velocity", limits.velocity), ("torque", limits.torque))
        if abs(getattr(command, name, 0.0)) > WIDER * most
    ]
    position: float | None = getattr(command, "position", None)
    if position is not None and limits.position is not None:
        low, high = limits.position
        found += ["position"] * (not low - limits.margin <= position <= high + limits.margin)
    return found


class Heard:
    """What a log has of a robot's devices."""

    def __init__(self, robot: Robot, buses: Mapping[str, str], began: Nanos) -> None:
        """`buses`: those of the robot, by that of the log; `began`: the log's first stamp."""
        there = set(buses.values())
        self._began, self._end = began, began
        self._devices = {
            one.name: _Device(
                one.joint.feedback_timeout if isinstance(one, Motor) else one.timeout,
                one.joint.limits if isinstance(one, Motor) else None,
                last=began,
            )
            for one in robot.devices()
            if one.bus in there
        }
        self._elsewhere = [one.name for one in robot.devices() if one.bus not in there]

    def take(self, decoded: DecodedPacket) -> None:
        """Take in a frame."""
        t = self._end = decoded.packet.t
        for event in decoded.events:
            name = str(getattr(event, "motor", "") or getattr(event, "sensor", ""))
            if name in self._devices:
                self._devices[name].hear(t, event)
        for command in decoded.commands:
            device = self._devices.get(str(getattr(command, "motor", "")))
            if device is not None and isinstance(command, Arm):
                device.arms += 1
            elif device is not None and isinstance(command, COMMANDS):
                device.tell(t, command)

    @property
    def sound(self) -> bool:
        """True if every device was heard, none was silent too long or in fault, and no command was beyond a
        limit."""
        return not any(self._wrong(one) for one in self._devices.values())

    def counts(self) -> dict[str, tuple[int, int]]:
        """Return of each device how many messages were heard, and how many things are to be said of it."""
        return {name: (one.events, len(self._wrong(one))) for name, one in self._devices.items()}

    def lines(self) -> list[str]:
        """Return what was heard, a line for each device and each finding."""
        lines = [line for name, one in self._devices.items() for line in self._told(name, one)]
        if self._elsewhere:
            lines.append(f"of buses that the log has not: {', '.join(self._elsewhere)}")
        return lines

    def _silence(self, one: _Device) -> tuple[Nanos, Nanos]:
        return max(one.gap, (self._end - (self._began if one.last is None else one.last), self._end))

    def _wrong(self, one: _Device) -> list[str]:
        """Return what is to be said of a device, one sentence each."""
        span, at = self._silence(one)
        wrong = ["nothing was heard of it"] if not one.events else []
        if one.events and span > one.timeout:
            wrong.append(
                f"silent for {span / MILLISECOND:.0f} ms until {self._time(at)}; its timeout is "
                f"{one.timeout / MILLISECOND:.0f} ms"
            )
        wrong += [f"at {self._time(t)}: {text}" for text, t in one.faults.items()]
        for name, (count, first, command) in one.beyond.items():
            most = getattr(one.limits, name)
            wrong.append(
                f"{count} commands beyond its limit of {name} ({most}); the first at {self._time(first)}: "
                f"{message_text(command)}"
            )
        return wrong

    def _told(self, name: str, one: _Device) -> list[str]:
        span, _ = self._silence(one)
        sent = ", ".join(f"{kind} {count}" for kind, count in sorted(one.commands.items()))
        told = f"; commands: {sent}" if sent else "; no command" * (one.limits is not None)
        head = f"{name}: {one.events} messages, at most {span / MILLISECOND:.0f} ms apart{told}"
        return [head, *(f"  {text}" for text in self._wrong(one))]

    def _time(self, t: Nanos) -> str:
        return f"{(t - self._began) / SECOND:.3f} s"
