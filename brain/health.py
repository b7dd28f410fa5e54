"""Whether the brain may trust what it hears: the ladder from full speed to standing still, and back.

Rules. Every source (a motor's feedback, a sensor) is judged by the age of its newest measurement, as a share
of that source's own timeout (the robot file's, which is the one place where a timeout stands), and by the
share of its measurements that perception has rejected. Worse is believed at once, better only after it
has lasted for `recover`. What stays bad for `give_up` is gone: the tasks are dropped, and when it comes back
the brain is ready, but does not go on by itself. A motor in fault is gone at once. At the start one that
initialises is missing, whatever it already measures; later some do so for a moment whenever they are armed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from math import isfinite

from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Fix, Imu, LaserScan, Mode, Nanos, State


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """When the brain goes slow, when it stands still, and when it goes on."""

    slow_age: float = 0.5
    """Share of a source's timeout: with a newest measurement older than this it goes slow,"""
    stand_age: float = 0.9
    """and older than this it stands: a little before the joint itself goes blind, at 1.0."""
    give_up: Nanos = 5 * SECOND
    """Standing still for so long, the tasks are dropped."""
    recover: Nanos = 300 * MILLISECOND
    """All must have been well for so long before it goes at full speed again."""
    slow: float = 0.3
    """Share of the largest speeds while slow."""
    window: Nanos = SECOND
    """Over which rejected measurements are counted."""
    rejected_slow: float = 0.3
    """Share of a source's measurements rejected, from which on it goes slow,"""
    rejected_stop: float = 0.8
    """and from which on it stands."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{field.name} must be more than 0, not {value}")
        for name in ("slow_age", "stand_age", "slow", "rejected_slow", "rejected_stop"):
            if getattr(self, name) > 1.0:
                raise ValueError(f"{name} is a share: at most 1, not {getattr(self, name)}")
        for less, more in (("slow_age", "stand_age"), ("rejected_slow", "rejected_stop")):
            if getattr(self, more) < getattr(self, less):
                raise ValueError(f"{more} must not be less than {less}")


class Level(IntEnum):
    """How bad it is."""

    WELL = 0
    SLOW = 1
    STAND = 2
    GONE = 3


@dataclass(frozen=True, slots=True)
class Verdict:
    """How bad it is, and what is."""

    level: Level
    reason: str = ""


WELL = Verdict(Level.WELL)
_WORDS = {Feedback: "feedback", Imu: "reading", LaserScan: "scan", Fix: "fix"}


class Health:
    """Judges the sources that the body needs, each by its timeout. State is plain data."""

    def __init__(
        self,
        motors: Sequence[str],
        sensors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        settings: HealthSettings,
    ) -> None:
        self.settings = settings
        self._timeouts = {name: timeouts[name] for name in (*motors, *sensors)}
        self._motors, self._sensors = tuple(motors), tuple(sensors)
        self._last: dict[str, Nanos] = {}
        self._word: dict[str, str] = {}
        """What a source says, in a word."""
        self._received: dict[str, int] = {}
        self._faults: dict[str, str] = {}
        self._initialising: dict[str, str] = {}
        """The motors that cannot be commanded yet, and what they say of it."""
        self._bad: Verdict = WELL
        self._bad_at: Nanos | None = None
        self._standing_since: Nanos | None = None
        self._window_end: Nanos | None = None
        self._before: dict[str, tuple[int, int]] = {}
        self._shares: dict[str, float] = {}

    def observe(self, events: Sequence[Event]) -> None:
        """Note who said something, and when it was measured."""
        for event in events:
            if isinstance(event, State):
                self._on_state(event)
            elif isinstance(event, Feedback):
                if event.position is not None or event.velocity is not None:
                    self._note(event.motor, event)
            elif isinstance(event, Imu | LaserScan | Fix):
                self._note(event.sensor, event)

    def missing(self) -> str:
        """What has never been heard or is not ready to be commanded, in words; "" if all is well."""
        parts = [f"feedback of {name}" for name in self._motors if name not in self._last]
        parts += [
            f"{name} to initialise{said}" for name, said in self._initialising.items() if name in self._last
        ]
        parts += [f"a reading of {name}" for name in self._sensors if name not in self._last]
        return ", ".join(parts)

    def judge(self, now: Nanos, rejected: Mapping[str, int]) -> Verdict:
        """The worst of all sources, with memory: worse at once, better after a while."""
        self._count(now, rejected)
        worst = max((self.source(now, name) for name in self._last), key=lambda v: v.level, default=WELL)
        if worst.level >= Level.STAND:
            if self._standing_since is None:
                self._standing_since = now
            if now - self._standing_since >= self.settings.give_up:
                worst = Verdict(Level.GONE, worst.reason)
        else:
            self._standing_since = None
        if worst.level > Level.WELL:
            self._bad, self._bad_at = worst, now
        elif self._bad_at is not None:
            if now - self._bad_at < self.settings.recover:
                return Verdict(Level.SLOW, f"just recovered: {self._bad.reason}")
            self._bad_at = None
        return worst

    def source(self, now: Nanos, name: str) -> Verdict:
        """How one source is, without memory."""
        if name in self._faults:
            return Verdict(Level.GONE, f"{name} is in fault{self._faults[name]}")
        if name not in self._last:
            return Verdict(Level.STAND, f"{name} was never heard")
        if name not in self._timeouts:
            return WELL
        age, timeout = now - self._last[name], self._timeouts[name]
        for level, share in ((Level.STAND, self.settings.stand_age), (Level.SLOW, self.settings.slow_age)):
            limit = round(share * timeout)
            if age > limit:
                said = f"{name}: no {self._word[name]} for more than {limit / MILLISECOND:g} ms"
                return Verdict(level, said)
        share = self._shares.get(name, 0.0)
        if share >= self.settings.rejected_slow:
            said = f"{name}: {100 * share:.0f} % of its measurements do not fit what is believed"
            return Verdict(Level.STAND if share >= self.settings.rejected_stop else Level.SLOW, said)
        return WELL

    def _on_state(self, event: State) -> None:
        if event.motor not in self._motors:
            return
        for mode, of_mode in ((Mode.FAULT, self._faults), (Mode.INITIALISING, self._initialising)):
            if event.mode is mode:
                of_mode[event.motor] = f": {event.detail}" if event.detail else ""
            else:
                of_mode.pop(event.motor, None)

    def _note(self, name: str, event: Feedback | Imu | LaserScan | Fix) -> None:
        self._last[name] = max(event.t, self._last.get(name, event.t))
        self._word[name] = _WORDS[type(event)]
        self._received[name] = self._received.get(name, 0) + 1

    def _count(self, now: Nanos, rejected: Mapping[str, int]) -> None:
        """At the end of each window: which share of each source was rejected in it."""
        if self._window_end is not None and now < self._window_end:
            return
        self._window_end = now + self.settings.window
        for name, received in self._received.items():
            was_received, was_rejected = self._before.get(name, (0, 0))
            refused = rejected.get(name, 0)
            self._before[name] = (received, refused)
            new = received - was_received
            self._shares[name] = (refused - was_rejected) / new if new >= FEWEST else 0.0


FEWEST = 5
"""Measurements in a window, below which no share is formed."""
