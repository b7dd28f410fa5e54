"""One case: the whole brain, as the robot file `diffbot` configures it, drives a base; what came of it.

Rules. A goal counts as reached if the true distance to it is at most 0.1 m when the brain reports it reached;
reported from farther it is false, the worst outcome. NEES is the mean over samples at 2 Hz of the squared
Mahalanobis distance of the pose's true error, per number: an honest filter has 1 (Bar-Shalom, Li, Kirubarajan
2001, section 5.4). What touches a standing robot is no contact of its own motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from brain.base_limb import BaseLimb
from brain.belief import BrainState, Pose
from brain.bodies.differential import Differential
from brain.brain import Brain
from gateway.config import load_robot
from gateway.core.robot import Robot
from protocols.messages import MILLISECOND, SECOND, Command, Drive, Goal, Nanos, seconds
from tests.robustness.plant import OWN, TICK, Base, Figures, Scene, scene

NEAR = 0.1
"""m, of a goal that is truly reached, and of a pose that is found again; with `NEAR_YAW`"""
NEAR_YAW = math.radians(5.0)
STANDING = 0.01
"""m/s, below which the base stands"""
MOST_NEES = 10.0
NOTICED = 10.0
"""s, within which a note must have the case's word"""
SAMPLE: Nanos = 500 * MILLISECOND

Expected: TypeAlias = Literal["reached", "safe", "refused", "stops", "named", "found"]
"""What is good, besides no contact by own motion and no goal falsely called reached.

reached: every goal is, and NEES is below 10, without the time between being moved and being found again.
refused: no goal is reached, with a note. stops: it stands at the end, with a note. safe: reached, or stops.
named: a note has the case's word in time, or as reached. found: within 1 s of being moved the pose is
right again, or it is lost, and found again within 5 s."""


@dataclass(frozen=True, slots=True)
class Then:
    """Something that happens once: from `at` on [s], as soon as the base is as fast as `moving` [m/s]."""

    at: float
    what: Callable[[Base], None]
    moving: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A variation of world, figures, goals, and what happens."""

    name: str
    world: str = "office"
    figures: Figures = field(default_factory=Figures)
    goals: tuple[tuple[float, float], ...] = ()
    """m, relative to the start; by default the world's tour"""
    start: Pose | None = None
    arrange: Callable[[Base], None] | None = None
    """Changes the scene before the start"""
    glass: frozenset[str] = frozenset()
    then: tuple[Then, ...] = ()
    drive: tuple[float, float] | None = None
    """m/s, rad/s by hand, in place of goals"""
    expect: Expected = "reached"
    word: str = ""
    limit: float = 0.0
    """s; by default what a slow drive takes"""


@dataclass(slots=True)
class Row:
    """What came of a case."""

    name: str
    seed: int
    asked: int
    reached: int = 0
    false: list[float] = field(default_factory=list)
    """m, how far off each goal was that was falsely called reached"""
    error: float = 0.0
    """m, the largest true error"""
    yaw: float = 0.0
    """degrees, of the heading"""
    nees: float = math.nan
    nis: dict[str, float] = field(default_factory=dict)
    contacts: list[tuple[str, float]] = field(default_factory=list)
    """By own motion: with what, and the speed [m/s]"""
    lost: float = math.inf
    """s, from what happened until the base stood and the state was no longer running"""
    found: float = math.inf
    """s, from what happened until the believed pose was true again"""
    noticed: float = math.inf
    """s, from the first motion until a note had the case's word"""
    standing: float = 0.0
    """s, the longest with a goal and without motion"""
    span: float = 0.0
    named: list[str] = field(default_factory=list)
    """Warnings and errors, each once"""
    good: bool = False

    def line(self) -> str:
        """Return the row of a table, under `HEADER`."""
        nis = ", ".join(f"{name} {mean:.2f}" for name, mean in self.nis.items())
        remarks = [f"reached falsely, {off:.2f} m off" for off in self.false]
        remarks += [f"touched {what} at {speed:.2f} m/s" for what, speed in self.contacts[:3]]
        remarks += [] if self.good else self.named[:2]
        return (
            f"| {self.name} | {'good' if self.good else '**bad**'} | {self.reached}/{self.asked} "
            f"| {self.error:.3f} | {self.yaw:.1f} | {self.nees:.2f} | {nis} | {self.span:.0f} "
            f"| {self.standing:.0f} | {self.lost:.1f} | {self.found:.1f} | {'; '.join(remarks)[:140]} |"
        ).replace("inf", "")


