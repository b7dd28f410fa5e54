"""The only place per motor for gear, sign, limits, ages, latched faults, finiteness and ownership.

Rules. Between this file and the bus, only the guard checks limits again; between this file and the brain,
gears are unknown. A joint gives exactly one command per step (`command`), whether or not the brain gave one.
Faults latch here until an operator clears them. Nothing can be switched off: every limit and timeout has
bounds on both sides, and a limit that is set at run time stays within the robot file's. Inside, everything
is at the output shaft; what goes to the driver, and what comes from it, is at the device's shaft (one turn of
the joint is `gear` turns of the device, reversed if `sign` is -1). Each concern has its file and its state:
`measured`, `whereabouts`, `arming`, `identity`, `faults`, `acceptance`, `load`, `torque_loop`,
`velocity_loop`, `stopping`, `following`, `limits`; here they are asked in the order of a step.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeAlias

from gateway.core.acceptance import Acceptance
from gateway.core.arming import Arming
from gateway.core.faults import (
    ANOTHER_DEVICE,
    DISARMED_ITSELF,
    FEEDBACK_LOST,
    STILL_ARMED,
    UNREFERENCED,
    LatchedFaults,
)
from gateway.core.following import Following
from gateway.core.gearing import Gearing
from gateway.core.identity import DeviceIdentity
from gateway.core.limits import Limits, SetpointProfile, Swing
from gateway.core.load import BY_TORQUE, Load
from gateway.core.measured import Measured
from gateway.core.reference import Reference
from gateway.core.stopping import LOWERING, Stopping
from gateway.core.torque_loop import LoopSettings, TorqueLoop
from gateway.core.velocity_loop import VelocityLoop
from gateway.core.whereabouts import Whereabouts
from protocols import messages as msg
from protocols.bounds import Bounds, Duration, Invalid
from protocols.messages import MILLISECOND, SECOND, Command, Mode, Nanos
from protocols.plugin import FeedbackKind, Spec

JointEvent: TypeAlias = msg.Feedback | msg.State | msg.Fault

LEAST_SHARE = 0.05
"""Of a limit in the robot file: the least that it may be set to while it runs."""

Timeout: TypeAlias = Annotated[Duration, Bounds(1, 2000)]


@dataclass(frozen=True, slots=True)
class JointSettings:
    """A motor's settings in the robot file that are the same for every protocol."""

    limits: Limits
    """At the joint's output shaft"""
    gear: Annotated[float, Bounds(1e-3, 1e4)] = 1.0
    """Turns of the device's shaft per turn of the joint."""
    sign: Literal[1, -1] = 1
    """-1: the motor is mounted the other way round"""
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
    command_timeout: Timeout = 100 * MILLISECOND
    """Age at which the brain's command counts for nothing: then `on_command_timeout`"""
    feedback_timeout: Timeout = 100 * MILLISECOND
    """Age at which feedback counts as lost; the brain slows down and stands at fractions of it."""
    following_time: Annotated[Duration, Bounds(100, 1000)] = 300 * MILLISECOND
    """For how long what is measured may be out of its bounds about the set-points (`following`)."""
    following_share: Annotated[float, Bounds(0.05, 0.5)] = 0.3
    """Share of a set-point of velocity by which it need not be followed."""
    serial: str = ""
    """The serial number that the device must have, in hexadecimal digits as `gateway motor dump` prints it:
    without it nothing arms the device. "": any."""
    loop: LoopSettings | None = None
    """Positions and velocities are reached by torque, at every step; None: by the device's own loops."""
    position_gain: Annotated[float, Bounds(0.0, 1e3, "1/s")] = 0.0
    """1/s: of a device that takes velocities and no positions, these are made of them: so much velocity per
    difference. 0: it takes none"""

    def __post_init__(self) -> None:
        if self.serial and not re.fullmatch("[0-9A-Fa-f]{1,32}", self.serial):
            raise Invalid(("serial", f"found {self.serial!r}, expected hexadecimal digits"))

    def lets_down(self, spec: Spec) -> bool:
        """True if a load can be let down: by a spring, or by a velocity while its torque is measured."""
        return msg.Impedance in spec.commands or self.turns_down(spec)

    def turns_down(self, spec: Spec) -> bool:
        """True if a load can be let down by a velocity."""
        return msg.Velocity in spec.commands and "Feedback.torque" in spec.ranges

    def commands(self, spec: Spec) -> frozenset[type[Command]]:
        """Return the commands that the joint takes of the brain: more than its device, with a loop."""
        by_torque = self.loop is not None and msg.Torque in spec.commands
        by_velocity = {msg.Position, msg.Hold} if self.moves_by_velocity(spec) else set()
        return spec.commands | {*BY_TORQUE} if by_torque else spec.commands | by_velocity

    def moves_by_velocity(self, spec: Spec) -> bool:
        """True if positions are made of velocities."""
        measured = "Feedback.position" in spec.ranges
        able = msg.Velocity in spec.commands and msg.Position not in spec.commands
        return self.position_gain > 0.0 and measured and able


