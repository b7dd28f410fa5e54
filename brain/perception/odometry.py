"""Wheel odometry: from two wheels with separate time stamps to the base's motion.

Rules. Each wheel's angle is interpolated to the times of the left wheel's feedback, so that both are known
at one time; the motion between two such times is one `Travel`. Nothing is extrapolated: a travel waits
until the slower wheel has reported. An angle that jumps by more than the wheel can have turned since its
last feedback (a device was reset, or its zero was moved) is a new zero, not a motion: the travel in between
is lost, and this is reported. A silent wheel gives no travels; when it comes back, its angle contains all
that it has turned meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from brain.bodies.differential import Differential
from brain.checks import within
from protocols.messages import MILLISECOND, Feedback, Nanos, seconds

MAX_SAMPLES = 256
"""Samples of one wheel that are kept while the other is silent."""
JUMPED = "position jumped"
STAMP_ERROR: Nanos = 10 * MILLISECOND
"""Two samples may be stamped by this much closer together than their angles were measured."""


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """Properties of the wheels' encoders."""

    resolution: float = 2.0 * math.pi / 8192.0
    """rad of the wheel: one count of the encoder, seen through the gear"""
    shortest: Nanos = 4 * MILLISECOND
    """Shorter travels are joined: their speed would be mostly rounding."""
    jump_margin: float = 2.0
    """An angle that changes faster than the wheel's largest speed times this has jumped."""

    def __post_init__(self) -> None:
        within(self, resolution=(1e-8, 1.0, "rad"), shortest=(0.0, 100.0), jump_margin=(1.0, 10.0))


@dataclass(frozen=True, slots=True)
class Travel:
    """Rotation of both wheels between two times."""

    since: Nanos
    t: Nanos
    left: float
    """rad that the left wheel turned"""
    right: float


@dataclass(frozen=True, slots=True)
class _Sample:
    t: Nanos
    angle: float


@dataclass(slots=True)
class _Wheel:
    """Samples of one wheel that are still needed, oldest first."""

    samples: deque[_Sample] = field(default_factory=deque)

    def add(self, sample: _Sample) -> None:
        """Add a sample; of too many (the other wheel is silent) drop the oldest after the base."""
        self.samples.append(sample)
        if len(self.samples) > MAX_SAMPLES:
            del self.samples[1]

    def at(self, t: Nanos) -> float:
        """Return the angle [rad] at a time within the samples."""
        before = self.samples[0]
        for sample in self.samples:
            if sample.t >= t:
                return _interpolated(before, sample, t)
            before = sample
        return before.angle

    def forget(self, t: Nanos) -> None:
        """Drop samples not needed for times from t on."""
        while len(self.samples) > 1 and self.samples[1].t <= t:
            self.samples.popleft()


def _interpolated(a: _Sample, b: _Sample, t: Nanos) -> float:
    if b.t <= a.t:
        return b.angle
    return a.angle + (b.angle - a.angle) * ((t - a.t) / (b.t - a.t))


class Odometry:
    """Pairs the samples of the two wheels."""

    def __init__(self, body: Differential, settings: OdometrySettings) -> None:
        self._body = body
        self._settings = settings
        self._wheels = {body.left: _Wheel(), body.right: _Wheel()}
        self._base: Nanos | None = None
        self._wanted: deque[Nanos] = deque(maxlen=MAX_SAMPLES)

    def observe(self, feedback: Feedback) -> tuple[list[Travel], str]:
        """Return the travels that this feedback completes, and "" or what is wrong with it."""
        angle = feedback.position
        if angle is None:
            return [], ""
        if not math.isfinite(angle):
            return [], "not finite"
        samples = self._wheels[feedback.motor].samples
        defect = ""
        if samples:
            last = samples[-1]
            if feedback.t <= last.t:
                return [], "" if feedback.t == last.t and angle == last.angle else "out of order"
            if self._jumped(last, feedback.t, angle):
                self._restart()
                defect = JUMPED
        self._wheels[feedback.motor].add(_Sample(feedback.t, angle))
        if feedback.motor == self._body.left:
            self._wanted.append(feedback.t)
        return self._travels(), defect

    def _jumped(self, last: _Sample, t: Nanos, angle: float) -> bool:
        fastest = self._body.wheel_speed * self._settings.jump_margin
        possible = fastest * seconds(t - last.t + STAMP_ERROR) + 2.0 * self._settings.resolution
        return abs(angle - last.angle) > possible

    def _restart(self) -> None:
        for wheel in self._wheels.values():
            wheel.samples.clear()
        self._wanted.clear()
        self._base = None

    def _travels(self) -> list[Travel]:
        left, right = self._wheels[self._body.left], self._wheels[self._body.right]
        travels: list[Travel] = []
        while self._wanted and right.samples and self._wanted[0] <= right.samples[-1].t:
            t = self._wanted.popleft()
            if t < right.samples[0].t:
                continue
            if self._base is None:
                self._base = t
            elif t - self._base >= self._settings.shortest:
                turned = tuple(wheel.at(t) - wheel.at(self._base) for wheel in (left, right))
                travels.append(Travel(self._base, t, *turned))
                self._base = t
            left.forget(self._base)
            right.forget(self._base)
        return travels
