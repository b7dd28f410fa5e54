"""A limb, and the four values of a brain's step: percept → allowance → plan → commands.

Rules. Each value is frozen and handed on whole: a limb reads what was perceived, and nothing of another
limb's inside. A limb is asked in this order at every step: `perceive`, `allow`, then `objection`,
`accept`, `drop`, `begin` and `stand` as tasks and missions need it, `plan`, `commands`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from brain.belief import Belief, BrainTask, MissionView
from brain.bodies.joint_profile import JointState
from brain.control.motion import FollowedPath, MotionInputs
from brain.health import HealthLevel
from brain.perception.percept import Sight
from brain.settings import BrainSettings
from brain.skills.skill import Intent, Observed
from brain.status import Note
from protocols.messages import Command, Event, Feedback, Nanos


@dataclass(frozen=True, slots=True)
class Percept:
    """What a limb knows at one moment."""

    now: Nanos
    joints: Mapping[str, Feedback] = field(default_factory=dict)
    """The newest position and velocity of each joint that takes targets"""
    sight: Sight | None = None
    """Of a base: pose, map, what moves about it, and how far to trust that"""


@dataclass(frozen=True, slots=True)
class Allowance:
    """Whether a limb may move, how fast, and why not."""

    level: HealthLevel = HealthLevel.OK
    reason: str = ""
    share: float = 1.0
    """Of the largest speeds"""
    missing: str = ""
    """What has never reported"""
    lost: Mapping[str, str] = field(default_factory=dict)
    """Why its joints may not move, by motor, where each is judged by itself"""
    stopped: str = ""
    """Why the gateway has stopped the robot"""
    waiting: str = ""
    """What the first motion of the robot waits for"""

    @property
    def refusal(self) -> str:
        """Why the tasks are dropped, and no other is taken; "" if they may be done."""
        given_up = "" if self.waiting or self.level is not HealthLevel.LOST else self.reason
        return self.stopped or given_up


@dataclass(frozen=True, slots=True)
class Course:
    """The path that a base is to follow."""

    version: int = 0
    """Of the path; another one is followed from its beginning"""
    path: FollowedPath | None = None
    yaw: float | None = None
    """rad, in which it ends"""
    slow: Callable[[float, float], float] | None = None
    """Returns the largest speed [m/s] at a place [m, m]"""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a limb is to do now."""

    busy: bool = False
    """There is something to do."""
    why: str = ""
    """What it does about an obstacle, while all is well"""
    degraded: str = ""
    """Why it does not do it as it should"""
    given_up: str = ""
    """Why the last task was given up"""
    inputs: MotionInputs | None = None
    """The motion of a base; None: control is not due"""
    course: Course = field(default_factory=Course)
    """The path that it follows"""
    targets: Mapping[str, Command] = field(default_factory=dict)
    """What each joint is to do"""
    states: Mapping[str, JointState] = field(default_factory=dict)
    """Where the joints of a planned motion should be"""
    torques: Mapping[str, float] = field(default_factory=dict)
    """The torque that carries the load of each"""


@dataclass(frozen=True, slots=True)
class StepValues:
    """What a step hands on, by limb. A step that is given some hands these on in place of its own: so each
    system can be run alone, on values that another run has made."""

    percepts: Mapping[str, Percept] = field(default_factory=dict)
    allowances: Mapping[str, Allowance] = field(default_factory=dict)
    plans: Mapping[str, Plan] = field(default_factory=dict)
    commands: Sequence[Command] = ()
    """One per motor of the robot"""


class Limb(Protocol):
    """What moves by itself. State is plain data."""

    motors: tuple[str, ...]

    def adopt(self, settings: BrainSettings) -> None:
        """Continue with other settings."""

    def perceive(self, now: Nanos, events: Sequence[Event], given: Percept | None = None) -> Percept:
        """Process the events since the last step; `given`: what is perceived, in place of its own."""

    def allow(self, percept: Percept, *, by_hand: bool) -> Allowance:
        """Return whether it may move; `by_hand`: a person drives, and sees where it is."""

    def objection(self, now: Nanos, task: BrainTask, allowance: Allowance) -> str:
        """Return why a task of an operator cannot be taken, or ""."""

    def accept(self, now: Nanos, task: BrainTask) -> None:
        """Take a task to which there is no objection."""

    def drop(self, now: Nanos, allowance: Allowance) -> None:
        """Drop what it may not do any more."""

    def begin(self, now: Nanos, intent: Intent) -> str:
        """Do what a mission's step wants, as far as it is this limb's; return why not, or ""."""

    def see(self, seen: Observed, percept: Percept, allowance: Allowance) -> Observed:
        """Add what a mission's steps go by."""

    def stand(self, now: Nanos) -> None:
        """End what a mission has begun."""

    def plan(self, percept: Percept, allowance: Allowance, *, running: bool) -> Plan:
        """Return what is to be done: a bounded amount of work."""

    def commands(self, percept: Percept, allowance: Allowance, plan: Plan) -> Sequence[Command]:
        """Return one command for each of its motors."""

    def believe(self, belief: Belief, mission: MissionView | None) -> Belief:
        """Add what observers are shown."""

    def take_notes(self) -> list[Note]:
        """Return the notes for the operator since the last call."""
