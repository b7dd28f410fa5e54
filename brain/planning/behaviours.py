"""What planning does about a goal: a table of states, what leads from one to another, and why.

Rules. `STATES` lists for each state what is looked for, in this order, and the state that follows; the first
that is true counts. A base that can get no further waits and keeps its goal. Meanwhile it looks around: it
turns a little to both sides, so that its beams sweep what lies between them, and sees a door that has opened.
Where it is stuck before an obstacle it backs off a little, if it knows the ground behind, and plans again; at
most `tries` times for a goal. Someone who crosses its path is waited for; who stands is driven around.
The goal is given up, with the reason, after `planner.patience` without progress. Every motion here is limited
by the stop zone like any other.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum
from math import copysign
from typing import Annotated

from brain.bodies.body import Base
from brain.bodies.plane import Twist, wrap
from protocols.bounds import Bounds, Duration, check
from protocols.messages import SECOND, Nanos

LOOK_RATE = 0.4
"""rad/s of looking around"""
BACK_SPEED = 0.1
"""m/s"""
LOOK_GAIN = 3.0
"""1/s: how the last of a look is turned"""
LOOKED = 0.03
"""rad off the direction that was to be looked in"""
MOTION_TIMEOUT: Nanos = 6 * SECOND
"""A look or a retreat that takes longer ends where it is."""


@dataclass(frozen=True, slots=True)
class BehaviourSettings:
    """What is done while there is no way."""

    look_after: Annotated[Duration, Bounds(200.0, 60_000.0)] = 4 * SECOND
    """Waiting before a look around, and between two"""
    look: Annotated[float, Bounds(0.0, 3.0, "rad")] = 0.26
    """rad, to each side; 0: none"""
    stuck_after: Annotated[Duration, Bounds(200.0, 60_000.0)] = 3 * SECOND
    """Standing before an obstacle, on a path that is free by the map, before backing off"""
    back: Annotated[float, Bounds(0.0, 1.0, "m")] = 0.2
    """m; 0: none"""
    tries: Annotated[int, Bounds(0, 20)] = 2
    """How often it backs off for one goal"""
    crossing: Annotated[Duration, Bounds(0.0, 60_000.0)] = 5 * SECOND
    """How long someone in motion on the path is waited for"""

    def __post_init__(self) -> None:
        check(self)


class BehaviourState(StrEnum):
    """What planning does."""

    IDLE = "idle"
    PLANNING = "planning"
    FOLLOWING = "following"
    """A path to the goal"""
    EXPLORING = "exploring"
    """A path to where the goal may become reachable"""
    YIELDING = "yielding"
    """Standing, with a path: someone crosses it"""
    WAITING = "waiting"
    """Standing: there is no way now"""
    LOOKING = "looking"
    """Turning to see whether there is one"""
    BACKING = "backing off"
    GIVEN_UP = "given up"


class Fact(StrEnum):
    """What is looked for."""

    GOAL = "there is a goal"
    NO_GOAL = "there is no goal"
    PATH = "a path"
    FRONTIER = "a path to a frontier"
    NO_PATH = "the path is obstructed"
    NO_WAY = "no way"
    CROSSING = "someone crosses the path"
    CLEAR = "the crossing is clear"
    STUCK = "stuck before an obstacle"
    STUCK_HERE = "stuck, with no room to back off"
    TIME_TO_LOOK = "time to look"
    MOVED = "the motion is over"
    IMPATIENT = "patience is over"


_PATHS = ((Fact.FRONTIER, BehaviourState.EXPLORING), (Fact.PATH, BehaviourState.FOLLOWING))
_ON_A_PATH = (
    (Fact.NO_GOAL, BehaviourState.IDLE),
    (Fact.IMPATIENT, BehaviourState.GIVEN_UP),
    (Fact.NO_WAY, BehaviourState.WAITING),
    (Fact.NO_PATH, BehaviourState.PLANNING),
    (Fact.CROSSING, BehaviourState.YIELDING),
    (Fact.STUCK, BehaviourState.BACKING),
    (Fact.STUCK_HERE, BehaviourState.LOOKING),
)
STATES: dict[BehaviourState, tuple[tuple[Fact, BehaviourState], ...]] = {
    BehaviourState.IDLE: ((Fact.GOAL, BehaviourState.PLANNING),),
    BehaviourState.PLANNING: (
        (Fact.NO_GOAL, BehaviourState.IDLE),
        (Fact.IMPATIENT, BehaviourState.GIVEN_UP),
        *_PATHS,
        (Fact.NO_WAY, BehaviourState.WAITING),
    ),
    BehaviourState.FOLLOWING: (*_ON_A_PATH, (Fact.FRONTIER, BehaviourState.EXPLORING)),
    BehaviourState.EXPLORING: (*_ON_A_PATH, (Fact.PATH, BehaviourState.FOLLOWING)),
    BehaviourState.YIELDING: (
        (Fact.NO_GOAL, BehaviourState.IDLE),
        (Fact.NO_PATH, BehaviourState.PLANNING),
        (Fact.CLEAR, BehaviourState.PLANNING),
    ),
    BehaviourState.WAITING: (
        (Fact.NO_GOAL, BehaviourState.IDLE),
        *_PATHS,
        (Fact.IMPATIENT, BehaviourState.GIVEN_UP),
        (Fact.TIME_TO_LOOK, BehaviourState.LOOKING),
    ),
    BehaviourState.LOOKING: (
        (Fact.NO_GOAL, BehaviourState.IDLE),
        (Fact.MOVED, BehaviourState.PLANNING),
        (Fact.IMPATIENT, BehaviourState.GIVEN_UP),
    ),
    BehaviourState.BACKING: (
        (Fact.NO_GOAL, BehaviourState.IDLE),
        (Fact.MOVED, BehaviourState.PLANNING),
        (Fact.IMPATIENT, BehaviourState.GIVEN_UP),
    ),
    BehaviourState.GIVEN_UP: ((Fact.GOAL, BehaviourState.PLANNING),),
}


class Behaviour:
    """The state of planning. Plain data."""

    def __init__(self) -> None:
        self.state = BehaviourState.IDLE
        self.reason = ""
        self.since: Nanos = 0
        """When the state was entered."""
        self.tried = 0
        """How often the base has backed off for this goal."""
        self._heading = 0.0
        """rad, before looking around"""
        self._side = 0
        self._covered = 0.0
        """m backed off"""
        self._last: tuple[float, float] | None = None

    def update(self, now: Nanos, facts: Collection[Fact], reason: str) -> bool:
        """Go to the state that follows from the facts, for a reason; return whether it is another one."""
        for fact, after in STATES[self.state]:
            if fact in facts:
                if after is BehaviourState.IDLE or self.state in (
                    BehaviourState.IDLE,
                    BehaviourState.GIVEN_UP,
                ):
                    self.tried = 0
                self.tried += after is BehaviourState.BACKING
                self.state, self.reason, self.since = after, reason or fact.value, now
                self._side, self._covered, self._last = 0, 0.0, None
                return True
        return False

    def motion(
        self, now: Nanos, here: tuple[float, float], yaw: float, body: Base, settings: BehaviourSettings
    ) -> tuple[Twist | None, bool]:
        """Return the twist of this state, None for that of the path, and whether the motion is over."""
        late = now - self.since > MOTION_TIMEOUT
        if self.state is BehaviourState.YIELDING:
            return Twist(), False
        if self.state is BehaviourState.LOOKING:
            return self._look(yaw, body, settings, late=late)
        if self.state is not BehaviourState.BACKING:
            return None, False
        if self._last is not None:
            dx, dy = here[0] - self._last[0], here[1] - self._last[1]
            self._covered += (dx * dx + dy * dy) ** 0.5
        self._last = here
        left = settings.back - self._covered
        if left <= 0.0 or late:
            return Twist(), True
        return Twist(-min(BACK_SPEED, body.max_linear)), False

    def _look(
        self, yaw: float, body: Base, settings: BehaviourSettings, *, late: bool
    ) -> tuple[Twist | None, bool]:
        """Turn to the left, to the right, and back."""
        if body.turning_radius > 0.0 or not settings.look:
            return Twist(), True
        if self._last is None:
            self._heading, self._last = yaw, (0.0, 0.0)
        sides = (settings.look, -settings.look, 0.0)
        while self._side < len(sides):
            left = wrap(self._heading + sides[self._side] - yaw)
            if abs(left) > LOOKED and not late:
                rate = min(LOOK_RATE, body.max_angular, max(LOOK_GAIN * abs(left), 0.1))
                return Twist(0.0, copysign(rate, left)), False
            self._side += 1
        return Twist(), True
