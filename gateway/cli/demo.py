"""The demo: a tour through a world of twins, its figures, and a picture of them.

Rules. The world's true pose is read here to judge the brain, and never given to it: what the gateway takes in
is in the recording, and holds frames and serial bytes only. A goal counts if the *true* pose is near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import cos, degrees, hypot, sin
from typing import TYPE_CHECKING

import numpy as np

from brain.belief import Belief, BrainState, Floats, Pose
from gateway.core.tick import Tick
from protocols.messages import MILLISECOND, SECOND, Nanos

if TYPE_CHECKING:
    from gateway.runtime.session import Session

NEAR = 0.20
"""m: how near the true pose must be to a goal."""
FAITHFUL = 0.01
"""How far the believed path may lie from the true one, over the true path's length."""
SAMPLE = 50 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Arrival:
    """A goal, and where the robot truly was when the brain said that it had reached it."""

    x: float
    y: float
    t: Nanos
    distance: float
    """m, of the true pose"""

    @property
    def near(self) -> bool:
        """Whether it counts."""
        return self.distance <= NEAR


@dataclass(slots=True)
class Log:
    """What a tour leaves behind for figures and picture: samples, in the frame "odom"."""

    start: Pose
    t: list[Nanos] = field(default_factory=list)
    true: list[Pose] = field(default_factory=list)
    believed: list[Pose] = field(default_factory=list)
    raw: list[Pose] = field(default_factory=list)
    covariance: list[Floats] = field(default_factory=list)
    load: list[dict[str, float]] = field(default_factory=list)
    """Share of each bus's capacity since the sample before."""
    age: list[float] = field(default_factory=list)
    """ms: how old the oldest feedback was that a command since the sample before has rested on."""
    arrivals: list[Arrival] = field(default_factory=list)
    paths: list[tuple[tuple[float, float], ...]] = field(default_factory=list)
    """The last path wanted on the way to each goal."""
    belief: Belief | None = None
    contacts: int = 0


@dataclass(frozen=True, slots=True)
class Figures:
    """The verdict on a tour."""

    goals: int
    arrivals: tuple[Arrival, ...]
    contacts: int
    length: float
    """m, of the true path"""
    believed_error: float
    """m, the largest distance between believed and true position"""
    raw_error: float
    believed_length: float
    raw_length: float
    seconds: float
    """simulated"""
    age_median: float
    """ms"""
    age_worst: float
    load: dict[str, float]
    """mean share of each bus"""

    @property
    def reached(self) -> bool:
        """Whether every goal was reached by the true pose."""
        return len(self.arrivals) == self.goals and all(a.near for a in self.arrivals)

    def lines(self) -> list[str]:
        """For a person."""
        near = sum(a.near for a in self.arrivals)
        truly = max(self.length, 1e-9)
        rows = [
            f"goal {i}: {a.x:.2f}, {a.y:.2f} m after {a.t / SECOND:.1f} s, true pose {a.distance:.3f} m away"
            for i, a in enumerate(self.arrivals, 1)
        ]
        rows.append(f"goals reached within {NEAR:.2f} m by the true pose: {near} of {self.goals}")
        rows.append(f"walls and boxes touched: {self.contacts}")
        rows.append(f"path driven: {self.length:.2f} m in {self.seconds:.1f} s")
        for name, error, length in (
            ("believed path", self.believed_error, self.believed_length),
            ("raw odometry ", self.raw_error, self.raw_length),
        ):
            share, longer = 100 * error / truly, 100 * (length / truly - 1.0)
            off = f"at most {error:.3f} m off the true one ({share:.2f} % of its length)"
            rows.append(f"{name}: {off}, {length:.2f} m long ({longer:+.2f} %)")
        rows.append(
            f"age of what commands rest on: median {self.age_median:.1f}, worst {self.age_worst:.1f} ms"
        )
        rows.append(
            "bus load at most: "
            + ", ".join(f"{name} {100 * share:.1f} %" for name, share in self.load.items())
        )
        return rows


