"""The host's record of one drive, beyond its phase: what it reported, and what is sent to it.

Rules. Plain data; integers are in the drive's units. Only uploads are sent before it is commanded, and no
set-point before its setup was read back. Whatever interrupts a setup, it is forgotten, and begun anew from a
fresh reading. Its `drive_state`, its `nmt` state, its `steering` and an `operator_stop` have files of their
own.

Source: CiA 402-2 "finite state automaton".
"""

from __future__ import annotations

from protocols.canopen import objects as co
from protocols.canopen import sdo
from protocols.canopen.client import NEVER, Job, Outcome, Purpose, SdoClient
from protocols.canopen.mapping import Setup
from protocols.canopen.objects import Key, Type, from_bytes, title, to_bytes
from protocols.canopen.pdo import DISABLED, NO_RTR
from protocols.canopen.scan import describe
from protocols.canopen.services import NmtState, sdo_rx_id
from protocols.cia402 import faults, profile, setpoints
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import FAULTY, DriveState, JudgedState
from protocols.cia402.homing import Homing
from protocols.cia402.nmt import NmtStatus
from protocols.cia402.objects import OBJECTS
from protocols.cia402.operator_stop import OperatorStop
from protocols.cia402.options import Options
from protocols.cia402.polls import Polls
from protocols.cia402.profile import Demand, Mode, PowerState
from protocols.cia402.setpoints import FAMILIES, Layouts, Output, SetpointArrival, Values
from protocols.cia402.setup import Known
from protocols.cia402.steering import Steering
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Fault, Impedance, Nanos
from protocols.messages import Mode as State
from protocols.plugin import Device
from protocols.toolkit.host import Phase

RESET_AGAIN = 500 * MILLISECOND
LATE = 500 * MILLISECOND
"""Time after which a drive that has not disarmed is commanded DISABLE VOLTAGE, without a ramp."""
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
        self.stop = OperatorStop()
        self.steering = Steering(options.state_timeout_ms * MILLISECOND)
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
        self.stop.restart()
        self.nmt = NmtStatus()
        self.tpdos: Layouts = {}
        self.reported = DriveState()
        self.judged: JudgedState
        self.check_at: Nanos = 0
        self.setup: Setup | None = None
        self.configured = False
        """The setup is done: set-points may be sent, and SYNC."""
        self.watches = False
        """It may monitor this host's heartbeat."""
        self.output = Output()
        self.arrival = SetpointArrival()
        self.synced = self.feeds = self.hurried = False
        """It needs SYNC; it was commanded, or need not be; a change of its state is expected."""
        self._unarm()
        self._judge()

    def _unarm(self) -> None:
        """Record that it does not follow set-points: the next one begins anew."""
        self.steering.restart()
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
        if self.nmt.state is not NmtState.OPERATIONAL:
            self.nmt.on_tpdo()
        self.polls.on_tpdo(t, keys)
        return dict(zip(keys, values, strict=True))

    def on_boot(self, t: Nanos) -> None:
        """Handle its boot-up message."""
        self.forget(t)
        self.nmt = NmtStatus(NmtState.PRE_OPERATIONAL)

    def take(self, values: Values) -> None:
        """Handle objects of state and motion, from a TPDO or an upload."""
        before = self.reported.power
        if not self.reported.take(values):
            return
        if self.reported.power is not before:
            self.polls.hasten()
            if before is PowerState.OPERATION_ENABLED:
                self._unarm()
        self._judge()

    def _judge(self) -> None:
        self.judged = self.reported.judge(self.known, stopped=self.stop.in_force)

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
                self.steering.on_written()
            case Purpose.REQUEST if (homing := self.steering.homing) and job.token == homing.token:
                self.client.put(*homing.on_method(outcome))
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
        reported = self.reported
        known = self.known.complete and reported.position is not None and reported.power is not None
        return known or self.nmt.state is NmtState.STOPPED

    def steer(self, now: Nanos, command: Command, *, at_sync: bool) -> list[CanFrame]:
        """Return the frames of a command. `at_sync`: a SYNC follows, or another host produces it."""
        self.commanded_at = now
        self.steering.begin(command)
        if not self.known.complete or not self._prepare():
            return self.nmt.start(now, self.address) if self.nmt.state is NmtState.STOPPED else []
        frames = [] if self.nmt.operational else self.nmt.start(now, self.address)
        if self.output.synchronous and not at_sync:
            return frames
        frames = frames + self._setpoints(now, command)
        if not self.nmt.operational:
            self.output.repeat()  # a drive takes no PDO before (CiA 301, NMT)
        return frames

    def _setpoints(self, now: Nanos, command: Command) -> list[CanFrame]:
        wanted, failure = self.steering.step(now, command, self.known, self.reported)
        if failure:
            self.failures.append((faults.NOT_ARMED, failure))
            self.arrival.restart()
        if wanted is None:
            return []
        self.client.drop(Purpose.SETPOINT)
        download = self.output.next_download(now, wanted.values, wanted.moving)
        job = self.client.job
        if download is not None and (job is None or job.purpose is not Purpose.SETPOINT):
            key, value = download
            self.client.put(Job(Purpose.SETPOINT, key, to_bytes(OBJECTS[key].type, value)))
        frames = self.output.frames(now, wanted.values, wanted.moving)
        if wanted.followed:
            self._check(now, wanted.moving, wanted.values.get(wanted.moving, 0))
        return frames

    def _check(self, now: Nanos, target: Key, value: int) -> None:
        """Read a set-point back once that is sent by RPDO."""
        wanted = target in self.output.mapped and self.arrival.sent(now, target, value)
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
        if self.judged.mode is not State.ARMED or not self.steering.holding:
            return "it must be armed and hold: command hold first"
        if self.steering.homing is not None:
            return "homing is under way"
        homing = Homing(self.token(), zero, runs=not zero)
        self.steering.home(homing)
        if zero:
            self.client.put(homing.job())
        return ""

    def homed(self) -> tuple[bool, str] | None:
        """Return the end of homing as (success, detail); None while it goes on."""
        homing, reported = self.steering.homing, self.reported
        if homing is None:
            return False, "it was disarmed, or commanded otherwise"
        return homing.result(reported.statusword or 0, reported.reports)

    def end_homing(self) -> None:
        """Go back to holding, at the position measured from now on; put back the method before Zero."""
        homing = self.steering.end_homing()
        if homing is None:
            return
        if homing.runs:
            self.reported.forget_position()
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
        if self.reported.power is PowerState.FAULT or (self.stopping and not late):
            return []
        demand = Demand.DISABLE_VOLTAGE if late else Demand.SHUTDOWN
        return self._send_demand(now, demand, by_sdo=now > since)

    def _send_demand(self, now: Nanos, demand: Demand, *, by_sdo: bool) -> list[CanFrame]:
        """Send a controlword by RPDO, and by SDO if it is in none, or that did not help (`by_sdo`)."""
        frames = []
        if self.configured and self.nmt.operational:
            reported = self.reported
            frames = self.output.demand(now, demand, reported.position or 0, reported.mode_display or 0)
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
        return self.stop.disobeyed(self.reported.power)

    def quick_stop(self, now: Nanos) -> None:
        """Stop it, by an operator's request; it stays in fault until that is cleared."""
        self.stop.begin(now)
        self.failures.append((faults.QUICK_STOPPED, ""))
        self.give_up_setup()
        self._unarm()
        self._judge()

    def clear(self) -> None:
        """Begin to clear its faults."""
        self.stop.end()
        self.clearing, self.reset_next = True, 0
        self.client.pardon()
        if self.known.unusable:
            self.known.forget()  # it may be another device now
        self._judge()

    def cleared(self) -> None:
        """End that, whether they are gone or not."""
        self.clearing = False
        self.reported.forget_codes()

    def reset(self, now: Nanos) -> None:
        """Reset its faults, if it has any, and again if that does not help."""
        if self.reported.power in FAULTY and now >= self.reset_next:
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
        self.hurried = self.hurried or (phase is Phase.ARMED and self.steering.waits)
        frames = []
        if self.stop.sends(now, self.reported.power):
            frames = self._send_demand(now, Demand.QUICK_STOP, by_sdo=self.stop.is_repeated(now))
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
        jobs: list[Job | None] = []
        client = self.client
        if self.setup is not None and active and not client.has(Purpose.SETUP):
            job = self.setup.job()
            self.watches = self.watches or (job is not None and job.key == co.CONSUMER_HEARTBEAT)
            jobs.append(job)
        if not client.has(Purpose.STARTUP):
            key = self.known.next_key()
            jobs.append(Job(Purpose.STARTUP, key) if key is not None else None)
        if self.reported.reports and now >= self.check_at and not client.has(Purpose.CHECK):
            self.check_at = now + (RECHECK if client.doubled else CHECK)
            has_serial = co.SERIAL_NUMBER not in self.known.absent
            jobs.append(Job(Purpose.CHECK, co.SERIAL_NUMBER if has_serial else co.DEVICE_TYPE))
            if self.configured:
                jobs += [Job(Purpose.CHECK, key) for key in self.known.cob_ids()]
        if self.known.units is not None and not client.has(Purpose.POLL):
            lacking, failed = self.known.absent, self.reported.code_wanted
            polled = self.polls.next(now, lacking, hurried=self.hurried, failed=failed)
            jobs.append(Job(Purpose.POLL, polled) if polled is not None else None)
        client.put(*(job for job in jobs if job is not None))

    def due(self) -> Nanos:
        """Return when `tend` next has something to do."""
        times = [self.client.due(), self.stop.due(self.reported.power)]
        if self.client.job is None and not self.known.unusable:
            reads = self.known.pdos is None and not self.client.has(Purpose.STARTUP)
            times += [0] if reads else []
            times += [self.polls.due] if self.known.units and not self.client.has(Purpose.POLL) else []
            times += [self.check_at] if self.reported.reports and not self.client.has(Purpose.CHECK) else []
        return min(times)

    def token(self) -> int:
        """Return a number for a request."""
        self.tokens += 1
        return self.tokens

    def resend(self) -> None:
        """Send anew what may have been lost on our side."""
        self.output.forget()
        self.client.resend()
