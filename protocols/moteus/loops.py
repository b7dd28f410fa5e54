"""What is configured on a moteus, and the control loops of its firmware: mode, set-point, torque, monitors.

Rules. One call of `step` is one cycle of the loop, whatever its `dt` [s]. Names and units are the vendor's
(rev, rev/s, N·m, A, V, °C), so that settings can be compared with `moteus_tool --dump-config`. What the loops
know of the shaft comes from the encoder. No frame and no message in here. Sources: mjbots/moteus@1f4a195
`fw/bldc_servo.cc`, `fw/bldc_servo_control.h`; for set-points also mjbots/moteus@db1a762
`docs/protocol/registers.md`, `docs/reference/configuration.md`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import copysign, inf, isnan, nan, sqrt, tau

from protocols.messages import SECOND, Nanos
from protocols.moteus.table import LATCHED, RISING, Mode
from protocols.toolkit.options import bounded, check_bounds
from protocols.toolkit.servo import Encoder, PowerStage, clamp

MIN_CURRENT = 0.01  # A: a smaller damping current is noise, and is not applied
WATCHDOG_MODES = (Mode.POSITION, Mode.STAY_WITHIN)
MAX_VELOCITY, MAX_CURRENT, HOT, MAX_TORQUE, BOUNDS = 96, 99, 100, 102, 103
"""Codes of the fault register for what limits the output."""
COUNTED = 32768.0  # rev: the firmware counts no further


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device: by default a commissioned servo."""

    uuid: str = ""  # 32 hexadecimal digits, as on the packaging; "": from the address and the twin's seed
    firmware: str = "1.3.4"
    model: int = bounded(0x030404, 0, 0x7FFFFFFF)
    register_map: int = bounded(5, 0, 0x7FFFFFFF)

    kp: float = bounded(10.0, 0.0, 1e6)  # servo.pid_position.kp, N·m/rev
    ki: float = bounded(10.0, 0.0, 1e6)  # N·m/(rev·s)
    kd: float = bounded(0.4, 0.0, 1e6)  # N·m/(rev/s)
    ilimit: float = bounded(0.3, 0.0, 1e6)  # N·m
    position_min: float = bounded(nan, -1e6, 1e6, nan="none")  # servopos.position_min
    position_max: float = bounded(nan, -1e6, 1e6, nan="none")
    position_derate: float = bounded(0.02, 1e-6, 1e6)  # beyond a limit, until the torque outwards is zero
    default_velocity_limit: float = bounded(nan, -1e6, 1e6, nan="none")
    default_accel_limit: float = bounded(nan, -1e9, 1e9, nan="none")
    default_timeout_s: float = bounded(0.1, 0.0, 1e6, nan="no watchdog unless a command has one")
    timeout_mode: int = bounded(int(Mode.ZERO_VELOCITY), 0, 15)
    timeout_max_torque: float = bounded(5.0, 0.0, 1e6)
    fault_position_error: float = bounded(nan, 0.0, 1e6, nan="not watched")
    fault_velocity_error: float = bounded(nan, 0.0, 1e6, nan="not watched")

    motor_kv: float = bounded(304.0, 1e-3, 1e6)  # rpm/V
    max_current: float = bounded(40.0, 1e-3, 1e6)
    max_velocity: float = bounded(500.0, 1e-3, 1e6)  # above it the torque falls
    max_velocity_derate: float = bounded(2.0, 1e-3, 1e6)
    current_bandwidth: float = bounded(2000.0, 1e-3, 1e6)  # rad/s of the current loop
    phase_resistance: float = bounded(0.05, 1e-6, 1e6)  # Ω
    encoder_cpr: int = bounded(16384, 1, 1 << 31)  # counts per revolution of the output
    encoder_bandwidth: float = bounded(1500.0, 1e-3, 1e6)  # rad/s of the velocity's filter
    enable_ms: int = bounded(5, 0, 1_000_000)  # from stopped to a mode with torque
    reply_delay_us: int = bounded(0, 0, 1_000_000_000)  # from the end of a frame to its reply

    bus_voltage: float = bounded(24.0, 1e-3, 1e6)  # without load
    bus_resistance: float = bounded(0.05, 0.0, 1e6)  # Ω of battery and cables
    max_voltage: float = bounded(46.0, 1e-3, 1e6)
    min_voltage: float = bounded(4.0, 0.0, 1e6)
    ambient: float = bounded(25.0, -273.0, 1e6)
    fault_temperature: float = bounded(75.0, -273.0, 1e6)
    motor_fault_temperature: float = bounded(nan, -273.0, 1e6, nan="no motor thermistor")
    temperature_margin: float = bounded(20.0, 1e-3, 1e6)  # K below a fault's, in which the current is limited

    def __post_init__(self) -> None:
        hexadecimal = not self.uuid or re.fullmatch(r"[0-9a-f]{32}", self.uuid)
        version = re.fullmatch(r"\d{1,2}\.\d{1,2}\.\d{1,2}", self.firmware)
        known = self.timeout_mode in (Mode.STOPPED, Mode.POSITION, Mode.ZERO_VELOCITY, Mode.BRAKE)
        others = ["" if hexadecimal else "uuid must be 32 hexadecimal digits (0-9, a-f), without dashes"]
        others.append("" if version else f"firmware {self.firmware!r} must be like 1.3.4")
        check_bounds(self, [*others, "" if known else "timeout_mode must be 0, 10, 12 or 15"])

    @property
    def torque_constant(self) -> float:
        """N·m/A of the motor."""
        return 8.27 / self.motor_kv


