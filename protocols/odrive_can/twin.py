"""The twin: an ODrive of firmware 0.6.x on the wire, with the firmware's habits (README, "the twin").

Rules. The ear's `Axis` decides what is obeyed, `Servo` what the motor then does; this file is the rest of
the firmware: arming, errors, watchdog, cyclic messages, answers, addresses, reboot. A device answers at the
step after it was asked. Time is an argument; phases of cyclic messages come from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from protocols.odrive_can.codec import ASKABLE, BROADCAST, CMD_BITS, cmd_of, decode_to_device, encode, turns
from protocols.odrive_can.ear import addressed, assign, axis_of, obey
from protocols.odrive_can.faults import Error, Result
from protocols.odrive_can.messages import (
    Address,
    Ask,
    AxisState,
    ClearErrors,
    EnterDfuMode,
    Estop,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetError,
    GetIq,
    GetPowers,
    GetTemperature,
    GetTorques,
    GetVersion,
    Heartbeat,
    Message,
    Reboot,
    RebootAction,
    SetAbsolutePosition,
    SetAxisState,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
    SetLimits,
    SetPosGain,
    SetTrajAccelLimits,
    SetTrajInertia,
    SetTrajVelLimit,
    SetVelGains,
)
from protocols.odrive_can.options import Settings
from protocols.odrive_can.servo import Gains, Servo, gains_of
from protocols.plugin import Device
from protocols.wire import CanFrame, Wire
from protocols.words import MILLISECOND, SECOND, Event, Feedback, Nanos, Torque, seconds

PROTOCOL_VERSION = 2
FEEDS = (SetInputPos, SetInputVel, SetInputTorque, SetAxisState)
"""What feeds the watchdog (odriverobotics/ODriveResources@fdb25dd `examples/can_watchdog.py`)."""
NEVER: Nanos = 1 << 62


class OdriveTwin:
    """One device. Its state is plain data."""

    def __init__(self, device: Device, seed: int) -> None:
        settings: Settings = device.settings
        self.device = device
        self.settings = settings
        self.axis = axis_of(device)
        self.servo = Servo(settings)
        self.errors = Error(0)
        self.disarm_reason = Error(0)
        self.result: int = Result.SUCCESS
        self.identify = False
        self.silent_until: Nanos = 0
        """The boot loader runs until then."""
        self.initializing_until: Nanos = 0
        self._flash: tuple[int, Gains] = (self.axis.node, gains_of(settings))
        """Node id and gains as saved."""
        self._fed: Nanos = 0
        self._now: Nanos | None = None
        self._shaft = (0.0, 0.0)
        self._replies: list[CanFrame] = []
        self._periods = _periods(settings)
        self._phase = (seed * 7919 + self.axis.serial * 31) % 1000
        self._next: dict[int, Nanos] = {}

    # -- the wire -----------------------------------------------------------------------------

    def receive(self, t: Nanos, wire: Wire) -> None:
        """A wire reached the device; what is not for it changes nothing."""
        if not isinstance(wire, CanFrame) or t < self.silent_until:
            return
        message = decode_to_device(wire)
        node = wire.id >> CMD_BITS
        if isinstance(message, Ask):
            self._answer(node, message.cmd)
        elif isinstance(message, Address):
            if assign(self.axis, node, message):
                self._reply(Address(self.axis.node, self.axis.serial, 0))
        elif message is not None and addressed(self.axis, node, message):
            self._hear(t, message)

    def _answer(self, node: int, cmd: int) -> None:
        discovery = node == BROADCAST and cmd == cmd_of(Address)
        if discovery or (node == self.axis.node and node != BROADCAST and cmd in ASKABLE):
            message = self._tell(cmd)
            if message is not None:
                self._reply(message)

    def _reply(self, message: Message) -> None:
        self._replies.append(encode(self.axis.node, message))

    def _hear(self, t: Nanos, message: Message) -> None:
        if isinstance(message, FEEDS):
            self._fed = t
        match message:
            case SetAxisState(state):
                self._request_state(state)
                return
            case Estop():
                self._trip(Error.ESTOP_REQUESTED)
            case ClearErrors(identify):
                self.errors &= Error.INITIALIZING
                self.disarm_reason = Error(0)
                self.identify = identify == 1
            case Reboot(action):
                self._reboot(t, action)
            case EnterDfuMode():
                self.silent_until = NEVER
            case SetAbsolutePosition(position):
                self.servo.call_position(position)
            case _:
                self._configure(message)
        obey(self.axis, message)

    def _configure(self, message: Message) -> None:
        gains = self.servo.gains
        match message:
            case SetLimits(velocity, current):
                gains.vel_limit = abs(velocity)
                gains.current_soft_max = min(abs(current), self.settings.current_hard_max)
            case SetPosGain(gain):
                gains.pos_gain = gain
            case SetVelGains(gain, integrator):
                gains.vel_gain, gains.vel_integrator_gain = gain, integrator
            case SetTrajVelLimit(velocity):
                gains.trap_vel_limit = abs(velocity)
            case SetTrajAccelLimits(acceleration, deceleration):
                gains.trap_accel_limit, gains.trap_decel_limit = abs(acceleration), abs(deceleration)
            case SetTrajInertia(inertia):
                gains.inertia = inertia

    # -- the firmware -------------------------------------------------------------------------

    def _request_state(self, state: int) -> None:
        was_armed = self.axis.armed
        if state == AxisState.CLOSED_LOOP_CONTROL:
            if was_armed:
                return
            if self.errors:
                self.result, self.disarm_reason = Result.DISARMED, self.errors
                return
            if not self.settings.calibrated:
                self.result = Result.NOT_CALIBRATED
                return
            self.servo.start()
            self.result, self.disarm_reason = Result.BUSY, Error(0)
        elif state == AxisState.IDLE:
            self.result = Result.SUCCESS if was_armed else self.result
        elif state == AxisState.HOMING:
            self.result = Result.HOMING_WITHOUT_ENDSTOP
        elif state != AxisState.UNDEFINED:
            self.result = Result.INVALID_STATE
        obey(self.axis, SetAxisState(state))

    def _trip(self, errors: Error) -> None:
        """Errors stay active until Clear_Errors; an armed axis disarms."""
        self.errors |= errors
        if self.axis.armed:
            self.axis.armed = False
            self.disarm_reason = self.errors
            self.result = Result.DISARMED

    def _reboot(self, t: Nanos, action: int) -> None:
        if action == RebootAction.SAVE:
            self._flash = (self.axis.node, self.servo.gains)
        elif action == RebootAction.ERASE:
            self._flash = (BROADCAST, gains_of(Settings()))
        self.silent_until = t + self.settings.reboot_ms * MILLISECOND
        self.initializing_until = self.silent_until + self.settings.initializing_ms * MILLISECOND
        serial = self.axis.serial
        self.axis = axis_of(self.device)
        self.axis.node, self.axis.serial = self._flash[0], serial
        whole_turns = math.floor(self.servo.shaft)
        self.servo = Servo(self.settings)
        self.servo.gains = Gains(**{name: getattr(self._flash[1], name) for name in Gains.__slots__})
        self.servo.offset = whole_turns  # an absolute encoder knows its place within one turn only
        self.errors, self.disarm_reason, self.result = Error.INITIALIZING, Error(0), Result.SUCCESS
        self._replies.clear()
        self._next.clear()

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Wire]]:
        """Run the firmware up to `now`; the shaft's Feedback [rad, rad/s] is what the encoder sees."""
        for event in truth:
            self._see(event)
        dt = 0.0 if self._now is None else seconds(max(0, now - self._now))
        first, self._now = self._now is None, now
        shaft, velocity = turns(self._shaft[0]), turns(self._shaft[1])
        if first:
            self.servo.measure(1.0, shaft, velocity)
            self._fed = now
        elif dt > 0.0:
            self.servo.measure(dt, shaft, velocity)
        if now < self.silent_until:
            return (Torque(self.device.name, 0.0),), ()
        if self.errors & Error.INITIALIZING and now >= self.initializing_until:
            self.errors &= ~Error.INITIALIZING
        if dt > 0.0:
            errors = self.servo.step(dt, self.axis)
            if errors:
                self._trip(errors)
        if self._watchdog_expired(now):
            self._trip(Error.WATCHDOG_TIMER_EXPIRED)
        torque = self.servo.torque() if self.axis.armed else 0.0
        replies, self._replies = self._replies, []
        return (Torque(self.device.name, torque),), (*replies, *self._cyclic(now))

    def _see(self, event: Event) -> None:
        if isinstance(event, Feedback) and event.motor == self.device.name:
            position = self._shaft[0] if event.position is None else event.position
            velocity = self._shaft[1] if event.velocity is None else event.velocity
            if math.isfinite(position) and math.isfinite(velocity):
                self._shaft = (position, velocity)

    def _watchdog_expired(self, now: Nanos) -> bool:
        if not (self.settings.enable_watchdog and self.axis.armed):
            return False
        return now - self._fed > round(self.settings.watchdog_timeout * SECOND)

    # -- what it tells ----------------------------------------------------------------------------

    def _cyclic(self, now: Nanos) -> Sequence[CanFrame]:
        if self.axis.node == BROADCAST:  # without an address it only answers discovery
            return ()
        if not self._next:
            self._next = {cmd: now + period * self._phase // 1000 for cmd, period in self._periods.items()}
        frames = []
        for cmd, period in self._periods.items():
            if now >= self._next[cmd]:
                self._next[cmd] += period * (1 + (now - self._next[cmd]) // period)
                message = self._tell(cmd)
                if message is not None:
                    frames.append(encode(self.axis.node, message))
        return frames

    def _tell(self, cmd: int) -> Message | None:
        servo, s = self.servo, self.settings
        state = AxisState.CLOSED_LOOP_CONTROL if self.axis.armed else AxisState.IDLE
        messages: tuple[Message, ...] = (
            GetVersion(
                PROTOCOL_VERSION, s.hw_line, 1, 0, s.fw_major, s.fw_minor, s.fw_revision, fw_unreleased=0
            ),
            Heartbeat(self.errors, state, self.result, int(servo.trajectory_done)),
            GetError(self.errors, self.disarm_reason),
            Address(self.axis.node, self.axis.serial, 0),
            GetEncoderEstimates(servo.position, servo.velocity),
            GetIq(servo.iq_setpoint, servo.iq),
            GetTemperature(servo.fet_temperature, servo.motor_temperature),
            GetBusVoltageCurrent(servo.bus_voltage, servo.bus_current),
            GetTorques(servo.torque_target, servo.torque()),
            GetPowers(servo.electrical, servo.mechanical),
        )
        return next((message for message in messages if cmd_of(type(message)) == cmd), None)

    def due(self) -> Nanos | None:
        """When the device next says something by itself, or leaves a state by itself."""
        times = list(self._next.values())
        if self._now is not None and self._now < self.silent_until < NEVER:
            times = [self.silent_until]
        if self._now is not None and self._now < self.initializing_until:
            times.append(self.initializing_until)
        if self.settings.enable_watchdog and self.axis.armed:
            times.append(self._fed + round(self.settings.watchdog_timeout * SECOND) + 1)
        return min(times, default=None)


def _periods(s: Settings) -> dict[int, Nanos]:
    rates = (
        (GetVersion, s.version_msg_rate_ms),
        (Heartbeat, s.heartbeat_msg_rate_ms),
        (GetEncoderEstimates, s.encoder_msg_rate_ms),
        (GetIq, s.iq_msg_rate_ms),
        (GetError, s.error_msg_rate_ms),
        (GetTemperature, s.temperature_msg_rate_ms),
        (GetBusVoltageCurrent, s.bus_voltage_msg_rate_ms),
        (GetTorques, s.torques_msg_rate_ms),
    )
    return {cmd_of(message): rate * MILLISECOND for message, rate in rates if rate}
