"""The twin's motor control: set-point generation in each mode, stopping, and the loops.

Rules. One call of `step` is one cycle of the firmware, whatever its `dt`. Everything the loops know of the
shaft comes through the encoder, in whole increments. Quantities are SI at the device's shaft; limits, ramps
and windows are read from the dictionary in the drive's units at every cycle, so that they may be written
while it runs. No frames and no commands here.

Source: CiA 402-2 (modes, option codes 605A to 605E, 6065, 6067, 606D, 606F, 607D, 607F, 6080, 6072). The
loops are this project's choice: P for position, PI for velocity, a lag for the current.
"""

from __future__ import annotations

import math
from dataclasses import replace

from protocols.cia402 import objects as o
from protocols.cia402.faults import FOLLOWING_ERROR
from protocols.cia402.memory import Memory
from protocols.cia402.profile import Control, Mode, PowerState
from protocols.cia402.settings import NEVER_FOLLOWING, Settings
from protocols.toolkit.servo import Encoder, Trapezoid, approach, clamp, lag

STANDSTILL = 0.02
"""rad/s below which a shaft that is slowed down counts as at standstill."""
SLOW_DOWN, QUICK_RAMP = 1, 2
"""Option codes that slow down, the same plus 4 for quick stop: 1 by 6084, 2 by 6085, 3 at the current
limit."""
ENABLED = PowerState.OPERATION_ENABLED


def lasting(dt: float, span: float | None, holds: bool) -> float | None:
    """Return for how long [s] a condition has held; None: it does not."""
    if not holds:
        return None
    return 0.0 if span is None else span + dt


