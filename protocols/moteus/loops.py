"""The control loops of the firmware: mode, set-point, torque, limits, and its fault monitors.

Rules. One call of `step` is one cycle of the loop, whatever its `dt` [s]. Units are the firmware's: rev,
rev/s, N·m, A. What the loops know of the shaft comes from the encoder. No frame and no message in here.
Sources: mjbots/moteus@1f4a195 `fw/bldc_servo.cc`, `fw/bldc_servo_control.h`; set-points also
mjbots/moteus@db1a762 `docs/protocol/registers.md`, `docs/reference/configuration.md`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from math import isnan, nan, tau

from protocols.messages import SECOND, Nanos
from protocols.moteus.settings import Settings, torque_constant
from protocols.moteus.table import LATCHED, RISING, Mode
from protocols.toolkit.servo import Encoder, PowerStage, clamp

MIN_CURRENT = 0.01
"""A: a smaller damping current is noise, and is not applied"""
WATCHDOG_MODES = (Mode.POSITION, Mode.STAY_WITHIN)
"""Modes in which the watchdog runs."""
MAX_VELOCITY, MAX_CURRENT, HOT, MAX_TORQUE, BOUNDS = 96, 99, 100, 102, 103
"""Codes of the fault register for what limits the output."""
COUNTED = 32768.0
"""rev: the firmware counts no further"""


def or_default(value: float, other: float) -> float:
    """Return the value of a register, or a default where it is "not given" (NaN)."""
    return other if isnan(value) else value


@dataclass(slots=True)
class Setpoint:
    """Set-point of the position loop. Without limits of velocity or acceleration it is the commanded position,
    and goes on with the commanded velocity; with them it goes there along a trajectory, step by step."""

    position: float = nan
    """NaN: it begins at the measured position."""
    velocity: float = 0.0
    fresh: float = nan
    """A commanded position that was not used yet."""
    goal: float = nan
    """End of a limited trajectory; NaN: it keeps its velocity."""
    done: bool = True
    """The trajectory is complete."""

    def take(self, position: float) -> None:
        """Take a commanded position; NaN: none, the set-point goes on from where it is."""
        self.fresh, self.goal = position, or_default(position, self.goal)

    def put(self, position: float = nan, velocity: float = 0.0) -> None:
        """Place it."""
        self.position, self.velocity = position, velocity

    def jump(self, dt: float, shaft: float, velocity: float, stop: float) -> None:
        """Advance without limits, but not beyond a stop position."""
        at = or_default(self.fresh, or_default(self.position, shaft)) + velocity * dt
        reached = (at - stop) * velocity >= 0.0 and velocity != 0.0
        self.put(*((stop, 0.0) if reached else (at, velocity)))
        self.fresh, self.done = nan, True

    def follow(self, dt: float, goal: float, velocity: float, fastest: float, hardest: float) -> None:
        """Advance towards goal + velocity·t, without a goal (NaN) at the velocity. Infinite: no limit."""
        aim, self.fresh = velocity, nan
        if not isnan(goal):
            self.goal = goal = goal + velocity * dt
            distance = goal - self.position
            speed = min(abs(distance) / dt, math.sqrt(2.0 * hardest * abs(distance)) if distance else 0.0)
            aim += math.copysign(speed, distance)
        change = clamp(clamp(aim, fastest) - self.velocity, hardest * dt)
        self.velocity += change
        self.position += self.velocity * dt
        self.done = abs(self.velocity - velocity) <= hardest * dt
        if not isnan(goal):
            self.done = self.done and abs(goal - self.position) <= abs(change) * dt + 1e-6
            if self.done:
                self.put(goal, velocity)

    def come_to_rest(self, dt: float, hardest: float, shaft: float) -> None:
        """Slow down with this acceleration [rev/s²]; NaN: at once."""
        self.velocity -= clamp(self.velocity, or_default(hardest, math.inf) * dt)
        self.position = or_default(self.position, shaft) + self.velocity * dt


class Loops:
    """The control loops of one controller. Plain data."""

    def __init__(self, settings: Settings, command: Mapping[str, float]) -> None:
        self.settings = settings
        self.kt = torque_constant(settings.motor_kv)
        self.command = command
        self.commanded: int = Mode.STOPPED
        """`mode` follows it where it can."""
        self.mode: int = Mode.STOPPED
        self.stopping = False
        """A stop was commanded and is still to be executed."""
        self.fault = 0
        self.limit = 0
        """Code of the active limit, or 0"""
        self.enabling = 0.0
        """s since enabling began"""
        self.home_state = 1
        """0 relative, 1 rotor, 2 output"""
        self.low = or_default(settings.position_min, -math.inf)
        self.high = or_default(settings.position_max, math.inf)
        self.encoder = Encoder(settings.encoder_cpr, settings.encoder_bandwidth)
        self.setpoint = Setpoint()
        self.stage = PowerStage(
            self.kt,
            settings.current_bandwidth,
            settings.phase_resistance,
            settings.bus_voltage,
            settings.bus_resistance,
            settings.ambient,
            stage_thermal=(2.0, 15.0),
        )
        self.integral = self.error = self.velocity_error = self.control_torque = 0.0
        self.terms = (0.0, 0.0)
        """Torque of the proportional and derivative term"""

    # -- inputs -----------------------------------------------------------------------------------

    def take(self, mode: int, command: Mapping[str, float]) -> None:
        """Take a command; it is executed from the next cycle on."""
        self.commanded, self.command, self.stopping = mode, command, mode == Mode.STOPPED
        self.setpoint.take(command["command_position"])

    def reindex(self) -> None:
        """Forget the home (register 0x132)."""
        self.home_state = 0

    def set_output(self, position: float) -> None:
        """Assign a value to the present position (registers 0x130, 0x131); an active set-point stays."""
        self.encoder.set_position(position)
        self.home_state = 2

    def recapture(self) -> None:
        """Set the set-point to what is measured (register 0x133)."""
        if self.mode == Mode.POSITION:
            self.setpoint.put(self.encoder.position, self.encoder.velocity)
            self.integral = 0.0

    def trip(self, code: int) -> None:
        """Enter fault, or after a timeout that mode: no torque until a stop."""
        self.mode, self.fault = (Mode.TIMEOUT, 0) if code == Mode.TIMEOUT else (Mode.FAULT, code)
        self.stopping = False

    def timeout(self) -> Nanos:
        """Return the timeout of the watchdog; 0: it does not run."""
        given = self.command["command_timeout"]
        timeout = self.settings.default_timeout_s if given == 0.0 else given
        return 0 if self.mode not in WATCHDOG_MODES or isnan(timeout) else max(1, round(timeout * SECOND))

    # -- one cycle of the loop --------------------------------------------------------------------

    def step(self, dt: float) -> None:
        """Run one cycle: mode, fault monitors, torque."""
        self._change_mode(dt)
        self._monitor()
        if self.mode != Mode.FAULT:
            self.fault = 0
        self.limit = 0
        if self.mode not in (*WATCHDOG_MODES, Mode.TIMEOUT):
            self._clear()
        self.control_torque = self._limited(self._torque(dt))
        released = self.mode == Mode.TIMEOUT and self.settings.timeout_mode == Mode.STOPPED
        off = released or self.mode in (Mode.STOPPED, Mode.FAULT, *RISING)
        self.stage.drive(dt, None if off else self.control_torque, self.encoder.velocity * tau)

    def _change_mode(self, dt: float) -> None:
        """Follow the commanded mode. Only a stop leaves fault and timeout; enabling comes after a stop."""
        if self.stopping:
            self.mode, self.stopping = Mode.STOPPED, False
        elif self.commanded == Mode.STOPPED or self.mode in (*LATCHED, self.commanded):
            return
        elif self.mode == Mode.STOPPED:
            self.mode, self.enabling = Mode.ENABLING, 0.0
        else:
            self.enabling += dt
            whole = self.settings.enable_ms / 1000.0
            if self.mode not in RISING or self.enabling >= whole:
                self._enter()
            elif self.enabling >= 0.5 * whole:
                self.mode = Mode.CALIBRATING

    def _enter(self) -> None:
        bounds = (self.settings.position_min, self.settings.position_max)
        if self.commanded in WATCHDOG_MODES:
            if self._beyond() > 0.0 and not self._ignoring():
                return self.trip(39)
            if any(abs(bound) > COUNTED for bound in bounds):
                return self.trip(48)
        self.mode = self.commanded
        return self._clear()

    def _beyond(self) -> float:
        """Return how far it is outside of servopos.position_min … position_max."""
        return max(self.encoder.position - self.high, self.low - self.encoder.position)

    def _clear(self) -> None:
        self.setpoint.put()
        self.integral = self.error = self.velocity_error = 0.0
        self.terms = (0.0, 0.0)

    def _ignoring(self) -> bool:
        return bool(self.command["command_ignore_position_bounds"])

    def _monitor(self) -> None:
        s, stage, running = self.settings, self.stage, self.mode == Mode.POSITION
        checks = {
            34: stage.voltage > s.max_voltage,
            40: stage.voltage < s.min_voltage,
            38: stage.stage_temperature > s.fault_temperature,
            49: running and abs(self.error) > s.fault_position_error,
            50: running and abs(self.velocity_error) > s.fault_velocity_error,
        }
        code = next((code for code, wrong in checks.items() if wrong), 0)
        if code and self.mode not in (Mode.STOPPED, Mode.FAULT):
            self.trip(code)

    # -- torque -----------------------------------------------------------------------------------

    def _given(self, name: str, default: float) -> float:
        return or_default(self.command[f"command_{name}"], default)

    def _torque(self, dt: float) -> float:
        """Return the torque [N·m] of the mode, before the current limits."""
        s, speed = self.settings, self.encoder.velocity
        match self.mode:
            case Mode.POSITION:
                return self._position(dt)
            case Mode.STAY_WITHIN:
                return self._stay_within(dt)
            case Mode.CURRENT:
                return self._given("q_current", 0.0) * self.kt
            case Mode.VOLTAGE_DQ:  # through phase resistance and back-EMF
                voltage = or_default(self.command["voltagedq_q"], 0.0)
                return (voltage - self.kt * tau * speed) / s.phase_resistance * self.kt
            case Mode.ZERO_VELOCITY:
                return -s.kd * self._given("kd_scale", 1.0) * speed
            case Mode.BRAKE:
                return self._brake()
            case Mode.TIMEOUT:
                return self._timeout(dt)
        return 0.0

    def _position(self, dt: float) -> float:
        s, setpoint, encoder = self.settings, self.setpoint, self.encoder
        fastest, hardest = (
            self._given(f"{name}_limit", default)
            for name, default in (("velocity", s.default_velocity_limit), ("accel", s.default_accel_limit))
        )
        limited, stop = fastest >= 0.0 or hardest >= 0.0, self.command["command_stop_position"]
        if limited and not isnan(stop):
            self.trip(45)
            return 0.0
        velocity = self._given("velocity", 0.0)
        if limited:
            if isnan(setpoint.position):
                setpoint.put(encoder.position, encoder.velocity)
            goal = nan if isnan(self.command["command_position"]) else setpoint.goal
            fastest, hardest = (limit if limit >= 0.0 else math.inf for limit in (fastest, hardest))
            setpoint.follow(dt, goal, velocity, fastest, hardest)
        else:
            setpoint.jump(dt, encoder.position, velocity, stop)
        if not self._ignoring():
            setpoint.put(max(self.low, min(self.high, setpoint.position)), setpoint.velocity)
        return self._pid(dt)

    def _pid(self, dt: float) -> float:
        """Return the torque of the position loop around the set-point, with feed-forward, within the commanded
        largest torque."""
        s, setpoint = self.settings, self.setpoint
        kp = self._given("kp_scale", 1.0)
        kd = min(self._given("kd_scale", 1.0), max(kp, 0.0))
        self.error = or_default(setpoint.position - self.encoder.position, 0.0)
        self.velocity_error = setpoint.velocity - self.encoder.velocity
        change = s.ki * self.error * dt
        self.integral = clamp(self.integral + change, s.ilimit * self._given("ilimit_scale", 1.0))
        self.terms = (s.kp * kp * self.error, s.kd * kd * self.velocity_error)
        return self._within_most(sum(self.terms) + self.integral + self._given("feedforward_torque", 0.0))

    def _within_most(self, torque: float) -> float:
        most = abs(self._given("position_max_torque", math.inf))
        self.limit = MAX_TORQUE if abs(torque) > most else self.limit
        return clamp(torque, most)

    def _stay_within(self, dt: float) -> float:
        low, high = (self.command[f"command_within_{end}_bound"] for end in ("lower", "upper"))
        position = self.encoder.position
        if position < low or position > high:
            self.setpoint.put(low if position < low else high)
            return self._pid(dt)
        self._clear()
        return self._within_most(self._given("feedforward_torque", 0.0))

    def _brake(self) -> float:
        """Return the torque of phases that are shorted through their resistance."""
        return -self.kt * self.kt * tau * self.encoder.velocity / (self.settings.phase_resistance * 1.5)

    def _timeout(self, dt: float) -> float:
        """Return the torque of servo.timeout_mode, with its own torque limit."""
        s = self.settings
        if s.timeout_mode == Mode.ZERO_VELOCITY:
            damping = -s.kd * self.encoder.velocity
            return 0.0 if abs(damping) < MIN_CURRENT * self.kt else clamp(damping, s.timeout_max_torque)
        if s.timeout_mode == Mode.BRAKE:
            return self._brake()
        if s.timeout_mode == Mode.POSITION:
            self.setpoint.come_to_rest(dt, s.default_accel_limit, self.encoder.position)
            return self._pid(dt)
        return 0.0

    def _limited(self, torque: float) -> float:
        """Return the torque [N·m] after the limits of position, velocity, temperature and current."""
        s, velocity, beyond = self.settings, self.encoder.velocity, self._beyond()
        outwards = torque != 0.0 and (torque > 0.0) == (self.encoder.position > self.high)
        if beyond > 0.0 and outwards and not self._ignoring():
            torque *= max(0.0, 1.0 - beyond / s.position_derate)
            self.limit = BOUNDS
        code, share = MAX_CURRENT, 1.0
        if velocity * torque > 0.0 and abs(velocity) > s.max_velocity:
            code, share = (
                MAX_VELOCITY,
                max(0.0, 1.0 - (abs(velocity) - s.max_velocity) / s.max_velocity_derate),
            )
        cool = max(0.0, (s.fault_temperature - self.stage.stage_temperature) / s.temperature_margin)
        code, share = (HOT, cool) if cool < share else (code, share)
        most = share * s.max_current * self.kt
        self.limit = code if abs(torque) > most else self.limit
        return clamp(torque, most)
