"""The only place per motor for gear, sign, limits, ages, latched faults, finiteness and ownership.

Rules. Between this file and the bus, only the guard checks limits again; between this file and the brain,
gears are unknown. A joint gives exactly one command per step (`command`), whether or not the brain gave one.
Faults latch here until an operator clears them. Nothing can be switched off: every limit and timeout has
bounds on both sides, and a limit that is set at run time stays within the robot file's. Inside, everything
is at the output shaft; what goes to the driver, and what comes from it, is at the device's shaft (one turn of
the joint is `gear` turns of the device, reversed if `sign` is -1).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from math import copysign, inf
from operator import attrgetter
from typing import Annotated, Any, Literal, TypeAlias

from brain.control.pid import Loop, LoopSettings
from gateway.core import following
from gateway.core.bounds import Bounds
from gateway.core.following import Following
from gateway.core.limits import Limits, Profile, Swing, no_stronger, softened, spring_within
from gateway.core.reference import ANEW, Reference
from protocols import messages as msg
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from protocols.plugin import FeedbackKind, Spec

JointEvent: TypeAlias = msg.Feedback | msg.State | msg.Fault

FEEDBACK_LOST, DISARMED_ITSELF, ARMED_AGAINST_IDLE, STILL_ARMED = -1, -2, -3, -6
UNREFERENCED, BEYOND_TRAVEL, ANOTHER_DEVICE = -20, -21, -22
"""Our own fault codes (-4 and -5: `gateway.core.step`; from -7 on: `gateway.core.following`)."""
_OWN_FAULTS: dict[int, tuple[str, str, str]] = {
    FEEDBACK_LOST: (
        "silent: no feedback for more than {}",
        "cable, supply, termination, the device's cyclic messages, or the device itself",
        "it was armed when last reported: cut its supply; repair it",
    ),
    DISARMED_ITSELF: (
        "disarmed itself: {}",
        "a restart, its watchdog, another host, or a second device at the same address",
        "find the cause",
    ),
    ARMED_AGAINST_IDLE: (
        "armed without being commanded",
        "a frame that an adapter delivered late, another host, or a device that does not obey Idle",
        "find the cause",
    ),
    STILL_ARMED: (
        "{}: cut its supply",
        "nothing that is sent reaches it (cable, bus), it does not obey, or another motor turns it",
        "cut its supply; find the cause",
    ),
    following.NOT_FOLLOWED: (
        "does not follow its set-points: {}",
        "blocked, no torque (supply, phases), a stuck encoder, or a slower ramp of the device's own",
        "find the cause",
    ),
    following.RUNS_AWAY: (
        "runs away: {}",
        "a reversed or defective encoder, wrong phases, gains, or an outer force",
        "find the cause before anything moves",
    ),
    following.INCONSISTENT: (
        "reports a position and a velocity that do not agree: {}",
        "a frozen, jumping or slipping encoder, a wrong resolution, or a second device at the same address",
        "check the encoder and its settings",
    ),
    following.NO_TORQUE: (
        "does not give its torque: {}",
        "supply, phases, a limit of the device's own that is lower than limits.torque",
        "find the cause",
    ),
    UNREFERENCED: (
        "its position is not known: {}",
        "a turn that was lost with the supply, a restart, an encoder that starts at zero, or it was turned",
        "zero it or home it, or look where it stands and confirm it",
    ),
    BEYOND_TRAVEL: (
        "is beyond its end of travel: {}",
        "a torque or a load drove it there, a slipping coupling, or wrong limits",
        "bring it back within its range",
    ),
    ANOTHER_DEVICE: (
        "is another device: {}",
        "adapters or cables that were exchanged, ports that the machine has numbered anew, or a new device",
        "put the wires right, or give the robot file the new serial number",
    ),
}
"""By code: name (with a detail), cause, remedy."""
_NOT_OBEYING = frozenset(_OWN_FAULTS) - {
    *(FEEDBACK_LOST, DISARMED_ITSELF, UNREFERENCED, BEYOND_TRAVEL, ANOTHER_DEVICE)
}
"""With such a fault a device is sent Idle, whatever its stop action."""
_BY_TORQUE = (msg.Position, msg.Velocity)
"""What a loop of our own reaches by torque."""
MAX_FAULTS = 64
"""Faults that latch, whatever a device reports; our own find room beside them."""
_REFERENCES = frozenset({"Zero", "Home"})
"""Requests after which the position is known."""
_OWN_MOTION = _REFERENCES | {"Reboot"}
"""Requests under which a device moves, or gives its position another value, by itself."""

DISARMING: Nanos = 500 * MILLISECOND
"""Time for a device to disarm after Idle, and to report it."""
BRAKING_MOST: Nanos = 2 * SECOND
"""The longest braking, whatever the limits are."""
HOMING_MOST: Nanos = 60 * SECOND
"""The longest own motion of a device, during which its set-points are not compared with what it measures."""
AT_REST = 0.02
"""Fraction of the velocity limit below which a braking joint is at rest,"""
REST_TIME: Nanos = 100 * MILLISECOND
"""if for this long: a wheel that slips stands for a moment, and is turned again by its base."""
IN_FORCE: Nanos = 5 * MILLISECOND
"""After this time a set-point has arrived at its device."""
FADING: Nanos = SECOND
"""In this time the torque that carries a load fades, when its device is taken over, and when it is lowered at
the end of a run;"""
LOWERING, LOWERED = 2500 * MILLISECOND, 0.05
"""after this time at most the joint is let go, or when it has come to rest: slower than that, in rad/s."""
DOWNWARDS, CARRIED = 0.1, 0.05
"""Shares of the limits: of the velocity at which a load is followed down, of a torque that carries none."""
ROUNDING = 1e-9
"""Share of a device's largest torque that is never asked for, lest it be refused after the gear."""
LEAST_SHARE = 0.05
"""Of a limit in the robot file: the least that it may be set to while it runs."""