class Motor:
    """One motor and its controllers. Plain data."""

    def __init__(self, settings: Settings, memory: Memory) -> None:
        self.settings, self.memory = settings, memory
        self.encoder = Encoder(bandwidth=settings.velocity_bandwidth)
        self.torque = 0.0
        """N·m of the motor, at the device's shaft."""
        self.demanded_torque = 0.0
        """N·m demanded by the controllers."""
        self.ramp = Trapezoid()
        """Demanded position and velocity."""
        self.homed = self.homing = False
        self.limited = False
        """A limit of the drive is effective."""
        self.following_error = False
        self._integral = 0.0
        self._ramped_torque = 0.0
        self._target: float | None = None
        """Of cyclic position; it is reached after `_left` [s]."""
        self._left = 0.0
        self._turn: int | None = None
        """Turn of the motor at the last cycle, while homing searches for the index."""
        self._slowing = False
        """It has left OPERATION ENABLED, and slows down first (605B, 605C)."""
        self._following: float | None = None
        """How long the following error has been too large [s]."""
        self._arrived: float | None = None
        """How long the target has been reached [s]."""
        self._before = PowerState.SWITCH_ON_DISABLED
        self._mode = Mode.NONE
        self._halted = False

    def measure(self, dt: float, shaft: float, velocity: float) -> None:
        """Measure the shaft: position in whole increments, velocity filtered."""
        counts = self.settings.encoder_increments * self.memory.units.gear / math.tau
        if counts != self.encoder.counts:
            self.encoder = replace(self.encoder, counts=counts)
        self.encoder.measure(dt, shaft, velocity)

    @property
    def at_standstill(self) -> bool:
        """True if a shaft that was slowed down has stopped."""
        return abs(self.encoder.velocity) < STANDSTILL

    def has_arrived(self, milliseconds: int) -> bool:
        """Return whether the target has been reached for that long."""
        return self._arrived is not None and self._arrived * 1000.0 >= milliseconds

    # -- one cycle --------------------------------------------------------------------------------------

    def step(self, dt: float) -> int:
        """Run one cycle; return the code of the error that it detected, or 0."""
        memory, code = self.memory, 0
        self.limited = self.following_error = False
        self._on_changes()
        match memory.state:
            case PowerState.OPERATION_ENABLED:
                code = self._operate(dt)
            case PowerState.QUICK_STOP:
                option = memory.values[o.QUICK_STOP_OPTION]
                if self._stop(dt, option % 4) and option < 4:
                    self._off(PowerState.SWITCH_ON_DISABLED)
            case PowerState.FAULT_REACTION:
                if self._stop(dt, memory.values[o.FAULT_OPTION]):
                    self._off(PowerState.FAULT)
            case PowerState.READY | PowerState.SWITCHED_ON if self._slowing:
                self._slowing = not self._stop(dt, SLOW_DOWN)
            case _:
                self._slowing = False
                self._off(memory.state)
        self.torque += lag(dt, self.settings.torque_bandwidth) * (self.demanded_torque - self.torque)
        self._before = memory.state
        return code

    def _on_changes(self) -> None:
        """Reset what begins anew when state, mode or halt change."""
        memory, state, before, mode = self.memory, self.memory.state, self._before, self.memory.mode
        enters = state is ENABLED and before is not ENABLED
        leaves = state is not ENABLED and before is ENABLED
        if enters:
            self._integral = self._ramped_torque = 0.0
        if leaves:
            options = {PowerState.READY: o.SHUTDOWN_OPTION, PowerState.SWITCHED_ON: o.DISABLE_OPTION}
            self._slowing = state in options and memory.values[options[state]] == SLOW_DOWN
        if mode is not self._mode:
            self.homing = False
            memory.take_homing()
        halted = memory.enabled and bool(memory.control & Control.HALT)
        if enters or leaves or mode is not self._mode or halted != self._halted:
            self._demand(self.encoder.position, self.encoder.velocity)
            self._target = self._turn = self._following = self._arrived = None
        self._mode, self._halted = mode, halted

    def _demand(self, position: float, velocity: float) -> None:
        self.ramp = Trapezoid(position, velocity)

    def _off(self, state: PowerState) -> None:
        """Give no torque."""
        self.demanded_torque = self.torque = self._integral = self._ramped_torque = 0.0
        self._demand(self.encoder.position, 0.0)
        if state is not self.memory.state:
            self.memory.enter(state)

    def _stop(self, dt: float, option: int) -> bool:
        """Slow down by an option code, and hold; True at standstill, or if the option is no torque."""
        if not option:
            return True
        velocity, position = 0.0, self.encoder.position
        if option in (SLOW_DOWN, QUICK_RAMP):
            key = o.PROFILE_DECELERATION if option == SLOW_DOWN else o.QUICK_STOP_DECELERATION
            slope = self.memory.units.acceleration(self.memory.values[key])
            velocity = approach(dt, self.ramp.velocity, 0.0, slope, slope)
        if velocity:
            self._demand(position, velocity)
            self._control_velocity(dt, velocity)
            return False
        self._demand(self.ramp.position if self.at_standstill else position, 0.0)
        self._control_position(dt)
        return self.at_standstill

    # -- modes --------------------------------------------------------------------------------------------

    def _operate(self, dt: float) -> int:
        """OPERATION ENABLED."""
        if self._halted:
            self._arrive(dt, self._stop(dt, self.memory.values[o.HALT_OPTION]))
            return 0
        match self._mode:
            case Mode.PP:
                self._profile_position(dt)
                return self._monitor_following(dt)
            case Mode.CSP:
                self._cyclic_position(dt)
                return self._monitor_following(dt)
            case Mode.PV | Mode.CSV:
                self._velocity(dt)
            case Mode.PT | Mode.CST:
                self._torque(dt)
            case Mode.HM:
                self._home(dt)
            case _:
                self._control_position(dt)
        return 0

    def _arrive(self, dt: float, near: bool) -> None:
        self._arrived = lasting(dt, self._arrived, near)

    def _profile_position(self, dt: float) -> None:
        memory, values, units = self.memory, self.memory.values, self.memory.units
        if memory.goal is not None:
            speed = min(units.velocity(values[o.PROFILE_VELOCITY]), self._speed_limit())
            slopes = (units.acceleration(values[k]) for k in (o.PROFILE_ACCELERATION, o.PROFILE_DECELERATION))
            self.ramp.advance(dt, self._limit_position(units.position(memory.goal)), speed, *slopes)
            if self.ramp.done:
                memory.finish_setpoint()
        memory.settle(round(self.ramp.position * units.per_turn / math.tau))
        self._control_position(dt, self.ramp.velocity)
        near = abs(self.ramp.position - self.encoder.position) <= units.position(values[o.POSITION_WINDOW])
        self._arrive(dt, near and memory.goal is None)

    def _cyclic_position(self, dt: float) -> None:
        """Go to the target, linearly over the period of 60C2."""
        values, units, position = self.memory.values, self.memory.units, self.ramp.position
        target = self._limit_position(units.position(values[o.TARGET_POSITION]))
        if target != self._target:
            self._target = target
            self._left = values[o.INTERPOLATION_VALUE] * 10.0 ** values[o.INTERPOLATION_INDEX]
        share = dt / self._left if self._left > dt else 1.0
        self._left = max(0.0, self._left - dt)
        next_position = target if share == 1.0 else position + (target - position) * share
        self._demand(next_position, units.velocity(values[o.VELOCITY_OFFSET]))
        self._control_position(dt, self.ramp.velocity, units.torque(values[o.TORQUE_OFFSET]))

    def _velocity(self, dt: float) -> None:
        values, units = self.memory.values, self.memory.units
        target = units.velocity(values[o.TARGET_VELOCITY])
        velocity, torque = target + units.velocity(values[o.VELOCITY_OFFSET]), values[o.TORQUE_OFFSET]
        if self._mode is Mode.PV:
            slopes = (units.acceleration(values[k]) for k in (o.PROFILE_ACCELERATION, o.PROFILE_DECELERATION))
            velocity, torque = approach(dt, self.ramp.velocity, target, *slopes), 0
        self._demand(self.encoder.position, velocity)
        self._control_velocity(dt, velocity, units.torque(torque))
        self._arrive(dt, abs(target - self.encoder.velocity) <= units.velocity(values[o.VELOCITY_WINDOW]))

    def _torque(self, dt: float) -> None:
        values, units = self.memory.values, self.memory.units
        target = units.torque(values[o.TARGET_TORQUE])
        slope = units.torque(values[o.TORQUE_SLOPE])
        if self._mode is Mode.CST:
            self._ramped_torque = target + units.torque(values[o.TORQUE_OFFSET])
        else:
            self._ramped_torque += clamp(target - self._ramped_torque, slope * dt)
        self._demand(self.encoder.position, self.encoder.velocity)
        self._integral = 0.0
        self._demand_torque(self._ramped_torque)
        self._arrive(dt, self._ramped_torque == target)

    def _home(self, dt: float) -> None:
        """Methods 33 and 34: turn to the next index; 35 and 37: home is the present position."""
        memory, values, units = self.memory, self.memory.values, self.memory.units
        method, at = values[o.HOMING_METHOD], self.encoder.position + self.encoder.offset
        if memory.take_homing():
            self.homing, self.homed, self._turn = True, False, None
        self.homing = self.homing and bool(memory.control & Control.START_HOMING)  # else it is interrupted
        if not self.homing or method not in (33, 34):
            if self.homing:
                self._home_found(at)
            self._stop(dt, SLOW_DOWN)
            return
        angle = math.tau / units.gear  # of the shaft, per turn of the motor
        before, self._turn = self._turn, math.floor(at / angle)
        if before is not None and before != self._turn:
            self._home_found(max(before, self._turn) * angle)
        speed = units.velocity(values[o.HOMING_SPEED_ZERO]) * (self.homing if method == 34 else -self.homing)
        slope = units.acceleration(values[o.HOMING_ACCELERATION])
        self._demand(self.encoder.position, approach(dt, self.ramp.velocity, speed, slope, slope))
        self._control_velocity(dt, self.ramp.velocity)

    def _home_found(self, home: float) -> None:
        """End homing: position zero is the home offset (607C) away from home."""
        before, offset = self.encoder.position, self.memory.units.position(self.memory.values[o.HOME_OFFSET])
        self.encoder.set_position(before + self.encoder.offset - home - offset)
        self._demand(self.ramp.position + self.encoder.position - before, self.ramp.velocity)
        self.homing, self.homed = False, True

    # -- the cascade --------------------------------------------------------------------------------------

    def _control_position(self, dt: float, velocity: float = 0.0, torque: float = 0.0) -> None:
        lag_ = self.ramp.position - self.encoder.position
        self._control_velocity(dt, velocity + self.settings.position_gain * lag_, torque)

    def _control_velocity(self, dt: float, velocity: float, torque: float = 0.0) -> None:
        fastest = self._speed_limit()
        self.limited = self.limited or abs(velocity) > fastest
        error = clamp(velocity, fastest) - self.encoder.velocity
        if self._demand_torque(torque + self.settings.velocity_gain * error + self._integral):
            self._integral *= math.exp(-dt / 0.01)  # anti-windup
        else:
            self._integral += self.settings.velocity_integral * error * dt

    def _demand_torque(self, torque: float) -> bool:
        """Demand a torque; True if it was limited (6072)."""
        self.demanded_torque = clamp(torque, self.memory.units.torque(self.memory.values[o.MAX_TORQUE]))
        cut = self.demanded_torque != torque
        self.limited = self.limited or cut
        return cut

    def _speed_limit(self) -> float:
        """Return the lower of 607F and 6080 in rad/s."""
        values, units = self.memory.values, self.memory.units
        motor = values[o.MAX_MOTOR_SPEED] / 60.0 * math.tau / units.gear
        return min(units.velocity(values[o.MAX_PROFILE_VELOCITY]), motor)

    def _limit_position(self, position: float) -> float:
        """Limit a target to the position limits (607D), if there are any."""
        values, units = self.memory.values, self.memory.units
        low, high = values[o.SOFT_LIMIT_LOW], values[o.SOFT_LIMIT_HIGH]
        if low == high == 0:
            return position
        inside = max(units.position(low), min(units.position(high), position))
        self.limited = self.limited or inside != position
        return inside

    def _monitor_following(self, dt: float) -> int:
        """Monitor the following error (6065, 6066); return its error code, or 0."""
        values, error = self.memory.values, abs(self.ramp.position - self.encoder.position)
        window = values[o.FOLLOWING_WINDOW]
        self.following_error = window != NEVER_FOLLOWING and error > self.memory.units.position(window)
        self._following = lasting(dt, self._following, self.following_error)
        too_long = self._following is not None and self._following * 1000.0 >= values[o.FOLLOWING_TIME]
        return FOLLOWING_ERROR if too_long else 0
