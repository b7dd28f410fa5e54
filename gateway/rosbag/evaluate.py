"""Judges what the brain believes of somebody else's bag: the path, by the bag's own truth.

Rules. Perception hears the events of the bag one by one, in their order, each at its own time: nothing
looks ahead, and no truth is among them. At each fix of the truth the believed pose is the one that a
robot would have had at that moment: the filter's newest, carried on by its own speeds. It is judged by
how far that path lies from the truth (`gateway.rosbag.trajectory_error`), beside what the wheels alone and the bag's
own odometry make of the same moments. What cannot be judged is not passed.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import degrees
from pathlib import Path

import numpy as np

from brain.belief import Estimate, Floats, Pose
from brain.bodies.differential import Differential, arc
from brain.perception.ekf import Nis
from brain.perception.perception import Perception
from gateway.core.robot import Robot
from gateway.errors import BagError
from gateway.rosbag import Bag, Topic, read
from gateway.rosbag.trajectory_error import FEWEST, PathError, east_north, path_error, spread
from protocols.messages import MILLISECOND, Event, Fix, Nanos, seconds

STANDING = 1.0
"""m: a truth that stays within this of its centre has not moved, and judges nothing."""
FORESIGHT: Nanos = 500 * MILLISECOND
"""For so long an estimate is carried on by its own speeds."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a bag has shown of the brain's perception."""

    bag: Bag
    lasted: Nanos
    """From the first event to the last."""
    driven: float
    """m: how far the base is believed to have gone"""
    end: Pose | None
    """Where it is believed to be at last, from where the robot file lets it start"""
    fixes: int
    """Fixes of the truth in the bag,"""
    early: int
    """and those before the first estimate: not compared."""
    extent: float
    """m: how far the truth goes from its centre; 0 without one"""
    believed: PathError | None
    """None if there is too little to judge by."""
    wheels: PathError | None
    """The same for the wheels alone: twists, integrated."""
    odometry: PathError | None
    """And for the poses that the bag's odometry told."""
    nis: Mapping[str, Nis]
    anomalies: Mapping[str, Mapping[str, int]]
    """What perception refused or did against the rule, by motor or sensor and reason."""
    at_most: float | None
    """m: the largest error (RMS) that is asked for"""

    @property
    def ok(self) -> bool:
        """Whether the path could be judged, and is as good as asked for."""
        return not self.objections()

    def objections(self) -> list[str]:
        """Why not; [] if it is."""
        said: list[str] = []
        unused = [t for t in self.bag.topics if t.part and not t.used]
        said += [f"not one message of {t.name} ({t.part}) could be used: {_reasons(t.left)}" for t in unused]
        if not self.fixes:
            said.append("there is no truth in it: nothing to judge the path by")
        elif self.believed is None:
            said.append(f"fewer than {FEWEST} fixes can be compared: the path cannot be judged")
        elif self.extent < STANDING:
            said.append(f"the truth stays within {self.extent:.2f} m: it did not move, and judges nothing")
        elif self.at_most is not None and not self.believed.rms <= self.at_most:
            said.append(
                f"the path is {self.believed.rms:.2f} m off, and at most {self.at_most:g} m is asked for"
            )
        return said

    def text(self) -> str:
        """For a person."""
        lines = [f"{self.bag.path.name}: {seconds(self.lasted):.1f} s, {self.driven:.1f} m driven"]
        if self.end is not None:
            lines[0] += f", to {self.end.x:.2f} m, {self.end.y:.2f} m, {degrees(self.end.yaw):.0f} degrees"
        if self.believed is not None:
            lines += self._errors(self.believed)
        lines += ["consistency (NIS per degree of freedom: 1 if the covariances are honest)"]
        lines += [f"  {name}: {_nis(nis)}" for name, nis in self.nis.items()]
        reported = [f"  {name}: {_reasons(reasons)}" for name, reasons in self.anomalies.items() if reasons]
        lines += ["measurements refused, or taken against the rule:", *(reported or ["  none"])]
        lines += ["messages used", *(f"  {_use(t)}" for t in self.bag.topics if t.part)]
        rest = [f"  {t.name}: {t.count} of {t.type}" for t in self.bag.topics if not t.part]
        lines += ["topics left over", *(rest or ["  none"])]
        if self.ok and self.at_most is not None:
            lines.append(f"passed: at most {self.at_most:g} m was asked for")
        return "\n".join([*lines, *(f"NOT PASSED: {said}" for said in self.objections())])

    def _errors(self, believed: PathError) -> list[str]:
        share = f", {100 * believed.rms / self.driven:.2f} % of the path" if self.driven else ""
        early = f" ({self.early} more before the first estimate)" if self.early else ""
        lines = [
            f"path error against the truth, over {believed.count} fixes{early}, after one turn and one shift",
            f"  believed:         {_error(believed)}{share}",
        ]
        if self.wheels is not None:
            lines.append(f"  wheels alone:     {_error(self.wheels)}")
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
    left = f"; left over: {_reasons(topic.left)}" if topic.left else ""
    return f"{topic.name}: {topic.used} of {topic.count} as {topic.part}{left}"


