"""The driver of all devices of one protocol on one bus: receiving, commands, requests, polling, silence.

Rules. A protocol gives an `Adapter`, which translates frames into `Report`s, and knows what is sent in each
phase; all else that a driver needs is here and in `host`. A command is sent in the step in which it is
given, or never. Every request has exactly one answer, at its deadline at the latest.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from math import isclose, nan
from typing import Any, Generic, TypeVar

from protocols import messages as msg
from protocols.frames import BusState, Frame
from protocols.line import Exchange
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plugin import Device, FaultInfo, Range, RxCounters
from protocols.toolkit import requests as rq
from protocols.toolkit.duplicates import SerialNumbers
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.requests import Pending as Pending  # protocols take it from here

Own = TypeVar("Own")
NEVER: Nanos = 1 << 62
ARMED = "it is armed: command Idle first"
LISTENED: Nanos = 1000 * MILLISECOND
"""For how long it is made sure that nobody has an address yet, before it is given to a device."""
TAKEN: Nanos = 2500 * MILLISECOND
"""Time in which the device must be given it, and be heard there."""


class Rx(Enum):
    """A frame, or a message of a stream, that reports nothing."""

    IGNORED = "of another device or protocol"
    MALFORMED = "of one of our devices, but with wrong content"
    EXPECTED = "of no device of ours, as an answer to a scan"


class Adapter(Generic[Own]):
    """What a protocol adds to `MotorDriver`. One object for each driver; plain data."""

    name: str
    faults: Mapping[int, FaultInfo] = {}
    not_armed: int = 0
    """Code of the fault of a device that does not arm in time; 0: it has none."""
    duplicate: int = 0
    """Code of the fault of a device whose address another one has too."""
    unaddressed: int | None = None
    """The address that all devices share which have none yet."""
    latch: bool = False
    """A fault stays until ClearFault, whatever the device reports."""
    blind: bool = False
    """A device is commanded before its mode and position are known: it holds by itself where it is."""
    needs_idle: tuple[type[Request], ...] = (msg.Zero, msg.Reboot, msg.WriteParameter)
    """Requests that are refused while a device is, or may be, armed."""
    clearing_disarms: bool = False
    """What clears faults disarms a device, too: it is not sent to one that is armed and has none."""
    clearing: Nanos = 0
    """Time for ClearFault: in it, faults that pass by themselves must have passed. 0: see `begin`."""
    confirmations: int = 2
    """Reports that it is disarmed which end a release,"""
    releasing: Nanos = 20 * MILLISECOND
    """and the period of Idle until then."""
    arming: Nanos = 1000 * MILLISECOND
    """Time after which a device that does not arm is a fault."""
    zero_tolerance: float = 0.01
    """rad within which the position is zero after Zero"""
    restarted: Nanos = 0
    """Silence that shows that a device has restarted, for Reboot; 0: see `answer`."""
    set_id_detail: str = ""
    """What is still to be done when a device has taken its new address."""
    set_address_detail: str = ""
    """The same, where it was not told by its serial number."""
    addresses: range = range(0)
    """Of all devices"""

    # -- devices and received frames ------------------------------------------------------------------

    def own(self, device: Device) -> Own:
        """Return what the protocol itself records of a device."""
        raise NotImplementedError

    def timing(self, options: Any) -> Timing:  # noqa: ANN401 -- the protocol's own type
        """Return the periods and timeouts of a device."""
        offline = round(options.offline_ms * MILLISECOND)
        return Timing(offline, self.releasing, self.confirmations, self.arming)

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Own]) -> Sequence[Report[Own] | Rx]:
        """Return what a frame (on a stream: each message that it completes) reports."""
        raise NotImplementedError

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Own]
    ) -> Sequence[Report[Own] | Rx]:
        """Return what the answer to an exchange reports. Here: what `receive` makes of its bytes alone."""
        reports = self.receive(t, data, driver) if data else ()
        self.interrupted()  # what has no end is no beginning of the next answer
        return reports

    # -- commands -------------------------------------------------------------------------------------

    def refuse(self, host: Host[Own], command: Command) -> str:
        """Return why a device cannot take a command at all, "" if it can. (Ranges were checked.)"""
        return ""

    def ready(self, host: Host[Own]) -> bool:
        """True if enough is known of a device to command it."""
        return True

    def arm(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        """Return what brings a device nearer to being armed for this command, without moving it."""
        raise NotImplementedError

    def command(self, now: Nanos, host: Host[Own], command: Command) -> Sequence[Frame]:
        """Return the set-point of a command to an armed device (of Hold: at `host.held`)."""
        raise NotImplementedError

    def release(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        """Return what disarms a device; [] where that would clear its fault."""
        raise NotImplementedError

    def rest(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        """Return what stops a device that is given Idle, and is never armed: a sensor that was started."""
        return ()

    # -- by itself ------------------------------------------------------------------------------------

    def notice(self, now: Nanos, host: Host[Own]) -> Sequence[Event]:
        """Return what is noticed of a device without a frame of it."""
        return ()

    def poll(self, now: Nanos, host: Host[Own]) -> Sequence[Frame]:
        """Return the read-only frames that are due to one device."""
        return ()

    def poll_due(self, host: Host[Own]) -> Nanos:
        """Return when `poll` next has something to do that cannot wait for a step."""
        return NEVER

    def awaits(self, host: Host[Own]) -> bool:
        """True while an answer is awaited to which there is something to add at once."""
        return False

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        """Return the read-only frames that are due to all devices."""
        return ()

    def poll_bus_due(self) -> Nanos:
        """Return when `poll_bus` next has something to send."""
        return NEVER

    def why_silent(self, host: Host[Own]) -> str:
        """Return why a device is silent, if more is known of that."""
        return ""

    def forget(self, now: Nanos, host: Host[Own]) -> None:
        """Forget what is in `host.own` of a device that may have restarted: by its own `forget`, if any."""
        own: Any = host.own
        if hasattr(own, "forget"):
            own.forget()

    def interrupted(self) -> None:
        """Note that what the line was carrying is lost (on a stream: the rest of a message)."""

    def resend(self, host: Host[Own]) -> None:
        """Note that frames to a device may have been lost on our side."""

    # -- requests -------------------------------------------------------------------------------------

    def running(self, host: Host[Own]) -> bool:
        """True if a device is, or may be, armed."""
        return host.running

    def collected(self, pending: Pending[Own], driver: MotorDriver[Own]) -> Sequence[Report[Own]]:
        """Return, at the end of a scan, the devices that did not answer it, each with a note."""
        return ()

    def begin(
        self, now: Nanos, request: Request, host: Host[Own] | None, driver: MotorDriver[Own]
    ) -> Pending[Own] | str:
        """Begin a request (`host` None: for the bus), or return why it is refused: here all but ClearFault,
        if `clearing` is given, and Scan, if there are `questions`."""
        if isinstance(request, msg.ClearFault) and host is not None and self.clearing:
            return Pending(request, host.name, now, now + self.clearing, now, host)
        if isinstance(request, msg.Scan) and (questions := tuple(self.questions(driver))):
            return rq.scan(now, request, questions)
        return "the device cannot do that on this bus"

    def readdress(self, host: Host[Own], address: int) -> Sequence[Frame]:
        """Return what gives a device another address; (): it cannot be given one. Sent once."""
        return ()

    def ask_at(self, address: int) -> Sequence[Frame]:
        """Return the read-only frames that are answered by who is at an address; () if there are none, and a
        device is heard unasked."""
        return ()

    def questions(self, driver: MotorDriver[Own]) -> Iterable[Frame]:
        """Return the read-only frames to all addresses, by which a scan finds devices."""
        return ()

    def frames(self, now: Nanos, pending: Pending[Own]) -> Sequence[Frame]:
        """Return what is sent for a request now."""
        return pending.slice() if pending.at_once else pending.frames

    def answer(self, t: Nanos, pending: Pending[Own], report: Report[Own]) -> Event | None:
        """Return the answer to a request, if this report of its device is one: what was asked for is so."""
        feedback = report.feedback
        position = feedback.position if feedback is not None else None
        match pending.request:
            case msg.ClearFault() if report.mode not in (None, Mode.FAULT):
                return pending.done(t)
            case msg.Estop() if report.mode is Mode.FAULT:
                return pending.done(t, "it stays in fault until cleared")
            case msg.Zero() if position is not None and abs(position) < self.zero_tolerance:
                return pending.done(t)
            case msg.Reboot() if self.restarted and pending.restarted(t, self.restarted):
                return pending.done(t, "it has restarted")
            case msg.ReadParameter(_, name) if name in report.parameters and report.written != name:
                return msg.Parameter(pending.name, t, name, float(report.parameters[name]))
            case msg.WriteParameter(_, name, value):
                read_back = isclose(report.parameters.get(name, nan), value, rel_tol=1e-6)
                return pending.done(t) if report.written == name or read_back else None
        return None

    def give_up(self, now: Nanos, pending: Pending[Own]) -> str:
        """Return why a request was not carried out by its deadline."""
        host = pending.host
        if isinstance(pending.request, msg.SetAddress):
            return f"it was sent, and nothing is heard at address {pending.request.address}"
        if isinstance(pending.request, msg.SetId):
            return f"no device with serial number {pending.request.serial:X} took the address"
        if host is None or host.received_at is None or host.received_at <= pending.began:
            return "no reply of the device"
        if isinstance(pending.request, msg.ClearFault):
            names = [host.faults[code].name for code in sorted(host.active)]
            host.report_again()
            return f"still in fault: {', '.join(names)}"
        if isinstance(pending.request, msg.Reboot) and self.restarted:
            return "it showed no sign of a restart"
        if isinstance(pending.request, msg.Zero):
            return "its position did not become zero: is it turning?"
        return "no reply to this request"


def _lacks(host: Host[Any], address: int) -> bool:
    """True if a motor does not answer at this address, its own: it may have none yet."""
    return host.offline and address == host.address


def first_address(pending: Pending[Any]) -> bool:
    """True for a request to give a device the address that its motor has in the file: it has none yet."""
    return pending.host is not None and getattr(pending.request, "address", None) == pending.host.address


def may_scan(device: Device | Host[Any]) -> bool:
    """True if a device's option `scan`, where it has one, does not switch scans of its bus off."""
    return bool(getattr(device.options, "scan", True))


