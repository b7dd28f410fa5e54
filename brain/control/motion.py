"""The motion of a base: from a path, or a twist asked for by hand, to one command per joint.

Rules. It runs with its own period, and in between only when the stop zone finds the present twist too fast.
The twist is what the path or the hand wants, within the body's limits, approached within its accelerations
and jerks, and as slow as the stop zone asks. A stop forgets it; rest with nothing to do disarms the motors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from brain.belief import Pose
from brain.bodies.base_profile import approach
from brain.bodies.body import Base
from brain.bodies.plane import REST, Commanded, Twist
from brain.control.carry import Carry
from brain.control.pursuit import Pursuit, PursuitSettings
from brain.planning.polyline import Point
from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Event, Nanos, seconds

MAX_CONTROL_STEP: Nanos = 100 * MILLISECOND
"""A longer time between two commands counts as this: after a pause the speed must not jump."""
LEAST_READY = 0.02
"""Share of the wanted twist that is commanded while motors arm and wheels steer: it tells them where to"""


class Protection(Protocol):
    """What protects the base (`brain.planning.stop_zone`)."""

    def is_too_fast(self, now: Commanded) -> bool:
        """Return whether what was seen since the last call makes this motion too fast."""
        ...

    def allowed(self, before: Commanded, desired: Commanded, wanted: Twist, dt: float) -> Commanded:
        """Return the next motion: the desired one, or a slower one."""
        ...


class FollowedPath(Protocol):
    """A path (`brain.planning.planner`)."""

    @property
    def points(self) -> tuple[Point, ...]:
        """m"""
        ...

    @property
    def headings(self) -> tuple[float, ...] | None:
        """rad of the base at each point; None: along the way, turning at the corners"""
        ...

    @property
    def gears(self) -> tuple[int, ...] | None:
        """Of each part between two points: 1 forward, -1 backward; None: all forward"""
        ...


@dataclass(frozen=True, slots=True)
class MotionInputs:
    """What control needs to know at one moment."""

    pose: Pose
    """In the frame "map", now"""
    odom: Pose
    """In the frame "odom", now"""
    share: float
    """Of the largest speeds; 0: brake and stand"""
    busy: bool
    """There is something to do."""
    drive: Twist | None = None
    """By hand, in place of the path"""
    clearance: float = 0.0
    """m between the footprint and the nearest obstacle of the map"""


class MotionControl:
    """Control of one base. State is plain data."""

    def __init__(self, settings: PursuitSettings, body: Base, motors: Sequence[str]) -> None:
        self.settings, self.body = settings, body
        self.pursuit = Pursuit()
        self.carry = Carry()
        self.commanded = Commanded()
        """Twist, and its rate of change"""
        self.commands: Sequence[Command] = ()
        """The last, one per motor"""
        self._motors = tuple(motors)
        self._due: Nanos | None = None
        """When control is due next"""
        self._ran: Nanos | None = None
        """When it last ran"""
        self._rest_since: Nanos | None = None
        self._positions: dict[str, float] = {}
        """rad, the newest of each joint"""
        self._memory: Any = None
        """What the body remembers between two commands."""
        self._armed: dict[str, bool] = {}
        """Whether each motor was last reported as armed"""
        self._moved = False
        """Whether any motor was commanded to move since all were disarmed"""
        self._idle()

    @property
    def twist(self) -> Twist:
        """The twist that is commanded."""
        return self.commanded.twist

    @property
    def arrived(self) -> bool:
        """At rest at the end of the path, by the pose believed."""
        return self.pursuit.arrived and self.carry.settled

    @property
    def missed(self) -> str:
        """Why the end of the path cannot be reached on it; "" if it may be."""
        return self.pursuit.missed

    def follow(
        self,
        path: FollowedPath,
        yaw: float | None = None,
        slow: Callable[[float, float], float] | None = None,
    ) -> None:
        """Follow a path, and end in this yaw [rad] if one is given.

        `slow`: the largest speed [m/s] at a place [m, m]."""
        self.carry.begin()
        self.pursuit.follow(path.points, yaw, self.body, self.settings, path.headings, path.gears, slow)

    def drop(self) -> None:
        """Forget the path: brake."""
        self.pursuit.drop()

    def adopt(self, body: Base, settings: PursuitSettings) -> None:
        """Continue with other settings."""
        self.body, self.settings = body, settings

    def observe(self, events: Sequence[Event]) -> None:
        """Process the joints' feedback."""
        for event in events:
            if isinstance(event, msg.Feedback) and event.position is not None:
                self._positions[event.motor] = event.position
            elif isinstance(event, msg.State):
                self._armed[event.motor] = event.mode is msg.Mode.ARMED

    def is_due(self, now: Nanos, zone: Protection) -> bool:
        """Return whether a step is due now; if not, `commands` stay."""
        return self._due is None or now >= self._due or zone.is_too_fast(self.commanded)

    def step(self, now: Nanos, inputs: MotionInputs, zone: Protection) -> Sequence[Command]:
        """Return new commands, one per motor."""
        period = self.settings.period
        if self._due is None or now - self._due >= period:
            self._due = now + period
        elif now >= self._due:
            self._due += period
        since = seconds(period if self._ran is None else min(now - self._ran, MAX_CONTROL_STEP))
        self._ran = now
        before = self.commanded
        wanted = self.body.limit(self._wanted(inputs, since))
        desired = approach(before, wanted, since, self.body)
        armed = all(self._armed.get(joint, True) for joint in self.body.joints)
        ready = self.body.readiness(desired.twist, self._places()) if armed else 0.0
        if ready < 1.0:
            slower = wanted.scaled(max(ready, LEAST_READY))
            desired = approach(before, slower, since, self.body)
        self.commanded = zone.allowed(before, desired, wanted, since)
        self.commands = self._actuated(now, inputs.busy, since)
        return self.commands

    def disarm(self) -> Sequence[Command]:
        """Forget the motion; return Idle for every motor (Hold for those of a body that would fall)."""
        self.commanded, self._ran, self._due, self._rest_since = Commanded(), None, None, None
        return self._idle()

    # -- private ------------------------------------------------------------------------------

    def _wanted(self, inputs: MotionInputs, dt: float) -> Twist:
        """Return the twist wanted, before the body's limits."""
        body, pose = self.body, self.carry.pose(inputs.pose, inputs.odom, self.twist, dt)
        if inputs.drive is not None:
            return body.limit(inputs.drive).scaled(inputs.share)
        return self.pursuit.step(pose, self.twist, inputs.share, inputs.clearance, body, self.settings)

    def _actuated(self, now: Nanos, busy: bool, dt: float) -> Sequence[Command]:
        if self.twist != REST or busy:
            self._rest_since = None
        elif self._rest_since is None:
            self._rest_since = now
        rested = self._rest_since is not None and now - self._rest_since >= self.settings.idle_after
        if rested and self.body.rests_idle:
            return self._idle()
        if self._rest_since is not None and all(isinstance(c, msg.Idle | msg.Hold) for c in self.commands):
            return self._idle()  # not moved since it was last disarmed: there is nothing to bring to rest
        commands, self._memory = self.body.actuate(self.twist, self._places(), dt, self._memory)
        own, self._moved = {command.motor: command for command in commands}, True
        return tuple(own.get(motor) or msg.Idle(motor) for motor in self._motors)

    def _places(self) -> list[float | None]:
        """Return the newest position of each of the body's joints [rad]."""
        return [self._positions.get(joint) for joint in self.body.joints]

    def _idle(self) -> Sequence[Command]:
        """Return Idle for every motor. A body that would fall holds what is armed, until a new task."""
        self._memory = None
        self._moved = self._moved and any(self._armed.get(joint) for joint in self.body.joints)
        joints = self.body.joints if self._moved and not self.body.rests_idle else ()
        held = [motor for motor in joints if self._armed.get(motor)]
        self.commands = tuple(msg.Hold(one) if one in held else msg.Idle(one) for one in self._motors)
        return self.commands
