"""`gateway jog`: turn one motor slowly, as long as a key is held, and show its feedback.

Rules. The motor goes through the gateway, its joint and the live loop like any other; the robot has this one
motor only, so that no other is commanded. Its speed is a limit of its joint. Only read-only frames are sent
before the first key. A key counts only if it is known to be new: the terminal is asked again and again, and a
key that follows its answer is no older than that question. Nothing moves again by itself: after a fault the
key must be pressed anew. However it ends (q, a signal, an exception, a closed terminal), the stop command is
sent first, and then the terminal is restored.
"""

from __future__ import annotations

import logging
import os
import sys
from argparse import ArgumentParser, Namespace
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field

from gateway.cli import arguments
from gateway.cli.terminal.keys import HeldKey, Key, ask, parse, press, raw_mode, read_keys, speed_share
from gateway.cli.terminal.screen import TerminalLine
from gateway.config import load_robot, with_interfaces
from gateway.config.errors import unknown
from gateway.config.robot_file import with_motor_alone
from gateway.core.joint import Joint
from gateway.core.robot import Robot
from gateway.errors import UserError
from gateway.monitor.render import age_text, fault_text, feedback_texts
from gateway.operator.commands import FRESH
from gateway.runtime.realtime import realtime, wanted_of
from gateway.runtime.session import Session, open_session
from protocols.messages import MILLISECOND, ClearFault, Idle, Instruction, Nanos, Velocity

log = logging.getLogger("gateway")

DEFAULT_SHARE = 0.05
"""Speed as a share of the joint's velocity limit, if none is given."""
SLOW = (
    "the link to this terminal is slow, or it does not answer: a key came %d ms after what it has answered, "
    "and counts up to %d ms. Nothing turns: work nearer to the robot, or at its own console"
)
REFRESH_PERIOD: Nanos = 100 * MILLISECOND
ASK_PERIOD: Nanos = 50 * MILLISECOND
"""Between two questions to the terminal, at least."""
MAX_ASKED = FRESH // ASK_PERIOD + 1
"""Questions that are not answered yet, at most: more would not make a key new."""
MULTIPLEXERS = {"TMUX": "tmux", "STY": "screen"}
"""Programs that answer in place of the person's terminal, by the variables that they set."""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("motor", metavar="MOTOR", help="its name in the robot file")
    parser.add_argument(
        "robot",
        nargs="?",
        default="bench",
        metavar="ROBOT",
        help="a robot file or its name (default: bench, simulated)",
    )
    arguments.add_bus(parser, "where the motor's bus is: can0=socketcan:can0")
    parser.add_argument(
        "--speed",
        type=arguments.number("rad/s"),
        metavar="RAD_PER_S",
        help="rad/s (default: 5 %% of the joint's velocity limit)",
    )
    arguments.add_realtime(parser)


def run(options: Namespace) -> int:
    """Return 1 if the motor is left in fault or armed."""
    wanted = wanted_of(options.realtime)
    robot = with_interfaces(load_robot(options.robot), dict(options.bus))
    robot = single_motor(robot, options.motor, options.speed)
    if not sys.stdin.isatty():
        raise UserError("the motor turns as long as a key is held: standard input must be a terminal")
    if within := [name for variable, name in MULTIPLEXERS.items() if os.environ.get(variable)]:
        raise UserError(
            f"the motor turns as long as a key is held, and within {within[0]} it is not known how late your "
            f"keys come: run it outside {within[0]}, or use the cockpit's page"
        )
    terminal = sys.stdin.fileno()
    with open_session(robot) as session:
        line = TerminalLine(sys.stdout)
        line.print_above(help_text(robot, options.motor))
        with raw_mode(terminal), log_above(line), realtime(wanted, robot, line.print_above):
            drive(session, options.motor, lambda: read_keys(terminal), line.draw, lambda: ask(terminal))
        line.end()
    return 1 if session.joints[options.motor].faults or session.gateway.still_armed() else 0


def single_motor(robot: Robot, motor: str, speed: float | None = None) -> Robot:
    """Return the robot reduced to one motor, whose velocity limit is `speed` [rad/s].

    Raises UserError for an unknown motor, one that takes no velocity, and a speed above its limit."""
    if motor not in robot.motors:
        raise UserError(unknown("motor", motor, robot.motors))
    settings = robot.motors[motor]
    if Velocity not in settings.joint.commands(settings.spec):
        raise UserError(f"{motor} takes no velocity ({settings.plugin.name}): it cannot be jogged")
    limits = settings.joint.limits
    speed = DEFAULT_SHARE * limits.velocity if speed is None else speed
    if speed > limits.velocity:
        raise UserError(f"--speed {speed:g}: the limit of {motor} is {limits.velocity:g} rad/s")
    return with_motor_alone(robot, motor, speed)


@dataclass(slots=True)
class JogControl:
    """Keys turned into instructions for one motor. Plain data."""

    motor: str
    speed: float
    """rad/s"""
    held: HeldKey = field(default_factory=HeldKey)
    leaving: bool = False
    velocity: float = 0.0
    """rad/s, wanted now"""
    _commanded: float | None = None
    """The last velocity that was commanded; None: none since the motor was disarmed."""
    _rest: bytes = b""
    asked: deque[Nanos] = field(default_factory=deque)
    """When the terminal was asked for the answers that have not come yet."""
    _known: Nanos | None = None
    """When it was asked for the newest answer that has come: a key that comes now was pressed later."""
    _late: bool = False
    """Whether the last key came too late to count."""

    def on_input(self, now: Nanos, data: bytes | None, blocked: bool) -> list[Instruction]:
        """Return the instructions of this step; `data` comes from the terminal, None if that is closed.

        `blocked`: the joint cannot move, since it is in fault, stopped, or without feedback."""
        if data is None:
            self.leaving, data = True, b""
        keys, self._rest = parse(self._rest + data)
        instructions = [message for key in keys if (message := self._press(now, key)) is not None]
        if blocked or self.leaving:
            self.held = HeldKey()
        self.velocity = speed_share(self.held, now) * self.speed
        if blocked:
            self._commanded = None
        elif self.velocity != self._commanded and (self.velocity or self._commanded is not None):
            self._commanded = self.velocity
            instructions.append(Velocity(self.motor, self.velocity))
        return instructions

    def asks(self, now: Nanos) -> bool:
        """Return whether the terminal is to be asked now."""
        return not self.asked or (len(self.asked) < MAX_ASKED and now - self.asked[-1] >= ASK_PERIOD)

    def _press(self, now: Nanos, key: Key) -> Instruction | None:
        match key:
            case Key.FORWARD | Key.BACKWARD:
                self.held = HeldKey() if self._too_late(now) else press(self.held, now, key.value)
            case Key.ANSWER if self.asked:
                self._known = self.asked.popleft()
            case Key.DISARM:
                self.held, self._commanded = HeldKey(), None
                return Idle(self.motor)
            case Key.CLEAR:
                return ClearFault(self.motor)
            case Key.LEAVE:
                self.leaving = True
        return None

    def _too_late(self, now: Nanos) -> bool:
        """Return whether a key that comes now may have been pressed long ago; log that once."""
        age = now - (self._known or 0)
        was, self._late = self._late, self._known is None or age > FRESH
        if self._late and not was:
            log.warning(SLOW, age // MILLISECOND, FRESH // MILLISECOND)
        return self._late


def drive(
    session: Session,
    motor: str,
    read: Callable[[], bytes | None],
    show: Callable[[str], None],
    ask: Callable[[], bool],
) -> None:
    """Run the session on what `read` returns, until it is to be left; the stop command is sent at the end.
    `ask` asks the terminal for an answer, which comes among the keys, unless it returns False."""
    joint = session.joints[motor]
    control = JogControl(motor, joint.settings.limits.velocity)

    def poll() -> Sequence[Instruction]:
        now = session.clock.now()
        if control.asks(now) and ask():
            control.asked.append(now)
        blocked = bool(joint.faults or session.gateway.why_stopped()) or joint.feedback_lost(now)
        return control.on_input(now, read(), blocked)

    next_line: Nanos = session.clock.now()
    with closing(session.run(poll=poll)) as ticks:
        for tick in ticks:
            if tick.now >= next_line:
                next_line = tick.now + REFRESH_PERIOD
                show(status_line(joint, control.velocity, tick.now))
            if control.leaving:
                break
    show(status_line(joint, 0.0, session.clock.now()))


def status_line(joint: Joint, velocity: float, now: Nanos) -> str:
    """Return the commanded velocity [rad/s], mode, faults and feedback of the motor."""
    arrow = "→" if velocity > 0.0 else "←" if velocity < 0.0 else "·"
    age = joint.feedback_age(now)
    fields = [
        f"{joint.name} {arrow} {abs(velocity):.2f} rad/s",
        *(f"FAULT {fault_text(fault)}" for fault in joint.faults.values()),
        str(joint.mode) if age is not None else "no feedback yet",
        *feedback_texts(joint.feedback).values(),
        age_text(None if age is None else now - age, now),
        joint.detail,
    ]
    return " | ".join(text for text in fields if text)


def help_text(robot: Robot, motor: str) -> str:
    """Return what the keys do."""
    settings = robot.motors[motor]
    bus = robot.buses[settings.bus]
    return (
        f"{motor} on {bus.name} ({bus.interface}): hold → or + to turn forward, ← or - backward, at most "
        f"{settings.joint.limits.velocity:g} rad/s; space disarms, c clears faults, q leaves"
    )


@contextmanager
def log_above(line: TerminalLine) -> Iterator[None]:
    """While inside, print log records above the line that is redrawn."""
    handler = _LineHandler(line)
    log.addHandler(handler)
    before, log.propagate = log.propagate, False
    try:
        yield
    finally:
        log.propagate = before
        log.removeHandler(handler)


class _LineHandler(logging.Handler):
    def __init__(self, line: TerminalLine) -> None:
        super().__init__()
        self._line = line

    def emit(self, record: logging.LogRecord) -> None:
        self._line.print_above(f"{record.levelname}: {record.getMessage()}")
