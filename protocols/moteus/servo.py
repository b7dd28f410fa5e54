"""The control loops of the firmware: set-point → torque → current, and what it watches over.

Rules. One call of `step` is one turn of the loop, whatever its `dt`. Units are the firmware's: rev, rev/s,
N·m, A, s. Everything the loops know of the shaft comes through `measure`, quantised as an encoder would. No
wire and no word in here. Sources: modes and their transitions, watchdog, limit codes mjbots/moteus@1f4a195
`fw/bldc_servo.cc`, `fw/bldc_servo_control.h`; trajectories `docs/reference/configuration.md`
(servo.default_velocity_limit). Supply and heat are models of ours (README, "the twin").
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from protocols.moteus.options import Settings, torque_constant
from protocols.moteus.registers import LATCHED, RISING, Mode, Register

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
        self.control_position: float | None = None
        self.control_velocity = 0.0
        self.fresh: float | None = None
        """A position that was commanded and is still to be taken."""
        self.goal: float | None = None
        """Where a limited trajectory leads; None: nowhere, it keeps its velocity."""
        self.trajectory_done = True
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
            self.control_position, self.control_velocity, self.integral = self.position, self.velocity, 0.0

    def take(self, mode: int, command: Mapping[int, float]) -> None:
        """A command arrived; it feeds the watchdog, and counts from the next turn of the loop on."""
        self.wanted, self.command = mode, command
        self.stopping = mode == Mode.STOPPED
        timeout = command[Register.COMMAND_TIMEOUT]
        timeout = self.settings.default_timeout_s if timeout == 0.0 else timeout
        self.timeout = None if math.isnan(timeout) else max(0.0, timeout)
        position = command[Register.COMMAND_POSITION]
        self.fresh = None if math.isnan(position) else position
        if not math.isnan(position):
            self.goal = position

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
        self.integral, self.control_position, self.control_velocity = 0.0, None, 0.0
        self.error = self.velocity_error = 0.0
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
                return _or(self.command[Register.COMMAND_Q_CURRENT], 0.0) * self.kt
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
        self._follow(dt)
        return self._bounded_by(
            self._pid(dt, self.control_position, self.control_velocity),
            self.command[Register.COMMAND_POSITION_MAX_TORQUE],
        )

    def _deprecated(self) -> bool:
        stop = self.command[Register.COMMAND_STOP_POSITION]
        return not math.isnan(stop) and any(limit is not None for limit in self._trajectory_limits())

    def _trajectory_limits(self) -> tuple[float | None, float | None]:
        """Of velocity and acceleration; None: none. A negative one in a command switches it off."""
        s = self.settings
        pairs = (
            (self.command[Register.COMMAND_VELOCITY_LIMIT], s.default_velocity_limit),
            (self.command[Register.COMMAND_ACCEL_LIMIT], s.default_accel_limit),
        )
        chosen = [default if math.isnan(said) else said for said, default in pairs]
        fastest, hardest = (None if math.isnan(x) or x < 0 else x for x in chosen)
        return fastest, hardest

    def _follow(self, dt: float) -> None:
        """The set-point moves: at once where nothing limits it, else along a trajectory."""
        fastest, hardest = self._trajectory_limits()
        wanted = _or(self.command[Register.COMMAND_VELOCITY], 0.0)
        begun = self.control_position is None
        at = self.position if self.control_position is None else self.control_position
        if fastest is None and hardest is None:
            at = at if self.fresh is None else self.fresh
            self.control_velocity, self.trajectory_done = wanted, True
            self.control_position = self._stopped_at(at + wanted * dt)
        else:
            self.control_velocity = self.velocity if begun else self.control_velocity
            self.control_position = at
            self._trajectory(dt, wanted, fastest, hardest)
        self.fresh = None
        s = self.settings
        low, high = s.position_min, s.position_max
        if not self.command[Register.COMMAND_IGNORE_POSITION_BOUNDS]:
            self.control_position = _between(self.control_position, low, high)

    def _stopped_at(self, at: float) -> float:
        stop = self.command[Register.COMMAND_STOP_POSITION]
        if math.isnan(stop) or self.control_velocity == 0.0:
            return at
        reached = (at - stop) * self.control_velocity >= 0.0
        self.control_velocity = 0.0 if reached else self.control_velocity
        return stop if reached else at

    def _trajectory(self, dt: float, wanted: float, fastest: float | None, hardest: float | None) -> None:
        """Towards x = goal + wanted·t, or to a velocity where no position was commanded; step by step."""
        at = self.control_position or 0.0
        goal = None if math.isnan(self.command[Register.COMMAND_POSITION]) else self.goal
        aim = wanted
        if goal is not None:
            self.goal = goal + wanted * dt
            way = self.goal - at
            room = abs(way) / dt if hardest is None else math.sqrt(2.0 * hardest * abs(way))
            aim = wanted + math.copysign(min(room, abs(way) / dt), way)
        if fastest is not None:
            aim = max(-fastest, min(fastest, aim))
        change = aim - self.control_velocity
        if hardest is not None:
            change = max(-hardest * dt, min(hardest * dt, change))
        self.control_velocity += change
        self.control_position = at + self.control_velocity * dt
        done = abs(self.control_velocity - wanted) <= (hardest or math.inf) * dt
        if goal is not None:
            done = done and abs((self.goal or 0.0) - self.control_position) <= abs(change) * dt + 1e-6
            if done:
                self.control_position, self.control_velocity = self.goal, wanted
        self.trajectory_done = done

    def _pid(self, dt: float, position: float | None, velocity: float) -> float:
        """The position loop; also the feed-forward."""
        s, get = self.settings, self.command.__getitem__
        kp = _or(get(Register.COMMAND_KP_SCALE), 1.0)
        kd = min(_or(get(Register.COMMAND_KD_SCALE), 1.0), max(kp, 0.0))
        self.error = 0.0 if position is None else position - self.position
        self.velocity_error = velocity - self.velocity
        most = s.ilimit * _or(get(Register.COMMAND_ILIMIT_SCALE), 1.0)
        self.integral = max(-most, min(most, self.integral + s.ki * self.error * dt))
        self.terms = (s.kp * kp * self.error, self.integral, s.kd * kd * self.velocity_error)
        return sum(self.terms) + _or(get(Register.COMMAND_FEEDFORWARD_TORQUE), 0.0)

    def _bounded_by(self, torque: float, most: float) -> float:
        if math.isnan(most) or abs(torque) <= abs(most):
            return torque
        self.limit = MAX_TORQUE
        return math.copysign(abs(most), torque)

    def _stay(self, dt: float) -> float:
        low = self.command[Register.COMMAND_WITHIN_LOWER_BOUND]
        high = self.command[Register.COMMAND_WITHIN_UPPER_BOUND]
        if self.position < low or self.position > high:
            self.control_position = low if self.position < low else high
            torque = self._pid(dt, self.control_position, 0.0)
        else:
            self._clear()
            torque = _or(self.command[Register.COMMAND_FEEDFORWARD_TORQUE], 0.0)
        return self._bounded_by(torque, self.command[Register.COMMAND_POSITION_MAX_TORQUE])

    def _damp(self) -> float:
        return -self.settings.kd * _or(self.command[Register.COMMAND_KD_SCALE], 1.0) * self.velocity

    def _short(self) -> float:
        """Brake: the phases are shorted through their resistance."""
        return -self.kt * self.kt * math.tau * self.velocity / (self.settings.phase_resistance * 1.5)

    def _voltage(self) -> float:
        """A that a voltage on the q axis drives against the motor's own."""
        back = self.kt * math.tau * self.velocity
        return (_or(self.command[Register.VOLTAGEDQ_Q], 0.0) - back) / self.settings.phase_resistance

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
            return self._come_to_rest(dt)
        return 0.0

    def _come_to_rest(self, dt: float) -> float:
        hardest = self.settings.default_accel_limit
        change = abs(self.control_velocity) if math.isnan(hardest) else hardest * dt
        at = self.position if self.control_position is None else self.control_position
        self.control_velocity -= math.copysign(min(change, abs(self.control_velocity)), self.control_velocity)
        self.control_position = at + self.control_velocity * dt
        return self._pid(dt, self.control_position, self.control_velocity)

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

    def told(self) -> int:
        """The fault register: the fault, or which limit is active."""
        return self.fault if self.mode == Mode.FAULT else self.limit


def _or(value: float, other: float) -> float:
    """A register that may be "not given"."""
    return other if math.isnan(value) else value


def _between(value: float, low: float, high: float) -> float:
    """Within bounds, where there are some."""
    if value < low:
        return low
    return high if value > high else value


def _lag(dt: float, bandwidth: float) -> float:
    """How much of a step a first-order lag has followed after dt."""
    return -math.expm1(-bandwidth * dt)
