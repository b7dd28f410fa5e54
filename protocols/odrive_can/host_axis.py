"""The host's record of one device: its reported state, arming and disarming, and what is sent to it.

Rules. Only remote frames go to a device that was never commanded, or whose firmware line is not known
(`identify`). The arming sequence is mode → set-point that does not move the shaft → Set_Axis_State 8 → wait
for a heartbeat in state 8; errors are never cleared unasked. A device that was commanded stays `owned`
through silence and bus errors, so that Idle is still sent; whether it *is* armed is forgotten then, and only
a new sequence arms it again. Set-points are sent only while heartbeats report closed loop. What differs by
firmware line is in `dialect`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

from protocols import messages as msg
from protocols.messages import MILLISECOND, Command, Event, Fault, Feedback, Mode, Nanos, State
from protocols.odrive_can import messages as m
from protocols.odrive_can.codec import EXTENDED, cmd_of, radians, turns
from protocols.odrive_can.dialect import DIALECTS, Dialect, Status, status_of
from protocols.odrive_can.duplicate_address import PositionCheck, alternating
from protocols.odrive_can.fault_reports import FaultReports
from protocols.odrive_can.faults import (
    NOT_ARMED,
    PROCEDURE,
    RESULTS,
    WRONG_FIRMWARE,
    Result,
    result_name,
    state_name,
)
from protocols.odrive_can.identify import Identity
from protocols.odrive_can.messages import AxisState, ControlMode, InputMode, SetAxisState, SetControllerMode
from protocols.odrive_can.options import Options
from protocols.odrive_can.polling import NEVER, SUPPLY, VERSION, Polling
from protocols.plugin import FaultInfo

DISARM_PERIOD = 50 * MILLISECOND
"""Period in which Set_Axis_State IDLE is repeated until `CONFIRMATIONS` heartbeats have confirmed it."""
CONFIRMATIONS = 2
ARM_ATTEMPTS = 5
"""This number of attempts without closed loop is a fault."""
INCONCLUSIVE = (Result.SUCCESS, Result.BUSY, Result.CANCELLED, Result.DISARMED)
"""Results that may be left from before the state request: they do not show how it ended."""

Setpoint: TypeAlias = m.SetInputPos | m.SetInputVel | m.SetInputTorque


def setpoint_of(command: Command, hold_position: float) -> tuple[ControlMode, Setpoint]:
    """Return the control mode and set-point of a command; Hold is at `hold_position` [turns]."""
    match command:
        case msg.Position(_, position, velocity, torque):
            return ControlMode.POSITION, m.SetInputPos(turns(position), turns(velocity), torque)
        case msg.Velocity(_, velocity, torque):
            return ControlMode.VELOCITY, m.SetInputVel(turns(velocity), torque)
        case msg.Torque(_, torque):
            return ControlMode.TORQUE, m.SetInputTorque(torque)
    return ControlMode.POSITION, m.SetInputPos(hold_position, 0.0, 0.0)


def standstill(mode: ControlMode, position: float) -> Setpoint:
    """Return the set-point that does not move a shaft at this position [turns]."""
    if mode == ControlMode.POSITION:
        return m.SetInputPos(position, 0.0, 0.0)
    return m.SetInputVel(0.0, 0.0) if mode == ControlMode.VELOCITY else m.SetInputTorque(0.0)


class HostAxis:
    """One device as the driver knows it. Plain data."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name = name
        self.node = address | EXTENDED if options.is_extended else address
        """As in `codec`: with a mark on an extended one."""
        self.options = options
        self.identity = Identity(options.firmware)
        self.started: Nanos | None = None
        self.received_at: Nanos | None = None
        self.offline = False
        self.state: int | None = None
        """The axis state of the last heartbeat; None if there was none, or it is out of date."""
        self.status = Status(0, 0)
        """Of the last heartbeat."""
        self.position: float | None = None
        """turns"""
        self.owned = False
        """It was commanded since it was last disarmed."""
        self.armed = False
        """It reported closed loop since it is owned."""
        self.control_mode: ControlMode | None = None
        """As sent to it, unless the device may have lost it."""
        self.hold_position: float | None = None
        """turns"""
        self.arming_failed = False
        """Reported as a fault; arming is not tried again before ClearFault or Idle."""
        self.arm_attempts = 0
        self.next_arming: Nanos = 0
        self.state_requested_at: Nanos = -NEVER
        self.heartbeats_since_arming = 0
        self.disarming = False
        self.next_disarming: Nanos = 0
        self.disarm_confirmations = 0
        self.reported_state: tuple[Mode, str] | None = None
        self.faults = FaultReports(name)
        self.position_check = PositionCheck()
        self.two_positions = False
        """Its encoder estimates are those of two shafts."""
        self.heartbeats: list[tuple[Nanos, int, int]] = []
        """The last four: time, state, errors."""
        self.polling = Polling(options)
        self._state_line = ""
        """The firmware line that `state` was decoded with."""

    @property
    def dialect(self) -> Dialect:
        """What is particular to its firmware line."""
        return DIALECTS[self.identity.decoded_as]

    def forget(self) -> None:
        """Forget the device's state, as it may have restarted or been replaced: only a new sequence arms
        it."""
        self.identity.forget()
        self.state, self.position, self.hold_position, self.reported_state = None, None, None, None
        self.armed, self.control_mode, self._state_line = False, None, ""
        self.arm_attempts, self.next_arming, self.heartbeats_since_arming = 0, 0, 0
        self.disarm_confirmations = 0
        self.faults.awaited.clear()
        self.heartbeats.clear()

    def resend(self) -> None:
        """Send mode and state again, as frames may have been lost in the transmit queue."""
        self.control_mode, self.next_arming, self.next_disarming, self.disarm_confirmations = None, 0, 0, 0

    # -- received messages --------------------------------------------------------------------

    def on_message(self, t: Nanos, message: m.Message) -> list[Event]:
        """Handle a message of the device."""
        self.received_at, self.offline = t, False
        self.polling.on_message(t, cmd_of(type(message)))
        match message:
            case m.GetEncoderEstimates(position, velocity):
                self.position = position
                self.two_positions = self.two_positions or self.position_check.add(t, position, velocity)
                return [Feedback(self.name, t, position=radians(position), velocity=radians(velocity))]
            case m.GetIq(_, measured):
                return [Feedback(self.name, t, current=measured)]
            case m.GetTorques(_, estimate):
                return [Feedback(self.name, t, torque=estimate)]
            case m.GetBusVoltageCurrent(voltage, _):
                events = self._on_identity(t, self.identity.on_reply())
                return [Feedback(self.name, t, voltage=voltage), *events]
            case m.GetTemperature(fet, motor):
                known = [value for value in (fet, motor) if value is not None]
                return [Feedback(self.name, t, temperature=max(known))] if known else []
            case m.GetError(active, reason):
                return self.faults.on_errors(t, self.dialect, active, reason)
            case m.GetMotorError() | m.GetEncoderError() | m.GetControllerError() | m.GetSensorlessError():
                return self.faults.on_component(t, self.dialect, cmd_of(type(message)), message.errors)
            case m.GetVersion():
                return self._on_identity(t, self.identity.on_version(message))
        status = status_of(message)
        return self._on_status(t, status) if status is not None else []

    def _on_identity(self, t: Nanos, wrong: FaultInfo | None) -> list[Event]:
        """Handle a step of the identification: a state decoded before the line was known does not count."""
        if self.dialect.line != self._state_line:
            self._state_line, self.state = self.dialect.line, None
            self.faults.awaited.clear()
        if wrong is None:
            return []
        fault = Fault(self.name, t, WRONG_FIRMWARE, wrong.name, wrong.cause, wrong.remedy)
        return [fault, *self._report_state(t, disarmed_itself=False)]

    def _on_status(self, t: Nanos, status: Status) -> list[Event]:
        dialect, before = self.dialect, self.status
        if status.error & dialect.initializing and not before.error & dialect.initializing:
            self.forget()
        self.state, self.status = status.state, status
        self.heartbeats = [*self.heartbeats[-3:], (t, status.state, status.error)]
        closed_loop = status.state == AxisState.CLOSED_LOOP_CONTROL
        disarmed_itself = self.armed and not closed_loop
        if disarmed_itself:
            self.armed, self.control_mode, self.hold_position = False, None, None
        elif closed_loop and self.owned and not self.disarming:
            self.armed, self.arm_attempts, self.heartbeats_since_arming = True, 0, 0
        self._confirm_disarming(closed_loop=closed_loop)
        events = self.faults.on_status(t, dialect, before, status, disarmed_itself=disarmed_itself)
        events += self._check_arming(t, closed_loop=closed_loop)
        return events + self._report_state(t, disarmed_itself=disarmed_itself)

    def _confirm_disarming(self, closed_loop: bool) -> None:
        confirmed = self.disarming and not closed_loop
        self.disarm_confirmations = self.disarm_confirmations + 1 if confirmed else 0
        if self.disarm_confirmations >= CONFIRMATIONS:
            self.owned = self.disarming = False
            self.disarm_confirmations = 0

    def _check_arming(self, t: Nanos, closed_loop: bool) -> list[Event]:
        if closed_loop or not self.arm_attempts or self.arming_failed or self.disarming:
            return []
        self.heartbeats_since_arming += 1
        if self.heartbeats_since_arming < CONFIRMATIONS:  # the first may be from before the request
            return []
        result = self.status.result
        known = RESULTS.get(result)
        if result not in INCONCLUSIVE and known is not None:
            self.arming_failed = True
            return [Fault(self.name, t, PROCEDURE + result, known.name, known.cause, known.remedy)]
        exhausted = self.arm_attempts >= ARM_ATTEMPTS and self.heartbeats_since_arming >= ARM_ATTEMPTS
        if not exhausted or t < self.next_arming:
            return []
        self.arming_failed = True
        name = f"did not arm in {self.arm_attempts} attempts"
        cause = f"it stayed in {state_name(self.status.state, AxisState)} with {result_name(result)}"
        return [Fault(self.name, t, NOT_ARMED, name, cause, "check it with the vendor's tool, then clear")]

    def _report_state(self, t: Nanos, disarmed_itself: bool) -> list[Event]:
        """Return the state if it changed."""
        detail = state_name(self.status.state, AxisState)
        if self.status.result not in (Result.SUCCESS, Result.BUSY):
            detail += f", {result_name(self.status.result)}"
        if disarmed_itself and not self.status.faulty:
            detail += ", left closed loop by itself"
        if not self.identity.line and not self.identity.wrong:
            detail += ", identifying its firmware"
        state = (self._mode(), detail)
        if state == self.reported_state:
            return []
        self.reported_state = state
        return [State(self.name, t, *state)]

    def _mode(self) -> Mode:
        if self.identity.wrong:
            return Mode.FAULT
        if not self.identity.decoded_as or self.status.error & self.dialect.initializing:
            return Mode.INITIALISING
        if self.status.faulty:
            return Mode.FAULT
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return Mode.ARMED
        return Mode.READY if self.state == AxisState.IDLE else Mode.INITIALISING

    def alternating(self) -> bool:
        """True if its heartbeats are those of two devices."""
        return alternating(self.heartbeats, self.state_requested_at)

    # -- commands -----------------------------------------------------------------------------

    def on_command(self, now: Nanos, command: Command) -> list[m.Message]:
        """Return what a command requires to be sent now; nothing while the device cannot accept it."""
        if isinstance(command, msg.Idle):
            return self._disarm(now)
        self.disarming = False
        if not self._commandable():
            return []
        if not isinstance(command, msg.Hold):
            self.hold_position = None
        elif self.hold_position is None:
            self.hold_position = self.position
        mode, setpoint = setpoint_of(command, self.hold_position or 0.0)
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return self._drive(mode, setpoint)
        return self._arm(now, mode)

    def _commandable(self) -> bool:
        """True if the device is online, identified, at a known position and without a fault."""
        return (
            not self.offline
            and self.state is not None
            and bool(self.identity.line)
            and not self.identity.wrong
            and self.position is not None
            and not self.status.faulty
            and not self.faults.awaited  # arming might erase the reason why it disarmed
            and not self.arming_failed
        )

    def _drive(self, mode: ControlMode, setpoint: Setpoint) -> list[m.Message]:
        self.owned = True
        # A device that is taken over may disarm before its next heartbeat: that is a disarming, too.
        self.armed = self.armed or self.heartbeats[-1][0] > self.state_requested_at
        if self.control_mode == mode:
            return [setpoint]
        # The set-point is sent before the mode changes, so that no stale input is obeyed in between;
        # and after it, since entering position control may replace the input by the present position.
        self.control_mode = mode
        return [setpoint, SetControllerMode(mode, InputMode.PASSTHROUGH), setpoint]

    def _arm(self, now: Nanos, mode: ControlMode) -> list[m.Message]:
        messages: list[m.Message] = []
        if self.control_mode != mode:
            messages.append(SetControllerMode(mode, InputMode.PASSTHROUGH))
            self.control_mode, self.owned = mode, True
        messages.append(standstill(mode, self.position or 0.0))
        if now >= self.next_arming and self.arm_attempts < ARM_ATTEMPTS:  # the last attempt has its time, too
            messages.append(SetAxisState(AxisState.CLOSED_LOOP_CONTROL))
            self.next_arming = now + self.options.arm_retry_ms * MILLISECOND
            self.state_requested_at = now
            self.arm_attempts += 1
        return messages

    def _disarm(self, now: Nanos) -> list[m.Message]:
        if not self.owned:
            return []
        if not self.disarming:
            self.disarming, self.disarm_confirmations, self.next_disarming = True, 0, now
            self.armed, self.control_mode, self.hold_position, self.arming_failed = False, None, None, False
            self.arm_attempts, self.next_arming, self.heartbeats_since_arming = 0, 0, 0
        if now < self.next_disarming:
            return []
        self.next_disarming, self.state_requested_at = now + DISARM_PERIOD, now
        return [SetAxisState(AxisState.IDLE)]

    def on_clear(self) -> None:
        """Handle an operator's ClearFault: the device may arm again, and is identified anew after a fault."""
        self.arming_failed, self.arm_attempts, self.heartbeats_since_arming = False, 0, 0
        self.two_positions, self.position_check = False, PositionCheck()
        self.faults.awaited.clear()
        self.identity.on_clear()

    def report_again(self) -> None:
        """Report the faults that remain once more, with all error words."""
        self.faults.reported.clear()
        self.status = replace(self.status, components=())

    # -- timing -------------------------------------------------------------------------------

    def poll(self, now: Nanos) -> tuple[list[Event], list[int]]:
        """Return what is due: the report of a timeout, and the commands to request."""
        if self.started is None:
            self.started = self.polling.started = now
        events: list[Event] = []
        if not self.offline and now >= self._offline_at():
            self.offline = True
            self.forget()
            events.append(State(self.name, now, Mode.OFFLINE, "no frames received"))
        cmds: list[int] = []
        if now >= self.polling.due(self.identity, self.faults.awaited, self._alive()):
            plan = self.polling.plan(self.identity, self.faults.awaited, self._alive())
            cmds = [cmd for at, cmd in plan if at <= now]
        for cmd in cmds:
            self.polling.on_request(now, cmd)
        self.faults.on_requests(cmds)
        if VERSION in cmds:
            has_heartbeat = self.state is not None
            events += self._on_identity(now, self.identity.on_request(has_heartbeat=has_heartbeat))
            cmds += [SUPPLY] if not self.identity.line and self.state is not None else []
        return events, cmds

    def due(self) -> Nanos:
        """Return when `poll` next has something to do that cannot wait for a step."""
        if self.started is None:
            return 0
        due = self.polling.urgent_due(self.identity, self.faults.awaited, self._alive())
        return due if self.offline else min(due, self._offline_at())

    def _alive(self) -> bool:
        return not self.offline and self.state is not None

    def _offline_at(self) -> Nanos:
        since = self.received_at if self.received_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND
