"""The host's end of CANopen CiA 402, for all such drives of one bus.

Rules. What is known of a drive, and what it is sent, is `Drive`'s; here its frames are dispatched, and
requests carried out. Nothing is learnt of a device from a host's frames, this one's or another's. Faults are
cleared by ClearFault alone, by a rising edge of bit 7 of the controlword.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

from protocols import messages as msg
from protocols.canopen import lss, sdo
from protocols.canopen import objects as co
from protocols.canopen import services as cs
from protocols.canopen.client import DOUBLED, Job, Outcome, Purpose
from protocols.canopen.master import Master
from protocols.canopen.objects import Type, to_bytes
from protocols.canopen.scan import DURATION, PERIOD, NodeScan, describe
from protocols.canopen.services import EMCY_BASE, HEARTBEAT_BASE, NODE_MASK, SDO_TX_BASE, SYNC_ID, NmtState
from protocols.cia402 import objects as o
from protocols.cia402 import setup
from protocols.cia402.drive import Drive
from protocols.cia402.drive_state import FAULTY
from protocols.cia402.faults import DUPLICATE_NODE, FAULTS, HOMING_FAILED, fault_info
from protocols.cia402.objects import OBJECTS, SIGNATURES
from protocols.cia402.polls import feedback
from protocols.cia402.setpoints import Values
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.faults import Faults
from protocols.toolkit.host import Host, Phase, Report
from protocols.toolkit.motor_driver import ARMED, NEVER, Adapter, MotorDriver, Pending, Rx

TPDOS = (0x180, 0x280, 0x380, 0x480)
TIMEOUT = 2000 * MILLISECOND
CLEAR_TIMEOUT, CLEAR_AGAIN = 3000 * MILLISECOND, 10 * MILLISECOND
REBOOT_TIMEOUT, REBOOT_AGAIN = 8000 * MILLISECOND, 2000 * MILLISECOND
SAVING = 6000 * MILLISECOND
LSS_PERIOD, SEARCH = 15 * MILLISECOND, 6000 * MILLISECOND
"""Between two messages of a search for a device without a node id, and of all of it with what follows"""
TWICE = "every request is answered twice (by two devices, or to two hosts)"
IDENTITY = (co.VENDOR_ID, co.PRODUCT_CODE, co.REVISION, co.SERIAL_NUMBER)
DRIVER_OBJECTS = frozenset({o.CONTROLWORD, o.MODE, *o.TARGETS, co.CONSUMER_HEARTBEAT})
"""Objects that only the driver itself writes, like the PDO parameters."""

DriveHost: TypeAlias = Host[Drive]
DriveReport: TypeAlias = Report[Drive]
DrivePending: TypeAlias = Pending[Drive]
Cia402Driver: TypeAlias = MotorDriver[Drive]


class Cia402Adapter(Adapter[Drive]):
    """What drives are sent, and what they report."""

    name = "cia402"
    faults = Faults(FAULTS, fault_info)
    duplicate = DUPLICATE_NODE
    blind = True  # `ready` decides
    releasing = 50 * MILLISECOND
    needs_idle = (msg.Reboot,)
    addresses = range(1, cs.MAX_NODE + 1)

    def __init__(self, devices: Sequence[Device]) -> None:
        synced = [device.options for device in devices if device.options.feedback == "sync"]
        host_id = devices[0].options.host_id if devices else 0
        self.master = Master(synced[0].sync_ms * MILLISECOND if synced else 0, host_id)
        self.drives: list[Drive] = []
        self._commanded_at: Nanos = -1
        """When set-points were sent last."""

    def own(self, device: Device) -> Drive:
        drive = Drive(device)
        self.drives.append(drive)
        return drive

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: Cia402Driver) -> Sequence[DriveReport | Rx]:
        if not isinstance(frame, CanFrame) or frame.extended or frame.fd or frame.remote:
            return (Rx.IGNORED,)
        if frame.id == lss.SLAVE:
            return (self._on_lss(frame, driver),)
        host, function = driver.at.get(frame.id & NODE_MASK), frame.id & ~NODE_MASK
        if host is None:
            return (self._on_stranger(t, frame, driver),)
        if function in TPDOS:
            values = host.own.on_tpdo(t, frame.id, frame.data)
            return (Rx.MALFORMED if values is None else self._report(t, host, values),)
        if function == SDO_TX_BASE:
            return (self._on_sdo(t, host, frame),)
        if function in (EMCY_BASE, HEARTBEAT_BASE):
            return (self._on_message(t, host, frame),)
        return (Rx.IGNORED,)

    def _on_lss(self, frame: CanFrame, driver: Cia402Driver) -> Rx:
        """Take the answer of a device that has no node id yet."""
        if len(frame.data) != lss.SIZE:
            return Rx.MALFORMED
        searches: list[lss.FastScan] = [
            p.notes["search"] for p in driver.queue.waiting if "search" in p.notes
        ]
        for search in searches:
            search.take(frame.data)
        return Rx.EXPECTED if searches else Rx.IGNORED

    def _report(
        self,
        t: Nanos,
        host: DriveHost,
        values: Values,
        *,
        judged: bool = False,
        **others: Any,  # noqa: ANN401
    ) -> DriveReport:
        """Return what objects of state and motion report. `judged`: what was read may have changed its mode;
        `others`: fields of the report."""
        drive, mode = host.own, None
        drive.take(values)
        # What neither gives torque nor rests for certain confirms no release.
        free, shown = host.phase is not Phase.RELEASING, o.STATUSWORD in values
        if (shown and drive.judged.rests) or (free and (shown or judged)):
            mode = drive.judged.mode if host.once_commanded else drive.judged.first_mode
        faults = drive.reported.codes if drive.reported.codes or host.active else None
        units = drive.known.units
        measured = None if units is None else feedback(host.name, t, values, units)
        return Report(host, host.address, mode, drive.judged.detail, faults, measured, **others)

    def _on_sdo(self, t: Nanos, host: DriveHost, frame: CanFrame) -> DriveReport | Rx:
        drive, response = host.own, sdo.decode_response(frame.data)
        if response is None:
            return Rx.MALFORMED
        known, outcome = drive.known.serial, drive.client.handle(t, response)
        serial = None
        if isinstance(response, sdo.Uploaded) and (response.index, response.sub) == co.SERIAL_NUMBER:
            asked = drive.client.repeats(response)  # of the device, or of another one beside it
            serial = int.from_bytes(response.data, "little") or None if asked else None
        two = TWICE if drive.client.doubled >= DOUBLED else ""
        others: dict[str, Any] = {"serial": known if two else serial, "duplicate": two, "content": outcome}
        if outcome is None:
            return Report(host, host.address, **others)
        values = drive.on_outcome(t, outcome)
        if serial is not None and known not in (None, serial):
            drive.forget(t)
            host.forget(t)
            return Report(host, host.address, drive.judged.mode, "another device responds", **others)
        note = drive.describe() if serial is not None else ""
        judged = outcome.job.purpose is Purpose.STARTUP
        return self._report(t, host, values, judged=judged, note=note, events=drive.take_events(), **others)

    def _on_message(self, t: Nanos, host: DriveHost, frame: CanFrame) -> DriveReport | Rx:
        drive = host.own
        match cs.decode(frame):
            case cs.Heartbeat(_, NmtState.INITIALISING):
                again = host.received_at is not None and (drive.reported.reports > 0 or host.owned)
                drive.on_boot(t)
                host.forget(t)
                detail = "restarted" if again else drive.judged.detail
                return Report(host, host.address, drive.judged.mode, detail, content=NmtState.INITIALISING)
            case cs.Heartbeat(_, state):
                return Report(host, host.address, duplicate=drive.nmt.on_heartbeat(t, state))
            case cs.Emcy(_, code):
                drive.reported.on_emcy(code)
                return Report(host, host.address, faults=drive.reported.codes)
        return Rx.MALFORMED

    def _on_stranger(self, t: Nanos, frame: CanFrame, driver: Cia402Driver) -> DriveReport | Rx:
        """Return what a frame of no known device reports: SYNC, or a response to a scan."""
        if frame.id == SYNC_ID and cs.decode(frame) is not None:
            found = self.master.on_sync(t, self.name)
            if found is None:
                return Rx.IGNORED
            return Report(None, 0, events=found) if found else Rx.EXPECTED
        node, uploaded = frame.id & NODE_MASK, frame.id & ~NODE_MASK == SDO_TX_BASE
        for pending in driver.queue.waiting:
            if getattr(pending.request, "address", None) == node and uploaded:
                return Report(None, node)  # whatever it answers to `ask_at`
            if isinstance(pending.request, msg.Scan) and frame.id & ~NODE_MASK == SDO_TX_BASE:
                scan: NodeScan = pending.notes["scan"]
                if scan.receive(frame.id & NODE_MASK, sdo.decode_response(frame.data)):
                    return Rx.EXPECTED
        return Rx.IGNORED

    # -- commanded ------------------------------------------------------------------------------------

    def refuse(self, host: DriveHost, command: Command) -> str:
        return host.own.why_not(command)

    def ready(self, host: DriveHost) -> bool:
        return host.own.ready

    def arm(self, now: Nanos, host: DriveHost, command: Command) -> Sequence[Frame]:
        frames = host.own.steer(now, command, at_sync=self.master.at_sync(now))
        self._commanded_at = now if frames else self._commanded_at
        return frames

    command = arm

    def release(self, now: Nanos, host: DriveHost) -> Sequence[Frame]:
        return host.own.release(now, host.since)

    # -- by itself ------------------------------------------------------------------------------------

    def notice(self, now: Nanos, host: DriveHost) -> Sequence[Event]:
        events = host.own.take_events()
        for code, cause in host.own.take_failures():
            events += host.trip(now, code, cause)
        return events

    def poll(self, now: Nanos, host: DriveHost) -> Sequence[Frame]:
        return host.own.tend(now, host.phase, owned=host.owned)

    def poll_due(self, host: DriveHost) -> Nanos:
        return host.own.due()

    def awaits(self, host: DriveHost) -> bool:
        return host.own.client.awaits()

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        needed = any(drive.synced for drive in self.drives)
        frames = self.master.sync(now, needed=needed, commanded=self._commanded_at == now)
        watching = [drive for drive in self.drives if drive.watches]
        if watching and all(drive.feeds for drive in watching):
            shortest = min(drive.options.watchdog_ms for drive in watching)
            frames += self.master.heartbeat(now, shortest * MILLISECOND)
        return frames

    def poll_bus_due(self) -> Nanos:
        return NEVER if self.master.sync_next is None else self.master.sync_next

    def forget(self, now: Nanos, host: DriveHost) -> None:
        host.own.forget(now)

    def interrupted(self) -> None:
        self.master.forget()

    def resend(self, host: DriveHost) -> None:
        host.own.resend()

    # -- requests -------------------------------------------------------------------------------------

    def readdress(self, host: DriveHost, address: int) -> Sequence[Frame]:
        """By LSS: the drive is selected by its identity, all of which must be known."""
        read = host.own.known.read
        if address == host.own.options.host_id or not read.keys() >= {*IDENTITY}:
            return ()
        vendor, product, revision, serial = (read[key] for key in IDENTITY)
        reset = cs.encode(cs.Nmt(cs.NmtCommand.RESET_COMMUNICATION, host.address))
        return *lss.assignment((vendor, product, revision, serial), address), reset

    def ask_at(self, address: int) -> Sequence[Frame]:
        return (CanFrame(cs.sdo_rx_id(address), sdo.encode(sdo.Upload(*co.SERIAL_NUMBER))),)

    def begin(
        self, now: Nanos, request: Request, host: DriveHost | None, driver: Cia402Driver
    ) -> DrivePending | str:
        if host is None:
            if not isinstance(request, msg.Scan):
                return "a node id is given to one of its motors (SetAddress, by LSS)"
            if driver.scanning():
                return "a scan is under way"
            notes = {"scan": NodeScan(tuple(driver.at))}
            return Pending(request, request.bus, now, now + DURATION, now, None, (), PERIOD, notes)
        drive = host.own
        slow = 10 * drive.options.sdo_timeout_ms * MILLISECOND
        match request:
            case msg.ClearFault():
                drive.clear()
                until = now + CLEAR_TIMEOUT
                return Pending(request, host.name, now, until, now, host, (), CLEAR_AGAIN, sent=1)
            case msg.Estop():
                drive.quick_stop(now)
                return _waiting(now, request, host, max(TIMEOUT, slow))
            case msg.Reboot():
                reset = cs.encode(cs.Nmt(cs.NmtCommand.RESET_NODE, host.address))
                until = now + REBOOT_TIMEOUT
                return Pending(request, host.name, now, until, now, host, (reset,), REBOOT_AGAIN)
            case msg.Home() | msg.Zero():
                why = drive.home(zero=isinstance(request, msg.Zero))
                timeout = drive.options.home_timeout_ms * MILLISECOND
                return why or _waiting(now, request, host, timeout)
            case msg.SetAddress(_, address):
                search: dict[str, Any] = {"search": lss.FastScan(address)}
                return Pending(request, host.name, now, now + SEARCH, now, host, (), LSS_PERIOD, search)
            case msg.ReadParameter(_, name):
                job = _job(name, None, drive.token())
            case msg.WriteParameter(_, name) if name in SIGNATURES and host.running:
                return ARMED
            case msg.WriteParameter(_, name, value):
                job = _job(name, value, drive.token())
            case _:
                return f"cia402 has no {type(request).__name__}"
        if isinstance(job, str):
            return job
        drive.client.put(job)
        return _waiting(now, request, host, SAVING if job.patience > 1 else max(TIMEOUT, slow), job)

    def frames(self, now: Nanos, pending: DrivePending) -> Sequence[Frame]:
        if isinstance(pending.request, msg.Scan):
            scan: NodeScan = pending.notes["scan"]
            return scan.frames()
        if isinstance(pending.request, msg.ClearFault) and pending.host is not None:
            pending.host.own.reset(now)
        if "search" in pending.notes:
            search: lss.FastScan = pending.notes["search"]
            following = search.message()
            if search.failed:
                pending.expire(now)
            return () if following is None else (following,)
        return pending.frames

    def collected(self, pending: DrivePending, driver: Cia402Driver) -> Sequence[DriveReport]:
        scan: NodeScan = pending.notes["scan"]
        reports: list[DriveReport] = []
        for host in driver.hosts.values():
            drive = host.own
            if not host.offline and co.DEVICE_TYPE in drive.known.read:
                serial = drive.known.serial
                reports.append(Report(host, host.address, serial=serial, note=drive.describe()))
        for node, found in sorted(scan.found.items()):
            serials: Sequence[int | None] = scan.serials.get(node, (None,))
            reports += [Report(None, node, serial=each, note=describe(found)) for each in serials]
        return reports

    def answer(self, t: Nanos, pending: DrivePending, report: DriveReport) -> Event | None:
        host = pending.host
        if host is None:
            return None
        drive, shown = host.own, report.mode is not None
        reported = drive.reported
        match pending.request:
            case msg.ClearFault() if shown and reported.power not in (None, *FAULTY) and not reported.emcy:
                drive.cleared()
                return pending.done(t)
            case msg.Estop() if shown and not drive.stopping:
                return pending.done(t, "it stays in fault until cleared")
            case msg.Reboot() if report.content is NmtState.INITIALISING:
                return pending.done(t, "it has restarted")
            case msg.SetAddress() if pending.notes["search"].ended:
                vendor, product, revision, serial = pending.notes["search"].numbers
                one = f"vendor {vendor:#x}, product {product:#x}, revision {revision:#x}"
                return pending.done(t, f"which the device of {one}, serial number {serial:X} took, by LSS")
            case msg.Home() | msg.Zero():
                ended = drive.homed()
                if ended is not None:
                    drive.end_homing()
                    return pending.done(t, ended[1]) if ended[0] else pending.refuse(t, ended[1])
        outcome = report.content
        if isinstance(outcome, Outcome) and outcome.job == pending.notes.get("job"):
            return self._answer(t, pending, host, outcome)
        return None

    def _answer(self, t: Nanos, pending: DrivePending, host: DriveHost, outcome: Outcome) -> Event:
        """Return the answer to a request for a parameter."""
        key, request = outcome.job.key, pending.request
        if outcome.abort is not None:
            return pending.refuse(t, sdo.abort_text(outcome.abort))
        if not isinstance(request, msg.ReadParameter):
            if key in (*setup.FIRST, *setup.THEN) and not host.owned:
                host.own.forget(t)  # what is known of it has changed: read it anew
                host.forget(t)
            return pending.done(t)
        if key in OBJECTS and OBJECTS[key].type is Type.TEXT:
            return pending.done(t, outcome.value.decode("ascii", "replace"))
        value = setup.value_of(key, outcome.value)
        if value is None:
            return pending.refuse(t, f"{outcome.value.hex()} is no number of its type")
        return msg.Parameter(host.name, t, request.parameter, float(value))

    def give_up(self, now: Nanos, pending: DrivePending) -> str:
        if (search := pending.notes.get("search")) is not None:
            given = f"it was given node id {search.node}, and nothing is heard of it there"
            return search.failed or (given if search.ended else "its search took too long")
        host = pending.host
        if host is None or host.received_at is None or host.received_at <= pending.began:
            return super().give_up(now, pending)
        drive = host.own
        match pending.request:
            case msg.ClearFault():
                drive.cleared()
                if drive.known.unusable:
                    return drive.known.unusable
            case msg.Reboot():
                return "no boot-up message after the reset"
            case msg.Home() | msg.Zero():
                drive.note(now, HOMING_FAILED)
                drive.end_homing()
                return "it did not end in time"
        return super().give_up(now, pending)


def _waiting(
    now: Nanos, request: Request, host: DriveHost, timeout: Nanos, job: Job | None = None
) -> DrivePending:
    """Return a request that waits for what the drive reports."""
    until = now + timeout
    return Pending(request, host.name, now, until, until, host, notes={"job": job}, sent=1)


# -- parameters ------------------------------------------------------------------------------------------


def _job(name: str, value: float | None, token: int) -> Job | str:
    """Return the upload of a parameter (`value` None), or the download, or why there is none."""
    if name in SIGNATURES and value is not None:
        key, signature = SIGNATURES[name]
        return Job(Purpose.REQUEST, key, signature, 10, token) if value == 1 else f"{name} takes 1"
    found = OBJECTS.find(name)
    if found is None:
        return f'{name!r} is no object: give its name, or its address like "6081" or "608F:01"'
    if value is None:
        return Job(Purpose.REQUEST, found, token=token)
    known = OBJECTS.get(found)
    if known is None or known.type is Type.TEXT:
        return f"the type of {co.title(found)} is not known: not written"
    if found in DRIVER_OBJECTS or found[0] in co.PDO_PARAMETERS:
        return f"{known.name} is the driver's own: commands set it"
    if value != int(value):
        return f"{value} is not a whole number"
    try:
        return Job(Purpose.REQUEST, found, to_bytes(known.type, int(value)), token=token)
    except ValueError as error:
        return str(error)
