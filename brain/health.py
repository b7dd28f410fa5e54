"""Whether the brain may trust its sources: levels from full speed to standing still, and back.

Rules. Every source (a motor's feedback, a sensor) is assessed by the age of its newest measurement, as a
share of its own timeout (the robot file's, the only place where a timeout is set), and by the share of its
measurements that perception has rejected. A reading that shows nothing (an empty scan, a constant IMU) is no
measurement: slow at once, then its source ages, with that as the cause. Sources that contradict each other
(`brain.perception.motion_check`) make the base slow until that is confirmed, and then stand; an estimate that
perception holds for lost (`brain.perception.consistency`) makes it stand. A worse level takes effect at once,
a better one only after it has lasted for `recover`. What stays bad for `give_up`, a contradiction for
`contradicted`, is lost: the tasks are dropped, and when all is well again the brain is ready, but does not go
on by itself. So is a base that has been slow or standing for `too_long`, or `too_often` within
`often_within`. What can be driven with is slow for as long as it lasts, and drops nothing: a lidar mounted a
little otherwise than stated, an estimate too sure of itself, a sensor that is only helpful (a gyro, where
wheels and lidar suffice) and does not report, even from the start on. A motor in fault is lost at once, a
sensor in fault is as one that does not report. At the start a motor that initialises is missing, even if it
already measures; later some do so briefly whenever they are armed.

Declared: after these faults a base with wheels, gyro, and a lidar of at least 10 Hz with a timeout of 500 ms
begins to stand within this time, or way; a contradiction drops the tasks 1 s later.

    lidar: frozen; returns from fewer than 15 % of its rays   0.6 s
    lidar: 40° or more lose their returns at once (blind, or  0.8 s
        at their maximum)
    lidar: 10° or more frozen, seeing what is on the way      0.5 m driven; 0.6 rad turned, and 0.4 s
    lidar: what hangs within 0.6 m, 6° wide or more (before   0.4 m driven past it, or 0.8 rad turned, and
        that the base slows and stands, as before anything)     0.4 s
    lidar: turned by 5° or more, shifted by 0.5 m, ranges     0.4 s
        off by 0.5 m, most rays past what was there
    lidar: mounted otherwise from the start: 180°; 0.5 m      0.4 m driven; 0.4 rad turned
        by more than 10°                                      1 s straight on
    IMU: constant, where it is needed                         0.4 s
    IMU: bias jump of 0.3 rad/s; of 0.1 rad/s; that bias      1 s; 3 s; 5 s
        from the start
    IMU: reversed                                             0.3 rad turned
    wheels: swapped                                           0.3 rad turned
    wheels: one reversed, one at another scale                0.3 m driven or 0.3 rad turned
    wheels: both reversed, both turn and the base does not    0.3 m driven
    wheels: both encoders at half scale                       0.6 m driven
    wheels: a position jumps by more than the wheel can turn  at once
    wheels: one is armed, and another one is not              1 s

It names, and goes on slowly (at 0.3 to 0.6 m/s; ranges with a noise of 0.01 m; a lidar's yaw is corrected
after 1 m):

    lidar: mounted 5° otherwise than stated; 2°               1 s; 2 s straight on
    lidar: 0.1 m elsewhere                                    1 rad turned
    IMU: silent or constant, where a lidar matches            half of its timeout; 0.4 s

Not noticed, since nothing shows it: swapped wheels or a reversed gyro on a straight way; a lidar turned by
180° where the place looks the same; a sector of it that never had a return, or is frozen along a wall (open
ground, and the wall, look the same); one mounted wrong by less than 1.5° or 0.05 m; a bias below 0.08 rad/s,
a jump of it below 0.05 rad/s, and any slip below a third of the way, which the filter learns; without a
lidar, wheels that turn on the spot or are both at another scale, and a gyro's bias under way; without a gyro
and a lidar, all of these.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Annotated

from brain.perception.consistency import Trust, Verdict
from brain.perception.motion_check import Contradiction
from protocols.bounds import Bounds, Duration, check, ordered
from protocols.messages import (
    MILLISECOND,
    SECOND,
    Event,
    Feedback,
    Measurement,
    Mode,
    Nanos,
    State,
)

APART: Nanos = SECOND
"""Longest time that one wheel may be armed and another one not: a base with one driven wheel turns aside."""
MIN_WINDOW_COUNT = 5
"""Measurements in a window, below which no share of rejected ones is computed."""


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """When the brain slows down, stands still, and continues."""

    slow_age: Annotated[float, Bounds(0.01, 1.0)] = 0.5
    """Share of a source's timeout: slow when the newest measurement is older than this,"""
    stand_age: Annotated[float, Bounds(0.01, 1.0)] = 0.9
    """and standing when older than this: a little before the joint's own feedback timeout, at 1.0."""
    give_up: Annotated[Duration, Bounds(1.0, 60_000.0)] = 5 * SECOND
    """After standing still for this time the tasks are dropped."""
    contradicted: Annotated[Duration, Bounds(1.0, 60_000.0)] = 1 * SECOND
    """After a contradiction of the sources for this time the tasks are dropped."""
    too_long: Annotated[Duration, Bounds(100.0, 600_000.0)] = 10 * SECOND
    """After this time of being slow or standing without interruption the tasks are dropped,"""
    too_often: Annotated[int, Bounds(1, 100)] = 5
    """and when it has begun so many times"""
    often_within: Annotated[Duration, Bounds(100.0, 600_000.0)] = 20 * SECOND
    """within this time."""
    recover: Annotated[Duration, Bounds(1.0, 60_000.0)] = 300 * MILLISECOND
    """All sources must have been well for this time before full speed is allowed again."""
    slow: Annotated[float, Bounds(0.01, 1.0)] = 0.3
    """Share of the largest speeds while slow."""
    window: Annotated[Duration, Bounds(10.0, 60_000.0)] = SECOND
    """Time over which rejected measurements are counted."""
    start_without: Annotated[Duration, Bounds(0.0, 60_000.0)] = 3 * SECOND
    """A sensor that is only helpful is awaited for this time at the start."""
    rejected_slow: Annotated[float, Bounds(0.01, 1.0)] = 0.3
    """Share of a source's measurements rejected, from which on it is slow,"""
    rejected_stop: Annotated[float, Bounds(0.01, 1.0)] = 0.8
    """and from which on it stands."""

    def __post_init__(self) -> None:
        check(self)
        ordered(self, "slow_age", "stand_age")
        ordered(self, "rejected_slow", "rejected_stop")


