"""What is known of one device, and how what it says changes that.

Rules. Plain data, no frames of ours: `motion` decides what is said. Integers are the drive's, floats SI. What
a device tells is believed only of itself; its restart, its silence and a change of its state are told as they
are heard. A fault is told once, with the device's code, until it has gone.
"""

from __future__ import annotations

from protocols.cia402 import mapping, startup
from protocols.cia402 import objects as o
from protocols.cia402.client import Client, Job
from protocols.cia402.codec import Emcy, Heartbeat, NmtState
from protocols.cia402.fault_reports import FINDINGS, WRONG_DEVICE
from protocols.cia402.faults import complaint
from protocols.cia402.feedback import NEVER, Polls, feedback
from protocols.cia402.mapping import Pdo
from protocols.cia402.objects import Key
from protocols.cia402.options import Options
from protocols.cia402.pdo import Packing, packing
from protocols.cia402.profile import Demand, PowerState, state_of
from protocols.cia402.profile import Mode as Operation
from protocols.cia402.setpoint import Values
from protocols.cia402.setpoint_writer import SetpointWriter
from protocols.cia402.startup import Known
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Event, Fault, Mode, Nanos, State

GENERIC_ERROR = 0x1000
FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
ENERGISED = (
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP,
    PowerState.SWITCHED_ON,
    PowerState.FAULT_REACTION,
)
"""States that Idle must bring to an end."""
CONFIRMED = 2
"""So many statuswords must say that a device is disarmed."""


