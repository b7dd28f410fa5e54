"""The host's end: which messages are sent with which values, and what is made of those that come.

Rules. A message may carry the commands of several motors: it is made at the end of a step, of what was given
in this step; a motor that was given nothing has what `idle` gives it, or the file's initial value. A message
goes out once per period, with the command of that step; what lets go does not wait, nor does another kind of
command, with its mode. A set-point goes out before what enables it. A mode that nothing confirms is sent
again every 500 ms. Where no signal tells the
state, a motor counts as armed while it is commanded and reports.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.dbc.database import Message, Raw
from protocols.dbc.table import FAULT, FAULTS, Assignments, Declared, SetPoint, declared
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.duplicates import ShaftCheck
from protocols.toolkit.host import Host, Report, counted_once
from protocols.toolkit.motor_driver import NEVER, Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.turns import LONGEST, Shaft

AGAIN: Nanos = 500 * MILLISECOND
"""Period of a mode, beside set-points in other messages"""
EARLY = 0.25
"""Share of its period by which a message may be early: steps do not fall on periods"""

APART = 0.5
"""rad by which the positions of two shafts differ at least, to be noticed as two"""


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    declared: Declared
    shaft: Shaft
    """Where the position is not fed back over all turns"""
    check: ShaftCheck = field(default_factory=lambda: ShaftCheck(APART))
    driven: bool = False
    told: bool | None = None
    """Whether its state says that it is armed; None: not told"""
    detail: str = ""
    faulty: str = ""
    """Its fault, in words"""
    kind: type[Command] | None = None
    """Of the last set-point; None: what it was sent last is none, or may be lost"""
    mode_at: Nanos = -NEVER
    """When its mode was last sent"""

    def forget(self) -> None:
        """Forget what it reported."""
        self.told, self.detail, self.faulty, self.mode_at, self.kind = None, "", "", -NEVER, None
        self.shaft.forget(self.shaft.position)

    def drive(self, *, driven: bool) -> None:
        """Record whether it is commanded."""
        self.driven = driven
        self.kind = self.kind if driven else None

    def send_mode(self, now: Nanos, kind: type[Command], *, must: bool) -> bool:
        """True if what goes beside this command is to be sent now."""
        due = must or kind is not self.kind or now - self.mode_at >= AGAIN
        self.kind = kind
        self.mode_at = now if due else self.mode_at
        return due

    def send_all(self) -> None:
        """Let its mode be sent with the next set-point: it may be lost."""
        self.kind = None

    def hear(self, told: bool | None, detail: str) -> None:
        """Record its state."""
        self.told, self.detail = told, detail

    def fail(self, faulty: str) -> None:
        """Record its fault; "": none."""
        self.faulty = faulty

    def state(self) -> tuple[Mode | None, str]:
        """Return its mode; None: not known yet."""
        if self.faulty:
            return Mode.FAULT, self.faulty
        if self.declared.state is None:
            return (
                (Mode.ARMED, "commanded; it tells no state")
                if self.driven
                else (Mode.READY, "it tells no state")
            )
        if self.told is None:
            return None, ""
        return Mode.ARMED if self.told else Mode.READY, self.detail


@dataclass(slots=True)
class Line:
    """A message to devices, as it is sent by this driver. Plain data."""

    count: int = -1
    """The last value of its counter"""
    sent: Nanos = -NEVER
    raws: dict[str, Raw] = field(default_factory=dict)
    """What was given in this step"""
    urgent: bool = False
    given: bool = False

    def give(self, raws: Mapping[str, Raw], *, urgent: bool) -> None:
        """Add values."""
        self.raws |= raws
        self.given, self.urgent = True, self.urgent or urgent

    def take(self, now: Nanos, size: int) -> dict[str, Raw]:
        """Return what was given, and note that it is sent."""
        raws, self.raws, self.given, self.urgent, self.sent = self.raws, {}, False, False, now
        self.count = (self.count + 1) % size
        return raws

    def drop(self) -> None:
        """Forget what was given in this step: it is not due."""
        self.raws, self.given, self.urgent = {}, False, False


class DbcAdapter(Adapter[Motor]):
    """What motors are sent, and what they report."""

    name, confirmations = "dbc", 4
    faults = FAULTS

    def __init__(self, devices: Sequence[Device] = ()) -> None:
        self._declared: dict[str, Declared] = {}
        self._lines: dict[str, Line] = {}
        self._rest: dict[str, dict[str, Raw]] = {}
        """By message, what the motors have in it that were given nothing"""
        self._messages: dict[str, Message] = {}
        self._periods: dict[str, Nanos] = {}
        self._last: dict[str, Raw] = {}
        """The counters that were received, by message"""
        for device in devices:
            self._add(device)

    def _add(self, device: Device) -> None:
        of = self._declared[device.name] = declared(device.options, device.address)
        for name in of.to_device:
            message = self._messages.setdefault(name, of.messages[name])
            if message != of.messages[name]:
                text = f"{device.name} has another {name} than the motors before it: its file, counter and"
                raise ValueError(f"{text} checksum must be the same")
            period = of.periods.get(name, round(device.options.period_ms * MILLISECOND))
            self._periods[name] = min(period, self._periods.get(name, period))
            self._lines.setdefault(name, Line())
            self._rest.setdefault(name, {}).update(of.idle.get(name, {}))

    def own(self, device: Device) -> Motor:
        of, within = self._declared[device.name], device.options.feedback.within_turn
        start = None if "position" in of.fed and within else 0.0
        longest = max(LONGEST, round(2 * device.options.feedback_ms * MILLISECOND))
        return Motor(of, Shaft(start, longest=longest))

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        found: list[tuple[Host[Motor], Message]] = []
        for host in driver.hosts.values():
            of = host.own.declared
            message = of.message(frame, of.from_device)
            if message is not None:
                found.append((host, message))
        if not found or not isinstance(frame, CanFrame):
            return (Rx.IGNORED,)
        message = found[0][1]
        raws = message.decode(frame)
        if raws is None or not all(raw - raw == 0.0 for raw in raws.values()):
            return (Rx.MALFORMED,)
        if message.counter:
            if self._last.get(message.name) == raws[message.counter]:
                return (Rx.MALFORMED,)
            self._last[message.name] = raws[message.counter]
        return counted_once(self._report(t, host, message.name, raws) for host, _ in found)

    def _report(self, t: Nanos, host: Host[Motor], name: str, raws: Mapping[str, Raw]) -> Report[Motor]:
        own, of = host.own, host.own.declared
        if of.state is not None and of.state[0].message == name:
            signal, raw = of.state[0].signal, raws[of.state[0].signal.name]
            own.hear(raw in of.state[1], f"{signal.name} {signal.choice(raw)}")
        faults: list[int] | None = None
        if of.fault is not None and of.fault[0].message == name:
            signal, raw = of.fault[0].signal, raws[of.fault[0].signal.name]
            own.fail("" if raw == of.fault[1] else f"{signal.name} {signal.choice(raw)}")
            faults = [FAULT] if own.faulty else []
        values: dict[str, float | None] = {
            key: number.measured(raws[number.signal.name])
            for key, number in of.fed.items()
            if number.message == name and number.signal.name in raws
        }
        if values.keys() & {"position", "velocity"} and self._counts(host):
            own.shaft.add(t, values.get("position"), values.get("velocity"))
            values["position"] = own.shaft.position
        feedback = Feedback(host.name, t, **values) if values else None
        mode, detail = own.state()
        place, speed = values.get("position"), values.get("velocity") or 0.0
        two = place is not None and own.check.add(t, place, speed)
        duplicate = "positions of two shafts" if two else ""
        return Report(host, host.address, mode, detail, faults, feedback, duplicate)

    @staticmethod
    def _counts(host: Host[Motor]) -> bool:
        """True if the position is counted here."""
        return "position" not in host.own.declared.fed or host.options.feedback.within_turn

    def resend(self, host: Host[Motor]) -> None:
        host.own.send_all()

    # -- sent -----------------------------------------------------------------------------------------

    def _give(self, assignments: Assignments, *, urgent: bool = False) -> None:
        for name, raws in assignments.items():
            self._lines[name].give(raws, urgent=urgent)

    def _set_point(self, now: Nanos, host: Host[Motor], command: Command, *, arming: bool) -> None:
        own, of = host.own, host.own.declared
        own.drive(driven=True)
        if isinstance(command, msg.Hold):
            place = host.position if host.held is None else host.held
            command = msg.Position(host.name, place or 0.0)
        if arming:
            command = _still(command, host.position)
        kind, one = type(command), of.setpoints[type(command)]
        other = kind is not own.kind
        value = getattr(command, kind.__name__.lower())
        self._give({one.number.message: {one.number.signal.name: one.number.raw(value)}}, urgent=other)
        all_of_it = own.send_mode(now, kind, must=arming)
        self._give(_beside(one, one.beside, all_of_it=all_of_it), urgent=other)
        self._give(_beside(one, of.enable, all_of_it=arming or of.state is None))

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        self._set_point(now, host, command, arming=True)
        return ()

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        self._set_point(now, host, command, arming=False)
        return ()

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.drive(driven=False)
        self._give(host.own.declared.idle, urgent=True)
        return ()

    def poll_bus(self, now: Nanos) -> Sequence[Frame]:
        frames: list[Frame] = []
        for name, line in self._lines.items():
            if not line.given:
                continue
            if not line.urgent and now - line.sent < (1.0 - EARLY) * self._periods[name]:
                line.drop()
                continue
            message = self._messages[name]
            size = 1 << message.signals[message.counter].bits if message.counter else 1
            raws = self._rest[name] | line.take(now, size)
            if message.counter:
                raws[message.counter] = line.count
            frames.append(message.encode(raws))
        return frames

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if isinstance(request, msg.ClearFault) and host is not None:
            return Pending(request, host.name, now, now + SECOND, now, host, sent=1)
        return "the device cannot do that on this bus"

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        if pending.host is not None:
            self._give(pending.host.own.declared.clear, urgent=True)
        return ()


def _beside(one: SetPoint, given: Assignments, *, all_of_it: bool) -> Assignments:
    """Return what goes in the message of a set-point, or all."""
    return {name: raws for name, raws in given.items() if all_of_it or name == one.number.message}


def _still(command: Command, position: float | None) -> Command:
    """Return what arms a motor for a command, and does not move it."""
    if isinstance(command, msg.Position):
        return msg.Position(command.motor, position or 0.0)
    made: Any = type(command)
    still: Command = made(command.motor, 0.0)
    return still
