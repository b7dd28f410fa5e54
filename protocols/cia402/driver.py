"""The driver: the host's end of CANopen CiA 402, for all such drives of one bus.

Rules. No clock, no bus: time and frames are arguments, frames to be sent are returned. `receive` never raises
and learns nothing of a device from a host's frames (this one's or another's). `DriveState` is the record of
one drive, `motion` executes commands, `requests` requests, `duplicate_address` detects a second device with
its node id; this file dispatches the frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.canopen import sdo
from protocols.canopen import services as codec
from protocols.cia402.old_client import Outcome, Purpose
from protocols.canopen.services import EMCY_BASE, HEARTBEAT_BASE, NODE_MASK, SDO_TX_BASE, SYNC_ID
from protocols.cia402 import configuring, duplicate_address, jobs, motion, requests
from protocols.cia402 import objects as o
from protocols.cia402.drive_state import DriveState
from protocols.cia402.faults import NOT_ARMED, NOT_CONFIGURED, QUICK_STOPPED
from protocols.cia402.objects import OBJECTS, from_bytes
from protocols.cia402.requests import Pending
from protocols.cia402.scanning import Scanner, describe
from protocols.cia402.sync import SECOND_PRODUCER, HostProducer, check_agreement
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plugin import Device, Range, RxCounters
from protocols.toolkit.requests import RejectionFilter, RequestQueue, out_of_range, refusal

PDO_IDS = range(0x180, SDO_TX_BASE)
OFFLINE = "no frames received"


class Cia402Driver:
    """All CiA 402 drives of one bus. Plain data. ValueError if they do not agree on SYNC and host."""

    def __init__(self, devices: Sequence[Device], ranges: Mapping[str, Mapping[str, Range]]) -> None:
        """`ranges`: by the device's name."""
        check_agreement(devices)
        self.counters = RxCounters()
        self.drives = {
            device.address: DriveState(device.name, device.address, device.options) for device in devices
        }
        self._all = list(self.drives.values())
        self._by_name = {drive.name: drive for drive in self._all}
        self._ranges = {name: dict(table) for name, table in ranges.items()}
        synced = [drive.options for drive in self._all if drive.options.feedback == "sync"]
        host = self._all[0].options.host_id if self._all else 0
        self.producer = HostProducer(synced[0].sync_ms * MILLISECOND if synced else 0, host)
        self._pending: RequestQueue[Pending] = RequestQueue()
        self._scan: Scanner | None = None
        self._token = 0
        self._events: list[Event] = []
        """Events outside `send`, to be returned by the next one."""
        self._rejections = RejectionFilter()

    # -- receiving ----------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Handle a frame; [] for one that is not of this driver's devices."""
        if not isinstance(frame, CanFrame) or not codec.is_classic(frame):
            self.counters.ignored += 1
            return []
        function, address = frame.id & ~NODE_MASK, frame.id & NODE_MASK
        drive = self.drives.get(address)
        if drive is None:
            return self._on_foreign(t, function, address, frame)
        if function == SDO_TX_BASE:
            return self._on_sdo(t, drive, frame)
        if function in (EMCY_BASE, HEARTBEAT_BASE):
            return self._on_message(t, drive, frame)
        if frame.id in PDO_IDS and frame.id & 0x80:
            return self._counted(drive.on_tpdo(t, frame.id, frame.data))
        self.counters.ignored += 1
        return []

    def _counted(self, events: list[Event] | None) -> list[Event]:
        if events is None:
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        return events

    def _on_message(self, t: Nanos, drive: DriveState, frame: CanFrame) -> list[Event]:
        match codec.decode(frame):
            case codec.Heartbeat() as beat:
                events = drive.on_heartbeat(t, beat)
                return self._counted(events + duplicate_address.check_heartbeats(t, drive))
            case codec.Emcy() as emcy:
                return self._counted(drive.on_emcy(t, emcy))
        return self._counted(None)

    def _on_foreign(self, t: Nanos, function: int, address: int, frame: CanFrame) -> list[Event]:
        """Handle a frame of a node that is not in the robot file, for a scan; or SYNC, which is of no
        node."""
        if frame.id == SYNC_ID and isinstance(codec.decode(frame), codec.Sync):
            return self._on_sync(t)
        scan = self._scan if function == SDO_TX_BASE else None
        response = sdo.decode_response(frame.data) if scan is not None else None
        if scan is not None and response is not None and scan.receive(t, address, response):
            self.counters.accepted += 1
        else:
            self.counters.ignored += 1
        return []

    def _on_sdo(self, t: Nanos, drive: DriveState, frame: CanFrame) -> list[Event]:
        response = sdo.decode_response(frame.data)
        if response is None:
            return self._counted(None)
        self.counters.accepted += 1
        drive.received(t)
        outcome = drive.client.handle(response)
        events = self._on_outcome(t, drive, outcome) if outcome is not None else []
        return events + duplicate_address.check_responses(t, drive)

    def _on_sync(self, t: Nanos) -> list[Event]:
        """Handle another producer's SYNC: ignored while this host produces none, else reported once."""
        if self.producer.sync_next is None:
            self.counters.ignored += 1
            return []
        reported, self.producer.second_producer_reported = self.producer.second_producer_reported, True
        found = msg.Found(t, "cia402", 0, detail=SECOND_PRODUCER, duplicate_address=True)
        return self._counted([] if reported else [found])

    # -- SDO transfers that ended -----------------------------------------------------------------

    def _on_outcome(self, t: Nanos, drive: DriveState, outcome: Outcome) -> list[Event]:
        job, abort = outcome.job, outcome.abort
        match job.purpose:
            case Purpose.STARTUP if not outcome.timed_out or job.key == o.DEVICE_NAME:
                return drive.on_read(t, job.key, outcome.value, abort)
            case Purpose.POLL if abort is None:
                value = from_bytes(OBJECTS[job.key].type, outcome.value)
                return drive.take(t, {job.key: value}) if value is not None else []
            case Purpose.POLL if not outcome.timed_out and job.key not in (o.STATUSWORD, o.POSITION):
                drive.absent.add(job.key)
            case Purpose.SETUP:
                return self._on_setup(t, drive, outcome)
            case Purpose.SETPOINT if abort is None and job.data is not None:
                drive.writer.confirm(t, job.key, from_bytes(OBJECTS[job.key].type, job.data) or 0)
                drive.rounds += 1
            case Purpose.REQUEST:
                return self._on_request(t, job.token, outcome)
            case Purpose.IDENTITY_CHECK if abort is None:
                return duplicate_address.on_identity(t, drive, outcome)
        return []

    def _on_setup(self, t: Nanos, drive: DriveState, outcome: Outcome) -> list[Event]:
        if outcome.timed_out:  # what it has accepted is unknown: all of it again
            drive.setup, drive.pdos_to_write, drive.configured = None, (), False
            return []
        allowed = configuring.on_written(drive, outcome.job, outcome.abort)
        if allowed or drive.stop_demand is not None:
            return []
        drive.arming_failed, drive.setup = True, None
        cause = f"{o.title(outcome.job.key)}: {sdo.abort_text(outcome.abort or 0)}"
        return drive.report_fault(t, NOT_CONFIGURED, cause)

    def _on_request(self, t: Nanos, token: int, outcome: Outcome) -> list[Event]:
        for pending in self._pending:
            if pending.token == token:
                events = requests.on_outcome(pending, t, outcome)
                if events:
                    self._pending.end(pending)
                return events
        return []

    # -- the bus ------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """Handle a change of the bus: frames may have been lost, devices may have restarted."""
        if state is BusState.FULL:
            for drive in self._all:
                drive.writer.forget()
        if state not in (BusState.GONE, BusState.OFF, BusState.BACK):
            return
        for drive in self._all:
            drive.forget()
        self.producer.second_producer_reported = False
        if state is not BusState.BACK:
            self._events += self._pending.refuse_all(t, f"the bus is {state}")
            if self._scan is not None:
                self._events.append(msg.Refused(t, msg.Scan.__name__, self._scan.bus, f"the bus is {state}"))
                self._scan = None

    # -- sending ------------------------------------------------------------------------------

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Encode the messages, then what is due: requests, SDO transfers, stops, SYNC and heartbeat."""
        events, self._events = self._events, []
        frames: list[Frame] = []
        for message in messages:
            if isinstance(message, msg.Stop):
                for drive in self._all:
                    drive.owned = True
            elif not isinstance(message, Command):
                events += self._begin_request(now, message)
        at_sync = self.producer.at_sync(now)
        for message in messages:
            if isinstance(message, Command):
                frames += self._command(now, message, at_sync, events)
        commanded = bool(frames)
        frames += self._poll_requests(now, events)
        for drive in self._all:
            frames += self._tend(now, drive, events)
        frames += self.producer.sync(now, self._all, commanded)
        frames += self.producer.heartbeat(now, self._all)
        return events, frames

    def _command(self, now: Nanos, command: Command, at_sync: bool, events: list[Event]) -> list[CanFrame]:
        drive = self._by_name.get(command.motor)
        reason = "no such motor on this bus" if drive is None else self._why_refused(drive, command)
        events += self._rejections.filter(now, command, reason)
        return [] if drive is None or reason else motion.apply(drive, now, command, at_sync)

    def _why_refused(self, drive: DriveState, command: Command) -> str:
        """Return why a command must not be sent; "" if it may."""
        if isinstance(command, msg.Impedance):
            return "the profile has no impedance control"
        return out_of_range(command, self._ranges[drive.name]) or motion.why_impossible(drive, command)

    def _tend(self, now: Nanos, drive: DriveState, events: list[Event]) -> list[Frame]:
        """Do what is due for a device without a command."""
        if drive.known_since is None:
            drive.known_since = now
        if not drive.offline and now >= drive.offline_at:
            drive.forget()
            drive.offline, drive.reported = True, (Mode.OFFLINE, OFFLINE)
            events.append(msg.State(drive.name, now, Mode.OFFLINE, OFFLINE))
        failure = motion.arming_timeout(drive, now)
        if failure:
            drive.arming_failed, drive.setpoints = True, {}
            drive.unarm()
            events += drive.report_fault(now, NOT_ARMED, failure)
        frames: list[Frame] = [*motion.repeat_stop(drive, now)]
        request, outcome = drive.client.poll(now)
        if outcome is not None:
            events += self._on_outcome(now, drive, outcome)
        if request is None:
            job = jobs.next_job(drive, now)
            if job is not None:
                drive.client.begin(job)
                request, _ = drive.client.poll(now)
        if request is not None:
            frames.append(CanFrame(codec.sdo_rx_id(drive.address), sdo.encode(request)))
        return frames

    # -- requests -----------------------------------------------------------------------------

    def _begin_request(self, now: Nanos, request: Request) -> list[Event]:
        drive = self._by_name.get(getattr(request, "motor", ""))
        begun: Pending | msg.Refused
        if isinstance(request, msg.Scan):
            return self._begin_scan(now, request)
        if full := self._pending.full():
            begun = refusal(now, request, full)
        elif drive is None:
            begun = refusal(now, request, "cia402 cannot do this, or knows no such motor")
        else:
            self._token += 1
            begun = requests.begin(now, request, drive, self._token)
        refused = self._pending.add(begun)
        if isinstance(begun, Pending) and isinstance(request, msg.Estop):
            return begun.drive.report_fault(now, QUICK_STOPPED)
        return [*refused]

    def _poll_requests(self, now: Nanos, events: list[Event]) -> list[Frame]:
        frames: list[Frame] = []
        for pending in self._pending:
            ended, sent = requests.poll(pending, now)
            events += ended
            frames += sent
            if ended:
                self._pending.end(pending)
        if self._scan is not None:
            frames += self._scan.send(now)
            if self._scan.over(now):
                events += self._end_scan(now, self._scan)
                self._scan = None
        return frames

    def _begin_scan(self, now: Nanos, request: msg.Scan) -> list[Event]:
        if self._scan is not None:
            return [refusal(now, request, "a scan is under way")]
        self._scan = Scanner(request.bus, tuple(self.drives), now)
        return []

    def _end_scan(self, now: Nanos, scan: Scanner) -> list[Event]:
        found = [
            (drive.address, drive.duplicate_reported, describe(drive.read, drive.names))
            for drive in self._all
            if drive.received_at is not None and not drive.offline and o.DEVICE_TYPE in drive.read
        ]
        for address, known in sorted(scan.found.items()):
            found.append((address, address in scan.duplicates, describe(known)))
        events: list[Event] = [
            msg.Found(now, "cia402", address, serial, detail, duplicate_address=duplicate)
            for address, duplicate, (serial, detail) in found
        ]
        return [*events, msg.Done(now, msg.Scan.__name__, scan.bus, f"{len(events)} devices")]

    # -- when ---------------------------------------------------------------------------------

    def due(self) -> Nanos | None:
        """Return when `send` next has something to do without a message."""
        times = [self._due_of(drive) for drive in self._all]
        times += self._pending.due()
        times += [self._scan.due()] if self._scan is not None else []
        times += [self.producer.sync_next] if self.producer.sync_next is not None else []
        return min(times, default=None)

    @staticmethod
    def _due_of(drive: DriveState) -> Nanos:
        if drive.known_since is None:
            return 0
        response = drive.client.due()
        due = jobs.due(drive) if response is None else response
        if drive.stop_demand is not None:
            due = min(due, drive.stop_next)
        if drive.arming_since is not None and not drive.arming_failed:
            due = min(due, drive.arming_since + drive.options.state_timeout_ms * MILLISECOND)
        return due if drive.offline else min(due, drive.offline_at)
