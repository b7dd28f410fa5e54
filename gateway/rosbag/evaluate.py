"""Evaluation of perception on another program's bag: the estimated path against the bag's ground truth.

Rules. Perception processes the events of the bag one by one, in order, each at its own time: nothing looks
ahead, and the ground truth is not among them. At each fix of the truth the estimated pose is what a robot
would have had at that time: the filter's newest, extrapolated by its own twist. The result is the absolute
trajectory error (`gateway.rosbag.trajectory_error`), beside that of dead reckoning and of the bag's own
odometry at the same times. What cannot be evaluated does not pass.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path

import numpy as np

from brain.belief import Estimate, Floats, Pose
from brain.bodies.body import Base
from brain.bodies.plane import arc
from brain.perception.filter_inputs import Nis
from brain.perception.perception import Perception
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.rosbag import Bag, Topic, read
from gateway.rosbag.contradictions import contradictions
from gateway.rosbag.trajectory_error import MIN_PAIRS, PathError, east_north, path_error, spread
from protocols.messages import MILLISECOND, Event, Fix, Nanos, seconds

MIN_EXTENT = 1.0
"""m: a truth that stays within this of its centre has not moved, and proves nothing."""
MAX_EXTRAPOLATION: Nanos = 500 * MILLISECOND
"""Longest time that an estimate is extrapolated by its own twist."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result of running perception on a bag."""

    bag: Bag
    duration: Nanos
    """From the first event to the last."""
    driven: float
    """m: estimated distance travelled"""
    end: Pose | None
    """Last estimated pose, relative to the start in the robot file"""
    fixes: int
    """Fixes of the truth in the bag,"""
    early: int
    """and those before the first estimate: not compared."""
    extent: float
    """m: largest distance of the truth from its centre; 0 without a truth"""
    estimated: PathError | None
    """Error of the estimated path; None if there are too few fixes."""
    wheels: PathError | None
    """Error of dead reckoning: wheel twists, integrated."""
    odometry: PathError | None
    """Error of the poses of the bag's own odometry."""
    nis: Mapping[str, Nis]
    anomalies: Mapping[str, Mapping[str, int]]
    """Measurements not used, or used against the gate, by motor or sensor and reason."""
    at_most: float | None
    """m: the largest error (RMS) that passes"""
    contradictions: tuple[str, ...] = ()
    """What in the bag contradicts itself: then no figure is right."""

    @property
    def ok(self) -> bool:
        """True if the path could be evaluated, and is as good as required."""
        return not self.objections()

    def objections(self) -> list[str]:
        """Return why not; [] if it is."""
        unused = [t for t in self.bag.topics if t.role and not t.used]
        objections = [
            f"no message of {t.name} ({t.role}) could be used: {_reasons(t.unused)}" for t in unused
        ]
        if not self.fixes:
            objections.append("there is no ground truth in it: the path cannot be evaluated")
        elif self.estimated is None:
            objections.append(f"fewer than {MIN_PAIRS} fixes can be compared: the path cannot be evaluated")
        elif self.extent < MIN_EXTENT:
            objections.append(
                f"the truth stays within {self.extent:.2f} m: it did not move, and proves nothing"
            )
        elif self.at_most is not None and not self.estimated.rms <= self.at_most:
            objections.append(
                f"the path error is {self.estimated.rms:.2f} m, and at most {self.at_most:g} m is allowed"
            )
        return [*self.contradictions, *objections]

    def text(self) -> str:
        """Return the result as text."""
        lines = [f"{self.bag.path.name}: {seconds(self.duration):.1f} s, {self.driven:.1f} m driven"]
        if self.end is not None:
            lines[0] += f", to {self.end.x:.2f} m, {self.end.y:.2f} m, {degrees(self.end.yaw):.0f} degrees"
        if self.estimated is not None:
            lines += self._errors(self.estimated)
        lines += ["consistency (NIS per degree of freedom: 1 if the covariances are right)"]
        lines += [f"  {name}: {_nis(nis)}" for name, nis in self.nis.items()]
        anomalies = [f"  {name}: {_reasons(reasons)}" for name, reasons in self.anomalies.items() if reasons]
        lines += ["measurements not used, or used against the gate:", *(anomalies or ["  none"])]
        lines += ["messages used", *(f"  {_use(t)}" for t in self.bag.topics if t.role)]
        rest = [f"  {t.name}: {t.count} of {t.type}" for t in self.bag.topics if not t.role]
        lines += ["topics left over", *(rest or ["  none"])]
        if self.ok and self.at_most is not None:
            lines.append(f"passed: at most {self.at_most:g} m is allowed")
        return "\n".join([*lines, *(f"NOT PASSED: {objection}" for objection in self.objections())])

    def _errors(self, estimated: PathError) -> list[str]:
        share = f", {100 * estimated.rms / self.driven:.2f} % of the path" if self.driven else ""
        early = f" ({self.early} more before the first estimate)" if self.early else ""
        lines = [
            f"path error against the truth, over {estimated.count} fixes{early}, after alignment",
            f"  estimated:        {_error(estimated)}{share}",
        ]
        if self.wheels is not None:
            lines.append(f"  dead reckoning:   {_error(self.wheels)}")
        if self.odometry is not None:
            lines.append(f"  the bag's own:    {_error(self.odometry)}")
        return lines