class MotorDriver(Generic[Own]):
    """All devices of a protocol on one bus."""

    def __init__(
        self, adapter: Adapter[Own], devices: Sequence[Device], ranges: Mapping[str, Mapping[str, Range]]
    ) -> None:
        """`ranges`: by device, as in its `Spec`."""
        self.counters = RxCounters()
        self.adapter = adapter
        faults, latch = adapter.faults, adapter.latch
        self.hosts = {
            each.name: Host(each, adapter.own(each), adapter.timing(each.options), faults, latch=latch)
            for each in devices
        }
        self.at = {host.address: host for host in self.hosts.values()}
        """The devices by address."""
        self.queue: rq.RequestQueue[Own] = rq.RequestQueue()
        self.serials = SerialNumbers(adapter.name)
        self._bounds = {
            name: {kind: rq.bounds_of(kind, of) for kind in msg.COMMANDS} for name, of in ranges.items()
        }
        self._rejections = rq.RejectionFilter()
        self._events: list[Event] = []
        """Events from outside `send`, to be returned by the next one."""

    # -- receiving ------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> Sequence[Event]:
        """Decode a frame; [] for foreign ones."""
        events: list[Event] = []
        for report in self.adapter.receive(t, frame, self):
            events += self._on_report(t, report) if isinstance(report, Report) else self._count(report)
        return events

    def answer(self, t: Nanos, asked: Exchange, data: bytes) -> Sequence[Event]:
        """Decode what came as answer to an exchange."""
        events: list[Event] = []
        for report in self.adapter.heard(t, asked, data, self):
            events += self._on_report(t, report) if isinstance(report, Report) else self._count(report)
        return events

    def _count(self, received: Rx) -> Sequence[Event]:
        self.counters.add(
            accepted=received is Rx.EXPECTED,
            malformed=received is Rx.MALFORMED,
            ignored=received is Rx.IGNORED,
        )
        return ()

    def _on_report(self, t: Nanos, report: Report[Own]) -> list[Event]:
        host = report.host
        ours = host is not None or report.serial is not None or bool(report.events)
        if count := report.messages:
            self.counters.add(accepted=count * ours, ignored=count * (not ours))
        events = [*report.events] if host is None else host.on_report(t, report)
        cause = report.duplicate
        if report.serial is not None and report.address != self.adapter.unaddressed:
            cause = self.serials.add(t, report.address, report.serial) or cause
        if cause:
            events += self._on_duplicate(t, report, cause)
        for pending in self.queue.waiting:
            if isinstance(pending.request, msg.SetAddress) and not first_address(pending):
                events += self._on_address(t, pending, pending.request, report)
            elif pending.host is None:
                events += self._on_found(t, pending, report)
            elif pending.host is host and pending.sent:
                answer = self.adapter.answer(t, pending, report)
                events += self._end(t, pending, answer) if answer is not None else []
        return events

    def _end(self, t: Nanos, pending: Pending[Own], answer: Event) -> list[Event]:
        self.queue.end(pending)
        cleared = isinstance(pending.request, msg.ClearFault) and isinstance(answer, msg.Done)
        return [*(pending.host.cleared(t) if cleared and pending.host is not None else ()), answer]

    def _on_duplicate(self, t: Nanos, report: Report[Own], cause: str) -> list[Event]:
        events = self.serials.report(t, report.address, cause)
        if events and self.adapter.duplicate and report.host is not None:
            name = f"duplicate address {report.address}"
            remedy = "take one off the bus, or give it another address (SetId with its serial number)"
            events.append(msg.Fault(report.host.name, t, self.adapter.duplicate, name, cause, remedy))
        return events

    def _on_found(self, t: Nanos, pending: Pending[Own], report: Report[Own]) -> list[Event]:
        """Report a device that a scan has not found yet, or that took the address that it was given."""
        request, address, serial = pending.request, report.address, report.serial
        if isinstance(request, msg.SetId):
            if (request.serial, request.address) != (serial, address):
                return []
            self.queue.end(pending)
            return [pending.done(t, self.adapter.set_id_detail)]
        known = any(other == address for other, _ in pending.found)
        if (serial is None and (known or not report.note)) or (address, serial) in pending.found:
            return []
        duplicate = known and address != self.adapter.unaddressed
        detail = ", ".join(filter(None, (report.host.name if report.host else "", report.note)))
        pending.found.update({(address, serial): detail})
        return [msg.Found(t, self.adapter.name, address, serial, detail, duplicate)]

    def _on_address(
        self, t: Nanos, pending: Pending[Own], request: msg.SetAddress, report: Report[Own]
    ) -> list[Event]:
        """Return whether the device has taken its new address, if this is heard from there."""
        if report.address != request.address or report.host is pending.host:
            return []
        self.queue.end(pending)
        if "given" not in pending.notes:
            return [pending.refuse(t, f"another device has address {request.address}")]
        return [pending.done(t, self.adapter.set_address_detail)]

    def _give_address(self, now: Nanos, request: msg.SetAddress, host: Host[Own]) -> Pending[Own] | str:
        """Begin to give a device another address, or return why it cannot be given this one."""
        address, addresses = request.address, self.adapter.addresses
        if addresses and address not in addresses:
            return f"{address} is not an address: {addresses.start} to {addresses.stop - 1}"
        if not addresses or not self.adapter.readdress(host, address):
            return "the device cannot be given an address on this bus"
        if address == host.address:
            return f"it answers at {address} already"
        if address in self.at:
            return f"address {address} is that of {self.at[address].name}"
        if self.adapter.running(host):
            return ARMED
        if not may_scan(host):
            return "it cannot be seen whether the address is free (scan = false)"
        return Pending(request, host.name, now, now + LISTENED + TAKEN, now, host)

    def _address_frames(self, now: Nanos, pending: Pending[Own], request: msg.SetAddress) -> Sequence[Frame]:
        """Ask who is at the new address; once nobody has answered for a while, give it to the device."""
        if now - pending.began < LISTENED or pending.host is None:
            return self.adapter.ask_at(request.address)
        if "given" not in pending.notes:
            pending.notes.update(given=[*self.adapter.readdress(pending.host, request.address)])
        left = pending.notes["given"]  # one after the other: a device may need its time with each
        return (left.pop(0),) if left else self.adapter.ask_at(request.address)

    def scanning(self, address: int = -1) -> bool:
        """True while a scan is under way, or while this address is given to a device: a stranger's answer is
        one to us."""
        return any(
            isinstance(pending.request, msg.Scan) or getattr(pending.request, "address", None) == address
            for pending in self.queue.waiting
        )

    def wrong_id(self, request: msg.SetId, addresses: range, bits: int) -> str:
        """Return why no device can be given this address, "" if one can; `bits`: of a serial number."""
        address, serial, known = request.address, request.serial, self.serials
        if address not in addresses:
            return f"{address} is not an address: {addresses.start} to {addresses.stop - 1}"
        if not 0 < serial < 1 << bits:
            return f"{serial} is not a serial number of {bits} bits"
        if others := known.at(address) - {serial}:
            return f"address {address} is held by serial number {min(others):X}"
        for host in self.hosts.values():
            concerned = serial in known.at(host.address) or host.address == address
            if concerned and self.adapter.running(host):
                return f"{host.name}: {ARMED}"
        return ""

    # -- the bus --------------------------------------------------------------------------------------

    def bus(self, t: Nanos, state: BusState) -> None:
        """Send anew what may have been lost; forget devices that may have restarted."""
        if state in (BusState.GONE, BusState.OFF, BusState.BACK):
            self.adapter.interrupted()
        for host in self.hosts.values():
            if state in (BusState.GONE, BusState.OFF, BusState.BACK):
                host.forget(t)
                self.adapter.forget(t, host)
            elif state is BusState.FULL:
                host.resend(t)
                self.adapter.resend(host)
        if state in (BusState.GONE, BusState.OFF):
            self._events += self.queue.refuse_all(t, f"the bus is {state}")

    # -- sending --------------------------------------------------------------------------------------

    def send(
        self, now: Nanos, messages: Sequence[Command | Request]
    ) -> tuple[Sequence[Event], Sequence[Frame]]:
        """Send requests, then commands, then what disarms, then what is polled."""
        events, self._events = self._events, []
        frames: list[Frame] = []
        commands: list[Command] = []
        for message in messages:
            if isinstance(message, Command):
                commands.append(message)
            elif isinstance(message, msg.Stop):
                for host in self.hosts.values():
                    host.own_unasked()
            else:
                events += self.queue.add(self._begin(now, message))
        if self.queue.waiting:
            self._send_requests(now, events, frames)
        for command in commands:
            frames += self._command(now, command, events)
        for host in self.hosts.values():
            silent = host.check_silence(now, self.adapter.why_silent(host))
            if silent:
                self.adapter.forget(now, host)
                events += silent
            events += self.adapter.notice(now, host)
            if host.phase is Phase.RELEASING and host.release_due(now):
                frames += self.adapter.release(now, host)
            frames += self.adapter.poll(now, host)
        frames += self.adapter.poll_bus(now)
        return events, frames

    def _command(self, now: Nanos, command: Command, events: list[Event]) -> Sequence[Frame]:
        host = self.hosts.get(command.motor)
        if host is None:
            events += self._rejections.filter(now, command, "no such motor on this bus")
            return ()
        if isinstance(command, msg.Idle):
            host.on_idle(now)
            return self.adapter.rest(now, host)
        bounds = self._bounds[host.name][type(command)]
        reason = self.adapter.refuse(host, command) or rq.outside(command, bounds)
        if reason or self._rejections.reported:
            events += self._rejections.filter(now, command, reason)
        known = self.adapter.blind or (host.mode is not None and host.position is not None)
        if reason or not known or not self.adapter.ready(host):
            return ()
        phase = host.on_command(now, hold=isinstance(command, msg.Hold))
        if phase is Phase.ARMED:
            return self.adapter.command(now, host, command)
        if phase is not Phase.ARMING:
            return ()
        if self.adapter.not_armed and host.overdue(now):
            events += host.trip(now, self.adapter.not_armed)
            return ()
        return self.adapter.arm(now, host, command)

    def _begin(self, now: Nanos, request: Request) -> Pending[Own] | msg.Refused | msg.Done:
        if full := self.queue.full():
            return rq.refusal(now, request, full)
        for_all = isinstance(request, msg.Scan | msg.SetId)
        host = None if for_all else self.hosts.get(rq.subject(request))
        if isinstance(request, msg.Scan) and not all(map(may_scan, self.hosts.values())):
            return rq.refusal(
                now, request, "switched off (scan = false): others on this bus would obey its questions"
            )
        if host is None and not for_all:
            return rq.refusal(now, request, f"{self.adapter.name} cannot do this, or knows no such motor")
        if host is not None and self.adapter.running(host) and isinstance(request, self.adapter.needs_idle):
            return rq.refusal(now, request, ARMED)
        clears = isinstance(request, msg.ClearFault) and self.adapter.clearing_disarms
        if host is not None and clears and host.sound:
            return msg.Done(now, type(request).__name__, host.name, "it is armed: nothing to clear")
        if host is not None and isinstance(request, msg.SetAddress) and not _lacks(host, request.address):
            begun = self._give_address(now, request, host)
        else:
            begun = self.adapter.begin(now, request, host, self)
        if isinstance(begun, str):
            return rq.refusal(now, request, begun)
        if host is not None and isinstance(request, msg.ClearFault):
            self.serials.clear(host.address)
        return begun

    def _send_requests(self, now: Nanos, events: list[Event], frames: list[Frame]) -> None:
        for pending in self.queue.expired(now):
            if isinstance(pending.request, msg.Scan):
                for report in self.adapter.collected(pending, self):
                    events += self._on_found(now, pending, report)
                count = len(pending.found)
                events.append(pending.done(now, f"{count} device{'' if count == 1 else 's'}"))
            else:
                events.append(pending.refuse(now, self.adapter.give_up(now, pending)))
        for pending in self.queue.waiting:
            if now >= pending.next:
                request, makes = pending.request, self.adapter.frames
                given = (
                    self._address_frames(now, pending, request)
                    if isinstance(request, msg.SetAddress) and not first_address(pending)
                    else makes(now, pending)
                )
                frames += pending.send(now, given)

    def due(self) -> Nanos | None:
        """Return when `send` next has something to do without a message."""
        if self._events:
            return 0
        times = self.queue.due()
        for host in self.hosts.values():
            times += host.due()
            times.append(self.adapter.poll_due(host))
        times.append(self.adapter.poll_bus_due())
        first = min(times)
        return first if first < NEVER else None

    def awaits(self) -> bool:
        """True while an answer is awaited to which there is something to add at once."""
        return any(self.adapter.awaits(host) for host in self.hosts.values())
