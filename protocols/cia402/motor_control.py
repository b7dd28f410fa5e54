"""The twin's motor control: encoder, control loops, set-point generation in each mode, and stopping.

Rules. One call of `step` is one cycle of the firmware, whatever its `dt`. Everything the loops know of the
shaft comes through `measure`, in whole increments of the encoder. Quantities are SI at the device's shaft;
limits, ramps and windows are read from the dictionary in the drive's units at every cycle, so that they may
be written while it runs. No frames and no commands here; `ramps` has the ramps.

Source: CiA 402-2 (modes, option codes 605A to 605E, 6065, 6067, 606D, 606F, 607D, 607F, 6080, 6072). The
loops are this project's choice: P for position, PI for velocity, a lag for the current.
"""

from __future__ import annotations

import math

from protocols.cia402 import objects as o
from protocols.cia402.axis import Axis
from protocols.cia402.faults import FOLLOWING_ERROR
from protocols.cia402.options import NEVER_FOLLOWING, Settings
from protocols.cia402.profile import Control, Mode, PowerState
from protocols.cia402.ramps import Interpolation, Ramp, Timer, clamp, lag

STANDSTILL = 0.02
"""rad/s below which a shaft that is slowed down counts as at standstill."""
SLOW_DOWN = 1
QUICK_RAMP = 2
"""Option codes that slow down, the same plus 4 for quick stop: 1 by 6084, 2 by 6085, 3 at the current
limit."""


