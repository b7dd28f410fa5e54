"""What the driver knows and wants of one device: its state heard, its arming, its polling.

Rules. Nothing but remote frames goes to a device that was never commanded. The arming sequence is mode →
set-point that does not move the shaft → Set_Axis_State 8 → wait for a heartbeat in state 8; errors are never
cleared unasked. What was armed is remembered as `claimed` through silence and bus trouble, so that Idle
still goes out; whether it *is* armed is forgotten then, and only a fresh sequence arms again. Set-points go
out only while heartbeats say closed loop.
"""

from __future__ import annotations

from protocols.odrive_can.codec import cmd_of, radians, turns
from protocols.odrive_can.faults import (
    NOT_ARMED,
    PROCEDURE,
    RESULTS,
    WRONG_FIRMWARE,
    Error,
    Result,
    bits,
    result_name,
    state_name,
    text_of,
)
from protocols.odrive_can.messages import (
    AxisState,
    ControlMode,
    GetBusVoltageCurrent,
    GetEncoderEstimates,
    GetError,
    GetIq,
    GetTemperature,
    GetTorques,
    GetVersion,
    Heartbeat,
    InputMode,
    Message,
    SetAxisState,
    SetControllerMode,
    SetInputPos,
    SetInputTorque,
    SetInputVel,
)
from protocols.odrive_can.options import Options
from protocols.words import (
    MILLISECOND,
    Command,
    Event,
    Fault,
    Feedback,
    Hold,
    Idle,
    Mode,
    Nanos,
    Position,
    State,
    Torque,
    Velocity,
)

POLLED = (cmd_of(GetIq), cmd_of(GetBusVoltageCurrent), cmd_of(GetTemperature), cmd_of(GetTorques))
VERSION, HEARTBEAT, ERROR, ESTIMATES = map(cmd_of, (GetVersion, Heartbeat, GetError, GetEncoderEstimates))
ASKED = (VERSION, HEARTBEAT, ERROR, ESTIMATES, *POLLED)
ASK_AGAIN = 100 * MILLISECOND
"""An unanswered question is repeated so often."""
HEARTBEAT_MISSED = 250 * MILLISECOND
"""Without a heartbeat for so long, one is asked for."""
RELEASE_AGAIN = 50 * MILLISECOND
"""Set_Axis_State IDLE is repeated so often until two heartbeats have confirmed it."""
CONFIRMED = 2
ARM_ATTEMPTS = 5
"""After so many tries without closed loop it is a fault."""
VERSION_ATTEMPTS = 10
REASON_ATTEMPTS = 5
"""A disarm reason that is not told in so many tries is not waited for."""
WAITING = (Result.SUCCESS, Result.BUSY, Result.CANCELLED, Result.DISARMED)
"""Results that may be left over from before the request: no verdict on it."""
NEVER: Nanos = 1 << 62


