"""The host's record of one drive, beyond its phase: what it reported, and what is sent to it.

Rules. Plain data; integers are in the drive's units. Only uploads are sent before it is commanded, and no
set-point before its setup was read back. The first set-point of a sequence is the measured position. Whatever
interrupts a setup, it is forgotten, and begun anew from a fresh reading. A drive that is slow is not late:
what waits for a state waits for a number of statuswords, too.

Source: CiA 402-2 "finite state automaton"; CiA 301 "NMT", "emergency".
"""

from __future__ import annotations

from protocols.canopen import objects as co
from protocols.canopen import sdo
from protocols.canopen.client import NEVER, Job, Outcome, Purpose, SdoClient
from protocols.canopen.mapping import Setup
from protocols.canopen.objects import Key, Type, from_bytes, title, to_bytes
from protocols.canopen.pdo import DISABLED, NO_RTR
from protocols.canopen.scan import describe
from protocols.canopen.services import Nmt, NmtCommand, NmtState, encode, sdo_rx_id
from protocols.cia402 import faults, profile, setpoints
from protocols.cia402 import objects as o
from protocols.cia402.homing import Homing
from protocols.cia402.objects import OBJECTS
from protocols.cia402.options import Options
from protocols.cia402.polls import Polls
from protocols.cia402.profile import POWERED, Demand, Mode, PowerState, Status
from protocols.cia402.setpoints import FAMILIES, TARGET_OF, Arrival, Handshake, Layouts, Output, Values
from protocols.cia402.setup import Known
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Fault, Hold, Impedance, Nanos
from protocols.messages import Mode as State
from protocols.plugin import Device
from protocols.toolkit.duplicates import StateCheck
from protocols.toolkit.host import Phase

FAULTY = (PowerState.FAULT, PowerState.FAULT_REACTION)
CALM = (PowerState.NOT_READY, PowerState.SWITCH_ON_DISABLED, PowerState.READY, PowerState.FAULT)
"""States that confirm that it is disarmed."""
READING = "reading its object dictionary"
START_AGAIN = 100 * MILLISECOND
"""Period at which NMT start is repeated until the drive is operational."""
STARTS = 3
"""NMT starts to a drive that sends no NMT state, before it is assumed to be operational."""
STOP_AGAIN = 50 * MILLISECOND
RESET_AGAIN = 500 * MILLISECOND
LATE = 500 * MILLISECOND
"""Time after which a drive that has not disarmed is commanded DISABLE VOLTAGE, without a ramp."""
PREPARED = 2
"""Set-points sent before a drive is enabled."""
PATIENCE = 5
"""Statuswords that a drive may send without progress in its time."""
AGE = 100 * MILLISECOND
"""Age at which a set-point that waits to be written by SDO is dropped."""
CHECK, RECHECK = SECOND, 100 * MILLISECOND
"""Period at which the serial number is read, to notice another device, or two; after a doubled response."""


