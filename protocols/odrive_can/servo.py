"""The control loops of the firmware: position → velocity → torque → current, and its monitoring.

Rules. One call of `step` is one cycle of the loop, whatever its `dt`; the firmware's 8 kHz constants are
scaled to it. Units are the firmware's: turns, turns/s, N·m, A. All that the loops know of the shaft comes
through `measure`, quantised as by an encoder. No frames and no messages in here.

Sources: loop structure, order of limits, velocity limit in torque control, overspeed check, integrator
decay of 0.99 per turn and input modes: odriverobotics/ODrive@0153e35 `MotorControl/controller.cpp`;
set-point at arming: odriverobotics/ODrive@028a22b `MotorControl/axis.cpp`. Thermal, bus and spin-out models
are ours (README, "the twin").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from protocols.odrive_can.decoder import Axis
from protocols.odrive_can.faults import Error
from protocols.odrive_can.messages import ControlMode, InputMode
from protocols.odrive_can.options import Settings

LOOP_RATE = 8000.0
"""Cycles of the firmware's control loop per second."""
INTEGRATOR_DECAY = 0.99
TEMPERATURE_MARGIN = 5.0
"""K above the upper limit at which a thermistor's error is raised."""
FET_RESISTANCE = 0.01
"""Ω of the power stage, for its heat."""
FET_THERMAL_RESISTANCE = 4.0
FET_THERMAL_CAPACITY = 15.0


@dataclass(slots=True)
class Gains:
    """The parameters that can be changed over the bus while it runs."""

    pos_gain: float
    vel_gain: float
    vel_integrator_gain: float
    vel_limit: float
    current_soft_max: float
    trap_vel_limit: float
    trap_accel_limit: float
    trap_decel_limit: float
    inertia: float


def gains_of(source: Settings | Gains) -> Gains:
    """Return the gains as configured, or a copy."""
    return Gains(*(getattr(source, name) for name in Gains.__slots__))


