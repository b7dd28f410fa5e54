"""When what is asked now and then was last asked, and is due again: the periods of questions, by name."""

from __future__ import annotations

from dataclasses import dataclass, field

from protocols.messages import Nanos
from protocols.toolkit.motor_driver import NEVER


@dataclass(slots=True)
class Questions:
    """The questions to one device. Plain data."""

    asked: dict[str, Nanos] = field(default_factory=dict)
    """When each was last asked."""

    later: dict[str, Nanos] = field(default_factory=dict)
    """When those are due that do not wait for their period."""

    def ask(self, now: Nanos, *names: str) -> None:
        """Record that these are asked."""
        for name in names:
            self.asked[name] = now
            self.later.pop(name, None)

    def forget(self, *names: str) -> None:
        """Forget that these were asked, or (without names) all: they are due."""
        for name in names or (*self.asked, *self.later):
            self.asked.pop(name, None)
            self.later.pop(name, None)

    def set_due(self, name: str, at: Nanos) -> None:
        """Make this one due then, whatever its period."""
        self.later[name] = at

    def due(self, name: str, period: Nanos) -> Nanos:
        """Return when one is due."""
        later = self.later.get(name)
        return self.asked.get(name, -NEVER) + period if later is None else later

    def take(self, now: Nanos, name: str, period: Nanos) -> bool:
        """True if one is due; then it counts as asked."""
        if now < self.due(name, period):
            return False
        self.ask(now, name)
        return True