HEADER = """\
| variation | verdict | goals | error m | yaw ° | NEES | NIS | s | standing s | lost s | found s | remarks |
|---|---|---|---|---|---|---|---|---|---|---|---|"""


def table(rows: Sequence[Row]) -> str:
    """Return rows as a table in Markdown, with how many are good."""
    lines = "\n".join(row.line() for row in rows)
    return f"{HEADER}\n{lines}\n\n{sum(row.good for row in rows)} of {len(rows)} good."


def mean_nees(rows: Sequence[Row]) -> float:
    """Return the mean NEES per number over runs."""
    return float(np.mean([row.nees for row in rows]))


def mean_nis(rows: Sequence[Row]) -> dict[str, float]:
    """Return the mean NIS per number over runs, by sensor."""
    return {sensor: float(np.mean([row.nis.get(sensor, 1.0) for row in rows])) for sensor in rows[0].nis}


@cache
def diffbot() -> Robot:
    """Return the robot that is driven."""
    return load_robot("diffbot")


def make_brain(figures: Figures) -> Brain:
    """Return its brain, with the sensors that there are."""
    robot = diffbot()
    there = {"lidar": figures.lidar, "imu": figures.imu}
    sensors = {name: sensor for name, sensor in robot.sensors.items() if there[name]}
    timeouts = {name: motor.joint.feedback_timeout for name, motor in robot.motors.items()}
    timeouts |= {name: sensor.timeout for name, sensor in sensors.items()}
    mounts = {name: sensor.mount for name, sensor in sensors.items()}
    return Brain(robot.brain, list(robot.motors), mounts, timeouts)


def in_odom(start: Pose, pose: Pose) -> Pose:
    """Return a pose of the world in the frame of where the base started."""
    c, s = math.cos(start.yaw), math.sin(start.yaw)
    dx, dy = pose.x - start.x, pose.y - start.y
    return Pose(c * dx + s * dy, c * dy - s * dx, math.remainder(pose.yaw - start.yaw, 2.0 * math.pi))


def run(case: Case, seed: int) -> Row:
    """Run a case to its end and judge it."""
    trial = _Trial(case, seed)
    while trial.tick():
        pass
    return trial.judged()


