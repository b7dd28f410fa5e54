"""The host's record of one drive, and how the frames that it sends change that.

Rules. Plain data; `motion` decides what is sent. Integers are in the drive's units, floats SI. A drive's
restart, its loss and a change of its state are reported as they are detected. A fault is reported once, with
the device's code, until it is gone.
"""

from __future__ import annotations

from protocols import messages as msg
from protocols.cia402.old_client import Job, Purpose, SdoClient
from protocols.canopen.pdo import Packing, packing
from protocols.canopen.services import Emcy, Heartbeat, NmtState
from protocols.cia402 import mapping, startup
from protocols.cia402 import objects as o
from protocols.cia402.faults import WRONG_DEVICE, fault_info
from protocols.cia402.feedback import NEVER, PollSchedule, feedback
from protocols.cia402.mapping import Pdo
from protocols.cia402.objects import OBJECTS, Key
from protocols.cia402.options import Options
from protocols.cia402.profile import Demand, PowerState, state_of
from protocols.cia402.setpoint import Values
from protocols.cia402.setpoint_writer import SetpointWriter
from protocols.cia402.startup import DeviceProfile
from protocols.cia402.units import Units
from protocols.messages import MILLISECOND, Event, Nanos

FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
ENERGISED = (
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP,
    PowerState.SWITCHED_ON,
    PowerState.FAULT_REACTION,
)
"""States that Idle must end."""
READING = "reading its object dictionary"


