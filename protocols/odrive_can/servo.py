"""The control loops of the firmware: position → velocity → torque → current, and its monitoring.

Rules. One call of `cycle` is one cycle of the loop, whatever its `dt`; the firmware's 8 kHz constants are
scaled to it. Units are the firmware's: turns, turns/s, N·m, A. All that the loops know of the shaft comes
from the encoder. No frames and no messages in here.

Sources: loop structure, order of limits, velocity limit in torque control, overspeed check, integrator
decay of 0.99 per cycle and input modes: odriverobotics/ODrive@f9b5419 `MotorControl/controller.cpp`;
set-point at arming: odriverobotics/ODrive@028a22b `MotorControl/axis.cpp`. Thermal, bus and spin-out models
are ours (README, "the twin").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

from protocols.odrive_can.options import AxisSettings
from protocols.odrive_can.table import ControlMode, InputMode
from protocols.toolkit.servo import Encoder, PowerStage, Trapezoid, clamp, lag

LOOP_RATE = 8000.0  # Cycles of the firmware's control loop per second.
INTEGRATOR_DECAY = 0.99
TEMPERATURE_MARGIN = 5.0  # K above the upper limit at which a thermistor's error is raised.
# Looked up once: a look at a member of an enumeration takes five times as long as one at a name.
VELOCITY, POSITION = ControlMode.VELOCITY, ControlMode.POSITION
GAINS: dict[str, tuple[str, ...]] = {
    "Set_Limits": ("vel_limit", "current_soft_max"),
    "Set_Traj_Vel_Limit": ("trap_vel_limit",),
    "Set_Traj_Accel_Limits": ("trap_accel_limit", "trap_decel_limit"),
    "Set_Traj_Inertia": ("inertia",),
    "Set_Pos_Gain": ("pos_gain",),
    "Set_Vel_Gains": ("vel_gain", "vel_integrator_gain"),
}
"""The settings that can be changed while it runs, by the message that does, in the order of its fields."""


class AxisInputs(Protocol):
    """What the axis was sent."""

    armed: bool
    input_mode: int
    position: float | None  # None: where the shaft was when the axis armed or entered position control.
    velocity: float
    torque: float

    @property
    def control(self) -> ControlMode:
        """The outermost loop."""
        ...


def gains_of(settings: AxisSettings) -> dict[str, float]:
    """Return these settings as configured."""
    return {name: getattr(settings, name) for names in GAINS.values() for name in names}


class Servo:
    """The loops of one axis. Plain data."""

    def __init__(self, settings: AxisSettings, gains: Mapping[str, float], whole_turns: int = 0) -> None:
        s = self.settings = settings
        self.gains = dict(gains)
        # An absolute encoder knows its position within one turn only.
        self.encoder = Encoder(float(s.encoder_cpr), s.encoder_bandwidth, offset=whole_turns)
        self.stage = PowerStage(
            *(s.torque_constant, s.current_bandwidth, s.phase_resistance, s.bus_voltage, s.bus_resistance),
            *(s.ambient, (s.motor_thermal_resistance, s.motor_thermal_capacity)),
        )
        self.here = 0.0  # Input position where none was given.
        self.set_point = Trapezoid()  # Position and velocity that the loops follow, whatever the input mode.
        self.torque_set_point = 0.0
        self.integrator = 0.0
        self.torque_target = 0.0
        self._electrical_slow = 0.0
        self._mechanical_slow = 0.0

    @property
    def current_set_point(self) -> float:
        """A"""
        return self.torque_target / self.settings.torque_constant

    def configure(self, gains: Iterable[tuple[str, float]]) -> None:
        """Set gains; limits are magnitudes."""
        for name, value in gains:
            self.gains[name] = abs(value) if "limit" in name or "max" in name else value
        most = self.settings.current_hard_max
        self.gains["current_soft_max"] = min(self.gains["current_soft_max"], most)

    def use(self, settings: AxisSettings) -> None:
        """Use other settings of motor, encoder and limits from now on."""
        s = self.settings = settings
        self.encoder = replace(self.encoder, bandwidth=s.encoder_bandwidth)
        self.stage = replace(
            self.stage,
            torque_constant=s.torque_constant,
            bandwidth=s.current_bandwidth,
            resistance=s.phase_resistance,
        )

    def start(self) -> None:
        """Arm: the present position is the set-point, the integrator empty."""
        self.here = self.encoder.position
        self.set_point = Trapezoid(self.here)
        self.torque_set_point = self.integrator = self._electrical_slow = self._mechanical_slow = 0.0

    def enter(self) -> None:
        """Enter position control: the present position is input and set-point."""
        self.here = self.encoder.position
        self.set_point.lead(self.here, self.set_point.velocity)

    def cycle(self, dt: float, inputs: AxisInputs) -> Sequence[str]:
        """Run one cycle of the loop; return the errors that it raised, by the names of 0.6.x."""
        stage, armed, overspeed = self.stage, inputs.armed, False
        if armed:
            self._follow(dt, inputs)
            overspeed = self._control(dt, inputs.control)
        else:
            self.torque_target = 0.0
        stage.drive(dt, self.torque_target if armed else None, self.encoder.velocity * math.tau)
        slow = lag(dt, self.settings.spinout_power_bandwidth)
        self._electrical_slow += slow * (stage.electrical - self._electrical_slow)
        self._mechanical_slow += slow * (stage.mechanical - self._mechanical_slow)
        return self._errors(armed, overspeed)

    # -- input modes: from inputs to set-points -------------------------------------------------------------

    def _follow(self, dt: float, inputs: AxisInputs) -> None:
        to, gains = self.set_point, self.gains
        goal = self.here if inputs.position is None else inputs.position
        match inputs.input_mode:
            case InputMode.PASSTHROUGH | InputMode.TUNING:  # with the factory's amplitudes of zero
                to.lead(goal, inputs.velocity)
                self.torque_set_point = inputs.torque
            case InputMode.VEL_RAMP:
                step = clamp(inputs.velocity - to.velocity, self.settings.vel_ramp_rate * dt)
                to.lead(to.position, to.velocity + step)
                self.torque_set_point = step / dt * gains["inertia"]
            case InputMode.TORQUE_RAMP:
                limit = self.settings.torque_ramp_rate * dt
                self.torque_set_point += clamp(inputs.torque - self.torque_set_point, limit)
            case InputMode.POS_FILTER:  # critically damped tracking of second order
                ki = 2.0 * self.settings.input_filter_bandwidth
                kp = 0.25 * ki * ki
                acceleration = kp * (goal - to.position) + ki * (inputs.velocity - to.velocity)
                self.torque_set_point = acceleration * gains["inertia"]
                velocity = to.velocity + dt * acceleration
                to.lead(to.position + dt * velocity, velocity)
            case InputMode.TRAP_TRAJ if inputs.position is not None:
                limits = gains["trap_vel_limit"], gains["trap_accel_limit"], gains["trap_decel_limit"]
                self.torque_set_point = to.advance(dt, goal, *limits) * gains["inertia"]

    # -- the cascade ------------------------------------------------------------------------------

    def _control(self, dt: float, mode: ControlMode) -> bool:
        """Find the torque. True if the shaft turns too fast."""
        settings, gains, velocity = self.settings, self.gains, self.encoder.velocity
        wanted = self.set_point.velocity
        if mode == POSITION:
            wanted += gains["pos_gain"] * (self.set_point.position - self.encoder.position)
        fastest = gains["vel_limit"]
        wanted = clamp(wanted, fastest)
        tolerance = settings.vel_limit_tolerance
        if tolerance and abs(velocity) > tolerance * fastest:
            return True
        torque, error = self.torque_set_point, 0.0
        if mode >= VELOCITY:
            error = wanted - velocity
            torque += gains["vel_gain"] * error + self.integrator
        elif settings.enable_torque_mode_vel_limit:
            highest = (fastest - velocity) * gains["vel_gain"]
            lowest = (-fastest - velocity) * gains["vel_gain"]
            torque = max(lowest, min(highest, torque))
        self.torque_target = clamp(torque, self.current_limit() * settings.torque_constant)
        if mode < VELOCITY:
            self.integrator = 0.0
        elif self.torque_target != torque:
            self.integrator *= INTEGRATOR_DECAY ** (dt * LOOP_RATE)
        else:
            self.integrator += gains["vel_integrator_gain"] * dt * error
        return False

    def current_limit(self) -> float:
        """Return the soft limit, A; it falls linearly between a thermistor's lower and upper limit."""
        s, stage = self.settings, self.stage
        motor = _derate(stage.motor_temperature, s.motor_temp_limit_lower, s.motor_temp_limit_upper)
        fet = _derate(stage.stage_temperature, s.fet_temp_limit_lower, s.fet_temp_limit_upper)
        return self.gains["current_soft_max"] * min(motor, fet)

    def _errors(self, armed: bool, overspeed: bool) -> list[str]:
        s, stage = self.settings, self.stage
        found = ["VELOCITY_LIMIT_VIOLATION"] if overspeed else []
        if stage.voltage < s.dc_bus_undervoltage_trip_level:
            found.append("DC_BUS_UNDER_VOLTAGE")
        if stage.voltage > s.dc_bus_overvoltage_trip_level:
            found.append("DC_BUS_OVER_VOLTAGE")
        if stage.motor_temperature > s.motor_temp_limit_upper + TEMPERATURE_MARGIN:
            found.append("MOTOR_OVER_TEMP")
        if stage.stage_temperature > s.fet_temp_limit_upper + TEMPERATURE_MARGIN:
            found.append("INVERTER_OVER_TEMP")
        if not armed:
            return found
        if stage.supply_current > s.dc_max_positive_current:
            found.append("DC_BUS_OVER_CURRENT")
        if stage.supply_current < s.dc_max_negative_current:
            found.append("DC_BUS_OVER_REGEN_CURRENT")
        if abs(stage.current) > s.current_hard_max:
            found.append("CURRENT_LIMIT_VIOLATION")
        slipping = self._mechanical_slow < s.spinout_mechanical_power_threshold
        if slipping and self._electrical_slow > s.spinout_electrical_power_threshold:
            found.append("SPINOUT_DETECTED")
        return found


def _derate(temperature: float, lower: float, upper: float) -> float:
    if temperature <= lower:
        return 1.0
    return max(0.0, (upper - temperature) / (upper - lower)) if upper > lower else 0.0
