"""The control loops of the firmware: set-point → torque → current, and what it watches over.

Rules. One call of `step` is one turn of the loop, whatever its `dt`. Units are the firmware's: rev, rev/s,
N·m, A, s. Everything the loops know of the shaft comes through `measure`, quantised as an encoder would. No
wire and no word in here. Sources: modes and their transitions, watchdog, limit codes mjbots/moteus@1f4a195
`fw/bldc_servo.cc`, `fw/bldc_servo_control.h`. Supply and heat are models of ours (README, "the twin").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from protocols.moteus.options import Settings, torque_constant
from protocols.moteus.registers import LATCHED, RISING, Mode, Register
from protocols.moteus.setpoint import Setpoint, limits_of, or_else

FET_RESISTANCE = 0.01
"""Ω of the power stage, for its heat."""
THERMAL_RESISTANCE = 2.0
"""K/W from the power stage to the ambient."""
THERMAL_CAPACITY = 15.0
"""J/K"""
LEAST_CURRENT = 0.01
"""A: less than that does not damp, but only makes noise."""
WATCHED = (Mode.POSITION, Mode.STAY_WITHIN)
"""Modes in which the watchdog runs."""
MAX_CURRENT, MAX_TORQUE, MAX_VELOCITY, BOUNDS, HOT = 99, 102, 96, 103, 100
"""What limits the output, as the fault register says it."""


class Servo:
    """One controller's loops. Plain data."""

    def __init__(self, settings: Settings, command: Mapping[int, float]) -> None:
        self.settings = settings
        self.kt = torque_constant(settings)
        self.command = command
        self.wanted: int = Mode.STOPPED
        """The mode commanded; `mode` follows it if it can."""
        self.mode: int = Mode.STOPPED
        self.stopping = False
        """A stop was commanded and is still to be taken."""
        self.fault = 0
        self.limit = 0
        """Which limit is active."""
        self.timeout: float | None = None
        """s left; None: no watchdog runs"""
        self.rising = 0.0
        """s since enabling began"""
        self.offset = 0.0
        """What is subtracted from the shaft's revolutions."""
        self.shaft = 0.0
        self.position = 0.0
        self.velocity = 0.0
        self.setpoint = Setpoint()
        self.integral = 0.0
        self.error = 0.0
        self.velocity_error = 0.0
        self.terms = (0.0, 0.0, 0.0)
        """Torque of the proportional, integral and derivative part."""
        self.control_torque = 0.0
        self.iq = 0.0
        self.bus_voltage = settings.bus_voltage
        self.temperature = settings.ambient
        self.power = 0.0
        self.homed = 1
        """0 relative, 1 rotor, 2 output"""

    # -- what comes in ----------------------------------------------------------------------------

    def measure(self, dt: float, shaft: float, velocity: float) -> None:
        """The encoder: position in whole counts, velocity behind its filter's lag."""
        self.shaft = shaft
        cpr = self.settings.encoder_cpr
        self.position = math.floor(shaft * cpr + 0.5) / cpr - self.offset
        self.velocity += _lag(dt, self.settings.encoder_bandwidth) * (velocity - self.velocity)

    def call_position(self, position: float) -> None:
        """Set output exact or nearest: the present position is called so; a running set-point stays."""
        self.offset += self.position - position
        self.position = position
        self.homed = 2

    def recapture(self) -> None:
        """The set-point becomes what is measured (register 0x133)."""
        if self.mode == Mode.POSITION:
            self.setpoint.position, self.setpoint.velocity, self.integral = self.position, self.velocity, 0.0

    def take(self, mode: int, command: Mapping[int, float]) -> None:
        """A command arrived; it feeds the watchdog, and counts from the next turn of the loop on."""
        self.wanted, self.command = mode, command
        self.stopping = mode == Mode.STOPPED
        timeout = command[Register.COMMAND_TIMEOUT]
        timeout = self.settings.default_timeout_s if timeout == 0.0 else timeout
        self.timeout = None if math.isnan(timeout) else max(0.0, timeout)
        self.setpoint.take(command[Register.COMMAND_POSITION])

    def trip(self, code: int) -> None:
        """A fault: no torque until a stop."""
        self.mode, self.fault = Mode.FAULT, code

    # -- one turn of the loop ---------------------------------------------------------------------

    def step(self, dt: float) -> None:
        """One turn: mode, watches, torque."""
        if self.timeout is not None:
            self.timeout = max(0.0, self.timeout - dt)
        self._change_mode(dt)
        self._watch()
        if self.mode in WATCHED and self.timeout is not None and self.timeout <= 0.0:
            self.mode = Mode.TIMEOUT
        if self.mode != Mode.FAULT:
            self.fault = 0
        self.limit = 0
        if self.mode not in (Mode.POSITION, Mode.STAY_WITHIN, Mode.TIMEOUT):
            self._clear()
        self._drive(dt, self._limited(self._torque(dt)))

    def _change_mode(self, dt: float) -> None:
        """A fault and a timeout are left through a stop only; from a stop, enabling comes first."""
        if self.stopping:
            self.mode, self.stopping = Mode.STOPPED, False
        elif self.wanted == Mode.STOPPED:
            return
        elif self.mode == Mode.STOPPED:
            self.mode, self.rising = Mode.ENABLING, 0.0
        elif self.mode in RISING:
            self.rising += dt
            share = self.rising * 1000.0 / self.settings.enable_ms if self.settings.enable_ms else 1.0
            self.mode = Mode.ENABLING if share < 0.5 else Mode.CALIBRATING
            if share >= 1.0:
                self._enter()
        elif self.mode not in LATCHED and self.mode != self.wanted:
            self._enter()

    def _enter(self) -> None:
        if self.wanted in WATCHED and self._outside():
            self.trip(39)
            return
        if self.wanted in WATCHED and self._bounds_invalid():
            self.trip(48)
            return
        self.mode = self.wanted
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

    def _watch(self) -> None:
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
        """N·m that the mode asks for, before the limits of the current."""
        match self.mode:
            case Mode.POSITION:
                return self._position(dt)
            case Mode.STAY_WITHIN:
                return self._stay(dt)
            case Mode.CURRENT:
                return or_else(self.command[Register.COMMAND_Q_CURRENT], 0.0) * self.kt
            case Mode.VOLTAGE_DQ:
                return self._voltage() * self.kt
            case Mode.ZERO_VELOCITY:
                return self._damp()
            case Mode.BRAKE:
                return self._short()
            case Mode.TIMEOUT:
                return self._abandoned(dt)
        return 0.0

    def _position(self, dt: float) -> float:
        if self._deprecated():
            self.trip(45)
            return 0.0
        self.setpoint.follow(dt, self.settings, self.command, self.position, self.velocity)
        return self._bounded_by(self._pid(dt), self.command[Register.COMMAND_POSITION_MAX_TORQUE])

    def _deprecated(self) -> bool:
        stop = self.command[Register.COMMAND_STOP_POSITION]
        return not math.isnan(stop) and limits_of(self.settings, self.command) != (None, None)

    def _pid(self, dt: float) -> float:
        """The position loop around the set-point; also the feed-forward."""
        position, velocity = self.setpoint.position, self.setpoint.velocity
        s, get = self.settings, self.command.__getitem__
        kp = or_else(get(Register.COMMAND_KP_SCALE), 1.0)
        kd = min(or_else(get(Register.COMMAND_KD_SCALE), 1.0), max(kp, 0.0))
        self.error = 0.0 if position is None else position - self.position
        self.velocity_error = velocity - self.velocity
        most = s.ilimit * or_else(get(Register.COMMAND_ILIMIT_SCALE), 1.0)
        self.integral = max(-most, min(most, self.integral + s.ki * self.error * dt))
        self.terms = (s.kp * kp * self.error, self.integral, s.kd * kd * self.velocity_error)
        return sum(self.terms) + or_else(get(Register.COMMAND_FEEDFORWARD_TORQUE), 0.0)

    def _bounded_by(self, torque: float, most: float) -> float:
        if math.isnan(most) or abs(torque) <= abs(most):
            return torque
        self.limit = MAX_TORQUE
        return math.copysign(abs(most), torque)

    def _stay(self, dt: float) -> float:
        low = self.command[Register.COMMAND_WITHIN_LOWER_BOUND]
        high = self.command[Register.COMMAND_WITHIN_UPPER_BOUND]
        if self.position < low or self.position > high:
            self.setpoint.position, self.setpoint.velocity = low if self.position < low else high, 0.0
            torque = self._pid(dt)
        else:
            self._clear()
            torque = or_else(self.command[Register.COMMAND_FEEDFORWARD_TORQUE], 0.0)
        return self._bounded_by(torque, self.command[Register.COMMAND_POSITION_MAX_TORQUE])

    def _damp(self) -> float:
        return -self.settings.kd * or_else(self.command[Register.COMMAND_KD_SCALE], 1.0) * self.velocity

    def _short(self) -> float:
        """Brake: the phases are shorted through their resistance."""
        return -self.kt * self.kt * math.tau * self.velocity / (self.settings.phase_resistance * 1.5)

    def _voltage(self) -> float:
        """A that a voltage on the q axis drives against the motor's own."""
        back = self.kt * math.tau * self.velocity
        return (or_else(self.command[Register.VOLTAGEDQ_Q], 0.0) - back) / self.settings.phase_resistance

    def _abandoned(self, dt: float) -> float:
        """What servo.timeout_mode says, with its own limit of torque."""
        s = self.settings
        if s.timeout_mode == Mode.ZERO_VELOCITY:
            most = s.timeout_max_torque
            damping = -s.kd * self.velocity
            return 0.0 if abs(damping) < LEAST_CURRENT * self.kt else max(-most, min(most, damping))
        if s.timeout_mode == Mode.BRAKE:
            return self._short()
        if s.timeout_mode == Mode.POSITION:
            self.setpoint.come_to_rest(dt, s.default_accel_limit, self.position)
            return self._pid(dt)
        return 0.0

    # -- current ----------------------------------------------------------------------------------

    def _limited(self, torque: float) -> float:
        """N·m after the limits of position, velocity, temperature and current."""
        s, velocity, ignored = (
            self.settings,
            self.velocity,
            self.command[Register.COMMAND_IGNORE_POSITION_BOUNDS],
        )
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
        let_go = self.mode == Mode.TIMEOUT and s.timeout_mode == Mode.STOPPED
        off = self.mode in (Mode.STOPPED, Mode.FAULT) or self.mode in RISING or let_go
        wanted = 0.0 if off else torque / self.kt
        self.iq = 0.0 if off else self.iq + _lag(dt, s.current_bandwidth) * (wanted - self.iq)
        square = 1.5 * self.iq * self.iq
        self.power = self.torque() * self.velocity * math.tau + square * (s.phase_resistance + FET_RESISTANCE)
        self.bus_voltage = s.bus_voltage - s.bus_resistance * self.power / max(self.bus_voltage, 1.0)
        above = self.temperature - s.ambient
        heat = square * FET_RESISTANCE * THERMAL_RESISTANCE - above
        self.temperature += _lag(dt, 1.0 / (THERMAL_RESISTANCE * THERMAL_CAPACITY)) * heat

    def torque(self) -> float:
        """N·m on the shaft."""
        return self.iq * self.kt

    def reply(self) -> int:
        """The fault register: the fault, or which limit is active."""
        return self.fault if self.mode == Mode.FAULT else self.limit


def _lag(dt: float, bandwidth: float) -> float:
    """How much of a step a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)