def _error(error: PathError) -> str:
    return f"{error.rms:6.2f} m RMS, median {error.median:.2f} m, largest {error.largest:.2f} m"


def _nis(nis: Nis) -> str:
    return f"{nis.mean:.3g} over {nis.count} measurements, {100 * nis.beyond / nis.count:.1f} % beyond 95 %"


def _reasons(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{count} × {reason}" for reason, count in reasons.items())


def _use(topic: Topic) -> str:
    unused = f"; not used: {_reasons(topic.unused)}" if topic.unused else ""
    return f"{topic.name}: {topic.used} of {topic.count} as {topic.role}{unused}"


# -- evaluate ------------------------------------------------------------------------------------


def evaluate_file(path: Path, robot: Robot, at_most: float | None = None) -> Evaluation:
    """Read a bag and evaluate it. Raises BagError."""
    return evaluate(read(path, robot.bag, _body(robot)), robot, at_most)


def evaluate(bag: Bag, robot: Robot, at_most: float | None = None) -> Evaluation:
    """Run the robot's perception on a bag. `at_most` [m] is the error (RMS) allowed."""
    body = _body(robot)
    mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
    perception = Perception(body, mounts, robot.brain.perception)
    events = _EventFeed(bag.events, perception)
    fixes: list[Fix] = []
    poses: list[tuple[Pose, Pose, Pose]] = []  # at the time of each: estimated, by the wheels, the bag's own
    for fix in bag.truth:
        events.process_until(fix.t)
        if perception.estimate is not None:
            own = bag.odometry[bisect_right(bag.odometry, fix.t, key=lambda one: one.t) - 1].pose
            fixes.append(fix)
            poses.append((extrapolated(perception.estimate, fix.t), perception.raw, own))
    events.process_until(None)
    truth = east_north(fixes) if fixes else np.empty((0, 2))
    estimated, wheels, odometry = (_error_of([path[i] for path in poses], truth) for i in range(3))
    return Evaluation(
        bag=bag,
        duration=bag.events[-1].t - bag.events[0].t if bag.events else 0,
        driven=events.driven,
        end=perception.estimate.pose if perception.estimate is not None else None,
        fixes=len(bag.truth),
        early=len(bag.truth) - len(truth),
        extent=spread(truth) if fixes else 0.0,
        estimated=estimated,
        wheels=wheels,
        odometry=odometry,
        nis=perception.nis,
        anomalies=perception.anomalies,
        at_most=at_most,
        contradictions=contradictions(bag, body, mounts, robot.brain.perception.filter.turn_slip),
    )


def extrapolated(estimate: Estimate, t: Nanos) -> Pose:
    """Return an estimate's pose at a later time, by its own twist, up to a limit."""
    dt = seconds(min(max(0, t - estimate.t), MAX_EXTRAPOLATION))
    return arc(estimate.pose, estimate.linear * dt, estimate.angular * dt)


class _EventFeed:
    """Feeds events to perception, up to given times."""

    def __init__(self, events: Sequence[Event], perception: Perception) -> None:
        self._events, self._perception, self._next = events, perception, 0
        self.driven = 0.0
        """m: the estimated speed, integrated; corrections of the pose do not count"""

    def process_until(self, t: Nanos | None) -> None:
        """Process all events up to and at a time; None: all that are left."""
        while self._next < len(self._events) and (t is None or self._events[self._next].t <= t):
            event = self._events[self._next]
            self._next += 1
            before = self._perception.estimate
            self._perception.observe(event.t, [event])
            after = self._perception.estimate
            if before is not None and after is not None:
                self.driven += abs(after.linear) * seconds(after.t - before.t)


def _error_of(poses: Sequence[Pose], truth: Floats) -> PathError | None:
    if len(poses) < MIN_PAIRS:
        return None
    return path_error(np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2), truth)


def _body(robot: Robot) -> Base:
    base = robot.brain.base
    if base is None:
        raise BagError(f"{robot.name}: a body of kind {robot.brain.body.kind!r} has no path to evaluate")
    return base
