"""The host's end: what a DDSM motor is sent in each phase, and what its answers report.

Rules. Each frame but `set mode` and `set id` is answered, and one question is under way on the line at a
time. The mode arms: it is written before anything is commanded, though the motor may have it already, and
counts once an answer has come that was asked for behind it (two of a DDSM210, which does not report it).
Released, a motor is in the mode without a loop for speed, with a value of 0; that goes out until answers
confirm it. A value of 0 is not sent in the mode for positions: it is an angle there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.ddsm import table as ds
from protocols.ddsm.options import Options
from protocols.frames import Frame
from protocols.line import Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report
from protocols.toolkit.lines import LineAdapter
from protocols.toolkit.motor_driver import MotorDriver, Pending, Rx
from protocols.toolkit.questions import Questions
from protocols.toolkit.requests import ANSWER, scan, still
from protocols.toolkit.table import Values
from protocols.toolkit.turns import Shaft

STATE: Nanos = SECOND // 2
"""Period of a query while it is driven: for what the answers to `drive` lack"""
APART: Nanos = 5 * MILLISECOND
"""Period in which `set id` is sent: the vendor's code has 4 ms."""
CLEARED: Nanos = SECOND
"""Time in which a fault must have passed after ClearFault"""


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    shaft: Shaft = field(default_factory=Shaft)
    current: float = 0.0
    """A"""
    mode: int | None = None
    """As it reports it; of a DDSM210 as it was set"""
    written: tuple[int, int] = (-1, 0)
    """The mode that was written, and the answers since"""
    value: int = 0
    """As last sent in `drive`; while its mode changes, 1 if it goes on armed"""
    error: int = 0
    asked: Questions = field(default_factory=Questions)
    """"motion": any question that reports its motion; "state": a query"""

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.shaft.forget()
        self.current, self.error, self.value, self.mode = 0.0, 0, 0, None
        self.write_again()

    def see(self, t: Nanos, values: Values, options: Options) -> None:
        """Record what an answer has."""
        fine, coarse = values.get("angle"), values.get("coarse")
        angle = fine * ds.ANGLE if fine is not None else None if coarse is None else coarse * ds.COARSE
        # A late answer, taken for that to another question, has other numbers in the place of the angle.
        speed = values["speed"] * options.of_model.rpm if "speed" in values else None
        self.shaft.add(t, angle, speed, 0.0 if fine is not None else ds.COARSE)
        self.current = values["current"] * ds.AMPERE if "current" in values else self.current
        self.mode, self.error = values.get("mode", self.mode), values["error"]

    def confirm(self, mode: int, model: ds.Model) -> None:
        """Record an answer behind a mode that was written."""
        self.written = mode, self.written[1] + 1 if self.written[0] == mode else 1
        if not model.names_mode and self.written[1] >= model.confirms:
            self.mode = mode

    def write_again(self) -> None:
        """Write its mode anew: it may not have come."""
        self.written = (-1, 0)

    def counts(self, mode: int, model: ds.Model) -> bool:
        """True if this mode was written, and the motor is in it."""
        return self.mode == mode == self.written[0] and self.written[1] >= model.confirms

    def send(self, value: int) -> None:
        """Record the value that it is sent."""
        self.value = value

    def rest(self, model: ds.Model) -> None:
        """Record that it is sent to let go."""
        self.value = 0
        self.write_again()
        self.mode = self.mode if model.names_mode else model.rest

    def feedback(self, t: Nanos, name: str, values: Values, options: Options) -> Feedback:
        """Return what was measured; at the ends of its numbers it may as well be beyond."""
        speed, counts = (values.get(key, ds.FULL) for key in ("speed", "current"))
        measured, doubtful = abs(counts) < ds.FULL, self.shaft.doubtful
        temperature = None if doubtful else values.get("temperature")
        return Feedback(
            name,
            t,
            None if doubtful else self.shaft.position,
            self.shaft.velocity if abs(speed) < ds.FULL else None,
            counts * options.torque if measured and options.torque else None,
            self.current if measured else None,
            temperature=None if temperature is None else float(temperature),
        )

    def mode_of(self, options: Options) -> tuple[Mode, str]:
        """Return its mode, and a name for it."""
        if self.error:
            return Mode.FAULT, f"error {self.error:#x}"
        if self.mode in (ds.SPEED, ds.POSITION):
            return Mode.ARMED, "speed loop" if self.mode == ds.SPEED else "position loop"
        drives = self.value != 0 or abs(self.current) > options.idle_current
        return (Mode.ARMED, "current") if drives else (Mode.READY, "released")


