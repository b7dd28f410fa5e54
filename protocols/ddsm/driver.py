"""The host's end: what a DDSM motor is sent in each phase, and what its answers report.

Rules. Each frame but `set mode` and `set id` is answered, and one question is under way on the line at a
time. The mode arms: it is written before anything is commanded, though the motor may have it already, and
counts once an answer has come that was asked for behind it (of a DDSM210, which does not tell its mode, two).
Released, a motor is in the mode without a loop for speed, with a value of 0; that goes out until answers
confirm it. A value of 0 is not sent in the mode for positions: it is an angle there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.ddsm import table as ds
from protocols.ddsm.options import Options
from protocols.frames import Frame
from protocols.line import Answer, Exchange, Rank
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request, seconds
from protocols.plugin import Device
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.requests import ANSWER
from protocols.toolkit.serial import Stream
from protocols.toolkit.table import Values

STATE: Nanos = SECOND // 2
"""Period of a query while it is driven: for what the answers to `drive` lack"""
LONGEST: Nanos = 100 * MILLISECOND
"""Time for which a velocity tells where a shaft went meanwhile"""
FAR = 0.3
"""rad beyond that, by which one answer alone moves no position"""
APART: Nanos = 5 * MILLISECOND
"""Period in which `set id` is sent: the vendor's code has 4 ms."""
CLEARED: Nanos = SECOND
"""Time in which a fault must have passed after ClearFault"""
FINISH: Nanos = 400 * MILLISECOND
"""Time for one more question of a scan or of `set id`."""


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    position: float | None = None
    """rad, with the turns since it was first reported"""
    velocity: float = 0.0
    current: float = 0.0
    """A"""
    at: Nanos = 0
    """When it was last heard"""
    doubtful: bool = False
    """The angle in that answer cannot be."""
    mode: int | None = None
    """As it reports it; of a DDSM210 as it was told"""
    told: tuple[int, int] = (-1, 0)
    """The mode that was written, and the answers since"""
    value: int = 0
    """As last sent in `drive`; while its mode changes, 1 if it goes on armed"""
    error: int = 0
    asked_at: Nanos = -(1 << 62)
    """When the last question was given that tells its motion,"""
    queried_at: Nanos = -(1 << 62)
    """and the last query."""

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.position, self.velocity, self.current, self.error, self.value = None, 0.0, 0.0, 0, 0
        self.mode, self.told = None, (-1, 0)

    def see(self, t: Nanos, values: Values, options: Options) -> None:
        """Record what an answer has. The shaft is where its angle says, in the turn that is nearest to where
        its velocity has brought it; a coarse angle confirms that, if it can."""
        before, since = self.velocity, seconds(min(t - self.at, LONGEST))
        self.velocity = values["speed"] * options.of_model.rpm if "speed" in values else before
        self.current = values["current"] * ds.AMPERE if "current" in values else self.current
        self.mode, self.error, self.at = values.get("mode", self.mode), values["error"], t
        fine, coarse = values.get("angle"), values.get("coarse")
        angle = fine * ds.ANGLE if fine is not None else None if coarse is None else coarse * ds.COARSE
        if self.position is None:
            self.position = None if angle is None else math.remainder(angle, math.tau)
            return
        expected = self.position + 0.5 * (before + self.velocity) * since
        if angle is None:
            self.position = expected
            return
        off = math.remainder(angle - expected, math.tau)
        # A late answer, taken for that to another question, has other numbers in the place of the angle.
        far = abs(off) > FAR + abs(self.velocity) * since and since < seconds(LONGEST)
        self.doubtful = far and not self.doubtful
        if not self.doubtful:
            self.position = expected + (off if fine is not None or abs(off) > ds.COARSE else 0.0)

    def answered(self, mode: int, model: ds.Model) -> None:
        """Record an answer behind a mode that was written."""
        self.told = mode, self.told[1] + 1 if self.told[0] == mode else 1
        if not model.tells_mode and self.told[1] >= model.told:
            self.mode = mode

    def untold(self) -> None:
        """Write its mode anew: it may not have come."""
        self.told = (-1, 0)

    def counts(self, mode: int, model: ds.Model) -> bool:
        """True if this mode was written, and the motor is in it."""
        return self.mode == mode == self.told[0] and self.told[1] >= model.told

    def query(self, now: Nanos) -> None:
        """Record a query."""
        self.asked_at = self.queried_at = now

    def send(self, now: Nanos, value: int, *, motion: bool) -> None:
        """Record the value that it is sent, and whether the answer tells its motion."""
        self.value, self.asked_at = value, now if motion else self.asked_at

    def rest(self, model: ds.Model) -> None:
        """Record that it is told to let go."""
        self.told, self.value = (-1, 0), 0
        self.mode = self.mode if model.tells_mode else model.rest

    def feedback(self, t: Nanos, name: str, values: Values, options: Options) -> Feedback:
        """Return what was measured; at the ends of its numbers it may as well be beyond."""
        speed, counts = (values.get(key, ds.FULL) for key in ("speed", "current"))
        measured = abs(counts) < ds.FULL
        return Feedback(
            name,
            t,
            None if self.doubtful else self.position,
            self.velocity if abs(speed) < ds.FULL else None,
            counts * options.torque if measured and options.torque else None,
            self.current if measured else None,
            temperature=float(values["temperature"])
            if "temperature" in values and not self.doubtful
            else None,
        )

    def mode_of(self, options: Options) -> tuple[Mode, str]:
        """Return its mode, and a name for it."""
        if self.error:
            return Mode.FAULT, f"error {self.error:#x}"
        if self.mode in (ds.SPEED, ds.POSITION):
            return Mode.ARMED, "speed loop" if self.mode == ds.SPEED else "position loop"
        drives = self.value != 0 or abs(self.current) > options.idle_current
        return (Mode.ARMED, "current") if drives else (Mode.READY, "released")


