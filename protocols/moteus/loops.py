"""What is configured on a moteus, and the control loops of its firmware: mode, set-point, torque, monitors.

Rules. One call of `step` is one cycle of the loop, whatever its `dt` [s]. Names and units are the vendor's
(rev, rev/s, N·m, A, V, °C), so that settings can be compared with `moteus_tool --dump-config`. What the loops
know of the shaft comes from the encoder. No frame and no message in here. Source: mjbots/moteus@db1a762
`fw/bldc_servo_control.h`, `fw/bldc_servo_position.h`, `fw/pid.h`; set-points with limits are our own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import copysign, inf, isnan, nan, sqrt, tau
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.messages import SECOND, Nanos
from protocols.moteus.table import LATCHED, RISING, Mode
from protocols.toolkit.servo import Encoder, PowerStage, clamp

CAPTURED = 0.05  # rev/s: at less, a set-point that begins at the shaft begins at rest
MOST_TORQUE = 100.0  # N·m, of a command that names no largest torque
WATCHDOG_MODES = (Mode.POSITION, Mode.STAY_WITHIN)
MAX_VELOCITY, MAX_CURRENT, HOT, MAX_TORQUE, BOUNDS = 96, 99, 100, 102, 103
"""Codes of the fault register for what limits the output."""
PID_MODES = (*WATCHDOG_MODES, Mode.ZERO_VELOCITY, Mode.TIMEOUT)
COUNTED = 32768.0  # rev: the firmware counts no further


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device: by default a commissioned servo."""

    uuid: str = ""
    """32 hexadecimal digits, as on the packaging; "": from the address and the twin's seed"""
    firmware: str = "1.3.4"
    model: Annotated[int, Bounds(0, 0x7FFFFFFF)] = 0x030404
    register_map: Annotated[int, Bounds(0, 0x7FFFFFFF)] = 5

    kp: Annotated[float, Bounds(0.0, 1e6)] = 10.0
    """servo.pid_position.kp, N·m/rev"""
    ki: Annotated[float, Bounds(0.0, 1e6)] = 10.0
    """N·m/(rev·s)"""
    kd: Annotated[float, Bounds(0.0, 1e6)] = 0.4
    """N·m/(rev/s)"""
    ilimit: Annotated[float, Bounds(0.0, 1e6)] = 0.3
    """N·m"""
    position_min: Annotated[float, Bounds(-1e6, 1e6, nan="none")] = nan
    """servopos.position_min"""
    position_max: Annotated[float, Bounds(-1e6, 1e6, nan="none")] = nan
    position_derate: Annotated[float, Bounds(1e-6, 1e6)] = 0.02
    """beyond a limit, until the torque outwards is zero"""
    default_velocity_limit: Annotated[float, Bounds(0.0, 1e6, nan="none")] = nan
    default_accel_limit: Annotated[float, Bounds(0.0, 1e9, nan="none")] = nan
    default_timeout_s: Annotated[float, Bounds(0.0, 1e6, nan="no watchdog unless a command has one")] = 0.1
    timeout_mode: Annotated[int, Bounds(0, 15)] = int(Mode.ZERO_VELOCITY)
    timeout_max_torque: Annotated[float, Bounds(0.0, 1e6)] = 5.0
    fault_position_error: Annotated[float, Bounds(0.0, 1e6, nan="not watched")] = nan
    velocity_threshold: Annotated[float, Bounds(0.0, 1e6)] = 0.0005
    """rev/s: an error of less is none"""
    fault_velocity_error: Annotated[float, Bounds(0.0, 1e6, nan="not watched")] = nan

    motor_kv: Annotated[float, Bounds(1e-3, 1e6)] = 304.0
    """rpm/V"""
    max_current: Annotated[float, Bounds(1e-3, 1e6)] = 40.0
    max_velocity: Annotated[float, Bounds(1e-3, 1e6)] = 500.0
    """Above it the torque falls"""
    max_velocity_derate: Annotated[float, Bounds(1e-3, 1e6)] = 2.0
    current_bandwidth: Annotated[float, Bounds(1e-3, 1e6)] = 2000.0
    """rad/s of the current loop"""
    phase_resistance: Annotated[float, Bounds(1e-6, 1e6)] = 0.05
    """Ω"""
    encoder_cpr: Annotated[int, Bounds(1, 1 << 31)] = 16384
    """Counts per revolution of the output"""
    encoder_bandwidth: Annotated[float, Bounds(1e-3, 1e6)] = 1500.0
    """rad/s of the velocity's filter"""
    enable_ms: Annotated[int, Bounds(0, 1_000_000)] = 5
    """From stopped to a mode with torque"""
    reply_delay_us: Annotated[int, Bounds(0, 1_000_000_000)] = 0
    """From the end of a frame to its reply"""

    bus_voltage: Annotated[float, Bounds(1e-3, 1e6)] = 24.0
    """Without load"""
    bus_resistance: Annotated[float, Bounds(0.0, 1e6)] = 0.05
    """Ω of battery and cables"""
    max_voltage: Annotated[float, Bounds(1e-3, 1e6)] = 46.0
    min_voltage: Annotated[float, Bounds(0.0, 1e6)] = 4.0
    ambient: Annotated[float, Bounds(-273.0, 1e6)] = 25.0
    fault_temperature: Annotated[float, Bounds(-273.0, 1e6)] = 75.0
    motor_fault_temperature: Annotated[float, Bounds(-273.0, 1e6, nan="no motor thermistor")] = nan
    temperature_margin: Annotated[float, Bounds(1e-3, 1e6)] = 20.0
    """K below a fault's, in which the current is limited"""

    def __post_init__(self) -> None:
        hexadecimal = not self.uuid or re.fullmatch(r"[0-9a-f]{32}", self.uuid)
        version = re.fullmatch(r"\d{1,2}\.\d{1,2}\.\d{1,2}", self.firmware)
        known = self.timeout_mode in (Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE)
        check(
            self,
            ("uuid", "" if hexadecimal else "uuid must be 32 hexadecimal digits (0-9, a-f), without dashes"),
            ("firmware", "" if version else f"firmware {self.firmware!r} must be like 1.3.4"),
            ("timeout_mode", "" if known else "timeout_mode must be 0, 10, 12 or 15"),
        )

    @property
    def torque_constant(self) -> float:
        """N·m/A of the motor."""
        return 8.27 / self.motor_kv


