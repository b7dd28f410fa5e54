"""The one gate per motor: gear, sign, limits, age, latched faults, finiteness, claim.

Rules. Between this file and the wire nobody looks at limits again but the guard; between this file and
the brain nobody knows of gears. A joint gives exactly one command a step (`allow`), whatever the
brain said or did not say. Faults latch here until an operator clears them. Nothing can be switched
off: every limit and timeout is a positive finite number. Inside, all is at the output shaft; what goes
to the driver, and what comes from it, is at the device's shaft (one turn of the joint is `gear` turns
of the device, in the other sense if `sign` is -1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import Literal, TypeAlias

from gateway.core.limits import Limits, Profile
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from protocols.plugin import Spec

JointEvent: TypeAlias = msg.Feedback | msg.State | msg.Fault

FEEDBACK_LOST = -1
"""Our own fault code: the device fell silent while it was commanded."""
AT_REST = 0.02
"""Part of the velocity limit below which a braking joint is at rest."""
DISARMED_ITSELF = -2
"""Our own fault code: the device disarmed itself while it was commanded."""


@dataclass(frozen=True, slots=True)
class JointSettings:
    """A motor's part of the robot file that concerns every protocol alike."""

    limits: Limits
    gear: float = 1.0
    """Turns of the device's shaft per turn of the joint."""
    sign: Literal[1, -1] = 1
    on_command_timeout: Literal["idle", "hold"] = "idle"
    """What a silent brain means."""
    stop_action: Literal["idle", "hold", "brake"] = "idle"
    """The last word on stop, fault and exit. "brake": slow down within the limit of acceleration, then
    Idle; at once Idle if the joint itself is in fault or blind, or if the loop has failed."""
    on_fault: Literal["stop", "continue"] = "stop"
    """A fault or blindness of this joint stops the whole robot, or only this joint."""
    command_timeout: Nanos = 100 * MILLISECOND
    feedback_timeout: Nanos = 100 * MILLISECOND
    """Age of feedback after which the joint is blind; the brain goes slow and stands at shares of it."""


