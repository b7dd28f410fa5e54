"""The host's end: what a motor is sent in each phase, and what its answers report.

Rules. A motor that is not commanded is only read. Any set-point starts it, and no report says whether it
runs: the answer to a set-point says that it does, that to a shutdown that it does not, and a current that
flows although it was shut down that another host drives it. So a motor that has been commanded, and is not,
is shut down again every 50 ms. Before its first set-point its watchdog must have been confirmed, and its
brake be released, which is asked for whenever it may be locked. A running time that goes backwards is a
restart.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.myactuator import table as rmd
from protocols.myactuator.options import Options
from protocols.plugin import Device
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host, Phase, Report
from protocols.toolkit.mit import encoded
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.table import Values

CHECK: Nanos = 50 * MILLISECOND
"""Period of questions for faults and running time, and of what is written until it is confirmed."""
ZEROED: Nanos = 2 * SECOND
"""Time in which a motor is restarted, and reads zero."""
RESTARTED = "restarted"
SILENT: Nanos = 100 * MILLISECOND
"""Silence that shows that a motor which was told to is restarting."""
EARLIER = 500
"""ms by which the running time must go back to be that of a restart, not a late frame."""


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    idle_current: float
    """A"""
    answers: AnswerCount = field(default_factory=AnswerCount)
    last: dict[str, Nanos] = field(default_factory=dict)
    """When it was last written and checked"""
    errors: int | None = None
    """Its error state; None: not known yet"""
    driven: bool | None = None
    """It runs; None: not known since it was forgotten"""
    timeout: int | None = None
    """ms of its watchdog, as it confirmed it"""
    released: bool = False
    """Its brake is, and was not sent to lock since it reported so."""
    runtime: int = 0
    """ms"""

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.errors = self.driven = self.timeout = None
        self.released, self.runtime = False, 0

    def restarted(self, ms: int) -> bool:
        """Record its running time. True if it must have restarted since the last one."""
        back = (self.runtime - ms) % (1 << 32)
        if EARLIER < back < 1 << 31:
            self.forget()
            self.driven = False
        self.runtime = ms if not 0 < back <= EARLIER else self.runtime
        return EARLIER < back < 1 << 31

    def see(self, name: str, values: Values) -> None:
        """Record an answer."""
        match name:
            case "status 1":
                self.errors, self.released = values["errors"], bool(values["released"])
            case "status 2":
                self.driven = True if abs(values["current"]) > self.idle_current else self.driven
            case "shutdown reply":
                self.driven = False
            case "lock brake reply":
                self.released = False
            case "set timeout reply":
                self.timeout = values["value"]
            case "motion reply" | "stop reply" | "torque reply" | "speed reply" | "position reply":
                self.driven = True

    def lock(self) -> None:
        """Note that it is sent to lock its brake: what it reported before says nothing any more."""
        self.released = False

    def mode(self) -> Mode | None:
        """Return its mode; None: it is not known."""
        if self.errors:
            return Mode.FAULT
        if self.errors is None or self.driven is None:
            return None
        return Mode.ARMED if self.driven else Mode.READY

    def is_due(self, now: Nanos, what: str) -> bool:
        """True if it was not done for a time: it is done now."""
        due = now - self.last.get(what, -CHECK) >= CHECK
        self.last |= {what: now} if due else {}
        return due


def _radians(degrees: float, most: float) -> float | None:
    """Return an angle or velocity in radians; None at the end of its range, where it may be beyond."""
    return math.radians(degrees) if abs(degrees) <= most else None


NAMES = {Mode.FAULT: "error", Mode.ARMED: "driven", Mode.READY: "shut down"}


class RmdAdapter(Adapter[Motor]):
    """What motors are sent, and what they report."""

    name = "myactuator"
    faults, latch, blind = rmd.ALL_FAULTS, True, True
    not_armed, duplicate, clearing = rmd.NOT_ARMED, rmd.DUPLICATE, 2 * SECOND
    clearing_disarms = True
    addresses = rmd.ADDRESSES

    def own(self, device: Device) -> Motor:
        return Motor(device.options.idle_current)

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        decoded = rmd.ANY.decode(frame, "from_device")
        host = None if decoded is None else driver.at.get(decoded.address)
        if decoded is None or (
            host is None and not (decoded.name == "version" and driver.scanning(decoded.address))
        ):
            return (Rx.IGNORED,)
        if decoded.name == "motion reply" and host is not None:
            decoded = host.options.table.decode(frame, "from_device") or decoded
        name, address, values = decoded
        if not name or values.get("motor", address) != address:
            return (Rx.MALFORMED,)
        note = f"firmware of {values['date']}" if name == "version" else ""
        if host is None:
            return (Report(host, address, note=note),)
        own, many = host.own, host.own.answers.add(t)
        if name == "runtime" and own.restarted(values["ms"]):
            return (Report(host, address, Mode.READY, RESTARTED, duplicate=many),)
        own.see(name, values)
        mode = own.mode()
        if name == "angle":
            feedback = Feedback(host.name, t, _radians(values["position"], rmd.TURNS))
            return (Report(host, address, feedback=feedback, duplicate=many),)
        reported = mode if name not in ("runtime", "version", "set timeout reply") else None
        faults = rmd.faults_in(own.errors or 0) if name == "status 1" else None
        detail = NAMES[mode] if mode else ""
        if host.tripped and mode is None:  # it is back, and it is not known whether it runs
            reported, detail = Mode.FAULT, "not cleared yet"
        if host.phase is Phase.RELEASING and own.driven is not False and reported is not Mode.ARMED:
            reported = None  # an error may pass, and the motor go on: only a shutdown ends that
        measured = self._measured(t, host, name, values)
        return (Report(host, address, reported, detail, faults, measured, duplicate=many, note=note),)

    def _measured(self, t: Nanos, host: Host[Motor], name: str, values: Values) -> Feedback | None:
        options, motor = host.options, host.name
        if name == "motion reply":
            return Feedback(motor, t, None, values["velocity"], values["torque"])
        if name == "status 1":
            return Feedback(motor, t, voltage=values["voltage"], temperature=float(values["temperature"]))
        if "current" not in values or options.mode == "motion":
            return None
        velocity, temperature = _radians(values["velocity"], rmd.FASTEST), float(values["temperature"])
        current = values["current"] if abs(values["current"]) <= rmd.STRONGEST else None
        torque = None if current is None else current * options.torque_constant
        return Feedback(motor, t, None, velocity, torque, current, temperature=temperature)

    # -- sent -----------------------------------------------------------------------------------------

    def ready(self, host: Host[Motor]) -> bool:
        return host.position is not None and host.own.errors is not None

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        own, options, address = host.own, host.options, host.address
        frames: list[Frame] = []
        if options.timeout_ms and own.timeout != options.timeout_ms:
            frames.append(rmd.ANY.encode("set timeout", address, value=options.timeout_ms))
        frames += self._opening(host)
        if not frames:  # what starts it where it stands; a damper would jerk a shaft that turns
            by_torque = options.mode == "motion" or isinstance(command, msg.Torque)
            kind = msg.Torque if by_torque else msg.Velocity
            return own.answers.sent(now, (self._set_point(host, kind(host.name, 0.0)),))
        return own.answers.sent(now, frames) if own.is_due(now, "write") else ()

    def _opening(self, host: Host[Motor]) -> Sequence[Frame]:
        """Return what opens its brake, if it may be locked."""
        locked = host.options.brake and not host.own.released
        names = ("release brake", "read status 1") if locked else ()
        return [rmd.ANY.encode(name, host.address) for name in names]

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        opening = self._opening(host)  # a late frame may have locked it: a current does not open it
        opening = opening if opening and host.own.is_due(now, "write") else ()
        read = rmd.ANY.encode("read angle", host.address)
        return host.own.answers.sent(now, (*opening, self._set_point(host, command), read))

    def _set_point(self, host: Host[Motor], command: Command) -> Frame:
        options: Options = host.options
        address = host.address
        if options.mode == "motion":
            goal = options.gains.impedance(command, host.held)
            return encoded(options.table.encoder("motion"), address, goal)
        match command:
            case msg.Torque(_, torque):
                return rmd.ANY.encode("torque", address, value=torque / options.torque_constant)
            case msg.Velocity(_, velocity):
                return rmd.ANY.encode("speed", address, value=math.degrees(velocity))
        held = host.position if host.held is None else host.held
        position: Any = getattr(command, "position", held)
        return rmd.ANY.encode("position", address, fastest=options.fastest, position=math.degrees(position))

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        names = ("shutdown", "lock brake") if host.options.brake else ("shutdown",)
        host.own.lock()
        return host.own.answers.sent(now, [rmd.ANY.encode(name, host.address) for name in names])

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        names: list[str] = []
        own = host.own
        if now - own.answers.sent_at >= host.options.feedback_ms * MILLISECOND:
            names += ["read angle", "read status 2"]
        if own.is_due(now, "check"):
            names += ["read status 1", "read runtime"]
            names += ["shutdown"] if host.once_commanded and host.phase is Phase.FREE else []
        return own.answers.sent(now, [rmd.ANY.encode(name, host.address) for name in names])

    def poll_due(self, host: Host[Motor]) -> Nanos:
        asked: Nanos = host.own.answers.sent_at + host.options.feedback_ms * MILLISECOND
        return min(asked, host.own.last.get("check", -CHECK) + CHECK)

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Motor]) -> Iterable[Frame]:
        return (rmd.ANY.encode("read version", at) for at in rmd.ADDRESSES)

    def ask_at(self, address: int) -> Sequence[Frame]:
        return (rmd.ANY.encode("read version", address),)

    def readdress(self, host: Host[Motor], address: int) -> Sequence[Frame]:
        # Where a motor takes it when it is restarted, it still has the old one.
        return rmd.ANY.encode("set id", host.address, id=address), rmd.ANY.encode("reset", host.address)

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if isinstance(request, msg.Zero) and host is not None:
            return Pending(request, host.name, now, now + ZEROED, now, host)
        return super().begin(now, request, host, driver)

    def answer(self, t: Nanos, pending: Pending[Motor], report: Report[Motor]) -> msg.Event | None:
        if isinstance(pending.request, msg.Zero):
            silent = pending.restarted(t, SILENT)  # of a motor that was just switched on, it is all there is
            if silent or report.detail == RESTARTED:
                pending.notes.update(back=True)
            if "back" not in pending.notes:
                return None
        return super().answer(t, pending, report)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        host = pending.host
        if host is None:
            return pending.slice()
        if isinstance(pending.request, msg.Zero):  # kept in the ROM, which wears out: once
            zero = rmd.ANY.encode("zero here", host.address, value=0)
            return () if pending.sent else (zero, rmd.ANY.encode("reset", host.address))
        if not pending.sent and host.active - rmd.PASSING.keys():
            return (rmd.ANY.encode("reset", host.address),)
        frames = [rmd.ANY.encode(name, host.address) for name in ("shutdown", "read status 1")]
        host.own.answers.ask(len(frames))
        return frames
