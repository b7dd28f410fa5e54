"""A tour through a simulated world as it is judged: samples, arrivals, figures.

Rules. The world's true pose is read here to judge the brain, and never given to it: what the gateway takes in
is in the recording, and holds frames and serial bytes only. A goal counts if the *true* pose is near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import cos, hypot, sin

import numpy as np

from brain.belief import Belief, BrainState, Floats, Pose
from gateway.core.tick import Tick
from gateway.runtime.session import Session
from protocols.messages import MILLISECOND, SECOND, Goal, Nanos

TOLERANCE = 0.20
"""m: how near the true pose must be to a goal."""
SAMPLE_PERIOD: Nanos = 50 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Sample:
    """One moment of a tour; poses are in the frame "odom"."""

    t: Nanos
    true: Pose
    believed: Pose
    raw: Pose
    """By the odometry alone."""
    covariance: Floats
    """Of the believed pose."""
    load: dict[str, float]
    """Share of each bus's capacity since the sample before."""
    age: float
    """ms: the oldest feedback that a command since the sample before was computed from."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A goal, and where the robot truly was when the brain reported it as reached."""

    goal: Goal
    t: Nanos
    distance: float
    """m, from the goal to the true position."""


class Tour:
    """What happens on the way to some goals, watched from outside the session."""

    def __init__(self, session: Session, goals: Sequence[Goal]) -> None:
        if session.twins is None:
            raise ValueError("only a simulated world knows the true pose")
        self._session = session
        self._world = session.twins.world
        self._start = self._world.truth()
        self.goals = goals
        self.samples: list[Sample] = []
        self.arrivals: list[Arrival] = []
        self.paths: list[tuple[tuple[float, float], ...]] = []
        """The last path planned on the way to each goal."""
        self.belief: Belief = session.belief
        self.outlines = [
            [(corner.x, corner.y) for corner in (self._in_odom(Pose(x, y, 0.0)) for x, y in outline)]
            for outline in self._world.outlines()
        ]
        """The true walls and boxes, as polygons [m] in the frame "odom"."""
        self.contacts = 0
        self._busy: dict[str, Nanos] = {}
        self._ages: list[Nanos] = []
        self._next: Nanos = 0

    def on_tick(self, tick: Tick) -> None:
        """Take a sample if one is due, and note an arrival."""
        self.belief = self._session.belief
        joints = self._session.joints.values()
        self._ages += [age for joint in joints if (age := joint.feedback_age(tick.now)) is not None]
        if tick.now >= self._next:
            self._next = tick.now + SAMPLE_PERIOD
            self.contacts = self._world.contacts()
            self._sample(tick.now)
        if self.belief.reached > len(self.arrivals):
            goal, true = self.goals[len(self.arrivals)], self._in_odom(self._world.truth())
            self.arrivals.append(Arrival(goal, tick.now, hypot(true.x - goal.x, true.y - goal.y)))

    def _sample(self, now: Nanos) -> None:
        belief, estimate = self.belief, self.belief.estimate
        if estimate is None:
            return
        busy = dict(self._session.stats.busy)
        load = {bus: (busy[bus] - self._busy.get(bus, 0)) / SAMPLE_PERIOD for bus in busy}
        true, age = self._in_odom(self._world.truth()), max(self._ages, default=0) / MILLISECOND
        raw = belief.raw or estimate.pose
        self.samples.append(Sample(now, true, estimate.pose, raw, estimate.covariance, load, age))
        self._busy, self._ages = busy, []
        if belief.path and belief.state is BrainState.RUNNING:
            self.paths[belief.reached :] = [belief.path]

    def _in_odom(self, pose: Pose) -> Pose:
        """Return a pose of the world in the frame "odom", whose origin is the robot's pose at the start."""
        dx, dy = pose.x - self._start.x, pose.y - self._start.y
        c, s = cos(self._start.yaw), sin(self._start.yaw)
        yaw = (pose.yaw - self._start.yaw + np.pi) % (2 * np.pi) - np.pi
        return Pose(c * dx + s * dy, -s * dx + c * dy, float(yaw))

    # -- figures ------------------------------------------------------------------------------

    @property
    def near(self) -> int:
        """The number of goals that the true pose was near."""
        return sum(arrival.distance <= TOLERANCE for arrival in self.arrivals)

    @property
    def seconds(self) -> float:
        """The simulated time of the last sample."""
        return self.samples[-1].t / SECOND if self.samples else 0.0

    @property
    def length(self) -> float:
        """The length [m] of the true path."""
        return _length([sample.true for sample in self.samples])

    def error(self, path: Sequence[Pose]) -> float:
        """Return the largest distance [m] of a path, one pose per sample, from the true one."""
        pairs = zip(path, self.samples, strict=True)
        return max((hypot(p.x - s.true.x, p.y - s.true.y) for p, s in pairs), default=0.0)

    def figures(self) -> list[str]:
        """Return the figures as text."""
        rows = [
            f"goal {i}: {a.goal.x:.2f}, {a.goal.y:.2f} m after {a.t / SECOND:.1f} s, "
            f"true pose {a.distance:.3f} m away"
            for i, a in enumerate(self.arrivals, 1)
        ]
        goals = f"{self.near} of {len(self.goals)}"
        rows.append(f"goals reached within {TOLERANCE:.2f} m by the true pose: {goals}")
        rows.append(f"walls and boxes touched: {self.contacts}")
        rows.append(f"path driven: {self.length:.2f} m in {self.seconds:.1f} s")
        length = max(self.length, 1e-9)
        for name, path in (
            ("believed path", [sample.believed for sample in self.samples]),
            ("raw odometry ", [sample.raw for sample in self.samples]),
        ):
            error, own_length = self.error(path), _length(path)
            off = f"at most {error:.3f} m off the true one ({100 * error / length:.2f} % of its length)"
            rows.append(f"{name}: {off}, {own_length:.2f} m long ({100 * (own_length / length - 1):+.2f} %)")
        ages = [sample.age for sample in self.samples] or [0.0]
        rows.append(
            f"age of the feedback behind commands: median {np.median(ages):.1f}, worst {max(ages):.1f} ms"
        )
        buses = self.samples[-1].load if self.samples else {}
        loads = [
            f"{bus} {100 * np.mean([sample.load.get(bus, 0.0) for sample in self.samples]):.1f} %"
            for bus in buses
        ]
        return [*rows, f"bus load at most: {', '.join(loads)}"]


def _length(path: Sequence[Pose]) -> float:
    return float(sum(hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(path)))
