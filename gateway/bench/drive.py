"""A short drive that shows how a base rolls: stated legs, driven by its wheels alone, watched by its lidar.

Rules. The wheels are bare joints here: what is to be calibrated decides nothing. Their limits, the guard and
the stop action are as ever; speeds rise and fall within the body's accelerations. Anything that comes nearer
to the lidar than the robot is wide, with a margin, ends the drive, and so does a joint that is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from brain.bodies import bare
from brain.bodies.body import Base
from brain.bodies.plane import Twist
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.runtime.session import Session
from protocols.messages import (
    SECOND,
    Command,
    Event,
    Feedback,
    Imu,
    LaserScan,
    Nanos,
    Position,
    Velocity,
    seconds,
)

LENGTH, ROUNDS = 0.8, 4
"""m that a leg leads away from the start; how often all legs are driven"""
FAST, QUICK = (0.35, 0.6), (1.0, 0.5)
"""m/s and rad/s of the legs, at most, and the share of the body's limits that they are at most"""
REST = 0.6
"""s between two legs,"""
FIRST = 1.5
"""and before the first: the gyro at rest"""
SPIN = 1.8
"""rad of a turn on the spot to one side"""
NEXT = 0.8
"""rad between the directions of two rounds"""
MARGIN = 0.12
"""m: beams that end nearer than the robot's circle and this end the drive,"""
NEAR = 3
"""if so many do"""
BLIND: Nanos = SECOND
"""Without a scan for so long, it ends."""
READY: Nanos = 15 * SECOND
"""For so long motors and sensors are awaited."""


class Leg(NamedTuple):
    """A speed for a time; ramps are within it."""

    linear: float
    angular: float
    seconds: float
    lateral: float = 0.0


def legs(body: Base, length: float = LENGTH, rounds: int = ROUNDS) -> list[Leg]:
    """Return the legs: there and back, a turn to both sides, an arc there and back, then all in another
    direction. A base that cannot turn on the spot drives arcs instead."""
    v = min(FAST[0], FAST[1] * body.max_linear)
    w = min(QUICK[0], QUICK[1] * body.max_angular)
    bend = min(w, v / body.turning_radius * 0.8) if body.turning_radius else 0.6 * w
    pause, ramp, spin_up = (
        Leg(0.0, 0.0, REST),
        v / body.max_linear_acceleration,
        w / body.max_angular_acceleration,
    )
    straight, arc = length / v + ramp, 0.7 * length / v + ramp
    found = [Leg(0.0, 0.0, FIRST)]
    for _ in range(rounds):
        found += [Leg(v, 0.0, straight), pause, Leg(-v, 0.0, straight), pause]
        if body.turning_radius:
            found += [Leg(v, -bend, arc), pause, Leg(-v, bend, arc), pause]
        else:
            turn = SPIN / w + spin_up
            more = 2.0 * SPIN / w + spin_up
            found += [Leg(0.0, w, turn), Leg(0.0, -w, more), Leg(0.0, w, turn + NEXT / w), pause]
        found += [Leg(v, bend, arc), pause, Leg(-v, -bend, arc), pause]
        if body.moves_sideways:
            found += [Leg(0.0, 0.0, straight, v), pause, Leg(0.0, 0.0, straight, -v), pause]
    return [*found, Leg(0.0, 0.0, FIRST)]


def bare_robot(robot: Robot) -> Robot:
    """Return the robot with its motors as bare joints; its sensors report as ever."""
    return replace(robot, brain=replace(robot.brain, body=bare(list(robot.motors)), other=None))