class Node:
    """One device as the driver sees it. Plain data."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name = name
        self.address = address
        self.options = options
        self.started: Nanos | None = None
        self.heard_at: Nanos | None = None
        self.offline = False
        self.version: GetVersion | None = None
        self.state: int | None = None
        self.errors = 0
        self.result: int = Result.SUCCESS
        self.position: float | None = None
        """turns"""
        self.claimed = False
        """We have commanded it since it was last released."""
        self.armed = False
        """It was heard in closed loop since we claimed it."""
        self.mode: ControlMode | None = None
        """What we set since it was last forgotten."""
        self.hold: float | None = None
        self.refused = False
        """It would not arm: told as a fault, not tried again before ClearFault or Idle."""
        self.attempts = 0
        self.arm_next: Nanos = 0
        self.state_sent: Nanos = -NEVER
        self.beats_since_arming = 0
        self.releasing = False
        self.release_next: Nanos = 0
        self.release_seen = 0
        self.told: tuple[Mode, str] | None = None
        self.told_errors = 0
        self.told_firmware = False
        self.want_reason = False
        self.reason_asks = 0
        self.beats: list[tuple[Nanos, int, int]] = []
        """The last heartbeats: time, state, errors."""
        self.heard: dict[int, Nanos] = {}
        self.asked: dict[int, Nanos] = {}
        self.version_asks = 0
        self.unanswered = False
        self.cyclic_at: Nanos = 0
        """When an encoder estimate last came unasked."""

    def forget(self) -> None:
        """The device may have restarted or been changed: only a fresh sequence arms it again."""
        self.version, self.state, self.position, self.hold, self.told = None, None, None, None, None
        self.armed, self.mode = False, None
        self.attempts, self.arm_next, self.beats_since_arming, self.release_seen = 0, 0, 0, 0
        self.version_asks, self.want_reason = 0, False
        self.beats.clear()

    def resend(self) -> None:
        """Frames may have been lost on our side: say mode and state again."""
        self.mode, self.arm_next, self.release_next, self.release_seen = None, 0, 0, 0

    # -- hearing ------------------------------------------------------------------------------

    def hear(self, t: Nanos, message: Message) -> list[Event]:
        """A message of the device; what it means in words."""
        self.heard_at, self.offline = t, False
        self.heard[cmd_of(type(message))] = t
        match message:
            case Heartbeat():
                return self._hear_heartbeat(t, message)
            case GetEncoderEstimates(position, velocity):
                if self.unanswered:
                    self.unanswered = False
                else:
                    self.cyclic_at = t
                self.position = position
                return [Feedback(self.name, t, position=radians(position), velocity=radians(velocity))]
            case GetIq(_, measured):
                return [Feedback(self.name, t, current=measured)]
            case GetTorques(_, estimate):
                return [Feedback(self.name, t, torque=estimate)]
            case GetBusVoltageCurrent(voltage, _):
                return [Feedback(self.name, t, voltage=voltage)]
            case GetTemperature(fet, motor):
                known = [value for value in (fet, motor) if value is not None]
                return [Feedback(self.name, t, temperature=max(known))] if known else []
            case GetError(active, reason):
                return self._hear_errors(t, active, reason)
            case GetVersion():
                return self._hear_version(t, message)
        return []

    def _hear_heartbeat(self, t: Nanos, beat: Heartbeat) -> list[Event]:
        if beat.error & Error.INITIALIZING and not self.errors & Error.INITIALIZING:
            self.forget()
        self.state, self.errors, self.result = beat.state, beat.error, beat.result
        self.beats = [*self.beats[-3:], (t, beat.state, beat.error)]
        closed = beat.state == AxisState.CLOSED_LOOP_CONTROL
        fell = self.armed and not closed
        if fell:
            self.armed, self.mode, self.hold = False, None, None
            self.want_reason, self.reason_asks = True, 0
        elif closed and self.claimed and not self.releasing:
            self.armed, self.attempts, self.beats_since_arming = True, 0, 0
        self._confirm_release(closed=closed)
        events = self._new_errors(t, beat.error & ~Error.INITIALIZING)
        self.told_errors &= beat.error
        events += self._judge_arming(t, closed=closed)
        return events + self._tell_state(t, fell=fell)

    def _confirm_release(self, closed: bool) -> None:
        self.release_seen = self.release_seen + 1 if self.releasing and not closed else 0
        if self.release_seen >= CONFIRMED:
            self.claimed = self.releasing = False
            self.release_seen = 0

    def _new_errors(self, t: Nanos, errors: int, prefix: str = "") -> list[Event]:
        fresh = errors & ~self.told_errors
        self.told_errors |= fresh
        texts = [(bit, text_of(bit)) for bit in bits(fresh)]
        return [Fault(self.name, t, bit, x.name, prefix + x.cause, x.cure) for bit, x in texts]

    def _hear_errors(self, t: Nanos, active: int, reason: int) -> list[Event]:
        """Get_Error: the disarm reason counts only where we saw it disarm; an old one is history."""
        events = self._new_errors(t, active & ~Error.INITIALIZING)
        if self.want_reason:
            self.want_reason = False
            events += self._new_errors(t, reason & ~Error.INITIALIZING, "it disarmed the axis: ")
        return events

    def _judge_arming(self, t: Nanos, closed: bool) -> list[Event]:
        if closed or not self.attempts or self.refused or self.releasing:
            return []
        self.beats_since_arming += 1
        if self.beats_since_arming < CONFIRMED:  # the first may be from before our request
            return []
        known = RESULTS.get(self.result)
        if self.result not in WAITING and known is not None:
            self.refused = True
            return [Fault(self.name, t, PROCEDURE + self.result, known.name, known.cause, known.cure)]
        if self.attempts < ARM_ATTEMPTS or self.beats_since_arming < ARM_ATTEMPTS:
            return []
        self.refused = True
        said = f"it stayed in {state_name(self.state or 0, AxisState)} with {result_name(self.result)}"
        cure = "look at it with the vendor's tool, then clear"
        return [Fault(self.name, t, NOT_ARMED, f"did not arm in {self.attempts} tries", said, cure)]

    def _tell_state(self, t: Nanos, fell: bool) -> list[Event]:
        detail = state_name(self.state or 0, AxisState)
        if self.result not in (Result.SUCCESS, Result.BUSY):
            detail += f", {result_name(self.result)}"
        if fell and not self.errors:
            detail += ", left closed loop by itself"
        told = (self._mode_now(), detail)
        if told == self.told:
            return []
        self.told = told
        return [State(self.name, t, *told)]

    def _mode_now(self) -> Mode:
        if self.errors & Error.INITIALIZING:
            return Mode.INITIALISING
        if self.errors or self.told_firmware:
            return Mode.FAULT
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return Mode.ARMED
        return Mode.READY if self.state == AxisState.IDLE else Mode.INITIALISING

    def _hear_version(self, t: Nanos, version: GetVersion) -> list[Event]:
        self.version = version
        line = f"{version.fw_major}.{version.fw_minor}"
        if line == self.options.firmware:
            self.told_firmware = False
            return []
        return self._wrong_firmware(t, f"firmware {line}.{version.fw_revision}", "it says so by Get_Version")

    def _wrong_firmware(self, t: Nanos, name: str, cause: str) -> list[Event]:
        if self.told_firmware:
            return []
        self.told_firmware = True
        cure = f"this driver speaks {self.options.firmware}.x: update the device's firmware"
        return [Fault(self.name, t, WRONG_FIRMWARE, name, cause, cure), *self._tell_state(t, fell=False)]

    # -- saying -------------------------------------------------------------------------------

    def say(self, now: Nanos, command: Command) -> list[Message]:
        """What a command takes now; nothing while the device cannot take it."""
        if isinstance(command, Idle):
            return self._release(now)
        self.releasing = False
        if self.unfit():
            return []
        if not isinstance(command, Hold):
            self.hold = None
        elif self.hold is None:
            self.hold = self.position
        mode, target = setpoint(command, self.hold or 0.0)
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return self._steer(mode, target)
        return self._arm(now, mode)

    def unfit(self) -> str:
        """Why the device cannot be commanded now; "" if it can."""
        if self.offline or self.state is None:
            return "it is not heard"
        if self.told_firmware or self.version is None:
            return "its firmware is not known to be 0.6"
        if self.position is None:
            return "its position is not known yet"
        if self.errors:
            return "it is in fault"
        if self.want_reason:  # arming again might wipe it
            return "why it disarmed is not known yet"
        return "it would not arm" if self.refused else ""

    def _steer(self, mode: ControlMode, target: Message) -> list[Message]:
        self.claimed = True
        if self.mode == mode:
            return [target]
        # The set-point stands before the mode changes, so that no stale input is obeyed in between;
        # and after it, since entering position control may replace the input by the present position.
        self.mode = mode
        return [target, SetControllerMode(mode, InputMode.PASSTHROUGH), target]

    def _arm(self, now: Nanos, mode: ControlMode) -> list[Message]:
        said: list[Message] = []
        if self.mode != mode:
            said.append(SetControllerMode(mode, InputMode.PASSTHROUGH))
            self.mode, self.claimed = mode, True
        said.append(standstill(mode, self.position or 0.0))
        if now >= self.arm_next:
            said.append(SetAxisState(AxisState.CLOSED_LOOP_CONTROL))
            self.arm_next = now + self.options.arm_retry_ms * MILLISECOND
            self.state_sent = now
            self.attempts += 1
        return said

    def _release(self, now: Nanos) -> list[Message]:
        if not self.claimed:
            return []
        if not self.releasing:
            self.releasing, self.release_seen, self.release_next = True, 0, now
            self.armed, self.mode, self.hold, self.refused = False, None, None, False
            self.attempts, self.arm_next, self.beats_since_arming = 0, 0, 0
        if now < self.release_next:
            return []
        self.release_next, self.state_sent = now + RELEASE_AGAIN, now
        return [SetAxisState(AxisState.IDLE)]

    def cleared(self) -> None:
        """An operator clears the device's faults: it may arm again, and is asked again what it is."""
        self.refused, self.attempts, self.beats_since_arming, self.want_reason = False, 0, 0, False
        if self.told_firmware:
            self.told_firmware, self.version, self.version_asks = False, None, 0

    # -- by itself ----------------------------------------------------------------------------

    def tend(self, now: Nanos) -> tuple[list[Event], list[int]]:
        """What falls due: silence told, and the commands to be asked for."""
        if self.started is None:
            self.started = now
        events: list[Event] = []
        if not self.offline and now >= self._offline_at():
            self.offline = True
            self.forget()
            events.append(State(self.name, now, Mode.OFFLINE, "nothing heard"))
        asks = [cmd for cmd in ASKED if self._ask_at(cmd) <= now]
        for cmd in asks:
            self.asked[cmd] = now
            self.unanswered = self.unanswered or cmd == ESTIMATES
            self.version_asks += cmd == VERSION and self.state is not None
            self.reason_asks += cmd == ERROR
        self.want_reason = self.want_reason and self.reason_asks < REASON_ATTEMPTS
        if self.version_asks > VERSION_ATTEMPTS and self.version is None:
            events += self._wrong_firmware(
                now, "firmware unknown", "it sends heartbeats but does not answer Get_Version: 0.5.x?"
            )
        return events, asks

    def due(self) -> Nanos:
        """When `tend` next has something to do."""
        if self.started is None:
            return 0
        times = [self._ask_at(cmd) for cmd in ASKED]
        if not self.offline:
            times.append(self._offline_at())
        return min(times)

    def _offline_at(self) -> Nanos:
        since = self.heard_at if self.heard_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND

    def _ask_at(self, cmd: int) -> Nanos:
        asked = self.asked.get(cmd)
        again = (asked + ASK_AGAIN) if asked is not None else (self.started or 0)
        if cmd == VERSION:
            return again if self.version is None else NEVER
        if cmd == ERROR:
            return again if self.want_reason else NEVER
        if cmd == HEARTBEAT:
            return max(again, self.heard.get(cmd, self.started or 0) + HEARTBEAT_MISSED)
        if cmd == ESTIMATES:
            return self._ask_estimates_at(again)
        period = self.options.poll_ms * MILLISECOND
        if not period or self.offline or self.state is None:
            return NEVER
        first = (self.started or 0) + period * (1 + POLLED.index(cmd)) // len(POLLED)
        return max(self.heard.get(cmd, first - period), self.asked.get(cmd, first - period)) + period

    def _ask_estimates_at(self, again: Nanos) -> Nanos:
        if self.offline or self.state is None:
            return again
        period = self.options.feedback_ms * MILLISECOND
        return max(self.asked.get(ESTIMATES, 0), self.cyclic_at + period) + period


def setpoint(command: Command, hold: float) -> tuple[ControlMode, Message]:
    """The control mode and input [turns] of a command; `hold` [turns] is where Hold holds."""
    match command:
        case Position(_, position, velocity, torque):
            return ControlMode.POSITION, SetInputPos(turns(position), turns(velocity), torque)
        case Velocity(_, velocity, torque):
            return ControlMode.VELOCITY, SetInputVel(turns(velocity), torque)
        case Torque(_, torque):
            return ControlMode.TORQUE, SetInputTorque(torque)
    return ControlMode.POSITION, SetInputPos(hold, 0.0, 0.0)


def standstill(mode: ControlMode, position: float) -> Message:
    """The input that does not move a shaft at this position [turns]."""
    if mode == ControlMode.POSITION:
        return SetInputPos(position, 0.0, 0.0)
    return SetInputVel(0.0, 0.0) if mode == ControlMode.VELOCITY else SetInputTorque(0.0)
