"""What the view's clients ask of a robot: lines of an operator's language → instructions of the next tick.

Rules. A client that may not steer may only stop. What is held (a key, a stick, a jog) ends when its client
does not repeat it for `HELD`, or is gone. A client has so many requests a second, but stop is always heard.
Nothing here raises, whatever a client sends.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from gateway.core.robot import Robot
from gateway.operator.commands import Query, RejectedLine, help_text, parse
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Instruction, Nanos

HELD: Nanos = 200 * MILLISECOND
"""How long something counts as held after the last message that says so."""
PER_SECOND = 20
"""Requests of one client,"""
AT_ONCE = 40
"""and at once."""
MAX_LINE = 1000
"""Characters of a line."""
READ_ONLY = "this view is read-only: start it with --steer"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a line."""

    ok: bool
    text: str


@dataclass(slots=True, eq=False)
class Asking:
    """One client, as one who asks."""

    tokens: float = AT_ONCE
    at: Nanos = 0
    """When `tokens` was brought up to date."""
    held: Instruction | None = None
    held_until: Nanos = 0


@dataclass(slots=True)
class Requests:
    """All that ask."""

    robot: Robot
    steer: bool
    """Whether they may do more than stop."""
    asking: list[Asking] = field(default_factory=list)

    def enter(self) -> Asking:
        """Return a new client."""
        self.asking.append(Asking())
        return self.asking[-1]

    def leave(self, one: Asking) -> Instruction | None:
        """Forget a client; return what ends what it held."""
        self.asking.remove(one)
        return _end_of(one)

    def line(self, now: Nanos, one: Asking, line: str) -> tuple[Instruction | None, Answer]:
        """Return what a line asks of the robot, and the answer; None if that is nothing."""
        asked = self._parsed(line)
        if isinstance(asked, Answer):
            return None, asked
        if isinstance(asked, msg.Stop):
            one.held = None  # it ends with the rest
            return asked, Answer(ok=True, text="stopped")
        if refused := self._refused(now, one):
            return None, Answer(ok=False, text=refused)
        return asked, Answer(ok=True, text=f"accepted: {line}")

    def hold(self, now: Nanos, one: Asking, line: str) -> tuple[Instruction | None, Answer]:
        """Do what a line asks for as long as it is held; "" ends it. Only Drive and Velocity can be held."""
        if not line.strip():
            return _end_of(one), Answer(ok=True, text="")
        asked = self._parsed(line)
        if isinstance(asked, Answer):
            return None, asked
        if not isinstance(asked, msg.Drive | msg.Velocity):
            return None, Answer(ok=False, text=f"{line!r} is nothing that can be held")
        if not self.steer:
            return None, Answer(ok=False, text=READ_ONLY)
        one.held, one.held_until = asked, now + HELD
        return asked, Answer(ok=True, text="")

    def expired(self, now: Nanos) -> list[Instruction]:
        """Return what ends that which is not held any more."""
        return [end for one in self.asking if now > one.held_until and (end := _end_of(one)) is not None]

    def _parsed(self, line: str) -> Instruction | Answer:
        if len(line) > MAX_LINE:
            return Answer(ok=False, text=f"the line is longer than {MAX_LINE} characters")
        line = line.encode(errors="replace").decode()  # half a character, as JSON can write, is no text
        words = line.split()
        if words[:1] == ["mission"] and any(mark in line for mark in "/\\"):
            return Answer(
                ok=False, text="name a mission that ships: files are for the gateway's own terminal"
            )
        match parse(line, self.robot):
            case None:
                return Answer(ok=False, text="nothing was asked")
            case RejectedLine(reason):
                return Answer(ok=False, text=reason)
            case Query("help"):
                return Answer(ok=True, text=help_text())
            case Query(kind):
                return Answer(ok=False, text=f"{kind} is for the gateway's own terminal, and `gateway ask`")
            case instruction:
                return instruction

    def _refused(self, now: Nanos, one: Asking) -> str:
        """Return why a client may not ask now; "" if it may."""
        if not self.steer:
            return READ_ONLY
        one.tokens = min(AT_ONCE, one.tokens + (now - one.at) / SECOND * PER_SECOND)
        one.at = now
        if one.tokens < 1.0:
            return f"too many requests: {PER_SECOND} a second are heard"
        one.tokens -= 1.0
        return ""


def _end_of(one: Asking) -> Instruction | None:
    """Return what ends what a client held, once."""
    held, one.held = one.held, None
    if isinstance(held, msg.Velocity):
        return replace(held, velocity=0.0)
    return None if held is None else msg.Drive(0.0, 0.0)