def given(value: float, default: float) -> float:
    """Return the value of a register, or a default where it is "not given" (NaN)."""
    return default if isnan(value) else value


@dataclass(slots=True)
class Setpoint:
    """Set-point of the position loop. Without limits it is the commanded position, and goes on with the
    commanded velocity; with them it goes there along a trajectory, step by step."""

    position: float = nan  # NaN: it begins at the measured position
    velocity: float = 0.0
    fresh: float = nan  # a commanded position that was not used yet
    goal: float = nan  # end of a limited trajectory
    done: bool = True  # the trajectory is complete

    def take(self, position: float) -> None:
        """Take a commanded position; NaN: none, the set-point goes on from where it is."""
        self.fresh, self.goal = position, given(position, self.goal)

    def put(self, position: float = nan, velocity: float = 0.0) -> None:
        """Place it."""
        self.position, self.velocity = position, velocity

    def jump(self, dt: float, velocity: float, stop: float) -> None:
        """Advance without limits, but not beyond a stop position."""
        at = given(self.fresh, self.position) + velocity * dt
        reached = (at - stop) * velocity >= 0.0 and velocity != 0.0
        self.put(*((stop, 0.0) if reached else (at, velocity)))
        self.fresh, self.done = nan, True

    def follow(self, dt: float, goal: float, velocity: float, fastest: float, hardest: float) -> None:
        """Advance towards goal + velocity·t, without a goal (NaN) at the velocity. Infinite: no limit."""
        aim, self.fresh = velocity, nan
        if not isnan(goal):
            self.goal = goal = goal + velocity * dt
            far = abs(goal - self.position)
            aim += copysign(min(far / dt, sqrt(2.0 * hardest * far) if far else 0.0), goal - self.position)
        change = clamp(clamp(aim, fastest) - self.velocity, hardest * dt)
        self.put(self.position + (self.velocity + change) * dt, self.velocity + change)
        self.done = abs(self.velocity - velocity) <= hardest * dt
        self.done &= isnan(goal) or abs(goal - self.position) <= abs(change) * dt + 1e-6
        if self.done and not isnan(goal):
            self.put(goal, velocity)


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
        self.low, self.high = given(s.position_min, -inf), given(s.position_max, inf)
        self.encoder = Encoder(s.encoder_cpr, s.encoder_bandwidth)
        self.setpoint = Setpoint()
        motor, supply = (self.kt, s.current_bandwidth, s.phase_resistance), (s.bus_voltage, s.bus_resistance)
        self.stage = PowerStage(*motor, *supply, s.ambient, stage_thermal=(2.0, 15.0))
        self.error = self.velocity_error = self.torque_error = self.motor_temperature = 0.0
        self.proportional = self.integral = self.derivative = self.feedforward = self.control_torque = 0.0
        """N·m"""

    # -- inputs -----------------------------------------------------------------------------------

    def take(self, mode: int, command: Mapping[str, float]) -> None:
        """Take a command; it is executed from the next cycle on."""
        self.commanded, self.command, self.stopping = mode, command, mode == Mode.STOPPED
        self.feedforward = self._given("feedforward_torque")
        self.setpoint.take(command["command_position"])

    def set_output(self, position: float) -> None:
        """Assign a value to the present position (registers 0x130, 0x131); an active set-point stays."""
        self.encoder.set_position(position)
        self.home_state = 2

    def reindex(self) -> None:
        """Forget the home (register 0x132)."""
        self.home_state = 0

    def recapture(self) -> None:
        """Set the set-point to what is measured (register 0x133)."""
        if self.mode == Mode.POSITION:
            self.setpoint.put(self.encoder.position, self.encoder.velocity)
            self.integral = 0.0

    def trip(self, code: int) -> None:
        """Enter fault, or the mode of a timeout."""
        self.mode, self.fault = (code, 0) if code == Mode.TIMEOUT else (Mode.FAULT, code)
        self.stopping = False

    def timeout(self) -> Nanos:
        """Return the timeout of the watchdog; 0: it does not run."""
        timeout = self.command["command_timeout"] or self.settings.default_timeout_s
        return 0 if self.mode not in WATCHDOG_MODES or isnan(timeout) else max(1, round(timeout * SECOND))

    # -- one cycle of the loop --------------------------------------------------------------------

    def step(self, dt: float) -> None:
        """Run one cycle: mode, fault monitors, torque."""
        self._change_mode(dt)
        self._monitor()
        self.fault = self.fault if self.mode == Mode.FAULT else 0
        if self.mode not in (*WATCHDOG_MODES, Mode.TIMEOUT):
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
        bounds = (self.settings.position_min, self.settings.position_max)
        self._clear()
        if self.commanded in WATCHDOG_MODES and self._beyond() > 0.0:
            self.trip(39)
        elif self.commanded in WATCHDOG_MODES and any(abs(bound) > COUNTED for bound in bounds):
            self.trip(48)
        else:
            self.mode = self.commanded

    def _clear(self) -> None:
        self.setpoint.put()
        self.error = self.velocity_error = self.proportional = self.integral = self.derivative = 0.0

    def _beyond(self) -> float:
        """Return how far it is outside of servopos.position_min … position_max, if they are not ignored."""
        position, ignored = self.encoder.position, self.command["command_ignore_position_bounds"]
        return 0.0 if ignored else max(position - self.high, self.low - position)

    def _monitor(self) -> None:
        s, stage, running = self.settings, self.stage, self.mode == Mode.POSITION
        checks = {
            34: stage.voltage > s.max_voltage,
            40: stage.voltage < s.min_voltage,
            38: stage.stage_temperature > s.fault_temperature
            or stage.motor_temperature > s.motor_fault_temperature,
            49: running and abs(self.error) > s.fault_position_error,
            50: running and abs(self.velocity_error) > s.fault_velocity_error,
        }
        code = next((code for code, wrong in checks.items() if wrong), 0)
        if code and self.mode not in (Mode.STOPPED, Mode.FAULT):
            self.trip(code)

    # -- torque -----------------------------------------------------------------------------------

    def _given(self, name: str, default: float = 0.0) -> float:
        return given(self.command[f"command_{name}"], default)

    def _torque(self, dt: float) -> float:
        """Return the torque [N·m] of the mode, before the limits of position, velocity, heat and current."""
        s, speed, timeout = self.settings, self.encoder.velocity, self.mode == Mode.TIMEOUT
        mode = s.timeout_mode if timeout else self.mode
        if mode == Mode.POSITION and isnan(self.setpoint.position):
            self.setpoint.put(self.encoder.position, 0.0 if timeout else speed)
        match mode:
            case Mode.POSITION if timeout:  # it comes to rest
                self.setpoint.follow(dt, nan, 0.0, inf, given(s.default_accel_limit, inf))
                return self._pid(dt)
            case Mode.POSITION:
                return self._within_most(self._position(dt))
            case Mode.STAY_WITHIN:
                return self._within_most(self._stay_within(dt))
            case Mode.CURRENT:
                return self._given("q_current") * self.kt
            case Mode.VOLTAGE_DQ:  # through phase resistance and back-EMF
                voltage = given(self.command["voltagedq_q"], 0.0)
                return (voltage - self.kt * tau * speed) / s.phase_resistance * self.kt
            case Mode.ZERO_VELOCITY if timeout:
                damping = -s.kd * speed
                return 0.0 if abs(damping) < MIN_CURRENT * self.kt else clamp(damping, s.timeout_max_torque)
            case Mode.ZERO_VELOCITY:
                return -s.kd * self._given("kd_scale", 1.0) * speed
            case Mode.BRAKE:  # phases are shorted
                return -self.kt * self.kt * tau * speed / (s.phase_resistance * 1.5)
        return 0.0

    def _position(self, dt: float) -> float:
        s, setpoint, velocity = self.settings, self.setpoint, self._given("velocity")
        fastest = self._given("velocity_limit", s.default_velocity_limit)
        hardest = self._given("accel_limit", s.default_accel_limit)
        stop = self.command["command_stop_position"]
        if fastest >= 0.0 or hardest >= 0.0:
            if not isnan(stop):
                self.trip(45)
                return 0.0
            goal = nan if isnan(self.command["command_position"]) else setpoint.goal
            fastest, hardest = (limit if limit >= 0.0 else inf for limit in (fastest, hardest))
            setpoint.follow(dt, goal, velocity, fastest, hardest)
        else:
            setpoint.jump(dt, velocity, stop)
        if not self.command["command_ignore_position_bounds"]:
            setpoint.put(max(self.low, min(self.high, setpoint.position)), setpoint.velocity)
        return self._pid(dt)

    def _pid(self, dt: float) -> float:
        """Return the torque of the position loop around the set-point, with feed-forward."""
        s, setpoint = self.settings, self.setpoint
        kp = self._given("kp_scale", 1.0)
        kd = min(self._given("kd_scale", 1.0), max(kp, 0.0))
        self.error = setpoint.position - self.encoder.position
        self.velocity_error = setpoint.velocity - self.encoder.velocity
        ilimit = s.ilimit * self._given("ilimit_scale", 1.0)
        self.integral = clamp(self.integral + s.ki * self.error * dt, ilimit)
        self.proportional, self.derivative = s.kp * kp * self.error, s.kd * kd * self.velocity_error
        return self.proportional + self.integral + self.derivative + self.feedforward

    def _within_most(self, torque: float) -> float:
        """Return a torque within the commanded largest torque."""
        most = abs(self._given("position_max_torque", inf))
        self.fault = MAX_TORQUE if abs(torque) > most else self.fault
        return clamp(torque, most)

    def _stay_within(self, dt: float) -> float:
        low, high = (self.command[f"command_within_{end}_bound"] for end in ("lower", "upper"))
        position = self.encoder.position
        if position < low or position > high:
            self.setpoint.put(low if position < low else high)
            return self._pid(dt)
        self._clear()
        return self.feedforward

    def _limited(self, torque: float) -> float:
        """Return the torque [N·m] after the limits of position, velocity, temperature and current."""
        s, speed, beyond = self.settings, abs(self.encoder.velocity), self._beyond()
        if beyond > 0.0 and torque * (self.encoder.position - self.high) > 0.0:  # outwards
            torque *= max(0.0, 1.0 - beyond / s.position_derate)
            self.fault = BOUNDS
        code, share = MAX_CURRENT, 1.0
        if self.encoder.velocity * torque > 0.0 and speed > s.max_velocity:
            code, share = MAX_VELOCITY, max(0.0, 1.0 - (speed - s.max_velocity) / s.max_velocity_derate)
        cool = max(0.0, (s.fault_temperature - self.stage.stage_temperature) / s.temperature_margin)
        code, share = (HOT, cool) if cool < share else (code, share)
        most = share * s.max_current * self.kt
        self.fault = code if abs(torque) > most else self.fault
        return clamp(torque, most)
