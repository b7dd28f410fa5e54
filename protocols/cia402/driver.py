"""The driver: our end of CANopen CiA 402, for all such drives of one bus.

Rules. No clock, no bus: time and frames are arguments, what is to be sent is returned. `receive` never raises
and learns nothing of a device from a host's frames (ours or another's). `Node` holds what is known of one
device, `motion` what a command takes, `requests` what is asked, `holders` who else has its node id; this file
deals out the frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.cia402 import configuring, holders, jobs, motion, requests, sdo
from protocols.cia402 import objects as o
from protocols.cia402.client import Outcome, Purpose
from protocols.cia402.codec import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    NODE_MASK,
    PROTOCOL,
    SDO_TX_BASE,
    SYNC_ID,
    Emcy,
    Heartbeat,
    Sync,
    decode,
    is_classic,
    sdo_rx_id,
)
from protocols.cia402.fault_reports import NOT_ARMED, NOT_CONFIGURED, QUICK_STOPPED
from protocols.cia402.node import Node
from protocols.cia402.requests import Pending
from protocols.cia402.scanning import Scanner, describe
from protocols.cia402.sync import DISTURBED, Pulse, agree
from protocols.frames import BusState, CanFrame, Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plugin import Device, Range, RxCounters
from protocols.request_queue import RejectionFilter, RequestQueue, out_of_range, refusal

PDO_IDS = range(0x180, SDO_TX_BASE)


class Cia402Driver:
    """All CiA 402 drives of one bus. Plain data. ValueError if they do not agree on what is the bus's own."""

    def __init__(self, devices: Sequence[Device], ranges: Mapping[str, Mapping[str, Range]]) -> None:
        """`ranges`: each device's, by its name."""
        agree(devices)
        self.counters = RxCounters()
        nodes = [Node(device.name, device.address, device.options) for device in devices]
        self.nodes = {node.address: node for node in nodes}
        self._all = nodes
        self._by_name = {node.name: node for node in nodes}
        self._ranges = {name: dict(table) for name, table in ranges.items()}
        synced = [node.options for node in nodes if node.options.feedback == "sync"]
        host = nodes[0].options.host_id if nodes else 0
        self.pulse = Pulse(synced[0].sync_ms * MILLISECOND if synced else 0, host)
        self._waiting: RequestQueue[Pending] = RequestQueue()
        self._scan: Scanner | None = None
        self._token = 0
        self._events: list[Event] = []
        """What happened outside `send`, to be told by the next one."""
        self._refusals = RejectionFilter()

    # -- hearing ------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """What a wire says; [] to what is not ours."""
        if not isinstance(frame, CanFrame) or not is_classic(frame):
            self.counters.ignored += 1
            return []
        function, address = frame.id & ~NODE_MASK, frame.id & NODE_MASK
        node = self.nodes.get(address)
        if node is None:
            return self._overhear(t, function, address, frame)
        if function == SDO_TX_BASE:
            return self._on_sdo(t, node, frame)
        if function in (EMCY_BASE, HEARTBEAT_BASE):
            return self._on_message(t, node, frame)
        if frame.id in PDO_IDS and frame.id & 0x80:
            events = node.on_tpdo(t, frame.id, frame.data)
            return self._counted(events)
        self.counters.ignored += 1
        return []

    def _counted(self, events: list[Event] | None) -> list[Event]:
        if events is None:
            self.counters.malformed += 1
            return []
        self.counters.accepted += 1
        return events

    def _on_message(self, t: Nanos, node: Node, frame: CanFrame) -> list[Event]:
        match decode(frame):
            case Heartbeat() as beat:
                events = node.on_beat(t, beat)
                return self._counted([*events, *holders.contradiction(t, node)])
            case Emcy() as emcy:
                return self._counted(node.on_emcy(t, emcy))
        return self._counted(None)

    def _overhear(self, t: Nanos, function: int, address: int, frame: CanFrame) -> list[Event]:
        """A node that is not in the robot file: only a scan listens to it. Node 0 is nobody: SYNC."""
        if frame.id == SYNC_ID and isinstance(decode(frame), Sync):
            return self._on_sync(t)
        answer = sdo.decode_answer(frame.data) if function == SDO_TX_BASE and self._scan is not None else None
        if answer is not None and self._scan is not None and self._scan.handle(t, address, answer):
            self.counters.accepted += 1
        else:
            self.counters.ignored += 1
        return []

    def _on_sdo(self, t: Nanos, node: Node, frame: CanFrame) -> list[Event]:
        answer = sdo.decode_answer(frame.data)
        if answer is None:
            return self._counted(None)
        self.counters.accepted += 1
        node.received(t)
        outcome = node.client.handle(answer)
        events = self._ended(t, node, outcome) if outcome is not None else []
        return events + holders.answered_twice(t, node)

    def _on_sync(self, t: Nanos) -> list[Event]:
        """Another producer's: nobody's business while we are none, else told once."""
        if self.pulse.next is None:
            self.counters.ignored += 1
            return []
        reported, self.pulse.disturbed = self.pulse.disturbed, True
        return self._counted(
            [] if reported else [msg.Found(t, PROTOCOL, 0, detail=DISTURBED, duplicate_address=True)]
        )

    # -- SDO transfers that ended -----------------------------------------------------------------

    def _ended(self, t: Nanos, node: Node, outcome: Outcome) -> list[Event]:
        job, abort = outcome.job, outcome.abort
        match job.purpose:
            case Purpose.READING if not outcome.silent or job.key == o.DEVICE_NAME:
                return node.on_read(t, job.key, outcome.value, abort)
            case Purpose.POLL if abort is None:
                value = jobs.polled(job.key, outcome.value)
                return node.take(t, {job.key: value}) if value is not None else []
            case Purpose.POLL if not outcome.silent and job.key not in (o.STATUSWORD, o.POSITION):
                node.absent.add(job.key)
            case Purpose.SETUP:
                return self._wrote(t, node, outcome)
            case Purpose.SETPOINT if abort is None and job.data is not None:
                node.outlet.confirm(t, job.key, jobs.polled(job.key, job.data) or 0)
                node.rounds += 1
            case Purpose.ASKED:
                return self._answered(t, job.token, outcome)
            case Purpose.ROLL_CALL if abort is None:
                return holders.on_serial(t, node, outcome)
        return []

    def _wrote(self, t: Nanos, node: Node, outcome: Outcome) -> list[Event]:
        if outcome.silent:  # nobody knows what it has taken: all of it again
            node.setup, node.writing, node.configured = None, (), False
            return []
        key = outcome.job.key
        if configuring.wrote(node, outcome.job, outcome.abort) or node.insist is not None:
            return []
        node.refused, node.setup = True, None
        said = f"{o.title(key)}: {sdo.abort_text(outcome.abort or 0)}"
        return node.complain(t, NOT_CONFIGURED, said)

    def _answered(self, t: Nanos, token: int, outcome: Outcome) -> list[Event]:
        for pending in self._waiting:
            if pending.token == token:
                events = requests.handle(pending, t, outcome)
                if events:
                    self._waiting.end(pending)
                return events
        return []

    # -- the bus ------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """The bus changed: forget what frames may have been lost, or devices may have restarted."""
        if state is BusState.FULL:
            for node in self._all:
                node.outlet.forget()
        if state not in (BusState.GONE, BusState.OFF, BusState.BACK):
            return
        for node in self._all:
            node.forget()
        self.pulse.disturbed = False
        if state is not BusState.BACK:
            self._events += self._waiting.drop(t, f"the bus is {state}")
            if self._scan is not None:
                self._events.append(msg.Refused(t, msg.Scan.__name__, self._scan.bus, f"the bus is {state}"))
                self._scan = None

    # -- saying -------------------------------------------------------------------------------

    def send(self, now: Nanos, words: Sequence[Command | Request]) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Say the words, then what falls due: set-points, requests, SDO transfers, SYNC and heartbeat."""
        events, self._events = self._events, []
        outgoing: list[Frame] = []
        for word in words:
            if isinstance(word, msg.Stop):
                for node in self._all:
                    node.owned = True
            elif not isinstance(word, Command):
                events += self._ask_for(now, word)
        steered = False
        at_sync = self.pulse.due_now(now)
        for word in words:
            if isinstance(word, Command):
                frames = self._command(now, word, at_sync, events)
                steered = steered or bool(frames)
                outgoing += frames
        outgoing += self._tend_requests(now, events)
        for node in self._all:
            outgoing += self._tend(now, node, events)
        outgoing += self.pulse.sync(now, self._all, steered)
        outgoing += self.pulse.beat(now, self._all)
        return events, outgoing

    def _tend(self, now: Nanos, node: Node, events: list[Event]) -> list[Frame]:
        """What falls due for a device by itself."""
        if node.started is None:
            node.started = now
        if not node.offline and now >= node.offline_at:
            node.forget()
            node.offline, node.reported = True, (Mode.OFFLINE, "nothing heard")
            events.append(msg.State(node.name, now, Mode.OFFLINE, "nothing heard"))
        stuck = motion.stuck(node, now)
        if stuck:
            node.refused, node.values = True, {}
            node.unarm()
            events += node.complain(now, NOT_ARMED, stuck)
        frames: list[Frame] = [*motion.insist(node, now)]
        request, outcome = node.client.say(now)
        if outcome is not None:
            events += self._ended(now, node, outcome)
        if request is None:
            job = jobs.next_job(node, now)
            if job is not None:
                node.client.begin(job)
                request, _ = node.client.say(now)
        if request is not None:
            frames.append(CanFrame(sdo_rx_id(node.address), sdo.encode(request)))
        return frames

    def _command(self, now: Nanos, command: Command, at_sync: bool, events: list[Event]) -> list[CanFrame]:
        node = self._by_name.get(command.motor)
        reason = "no such motor on this bus" if node is None else self._impossible(node, command)
        events += self._refusals.handle(now, command, reason)
        return [] if node is None or reason else motion.say(node, now, command, at_sync)

    def _impossible(self, node: Node, command: Command) -> str:
        """Why a command must not reach the wire; "" if it may."""
        if isinstance(command, msg.Impedance):
            return "the profile has no impedance control"
        return out_of_range(command, self._ranges[node.name]) or motion.possible(node, command)

    # -- requests -----------------------------------------------------------------------------

    def _ask_for(self, now: Nanos, request: Request) -> list[Event]:
        node = self._by_name.get(getattr(request, "motor", ""))
        begun: Pending | msg.Refused
        if isinstance(request, msg.Scan):
            return self._begin_scan(now, request)
        if full := self._waiting.full():
            begun = refusal(now, request, full)
        elif node is None:
            begun = refusal(now, request, f"{PROTOCOL} cannot do this, or knows no such motor")
        else:
            self._token += 1
            begun = requests.begin(now, request, node, self._token, node.holding)
        refused = self._waiting.add(begun)
        if isinstance(begun, Pending) and isinstance(request, msg.Estop):
            return begun.node.complain(now, QUICK_STOPPED)
        return [*refused]

    def _tend_requests(self, now: Nanos, events: list[Event]) -> list[Frame]:
        outgoing: list[Frame] = []
        for pending in self._waiting:
            ended, frames = requests.tend(pending, now)
            events += ended
            outgoing += frames
            if ended:
                self._waiting.end(pending)
        if self._scan is not None:
            outgoing += self._scan.say(now)
            if self._scan.over(now):
                events += self._end_scan(now, self._scan)
                self._scan = None
        return outgoing

    def _begin_scan(self, now: Nanos, request: msg.Scan) -> list[Event]:
        if self._scan is not None:
            return [refusal(now, request, "a scan is under way")]
        self._scan = Scanner(request.bus, tuple(self.nodes), now)
        return []

    def _end_scan(self, now: Nanos, scan: Scanner) -> list[Event]:
        events: list[Event] = []
        for node in self._all:
            if node.received_at is not None and not node.offline and o.DEVICE_TYPE in node.read:
                serial, detail = describe(dict(node.read), [node.name, *([node.title] if node.title else [])])
                events.append(
                    msg.Found(now, PROTOCOL, node.address, serial, detail, duplicate_address=node.doubled)
                )
        for address, known in sorted(scan.found.items()):
            serial, detail = describe(known)
            events.append(
                msg.Found(
                    now,
                    PROTOCOL,
                    address,
                    serial,
                    detail,
                    duplicate_address=address in scan.duplicate_address,
                )
            )
        return [*events, msg.Done(now, msg.Scan.__name__, scan.bus, f"{len(events)} devices")]

    # -- when ---------------------------------------------------------------------------------

    def due(self) -> Nanos | None:
        """When `send` next has something to do by itself."""
        times = [self._due_of(node) for node in self._all]
        times += self._waiting.due()
        times += [self._scan.due()] if self._scan is not None else []
        times += [self.pulse.next] if self.pulse.next is not None else []
        return min(times) if times else None

    @staticmethod
    def _due_of(node: Node) -> Nanos:
        if node.started is None:
            return 0
        own = node.client.due()
        due = jobs.due(node) if own is None else own
        if node.insist is not None:
            due = min(due, node.insist_next)
        if node.trying_since is not None and not node.refused:
            due = min(due, node.trying_since + node.options.state_timeout_ms * MILLISECOND)
        return due if node.offline else min(due, node.offline_at)
