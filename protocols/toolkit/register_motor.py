"""The host's end of motors that answer every frame, send nothing else, and keep their setup in registers.

Rules. A protocol's `RegisterAdapter` gives the frames; here is when they are sent. Before a device is armed,
registers that say what it is must be as expected, and those that decide how it behaves are written until they
are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Feedback, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host, Report
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending
from protocols.toolkit.registers import Registers
from protocols.toolkit.requests import ANSWER, scan

RETRY = 50 * MILLISECOND
"""Time after which a register is asked for or written again."""
FRESH = 500 * MILLISECOND
"""Age of what a register is known to hold, up to which a device is armed upon it."""
SILENT = 3
"""Periods of feedback without one, after which a commanded device is asked beside its set-points."""


@dataclass(slots=True)
class Motor:
    """What is known of one device beyond its phase. Plain data."""

    expected: Mapping[str, float] = field(default_factory=dict)
    """The registers that must be so,"""
    written: Mapping[str, float] = field(default_factory=dict)
    """and those that are written before it is armed."""
    wrong: dict[str, float] = field(default_factory=dict)
    """Of those that must be so, the ones that are not."""
    known: dict[str, float] = field(default_factory=dict)
    """What its registers hold, since it was last forgotten."""
    known_at: dict[str, Nanos] = field(default_factory=dict)
    asked: dict[str, Nanos] = field(default_factory=dict)
    """When each register was last asked for or written."""
    answers: AnswerCount = field(default_factory=AnswerCount)
    reported_at: Nanos = 0
    """When its feedback last came; answers about registers are none."""

    def reported(self, t: Nanos) -> str:
        """Record a feedback; return why more devices than one must have answered, "" if one may."""
        self.reported_at = t
        return self.answers.add(t)

    def ask(self, now: Nanos, name: str) -> None:
        """Record that a register is asked for or written."""
        self.asked[name] = now

    def put(self, t: Nanos, name: str, value: float) -> None:
        """Record what a register holds."""
        self.known[name], self.known_at[name] = value, t
        if name in self.expected:
            self.wrong = self.different(self.expected)

    def forget(self) -> None:
        """Forget everything: the device may have restarted."""
        self.known.clear()
        self.wrong.clear()
        self.asked.clear()

    def is_asked(self, t: Nanos, name: str) -> bool:
        """True if a frame received now may be the answer about this register."""
        return name in self.asked and t - self.asked[name] < ANSWER

    def missing(self, now: Nanos, names: Iterable[str]) -> list[str]:
        """Return which of these are not known, and may be asked for again."""
        return [name for name in names if name not in self.known and self.may_ask(now, name)]

    def stale(self, now: Nanos, names: Iterable[str]) -> list[str]:
        """Return which of these were last known too long ago: a restart since then shows in nothing else."""
        return [name for name in names if now - self.known_at.get(name, now) > FRESH]

    def different(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Return the registers that are known to hold something else."""
        return {n: v for n, v in wanted.items() if abs(self.known.get(n, v) - v) > 1e-3 * max(1.0, abs(v))}

    def to_write(self, now: Nanos, wanted: Mapping[str, float]) -> list[tuple[str, float]]:
        """Return the registers that hold something else, and may be written again."""
        return [each for each in self.different(wanted).items() if self.may_ask(now, each[0])]

    def may_ask(self, now: Nanos, name: str) -> bool:
        """True if a register was not asked for just before."""
        return now - self.asked.get(name, -RETRY) >= RETRY


