"""What is to hold of a run, as a person writes it: "tells silent", "raises", "final x < 0.5".

Rules. A condition is asked of inputs: they are run by the code of today, from a new gateway on.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from brain.belief import Belief, BrainState
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import UserError
from gateway.replay.input_log import InputLog, run
from gateway.report.watcher import Watcher

EXAMPLES = '"tells silent", "raises", "raises ZeroDivisionError", "final x < 0.5"'
_FIGURE = re.compile(r"(?P<name>\S.*?)\s*(?P<than>[<>])\s*(?P<value>[-+]?\d[\d.]*(?:[eE][-+]?\d+)?)")


class Condition(Protocol):
    """Something that holds of a run, or not."""

    @property
    def text(self) -> str:
        """As a person wrote it"""

    def first(self, log: InputLog) -> int | None:
        """Return the place of the first tick with which it holds; None if it does not."""
        ...

    def why_not(self, log: InputLog) -> list[str]:
        """Return, of a run for which it does not hold, what a person would want to know."""
        ...


def condition(text: str) -> Condition:
    """Return the condition that a text means. Raises UserError if it means none."""
    word, _, rest = text.strip().partition(" ")
    if word == "tells" and rest.strip():
        return Tells(text, rest.strip().lower())
    if word == "raises":
        return Raises(text, rest.strip().lower())
    if found := _FIGURE.fullmatch(text.strip()):
        return Compares(text, found["name"], found["than"], float(found["value"]))
    raise UserError(f"{text!r} is no condition; expected one such as {EXAMPLES}")


def told(tick: Tick, belief: Belief) -> Iterator[str]:
    """Yield what a tick tells a person: warnings and errors, and why the brain does not go on."""
    for note in tick.outputs.notes:
        if note.level != "info":
            yield f"{note.source}: {note.text}"
    if belief.state in (BrainState.DEGRADED, BrainState.STOPPED):
        yield f"brain: {belief.reason}"


@dataclass(frozen=True, slots=True)
class Tells:
    """A warning, an error or the reason of the brain's state holds some words."""

    text: str
    words: str

    def first(self, log: InputLog) -> int | None:
        """Return when it is told first."""
        try:
            for tick, belief in run(log):
                if any(self.words in line.lower() for line in told(tick, belief)):
                    return tick.number
        except Exception:  # noqa: BLE001 -- then it is another defect that is there
            return None
        return None

    def why_not(self, log: InputLog) -> list[str]:
        """Return what is told instead."""
        try:
            lines = dict.fromkeys(line for tick, belief in run(log) for line in told(tick, belief))
        except Exception as error:  # noqa: BLE001 -- as above
            return [f"raised: {type(error).__name__}: {error}"]
        return [f"told: {line}" for line in lines] or ["nothing is told but information"]


@dataclass(frozen=True, slots=True)
class Raises:
    """A step ends with an exception."""

    text: str
    words: str

    def first(self, log: InputLog) -> int | None:
        """Return in which step."""
        place = -1
        try:
            for tick, _ in run(log):
                place = tick.number
        except Exception as error:  # noqa: BLE001 -- whatever it is, it is what is looked for
            shown = f"{type(error).__name__}: {error}".lower()
            return place + 1 if self.words in shown else None
        return None

    def why_not(self, log: InputLog) -> list[str]:
        """Return what is raised instead, or that nothing is."""
        try:
            for _ in run(log):
                pass
        except Exception as error:  # noqa: BLE001 -- as above
            return [f"raised: {type(error).__name__}: {error}"]
        return ["every step ends as it should"]


@dataclass(frozen=True, slots=True)
class Compares:
    """A figure of the whole run (those of `gateway judge`) is below or above a value."""

    text: str
    name: str
    than: str
    value: float

    def first(self, log: InputLog) -> int | None:
        """Return the last tick, if it holds at the end."""
        try:
            figures = self._figures(log)
        except Exception:  # noqa: BLE001 -- as above
            return None
        if self.name not in figures:
            return None
        found = figures[self.name]
        holds = found < self.value if self.than == "<" else found > self.value
        return len(log.ticks) - 1 if holds else None

    def why_not(self, log: InputLog) -> list[str]:
        """Return what the figures are."""
        try:
            figures = self._figures(log)
        except Exception as error:  # noqa: BLE001 -- as above
            return [f"raised: {type(error).__name__}: {error}"]
        shown = [self.name] if self.name in figures else list(figures)
        return [f"{name}: {figures[name]:.6g}" for name in shown]

    def _figures(self, log: InputLog) -> dict[str, float]:
        made: list[Watcher] = []

        def watch(gateway: Gateway) -> None:
            made.append(Watcher(gateway))

        for tick, belief in run(log, watch):
            made[0].take(tick, belief)
        return {name: figure.value for name, figure in made[0].figures().items()} if log.ticks else {}
