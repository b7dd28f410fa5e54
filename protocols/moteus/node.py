"""What the driver knows and wants of one device: its mode heard, its arming, its questions.

Rules. Only questions go to a device that was never commanded. Arming is position control at the measured
place until the device tells that mode; only then do set-points follow. A velocity starts from the measured
place too, until that was answered: the device's own set-point may stand anywhere. Since a stop clears
faults, a device in fault or timeout is told none until ClearFault, also not for Idle: in fault it gives no
torque, and in timeout it damps its shaft, as its owner configured. What has tripped is not commanded again
before ClearFault, whoever stopped it. What limits the output of an armed device is told with its state.
Whether it is armed is forgotten in silence and bus trouble; what was commanded is remembered, so that Idle
still goes out.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import tau

from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos
from protocols.messages import Mode as StateMode
from protocols.moteus.codec import command_id, reply_id
from protocols.moteus.faults import LIMITS, NOT_ARMED, TIMEOUT, fault_info_of
from protocols.moteus.messages import IDENTIFY, STOP, move, push
from protocols.moteus.options import Options, limits_of
from protocols.moteus.registers import LATCHED, RISING, Mode, Register, mode_name
from protocols.moteus.reply import FAST, FULL, Reply

NEVER: Nanos = 1 << 62
RELEASE_AGAIN = 20 * MILLISECOND
"""A stop is repeated so often until two answers have confirmed it."""
CONFIRMED = 2
ABSENT_AGAIN = 50 * MILLISECOND
"""A device that is offline is asked so often."""
ANCHORED = 3
"""Answers after which a measured place must have arrived: the first ones may have been on their way."""
IDENTIFY_EVERY = 5 * SECOND
"""Who holds an id is asked so often, to notice one that is held twice."""
IDENTIFY_AGAIN = 100 * MILLISECOND
"""... and so often until it is known."""
LIMITED = SECOND
"""What limits the output is told for so long after it did."""
ARMING = SECOND
"""A device that answers but is not in position control after so long is a fault."""


class Node:
    """One device as the driver sees it. Plain data."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name = name
        self.address = address
        self.options = options
        self.limits = limits_of(options)
        self.asks_at = command_id(address, options.host_id, options.can_prefix)
        self.tells_at = reply_id(address, options.host_id, options.can_prefix)
        self.started: Nanos | None = None
        self.received_at: Nanos | None = None
        self.offline = False
        self.mode: int | None = None
        self.fault = 0
        self.limited: dict[int, Nanos] = {}
        """What limited its output of late (`LIMITS`), and when it was last told."""
        self.position: float | None = None
        """rev"""
        self.firmware: int | None = None
        self.model: int | None = None
        self.uuids: dict[bytes, Nanos] = {}
        """Whoever answered as this device, and when."""
        self.owned = False
        """We have commanded it since it was last released."""
        self.tripped = False
        """It was heard in fault or timeout, or would not arm, and nobody has cleared it."""
        self.arming_since: Nanos | None = None
        self.steered: type[Command] | None = None
        """What kind of command it was last told."""
        self.anchor: int | None = None
        """A velocity starts from the measured place: how often that was answered since it is sent."""
        self.hold: float | None = None
        self.releasing = False
        self.release_next: Nanos = 0
        self.release_seen = 0
        self.reply: tuple[StateMode, str] | None = None
        self.reported_fault: int | None = None
        self.asked_at: Nanos = -NEVER
        self.details_at: Nanos = 0
        self.identify_at: Nanos = 0

    def forget(self) -> None:
        """The device may have restarted or been changed: only a fresh sequence arms it again."""
        self.mode, self.position, self.hold, self.reply = None, None, None, None
        self.reported_fault, self.steered, self.arming_since, self.anchor = None, None, None, None
        self.release_seen, self.release_next, self.identify_at = 0, 0, 0
        self.uuids.clear()
        self.limited.clear()

    def resend(self) -> None:
        """Frames may have been lost on our side."""
        self.release_next, self.release_seen, self.steered, self.anchor = 0, 0, None, None

    # -- hearing ------------------------------------------------------------------------------

    def handle(self, t: Nanos, reply: Reply) -> list[Event]:
        """An answer of the device; what it means in words."""
        self.received_at, self.offline = t, False
        values = reply.values
        events = self._measured(t, values)
        self._identified(values)
        mode = values.get(Register.MODE)
        if mode is None:
            return events
        self.fault = int(values.get(Register.FAULT) or 0)
        self.mode = int(mode)
        self._anchored()
        self._confirm_release()
        events += self._fault_info(t, known=Register.FAULT in values)
        self._note_limit(t)
        return events + self._state(t)

    def _anchored(self) -> None:
        if self.anchor is None or self.mode != Mode.POSITION:
            return
        self.anchor += 1
        if self.anchor >= ANCHORED:
            self.steered, self.anchor = msg.Velocity, None

    def _note_limit(self, t: Nanos) -> None:
        """A limit is told until it was not active for `LIMITED`: it may come and go with every answer."""
        self.limited = {code: at for code, at in self.limited.items() if t - at < LIMITED}
        if self._mode_now() is not StateMode.ARMED:
            self.limited.clear()
        elif self.fault in LIMITS:
            self.limited[self.fault] = t

    def _measured(self, t: Nanos, values: Mapping[int, float | None]) -> list[Event]:
        get = values.get
        position, velocity, torque = get(Register.POSITION), get(Register.VELOCITY), get(Register.TORQUE)
        if position is not None:
            self.position = position
        hot = [x for x in (get(Register.TEMPERATURE), get(Register.MOTOR_TEMPERATURE)) if x is not None]
        current, voltage = get(Register.Q_CURRENT), get(Register.VOLTAGE)
        feedback = msg.Feedback(
            self.name,
            t,
            None if position is None else position * tau,
            None if velocity is None else velocity * tau,
            torque,
            current,
            voltage,
            max(hot) if hot else None,
        )
        return [feedback] if any(x is not None for x in (position, velocity, torque, voltage, *hot)) else []

    def _identified(self, values: Mapping[int, float | None]) -> None:
        firmware, model = values.get(Register.FIRMWARE_VERSION), values.get(Register.MODEL_NUMBER)
        self.firmware = self.firmware if firmware is None else int(firmware)
        self.model = self.model if model is None else int(model)

    def title(self) -> str:
        """Hardware and firmware as far as known, for a sentence."""
        if self.firmware is None:
            return "firmware not known yet"
        version = ".".join(str(self.firmware >> shift & 0xFF) for shift in (16, 8, 0))
        return f"model {self.model or 0:06X}, firmware {version}"

    def _confirm_release(self) -> None:
        self.release_seen = self.release_seen + 1 if self.releasing and self.mode == Mode.STOPPED else 0
        if self.release_seen >= CONFIRMED or (self.releasing and self.mode in LATCHED):
            self.owned = self.releasing = False
            self.release_seen = 0

    def _fault_info(self, t: Nanos, known: bool) -> list[Event]:
        """Told once for each time that it trips."""
        if self.mode not in LATCHED:
            self.reported_fault = None
            return []
        code = TIMEOUT if self.mode == Mode.TIMEOUT else self.fault
        self.tripped, self.arming_since, self.hold, self.steered = True, None, None, None
        if code == self.reported_fault or (self.mode == Mode.FAULT and not known):
            return []
        self.reported_fault = code
        return [self.complains(t, code)]

    def complains(self, t: Nanos, code: int) -> msg.Fault:
        """A fault of the table, in words."""
        text = fault_info_of(code)
        return msg.Fault(self.name, t, code, text.name, text.cause, text.remedy)

    def _state(self, t: Nanos) -> list[Event]:
        reply = (self._mode_now(), self._detail())
        if reply == self.reply:
            return []
        self.reply = reply
        return [msg.State(self.name, t, *reply)]

    def _mode_now(self) -> StateMode:
        """Enabling and calibrating (its current sensors) are part of every arming: it is ready for that."""
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

    # -- saying -------------------------------------------------------------------------------

    def say(self, now: Nanos, command: Command) -> tuple[list[Event], list[bytes]]:
        """What a command takes now; nothing while the device cannot take it."""
        if isinstance(command, msg.Idle):
            return [], self._release(now)
        self.releasing = False
        if self.unfit():
            return [], []
        if not isinstance(command, msg.Hold):
            self.hold = None
        elif self.hold is None:
            self.hold = self.position
        self.owned = True
        if self.mode != Mode.POSITION:
            return self._arm(now, command)
        self.arming_since = None
        return [], [self._steer(command) + self.question(now)]

    def unfit(self) -> str:
        """Why the device cannot be commanded now; "" if it can."""
        if self.offline or self.mode is None:
            return "it is not heard"
        if self.position is None:
            return "its position is not known yet"
        return "it is in fault, or was and is not cleared" if self.tripped else ""

    def _arm(self, now: Nanos, command: Command) -> tuple[list[Event], list[bytes]]:
        """Position control where the shaft is (for a torque: none), until the device tells that mode."""
        place = self.position or 0.0
        if self.arming_since is None:
            self.arming_since = now
        if now - self.arming_since > ARMING:
            return self._give_up(now), []
        still = push(place, 0.0, self.limits) if isinstance(command, msg.Torque) else self._still(place)
        # What it is told now is where it is: a velocity may go on from there.
        self.steered, self.anchor = type(command), None
        return [], [still + self.question(now)]

    def _still(self, place: float) -> bytes:
        return move(place, 0.0, 0.0, self.limits)

    def _give_up(self, now: Nanos) -> list[Event]:
        self.tripped, self.arming_since = True, None
        said = f"it stayed in mode {mode_name(self.mode or 0)} for {ARMING // MILLISECOND} ms"
        remedy = "look at it with the vendor's tool (tview), then clear"
        return [msg.Fault(self.name, now, NOT_ARMED, "did not arm", said, remedy), *self._state(now)]

    def _steer(self, command: Command) -> bytes:
        place = self.position or 0.0
        if not isinstance(command, msg.Velocity):
            self.steered, self.anchor = type(command), None
        match command:
            case msg.Position(_, position, velocity, torque):
                return move(position / tau, velocity / tau, torque, self.limits)
            case msg.Velocity(_, velocity, torque):
                if self.steered is msg.Velocity:
                    return move(None, velocity / tau, torque, self.limits)
                self.anchor = self.anchor or 0
                return move(place, velocity / tau, torque, self.limits)
            case msg.Torque(_, torque):
                return push(place, torque, self.limits)
        return self._still(place if self.hold is None else self.hold)

    def question(self, now: Nanos) -> bytes:
        """What is asked for in a frame that goes out now."""
        self.asked_at = now
        if now < self.details_at:
            return FAST
        self.details_at = now + self.options.details_ms * MILLISECOND
        return FULL

    def _release(self, now: Nanos) -> list[bytes]:
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
        self.release_next = now + RELEASE_AGAIN
        return [STOP + self.question(now)]

    # -- clearing -----------------------------------------------------------------------------

    def clearing(self, now: Nanos) -> bytes:
        """An operator clears: a stop to what is latched, a question to what is not."""
        return (STOP if self.mode in LATCHED else b"") + self.question(now)

    def cleared(self, t: Nanos) -> list[Event]:
        """It is latched no more."""
        self.tripped, self.reported_fault, self.arming_since = False, None, None
        return self._state(t)

    def report_again(self) -> None:
        """A fault that stays is told again, with all its words."""
        self.reported_fault, self.reply = None, None

    # -- by itself ----------------------------------------------------------------------------

    def tend(self, now: Nanos) -> tuple[list[Event], list[bytes]]:
        """What falls due: silence told, and questions."""
        if self.started is None:
            self.started = now
        events: list[Event] = []
        if not self.offline and now >= self._offline_at():
            self.offline = True
            self.forget()
            events.append(msg.State(self.name, now, StateMode.OFFLINE, "nothing heard"))
        asks = [self.question(now)] if now >= self._ask_at() else []
        if not self.offline and self.mode is not None and now >= self.identify_at:
            self.identify_at = now + (IDENTIFY_AGAIN if self.firmware is None else IDENTIFY_EVERY)
            asks.append(IDENTIFY)
        return events, asks

    def due(self) -> Nanos:
        """When `tend` next has something to do that cannot wait for a step."""
        if self.started is None:
            return 0
        return self._ask_at() if self.offline else min(self._ask_at(), self._offline_at())

    def _ask_at(self) -> Nanos:
        period = ABSENT_AGAIN if self.offline else self.options.feedback_ms * MILLISECOND
        return self.asked_at + period

    def _offline_at(self) -> Nanos:
        since = self.received_at if self.received_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND
