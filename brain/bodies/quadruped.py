"""A base on four legs of three joints: hip (abduction), thigh and knee.

Rules. It trots (`trot`) at any twist, and stands at rest. The joints are springs about the set-points of
their legs (`leg`), with the torques that carry the weight fed forward: the transposed Jacobian times the
share of the weight (Lynch and Park 2017, section 5.2). From any posture on its belly it first folds its legs,
then rises; the twist counts from then on. It knows nothing of its attitude: the floor must be even, and it
does not right itself.

Its motion is measured by the feet on the floor, which are the lower two diagonal ones: the rigid motion in
the plane that fits them best. A spherical foot rolls on the floor while its shank turns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from brain.bodies import urdf
from brain.bodies.body import Base, Setpoint, Travel
from brain.bodies.leg import Leg, Point
from brain.bodies.parts import UPRIGHT, Part
from brain.bodies.plane import REST, Twist
from brain.bodies.trot import Foot, Gait, Plane, Rhythm
from brain.bodies.urdf import Geometry, Origin
from protocols import messages as msg
from protocols.bounds import Bounds, Invalid
from protocols.messages import Command

GRAVITY = 9.81
FOLDING = 0.5
"""rad/s, mean speed of the joint that has the longest way while the legs are folded."""
ALIKE = 1e-6
"""m by which a measure may differ from leg to leg."""
SLOWEST, SLOWEST_TURN = 0.003, 0.01
"""m/s and rad/s: at less it stands."""
SHORTEST = 0.1
"""s, of each part of standing up."""
LEVEL = 0.001
"""m: two diagonal feet that are higher than the other two by this count e times less."""
ROLLING = 6
"""Iterations in which a foot's centre is found from where it should touch the floor: each is right to a tenth
(the foot's radius by the leg's length) of what the one before was wrong."""
FORE, SIDE = (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, 1.0, -1.0)
"""Signs of x and y of front left, front right, rear left, rear right."""


class Rise(NamedTuple):
    """On the way from any posture to standing."""

    start: tuple[float, ...]
    """rad, of the joints"""
    low: float
    """m, the height at which the feet come below their hips before the body is lifted"""
    fold: float
    """s until then"""
    lift: float
    """s of the lifting"""
    t: float = 0.0
    """s since it began"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Quadruped(Base):
    """Its origin is between the four hips; angles are positive by the right hand about x and y."""

    kind: ClassVar[str] = "quadruped"
    front_left: tuple[str, str, str]
    """Motors of hip, thigh and knee"""
    front_right: tuple[str, str, str]
    """Motors of hip, thigh and knee"""
    rear_left: tuple[str, str, str]
    """Motors of hip, thigh and knee"""
    rear_right: tuple[str, str, str]
    """Motors of hip, thigh and knee"""
    hip_x: Annotated[float, Bounds(0.01, 2.0, "m")]
    """m, of the hips before and behind the origin"""
    hip_y: Annotated[float, Bounds(0.0, 2.0, "m")]
    """m, of the hips beside it"""
    offset: Annotated[float, Bounds(0.0, 1.0, "m")]
    """m, from a hip's axis outward to the leg's plane"""
    thigh: Annotated[float, Bounds(0.01, 2.0, "m")]
    shank: Annotated[float, Bounds(0.01, 2.0, "m")]
    """m, from the knee to the foot's centre"""
    foot_radius: Annotated[float, Bounds(0.0, 0.2, "m")] = 0.02
    knees: Literal["backward", "forward"] = "backward"
    """Where they point"""
    mass: Annotated[float, Bounds(0.1, 1000.0, "kg")]
    """kg, of all"""
    height: Annotated[float, Bounds(0.01, 4.0, "m")]
    """m, of the origin above the feet's centres, standing"""
    lying_height: Annotated[float, Bounds(0.001, 4.0, "m")] = 0.08
    """m, likewise on its belly with folded legs"""
    rise_time: Annotated[float, Bounds(0.2, 10.0, "s")] = 1.0
    """s, from there to standing"""
    period: Annotated[float, Bounds(0.1, 5.0, "s")] = 0.4
    """s, of the trot"""
    stance: Annotated[float, Bounds(0.5, 0.9)] = 0.6
    """Share of the period for which a foot is on the floor"""
    lift: Annotated[float, Bounds(0.001, 0.5, "m")] = 0.05
    """m, of a foot that swings"""
    stiffness: Annotated[float, Bounds(0.1, 1e4, "N·m/rad")] = 60.0
    """N·m/rad, of each joint"""
    damping: Annotated[float, Bounds(0.001, 1e3, "N·m·s/rad")] = 2.0

    def __post_init__(self) -> None:
        Base.__post_init__(self)
        highest = 0.98 * (self.thigh + self.shank)
        if not self.lying_height < self.height <= highest:
            text = f"height must be above lying_height, and at most {highest:g}: the leg's length"
            raise Invalid(("height", text))

    @classmethod
    def motor_keys(cls) -> tuple[str, ...]:
        """Return the keys of the legs."""
        return "front_left", "front_right", "rear_left", "rear_right"

    @classmethod
    def from_urdf(cls, text: str, joints: Mapping[str, str], table: Mapping[str, Any]) -> dict[str, Any]:
        """Return the lengths, the feet's radius and the mass."""
        legs = [table.get(key) for key in cls.motor_keys()]
        if not all(isinstance(leg, list) and len(leg) == 3 for leg in legs):
            return {}
        model = urdf.parse(text)
        for motor in (motor for leg in legs for motor in leg or ()):
            if motor not in joints:
                raise ValueError(f"{motor!r} moves no joint of it")
        found = [_measured(model, [joints[motor] for motor in leg or ()]) for leg in legs]
        if any(
            abs(a - b) > ALIKE for one in found for a, b in zip(one.values(), found[0].values(), strict=True)
        ):
            raise ValueError("its legs differ")
        inertial = [link.inertial for link in model.links.values()]
        return {**found[0], "mass": sum(one.mass for one in inertial if one)}

    @property
    def joints(self) -> tuple[str, ...]:
        """The motors, leg by leg."""
        return (*self.front_left, *self.front_right, *self.rear_left, *self.rear_right)

    @property
    def moves_sideways(self) -> bool:
        """It does."""
        return True

    @property
    def rests_idle(self) -> bool:
        """It does not: without torque it falls."""
        return False

    @property
    def top_speeds(self) -> tuple[float, ...]:
        """No bound but the joints' own."""
        return (math.inf,) * 12

    @property
    def rolling(self) -> tuple[float, ...]:
        """What the body moves per rad of a thigh [m/rad], half of whose motion is on the floor."""
        return (0.0, 0.5 * self.height, 0.0) * 4

    def parts(self) -> list[Part]:
        """Return its trunk and its legs, as bars of its dimensions."""
        thick, long = 0.15 * self.thigh, 2.0 * self.hip_x + 0.4 * self.thigh
        trunk = Geometry("box", (long, 2.0 * self.hip_y + thick, 0.5 * self.thigh), UPRIGHT)
        parts = [Part(-1, UPRIGHT, (trunk,))]
        for number, leg in enumerate((self.front_left, self.front_right, self.rear_left, self.rear_right)):
            hip, thigh, knee = leg
            at = Origin((FORE[number] * self.hip_x, SIDE[number] * self.hip_y, 0.0))
            aside, below = Origin((0.0, SIDE[number] * self.offset, 0.0)), Origin((0.0, 0.0, -self.thigh))
            first, foot = len(parts), Origin((0.0, 0.0, -self.shank))
            ball = Geometry("sphere", (max(self.foot_radius, 0.5 * thick),), foot)
            parts += [
                Part(0, at, (Geometry("sphere", (thick,), UPRIGHT),), hip, (1.0, 0.0, 0.0)),
                Part(first, aside, (_bar(self.thigh, thick),), thigh, (0.0, 1.0, 0.0)),
                Part(first + 1, below, (_bar(self.shank, 0.7 * thick), ball), knee, (0.0, 1.0, 0.0)),
            ]
        return parts

    # -- legs ------------------------------------------------------------------------------------

    def leg(self, number: int) -> Leg:
        """Return a leg's kinematics, about its hip."""
        bend = 1.0 if self.knees == "forward" else -1.0
        return Leg(SIDE[number] * self.offset, self.thigh, self.shank, bend)

    def _homes(self) -> tuple[Plane, ...]:
        """Return where the feet stand: straight below the thighs' joints."""
        aside = self.hip_y + self.offset
        return tuple((fore * self.hip_x, side * aside) for fore, side in zip(FORE, SIDE, strict=True))

    def _command(
        self, number: int, foot: Point, velocity: Point, load: float
    ) -> tuple[Command, Command, Command]:
        """Return the springs that hold a foot there [m], moving [m/s], under a load [N]."""
        leg, radius = self.leg(number), self.foot_radius
        x, y, z = foot[0] - FORE[number] * self.hip_x, foot[1] - SIDE[number] * self.hip_y, foot[2]
        angles = home = leg.angles((0.0, leg.offset, -self.height))
        for _ in range(ROLLING):
            pitch = angles[1] + angles[2] - home[1] - home[2]
            angles = leg.angles((x + radius * pitch, y - radius * angles[0], z))
        rates = (0.0, 0.0, 0.0)
        for _ in range(ROLLING):
            along, across = velocity[0] + radius * (rates[1] + rates[2]), velocity[1] - radius * rates[0]
            rates = leg.rates(angles, (along, across, velocity[2]))
        columns = leg.jacobian(angles)
        a, b, c = (
            msg.Impedance(motor, angle, rate, -load * column[2], self.stiffness, self.damping)
            for motor, angle, rate, column in zip(
                self.joints[3 * number : 3 * number + 3], angles, rates, columns, strict=True
            )
        )
        return a, b, c

    def _standing(self, height: float, speed: float, load: float) -> tuple[Command, ...]:
        """Return the commands of all legs at home, at a height [m] that grows at a speed [m/s]."""
        return tuple(
            command
            for number, home in enumerate(self._homes())
            for command in self._command(number, (*home, -height), (0.0, 0.0, -speed), load)
        )

    def inverse(self, twist: Twist, positions: Sequence[float | None] = ()) -> tuple[Setpoint, ...]:
        """Return the angles at which it stands: what moves it is `actuate`."""
        return tuple(Setpoint(position=angle) for angle in self._posture(self.height))

    def _posture(self, height: float) -> tuple[float, ...]:
        return tuple(
            angle
            for number in range(4)
            for angle in self.leg(number).angles((0.0, SIDE[number] * self.offset, -height))
        )

    # -- motion ----------------------------------------------------------------------------------

    def actuate(
        self, twist: Twist, positions: Sequence[float | None], dt: float, memory: Any
    ) -> tuple[tuple[Command, ...], Any]:
        """Return the springs of all joints, and where in rising or walking it is."""
        if memory is None:
            start = tuple(position for position in positions if position is not None)
            if len(start) < 12:
                return tuple(msg.Idle(motor) for motor in self.joints), None
            memory = self._rise(start)
        if isinstance(memory, Rise):
            memory = memory._replace(t=memory.t + dt)
            if memory.t < memory.fold + memory.lift:
                return self._rising(memory), memory
            memory = Gait(tuple(Foot(home) for home in self._homes()))
        if twist.speed < SLOWEST and abs(twist.angular) < SLOWEST_TURN:
            twist = REST  # no step is so small
        rhythm = Rhythm(self.period, self.stance, self.lift)
        gait = rhythm.advanced(memory, self._homes(), self._eased(memory.twist, twist, dt), dt)
        loads = [rhythm.load(gait, number) for number in range(4)]
        weight = self.mass * GRAVITY / max(sum(loads), 1e-3)
        commands: list[Command] = []
        for number, foot in enumerate(gait.feet):
            high, climb = rhythm.height(gait, number)
            place, velocity = (*foot.place, high - self.height), (*foot.velocity, climb)
            commands += self._command(number, place, velocity, weight * loads[number])
        return tuple(commands), gait

    def _rise(self, start: tuple[float, ...]) -> Rise:
        """Return the way from where the joints are: the feet come to their places at their mean depth."""
        depth = -0.25 * sum(self.leg(number).foot(_three(start, number))[2] for number in range(4))
        low = max(self.lying_height, min(self.height, depth))
        ways = zip(start, self._posture(low), strict=True)
        fold = max(abs(b - a) for a, b in ways) / FOLDING
        share = (self.height - low) / (self.height - self.lying_height)
        return Rise(start, low, max(SHORTEST, fold), max(SHORTEST, share * self.rise_time))

    def _rising(self, rise: Rise) -> tuple[Command, ...]:
        """Return the commands on the way."""
        if rise.t < rise.fold:
            share, rate = _smooth(rise.t / rise.fold)
            return tuple(
                msg.Impedance(
                    motor, a + share * (b - a), rate / rise.fold * (b - a), 0.0, self.stiffness, self.damping
                )
                for motor, a, b in zip(self.joints, rise.start, self._posture(rise.low), strict=True)
            )
        share, rate = _smooth((rise.t - rise.fold) / rise.lift)
        way, load = self.height - rise.low, share * self.mass * GRAVITY / 4.0
        return self._standing(rise.low + share * way, rate / rise.lift * way, load)

    def _eased(self, before: Twist, wanted: Twist, dt: float) -> Twist:
        """Return the twist on the way to the one wanted: when it has risen, that may be any."""
        able = max(2.0 * self.max_linear_acceleration, self.stop_deceleration or 0.0) * max(dt, 1e-6)
        turn = 2.0 * self.max_angular_acceleration * max(dt, 1e-6)
        change = Twist(*(b - a for a, b in zip(before, wanted, strict=True)))
        excess = max(change.speed / able, abs(change.angular) / turn)
        if excess <= 1.0:
            return wanted
        return Twist(*(a + one / excess for a, one in zip(before, change, strict=True)))

    # -- odometry --------------------------------------------------------------------------------

    def _tread(self, number: int, angles: Point, before: Point) -> tuple[Point, tuple[Point, Point, Point]]:
        """Return a foot's centre [m] less the way that it has rolled on the floor since `before`, and the
        derivatives by the angles."""
        leg, radius = self.leg(number), self.foot_radius
        x, y, z = leg.foot(angles)
        hip, thigh, knee = leg.jacobian(angles)
        turn, pitch = angles[0] - before[0], angles[1] + angles[2] - before[1] - before[2]
        place = (
            FORE[number] * self.hip_x + x - radius * pitch,
            SIDE[number] * self.hip_y + y + radius * turn,
            z,
        )
        slopes = (
            (hip[0], hip[1] + radius, hip[2]),
            (thigh[0] - radius, thigh[1], thigh[2]),
            (knee[0] - radius, knee[1], knee[2]),
        )
        return place, slopes

    def travel(self, before: Sequence[float], after: Sequence[float]) -> Travel:
        """Return the motion that fits the feet on the floor: weighted least squares in closed form (Umeyama
        1991, in the plane), as a constant twist. The derivatives take the weights as they are."""
        old = [self._tread(n, _three(before, n), _three(before, n))[0] for n in range(4)]
        treads = [self._tread(n, _three(after, n), _three(before, n)) for n in range(4)]
        new = [place for place, _ in treads]
        heights = [old[n][2] + new[n][2] for n in range(4)]
        above = 0.25 * (heights[0] + heights[3] - heights[1] - heights[2])
        first = 0.5 / (1.0 + math.exp(max(-50.0, min(50.0, above / LEVEL))))
        weights = (first, 0.5 - first, 0.5 - first, first)
        ox, oy = _mean(weights, old, 0), _mean(weights, old, 1)
        nx, ny = _mean(weights, new, 0), _mean(weights, new, 1)
        cross = dot = 0.0
        for w, a, b in zip(weights, old, new, strict=True):
            cross += w * ((b[0] - nx) * (a[1] - oy) - (b[1] - ny) * (a[0] - ox))
            dot += w * ((b[0] - nx) * (a[0] - ox) + (b[1] - ny) * (a[1] - oy))
        turn = math.atan2(cross, dot)
        c, s = math.cos(turn), math.sin(turn)
        dx, dy = ox - c * nx + s * ny, oy - s * nx - c * ny
        # The logarithm of SE(2): half·cot(half) along, half across (as `plane.motion`).
        half = 0.5 * turn
        cot = half / math.tan(half) if abs(half) > 1e-4 else 1.0 - half * half / 3.0
        slope = -half / 3.0 if abs(half) < 1e-3 else 0.5 * (cot / half - half / math.sin(half) ** 2)
        square = max(cross * cross + dot * dot, 1e-12)
        by: list[tuple[float, float, float]] = []
        for w, a, (_, slopes) in zip(weights, old, treads, strict=True):
            px, py = a[0] - ox, a[1] - oy
            for ux, uy, _ in slopes:
                yaw = w * (dot * (ux * py - uy * px) - cross * (ux * px + uy * py)) / square
                gx = -w * (c * ux - s * uy) + (s * nx + c * ny) * yaw
                gy = -w * (s * ux + c * uy) - (c * nx - s * ny) * yaw
                bend = slope * yaw
                by.append(
                    (
                        cot * gx + half * gy + bend * dx + 0.5 * yaw * dy,
                        yaw,
                        cot * gy - half * gx + bend * dy - 0.5 * yaw * dx,
                    )
                )
        ahead, aside = cot * dx + half * dy, cot * dy - half * dx
        return Travel(ahead, turn, aside, *(tuple(one[i] for one in by) for i in range(3)))


