"""What the driver knows and wants of one device: its state heard, its arming, its polling.

Rules. Nothing but remote frames goes to a device that was never commanded, or whose firmware line is not
known (`identify`). The arming sequence is mode → set-point that does not move the shaft → Set_Axis_State 8 →
wait for a heartbeat in state 8; errors are never cleared unasked. What was armed is remembered as `claimed`
through silence and bus trouble, so that Idle still goes out; whether it *is* armed is forgotten then, and
only a fresh sequence arms again. Set-points go out only while heartbeats say closed loop. What differs by
firmware line is `dialect`'s.
"""

from __future__ import annotations

from dataclasses import replace

from protocols.messages import MILLISECOND, Command, Event, Fault, Feedback, Hold, Idle, Mode, Nanos, State
from protocols.odrive_can.codec import EXTENDED, AnyMessage, cmd_of, radians
from protocols.odrive_can.dialect import DIALECTS, Beat, Dialect, beat_of
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
    InputMode,
    SetAxisState,
    SetControllerMode,
)
from protocols.odrive_can.messages05 import (
    GetControllerError,
    GetEncoderError,
    GetMotorError,
    GetSensorlessError,
)
from protocols.odrive_can.options import Options
from protocols.odrive_can.places import Places
from protocols.odrive_can.polling import NEVER, OTHER, VERSION, Asking
from protocols.odrive_can.setpoints import Input, setpoint, standstill
from protocols.plugin import FaultInfo

RELEASE_AGAIN = 50 * MILLISECOND
"""Set_Axis_State IDLE is repeated so often until two heartbeats have confirmed it."""
CONFIRMED = 2
ARM_ATTEMPTS = 5
"""After so many tries without closed loop it is a fault."""
WAITING = (Result.SUCCESS, Result.BUSY, Result.CANCELLED, Result.DISARMED)
"""Results that may be left over from before the request: no verdict on it."""