@dataclass(slots=True)
class PatternDrive:
    """The legs as set-points of the joints, and what came back. Plain data."""

    body: Base
    plan: Sequence[Leg]
    events: list[Event] = field(default_factory=list)
    """Of the drive so far"""
    ended: str = ""
    """Why it was ended before its time"""
    sees: bool = False
    """Whether a scan has come"""
    _came: bool = False
    """Whether one has come since the last set-points"""
    _scanned: Nanos = 0
    """When one had"""
    _began: Nanos | None = None
    _last: Nanos = 0
    _now: Twist = field(default_factory=Twist)
    _positions: dict[str, float] = field(default_factory=dict)
    _own: dict[str, np.ndarray[tuple[int], np.dtype[np.bool_]]] = field(default_factory=dict)
    """Of each lidar, the beams that end at the robot itself"""

    @property
    def span(self) -> float:
        """Seconds that all legs take."""
        return sum(leg.seconds for leg in self.plan)

    def observe(self, events: Sequence[Event]) -> None:
        """Keep what is reported, and look for what is too near."""
        for event in events:
            if isinstance(event, Feedback | Imu | LaserScan):
                self.events.append(event)
            if isinstance(event, Feedback) and event.position is not None:
                self._positions[event.motor] = event.position
            elif isinstance(event, LaserScan) and not self.ended:
                self.sees = self._came = True
                self._look(event)

    def _look(self, scan: LaserScan) -> None:
        ranges = np.asarray(scan.ranges)
        read = (ranges >= max(scan.range_min, 1e-3)) & (ranges < scan.range_max)
        own = self._own.get(scan.sensor)
        if own is None or len(own) != len(ranges):
            own = self._own[scan.sensor] = read & (ranges < self.body.inner_radius)
        near = read & ~own & (ranges < self.body.radius + MARGIN)
        if np.count_nonzero(near) >= NEAR:
            self.ended = (
                f"{scan.sensor} sees something {float(ranges[near].min()):.2f} m away: "
                f"give it a free circle, or shorter legs (--length)"
            )

    def commands(self, now: Nanos) -> list[Command] | None:
        """Return the joints' set-points; None once all legs are driven."""
        if self._began is None:
            self._began = self._last = self._scanned = now
        self._scanned, self._came = (now if self._came else self._scanned), False
        if now - self._scanned > BLIND:
            self.ended = f"no scan has come for {seconds(BLIND):g} s: it would drive blindly"
        since, dt = seconds(now - self._began), seconds(now - self._last)
        self._last = now
        for leg in self.plan:
            if since < leg.seconds:
                wanted = Twist(leg.linear, leg.angular, leg.lateral)
                return self._towards(self.body.limit(wanted), dt)
            since -= leg.seconds
        return None

    def _towards(self, wanted: Twist, dt: float) -> list[Command]:
        most = self.body.max_linear_acceleration * dt, self.body.max_angular_acceleration * dt
        steps = zip(self._now, wanted, (most[0], most[1], most[0]), strict=True)
        self._now = Twist(*(a + min(max(b - a, -step), step) for a, b, step in steps))
        at = [self._positions.get(name) for name in self.body.joints]
        made: list[Command] = []
        for name, one in zip(self.body.joints, self.body.inverse(self._now, at), strict=True):
            made.append(
                Velocity(name, one.velocity)
                if one.velocity is not None
                else Position(name, one.position or 0.0)
            )
        return made


def drive(session: Session, made: PatternDrive) -> None:
    """Drive the legs; the stop action is sent at the end. Raises UserError if nothing was driven."""
    began = session.clock.now()
    commands: list[Command] = []
    with closing(session.run(poll=lambda: commands)) as ticks:
        for tick in ticks:
            made.observe(tick.outputs.events)
            waits = session.belief.systems and session.belief.reason.startswith("waiting")
            heard = all(session.joints[name].is_heard_since(0) for name in made.body.joints)
            if session.gateway.in_fault() or session.gateway.why_stopped():
                made.ended = made.ended or session.gateway.in_fault() or session.gateway.why_stopped()
            if made.ended:
                break
            if waits or not heard or not made.sees:
                if tick.now - began > READY:
                    lacks = "no scan of a lidar has come" if heard else "not all motors were heard"
                    raise UserError(f"it is not ready: {session.belief.reason or lacks}")
                continue
            wanted = made.commands(tick.now)
            if wanted is None:
                break
            commands = wanted
