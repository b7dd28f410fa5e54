"""The only place per motor for gear, sign, limits, ages, latched faults, finiteness and ownership.

Rules. Between this file and the bus, only the guard checks limits again; between this file and the brain,
gears are unknown. A joint gives exactly one command per step (`command`), whether or not the brain gave one.
Faults latch here until an operator clears them. Nothing can be switched off: every limit and timeout is a
positive finite number. Inside, everything is at the output shaft; what goes to the driver, and what comes
from it, is at the device's shaft (one turn of the joint is `gear` turns of the device, reversed if `sign`
is -1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import isfinite
from operator import attrgetter
from typing import Any, Literal, TypeAlias

from gateway.core.bounds import Positive, PositiveNanos
from gateway.core.limits import Limits, Profile
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from protocols.plugin import Spec

JointEvent: TypeAlias = msg.Feedback | msg.State | msg.Fault

FEEDBACK_LOST = -1
"""Our own fault code: the device sent no feedback while it was commanded."""
DISARMED_ITSELF = -2
"""Our own fault code: the device disarmed itself while it was commanded."""
ARMED_AGAINST_IDLE = -3
"""Our own fault code: the device is armed although Idle has been commanded for longer than `DISARMING`."""
DISARMING: Nanos = 500 * MILLISECOND
"""Time for a device to disarm after Idle, and to report it."""
AT_REST = 0.02
"""Fraction of the velocity limit below which a braking joint is at rest."""


@dataclass(frozen=True, slots=True)
class JointSettings:
    """A motor's settings in the robot file that are the same for every protocol."""

    limits: Limits
    gear: Positive = 1.0
    """Turns of the device's shaft per turn of the joint."""
    sign: Literal[1, -1] = 1
    on_command_timeout: Literal["idle", "hold"] = "idle"
    """What the joint does when the brain's command is older than `command_timeout`."""
    stop_action: Literal["idle", "hold", "brake"] = "idle"
    """The stop command: what is sent on stop, fault and exit. "brake": slow down within the limit of
    acceleration, then Idle; Idle at once if the joint itself is in fault or its feedback is lost, or if the
    loop has failed."""
    on_fault: Literal["stop", "continue"] = "stop"
    """Whether a fault or lost feedback of this joint stops the whole robot, or only this joint."""
    command_timeout: PositiveNanos = 100 * MILLISECOND
    feedback_timeout: PositiveNanos = 100 * MILLISECOND
    """Age at which feedback counts as lost; the brain slows down and stands at fractions of it."""