class MotorControl:
    """One motor and its controllers. Plain data."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.encoder = 0.0
        """rad, in whole increments of the encoder."""
        self.zero = 0.0
        """rad of `encoder` at position zero."""
        self.velocity = 0.0
        self.torque = 0.0
        """N·m of the motor, at the device's shaft."""
        self.demanded_torque = 0.0
        """N·m demanded by the controllers."""
        self.integral = 0.0
        self.ramp = Ramp()
        """Demanded position and velocity."""
        self.ramped_torque = 0.0
        self.interpolation = Interpolation()
        self.turn: int | None = None
        """Turn of the motor at the last cycle, while homing searches for the index."""
        self.slowing = False
        """It has left OPERATION ENABLED, and slows down first (605B, 605C)."""
        self.homed = self.homing = self.homing_failed = False
        self.following = Timer()
        """Since when the following error is too large."""
        self.arrived = Timer()
        """Since when the target is reached."""
        self.limited = False
        self.following_error = False
        self._before = PowerState.SWITCH_ON_DISABLED
        self._mode = Mode.NONE
        self._halted = False

    # -- the encoder --------------------------------------------------------------------------------

    def measure(self, dt: float, shaft: float, velocity: float, gear: float) -> None:
        """Measure the shaft: position in whole increments, velocity filtered."""
        per_radian = self.settings.encoder_increments * gear / math.tau
        self.encoder = math.floor(shaft * per_radian + 0.5) / per_radian
        self.velocity += lag(dt, self.settings.velocity_bandwidth) * (velocity - self.velocity)

    @property
    def position(self) -> float:
        """rad from position zero."""
        return self.encoder - self.zero

    def redefine_position(self, position: float) -> None:
        """Let the present position have this value; the demanded one moves along."""
        shift = position - self.position
        self.zero -= shift
        self.ramp.position += shift

    def at_standstill(self) -> bool:
        """True if a shaft that was slowed down has stopped."""
        return abs(self.velocity) < STANDSTILL

    # -- one cycle --------------------------------------------------------------------------------------

    def step(self, dt: float, axis: Axis) -> int:
        """Run one cycle; return the code of the error that it detected, or 0."""
        code = 0
        self.limited = self.following_error = False
        self._on_changes(axis)
        match axis.state:
            case PowerState.OPERATION_ENABLED:
                code = self._operate(dt, axis)
            case PowerState.QUICK_STOP:
                self._quick_stop(dt, axis)
            case PowerState.FAULT_REACTION:
                if self._stop(dt, axis, axis.dictionary.values[o.FAULT_OPTION]):
                    axis.state = PowerState.FAULT
                    self._off()
            case _:
                self._disabled(dt, axis)
        self.torque += lag(dt, self.settings.torque_bandwidth) * (self.demanded_torque - self.torque)
        self._before = axis.state
        return code

    def _on_changes(self, axis: Axis) -> None:
        """Reset what begins anew when state or mode change."""
        state, before = axis.state, self._before
        if state is PowerState.OPERATION_ENABLED and before is not state:
            self.slowing, self.integral, self.ramped_torque = False, 0.0, 0.0
            self._begin()
        elif before is PowerState.OPERATION_ENABLED and state is not before:
            values = axis.dictionary.values
            options = {
                PowerState.READY: values[o.SHUTDOWN_OPTION],
                PowerState.SWITCHED_ON: values[o.DISABLE_OPTION],
            }
            self.slowing = options.get(state) == SLOW_DOWN
            self._begin()
        if axis.mode is not self._mode:
            self._mode = axis.mode
            self.homing = axis.homing_requested = False
            self._begin()

    def _begin(self) -> None:
        """Start the demands where the shaft is, at its velocity."""
        self.ramp.start(self.position, self.velocity)
        self.interpolation.clear()
        self.turn = None
        self.following.clear()
        self.arrived.clear()

    def _off(self) -> None:
        self.demanded_torque = self.torque = self.integral = self.ramped_torque = 0.0
        self.ramp.start(self.position, 0.0)

    def _disabled(self, dt: float, axis: Axis) -> None:
        """Not enabled: no torque, once it has slowed down if it has to."""
        if axis.state not in (PowerState.READY, PowerState.SWITCHED_ON):
            self.slowing = False
        if self.slowing and not self._stop(dt, axis, SLOW_DOWN):
            return
        self.slowing = False
        self._off()

    def _quick_stop(self, dt: float, axis: Axis) -> None:
        option = axis.dictionary.values[o.QUICK_STOP_OPTION]
        if self._stop(dt, axis, option % 4) and option < 4:
            axis.state = PowerState.SWITCH_ON_DISABLED
            self._off()

    def _stop(self, dt: float, axis: Axis, option: int) -> bool:
        """Slow down by an option code, and hold; True at standstill, or if the option is no torque."""
        if not option:
            return True
        values, units = axis.dictionary.values, axis.units
        if option == SLOW_DOWN:
            self._slow_down(dt, units.acceleration(values[o.PROFILE_DECELERATION]))
        elif option == QUICK_RAMP:
            self._slow_down(dt, units.acceleration(values[o.QUICK_STOP_DECELERATION]))
        else:
            self.ramp.velocity = 0.0
        if self.ramp.velocity:
            self.ramp.position = self.position
            self._control_velocity(dt, axis, self.ramp.velocity, 0.0)
            return False
        if not self.at_standstill():
            self.ramp.position = self.position
        self._control_position(dt, axis, self.ramp.position, 0.0, 0.0)
        return self.at_standstill()

    def _slow_down(self, dt: float, deceleration: float) -> None:
        self.ramp.change_velocity(dt, 0.0, deceleration, deceleration)

    # -- modes --------------------------------------------------------------------------------------------

    def _operate(self, dt: float, axis: Axis) -> int:
        """OPERATION ENABLED."""
        halted = bool(axis.control & Control.HALT)
        if halted != self._halted:
            self._halted = halted
            self._begin()
        if halted:
            self.arrived.run(dt, self._stop(dt, axis, axis.dictionary.values[o.HALT_OPTION]))
            return 0
        match axis.mode:
            case Mode.PP:
                self._profile_position(dt, axis)
                return self._monitor_following(dt, axis)
            case Mode.CSP:
                self._cyclic_position(dt, axis)
                return self._monitor_following(dt, axis)
            case Mode.PV | Mode.CSV:
                self._velocity(dt, axis)
            case Mode.PT | Mode.CST:
                self._torque(dt, axis)
            case Mode.HM:
                self._home(dt, axis)
            case _:
                self._control_position(dt, axis, self.ramp.position, 0.0, 0.0)
        return 0

    def _profile_position(self, dt: float, axis: Axis) -> None:
        values, units = axis.dictionary.values, axis.units
        if axis.goal is not None:
            speed = min(units.velocity(values[o.PROFILE_VELOCITY]), self._speed_limit(axis))
            up, down = values[o.PROFILE_ACCELERATION], values[o.PROFILE_DECELERATION]
            goal = self._limit_position(axis, units.position(axis.goal))
            if self.ramp.move_to(dt, goal, speed, units.acceleration(up), units.acceleration(down)):
                axis.goal, axis.next_goal = axis.next_goal, None
        axis.position = round(self.ramp.position * units.per_turn / math.tau)
        self._control_position(dt, axis, self.ramp.position, self.ramp.velocity, 0.0)
        near = abs(self.ramp.position - self.position) <= units.position(values[o.POSITION_WINDOW])
        self.arrived.run(dt, near and axis.goal is None)

    def _cyclic_position(self, dt: float, axis: Axis) -> None:
        values, units = axis.dictionary.values, axis.units
        period = values[o.INTERPOLATION_VALUE] * 10.0 ** values[o.INTERPOLATION_INDEX]
        target = self._limit_position(axis, units.position(values[o.TARGET_POSITION]))
        self.ramp.position = self.interpolation.follow(dt, self.ramp.position, target, period)
        self.ramp.velocity = units.velocity(values[o.VELOCITY_OFFSET])
        offset = units.torque(values[o.TORQUE_OFFSET])
        self._control_position(dt, axis, self.ramp.position, self.ramp.velocity, offset)

    def _velocity(self, dt: float, axis: Axis) -> None:
        values, units = axis.dictionary.values, axis.units
        target, offset = units.velocity(values[o.TARGET_VELOCITY]), 0.0
        if axis.mode is Mode.CSV:
            self.ramp.velocity = target + units.velocity(values[o.VELOCITY_OFFSET])
            offset = units.torque(values[o.TORQUE_OFFSET])
        else:
            up = units.acceleration(values[o.PROFILE_ACCELERATION])
            self.ramp.change_velocity(dt, target, up, units.acceleration(values[o.PROFILE_DECELERATION]))
        self.ramp.position = self.position
        self._control_velocity(dt, axis, self.ramp.velocity, offset)
        near = abs(target - self.velocity) <= units.velocity(values[o.VELOCITY_WINDOW])
        self.arrived.run(dt, near)

    def _torque(self, dt: float, axis: Axis) -> None:
        values, units = axis.dictionary.values, axis.units
        target = units.torque(values[o.TARGET_TORQUE])
        if axis.mode is Mode.CST:
            self.ramped_torque = target + units.torque(values[o.TORQUE_OFFSET])
        else:
            slope = units.torque(values[o.TORQUE_SLOPE])
            self.ramped_torque += clamp(target - self.ramped_torque, slope * dt)
        self.ramp.start(self.position, self.velocity)
        self.integral = 0.0
        self._demand_torque(axis, self.ramped_torque)
        self.arrived.run(dt, self.ramped_torque == target)

    def _home(self, dt: float, axis: Axis) -> None:
        """Methods 33 and 34: turn to the next index; 35 and 37: home is the present position."""
        values, units = axis.dictionary.values, axis.units
        if axis.homing_requested:
            axis.homing_requested, self.homing, self.homed = False, True, False
            self.interpolation.clear()
            self.turn = None
        started = bool(axis.control & Control.START_HOMING)
        method = values[o.HOMING_METHOD]
        if self.homing and not started:
            self.homing = False  # interrupted
        if self.homing and method not in (33, 34):
            self._home_found(axis, self.encoder)
        elif self.homing:
            speed = math.copysign(units.velocity(values[o.HOMING_SPEED_ZERO]), 1 if method == 34 else -1)
            angle = math.tau / units.gear  # of the shaft, per turn of the motor
            before, self.turn = self.turn, math.floor(self.encoder / angle)
            if before is not None and before != self.turn:
                self._home_found(axis, max(before, self.turn) * angle)
            acceleration = units.acceleration(values[o.HOMING_ACCELERATION])
            self.ramp.change_velocity(dt, speed if self.homing else 0.0, acceleration, acceleration)
            self.ramp.position = self.position
            self._control_velocity(dt, axis, self.ramp.velocity, 0.0)
            return
        self._stop(dt, axis, SLOW_DOWN)

    def _home_found(self, axis: Axis, home: float) -> None:
        """End homing: position zero is the home offset (607C) away from home."""
        shift = axis.units.position(axis.dictionary.values[o.HOME_OFFSET])
        self.redefine_position(self.encoder - home - shift)
        self.homing, self.homed = False, True

    # -- the cascade --------------------------------------------------------------------------------------

    def _control_position(
        self, dt: float, axis: Axis, position: float, velocity: float, torque: float
    ) -> None:
        gain = self.settings.position_gain
        self._control_velocity(dt, axis, velocity + gain * (position - self.position), torque)

    def _control_velocity(self, dt: float, axis: Axis, velocity: float, torque: float) -> None:
        fastest = self._speed_limit(axis)
        if abs(velocity) > fastest:
            self.limited = True
        error = clamp(velocity, fastest) - self.velocity
        demanded = torque + self.settings.velocity_gain * error + self.integral
        if self._demand_torque(axis, demanded):
            self.integral *= math.exp(-dt / 0.01)  # anti-windup
        else:
            self.integral += self.settings.velocity_integral * error * dt

    def _demand_torque(self, axis: Axis, torque: float) -> bool:
        """Demand a torque; True if it was limited (6072)."""
        most = axis.units.torque(axis.dictionary.values[o.MAX_TORQUE])
        self.demanded_torque = clamp(torque, most)
        cut = self.demanded_torque != torque
        self.limited = self.limited or cut
        return cut

    def _speed_limit(self, axis: Axis) -> float:
        """Return the lower of 607F and 6080 in rad/s."""
        values = axis.dictionary.values
        motor = values[o.MAX_MOTOR_SPEED] / 60.0 * math.tau / axis.units.gear
        return min(axis.units.velocity(values[o.MAX_PROFILE_VELOCITY]), motor)

    def _limit_position(self, axis: Axis, position: float) -> float:
        """Limit a target to the position limits (607D), if there are any."""
        values, units = axis.dictionary.values, axis.units
        low, high = values[o.SOFT_LIMIT_LOW], values[o.SOFT_LIMIT_HIGH]
        if low == high == 0:
            return position
        inside = max(units.position(low), min(units.position(high), position))
        self.limited = self.limited or inside != position
        return inside

    def _monitor_following(self, dt: float, axis: Axis) -> int:
        """Monitor the following error (6065, 6066); return its error code, or 0."""
        values = axis.dictionary.values
        window = values[o.FOLLOWING_WINDOW]
        if window == NEVER_FOLLOWING:
            return 0
        far = abs(self.ramp.position - self.position) > axis.units.position(window)
        self.following_error = far
        self.following.run(dt, far)
        return FOLLOWING_ERROR if self.following.lasts(values[o.FOLLOWING_TIME]) else 0
