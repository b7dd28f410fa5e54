"""The host's record of one controller: its reported mode, its arming, and the queries to it.

Rules. Only queries go to a device that was never commanded. Arming is position control at the measured
position until the device reports that mode; only then do set-points follow. A velocity starts from the
measured position too, until a reply came to that: the device's own set-point may be anywhere. Since a stop
clears faults, a device in fault or timeout is sent none until ClearFault, not for Idle either: in fault it
gives no torque, and in timeout it damps its shaft, as its owner configured. What has tripped is not commanded
again before ClearFault, whatever stopped it. What limits the output of an armed device is reported with its
state. Without replies and after bus trouble the arming is forgotten; what was commanded is remembered, so
that Idle still goes out.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tau

from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos
from protocols.messages import Mode as StateMode
from protocols.moteus.codec import command_id, reply_id
from protocols.moteus.faults import LIMITS, NOT_ARMED, TIMEOUT, fault_info_of
from protocols.moteus.messages import IDENTIFY, STOP, position_command, torque_command
from protocols.moteus.options import Options, limits_of
from protocols.moteus.registers import LATCHED, RISING, Mode, Register, mode_name
from protocols.moteus.reply import FAST, FULL, Reply

NEVER: Nanos = 1 << 62
RELEASE_PERIOD = 20 * MILLISECOND
"""Period of stops until `CONFIRMED` replies have confirmed them."""
CONFIRMED = 2
OFFLINE_PERIOD = 50 * MILLISECOND
"""Period of queries to a device that is offline."""
ANCHORED = 3
"""Replies after which the start of a velocity must have arrived: earlier ones may have been on their way."""
IDENTIFY_PERIOD = 5 * SECOND
"""Period of queries for the UUID, to notice a duplicate id, ..."""
IDENTIFY_RETRY = 100 * MILLISECOND
"""... and until it is known for the first time."""
LIMITED = SECOND
"""How long what limited the output is reported after it did."""
ARMING = SECOND
"""Time after which a device that replies but is not in position control is a fault."""


class ControllerState:
    """The host's record of one controller. Plain data."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name = name
        self.address = address
        self.options = options
        self.limits = limits_of(options)
        self.command_id = command_id(address, options.host_id, options.can_prefix)
        self.reply_id = reply_id(address, options.host_id, options.can_prefix)
        self.started: Nanos | None = None
        self.received_at: Nanos | None = None
        self.offline = False
        self.mode: int | None = None
        self.fault = 0
        self.limited: dict[int, Nanos] = {}
        """When each of `LIMITS` last limited its output."""
        self.position: float | None = None
        """rev"""
        self.firmware: int | None = None
        self.model: int | None = None
        self.uuids: dict[bytes, Nanos] = {}
        """UUIDs of the devices that replied at this id, and when."""
        self.owned = False
        """We have commanded it since it was last released."""
        self.tripped = False
        """It reported fault or timeout, or did not arm, and was not cleared since."""
        self.arming_since: Nanos | None = None
        self.steered: type[Command] | None = None
        """Kind of the last set-point, while it counts as received."""
        self.anchor: int | None = None
        """Replies since a velocity is sent with the measured position."""
        self.hold: float | None = None
        """rev"""
        self.releasing = False
        self.release_next: Nanos = 0
        self.release_seen = 0
        self.reported_state: tuple[StateMode, str] | None = None
        self.reported_fault: int | None = None
        self.queried_at: Nanos = -NEVER
        self.details_at: Nanos = 0
        self.identify_at: Nanos = 0

    def forget(self) -> None:
        """Require a fresh arming: the device may have restarted or been changed."""
        self.mode, self.position, self.hold, self.reported_state = None, None, None, None
        self.reported_fault, self.steered, self.arming_since, self.anchor = None, None, None, None
        self.release_seen, self.release_next, self.identify_at = 0, 0, 0
        self.uuids.clear()
        self.limited.clear()

    def resend(self) -> None:
        """Send anew what may have been lost on our side."""
        self.release_next, self.release_seen, self.steered, self.anchor = 0, 0, None, None

    # -- receiving ----------------------------------------------------------------------------

    def handle(self, t: Nanos, reply: Reply) -> list[Event]:
        """Record a reply of the device. Returns its events."""
        self.received_at, self.offline = t, False
        values = reply.values
        events = self._feedback(t, values)
        firmware, model = values.get(Register.FIRMWARE_VERSION), values.get(Register.MODEL_NUMBER)
        self.firmware = self.firmware if firmware is None else int(firmware)
        self.model = self.model if model is None else int(model)
        mode = values.get(Register.MODE)
        if mode is None:
            return events
        self.fault = int(values.get(Register.FAULT) or 0)
        self.mode = int(mode)
        self._count_anchored()
        self._confirm_release()
        events += self._trip(t, known=Register.FAULT in values)
        self._note_limit(t)
        return events + self._state(t)

    def _count_anchored(self) -> None:
        if self.anchor is None or self.mode != Mode.POSITION:
            return
        self.anchor += 1
        if self.anchor >= ANCHORED:
            self.steered, self.anchor = msg.Velocity, None

    def _note_limit(self, t: Nanos) -> None:
        """Keep a limit until it was not active for `LIMITED`: it may come and go with every reply."""
        self.limited = {code: at for code, at in self.limited.items() if t - at < LIMITED}
        if self._state_mode() is not StateMode.ARMED:
            self.limited.clear()
        elif self.fault in LIMITS:
            self.limited[self.fault] = t

    def _feedback(self, t: Nanos, values: Mapping[int, float | None]) -> list[Event]:
        get = values.get
        position, velocity, torque = get(Register.POSITION), get(Register.VELOCITY), get(Register.TORQUE)
        if position is not None:
            self.position = position
        hot = [x for x in (get(Register.TEMPERATURE), get(Register.MOTOR_TEMPERATURE)) if x is not None]
        current, voltage = get(Register.Q_CURRENT), get(Register.VOLTAGE)
        if all(x is None for x in (position, velocity, torque, voltage, *hot)):
            return []
        position = None if position is None else position * tau
        velocity = None if velocity is None else velocity * tau
        hottest = max(hot, default=None)
        return [msg.Feedback(self.name, t, position, velocity, torque, current, voltage, hottest)]

    def title(self) -> str:
        """Return hardware and firmware as far as known, as text."""
        if self.firmware is None:
            return "firmware not known yet"
        version = ".".join(str(self.firmware >> shift & 0xFF) for shift in (16, 8, 0))
        return f"model {self.model or 0:06X}, firmware {version}"

    def _confirm_release(self) -> None:
        self.release_seen = self.release_seen + 1 if self.releasing and self.mode == Mode.STOPPED else 0
        if self.release_seen >= CONFIRMED or (self.releasing and self.mode in LATCHED):
            self.owned = self.releasing = False
            self.release_seen = 0

    def _trip(self, t: Nanos, known: bool) -> list[Event]:
        """Report a fault once for each time that it trips. `known`: the reply holds the fault register."""
        if self.mode not in LATCHED:
            self.reported_fault = None
            return []
        code = TIMEOUT if self.mode == Mode.TIMEOUT else self.fault
        self.tripped, self.arming_since, self.hold, self.steered = True, None, None, None
        if code == self.reported_fault or (self.mode == Mode.FAULT and not known):
            return []
        self.reported_fault = code
        info = fault_info_of(code)
        return [msg.Fault(self.name, t, code, info.name, info.cause, info.remedy)]

    def _state(self, t: Nanos) -> list[Event]:
        """Report the state where it has changed."""
        state = (self._state_mode(), self._detail())
        if state == self.reported_state:
            return []
        self.reported_state = state
        return [msg.State(self.name, t, *state)]

    def _state_mode(self) -> StateMode:
        """Return the mode as a message has it. A device that enables or calibrates its current sensors, as it
        does on every arming, is ready."""
        if self.tripped:
            return StateMode.FAULT
        if self.mode is None:
            return StateMode.INITIALISING
        return StateMode.READY if self.mode == Mode.STOPPED or self.mode in RISING else StateMode.ARMED

    def _detail(self) -> str:
        detail = "" if self.mode is None else mode_name(self.mode)
        if self.limited:
            detail += f", limited by {' and '.join(LIMITS[code] for code in sorted(self.limited))}"
        return f"{detail}, not cleared yet" if self.tripped and self.mode not in LATCHED else detail

    # -- sending ------------------------------------------------------------------------------

    def command(self, now: Nanos, command: Command) -> tuple[list[Event], list[bytes]]:
        """Return what a command sends now; nothing while the device cannot take it."""
        if isinstance(command, msg.Idle):
            return [], self._release(now)
        self.releasing = False
        if self.offline or self.mode is None or self.position is None or self.tripped:
            return [], []
        if not isinstance(command, msg.Hold):
            self.hold = None
        elif self.hold is None:
            self.hold = self.position
        self.owned = True
        if self.mode != Mode.POSITION:
            return self._arm(now, command)
        self.arming_since = None
        return [], [self._steer(command) + self.query(now)]

    def _arm(self, now: Nanos, command: Command) -> tuple[list[Event], list[bytes]]:
        """Command position control at the measured position (for a torque: no torque)."""
        position = self.position or 0.0
        if self.arming_since is None:
            self.arming_since = now
        if now - self.arming_since > ARMING:
            return self._give_up(now), []
        if isinstance(command, msg.Torque):
            still = torque_command(position, 0.0, self.limits)
        else:
            still = position_command(position, 0.0, 0.0, self.limits)
        # The set-point of arming is where the shaft is: a velocity may go on from there.
        self.steered, self.anchor = type(command), None
        return [], [still + self.query(now)]

    def _give_up(self, now: Nanos) -> list[Event]:
        self.tripped, self.arming_since = True, None
        cause = f"it stayed in mode {mode_name(self.mode or 0)} for {ARMING // MILLISECOND} ms"
        remedy = "look at it with the vendor's tool (tview), then clear"
        return [msg.Fault(self.name, now, NOT_ARMED, "did not arm", cause, remedy), *self._state(now)]

    def _steer(self, command: Command) -> bytes:
        """Encode the set-point of a command to an armed device."""
        measured = self.position or 0.0
        if not isinstance(command, msg.Velocity):
            self.steered, self.anchor = type(command), None
        match command:
            case msg.Position(_, position, velocity, torque):
                return position_command(position / tau, velocity / tau, torque, self.limits)
            case msg.Velocity(_, velocity, torque):
                if self.steered is msg.Velocity:
                    return position_command(None, velocity / tau, torque, self.limits)
                self.anchor = self.anchor or 0
                return position_command(measured, velocity / tau, torque, self.limits)
            case msg.Torque(_, torque):
                return torque_command(measured, torque, self.limits)
        return position_command(measured if self.hold is None else self.hold, 0.0, 0.0, self.limits)

    def query(self, now: Nanos) -> bytes:
        """Return the query of a frame that goes out now."""
        self.queried_at = now
        if now < self.details_at:
            return FAST
        self.details_at = now + self.options.details_ms * MILLISECOND
        return FULL

    def _release(self, now: Nanos) -> list[bytes]:
        """Send stops to an owned device until they are confirmed; none to one in fault or timeout."""
        self.hold, self.steered, self.anchor, self.arming_since = None, None, None, None
        if not self.owned:
            return []
        if self.mode in LATCHED:
            self.owned = self.releasing = False
            return []
        if not self.releasing:
            self.releasing, self.release_seen, self.release_next = True, 0, now
        if now < self.release_next:
            return []
        self.release_next = now + RELEASE_PERIOD
        return [STOP + self.query(now)]

    # -- clearing -----------------------------------------------------------------------------

    def clear_command(self, now: Nanos) -> bytes:
        """Return what ClearFault sends: a stop where a fault or timeout is latched, else a query alone."""
        return (STOP if self.mode in LATCHED else b"") + self.query(now)

    def cleared(self, t: Nanos) -> list[Event]:
        """Record that nothing is latched any more."""
        self.tripped, self.reported_fault, self.arming_since = False, None, None
        return self._state(t)

    def report_again(self) -> None:
        """Report a fault that stays once more, with cause and remedy."""
        self.reported_fault, self.reported_state = None, None

    # -- timers -------------------------------------------------------------------------------

    def poll(self, now: Nanos) -> tuple[list[Event], list[bytes]]:
        """Return what is due: offline reported, and queries."""
        if self.started is None:
            self.started = now
        events: list[Event] = []
        if not self.offline and now >= self._offline_at():
            self.offline = True
            self.forget()
            events.append(msg.State(self.name, now, StateMode.OFFLINE, "no reply"))
        queries = [self.query(now)] if now >= self._query_at() else []
        if not self.offline and self.mode is not None and now >= self.identify_at:
            self.identify_at = now + (IDENTIFY_RETRY if self.firmware is None else IDENTIFY_PERIOD)
            queries.append(IDENTIFY)
        return events, queries

    def due(self) -> Nanos:
        """Return when `poll` next has something to do that cannot wait for a step."""
        if self.started is None:
            return 0
        return self._query_at() if self.offline else min(self._query_at(), self._offline_at())

    def _query_at(self) -> Nanos:
        return self.queried_at + (OFFLINE_PERIOD if self.offline else self.options.feedback_ms * MILLISECOND)

    def _offline_at(self) -> Nanos:
        since = self.received_at if self.received_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND
