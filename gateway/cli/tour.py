"""A tour or a mission in a simulated world as it is judged: samples, arrivals, legs, figures.

Rules. The world's true pose is read here to judge the brain, and never given to it: what the gateway takes in
is in the recording, and holds frames and serial bytes only. A goal counts if the *true* pose is near it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import dist, hypot, sqrt

import numpy as np

from brain.belief import Belief, BrainState, Floats, Pose
from brain.bodies.body import Base, Linkage
from brain.bodies.limbs import LimbPlace, limbs
from brain.bodies.plane import motion, moved, seen_from
from brain.planning.polyline import Polyline
from gateway.core.tick import Tick
from gateway.runtime.session import Session
from protocols.messages import MILLISECOND, SECOND, Goal, Nanos

TOLERANCE = 0.20
"""m: how near the true pose must be to a goal."""
SAMPLE_PERIOD: Nanos = 50 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Sample:
    """One moment of a tour; poses are in the frame "map"."""

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
    off: float | None
    """m, of the true pose from the path that is followed, sideways; None without one"""
    people: tuple[tuple[float, float, float], ...] = ()
    """x, y, radius [m]"""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A goal, and where the robot truly was when the brain reported it as reached."""

    goal: Goal
    t: Nanos
    distance: float
    """m, from the goal to the true position."""