TimeoutNanos: TypeAlias = Annotated[Nanos, Bounds(MILLISECOND, 2 * SECOND)]


@dataclass(frozen=True, slots=True)
class JointSettings:
    """A motor's settings in the robot file that are the same for every protocol."""

    limits: Limits
    gear: Annotated[float, Bounds(1e-3, 1e4)] = 1.0
    """Turns of the device's shaft per turn of the joint."""
    sign: Literal[1, -1] = 1
    on_command_timeout: Literal["idle", "hold"] = "idle"
    """What the joint does when the brain's command is older than `command_timeout`. "hold": with the torque
    of the last command, if that was to a position, so that the load stays where it is."""
    stop_action: Literal["idle", "hold", "brake"] = "idle"
    """The stop command: what is sent on stop, fault and exit. "brake": slow down within the limit of
    acceleration, then Idle; Idle at once if the joint itself is in fault or its feedback is lost, or if the
    loop has failed."""
    unattended: Literal["held", "released"] = "held"
    """What becomes of the load when the gateway ends. "released": it is known that the device lets go of it
    (its watchdog), and it may hold until then (stop_action). It is let down first: against the damping of its
    springs, or else slowly to where it pulls, if its torque is measured; the last command is Idle."""
    on_fault: Literal["stop", "continue"] = "stop"
    """Whether a fault or lost feedback of this joint stops the whole robot, or only this joint."""
    command_timeout: TimeoutNanos = 100 * MILLISECOND
    feedback_timeout: TimeoutNanos = 100 * MILLISECOND
    """Age at which feedback counts as lost; the brain slows down and stands at fractions of it."""
    following_time: Annotated[Nanos, Bounds(100 * MILLISECOND, SECOND)] = 300 * MILLISECOND
    """For how long what is measured may be out of its bounds about the set-points (`following`)."""
    following_share: Annotated[float, Bounds(0.05, 0.5)] = 0.3
    """Share of a set-point of velocity by which it need not be followed."""
    serial: str = ""
    """The serial number that the device must have, in hexadecimal digits as `gateway motor dump` prints it:
    without it nothing arms the device. "": any."""
    loop: LoopSettings | None = None
    """Positions and velocities are reached by torque, at every step; None: by the device's own loops."""

    def __post_init__(self) -> None:
        if self.serial and not re.fullmatch("[0-9A-Fa-f]{1,32}", self.serial):
            raise ValueError(f"serial: found {self.serial!r}, expected hexadecimal digits")

    def lets_down(self, spec: Spec) -> bool:
        """True if a load can be let down: by a spring, or by a velocity while its torque is measured."""
        return msg.Impedance in spec.commands or self.turns_down(spec)

    def turns_down(self, spec: Spec) -> bool:
        """True if a load can be let down by a velocity."""
        return msg.Velocity in spec.commands and "Feedback.torque" in spec.ranges

    def commands(self, spec: Spec) -> frozenset[type[Command]]:
        """Return the commands that the joint takes of the brain: more than its device, with a loop."""
        by_torque = self.loop is not None and msg.Torque in spec.commands
        return spec.commands | {*_BY_TORQUE} if by_torque else spec.commands


