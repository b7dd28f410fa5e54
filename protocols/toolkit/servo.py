"""What the firmware of every servo drive has: encoder, control loops, power stage.

Rules. One call is one cycle of the control loop, whatever its `dt` [s]. Units are the protocol's own (rad or
turns at the shaft; N·m, A, V, °C). No frames and no messages in here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

from protocols.messages import Impedance


def clamp(value: float, limit: float) -> float:
    """Return the value within ±limit."""
    # as max(-limit, min(limit, value)) has it, also of what is no number; which takes three times as long
    least = value if value < limit else limit
    return least if least > -limit else -limit


def approach(dt: float, value: float, goal: float, up: float, down: float) -> float:
    """Return a value on its way to a goal: away from zero with slope `up`, towards it with `down`."""
    faster = abs(goal) > abs(value) and goal * value >= 0.0
    return value + clamp(goal - value, (up if faster else down) * dt)


@lru_cache(maxsize=256)
def lag(dt: float, bandwidth: float) -> float:
    """Return the share of a step that a first-order lag [rad/s] has followed after dt."""
    return -math.expm1(-bandwidth * dt)


@dataclass(slots=True)
class Encoder:
    """The encoder of a shaft: position in whole counts, velocity with the lag of its filter."""

    counts: float = 0.0
    """Per unit of position; 0: exact."""
    bandwidth: float = math.inf
    """rad/s of the velocity estimate"""
    offset: float = 0.0
    """Position of the shaft minus reported position."""
    shaft: float = 0.0
    position: float = 0.0
    velocity: float = 0.0

    def measure(self, dt: float, shaft: float, velocity: float) -> None:
        """Read the true shaft."""
        self.shaft = shaft
        counted = math.floor(shaft * self.counts + 0.5) / self.counts if self.counts else shaft
        self.position = counted - self.offset
        self.velocity = velocity + math.exp(-self.bandwidth * dt) * (self.velocity - velocity)

    def set_position(self, position: float) -> None:
        """Give the present position this value."""
        self.offset += self.position - position
        self.position = position


@dataclass(slots=True)
class Trapezoid:
    """A set-point that moves to a goal with limited velocity and acceleration."""

    position: float = 0.0
    velocity: float = 0.0
    done: bool = True

    def lead(self, position: float, velocity: float) -> None:
        """Give the set-point this value."""
        self.position, self.velocity = position, velocity

    def advance(self, dt: float, goal: float, velocity: float, speed_up: float, slow_down: float) -> float:
        """Go one cycle towards the goal [velocity, its square per unit]; return the acceleration."""
        distance = goal - self.position
        wanted = math.copysign(min(velocity, math.sqrt(2.0 * slow_down * abs(distance))), distance)
        limit = (speed_up if abs(wanted) > abs(self.velocity) else slow_down) * dt
        change = clamp(wanted - self.velocity, limit)
        self.velocity += change
        self.done = abs(distance) <= abs(self.velocity) * dt + 1e-6
        if self.done:
            self.position, self.velocity = goal, 0.0
            return 0.0
        self.position += self.velocity * dt
        return change / dt


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains and limits of the loops of `Servo`."""

    position: float = 20.0
    """1/s"""
    velocity: float = 0.3
    """N·m·s/rad"""
    integral: float = 3.0
    """N·m/rad"""
    torque_limit: float = 10.0
    """N·m"""

    def scaled(self, position: float, velocity: float, integral: float) -> Gains:
        """Return these gains times so much each."""
        loops = self.position * position, self.velocity * velocity, self.integral * integral
        return Gains(*loops, self.torque_limit)


@dataclass(slots=True)
class Servo:
    """Loops for velocity, position (around velocity) and impedance."""

    gains: Gains
    integral: float = 0.0
    """N·m"""

    def reset(self) -> None:
        """Empty the integrator."""
        self.integral = 0.0

    def tune(self, gains: Gains) -> None:
        """Take over other gains."""
        self.gains = gains

    def turn(self, dt: float, velocity: float, measured: float) -> float:
        """Return the torque of the velocity loop."""
        error, gains = velocity - measured, self.gains
        self.integral = clamp(self.integral + gains.integral * error * dt, gains.torque_limit)
        return clamp(gains.velocity * error + self.integral, gains.torque_limit)

    def towards(self, distance: float, velocity: float, fastest: float, slow_down: float) -> float:
        """Return the velocity of the position loop around `velocity`, limited so that it can still end there
        with this deceleration."""
        if slow_down < math.inf:
            fastest = min(fastest, math.sqrt(2.0 * slow_down * abs(distance)) + abs(velocity))
        return clamp(self.gains.position * distance + velocity, fastest)

    def spring(self, goal: Impedance, encoder: Encoder) -> float:
        """Return the torque of a spring and damper."""
        torque = goal.torque + goal.stiffness * (goal.position - encoder.position)
        return clamp(torque + goal.damping * (goal.velocity - encoder.velocity), self.gains.torque_limit)


@dataclass(slots=True)
class PowerStage:
    """Current, supply and heat of a motor with its power stage: our own model, the same for all drives.

    The current follows its loop; copper and transistors turn its square into heat, each a body with one
    thermal resistance to the ambient and one capacity; the supply sags by its resistance."""

    torque_constant: float
    """N·m/A"""
    bandwidth: float
    """rad/s of the current loop"""
    resistance: float
    """Ω of a phase"""
    supply: float
    """V without load"""
    supply_resistance: float
    """Ω of battery and cables"""
    ambient: float
    """°C"""
    motor_thermal: tuple[float, float] = (2.0, 80.0)
    """K/W to the ambient, and J/K, of the winding"""
    stage_resistance: float = 0.01
    """Ω of the transistors"""
    stage_thermal: tuple[float, float] = (4.0, 15.0)
    current: float = 0.0
    """A, torque-producing"""
    voltage: float = 0.0
    supply_current: float = 0.0
    motor_temperature: float = 0.0
    stage_temperature: float = 0.0
    mechanical: float = 0.0
    """W"""
    electrical: float = 0.0

    def __post_init__(self) -> None:
        self.voltage = self.voltage or self.supply
        self.motor_temperature = self.motor_temperature or self.ambient
        self.stage_temperature = self.stage_temperature or self.ambient

    @property
    def torque(self) -> float:
        """Torque on the shaft [N·m]."""
        return self.current * self.torque_constant

    def drive(self, dt: float, torque: float | None, velocity: float) -> None:
        """Run one cycle towards a torque [N·m]; None: switched off. `velocity`: rad/s of the shaft."""
        if torque is None:
            current = 0.0
        else:
            current = self.current
            current += lag(dt, self.bandwidth) * (torque / self.torque_constant - current)
        self.current = current
        square = 1.5 * current * current
        copper, stage = square * self.resistance, square * self.stage_resistance
        self.mechanical = current * self.torque_constant * velocity
        self.electrical = self.mechanical + copper + stage
        self.supply_current = self.electrical / (self.voltage if self.voltage > 1.0 else 1.0)
        self.voltage = self.supply - self.supply_resistance * self.supply_current
        self.motor_temperature += self._rise(dt, copper, self.motor_temperature, self.motor_thermal)
        self.stage_temperature += self._rise(dt, stage, self.stage_temperature, self.stage_thermal)

    def _rise(self, dt: float, heat: float, temperature: float, body: tuple[float, float]) -> float:
        """Return the rise in dt: exact for constant heat [W]."""
        resistance, capacity = body
        return lag(dt, 1.0 / (resistance * capacity)) * (heat * resistance - (temperature - self.ambient))