# -- the judge ----------------------------------------------------------------------------------


def replay(path: Path, robot: Robot, at_most: float | None = None) -> int:
    """`gateway replay` of a foreign bag: prints the verdict. Raises BagError."""
    verdict = judge(read(path, robot.bag, _body(robot)), robot, at_most)
    print(verdict.text())
    return 0 if verdict.ok else 1


def judge(bag: Bag, robot: Robot, at_most: float | None = None) -> Verdict:
    """Let the robot's perception live through a bag. `at_most` [m] is the error (RMS) allowed."""
    body = _body(robot)
    mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
    perception = Perception(body, mounts, robot.brain.perception)
    received, along = _Heard(bag.events, perception), _Moments()
    for fix in bag.truth:
        received.until(fix.t)
        if perception.estimate is not None:
            odometry = bag.odometry[bisect_right(bag.odometry, fix.t, key=lambda one: one[0]) - 1][1]
            along.add(fix, carried(perception.estimate, fix.t), perception.raw, odometry)
    received.until(None)
    truth = east_north(along.fixes) if along.fixes else np.empty((0, 2))
    return Verdict(
        bag=bag,
        lasted=bag.events[-1].t - bag.events[0].t if bag.events else 0,
        driven=received.driven,
        end=perception.estimate.pose if perception.estimate is not None else None,
        fixes=len(bag.truth),
        early=len(bag.truth) - len(truth),
        extent=spread(truth) if along.fixes else 0.0,
        believed=_error_of(along.believed, truth),
        wheels=_error_of(along.wheels, truth),
        odometry=_error_of(along.odometry, truth),
        nis={f"{body.left} and {body.right}" if n == body.left else n: v for n, v in perception.nis.items()},
        anomalies=perception.anomalies,
        at_most=at_most,
    )


def carried(estimate: Estimate, t: Nanos) -> Pose:
    """An estimate's pose at a later time, by its own speeds, as far as they can be trusted."""
    dt = seconds(min(max(0, t - estimate.t), FORESIGHT))
    return arc(estimate.pose, estimate.linear * dt, estimate.angular * dt)


class _Heard:
    """A perception and the events that it has not heard yet."""

    def __init__(self, events: Sequence[Event], perception: Perception) -> None:
        self._events, self._perception, self._next = events, perception, 0
        self.driven = 0.0
        """m: the believed speed, added up; corrections of the pose are no driving"""

    def until(self, t: Nanos | None) -> None:
        """Hear all events up to and at a time; None: all that are left."""
        while self._next < len(self._events) and (t is None or self._events[self._next].t <= t):
            event = self._events[self._next]
            self._next += 1
            before = self._perception.estimate
            self._perception.observe(event.t, [event])
            after = self._perception.estimate
            if before is not None and after is not None:
                self.driven += abs(before.linear) * seconds(after.t - before.t)


@dataclass(slots=True)
class _Moments:
    """Each fix that is compared, and the poses held against it."""

    fixes: list[Fix] = field(default_factory=list)
    believed: list[Pose] = field(default_factory=list)
    wheels: list[Pose] = field(default_factory=list)
    odometry: list[Pose] = field(default_factory=list)

    def add(self, fix: Fix, believed: Pose, wheels: Pose, odometry: Pose) -> None:
        self.fixes.append(fix)
        self.believed.append(believed)
        self.wheels.append(wheels)
        self.odometry.append(odometry)


def _error_of(poses: Sequence[Pose], truth: Floats) -> PathError | None:
    return path_error(_places(poses), truth) if len(poses) >= FEWEST else None


def _places(poses: Sequence[Pose]) -> Floats:
    return np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2)


def _body(robot: Robot) -> Differential:
    body = robot.brain.differential
    if robot.brain.body != "differential" or body is None:
        raise BagError(
            f"{robot.name}: a body of bare {robot.brain.body} goes nowhere: there is no path to judge"
        )
    return body
