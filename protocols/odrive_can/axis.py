"""What the host keeps of one device beyond its phase: firmware line, errors, arming, and what is requested.

Rules. Plain data; only its own methods change it. A reply to Get_Version means 0.6.x. A device is 0.5.x if it
sends heartbeats and repeatedly answers another request (one that both lines answer alike), but never
Get_Version and the discovery: silence alone proves nothing, since the host's frames may not arrive. The robot
file states an expectation; the device decides, and a difference is a fault. Until the line is known, and
after a fault, nothing moves. A host that only receives (a dry run, a monitor) never knows the line; for
decoding, and for nothing else, the form of a heartbeat is enough where only one line can have sent it. What a
device sends cyclically is not requested, and nothing faster than the periods below and those of the options.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, SECOND, Mode, Nanos
from protocols.odrive_can import errors, table
from protocols.odrive_can.options import Options
from protocols.odrive_can.setpoints import HEARTBEATS
from protocols.odrive_can.table import ControlMode, InputMode
from protocols.toolkit.duplicates import ShaftCheck, StateCheck
from protocols.toolkit.motor_driver import NEVER
from protocols.toolkit.table import Decoded, Table, Values

VERSION, HEARTBEAT, ESTIMATES = "Get_Version", "Heartbeat", "Get_Encoder_Estimates"
SUPPLY = "Get_Bus_Voltage_Current"  # Both lines answer this alike, and do not send it cyclically by default.
RETRY_PERIOD = 100 * MILLISECOND  # Period in which an unanswered request is repeated.
MODE_PERIOD = 100 * MILLISECOND  # Period in which the control mode is sent again.
VERSION_PERIOD = 5 * SECOND
"""Period of Get_Version to a device that was identified without it, or not at all."""
HEARTBEAT_TIMEOUT = 250 * MILLISECOND  # Time without a heartbeat after which one is requested.
ATTEMPTS = 5
"""After this number of requests an error word is not awaited, and closed loop not requested any more."""
POSITION_TOLERANCE = 0.05  # turns: a smaller difference may be vibration.
IDENTIFY_ATTEMPTS = 10
"""After this number of requests, a device that sends heartbeats and answers nothing is a fault."""
REPLIES = {"auto": 5, "0.5": 2, "0.6": 5}
"""Number of answers to the other request, with none to Get_Version, that identifies 0.5.x; by the option."""
NO_DISCOVERY = "sends heartbeats, but did not answer discovery: firmware 0.5.x?"


class Identity:
    """What is known of one device's firmware. Plain data."""

    def __init__(self, expected: str, extended: bool) -> None:
        self.expected = expected  # "0.5", "0.6" or "auto".
        self.extended = extended
        self.wrong = 0
        """The code of the fault if it is not what was expected, or cannot be identified; until cleared."""
        self.forget()

    def forget(self) -> None:
        """Identify the device anew: it may have restarted, or been replaced. A fault stays."""
        self.line = ""  # Empty while not known.
        self.version = ""  # As it reported it.
        self._requests = self._replies = 0
        self._reply_pending = self._answers_discovery = False
        self.decode_as("")

    def decode_as(self, line: str) -> None:
        """Decode its frames as those of a line, known or not."""
        self.dialect = table.DIALECTS[line]
        self.table: Table = table.table_of(line, self.extended)

    def decode_by_form(self, frame: CanFrame, heartbeat: Decoded) -> Decoded:
        """Return a heartbeat as of the line whose form it has, and decode as that line from now on: only if
        it is a whole one of that line, so that what is decoded is always of the line it is taken for."""
        line = table.line_by_form(heartbeat.values)
        better = table.table_of(line, self.extended).decode(frame, "from_device")
        if better is None or not better.name:
            return heartbeat
        self.decode_as(line)
        return better

    @property
    def as_expected(self) -> bool:
        """True if the line that its frames are decoded as is the one in the robot file."""
        return self.expected in ("auto", self.dialect.line)

    @property
    def known(self) -> bool:
        """True if it may be commanded."""
        return bool(self.line) and not self.wrong

    def on_request(self, has_heartbeat: bool) -> None:
        """Count a request of Get_Version and the other message."""
        self._reply_pending = True
        self._requests += has_heartbeat
        if self._requests > IDENTIFY_ATTEMPTS and not self.line:
            self._fault(errors.FIRMWARE_UNKNOWN)

    def on_reply(self) -> bool:
        """Handle an answer to the other request. True if that identifies the line."""
        if not self._reply_pending or self.line:
            return False
        self._reply_pending = False
        self._replies += 1
        if self._replies < REPLIES[self.expected] or self._answers_discovery:
            return False
        self.line = "0.5"
        self.decode_as(self.line)
        if self.expected == "0.6":
            self._fault(errors.FIRMWARE_05)
        return True

    def on_discovery_reply(self) -> None:
        """Handle an answer on the broadcast node, which no 0.5.x gives."""
        self._answers_discovery = True

    def on_version(self, values: Values) -> None:
        """Handle a reply to Get_Version."""
        before, line = self.line, f"{values['Fw_Version_Major']}.{values['Fw_Version_Minor']}"
        self.version = f"{line}.{values['Fw_Version_Revision']}"
        self.line = "0.6" if line == "0.6" else ""
        self.decode_as(self.line)
        if line != "0.6":
            self._fault(errors.FIRMWARE_OTHER)
        elif before == "0.5":
            self._fault(errors.FIRMWARE_CHANGED)
        elif self.expected == "0.5":
            self._fault(errors.FIRMWARE_06)

    def _fault(self, code: int) -> None:
        """Keep the first fault until it is cleared."""
        self.wrong = self.wrong or code

    def on_clear(self) -> bool:
        """Handle an operator's ClearFault. True if the device is to be identified anew."""
        wrong, self.wrong = self.wrong, 0
        return wrong != 0

    def text(self) -> str:
        """Return the firmware as far as known."""
        if self.version:
            return f"firmware {self.version}"
        return f"firmware {self.line}.x" if self.line else "firmware not known yet"

    def found(self) -> str:
        """Return what a scan reports of it if it did not answer discovery."""
        return self.text() if self.line else NO_DISCOVERY