def _measured(model: urdf.UrdfModel, names: Sequence[str]) -> dict[str, float]:
    """Return the measures [m] of a leg with these joints, whose frames are parallel."""
    hip, thigh, knee = (model.joints[name] for name in names)
    feet = [
        (joint, shape)
        for joint in model.joints.values()
        for shape in model.links[joint.child].shapes
        if joint.parent == knee.child and joint.kind == "fixed" and shape.kind == "sphere"
    ]
    if hip.parent != model.root or thigh.parent != hip.child or knee.parent != thigh.child or len(feet) != 1:
        raise ValueError(f"{', '.join(names)} are no leg of a hip on the root, thigh, knee, and a fixed ball")
    foot, ball = feet[0]
    return {
        "hip_x": abs(hip.origin.xyz[0]),
        "hip_y": abs(hip.origin.xyz[1]),
        "offset": abs(thigh.origin.xyz[1]),
        "thigh": -knee.origin.xyz[2],
        "shank": -foot.origin.xyz[2],
        "foot_radius": ball.size[0],
    }


def _three(angles: Sequence[float], number: int) -> Point:
    return angles[3 * number], angles[3 * number + 1], angles[3 * number + 2]


def _mean(weights: Sequence[float], places: Sequence[Point], axis: int) -> float:
    return sum(weight * place[axis] for weight, place in zip(weights, places, strict=True))


def _bar(length: float, thick: float) -> Geometry:
    """Return a bar that hangs from its origin [m]."""
    return Geometry("box", (thick, thick, length), Origin((0.0, 0.0, -0.5 * length)))


def _smooth(share: float) -> tuple[float, float]:
    """Return a way from 0 to 1 that begins and ends at rest, and its derivative."""
    s = max(0.0, min(1.0, share))
    return s * s * s * (10.0 - s * (15.0 - 6.0 * s)), 30.0 * s * s * (1.0 - s) ** 2
