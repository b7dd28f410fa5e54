"""The host's end of a plain line: what a motor is sent in each phase, and what devices report.

Rules. Any command arms a motor, which needs no other message for it, and holds by itself where it is. Each
request goes out once, and is answered by its device, or refused after `ANSWER`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Request
from protocols.plain import table
from protocols.plugin import Device
from protocols.toolkit.host import Host, Report, Timing
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import subject
from protocols.toolkit.serial import Stream

ANSWER: Nanos = 200 * MILLISECOND
"""Timeout of a request, and how long a scan collects answers."""
OFFLINE: Nanos = 250 * MILLISECOND
"""Time without a message after which a motor is offline."""
MAX_FAULTS = 64
"""Codes of faults that are kept of a device."""
Faults = set[int]
"""Codes of the faults that a motor reported since it was not in fault."""


@dataclass(frozen=True, slots=True)
class Options:
    """Configuration of the driver."""

    kind: Literal["sensor", "motor"] = "sensor"
    """What the device is: it decides which messages are sent to it and accepted from it."""


class PlainAdapter(Adapter[Faults]):
    """What plain devices are sent, and what they report."""

    name = table.NAME
    blind = True
    needs_idle = ()

    def __init__(self) -> None:
        self._stream = Stream(table.FRAMING)

    def own(self, device: Device) -> Faults:
        return set()

    def timing(self, options: Options) -> Timing:
        return Timing(OFFLINE if options.kind == "motor" else NEVER)

    def interrupted(self) -> None:
        self._stream.drop()

    def forget(self, now: Nanos, host: Host[Faults]) -> None:
        host.own.clear()

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Faults]) -> Sequence[Report[Faults] | Rx]:
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        reports: list[Report[Faults] | Rx] = []
        for each in self._stream.feed(frame):
            report = self._report(t, each, driver) if isinstance(each, bytes) else each
            reports.append(report)
        return reports

    def _report(self, t: Nanos, message: bytes, driver: MotorDriver[Faults]) -> Report[Faults] | Rx:
        address = message[table.ADDRESS]
        host = driver.at.get(address)
        event = table.decode(message, t, host.name if host else "")
        if isinstance(event, msg.Feedback) and host and host.options.kind == "motor":
            return Report(host, address, feedback=event)
        if isinstance(event, msg.Found) and (event.protocol, event.address) == (table.NAME, address):
            return Report(host, address, serial=event.serial, note=event.detail)
        # A command towards the host is an echo (RS-485); an unknown address is not ours.
        if host is not None and host.options.kind == "sensor" and isinstance(event, msg.Measurement):
            return Report(host, address, events=(event,))
        if host is None or isinstance(event, Command | Request):
            return Rx.IGNORED
        if host.options.kind == "sensor":
            return Rx.MALFORMED
        match event:
            case msg.State(_, _, mode, detail):
                if mode is not Mode.FAULT:
                    host.own.clear()
                return Report(host, address, mode, detail)
            case msg.Fault(_, _, code):
                known = code in host.own or len(host.own) >= MAX_FAULTS
                host.own.update(() if known else (code,))
                return Report(host, address, events=() if known else (event,))
            case msg.Done() | msg.Refused() | msg.Parameter():
                return Report(host, address, content=[event])
        return Rx.MALFORMED

    # -- sent -----------------------------------------------------------------------------------------

    def refuse(self, host: Host[Faults], command: Command) -> str:
        return "" if host.options.kind == "motor" else "a sensor takes no commands"

    def command(self, now: Nanos, host: Host[Faults], command: Command) -> Sequence[Frame]:
        return (table.encode(host.address, command),)

    arm = command

    def release(self, now: Nanos, host: Host[Faults]) -> Sequence[Frame]:
        return self.command(now, host, msg.Idle(host.name)) if host.options.kind == "motor" else ()

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Faults] | None, driver: MotorDriver[Faults]
    ) -> Pending[Faults] | str:
        if host is not None and (host.options.kind != "motor" or not isinstance(request, table.TO_MOTOR)):
            return "a plain device cannot do that"
        try:
            frame = table.encode(host.address if host else table.BROADCAST, request)
        except ValueError as error:
            return str(error)
        return Pending(request, subject(request), now, now + ANSWER, now, host, (frame,), NEVER)

    def answer(self, t: Nanos, pending: Pending[Faults], report: Report[Faults]) -> Event | None:
        """Return what the device answered: one answer ends one request."""
        answers: list[msg.Done | msg.Refused | msg.Parameter] = report.content or []
        for each in answers:
            asked = "ReadParameter" if isinstance(each, msg.Parameter) else each.request
            if asked == type(pending.request).__name__:
                return answers.pop()
        return None