class Drive:
    """One drive."""

    def __init__(self, device: Device) -> None:
        options: Options = device.options
        self.name, self.address, self.options = device.name, device.address, options
        self.client = SdoClient(options.sdo_timeout_ms * MILLISECOND)
        self.known = Known(options, device.address)
        self.polls = Polls(options.feedback_ms * MILLISECOND)
        self.events: list[Event] = []
        """To be reported with the next frame or step."""
        self.failures: list[tuple[int, str]] = []
        """Codes and causes of faults that are to be latched."""
        self.commanded_at: Nanos = -NEVER
        self.estopped_at: Nanos | None = None
        """Since when an operator's stop is in force."""
        self.tokens = 0
        """Requests so far."""
        self.clearing = False
        """Its faults are to be cleared."""
        self.reset_next: Nanos = 0
        self.forget(0)

    def forget(self, t: Nanos) -> None:
        """Begin anew: it may have restarted, or be another device. Only a fresh sequence arms it."""
        self.client.forget(t)
        self.known.forget()
        self.polls.forget()
        self.beats = StateCheck()
        self.tpdos: Layouts = {}
        # what was received
        self.nmt: NmtState | None = None
        self.statusword: int | None = None
        self.power: PowerState | None = None
        self.mode_display: int | None = None
        self.position: int | None = None
        self.reports = 0
        """Statuswords received."""
        self.codes: set[int] = set()
        """Error codes that are active."""
        self.code_wanted = False
        """It is in fault, and the error code is not known."""
        self.emcy = False
        """It sent an EMCY, and no statusword since."""
        self.check_at: Nanos = 0
        # what is sent
        self.setup: Setup | None = None
        self.configured = False
        """The setup is done: set-points may be sent, and SYNC."""
        self.watches = False
        """It may monitor this host's heartbeat."""
        self.output = Output()
        self.arrival = Arrival()
        self.starts = 0
        self.start_next: Nanos = 0
        self.stop_next: Nanos = 0
        self.synced = self.feeds = self.hurried = False
        """It needs SYNC; it was commanded, or need not be; a change of its state is expected."""
        self._unarm()
        self._judge()

    def _unarm(self) -> None:
        """Record that it does not follow set-points: the next one begins anew."""
        self.values: Values = {}
        """What it should have: set-points, mode and controlword."""
        self.hold: int | None = None
        self.holding = False
        """The last command was Hold."""
        self.rounds = 0
        """Set-points sent since arming began."""
        self.handshake = Handshake()
        self.homing: Homing | None = None
        self._progress: object = None
        self._since: tuple[Nanos, int] | None = None
        """Since when arming has made no progress, and the statuswords received then."""
        self.arrival.restart()

    # -- received -------------------------------------------------------------------------------------

    def on_tpdo(self, t: Nanos, id_: int, data: bytes) -> Values | None:
        """Return the objects in a TPDO; None if its length is wrong."""
        if id_ not in self.tpdos:
            return {}  # with an unknown mapping: it is alive
        keys, layout = self.tpdos[id_]
        values = layout.unpack(data) if len(data) == layout.size else None
        if values is None:
            return None
        self.nmt = NmtState.OPERATIONAL
        self.polls.on_tpdo(t, keys)
        return dict(zip(keys, values, strict=True))

    def on_heartbeat(self, t: Nanos, state: NmtState) -> str:
        """Handle its heartbeat; return why there must be two devices, if so."""
        self.nmt = state
        two = self.beats.add(t, state, self.start_next - START_AGAIN)
        return "its heartbeats alternate between contradictory states" if two else ""

    def on_boot(self, t: Nanos) -> None:
        """Handle its boot-up message."""
        self.forget(t)
        self.nmt = NmtState.PRE_OPERATIONAL

    def on_emcy(self, code: int) -> None:
        """Handle an emergency, or the end of one (code 0)."""
        if code:
            self.codes.add(code)
            self.code_wanted, self.emcy = False, True
        elif self.power not in FAULTY:
            self.codes.clear()

    def take(self, values: Values) -> None:
        """Handle objects of state and motion, from a TPDO or an upload."""
        if o.MODE_DISPLAY in values:
            self.mode_display = values[o.MODE_DISPLAY]
        if o.STATUSWORD in values:
            self._on_statusword(values[o.STATUSWORD])
        if o.POSITION in values:
            self.position = values[o.POSITION]
        if self.code_wanted and values.get(o.ERROR_CODE):
            self.codes.add(values[o.ERROR_CODE])
            self.code_wanted = False

    def _on_statusword(self, status: int) -> None:
        self.reports += 1
        self.emcy = False
        if (status, self.mode_display) != self._judged:
            before, self.statusword, self.power = self.power, status, profile.state_of(status)
            if before is not self.power:
                self._on_power(before, self.power)
            self._judge()

    def _on_power(self, before: PowerState | None, power: PowerState | None) -> None:
        self.polls.hasten()
        if before is PowerState.OPERATION_ENABLED:
            self._unarm()
        if power in FAULTY and before not in FAULTY:
            self.code_wanted = not self.codes
        elif power not in FAULTY and before in FAULTY:
            self.code_wanted = False
            self.codes.clear()

    def _judge(self) -> None:
        """Decide what its state is in the gateway's terms."""
        power, complete = self.power, self.known.complete
        self._judged = self.statusword, self.mode_display
        detail = power.value if power is not None else ""
        if power is PowerState.OPERATION_ENABLED and self.mode_display is not None:
            detail += f", {profile.mode_name(self.mode_display)}"
        self.detail = ", ".join(filter(None, (detail, "" if complete else READING)))
        if self.known.unusable:
            self.mode, self.detail = State.FAULT, self.known.unusable
        elif power in FAULTY or self.estopped_at is not None:
            self.mode = State.FAULT
        elif power in POWERED:
            self.mode = State.ARMED
        elif power in (None, PowerState.NOT_READY) or not complete:
            self.mode = State.INITIALISING
        else:
            self.mode = State.READY
        known = complete or self.known.unusable
        self.first_mode = self.mode if known else State.INITIALISING
        """The same of a drive that was never commanded: it is not reported as armed before it is known."""
        self.rests = power in CALM or self.mode is State.ARMED
        """It is armed, or certainly is not."""

    def on_outcome(self, t: Nanos, outcome: Outcome) -> Values:
        """Handle the end of a transfer; return the objects of state and motion that it has read."""
        job, key, abort = outcome.job, outcome.job.key, outcome.abort
        match job.purpose:
            case Purpose.STARTUP if abort != sdo.TIMEOUT or key == co.DEVICE_NAME:
                return self._on_read(t, key, outcome)
            case Purpose.POLL if abort is None:
                value = from_bytes(OBJECTS[key].type, outcome.value)
                return {} if value is None else {key: value}
            case Purpose.POLL if abort != sdo.TIMEOUT and key not in (o.STATUSWORD, o.POSITION):
                self.known.lacks(key)
            case Purpose.SETUP if job.data == bytes(4) and key == co.CONSUMER_HEARTBEAT:
                self.watches = abort == sdo.TIMEOUT
            case Purpose.SETUP if self.setup is not None:
                self.setup.on_outcome(outcome)
                if self.setup.failed:
                    self.failures.append((faults.NOT_CONFIGURED, self.setup.failed))
                    self.give_up_setup()
            case Purpose.SETPOINT if abort is None and job.data is not None:
                self.output.confirm(t, key, from_bytes(OBJECTS[key].type, job.data) or 0)
                self.rounds += 1
            case Purpose.REQUEST if self.homing is not None and job.token == self.homing.token:
                self.client.put(*self.homing.on_method(outcome))
            case Purpose.CHECK if key[0] in co.PDO_PARAMETERS and abort is None and self.configured:
                self._on_cob_id(key, outcome.value)
            case Purpose.CHECK if key in o.TARGETS:
                if failure := self.arrival.on_outcome(t, outcome):
                    self.failures.append((faults.NOT_ARMED, failure))
                    self._unarm()
        return {}

    def _on_read(self, t: Nanos, key: Key, outcome: Outcome) -> Values:
        value = self.known.add(key, outcome.value, outcome.abort)
        if self.known.pdos is not None:
            self._expect()
        if self.known.unusable:
            self.note(t, faults.WRONG_DEVICE, self.known.unusable)
        self._judge()
        reported = value is not None and key in (o.STATUSWORD, o.MODE_DISPLAY, o.ERROR_CODE)
        return {key: value} if value is not None and reported else {}

    def _expect(self) -> None:
        """Decode its TPDOs from now on."""
        options, pdos = self.options, (self.known.pdos or {}).values()
        tpdos = [pdo for pdo in pdos if pdo.kind == "TPDO" and pdo.entries and not pdo.cob & DISABLED]
        self.tpdos = setpoints.layouts(tpdos)
        self.polls.expect(tpdos, options.sync_ms * MILLISECOND if options.feedback == "sync" else 0)

    # -- reported -------------------------------------------------------------------------------------

    def note(self, t: Nanos, code: int, cause: str = "") -> None:
        """Report a fault that does not stay."""
        info = faults.fault_info(code)
        self.events.append(Fault(self.name, t, code, info.name, cause or info.cause, info.remedy))

    def take_events(self) -> list[Event]:
        """Return what is to be reported, once."""
        events, self.events = self.events, []
        return events

    def take_failures(self) -> list[tuple[int, str]]:
        """Return the faults that are to be latched, once."""
        failures, self.failures = self.failures, []
        return failures

    def describe(self) -> str:
        """Return its name and identity, as read."""
        return ", ".join(filter(None, (self.known.name, describe(self.known.read))))

    # -- commanded ------------------------------------------------------------------------------------

    def why_not(self, command: Command) -> str:
        """Return why it cannot do a command at all; "" if it can, or is not known yet."""
        known = self.known
        if isinstance(command, Impedance):
            return "the profile has no impedance control"
        if known.units is None or not known.complete:
            return ""
        mode = known.mode(*FAMILIES[type(command)])
        if mode is None:
            modes = known.read.get(o.SUPPORTED_MODES, 0)
            return f"its object 6502 ({modes:#x}) has no mode for {type(command).__name__}"
        try:
            values = setpoints.values_of(command, mode, known.units, 0)
        except ValueError as error:
            return str(error)
        lacking = next((key for key, value in values.items() if value and key in known.absent), None)
        return f"it has no object {lacking[0]:04X} ({OBJECTS[lacking].name})" if lacking else ""

    @property
    def ready(self) -> bool:
        """True if it can take a command, or must be started to tell."""
        known = self.known.complete and self.position is not None and self.power is not None
        return known or self.nmt is NmtState.STOPPED

    @property
    def operational(self) -> bool:
        """True if it is in NMT operational, as far as it reports that."""
        return self.nmt is NmtState.OPERATIONAL or (self.nmt is None and self.starts >= STARTS)

    def steer(self, now: Nanos, command: Command, *, at_sync: bool) -> list[CanFrame]:
        """Return the frames of a command. `at_sync`: a SYNC follows, or another host produces it."""
        self.commanded_at, self.holding = now, isinstance(command, Hold)
        if not self.known.complete or not self._prepare():
            return self._start(now) if self.nmt is NmtState.STOPPED else []
        frames = self._start(now) if not self.operational else []
        if self.output.synchronous and not at_sync:
            return frames
        return frames + self._setpoints(now, command)

    def _start(self, now: Nanos) -> list[CanFrame]:
        if now < self.start_next:
            return []
        self.start_next, self.starts = now + START_AGAIN, self.starts + 1
        return [encode(Nmt(NmtCommand.START, self.address))]

    def _setpoints(self, now: Nanos, command: Command) -> list[CanFrame]:
        units, mode = self.known.units, self.known.mode(*FAMILIES[type(command)])
        power, position = self.power, self.position
        if units is None or mode is None or power is None or position is None:
            return []
        if not self.holding:
            self.hold = None
            self.homing = None
        elif self.hold is None:
            self.hold = position
        if self.homing is not None and self.homing.runs:
            values = self.homing.values(position, self.mode_display, self.reports)
            return self._send(now, values, o.CONTROLWORD)
        target = TARGET_OF[mode]
        in_mode = self.mode_display == mode
        if power is PowerState.OPERATION_ENABLED:
            rest = self.values.get(o.TARGET_POSITION, position) if self.hold is None else self.hold
            values, control = setpoints.values_of(command, mode, units, rest), int(Demand.ENABLE_OPERATION)
            if mode is Mode.PP and in_mode:
                control = self._hand_over(now, values)
            self._note_progress(now, None if in_mode else (power, mode))
        else:
            values = setpoints.standstill(position)
            self._note_progress(now, (power, in_mode))
            option = self.known.read.get(o.QUICK_STOP_OPTION, 2)
            demand = setpoints.arming_demand(power, option, prepared=in_mode and self.rounds >= PREPARED)
            if demand is None:
                return []
            control = int(demand)
        self.rounds += 1
        frames = self._send(now, values | {o.CONTROLWORD: control, o.MODE: int(mode)}, target)
        if power is PowerState.OPERATION_ENABLED and in_mode:
            self._check(now, target)
        return frames

    def _send(self, now: Nanos, values: Values, moving: Key) -> list[CanFrame]:
        self.values = {key: value for key, value in values.items() if key not in self.known.absent}
        self.client.drop(Purpose.SETPOINT)
        download = self.output.next_download(now, self.values, moving)
        job = self.client.job
        if download is not None and (job is None or job.purpose is not Purpose.SETPOINT):
            key, value = download
            self.client.put(Job(Purpose.SETPOINT, key, to_bytes(OBJECTS[key].type, value)))
        return self.output.frames(now, self.values, moving)

    def _hand_over(self, now: Nanos, values: Values) -> int:
        """Return the controlword of PP's handshake; put its target into the values."""
        acknowledged = bool((self.statusword or 0) & Status.BIT_12)
        target = values[o.TARGET_POSITION]
        control, given = self.handshake.step(now, self.reports, target, acknowledged=acknowledged)
        values[o.TARGET_POSITION] = given
        if self.handshake.stuck(now, self.reports, self.options.state_timeout_ms * MILLISECOND):
            self.codes.add(faults.SETPOINT_STUCK)
        elif not self.handshake.blocked:
            self.codes.discard(faults.SETPOINT_STUCK)
        return control

    def _note_progress(self, now: Nanos, progress: object) -> None:
        """Note how far arming is (None: done); without progress in its time it has failed."""
        if progress is None or self._since is None or self._progress != progress:
            self._progress, self._since = progress, None if progress is None else (now, self.reports)
            return
        since, reports = self._since
        timeout = self.options.state_timeout_ms * MILLISECOND
        late = now - since >= timeout and self.reports >= reports + PATIENCE
        if late or now - since >= 10 * timeout:
            state = "an unknown state" if self.power is None else self.power.value
            shown = "no mode" if self.mode_display is None else profile.mode_name(self.mode_display)
            self.failures.append((faults.NOT_ARMED, f"it stayed in {state} with {shown} displayed"))
            self._unarm()

    def _check(self, now: Nanos, target: Key) -> None:
        """Read a set-point back once that is sent by RPDO."""
        mapped = target in self.output.mapped
        wanted = mapped and self.arrival.sent(now, target, self.values.get(target, 0))
        if wanted and not self.client.has(Purpose.CHECK):
            self.client.put(Job(Purpose.CHECK, target))

    # -- setup ----------------------------------------------------------------------------------------

    def _prepare(self) -> bool:
        """True if the setup is done; begin it first."""
        if self.setup is None:
            self.setup = self.known.setup()
        if self.setup.done and not self.configured:
            self.known.adopt(self.setup)
            self._expect()
            read = self.known.read
            offsets = {key: read[key] for key in Output.OFFSETS if key in read}
            self.output.configure(self.known.usable("RPDO"), offsets)
            self.configured = True
        return self.configured

    def _on_cob_id(self, key: Key, data: bytes) -> None:
        """Handle the COB-ID of an RPDO in use, as read back: a late copy of a write may have disabled it."""
        found, wanted = from_bytes(Type.U32, data), self.known.cob_ids().get(key)
        if found is None or wanted is None or not (found ^ wanted) & ~NO_RTR:
            return
        cause = f"{title(key)} is {found:08X} and was set to {wanted:08X}: it was configured anew meanwhile"
        self.failures.append((faults.NOT_CONFIGURED, cause))
        self.configured = False
        self.give_up_setup()

    def give_up_setup(self) -> None:
        """Forget a setup that is not done, and what it may have written."""
        if self.setup is None or self.configured:
            return
        self.client.drop(Purpose.SETUP)
        self.setup = None
        self.known.forget_pdos()
        self._judge()

    # -- homing ---------------------------------------------------------------------------------------

    def home(self, *, zero: bool) -> str:
        """Begin homing, or return why that is impossible."""
        modes = self.known.read.get(o.SUPPORTED_MODES, 0)
        if not self.known.complete or not profile.supports(modes, Mode.HM):
            return "it has no homing mode (object 6502), or is not known yet"
        if self.mode is not State.ARMED or not self.holding:
            return "it must be armed and hold: command hold first"
        if self.homing is not None:
            return "homing is under way"
        self.homing = Homing(self.token(), zero, runs=not zero)
        if zero:
            self.client.put(self.homing.job())
        return ""

    def homed(self) -> tuple[bool, str] | None:
        """Return the end of homing as (success, detail); None while it goes on."""
        if self.homing is None:
            return False, "it was disarmed, or commanded otherwise"
        return self.homing.result(self.statusword or 0, self.reports)

    def end_homing(self) -> None:
        """Go back to holding, at the position measured from now on; put back the method before Zero."""
        homing, self.homing = self.homing, None
        if homing is None:
            return
        if homing.runs:
            self.hold, self.position, self.rounds = None, None, 0
            self.polls.invalidate(o.POSITION)
        if homing.method is not None and homing.tried:
            self.client.put(homing.job(homing.method))

    # -- disarmed -------------------------------------------------------------------------------------

    def release(self, now: Nanos, since: Nanos) -> list[CanFrame]:
        """Return what disarms it; `since`: when that began. A quick stop goes first."""
        self.give_up_setup()
        self._unarm()
        self.client.drop(Purpose.SETPOINT)
        late = now - since >= LATE
        if self.power is PowerState.FAULT or (self.stopping and not late):
            return []
        demand = Demand.DISABLE_VOLTAGE if late else Demand.SHUTDOWN
        return self._send_demand(now, demand, by_sdo=now > since)

    def _send_demand(self, now: Nanos, demand: Demand, *, by_sdo: bool) -> list[CanFrame]:
        """Send a controlword by RPDO, and by SDO if it is in none, or that did not help (`by_sdo`)."""
        frames = []
        if self.configured and self.operational:
            frames = self.output.demand(now, demand, self.position or 0, self.mode_display or 0)
        if by_sdo or not frames:
            self.write_controlwords(demand)
        return frames

    def write_controlwords(self, *demands: Demand) -> None:
        """Write controlwords by SDO, before anything else."""
        self.client.drop(Purpose.URGENT)
        self.client.put(*(Job(Purpose.URGENT, o.CONTROLWORD, to_bytes(Type.U16, each)) for each in demands))
        self.output.overrule()

    @property
    def stopping(self) -> bool:
        """True while it does not obey an operator's stop."""
        at = self.estopped_at
        if at is None:
            return False
        return self.stop_next <= at or self.power not in (PowerState.QUICK_STOP, *CALM)

    def quick_stop(self, now: Nanos) -> None:
        """Stop it, by an operator's request; it stays in fault until that is cleared."""
        self.estopped_at = self.stop_next = now
        self.failures.append((faults.QUICK_STOPPED, ""))
        self.give_up_setup()
        self._unarm()
        self._judge()

    def clear(self) -> None:
        """Begin to clear its faults."""
        self.estopped_at, self.clearing, self.reset_next = None, True, 0
        self.client.pardon()
        if self.known.unusable:
            self.known.forget()  # it may be another device now
        self._judge()

    def cleared(self) -> None:
        """End that, whether they are gone or not."""
        self.clearing = False
        if self.power not in FAULTY:
            self.codes.clear()

    def reset(self, now: Nanos) -> None:
        """Reset its faults, if it has any, and again if that does not help."""
        if self.power in FAULTY and now >= self.reset_next:
            self.reset_next = now + RESET_AGAIN
            self.write_controlwords(Demand.DISABLE_VOLTAGE, Demand.FAULT_RESET)

    # -- by itself ------------------------------------------------------------------------------------

    def tend(self, now: Nanos, phase: Phase, *, owned: bool) -> list[CanFrame]:
        """Return what is due without a command."""
        active = phase in (Phase.ARMING, Phase.ARMED)
        if phase is Phase.FREE and not owned:
            self.setup, self.configured = None, False
            if self.watches and not self.client.has(Purpose.SETUP):  # leaving must not trip its watchdog
                self.client.put(Job(Purpose.SETUP, co.CONSUMER_HEARTBEAT, bytes(4)))
        self.feeds = not active or self.commanded_at == now
        self.synced = owned and self.configured and self.options.feedback == "sync"
        self.hurried = self.stopping or self.clearing or phase in (Phase.ARMING, Phase.RELEASING)
        self.hurried = self.hurried or (phase is Phase.ARMED and self._since is not None)
        frames = []
        if self.stopping and now >= self.stop_next:
            self.stop_next = now + STOP_AGAIN
            frames = self._send_demand(now, Demand.QUICK_STOP, by_sdo=now != self.estopped_at)
        if now - self.commanded_at > AGE:
            self.client.drop(Purpose.SETPOINT)
        return frames + self._transfer(now, active)

    def _transfer(self, now: Nanos, active: bool) -> list[CanFrame]:
        """Return the next SDO request."""
        for _ in range(2):  # what was given up makes room for another
            self._put_jobs(now, active)
            request, outcome = self.client.poll(now)
            if outcome is None:
                break
            self.on_outcome(now, outcome)
        return [] if request is None else [CanFrame(sdo_rx_id(self.address), sdo.encode(request))]

    def _put_jobs(self, now: Nanos, active: bool) -> None:
        client, jobs = self.client, list[Job | None]()
        if self.setup is not None and active and not client.has(Purpose.SETUP):
            job = self.setup.job()
            self.watches = self.watches or (job is not None and job.key == co.CONSUMER_HEARTBEAT)
            jobs.append(job)
        if not client.has(Purpose.STARTUP):
            key = self.known.next_key()
            jobs.append(Job(Purpose.STARTUP, key) if key is not None else None)
        if self.reports and now >= self.check_at and not client.has(Purpose.CHECK):
            self.check_at = now + (RECHECK if client.doubled else CHECK)
            has_serial = co.SERIAL_NUMBER not in self.known.absent
            jobs.append(Job(Purpose.CHECK, co.SERIAL_NUMBER if has_serial else co.DEVICE_TYPE))
            if self.configured:
                jobs += [Job(Purpose.CHECK, key) for key in self.known.cob_ids()]
        if self.known.units is not None and not client.has(Purpose.POLL):
            lacking, failed = self.known.absent, self.code_wanted
            polled = self.polls.next(now, lacking, hurried=self.hurried, failed=failed)
            jobs.append(Job(Purpose.POLL, polled) if polled is not None else None)
        client.put(*(job for job in jobs if job is not None))

    def due(self) -> Nanos:
        """Return when `tend` next has something to do."""
        times = [self.client.due(), self.stop_next if self.stopping else NEVER]
        if self.client.job is None and not self.known.unusable:
            reads = self.known.pdos is None and not self.client.has(Purpose.STARTUP)
            times += [0] if reads else []
            times += [self.polls.due] if self.known.units and not self.client.has(Purpose.POLL) else []
            times += [self.check_at] if self.reports and not self.client.has(Purpose.CHECK) else []
        return min(times)

    def token(self) -> int:
        """Return a number for a request."""
        self.tokens += 1
        return self.tokens

    def resend(self) -> None:
        """Send anew what may have been lost on our side."""
        self.output.forget()
        self.client.resend()