class Joint:
    """One motor's gate. Its state is plain data."""

    def __init__(self, name: str, settings: JointSettings, spec: Spec) -> None:
        self.name = name
        self.settings = settings
        self._commands = spec.commands
        self._ratio = settings.gear * settings.sign
        self.feedback = msg.Feedback(name, 0)
        """The newest of each quantity, at the output shaft; t is the newest motion's."""
        self.mode = Mode.OFFLINE
        self.detail = ""
        self._armed = False
        """Whether it was armed when it was last heard to say."""
        self.faults: dict[tuple[int, str], msg.Fault] = {}
        """Latched, in the order in which they came."""
        self.owned = False
        """Whether any command but Idle has gone out: only then does the safe word go out."""
        self.refused = ""
        """Why the brain's last command was not taken; "" if it was."""
        self.not_finite = 0
        """How many values that are not finite were kept from the wire or from the brain."""
        self._untold: list[msg.Fault] = []
        self._said: Command | None = None
        self._said_at: Nanos = 0
        self._out: Command = msg.Idle(name)
        self._out_at: Nanos = 0
        self._received_at: Nanos | None = None
        self._braking: Nanos | None = None
        """Since when the safe word brakes."""
        self._profile = Profile()

    # -- from the device ----------------------------------------------------------------------

    def on_event(self, event: JointEvent) -> JointEvent | None:
        """Move a driver's event to the output shaft and remember it; None if it must not go on."""
        if isinstance(event, msg.Feedback):
            return self._on_feedback(event)
        if isinstance(event, msg.State):
            if self._left_by_itself(event):
                self.latch(self._unexpected_disarm(event))
            if event.mode is not Mode.OFFLINE:  # what it does while it is silent, nobody knows
                self._armed = event.mode is Mode.ARMED
            self.mode, self.detail = event.mode, event.detail
            return event
        self.latch(event)
        return event

    def _left_by_itself(self, event: msg.State) -> bool:
        return (
            self._armed
            and event.mode in (Mode.READY, Mode.INITIALISING)
            and not isinstance(self._out, msg.Idle)
        )

    def _on_feedback(self, event: msg.Feedback) -> msg.Feedback | None:
        if not _finite(event):
            self.not_finite += 1
            return None
        ratio = self._ratio
        moved = msg.Feedback(
            event.motor,
            event.t,
            None if event.position is None else event.position / ratio,
            None if event.velocity is None else event.velocity / ratio,
            None if event.torque is None else event.torque * ratio,
            event.current,
            event.voltage,
            event.temperature,
        )
        old = self.feedback
        motion = moved.position is not None or moved.velocity is not None
        if motion:
            self._received_at = event.t
        self.feedback = msg.Feedback(
            self.name,
            event.t if motion else old.t,
            old.position if moved.position is None else moved.position,
            old.velocity if moved.velocity is None else moved.velocity,
            old.torque if moved.torque is None else moved.torque,
            old.current if moved.current is None else moved.current,
            old.voltage if moved.voltage is None else moved.voltage,
            old.temperature if moved.temperature is None else moved.temperature,
        )
        return moved

    def latch(self, fault: msg.Fault) -> None:
        """Keep a fault until it is cleared."""
        key = (fault.code, fault.name)
        if key not in self.faults:
            self.faults[key] = fault
            self._untold.append(fault)

    def take_unreported(self) -> list[msg.Fault]:
        """The faults that have latched since this was last asked."""
        unreported, self._untold = self._untold, []
        return unreported

    def clear(self) -> None:
        """An operator has cleared the faults; the joint starts anew, from where it is measured."""
        self.faults.clear()
        self._said = None
        self._profile.forget()

    def feedback_age(self, now: Nanos) -> Nanos | None:
        """The age of the newest motion; None if the device has never told any."""
        return None if self._received_at is None else now - self._received_at

    def feedback_lost(self, now: Nanos) -> bool:
        """Whether there is no feedback, or too old a one."""
        age = self.feedback_age(now)
        return age is None or age > self.settings.feedback_timeout

    def command_age(self, now: Nanos) -> Nanos | None:
        """The age of the brain's command; None if it has none."""
        return None if self._said is None else now - self._said_at

    # -- from the brain -----------------------------------------------------------------------

    def command(self, now: Nanos, said: Command | None, stopped: bool, last: bool = False) -> Command:
        """The one command of this step, at the device's shaft.

        `said` is what the brain says now, None if it says nothing new. `last`: nothing will follow, so
        there is no time to brake. A joint that went blind while it was armed latches a fault, for a
        motor that comes back must not start by itself."""
        if said is not None:
            self._take(now, said)
        if self.feedback_lost(now):
            self._latch_if_lost(now)
        wanted = self._wanted(now, stopped, last)
        if self._received_at is None:
            wanted = msg.Idle(self.name)  # never arm what was never heard
        out = self._limited(now, wanted)
        if not isinstance(out, msg.Idle):
            self.owned = True
        self._out, self._out_at = out, now
        return self._at_device(out)

    @property
    def braking_time(self) -> Nanos:
        """How long the safe word may brake: twice what the limits ask for."""
        if self.settings.stop_action != "brake":
            return 0
        return round(2.0 * self.settings.limits.velocity / self.settings.limits.acceleration * SECOND)

    def _safe_word(self, now: Nanos, last: bool) -> Command:
        if self.settings.stop_action == "hold":
            return msg.Hold(self.name)
        if self.settings.stop_action == "brake" and not last and self._may_brake(now):
            return msg.Velocity(self.name, 0.0)
        return msg.Idle(self.name)

    def _may_brake(self, now: Nanos) -> bool:
        if (
            self.faults
            or self.feedback_lost(now)
            or self.mode is not Mode.ARMED
            or isinstance(self._out, msg.Idle)
        ):
            return False
        if self._braking is None:
            self._braking = now
        moving = abs(self.feedback.velocity or 0.0) > AT_REST * self.settings.limits.velocity
        return moving and now - self._braking < self.braking_time

    def _latch_if_lost(self, now: Nanos) -> None:
        """A device that we armed, and that was armed when last heard: nobody knows what it does."""
        if self.owned and self._armed:
            self.latch(self._feedback_lost_fault(now))

    def _feedback_lost_fault(self, now: Nanos) -> msg.Fault:
        limit = f"{self.settings.feedback_timeout / MILLISECOND:g} ms"
        return msg.Fault(
            self.name,
            now,
            FEEDBACK_LOST,
            f"silent: no feedback for more than {limit}",
            "cable, supply, termination, the device's cyclic messages, or the device itself",
            f"mend it, then clear {self.name}",
        )

    def _unexpected_disarm(self, event: msg.State) -> msg.Fault:
        detail = f" ({event.detail})" if event.detail else ""
        return msg.Fault(
            self.name,
            event.t,
            DISARMED_ITSELF,
            f"disarmed itself: {event.mode}{detail}",
            "a restart, its watchdog, another host, or a second device at the same address",
            f"find out why, then clear {self.name}",
        )

    def _take(self, now: Nanos, said: Command) -> None:
        self.refused = self._objection(said)
        if not self.refused:
            self._said, self._said_at = said, now
        elif not _finite(said):
            self.not_finite += 1

    def _objection(self, said: Command) -> str:
        if type(said) not in self._commands:
            able = ", ".join(sorted(c.__name__ for c in self._commands))
            return f"{type(said).__name__} is not among what {self.name} can do: {able}"
        if not _finite(said):
            return f"a value of {said} is not finite"
        if isinstance(said, msg.Impedance) and (said.stiffness < 0.0 or said.damping < 0.0):
            return f"stiffness and damping of {said} must not be negative"
        return ""

    def _wanted(self, now: Nanos, stopped: bool, last: bool) -> Command:
        if stopped or self.faults:
            return self._safe_word(now, last)
        self._braking = None
        if self._said is None or now - self._said_at > self.settings.command_timeout:
            return msg.Hold(self.name) if self.settings.on_command_timeout == "hold" else msg.Idle(self.name)
        return self._said

    def _limited(self, now: Nanos, wanted: Command) -> Command:
        if self.mode is not Mode.ARMED:
            self._profile.forget()  # it starts from where the shaft is when the device is armed
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
        """Set a limit while running; "" or why not. A limit may be lowered or raised, never removed."""
        if key not in ("velocity", "acceleration", "torque"):
            return f"no limit {key!r} of {self.name}; there are velocity, acceleration, torque"
        if not (isfinite(value) and value > 0.0):
            return f"{self.name}.{key} must be a positive finite number, not {value}"
        old = self.settings.limits
        limits = Limits(
            value if key == "velocity" else old.velocity,
            value if key == "acceleration" else old.acceleration,
            value if key == "torque" else old.torque,
            old.position,
        )
        self.settings = replace(self.settings, limits=limits)
        return ""


def _finite(word: msg.Feedback | Command) -> bool:
    """Whether every number in the word is finite. Integers are times."""
    for name in word.__slots__:
        value = getattr(word, name)
        if isinstance(value, float) and not isfinite(value):
            return False
    return True