class RegisterAdapter(Adapter[Motor]):
    """The options of a device have `feedback_ms` and `offline_ms`."""

    clearing_disarms = True
    registers: Registers
    serial: str = ""
    """Register that holds the serial number."""
    save: str | None = None
    """Parameter that saves the configuration when 1 is written."""
    turns: str = ""
    """Register that holds the position beyond the range of the feedback."""
    enable: str = "enable"
    """Name of the message that arms."""
    disable: str = "disable"
    """Name of the message that disarms."""
    actions: Mapping[type[Request], str] = {}
    """Names of the messages that carry out requests other than for a parameter."""

    # -- the protocol's own ---------------------------------------------------------------------------

    def expected(self, options: Any) -> Mapping[str, float]:  # noqa: ANN401 -- the protocol's own type
        """Return the registers that must be so: else every number would be scaled wrongly."""
        return {}

    def written(self, options: Any) -> Mapping[str, float]:  # noqa: ANN401
        """Return the registers that are written before the device is armed."""
        return {}

    def wanted(self, host: Host[Motor]) -> Mapping[str, float]:
        """Return what these must hold now, where that depends on more than the options."""
        return host.own.written

    def polled(self, options: Any) -> Sequence[str]:  # noqa: ANN401
        """Return the registers that are read with every question and command."""
        return (self.turns,) if self.turns else ()

    def about(self, operation: str, address: int, name: str, value: float = 0.0) -> Sequence[Frame]:
        """Return what reads or writes a register ("read", "write"; where a device does not answer what was
        written, it is read back), or saves all ("save")."""
        raise NotImplementedError

    def ask_at(self, address: int) -> Sequence[Frame]:
        """Return the read-only frames that are answered by who is at an address; () if there are none."""
        return self.about("read", address, self.serial) if self.serial else ()

    def ask(self, host: Host[Motor]) -> Sequence[Frame]:
        """Return the read-only frames that the device answers with its feedback."""
        return ()

    def message(self, name: str, address: int) -> Frame:
        """Return a message that carries no number: `enable`, `disable`, or one of `actions`."""
        raise NotImplementedError

    def set_point(self, host: Host[Motor], command: Command) -> Frame:
        """Return the frame of a command."""
        raise NotImplementedError

    # -- received -------------------------------------------------------------------------------------

    def register_report(
        self, t: Nanos, host: Host[Motor], name: str, value: float, *, written: bool = False
    ) -> Report[Motor]:
        """Return what an answer about a register reports."""
        host.own.put(t, name, value)
        turned = name == self.turns and name in self.polled(host.options)
        return Report(
            host,
            host.address,
            parameters={name: value},
            written=name if written else "",
            serial=int(value) if name == self.serial else None,
            feedback=Feedback(host.name, t, position=value) if turned else None,
            duplicate=host.own.answers.add(t),
        )

    # -- sent -----------------------------------------------------------------------------------------

    def own(self, device: Device) -> Motor:
        return Motor(self.expected(device.options), self.written(device.options))

    def refuse(self, host: Host[Motor], command: Command) -> str:
        known, wrong = host.own.known, host.own.wrong
        differences = ", ".join(f"{name} is {known[name]:g}, not {wrong[name]:g}" for name in wrong)
        return f"it is another model than the robot file has: {differences}" if wrong else ""

    def ready(self, host: Host[Motor]) -> bool:
        own = host.own
        known = own.known.keys()
        return own.expected.keys() <= known and own.written.keys() <= known

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        wanted = self.wanted(host)
        if not wanted.keys() <= host.own.known.keys():
            return ()  # `poll` asks
        if stale := host.own.stale(now, wanted):
            asked = [name for name in stale if host.own.may_ask(now, name)]
            return host.own.answers.sent(now, self._read(now, host, asked))
        if host.own.different(wanted):
            wrong = host.own.to_write(now, wanted)
            return host.own.answers.sent(
                now, [f for each in wrong for f in self._about(now, host, "write", *each)]
            )
        return host.own.answers.sent(now, [self.message(self.enable, host.address)])

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        reads = self._read(now, host, self.polled(host.options))
        # One that has restarted may be in a mode in which it does not answer this set-point.
        silent = now - host.own.reported_at > SILENT * host.options.feedback_ms * MILLISECOND
        asks = self.ask(host) if silent else ()
        return host.own.answers.sent(now, [self.set_point(host, command), *asks, *reads])

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        return host.own.answers.sent(now, [self.message(self.disable, host.address)])

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        if now < self.poll_due(host):
            return ()
        options = host.options
        needed = (*host.own.expected, *host.own.written)
        names = (*host.own.missing(now, needed), *self.polled(options))
        return host.own.answers.sent(now, [*self.ask(host), *self._read(now, host, names)])

    def poll_due(self, host: Host[Motor]) -> Nanos:
        at: Nanos = host.own.answers.sent_at + host.options.feedback_ms * MILLISECOND
        return at

    def _read(self, now: Nanos, host: Host[Motor], names: Sequence[str]) -> list[Frame]:
        return [frame for name in names for frame in self._about(now, host, "read", name)]

    def _about(
        self, now: Nanos, host: Host[Motor], operation: str, name: str, value: float = 0.0
    ) -> Sequence[Frame]:
        host.own.ask(now, name)
        return self.about(operation, host.address, name, value)

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if isinstance(request, msg.Scan) and (once := self._who_is_there()):
            for each in driver.hosts.values():
                each.own.ask(now, self.serial)
            return scan(now, request, once)
        wrong = self.registers.wrong_request(request, self.save or "")
        if wrong is None:
            wrong = "" if type(request) in self.actions else "the device cannot do that on this bus"
        if wrong or host is None:
            return wrong
        # Its memory wears out: it is asked to save once.
        again = ANSWER if getattr(request, "parameter", "") == self.save else RETRY
        return Pending(request, host.name, now, now + ANSWER, now, host, (), again)

    def _who_is_there(self) -> list[Frame]:
        return [frame for at in self.addresses for frame in self.ask_at(at)]

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        host = pending.host
        if host is None:
            return pending.slice()
        frames: Sequence[Frame]
        match pending.request:
            case msg.ReadParameter(_, name):
                frames = self._about(now, host, "read", name)
            case msg.WriteParameter(_, name, value):
                frames = self._about(now, host, "save" if name == self.save else "write", name, value)
            case request:
                frames = [self.message(self.actions[type(request)], host.address)]
        host.own.answers.ask(len(frames))  # not `sent`: many requests must not put off the next question
        return frames
