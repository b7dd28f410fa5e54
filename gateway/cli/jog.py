"""`gateway jog`: one motor, slowly, as long as a key is held; and what comes back.

Rules. The motor goes through the gateway, its joint and the live loop like any other; the robot has this one
motor and no more, so that no other is commanded. Its speed is a limit of its joint. Nothing is sent but
read-only frames before the first key. Nothing moves again by itself: after a fault the key has to be pressed
anew. Whatever ends it (q, a signal, an exception, a terminal that is gone), the safe word goes out first, and
then the terminal is as it was.
"""

from __future__ import annotations

import logging
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace

from brain.bodies.joints import Joints
from gateway import config
from gateway.cli.terminal.keys import Held, Key, parse, press, raw, read, share
from gateway.cli.terminal.screen import Line
from gateway.config import resources
from gateway.config.errors import unknown
from gateway.core.joint import Joint
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.monitor.render import QUANTITIES, age, fault
from gateway.runtime.session import Session, open_session
from protocols.messages import MILLISECOND, ClearFault, Idle, Instruction, Nanos, Velocity

log = logging.getLogger("gateway")

SHARE = 0.05
"""Of the joint's limit of velocity, if no speed is given."""
REFRESH: Nanos = 100 * MILLISECOND


def jog(options: Namespace) -> int:
    """Jog a motor from the keyboard until told to leave."""
    robot = config.load_robot(resources.find("robots", options.robot))
    robot = alone(config.with_interfaces(robot, dict(options.bus)), options.motor, options.speed)
    if not sys.stdin.isatty():
        raise UserError("the motor turns as long as a key is held: this needs a terminal as standard input")
    terminal = sys.stdin.fileno()
    with open_session(robot) as made:
        line = Line(sys.stdout)
        line.above(help_text(robot, options.motor))
        with raw(terminal), above(line):
            drive(made, options.motor, lambda: read(terminal), line.draw)
        line.end()
        left = made.gateway.joints[options.motor].faults
    return 1 if left else 0


def alone(robot: Robot, motor: str, speed: float | None = None) -> Robot:
    """The robot reduced to one motor, whose joint goes no faster than `speed` [rad/s].

    Raises UserError for a motor that it does not have or that takes no velocity, and for too high a speed."""
    if motor not in robot.motors:
        raise UserError(unknown("motor", motor, robot.motors))
    part = robot.motors[motor]
    if Velocity not in part.spec.commands:
        raise UserError(f"{motor} takes no velocity ({part.plugin.name}): it cannot be jogged")
    limits = part.joint.limits
    speed = SHARE * limits.velocity if speed is None else speed
    if speed > limits.velocity:
        raise UserError(f"--speed {speed:g}: the limit of {motor} is {limits.velocity:g} rad/s")
    joint = replace(part.joint, limits=replace(limits, velocity=speed))
    return replace(
        robot,
        world=robot.world if robot.brain.body == "joints" else None,
        buses={part.bus: robot.buses[part.bus]},
        motors={motor: replace(part, joint=joint)},
        sensors={},
        brain=replace(robot.brain, body="joints", differential=None, joints=Joints((motor,))),
    )


@dataclass(slots=True)
class Hand:
    """The keys as what they ask of one motor. Plain data."""

    motor: str
    speed: float
    """rad/s"""
    held: Held = field(default_factory=Held)
    leaving: bool = False
    wanted: float = 0.0
    """rad/s, now"""
    _asked: float | None = None
    """The velocity that was last asked for; None: none since it was disarmed."""
    _rest: bytes = b""

    def ask(self, now: Nanos, typed: bytes | None, blocked: bool) -> list[Instruction]:
        """What is asked now; `typed`: what has come from the keys, None if there are none any more.

        `blocked`: the joint will not move, since it is in fault, stopped, or not heard."""
        if typed is None:
            self.leaving, typed = True, b""
        keys, self._rest = parse(self._rest + typed)
        asked = [word for key in keys if (word := self._press(now, key)) is not None]
        if blocked or self.leaving:
            self.held = Held()
        self.wanted = share(self.held, now) * self.speed
        if blocked:
            self._asked = None
        elif self.wanted != self._asked and (self.wanted or self._asked is not None):
            self._asked = self.wanted
            asked.append(Velocity(self.motor, self.wanted))
        return asked

    def _press(self, now: Nanos, key: Key) -> Instruction | None:
        match key:
            case Key.FORWARD | Key.BACKWARD:
                self.held = press(self.held, now, key.value)
            case Key.DISARM:
                self.held, self._asked = Held(), None
                return Idle(self.motor)
            case Key.CLEAR:
                return ClearFault(self.motor)
            case Key.LEAVE:
                self.leaving = True
        return None


def drive(made: Session, motor: str, typed: Callable[[], bytes | None], show: Callable[[str], None]) -> None:
    """The loop: keys in, a line out, until somebody leaves. The safe word goes out before it returns."""
    joint = made.gateway.joints[motor]
    hand = Hand(motor, joint.settings.limits.velocity)

    def ask() -> Sequence[Instruction]:
        now = made.clock.now()
        blocked = bool(joint.faults or made.gateway.why_stopped()) or joint.feedback_lost(now)
        return hand.ask(now, typed(), blocked)

    shown: Nanos | None = None
    with closing(made.run(poll=ask)) as ticks:
        for tick in ticks:
            if shown is None or tick.now >= shown + REFRESH:
                shown = tick.now
                show(status(joint, hand.wanted, tick.now))
            if hand.leaving:
                break
    show(status(joint, 0.0, made.clock.now()))


def status(joint: Joint, wanted: float, now: Nanos) -> str:
    """What the motor is asked and what comes back, in one line."""
    arrow = "→" if wanted > 0.0 else "←" if wanted < 0.0 else "·"
    reported = [
        f"{value:.{digits}f} {unit}"
        for name, unit, digits in QUANTITIES
        if (value := getattr(joint.feedback, name)) is not None
    ]
    received = joint.feedback_age(now)
    parts = [
        f"{joint.name} {arrow} {abs(wanted):.2f} rad/s",
        *(f"FAULT {fault(one)}" for one in joint.faults.values()),
        str(joint.mode) if received is not None else "never heard",
        *reported,
        age(None if received is None else now - received, now),
        joint.detail,
    ]
    return " | ".join(part for part in parts if part)


def help_text(robot: Robot, motor: str) -> str:
    """What the keys do."""
    part = robot.motors[motor]
    bus = robot.buses[part.bus]
    return (
        f"{motor} on {bus.name} ({bus.interface}): hold → or + to turn forward, ← or - backward, at most "
        f"{part.joint.limits.velocity:g} rad/s; space disarms, c clears faults, q leaves"
    )


@contextmanager
def above(line: Line) -> Iterator[None]:
    """While inside, what is logged stands above the line that is drawn over."""
    handler = _Above(line)
    log.addHandler(handler)
    before, log.propagate = log.propagate, False
    try:
        yield
    finally:
        log.propagate = before
        log.removeHandler(handler)


class _Above(logging.Handler):
    def __init__(self, line: Line) -> None:
        super().__init__()
        self._line = line

    def emit(self, record: logging.LogRecord) -> None:
        self._line.above(f"{record.levelname}: {record.getMessage()}")
