"""A skill: all that there is to know of one kind of mission step, as one value.

Rules. How it is written in a mission file and for an operator, what is wrong with it for a robot, its text,
and how it is done. A performer is plain data that `copy.deepcopy` can copy. `advance(seen)` is called at each
step of the brain while the mission runs, and returns what is wanted now, or the outcome, after a bounded
number of operations; `halt()` is called when the mission is paused: what is done stays done, and what is left
goes on later. Time is in `seen`; no clock, no randomness, no file. Nothing here looks for obstacles: goals
are planned, and every twist is limited by the stop zone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar

from brain.belief import Pose
from brain.bodies.body import Base, Placement
from brain.bodies.limbs import Abilities
from brain.bodies.plane import Twist
from brain.reading import Given, Read
from protocols.messages import Command, Feedback, Goal, Nanos

S = TypeVar("S")
FARTHEST = 10_000.0
"""m: largest coordinate and distance"""
LONGEST = 86_400.0
"""s"""


# -- what a performer asks for -------------------------------------------------------------------


class ToolPlace(NamedTuple):
    """Where the tip of an arm is to be brought."""

    at: Placement
    """In the robot's frame"""
    seconds: float = 0.0
    """Time of the motion, if the arm needs no more"""
    limb: str = ""
    """Which arm, of a robot with several"""


class Intent(NamedTuple):
    """What a step asks for now. Nothing at all: to stand still."""

    goal: Goal | None = None
    """To be driven to, from now on"""
    passing: bool = False
    """Whether this goal follows the last without a stop"""
    keep: bool = False
    """Whether the goal given before stays"""
    twist: Twist | None = None
    targets: tuple[Command, ...] = ()
    """New targets of joints"""
    seconds: float = 0.0
    """Time in which their positions are to be reached"""
    place: ToolPlace | None = None


STAND = Intent()


@dataclass(frozen=True, slots=True)
class Done:
    """The step is done; in words, what came of it."""

    text: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """The step has failed, and why."""

    reason: str


Result: TypeAlias = Intent | Done | Failed


# -- what it goes by -----------------------------------------------------------------------------


class Tally(NamedTuple):
    """How many have ended, and how the last did."""

    number: int = 0
    why: str = ""
    """Why it was given up; "" if it was reached"""


NONE_ENDED = Tally()


@dataclass(frozen=True, slots=True)
class Observed:
    """What the steps go by."""

    now: Nanos
    body: Base | None = None
    pose: Pose | None = None
    """None for bare joints"""
    linear: float = 0.0
    """m/s of the origin, as estimated"""
    angular: float = 0.0
    """rad/s, as estimated"""
    free: bool = True
    """Whether the base may move now"""
    obstructed: str = ""
    """Why it stands, if an obstacle is in its way"""
    goals: Tally = NONE_ENDED
    """Goals that have ended"""
    places: Mapping[str, Tally] = field(default_factory=dict)
    """Places that have ended, for the tip of each arm"""
    joints: Mapping[str, Feedback] | None = None
    """The newest of each joint"""
    marker: Callable[[int], Pose | None] = lambda _: None
    """Returns the pose of a marker on the map, its x axis out of its face"""


class Performer(Protocol):
    """Does one step."""

    def advance(self, seen: Observed) -> Result:
        """Return what is wanted now, or the outcome."""

    def halt(self) -> None:
        """Be ready to go on after a pause."""


# -- a skill -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Words(Generic[S]):
    """How an operator asks for it: a command whose words make the step."""

    usage: str
    summary: str
    parse: Callable[[list[str], Abilities], S]
    """Raises InvalidError."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Skill(Generic[S]):
    """One kind of step."""

    name: str
    """Its key in a mission file, and the name of its entry point"""
    title: str = ""
    """What an operator calls it, if not by that name"""
    step: type[S]
    """A frozen dataclass of numbers, texts, truth values, None, and tuples of these"""
    own: Read
    """Reads the value of its own key."""
    keys: Mapping[str, Read] = field(default_factory=dict)
    """Reads the values of further keys, which may be missing."""
    make: Callable[[Given], S]
    """Makes the step of all that were given."""
    words: Words[S] | None = None
    needs_base: bool = False
    wrong: Callable[[S, Abilities], str] = lambda *_: ""
    """Returns what is wrong with a step for a robot, "" if nothing is."""
    text: Callable[[S], str]
    """Returns a step in words."""
    motors: Callable[[S], tuple[str, ...]] = lambda _: ()
    """Returns the joints to which a step gives targets."""
    perform: Callable[[S], Performer]
    """Returns what does a step."""

    @property
    def called(self) -> str:
        """What a person calls it."""
        return self.title or self.name


def too_long(span: float) -> str:
    """Return what is wrong with a time [s], "" if nothing is."""
    return "" if 0.0 <= span <= LONGEST else f"its time must be from 0 to {LONGEST:g} s, not {span:g}"


def too_far(*points: tuple[float, float]) -> str:
    """Return which point is beyond what a robot may be sent to, "" if none is."""
    far = next((point for point in points if not all(abs(part) <= FARTHEST for part in point)), None)
    return "" if far is None else f"({far[0]:g}, {far[1]:g}) is beyond {FARTHEST:g} m"