class DriveState:
    """One drive as the host knows it, and what the host is doing with it."""

    def __init__(self, name: str, address: int, options: Options) -> None:
        self.name, self.address, self.options = name, address, options
        self.client = SdoClient(options.sdo_timeout_ms * MILLISECOND)
        self.writer = SetpointWriter()
        self.polls = PollSchedule(options.feedback_ms * MILLISECOND)
        # what was read
        self.read: dict[Key, int] = {}
        self.absent: set[Key] = set()
        self.device_name: str | None = None
        """Object 1008; None: not read yet."""
        self.units: Units | None = None
        self.profile: DeviceProfile | None = None
        self.unusable = ""
        """Why it cannot be commanded at all."""
        self.tpdos: dict[int, tuple[tuple[Key, ...], Packing]] = {}
        """Its TPDOs by identifier: their objects and packing."""
        # what was received
        self.known_since: Nanos | None = None
        """When the driver first tended it."""
        self.received_at: Nanos | None = None
        self.offline = False
        self.nmt: NmtState | None = None
        self.heartbeats: list[NmtState] = []
        """The last four."""
        self.statusword: int | None = None
        self.power: PowerState | None = None
        self.statusword_count = 0
        self.mode_display: int | None = None
        self.position: int | None = None
        self.error_code = 0
        self.error_code_wanted = False
        """It is in fault, and the error code is not known."""
        self.emcy_unconfirmed = False
        """It sent an EMCY, and no statusword since."""
        self.reported: tuple[msg.Mode, str] | None = None
        self.reported_faults: set[int] = set()
        self.identity_check_at: Nanos = 0
        self.duplicate_reported = False
        self.booted_at: Nanos | None = None
        # what is commanded
        self.owned = False
        self.commanded_at: Nanos = -NEVER
        self.setup: list[Job] | None = None
        """What remains to be written before it can be armed; None: not planned yet."""
        self.pdos_to_write: tuple[Pdo, ...] = ()
        """The PDOs that the setup writes."""
        self.configured = False
        """The setup is written: set-points may be sent, and SYNC."""
        self.monitors_host = False
        """It is a consumer of the host's heartbeat."""
        self.armed = False
        self.arming_failed = False
        """Reported as a fault, and not tried again before ClearFault or Idle."""
        self.estopped = False
        self.setpoints: Values = {}
        """What it should have: set-points, mode and controlword."""
        self.target: Key = o.TARGET_POSITION
        self.hold: int | None = None
        """The position to hold."""
        self.holding = False
        """The last command was Hold."""
        self.rounds = 0
        """Set-points sent since arming began."""
        self.arming_since: Nanos | None = None
        """Since when arming has made no progress."""
        self.arming_progress: object = None
        self.pp_target: int | None = None
        """PP: the target given last."""
        self.pp_new_setpoint = False
        """PP: the new set-point bit is set."""
        self.pp_raised_at: Nanos = 0
        self.pp_low_until: Nanos = -NEVER
        """PP: until then the new set-point bit stays low, so that it can rise."""
        self.nmt_start_next: Nanos = 0
        self.nmt_starts = 0
        self.stop_demand: Demand | None = None
        """Repeated until it is obeyed: SHUTDOWN to disarm, QUICK_STOP."""
        self.stop_since: Nanos = 0
        self.stop_next: Nanos = 0
        self.disarmed_statuswords = 0
        """In a row, since it was commanded to disarm."""
        self.urgent_jobs: list[Job] = []
        self.request_jobs: list[Job] = []
        self.poll_has_turn = False
        """The last transfer was a set-point, setup or startup: polling is next."""
        self.clearing = False
        """Its faults are being cleared."""
        self.homing_method: int | None = None
        """The one before Zero."""
        self.homing: HomingRun | None = None

    # -- forgetting -----------------------------------------------------------------------------

    def forget(self) -> None:
        """Begin anew: it may have restarted, or be another device. Only a fresh sequence arms it."""
        self.client.drop()
        self.read.clear()
        self.absent.clear()
        self.device_name = self.profile = self.units = self.reported = None
        self.tpdos.clear()
        self.polls.forget()
        self.heartbeats.clear()
        self.nmt = self.statusword = self.power = self.mode_display = self.position = None
        self.error_code_wanted, self.emcy_unconfirmed, self.error_code, self.unusable = False, False, 0, ""
        self.reported_faults.clear()
        self.writer = SetpointWriter()
        self.unarm()
        self.setup, self.pdos_to_write, self.monitors_host, self.configured = None, (), False, False
        self.setpoints = {}
        self.urgent_jobs.clear()
        self.request_jobs.clear()
        self.nmt_starts, self.nmt_start_next = 0, 0

    def unarm(self) -> None:
        """Note that it does not follow set-points: the next one begins anew."""
        self.armed, self.hold, self.rounds, self.arming_since = False, None, 0, None
        self.pp_target, self.pp_new_setpoint, self.homing = None, False, None

    # -- receiving ------------------------------------------------------------------------------

    def received(self, t: Nanos) -> None:
        """Note that a frame of it came."""
        self.received_at, self.offline = t, False

    def on_heartbeat(self, t: Nanos, beat: Heartbeat) -> list[Event]:
        """Handle its heartbeat, or its boot-up message."""
        if beat.state is NmtState.INITIALISING:
            restarted = self.received_at is not None or self.owned
            self.forget()
            self.received(t)
            self.booted_at = t
            self.nmt = NmtState.PRE_OPERATIONAL
            return self.report(t, "restarted") if restarted else self.report(t)
        self.received(t)
        self.heartbeats = [*self.heartbeats[-3:], beat.state]
        self.nmt = beat.state
        return self.report(t)

    def on_emcy(self, t: Nanos, emcy: Emcy) -> list[Event]:
        """Handle an emergency, or the end of one (code 0)."""
        self.received(t)
        if not emcy.code:
            if self.power not in FAULTY:
                self.reported_faults.clear()
            return []
        self.error_code, self.error_code_wanted, self.emcy_unconfirmed = emcy.code, False, True
        return self.report_fault(t, emcy.code)

    def on_tpdo(self, t: Nanos, id_: int, data: bytes) -> list[Event] | None:
        """Handle a TPDO; None if its length is wrong. One with an unknown mapping shows that the drive is
        alive."""
        if id_ not in self.tpdos:
            self.received(t)
            return []
        keys, packed = self.tpdos[id_]
        values = packed.unpack(data) if len(data) == packed.size else None
        if values is None:
            return None
        self.received(t)
        self.nmt = NmtState.OPERATIONAL
        self.polls.on_tpdo(t, keys)
        return self.take(t, dict(zip(keys, values, strict=True)))

    def take(self, t: Nanos, values: Values) -> list[Event]:
        """Handle objects of state and motion, from a TPDO or an upload."""
        events: list[Event] = []
        if o.MODE_DISPLAY in values:
            self.mode_display = values[o.MODE_DISPLAY]
        if o.ERROR_CODE in values:
            events += self._on_error_code(t, values[o.ERROR_CODE])
        if o.STATUSWORD in values:
            events += self._on_statusword(t, values[o.STATUSWORD])
        if o.POSITION in values:
            self.position = values[o.POSITION]
        measured = feedback(self.name, t, values, self.units) if self.units is not None else None
        return [*events, measured] if measured is not None else events

    def _on_error_code(self, t: Nanos, code: int) -> list[Event]:
        self.error_code = code
        if not self.error_code_wanted or not code:
            return []
        self.error_code_wanted = False
        return self.report_fault(t, code)

    def _on_statusword(self, t: Nanos, status: int) -> list[Event]:
        before, self.statusword = self.power, status
        self.power, self.emcy_unconfirmed = state_of(status), False
        power = self.power
        self.statusword_count += 1
        if self.armed and power is not PowerState.OPERATION_ENABLED:
            self.unarm()
        elif power is PowerState.OPERATION_ENABLED and self.owned and self.stop_demand is None:
            self.armed = True
        if power in FAULTY and before not in FAULTY:
            self.error_code_wanted = not self.reported_faults
        elif power not in FAULTY and before in FAULTY:
            self.error_code_wanted = False
            self.reported_faults.clear()
        disarmed = power is not None and power not in ENERGISED
        self.disarmed_statuswords = self.disarmed_statuswords + 1 if disarmed else 0
        if self.stop_demand is Demand.QUICK_STOP and power is PowerState.QUICK_STOP:
            self.stop_demand = None
        return self.report(t)

    # -- reporting ------------------------------------------------------------------------------

    def report_fault(self, t: Nanos, code: int, cause: str = "") -> list[Event]:
        """Report a fault, once until it is gone; `cause` if more is known than in the table."""
        if code in self.reported_faults:
            return self.report(t)
        self.reported_faults.add(code)
        info = fault_info(code)
        return [msg.Fault(self.name, t, code, info.name, cause or info.cause, info.remedy), *self.report(t)]

    def report(self, t: Nanos, detail: str = "") -> list[Event]:
        """Report its state, if it has changed."""
        state = (self.mode(), detail or self._detail())
        if state == self.reported:
            return []
        self.reported = state
        return [msg.State(self.name, t, *state)]

    def _detail(self) -> str:
        if self.unusable:
            return self.unusable
        if self.power is None:
            return READING
        detail = self.power.value
        if self.power is PowerState.OPERATION_ENABLED and self.mode_display is not None:
            detail += f", {startup.mode_name(self.mode_display)}"
        return detail if self.profile is not None else f"{detail}, {READING}"

    def mode(self) -> msg.Mode:
        """Return its state in the gateway's terms."""
        if self.unusable:
            return msg.Mode.FAULT
        if self.profile is None or self.power in (None, PowerState.NOT_READY):
            return msg.Mode.INITIALISING
        if self.power in FAULTY or self.estopped:
            return msg.Mode.FAULT
        return msg.Mode.ARMED if self.power is PowerState.OPERATION_ENABLED else msg.Mode.READY

    # -- reading its dictionary -----------------------------------------------------------------

    def next_key(self) -> Key | None:
        """Return the object to be read next before its profile is known."""
        if self.profile is not None or self.unusable:
            return None
        return startup.next_key(self.read, self.absent, self.device_name is not None)

    def on_read(self, t: Nanos, key: Key, value: bytes, abort: int | None) -> list[Event]:
        """Handle an object that was read at startup; with `abort` it is absent."""
        number = startup.value_of(key, value) if abort is None else None
        if key == o.DEVICE_NAME:
            self.device_name = "" if abort is not None else value.decode("ascii", "replace").strip("\0 ")
        elif number is None:
            self.absent.add(key)
        else:
            self.read[key] = number
        events: list[Event] = []
        if number is not None and key in (o.STATUSWORD, o.MODE_DISPLAY, o.ERROR_CODE):
            events += self.take(t, {key: number})
        if self.units is None and startup.units_read(self.read, self.absent):
            self.units = startup.units_from(self.read, self.options)
            self.unusable = startup.why_unusable(self.read, self.absent, self.options)
            if self.unusable:
                return [*events, *self.report_fault(t, WRONG_DEVICE, self.unusable)]
        if self.units is not None and self.profile is None and self.next_key() is None:
            self.profile = startup.device_profile(self.read, self.options)
            self.expect_tpdos(self.profile.pdos if self.profile else ())
            events += self.report(t)
        return events

    def expect_tpdos(self, pdos: tuple[Pdo, ...]) -> None:
        """Decode the TPDOs among these from now on."""
        sync = self.options.sync_ms * MILLISECOND if self.options.feedback == "sync" else 0
        tpdos = {pdo.id: pdo for pdo in pdos if pdo.kind == "TPDO" and pdo.enabled and pdo.entries}
        self.tpdos = {id_: (pdo.keys, packing(OBJECTS, pdo.entries)) for id_, pdo in tpdos.items()}
        self.polls.expect([(pdo.keys, pdo.period(sync)) for pdo in tpdos.values()])

    def usable(self, kind: mapping.PdoKind) -> list[Pdo]:
        """Return its PDOs that can be used as they are."""
        synced = self.options.feedback == "sync"
        pdos = self.profile.pdos if self.profile is not None else ()
        return [pdo for pdo in pdos if pdo.kind == kind and mapping.usable(pdo, self.address, synced)]

    # -- what can be sent to it -----------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Its name in the robot file, and its own if it has one."""
        return [self.name, *([self.device_name] if self.device_name else [])]

    @property
    def setup_pending(self) -> bool:
        """True while a part of the setup is not written."""
        job = self.client.job
        return bool(self.setup) or (job is not None and job.purpose is Purpose.SETUP)

    @property
    def commandable(self) -> bool:
        """True if set-points make sense now: it is known, and neither in fault nor stopped by Estop."""
        known = self.profile is not None and self.position is not None and self.power is not None
        stopped = self.power in FAULTY or self.estopped or self.arming_failed
        return known and not (self.unusable or self.offline or stopped)

    @property
    def offline_at(self) -> Nanos:
        """When it counts as offline without another frame."""
        since = self.received_at if self.received_at is not None else self.known_since or 0
        return since + self.options.offline_ms * MILLISECOND


class HomingRun:
    """A homing procedure under way: the token of its request, and its progress."""

    __slots__ = ("since", "started", "statusword_count", "token", "zero")

    def __init__(self, token: int, since: Nanos, *, zero: bool) -> None:
        self.token, self.since, self.zero = token, since, zero
        self.started = False
        """Bit 4 of the controlword was set."""
        self.statusword_count = 0
        """Statuswords received when it was started."""