def answered(options: Options, frame: bytes, rank: Rank, about: str, tries: int = 1) -> Exchange:
    """Return a frame that a motor answers."""
    delay = round(options.answer_ms * MILLISECOND)
    return Exchange(frame, Answer(ds.SIZE, ds.Finds(options.of_model), delay), rank, about, tries)


class DdsmAdapter(Adapter[Motor]):
    """What motors are sent, and what they report."""

    name = "ddsm"
    faults, latch = ds.FAULTS, True

    def __init__(self) -> None:
        self._models: dict[int, ds.Model] = {}
        self._stream = Stream(ds.Tens(self._is_likely))

    def own(self, device: Device) -> Motor:
        self._models[device.address] = device.options.of_model
        return Motor()

    def timing(self, options: Options) -> Timing:
        return Timing(round(options.offline_ms * MILLISECOND), confirmations=3)

    def forget(self, now: Nanos, host: Host[Motor]) -> None:
        host.own.forget()

    def resend(self, host: Host[Motor]) -> None:
        host.own.untold()

    def interrupted(self) -> None:
        self._stream.drop()

    def _is_likely(self, message: bytes) -> bool:
        """True for an answer that nobody has asked for: it must look like one in all, and tell no error:
        eight bits of checksum are no reason to stop a motor, which is asked again soon."""
        model = self._models.get(message[0]) or next(iter(self._models.values()))
        return message[0] in ds.ADDRESSES and not message[8] and model.fits(message)

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        """Return what an answer reports that nobody asked for: of a DDSM115 what all its answers have."""
        if not isinstance(frame, bytes):
            return (Rx.IGNORED,)
        found = self._stream.feed(frame)
        return [one if isinstance(one, Rx) else self._report(t, one, None, driver) for one in found]

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
        tells = options.of_model.tells_mode
        values = ds.read(
            options.model, data[1] if not tells else ds.QUERY if asked is None else asked[1], data
        )
        if asked is None and tells:
            values = {key: values[key] for key in ("mode", "current", "speed", "error")}
        own.see(t, values, options)
        if " set " in about:
            own.answered(int(about.rpartition(" ")[2]), options.of_model)
        (mode, detail), faults = own.mode_of(options), [1 << bit for bit in range(8) if own.error >> bit & 1]
        feedback = own.feedback(t, host.name, values, options)
        return Report(host, host.address, mode, detail, faults, feedback, note=note)

    # -- sent -----------------------------------------------------------------------------------------

    def _drive(self, now: Nanos, host: Host[Motor], value: int, rank: Rank = Rank.SET_POINT) -> Exchange:
        host.own.send(now, value, motion=host.options.of_model.tells_mode)
        frame = ds.encode("drive", host.address, value=value, brake=0)
        return answered(host.options, frame, rank, f"{host.address} drive")

    def _mode(self, host: Host[Motor], mode: int, rank: Rank) -> Exchange:
        name = f"set mode {host.options.model[4:]}"
        return Exchange(ds.encode(name, host.address, mode=mode), None, rank, f"{host.address} mode")

    def _query(self, now: Nanos, host: Host[Motor], rank: Rank, about: str) -> Exchange:
        host.own.query(now)
        return answered(host.options, ds.encode("query", host.address), rank, f"{host.address} {about}")

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        return self._drives(now, host, 0.0, by_torque=isinstance(command, msg.Torque))

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        number = command.torque if isinstance(command, msg.Torque) else getattr(command, "velocity", 0.0)
        return self._drives(now, host, number, by_torque=isinstance(command, msg.Torque))

    def _drives(self, now: Nanos, host: Host[Motor], number: float, *, by_torque: bool) -> Sequence[Frame]:
        """Return a set-point; what is missing to its mode, if that does not count yet."""
        options, wanted = host.options, ds.CURRENT if by_torque else ds.SPEED
        if host.own.counts(wanted, options.of_model):
            value = round(number / (options.torque if by_torque else options.of_model.rpm))
            return (self._drive(now, host, value or int(by_torque)),)  # a current of 0 would let go
        # A new mode begins without a value; one that is armed is to get one, and stays so.
        host.own.send(now, int(host.phase is Phase.ARMED), motion=False)
        return (
            self._mode(host, wanted, Rank.SET_POINT),
            self._query(now, host, Rank.QUESTION, f"set {wanted}"),
        )

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        model, rank = host.options.of_model, Rank.RELEASE
        host.own.rest(model)
        is_angle = host.own.mode == ds.POSITION
        asked = self._query(now, host, rank, "rest") if is_angle else self._drive(now, host, 0, rank)
        return self._mode(host, model.rest, rank), asked

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        if now < self.poll_due(host):
            return ()
        tells, driven = host.options.of_model.tells_mode, host.phase in (Phase.ARMING, Phase.ARMED)
        query = self._query(now, host, Rank.BACKGROUND if tells and driven else Rank.QUESTION, "state")
        if tells or driven or not host.once_commanded:
            return (query,)
        return *self.release(now, host), query  # it would not tell that a late frame has armed it

    def poll_due(self, host: Host[Motor]) -> Nanos:
        own, period = host.own, round(host.options.feedback_ms * MILLISECOND)
        at: Nanos = min(own.asked_at + period, own.queried_at + STATE)
        return at

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        match request:
            case msg.Scan():
                first = next(iter(driver.hosts.values()))
                frames = tuple(
                    answered(first.options, ds.encode("query", at), Rank.QUESTION, f"scan {at}", 2)
                    for at in ds.ADDRESSES
                )
                period = 2 * (round(first.options.answer_ms * MILLISECOND) + 3 * MILLISECOND)
                end = now + len(frames) * period + FINISH
                return Pending(request, request.bus, now, end, now, None, frames, period)
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
        if isinstance(request, msg.Scan):
            return pending.frames[pending.sent : pending.sent + 1]
        if host is None or isinstance(request, msg.ClearFault):
            return ()
        if isinstance(request, msg.WriteParameter) and pending.sent < ds.TIMES:
            return (Exchange(ds.encode("set id", id=int(request.value))),)
        return (answered(host.options, ds.encode("id query"), Rank.QUESTION, "id"),)