class Joint:
    """The joint of one motor. Its state is plain data."""

    def __init__(self, name: str, settings: JointSettings, spec: Spec) -> None:
        self.name = name
        self.settings = settings
        limits, gear, period = settings.limits, settings.gear, spec.feedback_period
        self._file = limits
        """The robot file's limits, which no change exceeds."""
        self._stop_limits = replace(limits, jerk=None)
        """The limits of a stop: as hard as the acceleration allows."""
        self._replies_only = spec.feedback is FeedbackKind.REPLY
        self._silence = spec.offline_after
        self._faults = LatchedFaults(name)
        self._identity = DeviceIdentity(settings.serial)
        self._acceptance = Acceptance(name, settings.commands(spec))
        self._gearing = Gearing(
            gear * settings.sign, "Position.velocity" in spec.ranges, "Position.torque" in spec.ranges
        )
        ratio = self._gearing.ratio
        self._measured = Measured(
            name,
            settings.feedback_timeout,
            limits.velocity,
            open_loop=spec.feedback is FeedbackKind.NONE,
            start=limits.inside(0.0),
        )
        self._place = Whereabouts(limits, Reference(limits, spec, gear))
        self._following = Following(limits, spec, gear, settings.following_time, settings.following_share)
        self._arming = Arming()
        damping = spec.gains[1] * ratio**2 if spec.gains else 0.0
        self._stopping = Stopping(name, limits, damping, turns_down=settings.turns_down(spec))
        self._loop = None
        """In place of the device's own."""
        if settings.loop is not None and msg.Torque in spec.commands:
            self._loop = TorqueLoop(settings.loop, spec, gear, settings.command_timeout)
        self._by_velocity = None
        """Makes positions of velocities."""
        if settings.moves_by_velocity(spec):
            self._by_velocity = VelocityLoop(settings.position_gain, settings.command_timeout)
        self._load = Load(spec, ratio, by_torque=self._loop is not None)
        self._profile = SetpointProfile(period / SECOND)
        self._swing = Swing(period / SECOND)
        self._shown = False
        """Whether its motion was reported, at the last command, since its device was armed."""
        self._intended: Command = msg.Idle(name)
        """The last command sent, before the spring that makes it was softened."""
        self._out: Command = msg.Idle(name)
        """The last command sent, at the output shaft."""
        self._out_at: Nanos = 0

    # -- what is known of it ------------------------------------------------------------------

    @property
    def feedback(self) -> msg.Feedback:
        """The newest value of each quantity, at the output shaft; t is the newest motion's."""
        return self._measured.feedback

    @property
    def open_loop(self) -> bool:
        """Whether its device reports nothing: what it does is presumed to be what it is commanded."""
        return self._measured.open_loop

    @property
    def mode(self) -> Mode:
        """The device's, as last reported."""
        return self._arming.mode

    @property
    def detail(self) -> str:
        """Of the mode, in the device's words."""
        return self._arming.detail

    @property
    def armed(self) -> bool:
        """Whether its last report of a mode was ARMED."""
        return self._arming.armed

    @property
    def owned(self) -> bool:
        """Whether any command but Idle has been sent: only then is the stop command sent."""
        return self._arming.owned

    @property
    def faults(self) -> dict[tuple[int, str], msg.Fault]:
        """Latched, in the order in which they came."""
        return self._faults.latched

    @property
    def refused(self) -> str:
        """Why the brain's last command was refused; "" if it was accepted."""
        return self._acceptance.refused

    @property
    def sent(self) -> Command:
        """The last command sent, at the output shaft."""
        return self._out

    @property
    def unidentified(self) -> bool:
        """Whether a serial number is demanded of the device, and has not been read."""
        return self._identity.unknown

    def is_heard_since(self, t: Nanos) -> bool:
        """True if its device has reported its motion after this time."""
        return self._measured.received_at is not None and self._measured.received_at > t

    def is_heard(self, now: Nanos) -> bool:
        """True if its device reports a state, or its motion."""
        return self.mode is not Mode.OFFLINE or not self._measured.lost(now)

    def feedback_age(self, now: Nanos) -> Nanos | None:
        """Return the age of the newest motion; None if the device has never reported any."""
        return self._measured.age(now)

    def feedback_lost(self, now: Nanos) -> bool:
        """True if there is no feedback, or it is older than the timeout; never of an open-loop joint, which
        has none to lose."""
        return self._measured.lost(now)

    def presumed(self, now: Nanos) -> msg.Feedback | None:
        """Return the motion of an open-loop joint if it does as commanded: nothing of it is measured. None:
        the device of another joint reports its motion."""
        if not self._measured.open_loop:
            return None
        if self.armed and isinstance(self._out, msg.Position):
            return msg.Feedback(self.name, now, self._out.position, self._out.velocity)
        commanded = self._out.velocity if self.armed and isinstance(self._out, msg.Velocity) else 0.0
        span = min(now - self._out_at, self.settings.command_timeout) / SECOND if commanded else 0.0
        return self._measured.presumed(now, commanded, span)

    # -- from the device ----------------------------------------------------------------------

    def on_event(self, event: JointEvent) -> JointEvent | None:
        """Store a driver's event and return it at the output shaft; None if it must be dropped."""
        if isinstance(event, msg.Feedback):
            return self._on_feedback(event)
        if isinstance(event, msg.State):
            self._on_state(event)
        else:
            self._faults.latch(event)
        return event

    def _on_feedback(self, event: msg.Feedback) -> msg.Feedback | None:
        moved = self._gearing.at_output(event)
        if moved is None:
            return None
        velocity = self._measured.take(moved)
        if velocity is not None:
            self._swing.on_velocity(moved.t, velocity)
        if moved.position is not None or moved.velocity is not None:
            self._following.on_motion(moved.t, moved.position, moved.velocity)
        if moved.position is not None:
            self._place.on_position(moved.t, moved.position)
        return moved

    def _on_state(self, event: msg.State) -> None:
        restarts = event.mode is Mode.INITIALISING and self.mode is not Mode.INITIALISING
        if self._arming.on_state(event, braking=self._stopping.under_way):
            detail = f" ({event.detail})" if event.detail else ""
            self._faults.find(event.t, DISARMED_ITSELF, f"{event.mode}{detail}")
        if restarts or event.mode is Mode.OFFLINE:  # it may be another one when it is back
            self._identity.forget()
        self._check_idle(event.t)

    def identify(self, serial: int) -> None:
        """Take the serial number that answers for the device; one that is wrong stays until it is silent."""
        self._identity.take(serial)

    def on_request(self, now: Nanos, request: msg.Request) -> None:
        """Note a request that is passed to the device."""
        self._place.on_request(now, type(request).__name__)

    def on_answer(self, now: Nanos, request: str, *, done: bool) -> None:
        """Note the answer to a request of this name."""
        over, known = self._place.on_answer(now, request, done=done)
        if over:
            self._following.forget_motion()
        if known:
            self.confirm()

    def on_held_back(self) -> None:
        """Note that the driver sends the device no set-point yet: it still prepares it."""
        self._arming.on_held_back()

    def confirm(self) -> None:
        """Take the reported position as the true one: it was zeroed, homed, or a person has looked."""
        self._place.confirm()
        self._faults.forget(UNREFERENCED)

    def latch(self, fault: msg.Fault) -> None:
        """Keep a fault until it is cleared."""
        self._faults.latch(fault)

    def take_unreported(self) -> list[msg.Fault]:
        """Return the faults that have latched since the last call."""
        return self._faults.take_unreported()

    def take_refused(self) -> str:
        """Return why the brain's command is refused, if that is news; else ""."""
        return self._acceptance.take_refused()

    def clear(self) -> None:
        """Clear the faults; the joint starts anew, from its measured position."""
        self._faults.latched.clear()
        self._acceptance.forget()
        self._profile.forget()
        self._following.restart()
        self._place.begin(self._measured)

    # -- from the brain -----------------------------------------------------------------------

    def command(
        self, now: Nanos, new: Command | None, stopped: bool, last: bool = False, leaving: bool = False
    ) -> Command:
        """Return the one command of this step, at the device's shaft.

        `new` is the brain's command of this step, None if it gave none. `leaving`: the run ends; `last`:
        nothing will follow, so there is no time to brake, or to lower a load. If feedback is lost while the
        device was armed, a fault latches, since a motor that comes back must not start by itself."""
        if new is not None:
            self._acceptance.offer(now, new)
        if (presumed := self.presumed(now)) is not None:
            self._measured.presume(presumed.position or 0.0)
        self._check(now, stopped)
        wanted = self._wanted(now, stopped, last, leaving)
        out = self._limited(now, self._placed(now, wanted, stopped), stopped)
        arming = self._arming
        measured, limits, armed = self._measured.feedback, self.settings.limits, arming.mode is Mode.ARMED
        first = arming.armed and not arming.owned
        self._intended = self._load.carried(now, out, measured, limits, taken_over=first)
        there = self._measured.expected(now, self._swing) if self._load.pulls(out) else measured
        out = self._load.softened(self._intended, measured, there, limits, armed=armed)
        if isinstance(self._intended, msg.Impedance) and not stopped:
            self._stopping.on_spring(self._intended.damping)  # not that of a softened one
        arming.on_sent(now, out, abs(measured.velocity or 0.0))
        dt, self._out, self._out_at = (now - self._out_at) / SECOND, out, now
        given = out if self._loop is None else self._loop.torque(out, dt, measured, limits, armed=armed)
        if self._by_velocity is not None:
            given = self._by_velocity.velocity(out, dt, measured, limits, armed=armed)
        return self._gearing.at_device(given)

    def _check(self, now: Nanos, stopped: bool) -> None:
        """Latch a fault of whatever is wrong with what was measured since the last command."""
        if self._measured.loses_position(now):
            self._profile.forget()
            self._acceptance.refuse("its position is lost: the device no longer reports it")
        armed = self._arming.armed
        if armed and self._arming.owned:
            if self._measured.lost(now):
                limit = f"{self.settings.feedback_timeout / MILLISECOND:g} ms"
                self._faults.find(now, FEEDBACK_LOST, limit)
            if self.open_loop and self.mode is Mode.OFFLINE:
                self._faults.find(now, FEEDBACK_LOST, f"{self._silence / MILLISECOND:g} ms")
        if wrong := self._identity.wrong():
            self._faults.find(now, ANOTHER_DEVICE, wrong)
        driven = armed and not isinstance(self._out, msg.Idle)
        for code, detail in self._place.check(self._measured, driven=driven):
            self._faults.find(now, code, detail)
        self._judge(now, stopped)
        self._check_idle(now)

    def _judge(self, now: Nanos, stopped: bool) -> None:
        """Latch a fault if the motion is not what the last command was to make."""
        moves_by_itself = self._place.moves_by_itself(now)
        age = self._measured.age(now)
        if age is None or self._arming.mode is not Mode.ARMED or isinstance(self._out, msg.Idle):
            self._following.restart()
        elif not moves_by_itself and (
            found := self._following.judge(now, self._intended, self._measured.feedback, age)
        ):
            code, detail = found
            if stopped and isinstance(self._out, msg.Hold):
                code, detail = STILL_ARMED, f"still moves ({detail})"
            self._faults.find(now, code, detail)

    def _check_idle(self, now: Nanos) -> None:
        """Latch a fault if the device is armed, or drives its shaft, against our will."""
        fastest, turned_on = self._file.velocity, self._faults.turned_on
        if found := self._arming.against_idle(now, self._measured, fastest, turned_on=turned_on):
            self._faults.find(now, *found)

    def _wanted(self, now: Nanos, stopped: bool, last: bool, leaving: bool) -> Command:
        if stopped or self._faults.latched:
            return self._stop_command(now, last, leaving)
        self._stopping.end()
        command = self._acceptance.newest(now, self.settings.command_timeout)
        if command is None and self.settings.on_command_timeout == "hold":
            return self._load.hold(self._out)
        return command or msg.Idle(self.name)

    def _placed(self, now: Nanos, wanted: Command, stopped: bool) -> Command:
        """Return what is wanted, if it is known where the joint is, and near enough to its range to begin."""
        if stopped or self._faults.latched or isinstance(wanted, msg.Idle):
            return wanted
        begins = isinstance(self._out, msg.Idle)
        if begins and self.unidentified:
            self._acceptance.refuse("the serial number that the robot file demands has not been read")
            return msg.Idle(self.name)
        why = self._place.objection(now, wanted, self._measured, begins=begins)
        if not why:
            return wanted
        if self.settings.on_fault == "stop":  # others may depend on where it is
            self._faults.find(now, UNREFERENCED, why)
        else:
            self._acceptance.refuse(why)
        held = self.armed and isinstance(self._out, msg.Hold)
        return self._load.hold(self._out) if held else msg.Idle(self.name)

    def _limited(self, now: Nanos, wanted: Command, stopped: bool) -> Command:
        measured = self._measured
        if measured.received_at is None and not isinstance(wanted, msg.Idle) and not measured.open_loop:
            # Nothing arms a device that has reported nothing, unless it reports only what it is commanded.
            wanted = self._at_rest(msg.Torque, msg.Velocity) if self._replies_only else msg.Idle(self.name)
        elif measured.position_lost and isinstance(wanted, msg.Hold):
            wanted = self._at_rest(msg.Velocity)
        shown, self._shown = self._shown, self._arming.shows_arming(measured)
        dt = max(0, min(now - self._out_at, self.settings.command_timeout)) / SECOND
        limits = self._stop_limits if stopped or self._faults.latched else self.settings.limits
        here = measured.feedback
        if not isinstance(wanted, msg.Velocity):
            here = self.presumed(now) or here
        begins = not self._arming.obeys(measured)
        if begins or (not shown and self._profile.departs(measured.feedback, limits)):
            self._profile.forget()  # it starts with the motion that the shaft has then
        out = self._profile.limited(wanted, dt, here, limits)
        if isinstance(out, msg.Torque):
            out = msg.Torque(self.name, self._swing.within(out.torque, dt, limits.velocity))
        return out

    def _at_rest(self, *kinds: type[msg.Torque | msg.Velocity]) -> Command:
        """Return the first of these commands that the device has, with the value 0, else Idle."""
        able = (kind(self.name, 0.0) for kind in kinds if kind in self._acceptance.supported)
        return next(able, msg.Idle(self.name))

    # -- the stop action ----------------------------------------------------------------------

    @property
    def braking_time(self) -> Nanos:
        """Longest time that the stop command may brake, or lower a load."""
        if self._lowers:
            return LOWERING
        return self._stopping.braking_time() if self.settings.stop_action == "brake" else 0

    @property
    def hurried_braking_time(self) -> Nanos:
        """Longest time that the stop command may still brake once the end of a run is hurried. A load is
        lowered no faster, since let go it would fall."""
        if self._lowers or self.settings.stop_action != "brake":
            return self.braking_time
        wanted = self._out.velocity if isinstance(self._out, msg.Velocity) else 0.0
        return self._stopping.hurried_braking_time(max(abs(self.feedback.velocity or 0.0), abs(wanted)))

    @property
    def _lowers(self) -> bool:
        """Whether its load is lowered when the run ends."""
        settings = self.settings
        released = settings.stop_action == "hold" and settings.unattended == "released"
        return released and self.owned and self.armed and self._stopping.can_lower

    def _stop_command(self, now: Nanos, last: bool, leaving: bool) -> Command:
        if self._faults.disobeyed:
            return msg.Idle(self.name)
        if self.settings.stop_action == "hold" and self.armed:  # Hold would arm another
            hold = self._load.hold(self._out)
            if leaving and not last and self._lowers:
                return self._stopping.lower(now, hold.torque, self.feedback, lost=self._measured.lost(now))
            return msg.Idle(self.name) if last and self.settings.unattended == "released" else hold
        if self.settings.stop_action == "brake" and not last and self._brakes(now):
            return msg.Velocity(self.name, 0.0)
        return msg.Idle(self.name)

    def _brakes(self, now: Nanos) -> bool:
        if self.faults or self._measured.lost(now):
            return False
        if self.mode is not Mode.ARMED or isinstance(self._out, msg.Idle):
            return False
        speed = getattr(self._out, "velocity", 0.0) if self.open_loop else self.feedback.velocity or 0.0
        return self._stopping.brakes(now, speed, self.settings.limits.velocity)

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