def given(value: float, default: float) -> float:
    """Return the value of a register, or a default where it is "not given" (NaN)."""
    return default if isnan(value) else value


def limits_of(command: Mapping[str, float], s: Settings) -> tuple[float, float]:
    """Return the limits of velocity and acceleration that hold for a command; inf: none. With any of them the
    velocity is limited, and at most servo.max_velocity."""
    velocity = given(command["command_velocity_limit"], s.default_velocity_limit)
    acceleration = given(command["command_accel_limit"], s.default_accel_limit)
    if not (velocity >= 0.0 or acceleration >= 0.0):
        return inf, inf
    fastest = min(velocity, s.max_velocity) if velocity >= 0.0 else s.max_velocity
    return fastest, acceleration if acceleration >= 0.0 else inf


@dataclass(slots=True)
class Setpoint:
    """Set-point of the position loop. Without limits it is the commanded position, and goes on with the
    commanded velocity; with them it goes there along a trajectory, step by step."""

    position: float = nan  # NaN: it begins at the measured position
    velocity: float = 0.0
    goal: float = nan  # a commanded position that was not reached yet
    done: bool = True  # the trajectory is complete

    def take(self, position: float) -> None:
        """Take a commanded position; NaN: none, the set-point goes on from where it is."""
        self.goal = position

    def put(self, position: float = nan, velocity: float = 0.0) -> None:
        """Place it."""
        self.position, self.velocity = position, velocity

    def advance(self, dt: float, velocity: float, fastest: float, hardest: float) -> None:
        """Advance towards goal + velocity·t, without a goal at the velocity. Infinite: no limit."""
        if fastest == hardest == inf:
            self.put(given(self.goal, self.position) + velocity * dt, velocity)
            self.goal, self.done = nan, True
            return
        aim = velocity
        if not isnan(self.goal):
            self.goal += velocity * dt
            far = abs(self.goal - self.position)
            aim += copysign(
                min(far / dt, sqrt(2.0 * hardest * far) if far else 0.0), self.goal - self.position
            )
        change = clamp(clamp(aim, fastest) - self.velocity, hardest * dt)
        self.put(self.position + (self.velocity + change) * dt, self.velocity + change)
        self.done = abs(self.velocity - velocity) <= hardest * dt
        if not isnan(self.goal):
            self.done &= abs(self.goal - self.position) <= abs(change) * dt + 1e-6
            if self.done:
                self.put(self.goal, velocity)
                self.goal = nan


