"""Limits of acceleration and jerk: from the commanded twist towards the wanted one, along the arc.

Rules. A pure function of the commanded motion, what is wanted, and dt. The speed changes first, within
acceleration and jerk; the angular speed follows it at the wanted curvature, so that the base stays on its arc
while it speeds up and while it brakes; where the curvature would need a faster change of the angular speed
than is allowed, the speed changes more slowly. What is commanded counts, not what is measured.
"""

from __future__ import annotations

from math import cos, hypot, isfinite, sin

from brain.bodies.body import Base
from brain.bodies.joint_profile import JointLimits, JointState, velocity_step
from brain.bodies.plane import REST, Commanded, Twist

LATE = 0.1
"""s of angular acceleration by which a base may be off its curvature until it no longer speeds up"""
SLOW = 1e-3
"""m/s below which a motion has no curvature"""
JERK = 0.7
"""Share of the jerks that is commanded: the motors' loops add to it"""
NOTHING = 1e-6
"""m/s and rad/s below which what shall rest does"""


def approach(now: Commanded, wanted: Twist, dt: float, body: Base) -> Commanded:
    """Return the commanded motion dt [s] later, within the body's accelerations and jerks.

    A wanted twist that is not finite counts as rest; a dt that is not positive changes nothing."""
    if not all(map(isfinite, wanted)):
        wanted = REST
    if not dt > 0.0:
        return now
    before, rate = now
    if wanted == REST and all(abs(v) + dt * abs(a) < NOTHING for v, a in zip(before, rate, strict=True)):
        return Commanded()
    curvature = _curvature(before, wanted)
    turning = abs(curvature or 0.0)
    begin = curvature * before.linear if curvature is not None else wanted.angular
    ready = 1.0
    if curvature is not None and wanted.speed > before.speed:
        late = abs(before.angular - begin) / (body.max_angular_acceleration * LATE)
        ready = min(max(1.0 - late, 0.01), 1.0)
    limits = JointLimits(
        1e3,
        ready * min(body.max_linear_acceleration, body.max_angular_acceleration / max(turning, 1e-9)),
        JERK * min(body.max_linear_jerk, body.max_angular_jerk / max(turning, 1e-9)),
    )
    # What does not roll along an arc keeps its direction while it turns: seen from it, that turns back.
    turned = -before.angular * dt if curvature is None and body.moves_sideways else 0.0
    (vx, vy), (ax, ay) = _vector_step(
        _turned((before.linear, before.lateral), turned),
        _turned((rate.linear, rate.lateral), turned),
        (wanted.linear, wanted.lateral),
        dt,
        limits,
    )
    target, begin_rate, target_rate = wanted.angular, 0.0, 0.0
    if curvature is not None:
        target, begin_rate, target_rate = curvature * vx, curvature * rate.linear, curvature * ax
    # What differs from the arc is brought to 0 like a joint of its own.
    off = JointState(0.0, before.angular - begin, rate.angular - begin_rate)
    most = body.max_angular_acceleration
    off = velocity_step(off, 0.0, dt, JointLimits(1e3, most, JERK * body.max_angular_jerk))
    angular = step(before.angular, target + off.velocity, most * dt)
    angular = clamp(angular, max(body.max_angular, abs(before.angular)))
    turning = clamp(target_rate + off.acceleration, most)
    return Commanded(Twist(vx, angular, vy), Twist(ax, turning, ay))


def along(twist: Twist, body: Base) -> JointLimits:
    """Return the limits within which the share of a twist along its arc may change: 1/s² and 1/s³."""
    speed, angular = max(twist.speed, 1e-9), max(abs(twist.angular), 1e-9)
    jerk = JERK * min(body.max_linear_jerk / speed, body.max_angular_jerk / angular)
    return JointLimits(1e3, 1.0 / max(body.to_rest(twist), 1e-9), jerk)


def braked(now: Commanded, dt: float, body: Base) -> Commanded:
    """Return the commanded motion dt [s] later if it brakes along its arc, within accelerations and jerks."""
    twist, rate = now
    if all(abs(v) + dt * abs(a) < NOTHING for v, a in zip(twist, rate, strict=True)):
        return Commanded()
    kept = velocity_step(JointState(0.0, 1.0, now.growth), 0.0, dt, along(twist, body))
    # What of the rate leads off the arc goes to 0 like a joint of its own.
    jerks = body.max_linear_jerk, body.max_angular_jerk, body.max_linear_jerk
    off = [
        velocity_step(JointState(0.0, 0.0, a - now.growth * v), 0.0, dt, JointLimits(1e3, 1e3, JERK * jerk))
        for v, a, jerk in zip(twist, rate, jerks, strict=True)
    ]
    return Commanded(
        Twist(*(v * kept.velocity + each.velocity for v, each in zip(twist, off, strict=True))),
        Twist(*(v * kept.acceleration + each.acceleration for v, each in zip(twist, off, strict=True))),
    )


def clamp(value: float, most: float) -> float:
    """Return the value within ± most."""
    return min(max(value, -most), most)


def step(previous: float, wanted: float, largest: float) -> float:
    """Move from previous towards wanted, by at most `largest`."""
    return min(max(wanted, previous - largest), previous + largest)


def _curvature(before: Twist, wanted: Twist) -> float | None:
    """Return the curvature [1/m] of the wanted twist, or of the present one if rest is wanted; None for a
    motion without: on the spot, and of a base that moves sideways."""
    if before.lateral or wanted.lateral:
        return None
    if abs(wanted.linear) > SLOW:
        return wanted.angular / wanted.linear
    if wanted == REST and abs(before.linear) > SLOW:
        return before.angular / before.linear
    return None


def _turned(vector: tuple[float, float], angle: float) -> tuple[float, float]:
    if not angle:
        return vector
    c, s = cos(angle), sin(angle)
    return c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]


def _vector_step(
    velocity: tuple[float, float],
    rate: tuple[float, float],
    wanted: tuple[float, float],
    dt: float,
    limits: JointLimits,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return velocity and acceleration in the plane, dt later: along the line to the wanted velocity as one
    joint, and across it the acceleration goes to 0."""
    dx, dy = wanted[0] - velocity[0], wanted[1] - velocity[1]
    gap = hypot(dx, dy)
    ux, uy = (dx / gap, dy / gap) if gap > 1e-12 else (1.0, 0.0)
    along, across = rate[0] * ux + rate[1] * uy, rate[1] * ux - rate[0] * uy
    state = velocity_step(JointState(0.0, -gap, along), 0.0, dt, limits)
    side = velocity_step(JointState(0.0, 0.0, across), 0.0, dt, limits) if across else JointState(0.0)
    done, aside = gap + state.velocity, side.velocity
    return (
        (velocity[0] + done * ux - aside * uy, velocity[1] + done * uy + aside * ux),
        (
            state.acceleration * ux - side.acceleration * uy,
            state.acceleration * uy + side.acceleration * ux,
        ),
    )
