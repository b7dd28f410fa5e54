"""Which commands of the brain a joint takes: what it can do, in finite numbers; the last that it took counts,
until it is too old."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from typing import Any

from protocols import messages as msg
from protocols.messages import Command, Nanos


class Acceptance:
    """The brain's commands to one joint. State is plain data."""

    def __init__(self, motor: str, supported: frozenset[type[Command]]) -> None:
        self._motor, self.supported = motor, supported
        self._command: Command | None = None
        """The brain's last accepted command."""
        self._at: Nanos = 0
        self.refused = ""
        """Why the brain's last command was refused, or not carried out; "" if it was accepted."""
        self._noted = ""
        """The refusal that was last noted: a command is repeated at every step."""

    def offer(self, now: Nanos, new: Command) -> None:
        """Accept a command, or refuse it."""
        # One that was accepted before is as good now: a command never changes.
        self.refused = "" if new is self._command else self._objection(new)
        if not self.refused:
            self._command, self._at = new, now

    def refuse(self, why: str) -> None:
        """Note why the accepted command is not carried out now."""
        self.refused = why

    def newest(self, now: Nanos, timeout: Nanos) -> Command | None:
        """Return the last command that was accepted, if it is no older than that."""
        return None if self._command is None or now - self._at > timeout else self._command

    def forget(self) -> None:
        """Forget what was commanded."""
        self._command = None

    def take_refused(self) -> str:
        """Return why the brain's command is refused, if that is news; else ""."""
        refused, before = self.refused, self._noted
        self._noted, self.refused = refused, ""
        return refused if refused != before else ""

    def _objection(self, new: Command) -> str:
        if type(new) not in self.supported:
            able = ", ".join(sorted(c.__name__ for c in self.supported))
            return f"{type(new).__name__} is not among what {self._motor} can do: {able}"
        if not _finite(new):
            return f"a value of {new} is not finite"
        if isinstance(new, msg.Impedance) and (new.stiffness < 0.0 or new.damping < 0.0):
            return f"stiffness and damping of {new} must not be negative"
        return ""


def _finite(command: Command) -> bool:
    """True if every number in a command is finite."""
    kind = type(command)
    if kind is msg.Idle:
        return True
    # Infinities and NaN less themselves are NaN. (A generator would take twice as long.)
    return all([value - value == 0.0 for value in _NUMBERS[kind](command)])  # noqa: C419


_NUMBERS: dict[type[Command], Callable[[Any], tuple[float, ...]]] = {
    kind: attrgetter(*(field.name for field in fields(kind) if field.name != "motor"))
    for kind in (msg.Position, msg.Velocity, msg.Impedance)
}
_NUMBERS[msg.Torque] = _NUMBERS[msg.Hold] = lambda torque: (torque.torque,)