class Joint:
    """The joint of one motor. Its state is plain data."""

    def __init__(self, name: str, settings: JointSettings, spec: Spec) -> None:
        self.name = name
        self.settings = settings
        self._file = settings.limits
        """The robot file's limits, which no change exceeds,"""
        self._stopping = replace(settings.limits, jerk=None)
        """and those of a stop: as hard as the acceleration allows."""
        self._supported = settings.commands(spec)
        self._loop = Loop() if settings.loop is not None and msg.Torque in spec.commands else None
        """In place of the device's own."""
        able = spec.ranges.get("Torque.torque")
        most = min(-able.low, able.high) if able else inf
        self._strongest = settings.gear * most * (1.0 - ROUNDING)
        """N·m at the output shaft that the device can be commanded"""
        self._holds_loads = "Hold.torque" in spec.ranges
        self._feeds_velocity = "Position.velocity" in spec.ranges
        """Whether Position takes the velocity on the way; else the device follows the position alone."""
        self._feeds_torque = "Position.torque" in spec.ranges
        """Likewise a torque: else its own loop must find what the load takes."""
        self._gains = spec.gains
        """Of the spring and damper that the device makes of Position, Velocity and Hold"""
        able_to_carry = {kind for kind in (msg.Hold, *_BY_TORQUE) if f"{kind.__name__}.torque" in spec.ranges}
        self._carries = able_to_carry if self._loop is None else able_to_carry | {*_BY_TORQUE}
        """Commands that take the torque of a load."""
        self._taken_over: tuple[Nanos, float] = (0, 0.0)
        """When a device was first commanded that ran already, and the torque that it gave then [N·m]."""
        self._replies_only = spec.feedback is FeedbackKind.REPLY
        self.open_loop = spec.feedback is FeedbackKind.NONE
        """Whether its device reports nothing: what it does is what it was told, as far as anybody knows."""
        self._presumed = 0.0
        """rad that such a joint has turned, if it did as it was told, up to the last command."""
        self._ratio = settings.gear * settings.sign
        self._following = Following(
            settings.limits, spec, settings.gear, settings.following_time, settings.following_share
        )
        self.feedback = msg.Feedback(name, 0)
        """The newest value of each quantity, at the output shaft; t is the newest motion's."""
        self.mode = Mode.OFFLINE
        self.detail = ""
        self.armed = False
        """Whether its last report of a mode was ARMED."""
        self._demanded = int(settings.serial, 16) if settings.serial else None
        self._serial: int | None = None
        """Of the device, as read since it was last silent."""
        self.faults: dict[tuple[int, str], msg.Fault] = {}
        """Latched, in the order in which they came."""
        self.owned = False
        """Whether any command but Idle has been sent: only then is the stop command sent."""
        self.refused = ""
        """Why the brain's last command was refused; "" if it was accepted."""
        self._noted = ""
        """The refusal that was last noted: a command is repeated at every step."""
        self._reference = Reference(settings.limits, spec, settings.gear)
        self._reading: tuple[Nanos, float] | None = None
        """The newest position of this step, with its time."""
        self._by_position = settings.limits.position is not None
        """Whether it matters where its zero is: it has a range, or was commanded to positions."""
        self._reach = settings.limits.margin
        """rad: how far outside its range it may be."""
        self._held: float | None = None
        """rad, where the first of the present Holds was given."""
        self._intended: Command = msg.Idle(name)
        """The last command sent, before the spring that makes it was softened."""
        self._unreported: list[msg.Fault] = []
        self._command: Command | None = None
        """The brain's last accepted command."""
        self._command_at: Nanos = 0
        self._out: Command = msg.Idle(name)
        """The last command sent, at the output shaft."""
        self._out_at: Nanos = 0
        self._idle_at: Nanos = 0
        """When the first of the present Idles was sent."""
        self._idle_until: Nanos | None = None
        """When the last Idle was sent, if the device has not been disarmed since."""
        self.driven_since: Nanos | None = None
        """When the first of the present set-points was sent; None: none was, since Idle."""
        self._armed_at: Nanos = 0
        self._disarmed = True
        """Whether the device has reported being disarmed since the last command but Idle."""
        self._own_motion: tuple[str, Nanos] | None = None
        """The request under which the device moves by itself, and since when."""
        self._received_at: Nanos | None = None
        self._reports_since: Nanos | None = None
        self._position_at: Nanos | None = None
        self._position_lost = False
        """Whether the device moves on without reporting its position: that is beyond its range."""
        self._braking: Nanos | None = None
        """When the stop command began to brake."""
        self._moved_at: Nanos = 0
        """When it was last not at rest, while braking."""
        self._damping = spec.gains[1] * self._ratio**2 if spec.gains else 0.0
        """N·m·s/rad, of the last spring that was commanded, before that of the device's own Position"""
        self._turns_down = settings.turns_down(spec)
        self._carried = 0.0
        """N·m, when its load began to be lowered"""
        self._profile = Profile(spec.feedback_period / SECOND)
        self._swing = Swing(spec.feedback_period / SECOND)

    # -- from the device ----------------------------------------------------------------------

    def on_event(self, event: JointEvent) -> JointEvent | None:
        """Store a driver's event and return it at the output shaft; None if it must be dropped."""
        if isinstance(event, msg.Feedback):
            return self._on_feedback(event)
        if isinstance(event, msg.State):
            if self._is_unexpected_disarm(event):
                detail = f" ({event.detail})" if event.detail else ""
                self.latch(self._fault(event.t, DISARMED_ITSELF, f"{event.mode}{detail}"))
            restarts = event.mode is Mode.INITIALISING and self.mode is not Mode.INITIALISING
            if restarts or event.mode is Mode.OFFLINE:  # it may be another one when it is back
                self._serial = None
            if event.mode is not Mode.OFFLINE:  # an offline device may still be armed
                if event.mode is Mode.ARMED and not self.armed:
                    self._armed_at = event.t
                self.armed = event.mode is Mode.ARMED
                self._disarmed = self._disarmed or not self.armed
            self.mode, self.detail = event.mode, event.detail
            self._check_idle(event.t)
            return event
        self.latch(event)
        return event

    @property
    def unidentified(self) -> bool:
        """Whether a serial number is demanded of the device, and has not been read."""
        return self._demanded is not None and self._serial is None

    def is_heard(self, now: Nanos) -> bool:
        """True if its device reports a state, or its motion."""
        return self.mode is not Mode.OFFLINE or not self.feedback_lost(now)

    def identify(self, serial: int) -> None:
        """Take the serial number that answers for the device; one that is wrong stays until it is silent."""
        if self._serial in (None, self._demanded):
            self._serial = serial

    def _is_unexpected_disarm(self, event: msg.State) -> bool:
        if not self.armed or event.mode not in (Mode.READY, Mode.INITIALISING):
            return False
        idle_until, self._idle_until = self._idle_until, None
        obeyed = idle_until is not None and event.t - idle_until <= DISARMING  # a command came after Idle
        ends = obeyed or self._braking is not None  # braking ends in Idle, too
        return not ends and not isinstance(self._out, msg.Idle)

    def _check_idle(self, now: Nanos) -> None:
        """Latch a fault if the device is armed, or drives its shaft, against our will: it does not obey, or a
        late frame or another host has armed it."""
        if not self.owned or not isinstance(self._out, msg.Idle) or now - self._idle_at <= DISARMING:
            return
        speed = abs(self.feedback.velocity or 0.0)
        if self.mode is Mode.ARMED:
            code = ARMED_AGAINST_IDLE if self._disarmed else STILL_ARMED
            self.latch(self._fault(now, code, "still armed"))
        elif speed > (1.0 + following.FAST) * self._file.velocity and not self.feedback_lost(now):
            self.latch(self._fault(now, STILL_ARMED, "still turns at more than its limit of velocity"))

    def on_request(self, now: Nanos, request: msg.Request) -> None:
        """Note a request that is passed to the device."""
        kind = type(request).__name__
        if kind in _OWN_MOTION:
            self._own_motion = kind, now
        if kind in _REFERENCES:
            self._reference.give_anew(now + HOMING_MOST)

    def on_answer(self, now: Nanos, request: str, *, done: bool) -> None:
        """Note the answer to a request of this name."""
        if self._own_motion is not None and self._own_motion[0] == request:
            self._own_motion = None
            self._following.forget_motion()
        if request in _REFERENCES:
            self._reference.give_anew(now + ANEW if done else now)
            if done:
                self.confirm()

    def confirm(self) -> None:
        """Take the reported position as the true one: it was zeroed, homed, or a person has looked."""
        self._reference.confirm()
        for key in [key for key in self.faults if key[0] == UNREFERENCED]:
            del self.faults[key]

    def _on_feedback(self, event: msg.Feedback) -> msg.Feedback | None:
        ratio, old, t = self._ratio, self.feedback, event.t
        position, velocity, torque = event.position, event.velocity, event.torque
        current, voltage, temperature = event.current, event.voltage, event.temperature
        for value in (position, velocity, torque, current, voltage, temperature):
            if value is not None and value - value != 0.0:  # infinities and NaN less themselves are NaN
                return None
        position = None if position is None else position / ratio
        velocity = None if velocity is None else velocity / ratio
        torque = None if torque is None else torque * ratio
        moved = msg.Feedback(event.motor, t, position, velocity, torque, current, voltage, temperature)
        if velocity is not None:
            self._swing.on_velocity(t, velocity)
        if position is None and velocity is None:
            t = old.t
        else:
            self._received_at = t
            self._reports_since = t if self._reports_since is None else self._reports_since
            self._following.on_motion(t, position, velocity)
        if position is not None:
            self._position_at, self._position_lost = t, False
            self._reading = t, position
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
        if key not in self.faults and len(self.faults) < (MAX_FAULTS if fault.code > 0 else 2 * MAX_FAULTS):
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
        self._following.restart()
        self._reach = max(self.settings.limits.margin, self._outside())

    def take_refused(self) -> str:
        """Return why the brain's command is refused, if that is news; else ""."""
        refused, before = self.refused, self._noted
        self._noted, self.refused = refused, ""
        return refused if refused != before else ""

    @property
    def sent(self) -> Command:
        """The last command sent, at the output shaft."""
        return self._out

    def feedback_age(self, now: Nanos) -> Nanos | None:
        """Return the age of the newest motion; None if the device has never reported any."""
        return None if self._received_at is None else max(0, now - self._received_at)

    def presumed(self, now: Nanos) -> msg.Feedback | None:
        """Return the motion of an open-loop joint if it does as it was told: nothing of it is measured. None:
        the device of another joint reports its motion."""
        if not self.open_loop:
            return None
        told = self._out.velocity if self.armed and isinstance(self._out, msg.Velocity) else 0.0
        span = min(now - self._out_at, self.settings.command_timeout) / SECOND if told else 0.0
        return msg.Feedback(self.name, now, self._presumed + told * span, told)

    def feedback_lost(self, now: Nanos) -> bool:
        """True if there is no feedback, or it is older than the timeout; never of an open-loop joint, which
        has none to lose."""
        if self.open_loop:
            return False
        received = self._received_at
        return received is None or now - received > self.settings.feedback_timeout

    # -- from the brain -----------------------------------------------------------------------

    def command(
        self, now: Nanos, new: Command | None, stopped: bool, last: bool = False, leaving: bool = False
    ) -> Command:
        """Return the one command of this step, at the device's shaft.

        `new` is the brain's command of this step, None if it gave none. `leaving`: the run ends; `last`:
        nothing will follow, so there is no time to brake, or to lower a load. If feedback is lost while the
        device was armed, a fault latches, since a motor that comes back must not start by itself."""
        if new is not None:
            self._accept(now, new)
        if (presumed := self.presumed(now)) is not None:
            self._presumed = presumed.position or 0.0
        if self._received_at is not None and self._received_at > now:
            self._received_at = now  # a stamp from the future must not keep the joint from going blind
        if self.owned and self.armed and self.feedback_lost(now):
            limit = f"{self.settings.feedback_timeout / MILLISECOND:g} ms"
            self.latch(self._fault(now, FEEDBACK_LOST, limit))
        self._forget_lost_position()
        self._check_identity(now)
        self._check_reading(now)
        self._judge(now, stopped)
        self._check_idle(now)
        wanted = self._wanted(now, stopped, last, leaving)
        out = self._limited(now, self._placed(now, wanted, stopped), stopped)
        self._intended = self._with_load(now, out)
        out = self._softened(now, self._intended)
        if isinstance(self._intended, msg.Impedance) and not stopped:
            self._damping = self._intended.damping  # not that of a softened spring: it lowers the load
        if not isinstance(out, msg.Idle):
            self.owned = True
            self._disarmed = False
            self.driven_since = now if self.driven_since is None else self.driven_since
        else:
            self.driven_since = None
            self._idle_until = now if self.armed else None
            if not isinstance(self._out, msg.Idle):
                self._idle_at = now
        dt, self._out, self._out_at = (now - self._out_at) / SECOND, out, now
        return self._at_device(out if self._loop is None else self._by_torque(out, dt, self._loop))

    def _with_load(self, now: Nanos, out: Command) -> Command:
        """Return a command with the torque that a running device gave when it was taken over, less and less
        of it: a spring that begins where its load stands gives none, and drops it."""
        if not isinstance(out, (msg.Hold, *_BY_TORQUE)):
            return out
        if not self.owned and self.armed:
            self._taken_over = now, self.feedback.torque or 0.0
        since, carried = self._taken_over
        torque = carried * (1.0 - (now - since) / FADING)
        if torque * carried <= 0.0 or out.torque or type(out) not in self._carries:
            return out
        return replace(out, torque=self.settings.limits.torque_now(torque, self.feedback))

    def _by_torque(self, out: Command, dt: float, loop: Loop) -> Command:
        """Return the torque with which a set-point is reached; any other command as it is."""
        measured, limits, settings = self.feedback, self.settings.limits, self.settings.loop
        if not isinstance(out, (msg.Position, msg.Velocity)) or settings is None:
            loop.reset()
            return out
        ahead = 0.0
        if isinstance(out, msg.Position):
            ahead = out.position - (measured.position or 0.0)
        dt = min(dt, self.settings.command_timeout / SECOND)
        most = min(limits.torque, self._strongest)
        torque = loop.step(ahead, out.velocity, measured.velocity or 0.0, out.torque, dt, most, settings)
        if self.mode is not Mode.ARMED:
            loop.reset()
            torque = 0.0
        return msg.Torque(self.name, limits.torque_now(torque, measured))

    def _forget_lost_position(self) -> None:
        known, newest = self._position_at, self._received_at
        if known is None or newest is None or newest - known <= self.settings.feedback_timeout:
            return
        self._position_at, self._position_lost = None, True
        self.feedback = replace(self.feedback, position=None)
        self._profile.forget()
        self.refused = "its position is lost: the device no longer reports it"

    # -- where it is ------------------------------------------------------------------------------

    def _outside(self) -> float:
        """Return how far outside its range it is [rad]."""
        position = self.feedback.position
        return 0.0 if position is None else self.settings.limits.outside(position)

    def _check_identity(self, now: Nanos) -> None:
        if self._demanded is not None and self._serial not in (None, self._demanded):
            numbers = f"serial number {self._serial:X}, the robot file demands {self._demanded:X}"
            self.latch(self._fault(now, ANOTHER_DEVICE, numbers))

    def _check_reading(self, now: Nanos) -> None:
        """Latch a fault if the position has jumped, or the shaft has left its range under a command."""
        reading, self._reading = self._reading, None
        if reading is not None and self._by_position:
            t, position = reading
            if wrong := self._reference.read(t, position, self.feedback.velocity or 0.0):
                self.latch(self._fault(now, UNREFERENCED, wrong))
        outside = self._outside()
        if isinstance(self._out, msg.Idle) or not self.armed:
            self._reach = max(self.settings.limits.margin, outside)
        elif outside > self._reach and self._own_motion is None:
            self._reach = outside
            self.latch(self._fault(now, BEYOND_TRAVEL, self._place()))

    def _place(self) -> str:
        low, high = self.settings.limits.position or (-inf, inf)
        return f"reads {self.feedback.position or 0.0:.4g} rad, limits [{low:g}, {high:g}]"

    def _placed(self, now: Nanos, wanted: Command, stopped: bool) -> Command:
        """Return what is wanted, if it is known where the joint is, and near enough to its range to begin."""
        if stopped or self.faults or isinstance(wanted, msg.Idle):
            return wanted
        if self.unidentified and isinstance(self._out, msg.Idle):
            self.refused = "the serial number that the robot file demands has not been read"
            return msg.Idle(self.name)
        why = self._reference.lost and f"{self._reference.lost}: zero it or home it, or confirm it"
        margin = self.settings.limits.margin
        if not why and self._by_position and self._measures_no_position(now):
            why = "it reports no position, or one beyond what it measures: a turn lost? zero it or home it"
        if not why and isinstance(self._out, msg.Idle) and self._outside() > margin:
            why = (
                f"{self._place()}: a turn lost? zero it or home it; if it is there, "
                f"move it by hand to within {margin:g} rad of its range"
            )
        if not why:
            self._by_position = self._by_position or isinstance(wanted, msg.Position | msg.Impedance)
            return wanted
        if self.settings.on_fault == "stop":  # others may depend on where it is
            self.latch(self._fault(now, UNREFERENCED, why))
        else:
            self.refused = why
        return self._hold() if self.armed and isinstance(self._out, msg.Hold) else msg.Idle(self.name)

    def _measures_no_position(self, now: Nanos) -> bool:
        """Whether the device has reported its motion for a while, and never a position."""
        since = self._reports_since
        late = since is not None and now - since > self.settings.feedback_timeout
        return late and self.feedback.position is None

    def _softened(self, now: Nanos, out: Command) -> Command:
        """Return a command that the device makes a spring of, softened where that would pull too hard now, or
        once it is in force."""
        if not isinstance(out, msg.Hold) or self.mode is not Mode.ARMED or self._held is None:
            self._held = self.feedback.position
        there, limits = self._coming(now), self.settings.limits
        if isinstance(out, msg.Impedance):
            return no_stronger(spring_within(out, there, limits), self.feedback, limits)
        if self._gains is None or not isinstance(out, msg.Position | msg.Velocity | msg.Hold):
            return out
        stiffness, damping = (gain * self._ratio * self._ratio for gain in self._gains)
        return softened(out, self._held, stiffness, damping, there, limits)

    def _coming(self, now: Nanos) -> msg.Feedback:
        """Return the motion as it is expected when what is sent now is in force."""
        here, age = self.feedback, self.feedback_age(now)
        if here.position is None or here.velocity is None or age is None:
            return here
        return replace(here, position=here.position + here.velocity * (age + IN_FORCE) / SECOND)

    def _judge(self, now: Nanos, stopped: bool) -> None:
        """Latch a fault if the motion is not what the last command was to make."""
        if self._own_motion is not None and now - self._own_motion[1] > HOMING_MOST:
            self._own_motion = None
        age = self.feedback_age(now)
        if age is None or self.mode is not Mode.ARMED or isinstance(self._out, msg.Idle):
            self._following.restart()
        elif self._own_motion is None and (
            found := self._following.judge(now, self._intended, self.feedback, age)
        ):
            code, detail = found
            if stopped and isinstance(self._out, msg.Hold):
                code, detail = STILL_ARMED, f"still moves ({detail})"
            self.latch(self._fault(now, code, detail))

    @property
    def braking_time(self) -> Nanos:
        """Longest time that the stop command may brake: twice what the limits need, within a bound; or lower
        a load."""
        if self._lowers:
            return LOWERING
        if self.settings.stop_action != "brake":
            return 0
        needed = 2.0 * self._file.velocity / self._file.acceleration
        return round(min(needed * SECOND, BRAKING_MOST))

    @property
    def hurried_braking_time(self) -> Nanos:
        """Longest time that the stop command may still brake once the end of a run is hurried: half as much
        again as the present velocity needs, so that it comes to rest no later. A load is lowered no faster,
        since let go it would fall."""
        if self._lowers or self.settings.stop_action != "brake":
            return self.braking_time
        wanted = self._out.velocity if isinstance(self._out, msg.Velocity) else 0.0
        speed = max(abs(self.feedback.velocity or 0.0), abs(wanted))
        return round(1.5 * speed / self._file.acceleration * SECOND) + REST_TIME

    @property
    def _lowers(self) -> bool:
        """Whether its load is lowered when the run ends."""
        settings = self.settings
        released = settings.stop_action == "hold" and settings.unattended == "released"
        able = self._damping > 0.0 or self._turns_down
        return released and self.owned and self.armed and able

    def _stop_command(self, now: Nanos, last: bool, leaving: bool) -> Command:
        if any(code in _NOT_OBEYING for code, _ in self.faults):
            return msg.Idle(self.name)
        if self.settings.stop_action == "hold" and self.armed:  # Hold would arm another
            if leaving and not last and self._lowers:
                return self._lower(now)
            released = last and self.settings.unattended == "released"
            return msg.Idle(self.name) if released else self._hold()
        if self.settings.stop_action == "brake" and not last and self._may_brake(now):
            return msg.Velocity(self.name, 0.0)
        return msg.Idle(self.name)

    def _hold(self) -> msg.Hold:
        """Return the command to hold, with the torque that has carried the load so far."""
        out = self._out
        if self._holds_loads and isinstance(out, msg.Position | msg.Impedance | msg.Hold):
            return msg.Hold(self.name, out.torque)
        return msg.Hold(self.name)

    def _lower(self, now: Nanos) -> Command:
        """Return the next command of letting a load down: less and less torque, and damping; then Idle. A
        device without springs follows the load down instead."""
        if self._braking is None:
            self._braking, self._carried = now, self._hold().torque or self.feedback.torque or 0.0
            self._moved_at = now + FADING if self._damping else now - REST_TIME
        since, position = now - self._braking, self.feedback.position
        if not self._damping:
            return self._turn_down(now, since)
        if abs(self.feedback.velocity or 0.0) > LOWERED:
            self._moved_at = max(self._moved_at, now)
        down = since >= LOWERING or now - self._moved_at >= REST_TIME
        if down or position is None or self.feedback_lost(now):
            return msg.Idle(self.name)
        torque = self._carried * max(0.0, 1.0 - since / FADING)
        return msg.Impedance(self.name, position, 0.0, torque, 0.0, self._damping)

    def _turn_down(self, now: Nanos, since: Nanos) -> Command:
        """Return the next command of turning slowly to where a load pulls, until it is not carried any more;
        then Idle."""
        measured = self.feedback.torque or 0.0
        if measured * self._carried > 0.0 and abs(measured) > CARRIED * self._file.torque:
            self._moved_at = now
        if since >= LOWERING or now - self._moved_at >= REST_TIME or self.feedback_lost(now):
            return msg.Idle(self.name)
        return msg.Velocity(self.name, -copysign(DOWNWARDS * self._file.velocity, self._carried))

    def _may_brake(self, now: Nanos) -> bool:
        if self.faults or self.feedback_lost(now):
            return False
        if self.mode is not Mode.ARMED or isinstance(self._out, msg.Idle):
            return False
        if self._braking is None:
            self._braking = self._moved_at = now
        speed = getattr(self._out, "velocity", 0.0) if self.open_loop else self.feedback.velocity or 0.0
        if abs(speed) > AT_REST * self.settings.limits.velocity:
            self._moved_at = now
        return now - self._moved_at < REST_TIME and now - self._braking < self.braking_time

    def _fault(self, now: Nanos, code: int, detail: str = "") -> msg.Fault:
        name, cause, remedy = _OWN_FAULTS[code]
        return msg.Fault(
            self.name, now, code, name.format(detail), cause, f"{remedy}, then clear {self.name}"
        )

    def _accept(self, now: Nanos, new: Command) -> None:
        # One that was accepted before is as good now: a command never changes.
        refused = "" if new is self._command else self._objection(new)
        if not refused:
            self._command, self._command_at = new, now
        self.refused = refused

    def _objection(self, new: Command) -> str:
        if type(new) not in self._supported:
            able = ", ".join(sorted(c.__name__ for c in self._supported))
            return f"{type(new).__name__} is not among what {self.name} can do: {able}"
        if not _finite(new):
            return f"a value of {new} is not finite"
        if isinstance(new, msg.Impedance) and (new.stiffness < 0.0 or new.damping < 0.0):
            return f"stiffness and damping of {new} must not be negative"
        return ""

    def _wanted(self, now: Nanos, stopped: bool, last: bool, leaving: bool) -> Command:
        if stopped or self.faults:
            return self._stop_command(now, last, leaving)
        self._braking = None
        if self._command is None or now - self._command_at > self.settings.command_timeout:
            return self._hold() if self.settings.on_command_timeout == "hold" else msg.Idle(self.name)
        return self._command

    def _limited(self, now: Nanos, wanted: Command, stopped: bool) -> Command:
        if self._received_at is None and not isinstance(wanted, msg.Idle) and not self.open_loop:
            # Nothing arms a device that has reported nothing, unless it reports only what it is commanded.
            wanted = self._at_rest(msg.Torque, msg.Velocity) if self._replies_only else msg.Idle(self.name)
        elif self._position_lost and isinstance(wanted, msg.Hold):
            wanted = self._at_rest(msg.Velocity)
        if not self._is_known_to_obey:
            self._profile.forget()  # it starts at the position that the shaft has then
        dt = max(0, min(now - self._out_at, self.settings.command_timeout)) / SECOND
        limits = self._stopping if stopped or self.faults else self.settings.limits
        out = self._profile.limited(wanted, dt, self.feedback, limits)
        if isinstance(out, msg.Torque):
            out = msg.Torque(self.name, self._swing.within(out.torque, dt, limits.velocity))
        return out

    @property
    def _is_known_to_obey(self) -> bool:
        """Whether it is armed, was sent a set-point, and has reported its motion since both."""
        if self.open_loop:
            return self.mode is Mode.ARMED
        sent, received = self.driven_since, self._received_at
        answered = sent is not None and received is not None and received > max(sent, self._armed_at)
        return answered and self.mode is Mode.ARMED

    def on_held_back(self) -> None:
        """Note that the driver sends the device no set-point yet: it still prepares it."""
        self.driven_since = None

    def _at_rest(self, *kinds: type[msg.Torque | msg.Velocity]) -> Command:
        """Return the first of these commands that the device has, with the value 0, else Idle."""
        able = (kind(self.name, 0.0) for kind in kinds if kind in self._supported)
        return next(able, msg.Idle(self.name))

    def _at_device(self, out: Command) -> Command:
        ratio = self._ratio
        match out:
            case msg.Velocity(motor, velocity, torque):
                return msg.Velocity(motor, velocity * ratio, torque / ratio)
            case msg.Position(motor, position, velocity, torque):
                ahead = velocity * ratio if self._feeds_velocity else 0.0
                return msg.Position(motor, position * ratio, ahead, torque / ratio * self._feeds_torque)
            case msg.Torque(motor, torque):
                return msg.Torque(motor, torque / ratio)
            case msg.Hold(motor, torque) if torque:
                return msg.Hold(motor, torque / ratio)
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
        """Set a limit at run time, to no more than the robot file's; return "" or why not."""
        if key not in ("velocity", "acceleration", "torque"):
            return f"no limit {key!r} of {self.name}; there are velocity, acceleration, torque"
        most: float = getattr(self._file, key)
        if not LEAST_SHARE * most <= value <= most:
            bounds = f"from {LEAST_SHARE * most:g} to the robot file's {most:g}"
            return f"{self.name}.{key} must be {bounds}, not {value:g}"
        change: dict[str, Any] = {key: value}
        self.settings = replace(self.settings, limits=replace(self.settings.limits, **change))
        return ""


def _finite(command: Command) -> bool:
    """True if every number in a command is finite."""
    kind = type(command)
    if kind is msg.Idle:
        return True
    # Infinities and NaN less themselves are NaN. (A generator would take twice as long.)
    return all([value - value == 0.0 for value in _NUMBERS[kind](command)])  # noqa: C419


_NUMBERS: dict[type[Command], Callable[[Any], tuple[float, ...]]] = {
    kind: attrgetter(*(field.name for field in fields(kind) if field.name != "motor"))
    for kind in (msg.Position, msg.Velocity, msg.Impedance)
}
_NUMBERS[msg.Torque] = _NUMBERS[msg.Hold] = lambda torque: (torque.torque,)