class Loops:
    """The control loops of one controller. Plain data."""

    def __init__(self, settings: Settings, command: Mapping[str, float]) -> None:
        s = self.settings = settings
        self.kt = s.torque_constant
        self.command = command
        self.commanded: int = Mode.STOPPED  # `mode` follows it where it can
        self.mode: int = Mode.STOPPED
        self.stopping = False  # a stop was commanded and is still to be executed
        self.fault = 0  # the fault register: the fault, or what limits the output now
        self.enabling = 0.0  # s since enabling began
        self.home_state = 1  # 0 relative, 1 rotor, 2 output
        self._timeout: Nanos = 0  # of the watchdog, by the command; no mode has one before the first
        self.velocity = 0.0  # rev/s, commanded
        self.fastest = self.hardest = inf
        self.scales = (1.0, 1.0, 1.0)  # of kp, kd and the integrator's limit
        self.encoder = Encoder(s.encoder_cpr, s.encoder_bandwidth)
        self.setpoint = Setpoint()
        motor, supply = (self.kt, s.current_bandwidth, s.phase_resistance), (s.bus_voltage, s.bus_resistance)
        self.stage = PowerStage(*motor, *supply, s.ambient, stage_thermal=(2.0, 15.0))
        self.error = self.velocity_error = self.torque_error = self.motor_temperature = 0.0
        self.proportional = self.integral = self.derivative = self.feedforward = self.control_torque = 0.0
        """N·m"""

    # -- inputs -----------------------------------------------------------------------------------

    def take(self, mode: int, command: Mapping[str, float]) -> None:
        """Take a command; it is executed from the next cycle on. What is wrong with it trips at once."""
        self.commanded, self.command = mode, command
        timeout = command["command_timeout"] or self.settings.default_timeout_s
        self._timeout = 0 if isnan(timeout) else max(1, round(timeout * SECOND))
        self.stopping |= mode == Mode.STOPPED
        self.fastest, self.hardest = limits_of(command, self.settings)
        self.velocity = clamp(self._given("velocity"), self.fastest)
        self.feedforward = self._given("feedforward_torque")
        kp, kd, ilimit = (self._given(f"{gain}_scale", 1.0) for gain in ("kp", "kd", "ilimit"))
        self.scales = kp, kd, ilimit
        position, stop = command["command_position"], command["command_stop_position"]
        self.setpoint.take(position)
        if isnan(position) and not isnan(stop):  # so that it gets there
            self.velocity = copysign(self.velocity, stop - self.encoder.position)
        if not isnan(stop) and self.fastest < inf and mode != Mode.STOPPED:
            self.trip(45)

    def set_output(self, position: float) -> None:
        """Assign a value to the present position (registers 0x130, 0x131); an active set-point stays."""
        self.encoder.set_position(position)
        self.home_state = 2

    def reindex(self) -> None:
        """Forget the home (register 0x132)."""
        self.home_state = 0

    def recapture(self) -> None:
        """Set the set-point to what is measured (register 0x133)."""
        self._clear()

    def trip(self, code: int) -> None:
        """Enter fault, or the mode of a timeout."""
        self.mode, self.fault = (code, 0) if code == Mode.TIMEOUT else (Mode.FAULT, code)
        self.stopping = False

    def timeout(self) -> Nanos:
        """Return the timeout of the watchdog; 0: it does not run."""
        return self._timeout if self.mode in WATCHDOG_MODES else 0

    # -- one cycle of the loop --------------------------------------------------------------------

    def step(self, dt: float, since: Nanos) -> None:
        """Run one cycle: mode, fault monitors, torque. `since`: time since the last command."""
        self._change_mode(dt)
        if 0 < self.timeout() < since:  # it has passed while the device enabled
            self.trip(Mode.TIMEOUT)
        self._monitor()
        self.fault = self.fault if self.mode == Mode.FAULT else 0
        if self.mode not in PID_MODES:
            self._clear()
        self.control_torque = self._limited(self._torque(dt))
        released = self.mode == Mode.TIMEOUT and self.settings.timeout_mode == Mode.STOPPED
        off = released or self.mode in (Mode.STOPPED, Mode.FAULT, *RISING)
        self.stage.drive(dt, None if off else self.control_torque, self.encoder.velocity * tau)
        self.torque_error = self.stage.torque - self.control_torque
        thermistor = not isnan(self.settings.motor_fault_temperature)
        self.motor_temperature = self.stage.motor_temperature if thermistor else 0.0

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
        self._clear()
        self.mode = self.commanded
        low, high = self._bounds()
        if self.mode in WATCHDOG_MODES and not low <= self.encoder.position <= high:
            self.trip(39)
        elif self.mode in WATCHDOG_MODES and any(COUNTED < abs(bound) < inf for bound in (low, high)):
            self.trip(48)

    def _clear(self) -> None:
        self.setpoint.put()
        self.error = self.velocity_error = self.proportional = self.integral = self.derivative = 0.0

    def _bounds(self) -> tuple[float, float]:
        """Return servopos.position_min and position_max, if the command does not have them ignored."""
        own = self.mode not in (Mode.TIMEOUT, Mode.ZERO_VELOCITY)
        if own and self.command["command_ignore_position_bounds"]:
            return -inf, inf
        return given(self.settings.position_min, -inf), given(self.settings.position_max, inf)

    def _monitor(self) -> None:
        s, stage = self.settings, self.stage
        if stage.voltage > s.max_voltage:
            code = 34
        elif stage.voltage < s.min_voltage:
            code = 40
        elif (
            stage.stage_temperature > s.fault_temperature
            or stage.motor_temperature > s.motor_fault_temperature
        ):
            code = 38
        else:
            return
        if self.mode not in (Mode.STOPPED, Mode.FAULT):
            self.trip(code)

    # -- torque -----------------------------------------------------------------------------------

    def _given(self, name: str, default: float = 0.0) -> float:
        return given(self.command[f"command_{name}"], default)

    def _torque(self, dt: float) -> float:
        """Return the torque [N·m] of the mode, before the limits of position, velocity, heat and current."""
        s, speed, lost = self.settings, self.encoder.velocity, self.mode == Mode.TIMEOUT
        match s.timeout_mode if lost else self.mode:
            case Mode.POSITION if lost:  # it comes to rest, with scales of its own
                self.setpoint.take(nan)
                fastest = given(s.default_velocity_limit, inf)
                self._advance(dt, 0.0, fastest, given(s.default_accel_limit, inf))
                return self._capped(self._pid(dt, 1.0, 1.0, 1.0), MOST_TORQUE)
            case Mode.POSITION:
                self._advance(dt, self.velocity, self.fastest, self.hardest)
                torque = self._pid(dt, *self.scales) + self.feedforward
                return self._capped(torque, self._given("position_max_torque", inf))
            case Mode.STAY_WITHIN:
                torque = self._stay_within(dt) + self.feedforward
                return self._capped(torque, self._given("position_max_torque", inf))
            case Mode.ZERO_VELOCITY:  # also after a timeout, with the last command's kd
                self.setpoint.take(nan)
                self._advance(dt, 0.0, inf, inf)
                return self._capped(self._pid(dt, 0.0, self.scales[1], 0.0), s.timeout_max_torque)
            case Mode.CURRENT:
                return self._given("q_current") * self.kt
            case Mode.VOLTAGE_DQ:  # through phase resistance and back-EMF
                voltage = given(self.command["voltagedq_q"], 0.0)
                return (voltage - self.kt * tau * speed) / s.phase_resistance * self.kt
            case Mode.BRAKE:  # phases are shorted
                return -self.kt * self.kt * tau * speed / (s.phase_resistance * 1.5)
        return 0.0

    def _advance(self, dt: float, velocity: float, fastest: float, hardest: float) -> None:
        """Advance the set-point, up to a bound or the stop position: there it has no velocity."""
        point, speed, stop = self.setpoint, self.encoder.velocity, nan
        if isnan(point.position):
            point.put(self.encoder.position, speed if abs(speed) >= CAPTURED else 0.0)
        point.advance(dt, velocity, fastest, hardest)
        low, high = self._bounds()
        held = max(low, min(high, point.position))
        if self.mode == Mode.POSITION:
            stop = self.command["command_stop_position"]
        if (held - stop) * point.velocity > 0.0:
            held = stop
        if held != point.position:
            point.put(held)

    def _pid(self, dt: float, kp: float, kd: float, ilimit: float) -> float:
        """Return the torque of the position loop around the set-point; errors too large trip."""
        s, point, encoder = self.settings, self.setpoint, self.encoder
        self.error, off = encoder.position - point.position, encoder.velocity - point.velocity
        self.velocity_error = 0.0 if abs(off) < s.velocity_threshold else off
        self.integral = clamp(self.integral + s.ki * self.error * dt, s.ilimit * ilimit)
        self.proportional, self.derivative = s.kp * kp * self.error, s.kd * kd * self.velocity_error
        if abs(self.error) > s.fault_position_error:
            self.trip(49)
        elif abs(self.velocity_error) > s.fault_velocity_error:
            self.trip(50)
        return -(self.proportional + self.integral + self.derivative)

    def _stay_within(self, dt: float) -> float:
        low, high = (self.command[f"command_within_{end}_bound"] for end in ("lower", "upper"))
        position, scales = self.encoder.position, self.scales
        bound = low if position < low else high if position > high else nan
        if isnan(bound):
            self._clear()
            scales = (0.0, 0.0, 0.0)
        else:
            self.setpoint.take(bound)
            self.setpoint.put(bound)
        self._advance(dt, 0.0, self.fastest, self.hardest)
        return self._pid(dt, *scales)

    def _capped(self, torque: float, most: float, code: int = MAX_TORQUE) -> float:
        """Return a torque within ±most; the fault register holds the code of what limits it."""
        if abs(torque) > most and self.mode != Mode.FAULT:
            self.fault = code
        return clamp(torque, most)

    def _limited(self, torque: float) -> float:
        """Return the torque [N·m] after the limits of position, velocity, temperature and current."""
        s, position, speed = self.settings, self.encoder.position, self.encoder.velocity
        low, high = self._bounds()
        beyond = max(position - high, 0.0) if torque > 0.0 else max(low - position, 0.0)
        if beyond and torque and self.mode != Mode.FAULT:  # outwards
            torque *= max(0.0, 1.0 - beyond / s.position_derate)
            self.fault = BOUNDS
        code, share = MAX_CURRENT, 1.0
        if speed * torque > 0.0 and abs(speed) > s.max_velocity:
            code, share = MAX_VELOCITY, max(0.0, 1.0 - (abs(speed) - s.max_velocity) / s.max_velocity_derate)
        cool = max(0.0, (s.fault_temperature - self.stage.stage_temperature) / s.temperature_margin)
        code, share = (HOT, cool) if cool < share else (code, share)
        return self._capped(torque, share * s.max_current * self.kt, code)
