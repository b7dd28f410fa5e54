"""A base that drives through the doorway of the office, and two people whose ways meet its own.

Rules. People walk straight on, from wall to wall; they neither stop nor give way. Each comes to where the
base would be at that moment without them, up to `ASIDE`: one through the doorway, or along the wall beside it
on the far side, hidden until late; the other anywhere, across or towards the base. They set out at a wall, at
least `FAR` from the base or hidden from it, as soon as the base is as far on its way as it was so long before
in a run without people. Who walks into a base that stands, or into another, steps aside and is gone; who
touches a base of which the middle, or the place touched, is faster than `STANDS` is struck. The base and its
sensors are those of `tests.robustness`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.bodies.differential import Differential
from protocols.messages import Command, Goal, seconds
from tests.robustness.judge import diffbot, in_odom, make_brain
from tests.robustness.plant import HALF_LENGTH, HALF_WIDTH, Base, Figures, Person, Scene, cast, scene

Ints = npt.NDArray[np.int64]

STANDS = 0.05
"""m/s"""
RADIUS, ASIDE, FAR = 0.25, 0.3, 2.0
"""m"""
SPEEDS = (0.3, 1.2)
"""m/s"""
DOOR, SILLS, BESIDE = 2.6, (0.8, 1.3), (0.35, 0.8)
"""m: x of the doorway's wall, y between which somebody fits through, and how far from the wall some walk"""
WAYS = ((Pose(0.0, 0.0, 0.0), Pose(5.2, 1.0, 0.0)), (Pose(5.2, 1.0, math.pi), Pose(0.4, 0.2, 0.0)))
"""Starts and goals in the world"""
BEGIN, LIMIT = 1.0, 90.0
"""s, when the goal is given, and when a run ends at the latest"""


@dataclass(frozen=True, slots=True)
class Walk:
    """Somebody, in a word, who sets out as soon as the base has come to this pose of the track."""

    name: str
    person: Person
    after: int


@dataclass(slots=True)
class Crossing:
    """What came of a run."""

    seed: int
    walks: list[str] = field(default_factory=list)
    struck: list[tuple[str, float, float]] = field(default_factory=list)
    """Who was, when [s], and the speed [m/s]"""
    stepped_aside: int = 0
    clearance: float = math.inf
    """m, the least between the outline and anybody while the base moved"""
    span: float = math.inf
    """s until the goal was reached"""

    @property
    def delay(self) -> float:
        """Return how much longer it took than the same way without people [s]."""
        return min(self.span, LIMIT) - alone(self.seed % 2)[0].span

    def line(self) -> str:
        """Return the run in words."""
        struck = [f"{who} STRUCK at {t:.1f} s, {speed:.2f} m/s" for who, t, speed in self.struck]
        return (
            f"seed {self.seed}: {', '.join(self.walks)}; clearance {self.clearance:.2f} m; "
            f"{self.span:.1f} s, {self.delay:+.1f} s; {', '.join(struck) or 'nobody struck'}"
        )


class Trial:
    """A run under way. `track`: the base's pose at each tick of the same way without people."""

    def __init__(self, seed: int, way: int, walks: list[Walk], track: Floats) -> None:
        body, mount = diffbot().brain.body, diffbot().sensors["lidar"].mount
        assert isinstance(body, Differential)
        start, goal = WAYS[way]
        around = Scene(scene("office").solids, start, ())
        self.base = Base(around, body, (mount.x, mount.y, mount.yaw), Figures(), seed)
        self.brain = make_brain(Figures())
        self.result = Crossing(seed)
        self.walks = walks
        self._goal, self._track, self._along = in_odom(start, goal), track, 0
        self._began, self._commands = self.base.now, tuple[Command, ...]()

    @property
    def elapsed(self) -> float:
        """Return the time since the start [s]."""
        return seconds(self.base.now - self._began)

    def tick(self) -> bool:
        """Advance by one tick; return whether the run goes on."""
        self._set_out()
        before = self.elapsed
        events = self.base.step(self._commands)
        goes = before < BEGIN <= self.elapsed
        tasks = [Goal(self._goal.x, self._goal.y)] if goes else []
        self._commands = tuple(self.brain.step(self.base.now, events, tasks, ""))
        people = self.base.people
        for name in list(people):
            self._meet(name)
        if len(people) == 2 and _apart(*people.values()) < 2.0 * RADIUS:
            del people[self.result.walks[-1]]
        for _, text in self.brain.take_notes():
            if text.startswith("goal ") and " reached" in text:
                self.result.span = self.elapsed
        return self.elapsed < min(self.result.span, LIMIT)

    def _set_out(self) -> None:
        if not self.walks:
            return
        last = min(self._along + 100, round(self.elapsed * 100), len(self._track) - 1)
        coming = self._track[self._along : last + 1]
        away = np.hypot(coming[:, 0] - self.base.pose.x, coming[:, 1] - self.base.pose.y)
        self._along = last - int(away[::-1].argmin())
        for walk in [walk for walk in self.walks if walk.after <= self._along]:
            self.walks.remove(walk)
            self.base.people[walk.name] = walk.person
            self.result.walks.append(walk.name)

    def _meet(self, name: str) -> None:
        base, person, result = self.base, self.base.people[name], self.result
        c, s = math.cos(base.pose.yaw), math.sin(base.pose.yaw)
        dx, dy = person.x - base.pose.x, person.y - base.pose.y
        x, y = c * dx + s * dy, c * dy - s * dx
        ours = min(max(x, -HALF_LENGTH), HALF_LENGTH), min(max(y, -HALF_WIDTH), HALF_WIDTH)
        clearance = math.dist((x, y), ours) - person.radius
        there = math.hypot(base.speed - base.turn_rate * ours[1], base.turn_rate * ours[0])
        speed = max(abs(base.speed), there)
        if speed > STANDS:
            result.clearance = min(result.clearance, clearance)
        if clearance < 0.0:
            del base.people[name]
            if speed > STANDS:
                result.struck.append((name, self.elapsed, speed))
            else:
                result.stepped_aside += 1


