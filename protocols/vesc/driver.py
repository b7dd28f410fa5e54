"""The host's end: what a VESC is sent in each phase, and what its messages report.

Rules. A set-point arms a controller, and no report says that it is armed. It reports, when asked, whether its
timeout has passed: then it drives nothing. So before the first set-point the timeout must have been seen to
pass; a current of 0, which drives nothing either, must end that; from then on it counts as armed while it is
fed. Last fed with a current of 0, and without current, it is released. Fed though its timeout had passed
since we last fed it, it is driven by another host or by late frames. A timeout that does not pass is a fault.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Feedback, Mode, Nanos
from protocols.plugin import Device
from protocols.toolkit.duplicates import AnswerCount
from protocols.toolkit.host import Host, Report, Timing
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.table import Values
from protocols.vesc import table as vt
from protocols.vesc.options import Options

ABSENT: Nanos = SECOND
"""Time for which others come and one does not, after which a message is missing."""
ASKED: Nanos = 10 * MILLISECOND
"""Period of questions while it is armed or released."""


@dataclass(slots=True)
class Controller:
    """What is known of one controller beyond its phase. Plain data."""

    timeout: Nanos
    """After which it cannot be fed by us any more"""
    idle_current: float
    """A"""
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
        needed = ("STATUS_1", "STATUS_4", "STATUS_5", "state")
        return [name for name in needed if t - self.seen.get(name, self.since or t) > ABSENT]

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


class VescAdapter(Adapter[Controller]):
    """What controllers are sent, and what they report."""

    name = "vesc"
    faults, not_armed, latch, clearing = vt.ALL_FAULTS, vt.NOT_ARMED, True, SECOND

    def own(self, device: Device) -> Controller:
        options: Options = device.options
        return Controller((11 * options.timeout_ms // 10 + 50) * MILLISECOND, options.idle_current)

    def timing(self, options: Options) -> Timing:
        return Timing(options.offline_ms * MILLISECOND, confirmations=4)

    def forget(self, now: Nanos, host: Host[Controller]) -> None:
        host.own.forget()

    # -- received -------------------------------------------------------------------------------------

    def receive(
        self, t: Nanos, frame: Frame, driver: MotorDriver[Controller]
    ) -> Sequence[Report[Controller] | Rx]:
        decoded = vt.TABLE.decode(frame, "from_device")
        if decoded is None:
            return (Rx.IGNORED,)
        name, address, values = decoded
        host = driver.at.get(address)
        if "host" in values and values["host"] not in {
            each.options.host_id for each in driver.hosts.values()
        }:
            return (Rx.IGNORED,)
        note = f"hardware type {values['hardware']}" if name == "PONG" else ""
        if note and (host is not None or driver.scanning()):
            return (Report(host, address, note=note),)
        if host is None or not name:
            return (Rx.EXPECTED if note else Rx.IGNORED if host is None else Rx.MALFORMED,)
        own = host.own
        own.see(t, name, values)
        mode, detail = own.mode(host.mode)
        if name in ("fault", "state"):
            known = mode if own.faults or name == "state" else None
            return (Report(host, address, known, detail, own.faults, duplicate=own.answers.add(t)),)
        late = mode if own.current and not own.driven and mode is Mode.ARMED else None
        return (Report(host, address, late, detail, feedback=self._measured(t, host, name, values)),)

    def _measured(self, t: Nanos, host: Host[Controller], name: str, values: Values) -> Feedback | None:
        motor, options = host.name, host.options
        match name:
            case "STATUS_1":
                # The sign of the current is that of the power that it takes from the supply.
                sign = values["duty"] or values["velocity"]
                current = (-values["current"] if sign < 0 else values["current"]) + 0.0
                torque = current * options.torque_constant
                return Feedback(motor, t, None, _inside(values["velocity"], options.erpm), torque, current)
            case "STATUS_5":
                position = _inside(values["position"], options.step)
                return Feedback(motor, t, position, voltage=values["voltage"])
            case "STATUS_4":
                return Feedback(motor, t, temperature=max(values["fet"], values["motor"]))
        return None

    def notice(self, now: Nanos, host: Host[Controller]) -> Sequence[Event]:
        own = host.own
        if host.offline or host.tripped or host.received_at is None:
            return ()
        if missing := own.missing(host.received_at):
            deaf = "state" in missing
            code, names = (vt.NO_ANSWER, "") if deaf else (vt.NO_STATUS, f"{', '.join(missing)}: ")
            return host.trip(now, code, names + vt.ALL_FAULTS[code].cause)
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
        return vt.TABLE.encode("SET_CURRENT", host.address, value=0.0), *self._ask(now, host, ASKED)

    def command(self, now: Nanos, host: Host[Controller], command: Command) -> Sequence[Frame]:
        options = host.options
        host.own.feed(now, driven=True)
        if isinstance(command, msg.Velocity):
            value = round(command.velocity / options.erpm)
            return (vt.TABLE.encode("SET_RPM", host.address, value=value),)
        # A current of 0 would release it: 1 mA drives nothing either.
        current = getattr(command, "torque", 0.0) / options.torque_constant
        return (vt.TABLE.encode("SET_CURRENT", host.address, value=round(current, 3) or 1e-3),)

    def poll(self, now: Nanos, host: Host[Controller]) -> Sequence[Frame]:
        return self._ask(now, host, host.options.poll_ms * MILLISECOND)

    def poll_due(self, host: Host[Controller]) -> Nanos:
        at: Nanos = host.own.answers.sent_at + host.options.poll_ms * MILLISECOND
        return at

    def _ask(self, now: Nanos, host: Host[Controller], period: Nanos) -> Sequence[Frame]:
        """Return the questions about fault and timeout, if none were sent for a time."""
        answers = host.own.answers
        if now - answers.sent_at < period:
            return ()
        return answers.sent(now, (self._get("fault", host), self._get("state", host)))

    def _get(self, name: str, host: Host[Controller]) -> Frame:
        return vt.TABLE.encode(f"get {name}", host.address, host=host.options.host_id, mode=0)

    # -- requests -------------------------------------------------------------------------------------

    def questions(self, driver: MotorDriver[Controller]) -> Iterable[Frame]:
        reply = next(iter(driver.hosts.values())).options.host_id
        return (vt.TABLE.encode("PING", at, host=reply) for at in vt.ADDRESSES if at != reply)

    def frames(self, now: Nanos, pending: Pending[Controller]) -> Sequence[Frame]:
        host = pending.host
        if host is None:
            return pending.slice()
        host.own.answers.ask()
        return (self._get("state", host),)


def _inside(raw: int, unit: float) -> float | None:
    """Return a number of 32 bits; None at their ends, where it may as well be beyond."""
    return raw * unit if abs(raw) < (1 << 31) - 1 else None