class Servo:
    """The loops of one axis. Plain data."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.gains = gains_of(settings)
        self.offset = 0.0
        """turns: shaft angle minus position"""
        self.shaft = 0.0
        self.position = 0.0
        self.velocity = 0.0
        self.mode = settings.control_mode
        self.pos_setpoint = 0.0
        self.vel_setpoint = 0.0
        self.torque_setpoint = 0.0
        self.integrator = 0.0
        self.torque_target = 0.0
        self.trajectory_done = True
        self.iq_setpoint = 0.0
        self.iq = 0.0
        self.bus_voltage = settings.bus_voltage
        self.bus_current = 0.0
        self.motor_temperature = settings.ambient
        self.fet_temperature = settings.ambient
        self.electrical = 0.0
        self.mechanical = 0.0
        self._electrical_slow = 0.0
        self._mechanical_slow = 0.0

    def measure(self, dt: float, shaft: float, velocity: float) -> None:
        """Update the encoder: position in whole counts, velocity with its estimator's lag."""
        self.shaft = shaft
        cpr = self.settings.encoder_cpr
        self.position = math.floor(shaft * cpr + 0.5) / cpr - self.offset
        self.velocity += _lag(dt, self.settings.encoder_bandwidth) * (velocity - self.velocity)

    def set_position(self, position: float) -> None:
        """Give the present position this value (Set_Absolute_Position)."""
        self.offset += self.position - position
        self.position = position

    def start(self) -> None:
        """Arm: the present position is the set-point, the integrator empty."""
        self.pos_setpoint = self.position
        self.vel_setpoint = self.torque_setpoint = self.integrator = 0.0
        self._electrical_slow = self._mechanical_slow = 0.0
        self.trajectory_done = True

    def torque(self) -> float:
        """Return the torque on the shaft, N·m."""
        return self.iq * self.settings.torque_constant

    def step(self, dt: float, axis: Axis) -> Error:
        """Run one cycle of the loop; return the errors that it raised."""
        if axis.control_mode != self.mode:
            self.mode = axis.control_mode
            if self.mode == ControlMode.POSITION:
                self.pos_setpoint = self.position
        errors = Error(0)
        if axis.armed:
            self._follow_inputs(dt, axis)
            errors |= self._control(dt)
        else:
            self.iq_setpoint = self.iq = self.torque_target = 0.0
        self._power(dt)
        return errors | self._monitor(armed=axis.armed)

    # -- input modes: from inputs to set-points -------------------------------------------------------------

    def _follow_inputs(self, dt: float, axis: Axis) -> None:
        goal = self.pos_setpoint if axis.position is None else axis.position
        mode = axis.input_mode
        if mode == InputMode.PASSTHROUGH:
            self.pos_setpoint, self.vel_setpoint, self.torque_setpoint = goal, axis.velocity, axis.torque
        elif mode == InputMode.VEL_RAMP:
            limit = self.settings.vel_ramp_rate * dt
            step = _clamp(axis.velocity - self.vel_setpoint, limit)
            self.vel_setpoint += step
            self.torque_setpoint = step / dt * self.gains.inertia
        elif mode == InputMode.TORQUE_RAMP:
            limit = self.settings.torque_ramp_rate * dt
            self.torque_setpoint += _clamp(axis.torque - self.torque_setpoint, limit)
        elif mode == InputMode.POS_FILTER:
            self._filter(dt, goal, axis.velocity)
        elif mode == InputMode.TRAP_TRAJ and axis.position is not None:
            self._trapezoid(dt, goal)

    def _filter(self, dt: float, goal: float, velocity: float) -> None:
        """Critically damped second-order tracking."""
        ki = 2.0 * self.settings.input_filter_bandwidth
        kp = 0.25 * ki * ki
        acceleration = kp * (goal - self.pos_setpoint) + ki * (velocity - self.vel_setpoint)
        self.torque_setpoint = acceleration * self.gains.inertia
        self.vel_setpoint += dt * acceleration
        self.pos_setpoint += dt * self.vel_setpoint

    def _trapezoid(self, dt: float, goal: float) -> None:
        """The velocity profile of a trapezoidal move, computed step by step instead of planned ahead."""
        gains, distance = self.gains, goal - self.pos_setpoint
        braking = math.sqrt(2.0 * gains.trap_decel_limit * abs(distance))
        wanted = math.copysign(min(gains.trap_vel_limit, braking), distance)
        speeding_up = abs(wanted) > abs(self.vel_setpoint)
        limit = (gains.trap_accel_limit if speeding_up else gains.trap_decel_limit) * dt
        change = _clamp(wanted - self.vel_setpoint, limit)
        self.vel_setpoint += change
        self.trajectory_done = abs(distance) <= abs(self.vel_setpoint) * dt + 1e-6
        if self.trajectory_done:
            self.pos_setpoint, self.vel_setpoint, self.torque_setpoint = goal, 0.0, 0.0
        else:
            self.pos_setpoint += self.vel_setpoint * dt
            self.torque_setpoint = change / dt * gains.inertia

    # -- the cascade ------------------------------------------------------------------------------

    def _control(self, dt: float) -> Error:
        settings, gains = self.settings, self.gains
        wanted = self.vel_setpoint
        if self.mode == ControlMode.POSITION:
            wanted += gains.pos_gain * (self.pos_setpoint - self.position)
        wanted = _clamp(wanted, gains.vel_limit)
        tolerance = settings.vel_limit_tolerance
        if tolerance and abs(self.velocity) > tolerance * gains.vel_limit:
            return Error.VELOCITY_LIMIT_VIOLATION
        torque, error = self.torque_setpoint, 0.0
        if self.mode >= ControlMode.VELOCITY:
            error = wanted - self.velocity
            torque += gains.vel_gain * error + self.integrator
        elif settings.enable_torque_mode_vel_limit:
            highest = (gains.vel_limit - self.velocity) * gains.vel_gain
            lowest = (-gains.vel_limit - self.velocity) * gains.vel_gain
            torque = max(lowest, min(highest, torque))
        if self.mode == ControlMode.VOLTAGE:  # not for a motor with an encoder
            torque = 0.0
        limit = self.current_limit() * settings.torque_constant
        self.torque_target = _clamp(torque, limit)
        if self.mode < ControlMode.VELOCITY:
            self.integrator = 0.0
        elif self.torque_target != torque:
            self.integrator *= INTEGRATOR_DECAY ** (dt * LOOP_RATE)
        else:
            self.integrator += gains.vel_integrator_gain * dt * error
        self.iq_setpoint = self.torque_target / settings.torque_constant
        self.iq += _lag(dt, settings.current_bandwidth) * (self.iq_setpoint - self.iq)
        return Error(0)

    def current_limit(self) -> float:
        """Return the soft limit, A; it falls linearly between a thermistor's lower and upper limit."""
        s = self.settings
        motor = _derate(self.motor_temperature, s.motor_temp_limit_lower, s.motor_temp_limit_upper)
        fet = _derate(self.fet_temperature, s.fet_temp_limit_lower, s.fet_temp_limit_upper)
        return self.gains.current_soft_max * min(motor, fet)

    # -- monitoring -----------------------------------------------------------------------------------

    def _power(self, dt: float) -> None:
        s = self.settings
        square = 1.5 * self.iq * self.iq
        copper, stage = square * s.phase_resistance, square * FET_RESISTANCE
        self.mechanical = self.torque() * self.velocity * math.tau
        self.electrical = self.mechanical + copper + stage
        self.bus_current = self.electrical / max(self.bus_voltage, 1.0)
        self.bus_voltage = s.bus_voltage - s.bus_resistance * self.bus_current
        self.motor_temperature += _temperature_rise(
            dt,
            copper,
            self.motor_temperature - s.ambient,
            s.motor_thermal_resistance,
            s.motor_thermal_capacity,
        )
        self.fet_temperature += _temperature_rise(
            dt, stage, self.fet_temperature - s.ambient, FET_THERMAL_RESISTANCE, FET_THERMAL_CAPACITY
        )
        lag = _lag(dt, s.spinout_power_bandwidth)
        self._electrical_slow += lag * (self.electrical - self._electrical_slow)
        self._mechanical_slow += lag * (self.mechanical - self._mechanical_slow)

    def _monitor(self, armed: bool) -> Error:
        s = self.settings
        errors = Error(0)
        if self.bus_voltage < s.dc_bus_undervoltage_trip_level:
            errors |= Error.DC_BUS_UNDER_VOLTAGE
        if self.bus_voltage > s.dc_bus_overvoltage_trip_level:
            errors |= Error.DC_BUS_OVER_VOLTAGE
        if self.motor_temperature > s.motor_temp_limit_upper + TEMPERATURE_MARGIN:
            errors |= Error.MOTOR_OVER_TEMP
        if self.fet_temperature > s.fet_temp_limit_upper + TEMPERATURE_MARGIN:
            errors |= Error.INVERTER_OVER_TEMP
        return errors | self._monitor_current() if armed else errors

    def _monitor_current(self) -> Error:
        s = self.settings
        errors = Error(0)
        if self.bus_current > s.dc_max_positive_current:
            errors |= Error.DC_BUS_OVER_CURRENT
        if self.bus_current < s.dc_max_negative_current:
            errors |= Error.DC_BUS_OVER_REGEN_CURRENT
        if abs(self.iq) > s.current_hard_max:
            errors |= Error.CURRENT_LIMIT_VIOLATION
        slipping = self._mechanical_slow < s.spinout_mechanical_power_threshold
        if slipping and self._electrical_slow > s.spinout_electrical_power_threshold:
            errors |= Error.SPINOUT_DETECTED
        return errors


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _lag(dt: float, bandwidth: float) -> float:
    """Return the share of a step that a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)


def _derate(temperature: float, lower: float, upper: float) -> float:
    if temperature <= lower:
        return 1.0
    return max(0.0, (upper - temperature) / (upper - lower)) if upper > lower else 0.0


def _temperature_rise(dt: float, heat: float, above: float, resistance: float, capacity: float) -> float:
    """Return the temperature rise of a body in dt, K: exact for constant heat [W]."""
    return _lag(dt, 1.0 / (resistance * capacity)) * (heat * resistance - above)
