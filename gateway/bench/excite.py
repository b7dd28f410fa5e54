"""Steps and sines of one joint's velocity, within a declared travel about where it stands.

Rules. The joint is commanded as by a person: through its limits and the guard; the other motors are not
commanded. Each step goes there and back, slow ones first. A joint that leaves the travel, is in fault or is
lost ends it; however it ends, the stop action is sent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.bench.joint_trace import JointTrace
from gateway.config.robot_file import with_motor_alone
from gateway.core.limits import Limits
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.runtime.session import Session
from protocols.messages import SECOND, Instruction, Nanos, Velocity, seconds

STEPS = (0.1, 0.1, 0.4, 0.7, 1.0)
"""Shares of the speed of the steps, each there and back"""
SINES = (1.0, 2.5)
"""Hz"""
CYCLES = 4
LONGEST, SHORTEST = 2.0, 0.15
"""s of a step to one side"""
PAUSE = 0.25
"""s between the parts"""
READY: Nanos = 15 * SECOND
OVERSHOOT = 1.5
"""Times the speed that is commanded, which a joint may turn: a loop that is not tuned yet overshoots"""
OVER = 1.25
"""Times the travel, at which a joint has left it"""


class Part(NamedTuple):
    """A velocity for a time; with a frequency a sine of this amplitude."""

    velocity: float
    seconds: float
    hertz: float = 0.0


def parts(limits: Limits, speed: float, travel: float) -> list[Part]:
    """Return the parts: rad/s at most, rad to either side of the start."""
    found = [Part(0.0, PAUSE)]
    for share in STEPS:
        v = share * speed
        ramp = v / limits.acceleration
        span = min(LONGEST, travel / v - ramp)
        if span < SHORTEST:
            continue
        found += [Part(v, span), Part(-v, 2.0 * span), Part(v, span), Part(0.0, PAUSE)]
    for hertz in SINES:
        amplitude = min(
            0.6 * speed, travel * math.pi * hertz, 0.7 * limits.acceleration / (2.0 * math.pi * hertz)
        )
        found += [Part(amplitude, CYCLES / hertz, hertz), Part(0.0, PAUSE)]
    return found


def one_motor(robot: Robot, motor: str, speed: float) -> Robot:
    """Return the robot with this joint alone, its speed limited. Raises UserError where that cannot be."""
    JointTrace(robot, motor)
    settings = robot.motors[motor]
    if Velocity not in settings.joint.commands(settings.spec):
        raise UserError(f"{motor} takes no velocity ({settings.plugin.name}): it cannot be stepped")
    limits = settings.joint.limits
    if speed > limits.velocity:
        raise UserError(f"--speed {speed:g}: the limit of {motor} is {limits.velocity:g} rad/s")
    most = min(limits.velocity, OVERSHOOT * speed)
    return with_motor_alone(robot, motor, most)


@dataclass(slots=True)
class Excitation:
    """The parts as set-points over time, and why they ended. Plain data."""

    motor: str
    plan: Sequence[Part]
    travel: float
    trace: JointTrace
    ended: str = ""
    _began: Nanos | None = None
    _start: float | None = None
    _last: float = field(default=math.nan)

    @property
    def span(self) -> float:
        """Seconds that all parts take."""
        return sum(part.seconds for part in self.plan)

    def velocity(self, now: Nanos) -> float | None:
        """Return the velocity that is wanted; None once all is done."""
        self._began = now if self._began is None else self._began
        since = seconds(now - self._began)
        for part in self.plan:
            if since < part.seconds:
                return part.velocity * (math.cos(2.0 * math.pi * part.hertz * since) if part.hertz else 1.0)
            since -= part.seconds
        return None

    def watch(self) -> None:
        """End it if the joint has left the travel."""
        if not self.trace.position:
            return
        at = self.trace.position[-1][1]
        self._start = at if self._start is None else self._start
        if abs(at - self._start) > OVER * self.travel:
            self.ended = f"it has moved by {at - self._start:+.2f} rad, {self.travel:g} were declared"

    def changed(self, wanted: float) -> Sequence[Instruction]:
        """Return the instruction for a velocity that is new."""
        if wanted == self._last:
            return ()
        self._last = wanted
        return (Velocity(self.motor, wanted),)


def excite(session: Session, made: Excitation) -> None:
    """Run all parts; the stop action is sent at the end. Raises UserError if the joint is never ready."""
    began, instructions = session.clock.now(), list[Instruction]()

    def poll() -> Sequence[Instruction]:
        given = tuple(instructions)
        instructions.clear()
        return given

    joint = session.joints[made.motor]
    with closing(session.run(poll=poll)) as ticks:
        for tick in ticks:
            made.trace.take(tick)
            made.watch()
            why = session.gateway.in_fault() or session.gateway.why_stopped()
            why = why or next((fault.name for fault in joint.faults.values()), "")
            if made.ended or why:
                made.ended = made.ended or why
                break
            if not joint.is_heard_since(0) or session.belief.reason.startswith("waiting"):
                if tick.now - began > READY:
                    raise UserError(
                        f"{made.motor} is not ready: {session.belief.reason or 'it is not heard'}"
                    )
                continue
            wanted = made.velocity(tick.now)
            if wanted is None:
                break
            instructions += made.changed(wanted)
