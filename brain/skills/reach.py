"""`joints = {lift = 0.2}`: give joints targets, all at once: to be reached, or until they are held up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from brain import reading
from brain.bodies.limbs import Abilities
from brain.checks import objection
from brain.skills.skill import STAND, Done, Failed, Intent, Observed, Result, Skill, too_long
from protocols import messages as msg
from protocols.messages import SECOND, Command, Feedback, Nanos, Reach

POSITION_TOLERANCE, STANDING = 0.03, 0.03
"""rad and rad/s: a joint that is so near its target, and so slow, has reached it"""
HELD_UP: Nanos = 300_000_000
"""A joint that stands for this long, and has not reached its target, is in contact."""
LOOKED: Nanos = 100_000_000
"""Where no velocity is reported, it is that of the position over this time."""
UNTIL_REACHED: Nanos = 5 * SECOND
"""How long a joint may take beyond the time given"""


@dataclass(slots=True)
class _Reaching:
    reach: Reach
    since: Nanos | None = None
    standing: dict[str, Nanos] | None = None
    """Since when each joint stands"""
    places: dict[str, tuple[Nanos, float]] = field(default_factory=dict)
    """Where each joint was a moment ago, of those that report no velocity"""

    def advance(self, seen: Observed) -> Result:
        reach, joints = self.reach, seen.joints or {}
        if self.since is None:
            self.since, self.standing = seen.now, {}
            return Intent(targets=reach.targets, seconds=reach.seconds)
        assert self.standing is not None
        spent = seen.now - self.since
        for target in reach.targets:
            if self._stands(seen.now, joints.get(target.motor), stood=target.motor in self.standing):
                self.standing.setdefault(target.motor, seen.now)
            else:
                self.standing.pop(target.motor, None)
        open_ = [target for target in reach.targets if self._is_open(target, seen, joints)]
        if not open_ and spent >= round(reach.seconds * SECOND) * (not reach.contact):
            held = ", ".join(f"{t.motor} at {_position(joints, t.motor)}" for t in reach.targets)
            return Done(f"{'held up: ' if reach.contact else ''}{held}")
        if spent < round(reach.seconds * SECOND) + UNTIL_REACHED:
            return STAND
        if reach.contact:
            return Failed(f"{open_[0].motor} met nothing: it is at {_position(joints, open_[0].motor)}")
        where = _position(joints, open_[0].motor)
        return Failed(f"{open_[0].motor} stands at {where}, not at its target")

    def _stands(self, now: Nanos, joint: Feedback | None, *, stood: bool) -> bool:
        """Return whether a joint stands; `stood`: whether it did before."""
        if joint is None or joint.velocity is not None:
            return joint is not None and joint.velocity is not None and abs(joint.velocity) < STANDING
        if joint.position is None:
            return False
        at, place = self.places.setdefault(joint.motor, (now, joint.position))
        if now - at < LOOKED:
            return stood
        self.places[joint.motor] = now, joint.position
        return abs(joint.position - place) < STANDING * (now - at) / SECOND

    def _is_open(self, target: Command, seen: Observed, joints: Mapping[str, Feedback]) -> bool:
        """Return whether a joint is still to do what it should."""
        since = (self.standing or {}).get(target.motor)
        position = joints[target.motor].position if target.motor in joints else None
        there = (
            isinstance(target, msg.Position)
            and position is not None
            and abs(position - target.position) < POSITION_TOLERANCE
        )
        if self.reach.contact:
            assert self.since is not None
            return there or since is None or seen.now - max(since, self.since + HELD_UP) < HELD_UP
        return isinstance(target, msg.Position) and (not there or since is None)

    def halt(self) -> None:
        self.since = None


def _position(joints: Mapping[str, Feedback], motor: str) -> str:
    position = joints[motor].position if motor in joints else None
    return "an unknown position" if position is None else f"{position:.3f} rad"


# -- as it is written ----------------------------------------------------------------------------


KINDS: dict[str, type[Command]] = {
    "position": msg.Position,
    "velocity": msg.Velocity,
    "torque": msg.Torque,
}
"""A target by its first key; more of its fields may follow. With `stiffness` it is an Impedance."""


def _targets(value: object) -> tuple[Command, ...]:
    if not isinstance(value, dict) or not value:
        raise reading.InvalidError("targets by joint: {lift = 0.2}")
    return tuple(_target(motor, each) for motor, each in value.items())


def _target(motor: str, value: object) -> Command:
    if value in ("hold", "idle"):
        return msg.Hold(motor) if value == "hold" else msg.Idle(motor)
    if not isinstance(value, dict):
        return msg.Position(motor, reading.number(value))
    kinds = [KINDS[key] for key in KINDS if key in value]
    kind: type[Command] = msg.Impedance if "stiffness" in value else kinds[0] if kinds else msg.Position
    names = [field.name for field in fields(kind) if field.name != "motor"]
    wrong = [key for key in value if key not in names]
    given = {key: reading.number(each) for key, each in value.items() if key in names}
    if kind is msg.Impedance:
        given = dict.fromkeys(("velocity", "torque", "damping"), 0.0) | given
    required = names if kind is msg.Impedance else names[:1]
    if wrong or not all(name in given for name in required):
        raise reading.InvalidError(f"for {motor}: a number (rad), or {', '.join(names)}")
    return kind(motor, **given)


def _wrong(step: Reach, able: Abilities) -> str:
    if not step.targets:
        return "there are no targets"
    if wrong := too_long(step.seconds):
        return wrong
    names = [target.motor for target in step.targets]
    if len(set(names)) < len(names):
        return "a joint has two targets"
    return next((wrong for target in step.targets if (wrong := wrong_target(target, able))), "")


def wrong_target(target: Command, able: Abilities) -> str:
    """Return why a robot's joint cannot take a target, "" if it can."""
    if target.motor not in able.joints:
        there = f"there are {', '.join(able.joints)}" if able.joints else "there are none"
        return f"{target.motor!r} is no joint that takes a target; {there}"
    wrong = objection(target)
    takes = able.takes.get(target.motor, (type(target),))
    planned = isinstance(target, msg.Position) and able.arm_of(target.motor) is not None
    if not wrong and not planned and type(target) not in takes:
        can = ", ".join(sorted(each.__name__ for each in takes))
        wrong = f"it takes no {type(target).__name__}, but {can}"
    return f"{target.motor}: {wrong}" if wrong else ""


skill = Skill(
    name="joints",
    step=Reach,
    own=_targets,
    keys={"seconds": reading.number, "contact": reading.flag},
    make=lambda given: Reach(given["joints"], given.get("seconds", 0.0), given.get("contact", False)),
    wrong=_wrong,
    text=lambda step: f"{'close' if step.contact else 'move'} {', '.join(t.motor for t in step.targets)}",
    motors=lambda step: tuple(target.motor for target in step.targets),
    perform=_Reaching,
)