class Node:
    """One device, as far as heard, and where we stand with it."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name, self.address, self.options = name, address, options
        self.client = Client(options.sdo_timeout_ms * MILLISECOND)
        self.outlet = SetpointWriter()
        self.polls = Polls(options.feedback_ms * MILLISECOND)
        # what was read
        self.read: dict[Key, int] = {}
        self.absent: set[Key] = set()
        self.title: str | None = None
        """Object 1008; None: not read yet."""
        self.units: Units | None = None
        self.known: Known | None = None
        self.wrong = ""
        """Why it cannot be commanded at all."""
        self.listening: dict[int, tuple[tuple[Key, ...], Packing, Nanos | None]] = {}
        """Its TPDOs by identifier: what they hold, and how often they come."""
        # what was heard
        self.started: Nanos | None = None
        self.received_at: Nanos | None = None
        self.offline = False
        self.nmt: NmtState | None = None
        self.beats: list[NmtState] = []
        self.status: int | None = None
        self.power: PowerState | None = None
        self.statuses = 0
        """Statuswords heard."""
        self.operation: int | None = None
        """Mode of operation, as it displays it."""
        self.position: int | None = None
        self.position_at: Nanos = 0
        self.error_code = 0
        self.wants_error = False
        """It is in fault, and has not told why."""
        self.emergency = False
        """It told of a fault by EMCY, and no statusword came since."""
        self.reported: tuple[Mode, str] | None = None
        self.reported_faults: set[int] = set()
        self.roll_call: Nanos = 0
        self.doubled = False
        """That its node id is held twice has been told."""
        # where we stand
        self.owned = False
        self.commanded_at: Nanos = -NEVER
        self.setup: list[Job] | None = None
        """What it must still be told before it can be armed; None: not planned yet."""
        self.writing: tuple[Pdo, ...] = ()
        """The PDOs that the setup writes."""
        self.configured = False
        """All of it is written: set-points may go out, and SYNC."""
        self.watched = False
        """It expects our heartbeat."""
        self.armed = False
        self.refused = False
        """It would not arm: told as a fault, not tried again before ClearFault or Idle."""
        self.estopped = False
        self.values: Values = {}
        """What was last wanted of it."""
        self.target: Key = o.TARGET_POSITION
        self.hold: int | None = None
        self.rounds = 0
        """Set-points sent since arming began."""
        self.trying_since: Nanos | None = None
        self.trying: object = None
        """What was last seen of its way to being armed."""
        self.setpoint: int | None = None
        """PP: the target that was last given."""
        self.handing = False
        """PP: the new set-point bit is set."""
        self.handed_at: Nanos = 0
        self.lowered_until: Nanos = -NEVER
        """PP: till then the new set-point bit is low, so that it can rise."""
        self.start_next: Nanos = 0
        self.starts = 0
        self.insist: Demand | None = None
        """What it is told again and again until it obeys: SHUTDOWN to disarm, QUICK_STOP."""
        self.insist_since: Nanos = 0
        self.insist_next: Nanos = 0
        self.urgent: list[Job] = []
        self.questions: list[Job] = []
        """What a person asked for, in order."""
        self.took_turn = False
        """The last transfer was a set-point: feedback has its turn."""
        self.clearing = False
        """Its faults are being cleared."""
        self.holding = False
        """The last command was Hold."""
        self.homing_method: int | None = None
        """The one that it had before Zero."""
        self.booted_at: Nanos | None = None
        self.disarmed = 0
        """Statuswords that said so since it was told to disarm."""
        self.homing: Homing | None = None

    # -- forgetting -----------------------------------------------------------------------------

    def forget(self) -> None:
        """It may have restarted, or be another one: read it anew, and only a fresh sequence arms it."""
        self.client.drop()
        self.read.clear()
        self.absent.clear()
        self.title = self.known = self.units = self.reported = None
        self.listening.clear()
        self.polls.forget()
        self.beats.clear()
        self.nmt = self.status = self.power = self.operation = self.position = None
        self.wants_error, self.emergency, self.error_code, self.wrong = False, False, 0, ""
        self.reported_faults.clear()
        self.outlet = SetpointWriter()
        self.unarm()
        self.setup, self.writing, self.watched, self.configured = None, (), False, False
        self.values = {}
        self.urgent.clear()
        self.questions.clear()
        self.starts, self.start_next = 0, 0

    def unarm(self) -> None:
        """Whatever it does now, it does not follow our set-points: the next one begins anew."""
        self.armed, self.hold, self.rounds, self.trying_since = False, None, 0, None
        self.setpoint, self.handing, self.homing = None, False, None

    # -- hearing --------------------------------------------------------------------------------

    def received(self, t: Nanos) -> None:
        """Something of it came."""
        self.received_at, self.offline = t, False

    def on_beat(self, t: Nanos, beat: Heartbeat) -> list[Event]:
        """Its heartbeat, or its boot-up message."""
        if beat.state is NmtState.INITIALISING:
            restarted = self.received_at is not None or self.owned
            self.forget()
            self.received(t)
            self.booted_at = t
            self.nmt = NmtState.PRE_OPERATIONAL
            return self.report(t, "restarted") if restarted else self.report(t)
        self.received(t)
        self.beats = [*self.beats[-3:], beat.state]
        self.nmt = beat.state
        return self.report(t)

    def on_emcy(self, t: Nanos, emcy: Emcy) -> list[Event]:
        """An emergency, or that one is over."""
        self.received(t)
        if not emcy.code:
            if self.power not in FAULTY:
                self.reported_faults.clear()
            return []
        self.error_code, self.wants_error, self.emergency = emcy.code, False, True
        return self.complain(t, emcy.code)

    def on_tpdo(self, t: Nanos, id_: int, data: bytes) -> list[Event] | None:
        """A TPDO; None if it is too short. One whose mapping is not known shows that it lives."""
        known = self.listening.get(id_)
        if known is None:
            self.received(t)
            return []
        keys, packed, _ = known
        values = packed.unpack(data) if len(data) == packed.size else None
        if values is None:
            return None
        self.received(t)
        self.nmt = NmtState.OPERATIONAL
        self.polls.came(t, keys)
        return self.take(t, dict(zip(keys, values, strict=True)))

    def take(self, t: Nanos, values: Values) -> list[Event]:
        """Objects that tell its state or motion, however they came."""
        events: list[Event] = []
        if o.MODE_DISPLAY in values:
            self.operation = values[o.MODE_DISPLAY]
        if o.ERROR_CODE in values:
            events += self._on_error(t, values[o.ERROR_CODE])
        if o.STATUSWORD in values:
            events += self._on_status(t, values[o.STATUSWORD])
        if o.POSITION in values:
            self.position, self.position_at = values[o.POSITION], t
        measured = feedback(self.name, t, values, self.units) if self.units is not None else None
        return [*events, measured] if measured is not None else events

    def _on_error(self, t: Nanos, code: int) -> list[Event]:
        self.error_code = code
        if not self.wants_error or not code:
            return []
        self.wants_error = False
        return self.complain(t, code)

    def _on_status(self, t: Nanos, status: int) -> list[Event]:
        before, self.status = self.power, status
        self.power, self.emergency = state_of(status), False
        power = self.power
        self.statuses += 1
        events: list[Event] = []
        if self.armed and power is not PowerState.OPERATION_ENABLED:
            self.unarm()
        elif power is PowerState.OPERATION_ENABLED and self.owned and self.insist is None:
            self.armed = True
        if power in FAULTY and before not in FAULTY:
            self.wants_error = not self.reported_faults
        elif power not in FAULTY and before in FAULTY:
            self.wants_error = False
            self.reported_faults.clear()
        self._count_disarmed(power)
        return events + self.report(t)

    def _count_disarmed(self, power: PowerState | None) -> None:
        obeyed = power is not None and power not in ENERGISED
        self.disarmed = self.disarmed + 1 if obeyed else 0
        if self.insist is Demand.QUICK_STOP and power is PowerState.QUICK_STOP:
            self.insist = None

    # -- telling --------------------------------------------------------------------------------

    def complain(self, t: Nanos, code: int, cause: str = "") -> list[Event]:
        """A fault, told once until it has gone; `cause` where more is known than the table says."""
        if code in self.reported_faults:
            return self.report(t)
        self.reported_faults.add(code)
        words = FINDINGS.get(code) or complaint(code)
        return [Fault(self.name, t, code, words.name, cause or words.cause, words.remedy), *self.report(t)]

    def report(self, t: Nanos, detail: str = "") -> list[Event]:
        """Its state, if it has changed."""
        reported = (self.mode(), detail or self._detail())
        if reported == self.reported:
            return []
        self.reported = reported
        return [State(self.name, t, *reported)]

    def _detail(self) -> str:
        if self.wrong:
            return self.wrong
        if self.power is None:
            return "asking it what it is"
        said = self.power.value
        if self.power is PowerState.OPERATION_ENABLED and self.operation is not None:
            said += f", {startup.mode_name(self.operation)}"
        return said if self.known is not None else f"{said}, asking it what it is"

    def mode(self) -> Mode:
        """Its state in our words."""
        if self.wrong:
            return Mode.FAULT
        if self.known is None or self.power in (None, PowerState.NOT_READY):
            return Mode.INITIALISING
        if self.power in FAULTY or self.estopped:
            return Mode.FAULT
        return Mode.ARMED if self.power is PowerState.OPERATION_ENABLED else Mode.READY

    # -- reading it -----------------------------------------------------------------------------

    def next_key(self) -> Key | None:
        """What is next to be read before it is known."""
        if self.known is not None or self.wrong:
            return None
        return startup.next_key(self.read, self.absent, self.title is not None)

    def on_read(self, t: Nanos, key: Key, value: bytes, abort: int | None) -> list[Event]:
        """An object that was read; with `abort` it is absent."""
        number = startup.value_of(key, value) if abort is None else None
        if key == o.DEVICE_NAME:
            self.title = "" if abort is not None else value.decode("ascii", "replace").strip("\0 ")
        elif number is None:
            self.absent.add(key)
        else:
            self.read[key] = number
        events: list[Event] = []
        if number is not None and key in (o.STATUSWORD, o.MODE_DISPLAY, o.ERROR_CODE):
            events += self.take(t, {key: number})
        if self.units is None and startup.units_known(self.read, self.absent):
            self.units = startup.units_from(self.read, self.options)
            self.wrong = startup.wrong_with(self.read, self.absent, self.options)
            if self.wrong:
                return [*events, *self.complain(t, WRONG_DEVICE, self.wrong)]
        if self.units is not None and self.known is None and self.next_key() is None:
            self.known = startup.known_of(self.read, self.options)
            self.listen(self.known.pdos if self.known else ())
            events += self.report(t)
        return events

    def listen(self, pdos: tuple[Pdo, ...]) -> None:
        """Understand these TPDOs from now on."""
        sync = self.options.sync_ms * MILLISECOND if self.options.feedback == "sync" else 0
        self.listening = {
            pdo.id: (pdo.keys, packing(pdo.entries), pdo.period(sync))
            for pdo in pdos
            if pdo.way == "from" and pdo.enabled and pdo.entries
        }
        self.polls.expect((keys, period) for keys, _, period in self.listening.values())

    def usable(self, way: mapping.Way) -> list[Pdo]:
        """Its PDOs that can be worked with as they are."""
        synced = self.options.feedback == "sync"
        pdos = self.known.pdos if self.known is not None else ()
        return [p for p in pdos if p.way == way and mapping.usable(p, self.address, synced)]

    # -- what it may be told --------------------------------------------------------------------

    def unfit(self) -> str:
        """Why it cannot be commanded now; "" if it can."""
        if self.wrong:
            return self.wrong
        if self.offline or self.known is None:
            return "it is not known yet"
        if self.position is None or self.power is None:
            return "its position or state is not known yet"
        if self.power in FAULTY:
            return "it is in fault"
        if self.estopped:
            return "it was stopped by its emergency stop"
        return "it would not arm" if self.refused else ""

    def has_mode(self, operation: Operation) -> bool:
        """Whether it displays this mode of operation."""
        return self.operation == operation

    @property
    def offline_at(self) -> Nanos:
        """When its silence has lasted too long."""
        since = self.received_at if self.received_at is not None else self.started or 0
        return since + self.options.offline_ms * MILLISECOND


class Homing:
    """A homing procedure under way: the request's token, and how far it is."""

    __slots__ = ("seen", "since", "started", "token", "zero")

    def __init__(self, token: int, since: Nanos, *, zero: bool) -> None:
        self.token, self.since, self.zero = token, since, zero
        self.started: Nanos | None = None
        self.seen = 0
        """Statuswords heard when it was started."""