class Joint:
    """The joint of one motor. Its state is plain data."""

    def __init__(self, name: str, settings: JointSettings, spec: Spec) -> None:
        self.name = name
        self.settings = settings
        self._supported = spec.commands
        self._ratio = settings.gear * settings.sign
        self.feedback = msg.Feedback(name, 0)
        """The newest value of each quantity, at the output shaft; t is the newest motion's."""
        self.mode = Mode.OFFLINE
        self.detail = ""
        self.armed = False
        """Whether its last report of a mode was ARMED."""
        self.faults: dict[tuple[int, str], msg.Fault] = {}
        """Latched, in the order in which they came."""
        self.owned = False
        """Whether any command but Idle has been sent: only then is the stop command sent."""
        self.refused = ""
        """Why the brain's last command was refused; "" if it was accepted."""
        self.not_finite = 0
        """Number of messages from the device or the brain that were dropped for a non-finite value."""
        self._unreported: list[msg.Fault] = []
        self._command: Command | None = None
        """The brain's last accepted command."""
        self._command_at: Nanos = 0
        self._out: Command = msg.Idle(name)
        """The last command sent, at the output shaft."""
        self._out_at: Nanos = 0
        self._idle_at: Nanos = 0
        """When the first of the present Idles was sent."""
        self._received_at: Nanos | None = None
        self._braking: Nanos | None = None
        """When the stop command began to brake."""
        self._profile = Profile()

    # -- from the device ----------------------------------------------------------------------

    def on_event(self, event: JointEvent) -> JointEvent | None:
        """Store a driver's event and return it at the output shaft; None if it must be dropped."""
        if isinstance(event, msg.Feedback):
            return self._on_feedback(event)
        if isinstance(event, msg.State):
            if self._is_unexpected_disarm(event):
                self.latch(self._unexpected_disarm(event))
            if event.mode is not Mode.OFFLINE:  # an offline device may still be armed
                self.armed = event.mode is Mode.ARMED
            self.mode, self.detail = event.mode, event.detail
            self._check_idle(event.t)
            return event
        self.latch(event)
        return event

    def _is_unexpected_disarm(self, event: msg.State) -> bool:
        disarmed = event.mode in (Mode.READY, Mode.INITIALISING)
        return self.armed and disarmed and not isinstance(self._out, msg.Idle)

    def _check_idle(self, now: Nanos) -> None:
        """Latch a fault if the device is armed against our will: by a late frame, or another host."""
        obeys = self.mode is not Mode.ARMED or not isinstance(self._out, msg.Idle)
        if self.owned and not obeys and now - self._idle_at > DISARMING:
            self.latch(self._armed_against_idle(now))

    def _on_feedback(self, event: msg.Feedback) -> msg.Feedback | None:
        ratio, old, t = self._ratio, self.feedback, event.t
        position, velocity, torque = event.position, event.velocity, event.torque
        current, voltage, temperature = event.current, event.voltage, event.temperature
        for value in (position, velocity, torque, current, voltage, temperature):
            if value is not None and value - value != 0.0:  # infinities and NaN less themselves are NaN
                self.not_finite += 1
                return None
        position = None if position is None else position / ratio
        velocity = None if velocity is None else velocity / ratio
        torque = None if torque is None else torque * ratio
        moved = msg.Feedback(event.motor, t, position, velocity, torque, current, voltage, temperature)
        if position is None and velocity is None:
            t = old.t
        else:
            self._received_at = t
        self.feedback = msg.Feedback(
            self.name,
            t,
            old.position if position is None else position,
            old.velocity if velocity is None else velocity,
            old.torque if torque is None else torque,
            old.current if current is None else current,
            old.voltage if voltage is None else voltage,
            old.temperature if temperature is None else temperature,
        )
        return moved

    def latch(self, fault: msg.Fault) -> None:
        """Keep a fault until it is cleared."""
        key = (fault.code, fault.name)
        if key not in self.faults:
            self.faults[key] = fault
            self._unreported.append(fault)

    def take_unreported(self) -> list[msg.Fault]:
        """Return the faults that have latched since the last call."""
        unreported, self._unreported = self._unreported, []
        return unreported

    def clear(self) -> None:
        """Clear the faults; the joint starts anew, from its measured position."""
        self.faults.clear()
        self._command = None
        self._profile.forget()

    def feedback_age(self, now: Nanos) -> Nanos | None:
        """Return the age of the newest motion; None if the device has never reported any."""
        return None if self._received_at is None else now - self._received_at

    def feedback_lost(self, now: Nanos) -> bool:
        """True if there is no feedback, or it is older than the timeout."""
        age = self.feedback_age(now)
        return age is None or age > self.settings.feedback_timeout

    # -- from the brain -----------------------------------------------------------------------

    def command(self, now: Nanos, new: Command | None, stopped: bool, last: bool = False) -> Command:
        """Return the one command of this step, at the device's shaft.

        `new` is the brain's command of this step, None if it gave none. `last`: nothing will follow, so
        there is no time to brake. If feedback is lost while the device was armed, a fault latches, since
        a motor that comes back must not start by itself."""
        if new is not None:
            self._accept(now, new)
        if self.owned and self.armed and self.feedback_lost(now):
            self.latch(self._feedback_lost_fault(now))
        self._check_idle(now)
        wanted = self._wanted(now, stopped, last)
        if self._received_at is None:
            wanted = msg.Idle(self.name)  # never arm a device that has reported nothing
        out = self._limited(now, wanted)
        if not isinstance(out, msg.Idle):
            self.owned = True
        elif not isinstance(self._out, msg.Idle):
            self._idle_at = now
        self._out, self._out_at = out, now
        return self._at_device(out)

    @property
    def braking_time(self) -> Nanos:
        """Longest time that the stop command may brake: twice what the limits need."""
        if self.settings.stop_action != "brake":
            return 0
        return round(2.0 * self.settings.limits.velocity / self.settings.limits.acceleration * SECOND)

    def _stop_command(self, now: Nanos, last: bool) -> Command:
        if any(code == ARMED_AGAINST_IDLE for code, _ in self.faults):
            return msg.Idle(self.name)
        if self.settings.stop_action == "hold":
            return msg.Hold(self.name)
        if self.settings.stop_action == "brake" and not last and self._may_brake(now):
            return msg.Velocity(self.name, 0.0)
        return msg.Idle(self.name)

    def _may_brake(self, now: Nanos) -> bool:
        if self.faults or self.feedback_lost(now):
            return False
        if self.mode is not Mode.ARMED or isinstance(self._out, msg.Idle):
            return False
        if self._braking is None:
            self._braking = now
        moving = abs(self.feedback.velocity or 0.0) > AT_REST * self.settings.limits.velocity
        return moving and now - self._braking < self.braking_time

    def _feedback_lost_fault(self, now: Nanos) -> msg.Fault:
        limit = f"{self.settings.feedback_timeout / MILLISECOND:g} ms"
        return msg.Fault(
            self.name,
            now,
            FEEDBACK_LOST,
            f"silent: no feedback for more than {limit}",
            "cable, supply, termination, the device's cyclic messages, or the device itself",
            f"repair it, then clear {self.name}",
        )

    def _unexpected_disarm(self, event: msg.State) -> msg.Fault:
        detail = f" ({event.detail})" if event.detail else ""
        return msg.Fault(
            self.name,
            event.t,
            DISARMED_ITSELF,
            f"disarmed itself: {event.mode}{detail}",
            "a restart, its watchdog, another host, or a second device at the same address",
            f"find the cause, then clear {self.name}",
        )

    def _armed_against_idle(self, now: Nanos) -> msg.Fault:
        return msg.Fault(
            self.name,
            now,
            ARMED_AGAINST_IDLE,
            "armed without being commanded",
            "a frame that an adapter delivered late, another host, or a device that does not obey Idle",
            f"find the cause, then clear {self.name}",
        )

    def _accept(self, now: Nanos, new: Command) -> None:
        self.refused = self._objection(new)
        if not self.refused:
            self._command, self._command_at = new, now
        elif not _finite(new):
            self.not_finite += 1

    def _objection(self, new: Command) -> str:
        if type(new) not in self._supported:
            able = ", ".join(sorted(c.__name__ for c in self._supported))
            return f"{type(new).__name__} is not among what {self.name} can do: {able}"
        if not _finite(new):
            return f"a value of {new} is not finite"
        if isinstance(new, msg.Impedance) and (new.stiffness < 0.0 or new.damping < 0.0):
            return f"stiffness and damping of {new} must not be negative"
        return ""

    def _wanted(self, now: Nanos, stopped: bool, last: bool) -> Command:
        if stopped or self.faults:
            return self._stop_command(now, last)
        self._braking = None
        if self._command is None or now - self._command_at > self.settings.command_timeout:
            return msg.Hold(self.name) if self.settings.on_command_timeout == "hold" else msg.Idle(self.name)
        return self._command

    def _limited(self, now: Nanos, wanted: Command) -> Command:
        if self.mode is not Mode.ARMED:
            self._profile.forget()  # it starts at the position that the shaft has when the device is armed
        dt = min(now - self._out_at, self.settings.command_timeout) / SECOND
        return self._profile.limited(wanted, dt, self.feedback, self.settings.limits)

    def _at_device(self, out: Command) -> Command:
        ratio = self._ratio
        match out:
            case msg.Velocity(motor, velocity, torque):
                return msg.Velocity(motor, velocity * ratio, torque / ratio)
            case msg.Position(motor, position, velocity, torque):
                return msg.Position(motor, position * ratio, velocity * ratio, torque / ratio)
            case msg.Torque(motor, torque):
                return msg.Torque(motor, torque / ratio)
            case msg.Impedance(motor, position, velocity, torque, stiffness, damping):
                square = ratio * ratio
                return msg.Impedance(
                    motor,
                    position * ratio,
                    velocity * ratio,
                    torque / ratio,
                    stiffness / square,
                    damping / square,
                )
        return out

    def change(self, key: str, value: float) -> str:
        """Set a limit at run time; return "" or why not. A limit may be lowered or raised, never removed."""
        if key not in ("velocity", "acceleration", "torque"):
            return f"no limit {key!r} of {self.name}; there are velocity, acceleration, torque"
        if not (isfinite(value) and value > 0.0):
            return f"{self.name}.{key} must be a positive finite number, not {value}"
        change: dict[str, Any] = {key: value}
        self.settings = replace(self.settings, limits=replace(self.settings.limits, **change))
        return ""


def _finite(command: Command) -> bool:
    """True if every number in a command is finite."""
    kind = type(command)
    if kind is msg.Idle or kind is msg.Hold:
        return True
    # Infinities and NaN less themselves are NaN. (A generator would take twice as long.)
    return all([value - value == 0.0 for value in _NUMBERS[kind](command)])  # noqa: C419


_NUMBERS: dict[type[Command], Callable[[Any], tuple[float, ...]]] = {
    kind: attrgetter(*(field.name for field in fields(kind) if field.name != "motor"))
    for kind in (msg.Position, msg.Velocity, msg.Impedance)
}
_NUMBERS[msg.Torque] = lambda torque: (torque.torque,)
