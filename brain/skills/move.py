"""`drive = 0.3`: drive at a speed [m/s], straight or on an arc, for a time or a distance, by the estimate."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import degrees, hypot

from brain import reading
from brain.bodies.body import Base
from brain.bodies.limbs import Abilities
from brain.bodies.plane import Twist, wrap
from brain.skills.measured import (
    CREEP,
    HEADING_GAIN,
    LENGTH_TOLERANCE,
    REST,
    REST_TURN,
    MotionProgress,
    ending,
)
from brain.skills.skill import FARTHEST, LONGEST, STAND, Done, Failed, Intent, Observed, Result, Skill, Words
from protocols.messages import Move, Nanos, seconds

HEADING_MOST = 0.3
"""rad/s: with which a straight motion keeps its heading, at most"""
DEFAULT_SPEED = 0.2
"""m/s, of a motion whose speed an operator does not give"""


@dataclass(slots=True)
class _Moving:
    move: Move
    progress: MotionProgress = field(default_factory=MotionProgress)
    heading: float | None = None
    """rad, of a straight motion"""
    spent: float = 0.0
    """s in motion"""
    at: Nanos | None = None
    ending: bool = False

    def advance(self, seen: Observed) -> Result:
        move, pose = self.move, seen.pose
        assert pose is not None
        assert seen.body is not None
        speed = hypot(move.linear, move.lateral)
        scale = speed or 1.0
        self.progress.add(
            seen, lambda d, t, s: (d * move.linear + s * move.lateral) / scale if speed else abs(t)
        )
        if seen.free and self.at is not None:
            self.spent += seconds(seen.now - self.at)
        self.at = seen.now
        self.heading = pose.yaw if self.heading is None else self.heading
        left = None if move.distance is None else move.distance - self.progress.so_far
        over = move.seconds is not None and self.spent >= move.seconds
        self.ending = self.ending or over or (left is not None and left <= LENGTH_TOLERANCE)
        if self.ending:
            if seen.linear > REST or abs(seen.angular) > REST_TURN:
                return STAND
            covered = f"{self.progress.so_far:.2f} m" if speed else f"{degrees(self.progress.so_far):.0f}°"
            return Done(f"{covered} in {self.spent:.1f} s")
        if why := self.progress.stuck(seen):
            return Failed(why)
        share = 1.0
        if left is not None and speed:
            share = min(1.0, max(ending(left, seen.body.max_linear_acceleration), CREEP) / speed)
        twist = Twist(move.linear, move.angular, move.lateral).scaled(share)
        if not move.angular:
            keep = HEADING_GAIN * wrap(self.heading - pose.yaw)
            twist = twist._replace(angular=max(-HEADING_MOST, min(HEADING_MOST, keep)))
        return Intent(twist=twist)

    def halt(self) -> None:
        self.progress.halt()
        self.heading = self.at = None


def _make(given: reading.Given) -> Move:
    left, turn = given.get("left", 0.0), given.get("turn_deg", 0.0)
    return Move(given["drive"], left, turn, given.get("seconds"), given.get("distance"))


def _parse(texts: list[str], able: Abilities) -> Move:
    words = [word for word in reading.joined(texts) if word not in ("for", "at")]
    sides = [word for word in words if word in ("left", "right")]
    words = [word for word in words if word not in sides]
    given: dict[str, float] = {}
    for word in words:
        kind = "speed" if word.endswith("m/s") else "seconds" if word.endswith("s") else "distance"
        if not word.endswith(("m/s", "s", "m")):
            kind = "speed" if "speed" not in given and len(words) > 1 else kind
        if kind in given:
            raise reading.InvalidError(f"there are two of what {word!r} is")
        given[kind] = reading.quantity_of(word, ("m/s", "m", "s"))
    distance, span, base = given.get("distance"), given.get("seconds"), able.base
    assert base is not None, "it is a base's"
    most = (sides and base.max_lateral) or base.max_linear
    speed = given.get("speed", min(DEFAULT_SPEED, most))
    if distance is not None and distance < 0.0:
        speed, distance = -speed, -distance
    side = {"left": 1.0, "right": -1.0}[sides[0]] if sides else 0.0
    linear, lateral = (0.0, side * speed) if side else (speed, 0.0)
    return Move(linear, lateral, 0.0, span, distance)


def _wrong(move: Move, able: Abilities) -> str:
    base = able.base
    assert base is not None, "it is a base's"
    if move.seconds is None and move.distance is None:
        return "a motion needs a time or a distance"
    if move.distance is not None and not (move.linear or move.lateral):
        return "a distance needs a speed"
    if not (move.linear or move.lateral or move.angular):
        return "a motion needs a speed; to stand, wait"
    if move.lateral and not base.moves_sideways:
        return "this base does not move sideways"
    if move.angular and base.turning_radius and abs(move.linear) < base.turning_radius * abs(move.angular):
        return f"this base turns with a radius of {base.turning_radius:g} m at least"
    if fast := _too_fast(move, base):
        return fast
    if not 0.0 <= (move.seconds or 0.0) <= LONGEST or not 0.0 <= (move.distance or 0.0) <= FARTHEST:
        return f"its time must be from 0 to {LONGEST:g} s, and its distance from 0 to {FARTHEST:g} m"
    return ""


def _too_fast(move: Move, base: Base) -> str:
    able = (base.max_linear, base.max_lateral or base.max_linear, base.max_angular)
    asked = (("linear", move.linear), ("lateral", move.lateral), ("angular", move.angular))
    for (name, value), most in zip(asked, able, strict=True):
        if abs(value) > most + 1e-9:
            return f"its {name} speed, {value:g}, is beyond this base's {most:g}"
    return ""


def _text(move: Move) -> str:
    linear, lateral, angular = move.linear, move.lateral, move.angular
    speeds = [f"{linear:g} m/s"] if linear or not (lateral or angular) else []
    speeds += [f"{abs(lateral):g} m/s to the {'left' if lateral > 0 else 'right'}"] if lateral else []
    speeds += [f"{degrees(angular):.0f}°/s"] if angular else []
    length = [f"{move.distance:g} m"] if move.distance is not None else []
    length += [f"{move.seconds:g} s"] if move.seconds is not None else []
    return f"drive {', '.join(speeds)} for {' or '.join(length)}"


skill = Skill(
    name="drive",
    title="move",
    step=Move,
    own=reading.number,
    keys={
        "left": reading.number,
        "turn_deg": reading.degrees,
        "seconds": reading.number,
        "distance": reading.number,
    },
    make=_make,
    words=Words(
        "[left|right] [SPEED] [for SECONDS s | METRES m]",
        "drive straight: move 2 m, move 0.3 for 2 m, move -0.2 for 3 s",
        _parse,
    ),
    needs_base=True,
    wrong=_wrong,
    text=_text,
    perform=_Moving,
)