@dataclass(slots=True)
class TourLeg:
    """The way to one goal."""

    began: Nanos
    """When its first path was planned,"""
    planned: float = 0.0
    """and how long [m] that was; with what was driven before, of the first path that ended at the goal, or of
    the last one where there is none."""
    whole: bool = False
    """Whether that one did."""
    goal: Goal | None = None
    """The last one: on the way past some points there are several"""
    driven: float = 0.0
    """m, by the true pose since then"""
    ended: Nanos | None = None

    def least(self, body: Base) -> float:
        """Return the time [s] in which the planned path could be driven straight, from rest to rest."""
        ramp = body.max_linear / body.max_linear_acceleration
        if self.planned < ramp * body.max_linear:
            return 2.0 * sqrt(self.planned / body.max_linear_acceleration)
        return self.planned / body.max_linear + ramp


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
        self.legs: list[TourLeg] = []
        """Those that have a path; a leg is the way to one goal, of a tour or a mission."""
        self.shafts: list[tuple[float, ...]] = []
        """rad, true positions of all joints, in the order of the robot file, by sample"""
        self.boxes: list[dict[str, tuple[float, float, float]]] = []
        """m, where the boxes are that can be moved, by sample"""
        self.times: list[Nanos] = []
        """Of `shafts`."""
        self._line: tuple[int, Polyline] | None = None
        """The path that is followed, with its version."""
        self.belief: Belief = session.belief
        self.outlines = [
            [(corner.x, corner.y) for corner in (self._in_map(Pose(x, y, 0.0)) for x, y in outline)]
            for outline in self._world.outlines()
        ]
        """The true walls and boxes, as polygons [m] in the frame "map"."""
        self.tags = [(number, self._in_map(Pose(x, y, yaw))) for number, x, y, yaw in self._world.tags()]
        """Number and pose of each tag in the frame "map"."""
        self.contacts = self.touched_people = 0
        self._leg = 0
        """Number of goals that are reached once the present leg is."""
        self._busy = dict(session.stats.transmission_times())
        self._ages: list[Nanos] = []
        self._next: Nanos = 0

    def on_tick(self, tick: Tick) -> None:
        """Take a sample if one is due, and note an arrival."""
        self.belief = self._session.belief
        joints = self._session.joints.values()
        self._ages += [age for joint in joints if (age := joint.feedback_age(tick.now)) is not None]
        if tick.now >= self._next:
            self._next = tick.now + SAMPLE_PERIOD
            self.contacts, self.touched_people = self._world.contacts(), self._world.touches_by_people()
            self.shafts.append(tuple(self._world.shaft(motor)[0] for motor in self._session.robot.motors))
            self.boxes.append(self._world.movable())
            self.times.append(tick.now)
            self._sample(tick.now)
        if len(self.goals) > len(self.arrivals) < self.belief.reached:
            goal, true = self.goals[len(self.arrivals)], self._in_map(self._world.truth())
            self.arrivals.append(Arrival(goal, tick.now, hypot(true.x - goal.x, true.y - goal.y)))

    def _sample(self, now: Nanos) -> None:
        belief, estimate = self.belief, self.belief.estimate
        if estimate is None:
            return
        busy = dict(self._session.stats.transmission_times())
        load = {bus: (busy[bus] - self._busy.get(bus, 0)) / SAMPLE_PERIOD for bus in busy}
        true, age = self._in_map(self._world.truth()), max(self._ages, default=0) / MILLISECOND
        raw, off = belief.raw or estimate.pose, self._follow(now, true)
        people = tuple(
            (p.x, p.y, r) for x, y, r in self._world.people() for p in [self._in_map(Pose(x, y, 0.0))]
        )
        if self.samples and self.legs and self.legs[-1].ended is None:
            before = self.samples[-1].true
            self.legs[-1].driven += hypot(true.x - before.x, true.y - before.y)
        self.samples.append(
            Sample(now, true, estimate.pose, raw, estimate.covariance, load, age, off, people)
        )
        self._busy, self._ages = busy, []

    def _follow(self, now: Nanos, true: Pose) -> float | None:
        """Note legs and paths; return how far the true pose is off the path, sideways."""
        belief = self.belief
        running = belief.state is BrainState.RUNNING and len(belief.path) > 1
        if self.legs and self.legs[-1].ended is None and (belief.reached >= self._leg or belief.goal is None):
            self.legs[-1].ended = now
        if not running:
            return None
        if self._line is None or self._line[0] != belief.path_version:
            self._line = (belief.path_version, Polyline(belief.path))
        if not self.legs or self.legs[-1].ended is not None:
            self._leg = belief.reached + 1
            self.legs.append(TourLeg(now))
        leg, goal = self.legs[-1], belief.goal
        if not leg.whole or goal != leg.goal:
            leg.goal = goal
            leg.planned = leg.driven + self._line[1].length
            leg.whole = goal is not None and dist(belief.path[-1], (goal.x, goal.y)) < TOLERANCE
        self.paths[len(self.legs) - 1 :] = [belief.path]
        along, off = self._line[1].project((true.x, true.y))
        return off if 0.0 < along < self._line[1].length else None

    def _in_map(self, pose: Pose) -> Pose:
        """Return a pose of the world in the frame "map", whose origin is the robot's pose at the start."""
        return seen_from(self._start, pose)

    # -- figures ------------------------------------------------------------------------------

    @property
    def motors(self) -> tuple[str, ...]:
        """The names of the joints of `shafts`."""
        return tuple(self._session.robot.motors)

    @property
    def arms(self) -> list[tuple[Linkage, LimbPlace]]:
        """The arms, and where in the robot's frame each stands."""
        found = limbs(self._session.robot.brain.body).values()
        return [(arm, one.at) for one in found if (arm := one.body.as_linkage) is not None]

    def footprint(self, pose: Pose) -> list[tuple[float, float]]:
        """Return the robot's outline at a pose, drawn to scale; empty for a body without one."""
        base = self._session.robot.brain.base
        corners = base.outline if base is not None else ()
        places = [moved(pose, Pose(x, y, 0.0)) for x, y in corners]
        return [(place.x, place.y) for place in places]

    @property
    def near(self) -> int:
        """The number of goals that the true pose was near."""
        return sum(arrival.distance <= TOLERANCE for arrival in self.arrivals)

    @property
    def done(self) -> bool:
        """Whether the mission is done."""
        return self.belief.mission is not None and self.belief.mission.phase == "done"

    @property
    def outcome(self) -> str:
        """How many goals were reached, or what became of the mission."""
        view = self.belief.mission
        return (
            f"{self.near} of {len(self.goals)} goals"
            if view is None
            else f"mission {view.name}: {view.phase}"
        )

    @property
    def seconds(self) -> float:
        """The time of the last sample."""
        return self.times[-1] / SECOND if self.times else 0.0

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
        if self.goals:
            rows.append(f"goals reached within {TOLERANCE:.2f} m by the true pose: {goals}")
        rows.append(f"walls and boxes touched: {self.contacts}; people: {self.touched_people}")
        if not self.samples:
            return [*rows, f"joints moved for {self.seconds:.1f} s"]
        rows += [*self._legs(), f"path driven: {self.length:.2f} m in {self.seconds:.1f} s"]
        if beside := [(sample.off, sample.t) for sample in self.samples if sample.off is not None]:
            rms = 100.0 * sqrt(sum(off * off for off, _ in beside) / len(beside))
            farthest, t = max(beside)
            rows.append(
                f"off the path that is followed: RMS {rms:.1f} cm, "
                f"at most {100.0 * farthest:.1f} cm, at {t / SECOND:.1f} s"
            )
        most, when = self.jerk()
        span = f"over {SAMPLE_PERIOD / SECOND:g} s"
        rows.append(f"jerk of the true motion {span}: at most {most:.1f} m/s³, at {when:.1f} s")
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
        buses = self.samples[-1].load
        loads = [
            f"{bus} {100 * np.mean([sample.load.get(bus, 0.0) for sample in self.samples]):.1f} %"
            for bus in buses
        ]
        return [*rows, f"bus load at most: {', '.join(loads)}"]

    def _legs(self) -> list[str]:
        """Return how each leg compares with its first plan, and with the shortest time for that."""
        base = self._session.robot.brain.base
        if base is None:
            return []
        rows = []
        for i, leg in enumerate(self.legs, 1):
            took = ((leg.ended or self.samples[-1].t) - leg.began) / SECOND
            least = leg.least(base)
            rows.append(
                f"leg {i}: {leg.driven:.2f} m driven, {leg.planned:.2f} m planned "
                f"({leg.driven / max(leg.planned, 1e-9):.2f}); "
                f"{took:.1f} s, at best {least:.1f} s straight on ({took / max(least, 1e-9):.2f})"
            )
        return rows

    def speeds(self) -> list[tuple[float, float, float]]:
        """Return the true speed between samples: m/s forward, rad/s, m/s to the left."""
        dt = SAMPLE_PERIOD / SECOND
        moves = [motion(a.true, b.true) for a, b in pairwise(self.samples)]
        return [(distance / dt, turn / dt, sideways / dt) for distance, turn, sideways in moves]

    def jerk(self) -> tuple[float, float]:
        """Return the largest jerk [m/s³] of the true motion along and across, and when [s] it was."""
        dt = SAMPLE_PERIOD / SECOND
        speeds = [(forward, left) for forward, _, left in self.speeds()]
        largest, at = 0.0, 0.0
        for i, ((ax, ay), (bx, by), (cx, cy)) in enumerate(zip(speeds, speeds[1:], speeds[2:], strict=False)):
            found = hypot(cx - 2.0 * bx + ax, cy - 2.0 * by + ay) / dt**2
            if found > largest:
                largest, at = found, self.samples[i + 1].t / SECOND
        return largest, at


def _length(path: Sequence[Pose]) -> float:
    return float(sum(hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(path)))