class Node:
    """One device as the driver sees it. Plain data."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name = name
        self.address = address | EXTENDED if options.is_extended else address
        """As `codec` has a node: with a mark on an extended one."""
        self.options = options
        self.identity = Identity(options.firmware)
        self.started: Nanos | None = None
        self.received_at: Nanos | None = None
        self.offline = False
        self.state: int | None = None
        self.beat = Beat(0, 0)
        """The last one."""
        self.position: float | None = None
        """turns"""
        self.owned = False
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
        self.reported: tuple[Mode, str] | None = None
        self.complaints = FaultReports(name)
        self.places = Places()
        self.two = False
        """Its estimates contradict each other: there are two of it."""
        self.beats: list[tuple[Nanos, int, int]] = []
        """The last heartbeats: time, state, errors."""
        self.asking = Asking(options)
        self._line_heard = ""
        """The firmware line in which `state` was heard."""

    @property
    def dialect(self) -> Dialect:
        """How to speak with it."""
        return DIALECTS[self.identity.reading]

    def forget(self) -> None:
        """The device may have restarted or been changed: only a fresh sequence arms it again."""
        self.identity.forget()
        self.state, self.position, self.hold, self.reported = None, None, None, None
        self.armed, self.mode, self._line_heard = False, None, ""
        self.attempts, self.arm_next, self.beats_since_arming, self.release_seen = 0, 0, 0, 0
        self.complaints.wanted.clear()
        self.beats.clear()

    def resend(self) -> None:
        """Frames may have been lost on our side: say mode and state again."""
        self.mode, self.arm_next, self.release_next, self.release_seen = None, 0, 0, 0

    # -- hearing ------------------------------------------------------------------------------

    def handle(self, t: Nanos, message: AnyMessage) -> list[Event]:
        """A message of the device; what it means in words."""
        self.received_at, self.offline = t, False
        self.asking.handle(t, cmd_of(type(message)))
        match message:
            case GetEncoderEstimates(position, velocity):
                self.position = position
                self.two = self.two or self.places.handle(t, position, velocity)
                return [Feedback(self.name, t, position=radians(position), velocity=radians(velocity))]
            case GetIq(_, measured):
                return [Feedback(self.name, t, current=measured)]
            case GetTorques(_, estimate):
                return [Feedback(self.name, t, torque=estimate)]
            case GetBusVoltageCurrent(voltage, _):
                reported = self._identified(t, self.identity.on_other())
                return [Feedback(self.name, t, voltage=voltage), *reported]
            case GetTemperature(fet, motor):
                known = [value for value in (fet, motor) if value is not None]
                return [Feedback(self.name, t, temperature=max(known))] if known else []
            case GetError(active, reason):
                return self.complaints.on_errors(t, self.dialect, active, reason)
            case GetMotorError() | GetEncoderError() | GetControllerError() | GetSensorlessError():
                return self.complaints.on_part(t, self.dialect, cmd_of(type(message)), message.errors)
            case GetVersion():
                return self._identified(t, self.identity.on_version(message))
        beat = beat_of(message)
        return self._on_beat(t, beat) if beat is not None else []

    def _identified(self, t: Nanos, wrong: FaultInfo | None) -> list[Event]:
        """The firmware line may be known now: what was heard before is to be heard again in its language."""
        if self.dialect.line != self._line_heard:
            self._line_heard, self.state = self.dialect.line, None
            self.complaints.wanted.clear()
        if wrong is None:
            return []
        fault = Fault(self.name, t, WRONG_FIRMWARE, wrong.name, wrong.cause, wrong.remedy)
        return [fault, *self._report_state(t, fell=False)]

    def _on_beat(self, t: Nanos, beat: Beat) -> list[Event]:
        dialect, before = self.dialect, self.beat
        if beat.error & dialect.initializing and not before.error & dialect.initializing:
            self.forget()
        self.state, self.beat = beat.state, beat
        self.beats = [*self.beats[-3:], (t, beat.state, beat.error)]
        closed = beat.state == AxisState.CLOSED_LOOP_CONTROL
        fell = self.armed and not closed
        if fell:
            self.armed, self.mode, self.hold = False, None, None
        elif closed and self.owned and not self.releasing:
            self.armed, self.attempts, self.beats_since_arming = True, 0, 0
        self._confirm_release(closed=closed)
        events = self.complaints.on_beat(t, dialect, before, beat, fell=fell)
        events += self._judge_arming(t, closed=closed)
        return events + self._report_state(t, fell=fell)

    def _confirm_release(self, closed: bool) -> None:
        self.release_seen = self.release_seen + 1 if self.releasing and not closed else 0
        if self.release_seen >= CONFIRMED:
            self.owned = self.releasing = False
            self.release_seen = 0

    def _judge_arming(self, t: Nanos, closed: bool) -> list[Event]:
        if closed or not self.attempts or self.refused or self.releasing:
            return []
        self.beats_since_arming += 1
        if self.beats_since_arming < CONFIRMED:  # the first may be from before our request
            return []
        known = RESULTS.get(self.beat.result)
        if self.beat.result not in WAITING and known is not None:
            self.refused = True
            return [Fault(self.name, t, PROCEDURE + self.beat.result, known.name, known.cause, known.remedy)]
        if self.attempts < ARM_ATTEMPTS or self.beats_since_arming < ARM_ATTEMPTS or t < self.arm_next:
            return []
        self.refused = True
        said = f"it stayed in {state_name(self.beat.state, AxisState)} with {result_name(self.beat.result)}"
        remedy = "look at it with the vendor's tool, then clear"
        return [Fault(self.name, t, NOT_ARMED, f"did not arm in {self.attempts} tries", said, remedy)]

    def _report_state(self, t: Nanos, fell: bool) -> list[Event]:
        detail = state_name(self.beat.state, AxisState)
        if self.beat.result not in (Result.SUCCESS, Result.BUSY):
            detail += f", {result_name(self.beat.result)}"
        if fell and not self.faulty():
            detail += ", left closed loop by itself"
        if not self.identity.line and not self.identity.wrong:
            detail += ", asking for its firmware"
        reported = (self._mode_now(), detail)
        if reported == self.reported:
            return []
        self.reported = reported
        return [State(self.name, t, *reported)]

    def _mode_now(self) -> Mode:
        if self.identity.wrong:
            return Mode.FAULT
        if not self.identity.reading or self.beat.error & self.dialect.initializing:
            return Mode.INITIALISING
        if self.faulty():
            return Mode.FAULT
        if self.state == AxisState.CLOSED_LOOP_CONTROL:
            return Mode.ARMED
        return Mode.READY if self.state == AxisState.IDLE else Mode.INITIALISING

    def faulty(self) -> bool:
        """Whether its last heartbeat says that something is wrong."""
        return bool(self.beat.error or self.beat.parts)

    # -- saying -------------------------------------------------------------------------------

    def say(self, now: Nanos, command: Command) -> list[AnyMessage]:
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
        if self.identity.wrong or not self.identity.line:
            return "its firmware is not known"
        if self.position is None:
            return "its position is not known yet"
        if self.faulty():
            return "it is in fault"
        if self.complaints.wanted:  # arming again might wipe it
            return "why it disarmed is not known yet"
        return "it would not arm" if self.refused else ""

    def _steer(self, mode: ControlMode, target: Input) -> list[AnyMessage]:
        self.owned = True
        # One that is taken over may fall before its next heartbeat: that is a fall, too.
        self.armed = self.armed or self.beats[-1][0] > self.state_sent
        if self.mode == mode:
            return [target]
        # The set-point stands before the mode changes, so that no stale input is obeyed in between;
        # and after it, since entering position control may replace the input by the present position.
        self.mode = mode
        return [target, SetControllerMode(mode, InputMode.PASSTHROUGH), target]

    def _arm(self, now: Nanos, mode: ControlMode) -> list[AnyMessage]:
        said: list[AnyMessage] = []
        if self.mode != mode:
            said.append(SetControllerMode(mode, InputMode.PASSTHROUGH))
            self.mode, self.owned = mode, True
        said.append(standstill(mode, self.position or 0.0))
        if now >= self.arm_next and self.attempts < ARM_ATTEMPTS:  # the last try has its time, too
            said.append(SetAxisState(AxisState.CLOSED_LOOP_CONTROL))
            self.arm_next = now + self.options.arm_retry_ms * MILLISECOND
            self.state_sent = now
            self.attempts += 1
        return said

    def _release(self, now: Nanos) -> list[AnyMessage]:
        if not self.owned:
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
        self.refused, self.attempts, self.beats_since_arming = False, 0, 0
        self.two, self.places = False, Places()
        self.complaints.wanted.clear()
        self.identity.cleared()

    def report_again(self) -> None:
        """Faults that stay are told again, with all their words."""
        self.complaints.reported.clear()
        self.beat = replace(self.beat, parts=())

    # -- by itself ----------------------------------------------------------------------------

    def tend(self, now: Nanos) -> tuple[list[Event], list[int]]:
        """What falls due: silence told, and the commands to be asked for."""
        if self.started is None:
            self.started = self.asking.started = now
        events: list[Event] = []
        if not self.offline and now >= self._offline_at():
            self.offline = True
            self.forget()
            events.append(State(self.name, now, Mode.OFFLINE, "nothing heard"))
        asks: list[int] = []
        if now >= self._ask_at():
            alive = self._alive()
            plan = self.asking.plan(self.identity, self.complaints.wanted, alive)
            asks = [cmd for at, cmd in plan if at <= now]
        for cmd in asks:
            self.asking.ask(now, cmd)
        self.complaints.asked(asks)
        if VERSION in asks:
            events += self._identified(now, self.identity.ask(beating=self.state is not None))
            asks += [OTHER] if not self.identity.line and self.state is not None else []
        return events, asks

    def due(self) -> Nanos:
        """When `tend` next has something to do that cannot wait for a step."""
        if self.started is None:
            return 0
        pressing = self.asking.pressing(self.identity, self.complaints.wanted, self._alive())
        return pressing if self.offline else min(pressing, self._offline_at())

    def _ask_at(self) -> Nanos:
        return self.asking.due(self.identity, self.complaints.wanted, self._alive())

    def _alive(self) -> bool:
        return not self.offline and self.state is not None

    def _offline_at(self) -> Nanos:
        since = self.received_at if self.received_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND
