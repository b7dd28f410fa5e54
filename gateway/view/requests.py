"""What the view's clients ask of a robot: lines of an operator's language → instructions of the next tick.

Rules. A client that may not steer may only stop. What is held (a key, a stick, a jog) ends when its client
does not repeat it for `HELD`, holds something else, or is gone; and with a stop, from wherever, or when its
link is slow: then it must be let go before it is held again. A link may bring what was held when it has long
been let go; so each message has the newest time of ours that its client had (`heard`), after which it was
sent: older than `FRESH`, or without one, it counts for nothing. So does whatever was asked before its client
could know of the newest stop: a release or a goal that is still under way must not undo it. A client has so
many requests a second and in one poll, but a stop is always read. Nothing here raises, whatever a client
sends.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

from gateway.core.robot import Robot
from gateway.operator import commands
from gateway.operator.commands import Query, RejectedLine, command_of, help_text, parse
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos

HELD: Nanos = 200 * MILLISECOND
"""How long something counts as held after the last message about it."""
PER_SECOND = 20
"""Requests of one client in a second, in the long run."""
AT_ONCE = 40
"""Requests of one client at once."""
PER_POLL = 10
"""Requests of one client in one poll."""
HOLDS_PER_SECOND = 100
"""Messages of one client that something is held: more are a flood, and hold nothing."""
MAX_LINE = 1000
"""Characters of a line."""
READ_ONLY = "this view is read-only: start it with --steer"
NO_TIME = "nothing is held without a time of the gateway's, which its client has just received"
SLOW = (
    "the link is slow: {age} ms there and back, and what is held counts up to {most} ms. Let go; drive by "
    "cable or nearer to the robot, or give it a goal. STOP is obeyed, that much later"
)
OVERTAKEN = "somebody pressed STOP while this was under way: look why, and ask again"
NO_ROBOT = "no robot runs here: what is shown takes no requests, and cannot be stopped"

log = logging.getLogger("gateway")


@dataclass(frozen=True, slots=True)
class ViewAnswer:
    """The answer to a line."""

    ok: bool
    text: str


SILENT = ViewAnswer(ok=True, text="")
"""The answer to what needs none."""


@dataclass(slots=True)
class Budget:
    """How much of something may be asked: so much a second, and that of `span` seconds at once."""

    rate: float
    left: float
    debt: float = 0.0
    """How far it can be overdrawn: a flood stays refused until it calms down."""
    at: Nanos = 0
    """When `left` was brought up to date."""
    full: float = field(init=False)

    def __post_init__(self) -> None:
        self.full = self.left

    def take(self, now: Nanos, count: int = 1) -> bool:
        """Take so many, if there are any."""
        self.left = min(self.full, self.left + (now - self.at) / SECOND * self.rate)
        self.at = now
        granted = self.left >= count
        if granted or self.debt:
            self.left = max(-self.debt, self.left - count)
        return granted


@dataclass(slots=True, eq=False)
class Asking:
    """One client, as one who asks."""

    requests: Budget = field(default_factory=lambda: Budget(PER_SECOND, AT_ONCE))
    holds: Budget = field(
        default_factory=lambda: Budget(HOLDS_PER_SECOND, HOLDS_PER_SECOND, debt=HOLDS_PER_SECOND)
    )
    polled: Nanos = -1
    """The last poll in which it asked."""
    asked: int = 0
    """How often it asked in that poll."""
    stopped: Nanos = -1
    """The last poll in which it asked for a stop: once is enough."""
    held: Instruction | None = None
    held_until: Nanos = 0
    """Without another message; or, if it is barred, until when that lasts."""
    barred: bool = False
    """Whether what it holds counts for nothing until it lets go."""
    slow: bool = False
    """Whether its link is, as its log has it."""


@dataclass(slots=True)
class Requests:
    """All that ask."""

    robot: Robot
    steer: bool
    """Whether they may do more than stop."""
    live: bool = True
    """Whether there is a robot to ask."""
    asking: list[Asking] = field(default_factory=list)
    _stopped: str = ""
    """Why the robot is stopped; "": it is not."""
    _pressed: Nanos = 0
    """When somebody asked for a stop last, wherever."""
    _polled: Nanos = 0
    """When it was polled last."""

    def enter(self) -> Asking:
        """Return a new client."""
        self.asking.append(Asking())
        return self.asking[-1]

    def leave(self, one: Asking) -> list[Instruction]:
        """Forget a client; return what ends what it held."""
        self.asking.remove(one)
        return _end_of(one)

    def line(
        self, now: Nanos, one: Asking, line: str, heard: Nanos | None
    ) -> tuple[Instruction | None, ViewAnswer]:
        """Return what a line asks of the robot, and the answer; None if that is nothing.

        `heard`: as in `hold`."""
        word = command_of(line[:MAX_LINE])
        if word == "stop" and self.live:
            return self._stop(now, one, line)
        if refused := self.refused(now, one, reads=word == "help"):
            return None, ViewAnswer(ok=False, text=refused)
        asked = self._parsed(line)
        if isinstance(asked, ViewAnswer):
            return None, asked
        if (heard or 0) < self._pressed:
            return None, ViewAnswer(ok=False, text=OVERTAKEN)
        return asked, ViewAnswer(ok=True, text=f"accepted: {line}")

    def hold(
        self, now: Nanos, one: Asking, line: str, heard: Nanos | None, count: int = 1
    ) -> tuple[list[Instruction], ViewAnswer]:
        """Do what a line asks for as long as it is held; "" ends it. Only Drive, Velocity and Torque
        can be held.

        Args:
            now: the time of the poll.
            one: who asks.
            line: the newest of the messages of this poll.
            heard: the newest time of ours that its client had when it sent this; None: none.
            count: how many there were.
        """
        if not line.strip():
            one.barred = False
            return _end_of(one), SILENT
        if one.barred and now <= one.held_until:
            one.held_until = now + HELD
            return [], SILENT
        one.barred = False
        if not one.holds.take(now, count):
            one.barred, one.held_until = True, now + HELD
            return _end_of(one), ViewAnswer(ok=False, text="too many messages: what is held has ended")
        stopped = f"stopped: {self._stopped}" if self._stopped else ""
        if wrong := self._never() or stopped or _slow(now, one, heard):
            one.barred, one.held_until = True, now + HELD
            return _end_of(one), ViewAnswer(ok=False, text=wrong)
        if heard is None or heard > now:
            return _end_of(one), ViewAnswer(ok=False, text=NO_TIME)
        asked = self._parsed(line)
        if isinstance(asked, ViewAnswer):
            return _end_of(one), asked
        if not isinstance(asked, msg.Drive | msg.Velocity | msg.Torque):
            return _end_of(one), ViewAnswer(ok=False, text=f"{line!r} is nothing that can be held")
        ended = [] if _motor(one.held) == _motor(asked) else _end_of(one)
        one.held, one.held_until = asked, now + HELD
        return [*ended, asked], SILENT

    def refused(self, now: Nanos, one: Asking, *, reads: bool = False) -> str:
        """Return why a client may not ask now; "" if it may. `reads`: it only wants to know something."""
        if not reads and (wrong := self._never()):
            return wrong
        if one.polled != now:
            one.polled, one.asked = now, 0
        one.asked += 1
        if one.asked > PER_POLL or not one.requests.take(now):
            return f"too many requests: {PER_SECOND} a second are read, {PER_POLL} in a step"
        return ""

    def expired(self, now: Nanos) -> list[Instruction]:
        """Return what ends that which is not held any more. Called in every poll."""
        self._polled = now
        return [end for one in self.asking if now > one.held_until for end in _end_of(one)]

    def ends(self) -> list[Instruction]:
        """Return what ends all that is held."""
        return [end for one in self.asking for end in _end_of(one)]

    def on_stop(self, reason: str, *, pressed: bool = False) -> None:
        """Take why the robot must not move, "" if it may. With that ends what is held.

        `pressed`: somebody has just asked for it."""
        self._stopped = reason
        self._pressed = self._polled if pressed else self._pressed
        if reason:
            for one in self.asking:
                one.barred = one.barred or one.held is not None
                one.held = None

    def _never(self) -> str:
        """Return why no client may ask for anything but a stop; "" if they may."""
        return NO_ROBOT if not self.live else READ_ONLY if not self.steer else ""

    def _stop(self, now: Nanos, one: Asking, line: str) -> tuple[Instruction | None, ViewAnswer]:
        again, one.stopped, self._pressed = one.stopped == now, now, now
        asked = None if again else self._parsed(line[:MAX_LINE])
        return asked if isinstance(asked, msg.Stop) else None, ViewAnswer(ok=True, text="stopped")

    def _parsed(self, line: str) -> Instruction | ViewAnswer:
        if len(line) > MAX_LINE:
            return ViewAnswer(ok=False, text=f"the line is longer than {MAX_LINE} characters")
        line = line.encode(errors="replace").decode()  # half a character, as JSON can write, is no text
        match parse(line, self.robot, files=False):
            case None:
                return ViewAnswer(ok=False, text="nothing was asked")
            case RejectedLine(reason):
                return ViewAnswer(ok=False, text=reason)
            case Query("help"):
                return ViewAnswer(ok=True, text=help_text())
            case Query(kind):
                return ViewAnswer(
                    ok=False, text=f"{kind} is for the gateway's own terminal, and `gateway ask`"
                )
            case instruction:
                return instruction


def _slow(now: Nanos, one: Asking, heard: Nanos | None) -> str:
    """Return that the link is slow, which is logged once; "" if it is not, or nothing is known of it."""
    age = 0 if heard is None else now - heard
    was, one.slow = one.slow, age > commands.FRESH
    if not one.slow:
        return ""
    wrong = SLOW.format(age=age // MILLISECOND, most=commands.FRESH // MILLISECOND)
    if not was:
        log.warning("live view: %s", wrong)
    return wrong


def _motor(held: Instruction | None) -> str | None:
    """Return what is held: the name of a motor, "" for the base; None: nothing."""
    return held.motor if isinstance(held, msg.Velocity | msg.Torque) else None if held is None else ""


def _end_of(one: Asking) -> list[Instruction]:
    """Return what ends what a client held, once."""
    held, one.held = one.held, None
    if isinstance(held, msg.Velocity):
        return [replace(held, velocity=0.0)]
    if isinstance(held, msg.Torque):
        return [replace(held, torque=0.0)]
    return [] if held is None else [msg.Drive(0.0, 0.0)]