class _Trial:
    """A case under way."""

    def __init__(self, case: Case, seed: int) -> None:
        around, robot = scene(case.world), diffbot()
        body, mount = robot.brain.body, robot.sensors["lidar"].mount
        assert isinstance(body, Differential)
        if case.start is not None:
            around = Scene(around.solids, case.start, around.tour)
        lidar = (mount.x, mount.y, mount.yaw)
        self.case = case
        self.base = Base(around, body, lidar, case.figures, seed, case.glass)
        if case.arrange is not None:
            case.arrange(self.base)
        self.brain = make_brain(case.figures)
        self.start, self.began = self.base.pose, self.base.now
        self.goals = list(case.goals or around.tour)
        length = sum(math.dist(a, b) for a, b in pairwise([(0.0, 0.0), *self.goals]))
        self.limit = case.limit or 30.0 + 8.0 * length
        self.row = Row(case.name, seed, 0 if case.drive else len(self.goals))
        self.goal: tuple[float, float] | None = None
        self.asked: Nanos = 0
        self.commands: tuple[Command, ...] = ()
        self.then = list(case.then)
        self.happened: Nanos | None = None
        self.stood: Nanos = 0
        self.set_out: Nanos | None = None
        self.nees: list[float] = []

    def tick(self) -> bool:
        """Advance by one tick; return whether the case goes on."""
        base, now = self.base, self.base.now + TICK
        elapsed = seconds(now - self.began)
        if self.then and elapsed >= self.then[0].at and abs(base.speed) >= self.then[0].moving:
            self.then.pop(0).what(base)
            self.happened = self.happened or now
        events = base.step(self.commands)
        if self.set_out is None and abs(base.speed) > STANDING:
            self.set_out = now
        self.commands = tuple(self.brain.step(now, events, self._tasks(now, elapsed), ""))
        self._notes()
        self._stand()
        if now % SAMPLE == 0:
            self._sample(now)
        awaited = self.happened is not None and math.isinf(self.row.lost) and now % (50 * MILLISECOND) == 0
        if awaited and abs(base.speed) < STANDING and self.brain.belief().state is not BrainState.RUNNING:
            self.row.lost = seconds(now - (self.happened or now))
        self.row.span = elapsed
        over = not self.case.drive and self.goal is None and not self.goals
        searched = seconds(now - (self.happened or now)) < 6.0 and math.isinf(self.row.found)
        over = over and not (base.moved and searched)
        return elapsed < self.limit and not (over and abs(base.speed) < STANDING)

    def _tasks(self, now: Nanos, elapsed: float) -> list[Goal | Drive]:
        if elapsed < 1.0:
            return []
        if self.case.drive is not None:
            return [Drive(*self.case.drive)] if now % (100 * MILLISECOND) == 0 else []
        if self.goal is not None or not self.goals:
            return []
        self.goal, self.asked = self.goals.pop(0), now
        return [Goal(*self.goal)]

    def _notes(self) -> None:
        for level, text in self.brain.take_notes():
            if level != "info" and text not in self.row.named:
                self.row.named.append(text)
                if self.case.word in text.lower() and self.set_out is not None:
                    self.row.noticed = min(self.row.noticed, seconds(self.base.now - self.set_out))
            if text.startswith("goal ") and " reached" in text and self.goal is not None:
                here = in_odom(self.start, self.base.pose)
                off = math.dist(self.goal, (here.x, here.y))
                self.row.reached += off <= NEAR
                self.row.false += [off] if off > NEAR else []
                self.goal = None

    def _stand(self) -> None:
        base = self.base
        if self.goal is None or abs(base.speed) > STANDING or abs(base.turn_rate) > 0.02:
            self.stood = base.now
        self.row.standing = max(self.row.standing, seconds(base.now - self.stood))

    def _sample(self, now: Nanos) -> None:
        belief, row = self.brain.belief(), self.row
        if self.goal is not None and belief.goal is None and now > self.asked + SECOND:
            self.goal = None  # given up
        estimate = belief.estimate
        if estimate is None or seconds(now - self.began) < 1.0:
            return
        true, pose = in_odom(self.start, self.base.at(estimate.t)), estimate.pose
        turn = math.remainder(pose.yaw - true.yaw, 2.0 * math.pi)
        apart = np.array([pose.x - true.x, pose.y - true.y, turn])
        off = math.hypot(apart[0], apart[1])
        if self.base.moved and math.isinf(row.found):
            if off > NEAR or abs(turn) > NEAR_YAW:
                return
            row.found = seconds(now - (self.happened or now))
        row.error, row.yaw = max(row.error, off), max(row.yaw, math.degrees(abs(turn)))
        covariance = estimate.covariance + 1e-12 * np.eye(3)
        self.nees.append(float(apart @ np.linalg.solve(covariance, apart)) / 3.0)

    def judged(self) -> Row:
        """Return the row, with its verdict."""
        row, case = self.row, self.case
        row.nees = float(np.mean(self.nees)) if self.nees else math.nan
        assert isinstance(self.brain.base, BaseLimb)
        perception = self.brain.base.perception
        row.nis = {name: nis.mean for name, nis in perception.nis.items() if nis.count}
        row.contacts = [(what, speed) for what, speed in self.base.touches if abs(speed) > OWN]
        all_reached = row.reached == row.asked and row.nees < MOST_NEES
        stands = abs(self.base.speed) < STANDING and bool(row.named)
        good = {
            "reached": all_reached,
            "refused": not row.reached and bool(row.named),
            "safe": all_reached or stands,
            "stops": stands,
            "named": all_reached or row.noticed <= NOTICED,
            "found": row.found <= 1.0 or (row.lost <= 1.0 and row.found <= 5.0),
        }
        row.good = good[case.expect] and not row.contacts and not row.false
        return row
