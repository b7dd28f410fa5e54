"""The host's end over any transport: what is known of a VESC, and what it is sent in each phase.

Rules. A set-point arms a controller, and no report says that it is armed. It reports, when asked, whether its
timeout has passed: then it drives nothing. So before the first set-point the timeout must have been seen to
pass; a current of 0, which drives nothing either, must end that; from then on it counts as armed while it is
fed. Last fed with a current of 0, and without current, it is released. Fed though its timeout had passed
since we last fed it, it is driven by another host or by late frames. A timeout that does not pass is a fault.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host
from protocols.toolkit.motor_driver import Adapter
from protocols.toolkit.table import Values
from protocols.vesc import table as vt
from protocols.vesc.options import MotorOptions

ABSENT: Nanos = SECOND
"""Time for which others come and one does not, after which a message is missing."""


@dataclass(slots=True)
class Controller:
    """What is known of one controller beyond its phase. Plain data."""

    timeout: Nanos
    """After which it cannot be fed by us any more"""
    idle_current: float
    """A"""
    needed: tuple[str, ...]
    """The messages without which it cannot be commanded."""
    answers: AnswerCount = field(default_factory=AnswerCount)
    since: Nanos | None = None
    """When it first reported,"""
    seen: dict[str, Nanos] = field(default_factory=dict)
    """and when each message last was."""
    proven: bool = False
    """Its timeout was seen to pass,"""
    passed: bool = False
    """and has since we last fed it."""
    timed_out: bool = True
    code: int = 0
    """Of its fault"""
    kill: bool = False
    """Its kill switch is on."""
    current: bool = False
    """More current flows than when it is idle."""
    driven: bool = False
    """What we sent last is a set-point, or prepares one."""
    fed_at: Nanos | None = None
    """When we last fed it."""

    def forget(self) -> None:
        """Forget what it reported: it may have restarted, or been replaced."""
        self.since = self.fed_at = None
        self.proven = self.passed = self.current = self.driven = False
        self.timed_out, self.code, self.kill = True, 0, False
        self.seen.clear()

    def see(self, t: Nanos, name: str, values: Values) -> None:
        """Record a message."""
        self.since = t if self.since is None else self.since
        self.seen[name] = t
        match name:
            case "STATUS_1":
                self.current = abs(values["current"]) > self.idle_current
            case "fault":
                code = values["value"]
                self.code = code if code in vt.FAULTS or not code else vt.UNKNOWN
            case "state":
                self.timed_out, self.kill = bool(values["value"] & 1), bool(values["value"] & 2)
                self.proven, self.passed = self.proven or self.timed_out, self.passed or self.timed_out

    def mode(self, before: Mode | None) -> tuple[Mode, str]:
        """Return its mode, and a name for it; `before`: that which was reported last."""
        if self.faults:
            return Mode.FAULT, vt.FAULTS[min(self.faults)].name
        if not self.timed_out and (self.driven or self.current or self.passed):
            return Mode.ARMED, "driven"
        return Mode.READY, "timeout" if self.timed_out and before is Mode.ARMED else "released"

    def missing(self, t: Nanos) -> list[str]:
        """Return the messages that are needed and do not come, while others do."""
        return [name for name in self.needed if t - self.seen.get(name, self.since or t) > ABSENT]

    def without_timeout(self) -> bool:
        """True if it should have passed, and did not."""
        at = self.seen.get("state", 0)
        since = self.since if self.fed_at is None else self.fed_at
        fed = self.timed_out or self.passed or self.driven or since is None
        return not fed and at - (since or at) > self.timeout

    @property
    def faults(self) -> list[int]:
        """Codes of all that is wrong with it."""
        return [code for code in (self.code, vt.KILL * self.kill) if code]

    def feed(self, now: Nanos, *, driven: bool) -> None:
        """Record that it is fed."""
        self.driven, self.fed_at, self.passed = driven, now, False


class ControllerAdapter(Adapter[Controller]):
    """What controllers are sent, and what they report, over any transport."""

    faults, not_armed, latch, clearing = vt.ALL_FAULTS, vt.NOT_ARMED, True, SECOND
    confirmations = 4
    needed: tuple[str, ...] = ("state",)

    def own(self, device: Device) -> Controller:
        options: MotorOptions = device.options
        timeout = (11 * options.timeout_ms // 10 + 50) * MILLISECOND
        return Controller(timeout, options.idle_current, self.needed)

    # -- the transport's own --------------------------------------------------------------------------

    @abstractmethod
    def set(self, host: Host[Controller], name: str, value: float, *, release: bool = False) -> Frame:
        """Return a message with one number; `release`: it disarms."""

    @abstractmethod
    def ask(self, now: Nanos, host: Host[Controller], *, hurry: bool = False) -> Sequence[Frame]:
        """Return the questions about fault and timeout that are due; `hurry`: it is armed or released."""

    # -- received -------------------------------------------------------------------------------------

    def motion(
        self,
        t: Nanos,
        host: Host[Controller],
        velocity: int,
        current: float,
        duty: float,
        position: float | None = None,
    ) -> Feedback:
        """Return what a controller reports of its motion [ERPM, A, share of the supply; rad]. The sign of the
        current is that of the power that it takes from the supply."""
        sign, options = duty or velocity, host.options
        current = (-current if sign < 0 else current) + 0.0
        torque = current * options.torque_constant
        return Feedback(host.name, t, position, inside(velocity, options.erpm), torque, current)

    def notice(self, now: Nanos, host: Host[Controller]) -> Sequence[Event]:
        own = host.own
        if host.offline or host.tripped or host.received_at is None:
            return ()
        if missing := own.missing(host.received_at):
            deaf = "state" in missing
            code, names = (vt.NO_ANSWER, "") if deaf else (vt.NO_STATUS, f"{', '.join(missing)}: ")
            return host.trip(now, code, names + self.faults[code].cause)
        return host.trip(now, vt.NO_TIMEOUT) if own.without_timeout() else ()

    # -- sent -----------------------------------------------------------------------------------------

    def ready(self, host: Host[Controller]) -> bool:
        return host.own.proven and not host.own.faults

    def arm(self, now: Nanos, host: Host[Controller], command: Command) -> Sequence[Frame]:
        return self._without_current(now, host, driven=True)

    def release(self, now: Nanos, host: Host[Controller]) -> Sequence[Frame]:
        return self._without_current(now, host, driven=False)

    def _without_current(self, now: Nanos, host: Host[Controller], *, driven: bool) -> Sequence[Frame]:
        host.own.feed(now, driven=driven)
        zero = self.set(host, "SET_CURRENT", 0.0, release=not driven)
        return zero, *self.ask(now, host, hurry=True)

    def command(self, now: Nanos, host: Host[Controller], command: Command) -> Sequence[Frame]:
        options = host.options
        host.own.feed(now, driven=True)
        if isinstance(command, msg.Velocity):
            value = round(command.velocity / options.erpm)
            return (self.set(host, "SET_RPM", value),)
        # A current of 0 would release it: 1 mA drives nothing either.
        current = getattr(command, "torque", 0.0) / options.torque_constant
        return (self.set(host, "SET_CURRENT", round(current, 3) or 1e-3),)

    def poll(self, now: Nanos, host: Host[Controller]) -> Sequence[Frame]:
        return self.ask(now, host)


def inside(raw: int, unit: float) -> float | None:
    """Return a number of 32 bits; None at their ends, where it may as well be beyond."""
    return raw * unit if abs(raw) < (1 << 31) - 1 else None