class DdsmAdapter(LineAdapter[Motor]):
    """What motors are sent, and what they report."""

    name = "ddsm"
    faults, latch, confirmations = ds.FAULTS, True, 3

    def __init__(self) -> None:
        self._models: dict[int, ds.Model] = {}
        super().__init__(ds.answers(self._likely))

    def own(self, device: Device) -> Motor:
        self._models[device.address] = device.options.of_model
        return Motor()

    def resend(self, host: Host[Motor]) -> None:
        host.own.write_again()

    def _likely(self, ten: bytes) -> bytes | None:
        """Return an answer that nobody has asked for: it must look like one in all, and report no error:
        eight bits of checksum are no reason to stop a motor, which is asked again soon."""
        model = self._models.get(ten[0]) or next(iter(self._models.values()))
        return model.answer(ten) if ten[0] in ds.ADDRESSES and not ten[8] else None

    # -- received -------------------------------------------------------------------------------------

    def unasked(self, t: Nanos, message: bytes, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        """Return what an answer reports that nobody asked for: of a DDSM115 what all its answers have."""
        return (self._report(t, message, None, driver),)

    def heard(
        self, t: Nanos, asked: Exchange, data: bytes, driver: MotorDriver[Motor]
    ) -> Sequence[Report[Motor] | Rx]:
        if asked.answer is None or asked.answer.find(asked, data) != (0, len(data)):
            return super().heard(t, asked, data, driver)
        return (self._report(t, data, asked, driver),)

    def _report(
        self, t: Nanos, data: bytes, asked: Exchange | None, driver: MotorDriver[Motor]
    ) -> Report[Motor] | Rx:
        first, about = next(iter(driver.hosts.values())), "" if asked is None else asked.about
        if asked is not None and asked[0] == ds.ANYONE:  # one alone is on the line, at whatever address
            return Report(first, first.address, parameters={"id": float(data[0])})
        host, note = driver.at.get(data[0]), first.options.model if about.startswith("scan") else ""
        if host is None:
            return Report(None, data[0], note=note) if note else Rx.IGNORED
        own, options = host.own, host.options
        names = options.of_model.names_mode
        function = data[1] if not names else ds.QUERY if asked is None else asked[1]
        values = ds.read(options.model, function, data)
        if asked is None and names:
            values = {key: values[key] for key in ("mode", "current", "speed", "error")}
        own.see(t, values, options)
        if " set " in about:
            own.confirm(int(about.rpartition(" ")[2]), options.of_model)
        (mode, detail), faults = own.mode_of(options), [1 << bit for bit in range(8) if own.error >> bit & 1]
        feedback = own.feedback(t, host.name, values, options)
        return Report(host, host.address, mode, detail, faults, feedback, note=note)

    # -- sent -----------------------------------------------------------------------------------------

    def _drive(self, now: Nanos, host: Host[Motor], value: int, rank: Rank = Rank.SET_POINT) -> Exchange:
        host.own.send(value)
        if host.options.of_model.names_mode:
            host.own.asked.ask(now, "motion")
        frame = ds.drive(host.address, value=value, brake=0)
        return Exchange(frame, host.options.answer(host.address), rank, f"{host.address} drive")

    def _mode(self, host: Host[Motor], mode: int, rank: Rank) -> Exchange:
        name = f"set mode {host.options.model[4:]}"
        return Exchange(ds.encode(name, host.address, mode=mode), None, rank, f"{host.address} mode")

    def _query(self, now: Nanos, host: Host[Motor], rank: Rank, about: str) -> Exchange:
        host.own.asked.ask(now, "motion", "state")
        frame = ds.encode("query", host.address)
        return Exchange(frame, host.options.answer(host.address), rank, f"{host.address} {about}")

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        return self.command(now, host, still(command))

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        """Return a set-point; what is missing to its mode, if that does not count yet."""
        options, by_torque = host.options, isinstance(command, msg.Torque)
        wanted = ds.CURRENT if by_torque else ds.SPEED
        if host.own.counts(wanted, options.of_model):
            number = command.torque if isinstance(command, msg.Torque) else getattr(command, "velocity", 0.0)
            value = round(number / (options.torque if by_torque else options.of_model.rpm))
            return (self._drive(now, host, value or int(by_torque)),)  # a current of 0 would let go
        # A new mode begins without a value; one that is armed is to get one, and stays so.
        host.own.send(int(host.phase is Phase.ARMED))
        asked = self._query(now, host, Rank.QUESTION, f"set {wanted}")
        return self._mode(host, wanted, Rank.SET_POINT), asked

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        model, rank = host.options.of_model, Rank.RELEASE
        host.own.rest(model)
        is_angle = host.own.mode == ds.POSITION
        asked = self._query(now, host, rank, "rest") if is_angle else self._drive(now, host, 0, rank)
        return self._mode(host, model.rest, rank), asked

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        if now < self.poll_due(host):
            return ()
        names, driven = host.options.of_model.names_mode, host.phase in (Phase.ARMING, Phase.ARMED)
        query = self._query(now, host, Rank.BACKGROUND if names and driven else Rank.QUESTION, "state")
        if names or driven or not host.once_commanded:
            return (query,)
        return *self.release(now, host), query  # it would not report that a late frame has armed it

    def poll_due(self, host: Host[Motor]) -> Nanos:
        asked, period = host.own.asked, round(host.options.feedback_ms * MILLISECOND)
        return min(asked.due("motion", period), asked.due("state", STATE))

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        match request:
            case msg.Scan():
                options = next(iter(driver.hosts.values())).options
                period = 2 * (options.delay + 3 * MILLISECOND)
                asked = [(at, ds.encode("query", at)) for at in ds.ADDRESSES]
                frames = [Exchange(one, options.answer(at), about=f"scan {at}", tries=2) for at, one in asked]
                return scan(now, request, frames, 1, 1, period)
            case msg.ClearFault() if host is not None:  # its faults pass by themselves
                return Pending(request, host.name, now, now + CLEARED, now, host, sent=1)
            case msg.WriteParameter(_, "id") if len(driver.hosts) > 1:
                return "every motor on the line would take it: connect one alone"
            case msg.WriteParameter(_, "id", value) if value not in ds.ADDRESSES:
                return f"{value:g} is not an id: {ds.ADDRESSES.start} to {ds.ADDRESSES.stop - 1}"
            case msg.WriteParameter(_, "id"):
                end = now + ANSWER + ds.TIMES * APART
                return Pending(request, request.motor, now, end, now, host, period=APART)
            case msg.WriteParameter(_, name):
                return f"no parameter {name!r}: there is id"
        return "the device cannot do that on this bus"

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        request, host = pending.request, pending.host
        if host is None or isinstance(request, msg.ClearFault):
            return super().frames(now, pending)
        if isinstance(request, msg.WriteParameter) and pending.sent < ds.TIMES:
            return (Exchange(ds.encode("set id", id=int(request.value))),)
        return (Exchange(ds.encode("id query"), host.options.answer(ds.ANYONE), Rank.QUESTION, "id"),)