class Watcher:
    """Looks over the shoulder of a session with twins: samples, arrivals, contacts."""

    def __init__(self, session: Session) -> None:
        if session.twins is None:
            raise ValueError("only a world knows the true pose")
        self._session = session
        self._world = session.twins.world
        self.log = Log(self._world.truth())
        self._busy: dict[str, Nanos] = {}
        self._ages: list[Nanos] = []
        self._next: Nanos = 0

    def watch(self, tick: Tick) -> None:
        """After every tick."""
        joints = self._session.gateway.joints.values()
        self._ages += [age for joint in joints if (age := joint.feedback_age(tick.now)) is not None]
        if tick.now >= self._next:
            self._sample(tick.now)
            self._next = tick.now + SAMPLE

    def arrived(self, now: Nanos, x: float, y: float) -> Arrival:
        """The brain says that it is there: where is it truly?"""
        true = relative(self._world.truth(), self.log.start)
        arrival = Arrival(x, y, now, hypot(true.x - x, true.y - y))
        self.log.arrivals.append(arrival)
        return arrival

    def outlines(self) -> list[list[tuple[float, float]]]:
        """The true walls and boxes, as polygons [m] in the frame "odom"."""
        flat = [
            [relative(Pose(x, y, 0.0), self.log.start) for x, y in wall] for wall in self._world.outlines()
        ]
        return [[(corner.x, corner.y) for corner in wall] for wall in flat]

    def _sample(self, now: Nanos) -> None:
        log, gateway = self.log, self._session.gateway
        belief = gateway.belief()
        log.belief = belief
        log.contacts = self._world.contacts()
        if belief.estimate is None:
            return
        log.t.append(now)
        log.true.append(relative(self._world.truth(), log.start))
        log.believed.append(belief.estimate.pose)
        log.raw.append(belief.raw or belief.estimate.pose)
        log.covariance.append(belief.estimate.covariance)
        log.age.append(max(self._ages, default=0) / MILLISECOND)
        self._ages = []
        busy = dict(self._session.stats.busy)
        log.load.append({bus: (busy[bus] - self._busy.get(bus, 0)) / SAMPLE for bus in busy})
        self._busy = busy
        if belief.path and (belief.state is BrainState.RUNNING):
            reached = belief.reached
            log.paths[reached:] = [belief.path]


def figures(log: Log, goals: int) -> Figures:
    """The verdict on what was watched."""
    buses = log.load[-1] if log.load else {}
    loads = {name: float(np.mean([sample.get(name, 0.0) for sample in log.load])) for name in buses}
    return Figures(
        goals,
        tuple(log.arrivals),
        log.contacts,
        _length(log.true),
        _apart(log.believed, log.true),
        _apart(log.raw, log.true),
        _length(log.believed),
        _length(log.raw),
        (log.t[-1] / SECOND) if log.t else 0.0,
        float(np.median(log.age)) if log.age else 0.0,
        max(log.age, default=0.0),
        loads,
    )


def relative(pose: Pose, start: Pose) -> Pose:
    """A pose of the world in the frame "odom", whose origin is where the robot stood at the start."""
    dx, dy = pose.x - start.x, pose.y - start.y
    c, s = cos(start.yaw), sin(start.yaw)
    turned = (pose.yaw - start.yaw + np.pi) % (2 * np.pi) - np.pi
    return Pose(c * dx + s * dy, -s * dx + c * dy, float(turned))


def _length(path: Sequence[Pose]) -> float:
    return float(sum(hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(path)))


def _apart(one: Sequence[Pose], other: Sequence[Pose]) -> float:
    return max((hypot(a.x - b.x, a.y - b.y) for a, b in zip(one, other, strict=True)), default=0.0)


def progress(session: Session, now: Nanos, goals: int) -> str:
    """One line for a person who waits."""
    belief = session.gateway.belief()
    estimate = belief.estimate
    where = "no pose yet"
    if estimate is not None:
        x, y, yaw = estimate.pose.x, estimate.pose.y, degrees(estimate.pose.yaw)
        where = f"at {x:6.2f}, {y:6.2f} m, {yaw:4.0f}°, {estimate.linear:5.2f} m/s"
    why = f" ({belief.reason})" if belief.reason else ""
    return f"{now / SECOND:6.1f} s  {belief.state:<12} {where}  goals {belief.reached}/{goals}{why}"