class HealthLevel(IntEnum):
    """Severity, from full speed to giving up."""

    OK = 0
    SLOW = 1
    HALT = 2
    """Stand still, keeping the tasks."""
    LOST = 3
    """Stand still, and drop the tasks."""


@dataclass(frozen=True, slots=True)
class SourceHealth:
    """Severity, and its cause in words."""

    level: HealthLevel
    reason: str = ""


OK = SourceHealth(HealthLevel.OK)
CONSISTENT = Verdict()
NOTHING: Mapping[str, str] = MappingProxyType({})


class Health:
    """Assesses the sources that the body needs, each by its timeout. State is plain data."""

    def __init__(
        self,
        motors: Sequence[str],
        sensors: Sequence[str],
        timeouts: Mapping[str, Nanos],
        settings: HealthSettings,
        helpful: Sequence[str] = (),
    ) -> None:
        """`helpful`: the sensors without which the base drives slowly."""
        self.settings, self.helpful = settings, frozenset(helpful)
        self._timeouts = {name: timeouts[name] for name in (*motors, *sensors)}
        self._motors, self._sensors = tuple(motors), tuple(sensors)
        self._last: dict[str, Nanos] = {}
        """Time of the newest measurement, by source"""
        self._measurement: dict[str, str] = {}
        """What the newest measurement is called, by source"""
        self._absent: Mapping[str, str] = {}
        """Why the newest reading shows nothing, by sensor."""
        self._received: dict[str, int] = {}
        self._unsound: dict[str, str] = {}
        """The sensors in fault, with the detail of their state."""
        self._faults: dict[str, str] = {}
        """The motors in fault, with the detail of their state."""
        self._initialising: dict[str, str] = {}
        """The motors that cannot be commanded yet, with the detail of their state."""
        self._not_armed = dict.fromkeys(self._motors)
        """The motors that are not armed."""
        self._apart_since: Nanos | None = None
        """Since when one motor is armed and another one is not."""
        self._bad = OK
        """The last assessment worse than OK"""
        self._bad_at: Nanos | None = None
        """The time of that assessment; None once recovered"""
        self._began: Nanos | None = None
        self._waited: Nanos = 0
        """Since the first assessment."""
        self._limit, self._limit_at = OK, 0
        """What was last driven with slowly, and when."""
        self._halted_since: Nanos | None = None
        self._contradicted_since: Nanos | None = None
        self._degraded: deque[Nanos] = deque()
        """When being slow or standing began, each time."""
        self._lost = ""
        """Why the tasks were dropped; until all has been well for `recover`."""
        self._window_end: Nanos | None = None
        self._at_window_start: dict[str, tuple[int, int]] = {}
        """Received and rejected counts at the start of the window, by source."""
        self._rejected_share: dict[str, float] = {}

    def adopt(self, settings: HealthSettings) -> None:
        """Continue with other settings."""
        self.settings = settings

    def observe(
        self,
        events: Sequence[Event],
        absent: Mapping[str, str] = NOTHING,
        helpful: frozenset[str] | None = None,
    ) -> None:
        """Record which sources have reported, and when they measured; `absent`: sensors whose newest reading
        shows nothing, and why; `helpful`: those without which the base drives slowly, from now on."""
        self._absent = dict(absent)
        self.helpful = self.helpful if helpful is None else helpful
        for event in events:
            if isinstance(event, State):
                self._on_state(event)
            elif isinstance(event, Feedback):
                if event.position is not None or event.velocity is not None:
                    self._on_measurement(event.motor, event)
            elif isinstance(event, Measurement) and event.sensor not in absent:
                self._on_measurement(event.sensor, event)

    def missing(self) -> str:
        """Return what has never reported or cannot be commanded yet, in words, and is still to be awaited;
        "" if nothing is."""
        parts = [f"feedback of {name}" for name in self._motors if name not in self._last]
        parts += [
            f"{name} to initialise{detail}"
            for name, detail in self._initialising.items()
            if name in self._last
        ]
        needless = self.helpful if self._waited >= self.settings.start_without else ()
        parts += [
            f"a reading of {name}{self._why_absent(name)}"
            for name in self._sensors
            if name not in self._last and name not in needless
        ]
        return ", ".join(parts)

    def assess(
        self,
        now: Nanos,
        rejected: Mapping[str, int],
        contradictions: Sequence[Contradiction] = (),
        verdict: Verdict = CONSISTENT,
    ) -> SourceHealth:
        """Return the worst of all sources and of perception's verdict, with memory: worse at once, better
        after `recover`."""
        self._began = now if self._began is None else self._began
        self._waited = now - self._began
        self._update_window(now, rejected)
        flawed = {one.flawed for one in contradictions}  # which is why its measurements are rejected
        self._rejected_share = {k: share for k, share in self._rejected_share.items() if k not in flawed}
        needed = [self.source(now, name) for name in self._last if name not in self.helpful]
        needed.append(self._apart(now))
        limits = [self.source(now, name) for name in self._sensors if name in self.helpful]
        limits += [SourceHealth(HealthLevel.SLOW, one.reason) for one in contradictions if one.flawed]
        if verdict.trust is Trust.LOST:
            needed.append(SourceHealth(HealthLevel.HALT, verdict.reason))
        elif verdict.trust is not Trust.CONSISTENT:
            limits.append(SourceHealth(HealthLevel.SLOW, verdict.reason))
        worst = max(needed, key=lambda h: h.level)
        worst = self._with_contradictions(now, worst, [one for one in contradictions if not one.flawed])
        worst = self._remembered(now, worst)
        limit = max(limits, key=lambda h: h.level, default=OK)
        if limit.level > HealthLevel.OK:
            self._limit, self._limit_at = SourceHealth(HealthLevel.SLOW, limit.reason), now
        elif now - self._limit_at >= self.settings.recover:
            self._limit = OK
        return max(worst, self._limit, key=lambda h: h.level)

    def _remembered(self, now: Nanos, worst: SourceHealth) -> SourceHealth:
        if worst.level >= HealthLevel.HALT:
            if self._halted_since is None:
                self._halted_since = now
            if now - self._halted_since >= self.settings.give_up:
                worst = SourceHealth(HealthLevel.LOST, worst.reason)
        else:
            self._halted_since = None
        if worst.level > HealthLevel.OK:
            if self._bad_at is None:
                self._degraded.append(now)
            self._bad, self._bad_at = worst, now
            return self._limited(now, worst)
        if self._bad_at is not None:
            if now - self._bad_at < self.settings.recover:
                recovering = SourceHealth(HealthLevel.SLOW, f"just recovered: {self._bad.reason}")
                return SourceHealth(HealthLevel.LOST, self._lost) if self._lost else recovering
            self._bad_at, self._lost = None, ""
        return worst

    def _apart(self, now: Nanos) -> SourceHealth:
        if not 0 < len(self._not_armed) < len(self._motors):
            self._apart_since = None
            return OK
        self._apart_since = now if self._apart_since is None else self._apart_since
        name = next(iter(self._not_armed))
        late = now - self._apart_since > APART
        return SourceHealth(HealthLevel.HALT, f"{name} is not armed, and another wheel is") if late else OK

    def _with_contradictions(
        self, now: Nanos, worst: SourceHealth, contradictions: Sequence[Contradiction]
    ) -> SourceHealth:
        confirmed = [one.reason for one in contradictions if one.confirmed]
        if not confirmed:
            self._contradicted_since = None
            doubts = [SourceHealth(HealthLevel.SLOW, one.reason) for one in contradictions]
            return max(worst, *doubts, key=lambda h: h.level) if doubts else worst
        since = self._contradicted_since = (
            now if self._contradicted_since is None else self._contradicted_since
        )
        if now - since >= self.settings.contradicted:
            self._lost = confirmed[0]
        return max(SourceHealth(HealthLevel.HALT, confirmed[0]), worst, key=lambda h: h.level)

    def _limited(self, now: Nanos, bad: SourceHealth) -> SourceHealth:
        """Return what is bad as lost, if it has been for too long or too often."""
        settings, began = self.settings, self._degraded
        while began[0] < now - settings.often_within and len(began) > 1:
            began.popleft()
        if now - began[-1] >= settings.too_long:
            self._lost = f"degraded for {settings.too_long / SECOND:g} s: {bad.reason}"
        elif len(began) >= settings.too_often:
            within = f"{len(began)} times within {settings.often_within / SECOND:g} s"
            self._lost = f"degraded {within}: {bad.reason}"
            self._degraded = deque([now])
        return SourceHealth(HealthLevel.LOST, self._lost) if self._lost else bad

    def _why_absent(self, name: str) -> str:
        return f" ({self._absent[name]})" if name in self._absent else ""

    def source(self, now: Nanos, name: str) -> SourceHealth:
        """Return the health of one source, without memory."""
        if name in self._faults:
            return SourceHealth(HealthLevel.LOST, f"{name} is in fault{self._faults[name]}")
        if name in self._unsound:
            return SourceHealth(HealthLevel.HALT, f"{name} is in fault{self._unsound[name]}")
        if name not in self._last:
            return SourceHealth(HealthLevel.HALT, f"{name} has never reported")
        if name not in self._timeouts:
            return OK
        age, timeout, settings = now - self._last[name], self._timeouts[name], self.settings
        stand, slow = settings.stand_age * timeout, settings.slow_age * timeout
        for level, share in ((HealthLevel.HALT, stand), (HealthLevel.SLOW, slow)):
            if age > share - 1.0 and age > (limit := round(share)):
                reason = f"{name}: no {self._measurement[name]} for more than {limit / MILLISECOND:g} ms"
                reason += self._why_absent(name)
                return SourceHealth(level, reason)
        if name in self._absent:
            return SourceHealth(HealthLevel.SLOW, f"{name}: {self._absent[name]}")
        share = self._rejected_share.get(name, 0.0)
        if share >= settings.rejected_slow:
            level = HealthLevel.HALT if share >= settings.rejected_stop else HealthLevel.SLOW
            return SourceHealth(level, f"{name}: {100 * share:.0f} % of its measurements are rejected")
        return OK

    def _on_state(self, event: State) -> None:
        if event.motor in self._sensors:
            self._unsound.pop(event.motor, None)
            if event.mode is Mode.FAULT:
                self._unsound[event.motor] = f": {event.detail}" if event.detail else ""
        if event.motor not in self._motors:
            return
        if event.mode is Mode.ARMED:
            self._not_armed.pop(event.motor, None)
        else:
            self._not_armed[event.motor] = None
        for mode, motors in ((Mode.FAULT, self._faults), (Mode.INITIALISING, self._initialising)):
            if event.mode is mode:
                motors[event.motor] = f": {event.detail}" if event.detail else ""
            else:
                motors.pop(event.motor, None)

    def _on_measurement(self, name: str, event: Feedback | Measurement) -> None:
        t = event.t + max(0, min(getattr(event, "duration", 0), SECOND))  # of a scan: of its newest beam
        self._last[name] = max(t, self._last.get(name, t))
        self._measurement[name] = event.noun if isinstance(event, Measurement) else "feedback"
        self._received[name] = self._received.get(name, 0) + 1

    def _update_window(self, now: Nanos, rejected: Mapping[str, int]) -> None:
        """At the end of each window, compute the share of rejected measurements of each source in it."""
        if self._window_end is not None and now < self._window_end:
            return
        self._window_end = now + self.settings.window
        for name, received in self._received.items():
            was_received, was_rejected = self._at_window_start.get(name, (0, 0))
            now_rejected = rejected.get(name, 0)
            self._at_window_start[name] = (received, now_rejected)
            new = received - was_received
            share = (now_rejected - was_rejected) / new if new >= MIN_WINDOW_COUNT else 0.0
            self._rejected_share[name] = share
