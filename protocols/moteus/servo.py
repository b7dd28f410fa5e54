"""The control loops of the firmware: set-point → torque → current, and its fault monitors.

Rules. One call of `step` is one cycle of the loop, whatever its `dt`. Units are the firmware's: rev, rev/s,
N·m, A, s. Everything the loops know of the shaft comes through `measure`, quantised as by an encoder. No
frame and no message in here. Sources: modes and their transitions, watchdog, limit codes
mjbots/moteus@1f4a195 `fw/bldc_servo.cc`, `fw/bldc_servo_control.h`. Supply and heat are our own models
(README, "The twin").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from protocols.moteus.options import Settings, torque_constant
from protocols.moteus.registers import LATCHED, RISING, Mode, Register
from protocols.moteus.setpoint import Setpoint, or_default, trajectory_limits

FET_RESISTANCE = 0.01
"""Ω of the power stage, for its heat"""
THERMAL_RESISTANCE = 2.0
"""K/W from the power stage to ambient"""
THERMAL_CAPACITY = 15.0
"""J/K"""
MIN_CURRENT = 0.01
"""A: a smaller damping current is noise, and is not applied"""
WATCHDOG_MODES = (Mode.POSITION, Mode.STAY_WITHIN)
"""Modes in which the watchdog runs."""
MAX_CURRENT, MAX_TORQUE, MAX_VELOCITY, BOUNDS, HOT = 99, 102, 96, 103, 100
"""Codes of the fault register for what limits the output."""


class Servo:
    """The control loops of one controller. Plain data."""

    def __init__(self, settings: Settings, command: Mapping[int, float]) -> None:
        self.settings = settings
        self.kt = torque_constant(settings)
        self.command = command
        self.commanded_mode: int = Mode.STOPPED
        """`mode` follows it where it can."""
        self.mode: int = Mode.STOPPED
        self.stop_pending = False
        """A stop was commanded and is still to be executed."""
        self.fault = 0
        self.limit = 0
        """Code of the active limit, or 0"""
        self.timeout: float | None = None
        """s left; None: no watchdog runs"""
        self.enabling = 0.0
        """s since enabling began"""
        self.offset = 0.0
        """rev, subtracted from the position of the shaft"""
        self.shaft = 0.0
        self.position = 0.0
        self.velocity = 0.0
        self.setpoint = Setpoint()
        self.integral = 0.0
        self.error = 0.0
        self.velocity_error = 0.0
        self.terms = (0.0, 0.0, 0.0)
        """Torque of the proportional, integral and derivative term"""
        self.control_torque = 0.0
        self.iq = 0.0
        self.bus_voltage = settings.bus_voltage
        self.temperature = settings.ambient
        self.power = 0.0
        self.home_state = 1
        """0 relative, 1 rotor, 2 output"""

    # -- inputs -----------------------------------------------------------------------------------

    def measure(self, dt: float, shaft: float, velocity: float) -> None:
        """Read the encoder: position in whole counts, velocity with the lag of its filter."""
        self.shaft = shaft
        cpr = self.settings.encoder_cpr
        self.position = math.floor(shaft * cpr + 0.5) / cpr - self.offset
        self.velocity += _lag(dt, self.settings.encoder_bandwidth) * (velocity - self.velocity)

    def set_output(self, position: float) -> None:
        """Assign a value to the present position (registers 0x130, 0x131); an active set-point stays."""
        self.offset += self.position - position
        self.position = position
        self.home_state = 2

    def recapture(self) -> None:
        """Set the set-point to what is measured (register 0x133)."""
        if self.mode == Mode.POSITION:
            self.setpoint.position, self.setpoint.velocity, self.integral = self.position, self.velocity, 0.0

    def take(self, mode: int, command: Mapping[int, float]) -> None:
        """Take a command; it feeds the watchdog, and is executed from the next cycle on."""
        self.commanded_mode, self.command = mode, command
        self.stop_pending = mode == Mode.STOPPED
        timeout = command[Register.COMMAND_TIMEOUT]
        timeout = self.settings.default_timeout_s if timeout == 0.0 else timeout
        self.timeout = None if math.isnan(timeout) else max(0.0, timeout)
        self.setpoint.take(command[Register.COMMAND_POSITION])

    def trip(self, code: int) -> None:
        """Enter fault: no torque until a stop."""
        self.mode, self.fault = Mode.FAULT, code

    # -- one cycle of the loop --------------------------------------------------------------------

    def step(self, dt: float) -> None:
        """Run one cycle: mode, fault monitors, torque."""
        if self.timeout is not None:
            self.timeout = max(0.0, self.timeout - dt)
        self._change_mode(dt)
        self._monitor()
        if self.mode in WATCHDOG_MODES and self.timeout is not None and self.timeout <= 0.0:
            self.mode = Mode.TIMEOUT
        if self.mode != Mode.FAULT:
            self.fault = 0
        self.limit = 0
        if self.mode not in (Mode.POSITION, Mode.STAY_WITHIN, Mode.TIMEOUT):
            self._clear()
        self._drive(dt, self._limited(self._torque(dt)))

    def _change_mode(self, dt: float) -> None:
        """Follow the commanded mode. Only a stop leaves fault and timeout; enabling comes after a stop."""
        if self.stop_pending:
            self.mode, self.stop_pending = Mode.STOPPED, False
        elif self.commanded_mode == Mode.STOPPED:
            return
        elif self.mode == Mode.STOPPED:
            self.mode, self.enabling = Mode.ENABLING, 0.0
        elif self.mode in RISING:
            self.enabling += dt
            share = self.enabling * 1000.0 / self.settings.enable_ms if self.settings.enable_ms else 1.0
            self.mode = Mode.ENABLING if share < 0.5 else Mode.CALIBRATING
            if share >= 1.0:
                self._enter()
        elif self.mode not in LATCHED and self.mode != self.commanded_mode:
            self._enter()

    def _enter(self) -> None:
        if self.commanded_mode in WATCHDOG_MODES and self._outside():
            self.trip(39)
            return
        if self.commanded_mode in WATCHDOG_MODES and self._bounds_invalid():
            self.trip(48)
            return
        self.mode = self.commanded_mode
        self._clear()

    def _clear(self) -> None:
        self.setpoint.clear()
        self.integral = self.error = self.velocity_error = 0.0
        self.terms = (0.0, 0.0, 0.0)

    def _outside(self) -> bool:
        if self.command[Register.COMMAND_IGNORE_POSITION_BOUNDS]:
            return False
        return self.position < self.settings.position_min or self.position > self.settings.position_max

    def _bounds_invalid(self) -> bool:
        return abs(self.settings.position_min) > 32768.0 or abs(self.settings.position_max) > 32768.0

    def _monitor(self) -> None:
        if self.mode in (Mode.STOPPED, Mode.FAULT):
            return
        s = self.settings
        if self.bus_voltage > s.max_voltage:
            self.trip(34)
        elif self.bus_voltage < s.min_voltage:
            self.trip(40)
        elif self.temperature > s.fault_temperature:
            self.trip(38)
        elif self.mode == Mode.POSITION and abs(self.error) > s.fault_position_error:
            self.trip(49)
        elif self.mode == Mode.POSITION and abs(self.velocity_error) > s.fault_velocity_error:
            self.trip(50)

    # -- torque -----------------------------------------------------------------------------------

    def _torque(self, dt: float) -> float:
        """Return the torque [N·m] of the mode, before the current limits."""
        match self.mode:
            case Mode.POSITION:
                return self._position(dt)
            case Mode.STAY_WITHIN:
                return self._stay_within(dt)
            case Mode.CURRENT:
                return or_default(self.command[Register.COMMAND_Q_CURRENT], 0.0) * self.kt
            case Mode.VOLTAGE_DQ:
                return self._voltage_current() * self.kt
            case Mode.ZERO_VELOCITY:
                return self._zero_velocity()
            case Mode.BRAKE:
                return self._brake()
            case Mode.TIMEOUT:
                return self._timeout_torque(dt)
        return 0.0

    def _position(self, dt: float) -> float:
        if self._stop_position_deprecated():
            self.trip(45)
            return 0.0
        self.setpoint.follow(dt, self.settings, self.command, self.position, self.velocity)
        return self._limit_torque(self._pid(dt), self.command[Register.COMMAND_POSITION_MAX_TORQUE])

    def _stop_position_deprecated(self) -> bool:
        stop = self.command[Register.COMMAND_STOP_POSITION]
        return not math.isnan(stop) and trajectory_limits(self.settings, self.command) != (None, None)

    def _pid(self, dt: float) -> float:
        """Return the torque of the position loop around the set-point, with feed-forward."""
        position, velocity = self.setpoint.position, self.setpoint.velocity
        s, get = self.settings, self.command.__getitem__
        kp = or_default(get(Register.COMMAND_KP_SCALE), 1.0)
        kd = min(or_default(get(Register.COMMAND_KD_SCALE), 1.0), max(kp, 0.0))
        self.error = 0.0 if position is None else position - self.position
        self.velocity_error = velocity - self.velocity
        most = s.ilimit * or_default(get(Register.COMMAND_ILIMIT_SCALE), 1.0)
        self.integral = max(-most, min(most, self.integral + s.ki * self.error * dt))
        self.terms = (s.kp * kp * self.error, self.integral, s.kd * kd * self.velocity_error)
        return sum(self.terms) + or_default(get(Register.COMMAND_FEEDFORWARD_TORQUE), 0.0)

    def _limit_torque(self, torque: float, most: float) -> float:
        if math.isnan(most) or abs(torque) <= abs(most):
            return torque
        self.limit = MAX_TORQUE
        return math.copysign(abs(most), torque)

    def _stay_within(self, dt: float) -> float:
        low = self.command[Register.COMMAND_WITHIN_LOWER_BOUND]
        high = self.command[Register.COMMAND_WITHIN_UPPER_BOUND]
        if self.position < low or self.position > high:
            self.setpoint.position, self.setpoint.velocity = low if self.position < low else high, 0.0
            torque = self._pid(dt)
        else:
            self._clear()
            torque = or_default(self.command[Register.COMMAND_FEEDFORWARD_TORQUE], 0.0)
        return self._limit_torque(torque, self.command[Register.COMMAND_POSITION_MAX_TORQUE])

    def _zero_velocity(self) -> float:
        return -self.settings.kd * or_default(self.command[Register.COMMAND_KD_SCALE], 1.0) * self.velocity

    def _brake(self) -> float:
        """Return the torque of phases that are shorted through their resistance."""
        return -self.kt * self.kt * math.tau * self.velocity / (self.settings.phase_resistance * 1.5)

    def _voltage_current(self) -> float:
        """Return the current [A] that the q-axis voltage drives against the back-EMF."""
        back_emf = self.kt * math.tau * self.velocity
        voltage = or_default(self.command[Register.VOLTAGEDQ_Q], 0.0)
        return (voltage - back_emf) / self.settings.phase_resistance

    def _timeout_torque(self, dt: float) -> float:
        """Return the torque of servo.timeout_mode, with its own torque limit."""
        s = self.settings
        if s.timeout_mode == Mode.ZERO_VELOCITY:
            most = s.timeout_max_torque
            damping = -s.kd * self.velocity
            return 0.0 if abs(damping) < MIN_CURRENT * self.kt else max(-most, min(most, damping))
        if s.timeout_mode == Mode.BRAKE:
            return self._brake()
        if s.timeout_mode == Mode.POSITION:
            self.setpoint.come_to_rest(dt, s.default_accel_limit, self.position)
            return self._pid(dt)
        return 0.0

    # -- current ----------------------------------------------------------------------------------

    def _limited(self, torque: float) -> float:
        """Return the torque [N·m] after the limits of position, velocity, temperature and current."""
        s, velocity = self.settings, self.velocity
        ignored = self.command[Register.COMMAND_IGNORE_POSITION_BOUNDS]
        beyond = max(self.position - s.position_max, s.position_min - self.position, 0.0)
        outwards = (torque > 0) == (self.position > s.position_max)
        if beyond > 0.0 and outwards and not ignored and torque:
            torque *= max(0.0, 1.0 - beyond / s.position_derate)
            self.limit = BOUNDS
        most = s.max_current
        excess = abs(velocity) - s.max_velocity
        if excess > 0.0 and velocity * torque > 0.0:
            most = min(most, s.max_current * max(0.0, 1.0 - excess / s.max_velocity_derate))
        hot = (self.temperature - s.fault_temperature) / s.temperature_margin + 1.0
        cool = s.max_current * min(1.0, max(0.0, 1.0 - hot))
        code = MAX_CURRENT if most == s.max_current else MAX_VELOCITY
        code, most = (HOT, cool) if cool < most else (code, most)
        if abs(torque) > most * self.kt:
            self.limit = code
            torque = math.copysign(most * self.kt, torque)
        return torque

    def _drive(self, dt: float, torque: float) -> None:
        s = self.settings
        self.control_torque = torque
        released = self.mode == Mode.TIMEOUT and s.timeout_mode == Mode.STOPPED
        off = self.mode in (Mode.STOPPED, Mode.FAULT) or self.mode in RISING or released
        wanted = 0.0 if off else torque / self.kt
        self.iq = 0.0 if off else self.iq + _lag(dt, s.current_bandwidth) * (wanted - self.iq)
        square = 1.5 * self.iq * self.iq
        self.power = self.torque() * self.velocity * math.tau + square * (s.phase_resistance + FET_RESISTANCE)
        self.bus_voltage = s.bus_voltage - s.bus_resistance * self.power / max(self.bus_voltage, 1.0)
        above = self.temperature - s.ambient
        heat = square * FET_RESISTANCE * THERMAL_RESISTANCE - above
        self.temperature += _lag(dt, 1.0 / (THERMAL_RESISTANCE * THERMAL_CAPACITY)) * heat

    def torque(self) -> float:
        """Return the torque on the shaft [N·m]."""
        return self.iq * self.kt

    def fault_register(self) -> int:
        """Return the fault, or the code of the active limit."""
        return self.fault if self.mode == Mode.FAULT else self.limit


def _lag(dt: float, bandwidth: float) -> float:
    """Return the share of a step that a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)
