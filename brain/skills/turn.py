"""`turn_deg = 30`: turn by an angle, on the spot or on the narrowest circle, by the estimate."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import copysign, degrees

from brain import reading
from brain.bodies.body import Base
from brain.bodies.limbs import Abilities
from brain.bodies.plane import Twist
from brain.skills.measured import CREEP_TURN, REST, REST_TURN, MotionProgress, ending
from brain.skills.skill import STAND, Done, Failed, Intent, Observed, Result, Skill, Words
from protocols.messages import Turn

ANGLE_TOLERANCE = 0.01
"""rad, of a measured motion"""


@dataclass(slots=True)
class Turning:
    """Turns by an angle [rad]."""

    turn: Turn
    progress: MotionProgress = field(default_factory=MotionProgress)

    def advance(self, seen: Observed) -> Result:
        """Turn what is left."""
        body, angle = seen.body, self.turn.angle
        way = copysign(1.0, angle)
        assert body is not None
        self.progress.add(seen, lambda _, turn, __: way * turn)
        left = abs(angle) - self.progress.so_far
        if abs(left) <= ANGLE_TOLERANCE:
            if abs(seen.angular) > REST_TURN or seen.linear > REST:
                return STAND
            return Done(f"turned {degrees(way * self.progress.so_far):.1f}°")
        if why := self.progress.stuck(seen):
            return Failed(why)
        return Intent(twist=_twist(body, way * left))

    def halt(self) -> None:
        """Be ready to go on after a pause."""
        self.progress.halt()


def _twist(body: Base, left: float) -> Twist:
    """Return the twist for the rest of a turn [rad]: on the spot, or on the narrowest circle, forward."""
    radius = 1.05 * body.turning_radius
    most, acceleration = body.max_angular, body.max_angular_acceleration
    if radius > 0.0:
        most = min(most, body.max_linear / radius)
        acceleration = min(acceleration, body.max_linear_acceleration / radius)
    rate = min(most, max(ending(abs(left), acceleration), CREEP_TURN))
    return Twist(rate * radius, copysign(rate, left))


def _parse(texts: list[str], _: Abilities) -> Turn:
    words = reading.joined(texts)
    side = {"left": 1.0, "right": -1.0}.get(words[0], 0.0) if words else 0.0
    words = words[1:] if side else words
    if len(words) != 1:
        raise reading.InvalidError("one angle is needed")
    return Turn((side or 1.0) * reading.angle_of(words[0]))


skill = Skill(
    name="turn_deg",
    title="turn",
    step=Turn,
    own=reading.degrees,
    make=lambda given: Turn(given["turn_deg"]),
    words=Words("[left|right] ANGLE", "turn on the spot [degrees]", _parse),
    needs_base=True,
    wrong=lambda step, _: "" if abs(step.angle) <= 1000.0 else "an angle beyond 1000 rad",
    text=lambda step: f"turn {abs(degrees(step.angle)):.0f}° to the {'left' if step.angle >= 0 else 'right'}",
    perform=Turning,
)