def _apart(one: Person, other: Person) -> float:
    return math.dist((one.x, one.y), (other.x, other.y))


@cache
def alone(way: int) -> tuple[Crossing, Floats]:
    """Return a run without people, and the base's true pose at each tick."""
    trial, track = Trial(0, way, [], np.empty((0, 3))), []
    while trial.tick():
        here = trial.base.pose
        track.append((here.x, here.y, here.yaw))
    return trial.result, np.array(track)


def run(seed: int, *, to_the_goal: bool = True) -> Crossing:
    """Run one seed to the goal, or until both have come and gone."""
    trial = Trial(seed, seed % 2, drawn(seed), alone(seed % 2)[1])
    while trial.tick() and (to_the_goal or trial.walks or trial.base.people):
        pass
    return trial.result


def drawn(seed: int) -> list[Walk]:
    """Draw two people."""
    random = np.random.Generator(np.random.PCG64([5, seed]))
    track = alone(seed % 2)[1]
    on = 1.0 if seed % 2 == 0 else -1.0
    ticks = np.arange(round(BEGIN * 100) + 100, len(track) - 50)
    past = on * (track[ticks, 0] - DOOR)
    hidden = bool(random.integers(2))
    first = ticks[(past > BESIDE[0]) & (past < BESIDE[1])] if hidden else ticks[abs(past) < 1.0]
    return [
        _drawn(random, track, first, "from behind the frame" if hidden else "through the doorway"),
        _drawn(random, track, ticks, "across" if random.integers(2) else "towards"),
    ]


def _drawn(random: np.random.Generator, track: Floats, ticks: Ints, kind: str) -> Walk:
    """Draw somebody who comes to where the base is at one of these ticks."""
    while True:
        tick, speed = int(random.choice(ticks)), float(random.uniform(*SPEEDS))
        side, turn = float(random.choice([-1.0, 1.0])), random.uniform(-0.5, 0.5)
        aside = random.uniform(-ASIDE, ASIDE)
        x, y, yaw = track[tick]
        x, y = x - aside * math.sin(yaw), y + aside * math.cos(yaw)
        yaw = {
            "through the doorway": (1.0 - side) * math.pi / 2.0 + turn,
            "from behind the frame": side * math.pi / 2.0 + 0.2 * turn,
            "across": yaw + side * math.pi / 2.0 + turn,
            "towards": yaw + math.pi + turn,
        }[kind]
        c, s = math.cos(yaw), math.sin(yaw)
        back, on = _free(x, y, yaw + math.pi), _free(x, y, yaw)
        if kind == "through the doorway":
            way = (DOOR - x) / c
            if not (-back < way < on and SILLS[0] < y + s * way < SILLS[1]):
                continue
        lead = min(round(100.0 * back / speed), tick)
        back = min(back, speed * lead / 100.0)
        x, y = x - back * c, y - back * s
        there = Pose(*track[tick - lead])
        unseen = math.dist((x, y), (there.x, there.y)) > FAR or _is_hidden(there, x, y)
        if back > 0.5 and on > 0.0 and unseen:
            person = Person(x, y, speed * c, speed * s, RADIUS, (back + on) / speed)
            return Walk(f"{kind} {speed:.2f} m/s", person, tick - lead)


@cache
def _walls() -> Floats:
    corners = np.array(list(scene("office").solids.values())).reshape(-1, 4, 2)
    return np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)


def _free(x: float, y: float, yaw: float) -> float:
    """Return how far somebody can walk [m]."""
    beside = np.linspace(-RADIUS, RADIUS, 7)
    origins = np.stack([x - beside * math.sin(yaw), y + beside * math.cos(yaw)], axis=1)
    return float(cast(_walls(), (), origins, np.full(7, yaw), 6.0).min()) - RADIUS - 0.05


def _is_hidden(here: Pose, x: float, y: float) -> bool:
    """Return whether nothing of somebody is seen from a place."""
    bearing, far = math.atan2(y - here.y, x - here.x), math.dist((x, y), (here.x, here.y))
    half = math.asin(min(RADIUS / far, 1.0))
    angles = np.linspace(bearing - half, bearing + half, 9)
    return bool((cast(_walls(), (), np.full((9, 2), (here.x, here.y)), angles, 9.0) < far - RADIUS).all())