class Axis:
    """One device."""

    def __init__(self, address: int, options: Options) -> None:
        self.address = address
        self.identity = Identity(options.firmware, options.is_extended)
        requests = table.requests_of(options.firmware, options.is_extended)
        self.requests: dict[str, CanFrame] = {
            row.name.removeprefix("request for "): requests.encode(row.name, address)
            for row in requests.rows
            if row.remote
        }
        """By message: the remote frame that requests it."""
        self.registers = options.registers()
        self._position_input = InputMode[options.position_input.upper()]
        self.written: dict[str, float] = {}  # Parameters that were written to it.
        # Of the last heartbeat:
        self.state = self.errors = self.result = 0
        self.components: tuple[str, ...] = ()  # Messages of the components with errors.
        self.heartbeat_at: Nanos = -1
        self.alive = False  # There was a heartbeat, decoded as its line is now.
        self.words: dict[str, int] = {}  # Error words of its components, by message.
        self.awaited: dict[str, int] = {}
        """Messages with error words that are awaited, and how often each was requested."""
        self.control_mode: int | None = None  # As sent to it, unless it may have lost it.
        self._mode_at: Nanos = 0  # When it was last sent.
        self.failure = 0
        """Code of the fault that ended arming, which is not tried again before ClearFault or Idle."""
        self.requested_at: Nanos = -NEVER  # When a state was last requested.
        self._attempts = self._heartbeats_since = 0
        self._next_attempt: Nanos = 0
        self._retry = options.arm_retry_ms * MILLISECOND
        self._shaft = ShaftCheck(POSITION_TOLERANCE)
        self._states = StateCheck()
        self.due: Nanos = 0
        """When the first request is due that is worth a step of its own, which repeats every set-point. Polls
        are not: with twelve motors they would nearly double the bus load."""
        self.polls_due: Nanos = NEVER
        self._due: dict[str, Nanos] = {VERSION: 0, ESTIMATES: 0, HEARTBEAT: 0}
        """When each message is requested next."""
        self._polls: dict[str, Nanos] = {}  # When each polled message is.
        self._feedback, self._poll = options.feedback_ms * MILLISECOND, options.poll_ms * MILLISECOND
        self._estimates_pending = False  # They were requested and have not been received.

    # -- received -------------------------------------------------------------------------------------

    def on_estimates(self, t: Nanos, position: float, velocity: float) -> str:
        """Handle encoder estimates [turns]; return why they must be of two shafts, or ""."""
        if not self._estimates_pending:  # sent cyclically
            self._due[ESTIMATES] = t + 2 * self._feedback
            self.due = min(self._due.values())
        self._estimates_pending = False
        return "its positions contradict each other in turn" if self._shaft.add(t, position, velocity) else ""

    def on_heartbeat(self, t: Nanos, values: Values, fell: bool, releasing: bool) -> str:
        """Handle a heartbeat; `fell`: it left closed loop by itself, `releasing`: Idle is being sent. Return
        why it must be of two devices, or ""."""
        dialect = self.identity.dialect
        self.state, self.errors = values["Axis_State"], values["Axis_Error"]
        self.result = values.get("Procedure_Result", errors.SUCCESS)
        before, self.components = self.components, table.flagged(values) if dialect.boards else ()
        if self.words or self.components or fell:
            self.words = {name: self.words.get(name, 0) for name in self.components}
            self._await(t, [name for name in self.components if name not in before])
            self._await(t, dialect.disarm_reasons if fell else ())
        if self.state == table.CLOSED_LOOP:
            self._attempts = self._heartbeats_since = 0
        elif fell:
            self.control_mode = None
        if self._attempts and not self.failure and not releasing:
            self._check_arming(t)
        if not self.alive:
            self.alive, self.polls_due = True, 0
        self.heartbeat_at = t
        on_request = not dialect.boards or not self.identity.as_expected
        self._due[HEARTBEAT] = t + HEARTBEAT_TIMEOUT if on_request else NEVER
        self.due = min(self._due.values())
        twice = self._states.add(t, (self.state, self.errors), self.requested_at)
        return "its heartbeats contradict each other in turn" if twice else ""

    def _check_arming(self, t: Nanos) -> None:
        self._heartbeats_since += 1
        if self._heartbeats_since < HEARTBEATS:
            return
        if self.result not in errors.INCONCLUSIVE and self.result in errors.RESULT_NAMES:
            self.failure = errors.PROCEDURE + self.result
        elif min(self._attempts, self._heartbeats_since) >= ATTEMPTS and t >= self._next_attempt:
            self.failure = errors.NOT_ARMED

    def _await(self, t: Nanos, names: Collection[str]) -> None:
        self.awaited |= dict.fromkeys(names, 0)
        self._due |= dict.fromkeys(names, t) if self.identity.as_expected else {}

    def on_word(self, name: str, word: int) -> Collection[int]:
        """Handle the error word of a component (0.5.x); return the codes of all faults."""
        self._received(name)
        self.words[name] = word
        return self.codes()

    def on_errors(self, active: int, reason: int) -> Collection[int]:
        """Handle Get_Error (0.6.x); return the codes of all faults. The disarm reason counts only after a
        disarming that was observed."""
        reason = reason if self._received("Get_Error") else 0
        return [*self.codes(), *errors.ERRORS.codes((active | reason) & ~errors.INITIALIZING)]

    def _received(self, name: str) -> bool:
        """True if this error word was awaited."""
        self._due.pop(name, None)
        return self.awaited.pop(name, None) is not None

    def on_message(self, t: Nanos, name: str, values: Values) -> None:
        """Handle a message that identifies it, or may be polled."""
        if name in self._polls:
            self._polls[name] = t + self._poll
        identity = self.identity
        before = identity.line, identity.dialect
        if name == VERSION:
            identity.on_version(values)
            self._due[VERSION] = t + VERSION_PERIOD if identity.wrong else NEVER
        elif name == SUPPLY and identity.on_reply():
            self._due[VERSION] += VERSION_PERIOD - RETRY_PERIOD
        if (identity.line, identity.dialect) != before:
            self._identified()

    def _identified(self) -> None:
        """Forget the state: one decoded before the line was known does not count."""
        self.alive = False
        for name in tuple(self.awaited):
            self._received(name)
        self._polls.clear()
        self.report_again()
        self.due = min(self._due.values())

    # -- what is reported -----------------------------------------------------------------------------

    def codes(self) -> Collection[int]:
        """Return the codes of all faults that are active."""
        dialect, wrong = self.identity.dialect, self.identity.wrong
        if not (self.errors or self.words or wrong or self.failure):
            return ()
        return [*dialect.codes(self.errors, self.words), *filter(None, (wrong, self.failure))]

    @property
    def faulty(self) -> bool:
        """True if it reports any error."""
        return bool(self.errors or self.components)

    def mode(self) -> Mode:
        """Return the state of the device."""
        identity = self.identity
        return Mode.FAULT if identity.wrong else identity.dialect.mode(self.state, self.errors, self.faulty)

    def detail(self, fell: bool = False) -> str:
        """Return the vendor's name for it."""
        text = table.state_text(self.state, self.result)
        if fell and not self.faulty:
            text += ", left closed loop by itself"
        if not self.identity.line and not self.identity.wrong:
            text += ", identifying its firmware"
        return text

    # -- commanded ------------------------------------------------------------------------------------

    @property
    def commandable(self) -> bool:
        """True if it is identified and reported its state. Arming might erase the reason why it disarmed, and
        would end a procedure."""
        unable = self.awaited or self.failure or self.faulty or self.state in table.PROCEDURES
        return self.alive and self.identity.known and not unable

    def encode(self, name: str, **values: Any) -> CanFrame:  # noqa: ANN401 -- numbers
        """Return the frame of a message to it."""
        return self.identity.table.encode(name, self.address, **values)

    def action(self, key: object) -> Sequence[CanFrame]:
        """Return the message that carries out a request; none where that cannot be done over CAN."""
        message = self.identity.dialect.messages.get(key)
        return () if message is None else (self.encode(message[0], **message[1]),)

    def set_mode(self, now: Nanos, mode: ControlMode) -> Sequence[CanFrame]:
        """Set the control mode. Returns what must be sent for it: again and again, as nothing confirms it."""
        changed = mode != self.control_mode or now - self._mode_at > MODE_PERIOD
        self.control_mode, self._mode_at = mode, now if changed else self._mode_at
        given = self._position_input if mode is ControlMode.POSITION else InputMode.PASSTHROUGH
        return [self.encode("Set_Controller_Mode", Control_Mode=mode, Input_Mode=given)] if changed else []

    def attempt(self, now: Nanos) -> bool:
        """Arm. True if closed loop is to be requested now: the last attempt has its time, too."""
        if now < self._next_attempt or self._attempts >= ATTEMPTS:
            return False
        self._next_attempt, self.requested_at = now + self._retry, now
        self._attempts += 1
        return True

    def release(self, now: Nanos) -> None:
        """Disarm."""
        self.requested_at, self.control_mode, self.failure = now, None, 0
        self._attempts = self._next_attempt = self._heartbeats_since = 0

    def write(self, parameter: str, value: float) -> Mapping[str, float]:
        """Keep a parameter that is to be written; return all of them."""
        self.written[parameter] = value
        return self.written

    def clear(self, now: Nanos) -> bool:
        """Handle an operator's ClearFault: it may arm again. True if it is identified anew, after a fault."""
        self.failure = self._attempts = self._heartbeats_since = 0
        self._shaft = ShaftCheck(POSITION_TOLERANCE)
        for name in tuple(self.awaited):
            self._received(name)
        wrong = self.identity.on_clear()
        if wrong:
            self.forget(now)
        return wrong

    def report_again(self) -> None:
        """Request the error words of the faults that remain once more."""
        self.words, self.components = {}, ()

    def resend(self) -> None:
        """Send mode and state again, as frames may have been lost in the transmit queue."""
        self.control_mode, self._next_attempt = None, 0

    def forget(self, now: Nanos) -> None:
        """Forget its state, as it may have restarted or been replaced."""
        self.identity.forget()
        self.resend()
        self._attempts = self._heartbeats_since = 0
        self._states = StateCheck()
        self._due |= {name: now for name in (VERSION, HEARTBEAT) if self._due[name] > now + RETRY_PERIOD}
        self._identified()

    # -- requested ------------------------------------------------------------------------------------

    def plan(self, now: Nanos) -> list[str]:
        """Return the messages that are requested now."""
        self._due[HEARTBEAT] = self._due[HEARTBEAT] or now + HEARTBEAT_TIMEOUT  # at first
        names = [name for name, at in self._due.items() if now >= at]
        for name in names:
            self._due[name] = now + RETRY_PERIOD
        if VERSION in names:
            identity = self.identity
            identity.on_request(self.alive)
            self._due[VERSION] = now + (VERSION_PERIOD if identity.line or identity.wrong else RETRY_PERIOD)
            names += [SUPPLY] if not identity.line and self.alive else []
        if ESTIMATES in names:
            self._estimates_pending = True
            self._due[ESTIMATES] = now + (self._feedback if self.alive else RETRY_PERIOD)
        for name in self.awaited.keys() & names:
            self.awaited[name] += 1
            if self.awaited[name] >= ATTEMPTS:
                self._received(name)
        self.due = min(self._due.values())
        return names + self._due_polls(now)

    def _due_polls(self, now: Nanos) -> list[str]:
        """Return the polled messages that are due; at first they are spread over one period."""
        polled = self.identity.dialect.polled if self._poll and self.identity.as_expected else ()
        if not self._polls and self.alive:
            spread = [self._poll * (1 + at) // len(polled) for at in range(len(polled))]
            self._polls = {name: self.heartbeat_at + at for name, at in zip(polled, spread, strict=True)}
        due = [name for name, at in self._polls.items() if now >= at]
        self._polls |= dict.fromkeys(due, now + self._poll)
        self.polls_due = min(self._polls.values(), default=NEVER)
        return due
