"""The host's end: what a motor is sent in each phase, and what it reports.

Rules. No report says whether a motor is driven, and none is known to stop by itself when its host is gone. So
a motor that has been commanded, and is not, is released again every `feedback_ms`: by a current of 0, or by
the frame that leaves MIT mode, which is answered. In MIT mode every frame is answered, and nothing else is
sent: an answer belongs to the oldest frame that still waits for one; one that was not asked for is to another
host, or to a late frame. One that has left motor mode answers on: it is known by the torque that it does not
give, and entered again. Servo mode reports by itself, and so does firmware V3, which takes five numbers
beside the set-points of servo mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from protocols import messages as msg
from protocols.cubemars import table as cm
from protocols.cubemars.options import Options
from protocols.frames import CanFrame, Frame
from protocols.messages import MILLISECOND, SECOND, Command, Feedback, Mode, Nanos, Request
from protocols.plugin import Device
from protocols.toolkit.duplicates import ShaftCheck
from protocols.toolkit.host import Host, Phase, Report, Timing
from protocols.toolkit.mit import NUMBERS, encoded
from protocols.toolkit.motor_driver import Adapter, MotorDriver, Pending, Rx
from protocols.toolkit.table import Values
from protocols.toolkit.turns import Turns

ANSWER: Nanos = 50 * MILLISECOND
"""Time within which a frame is answered, if it is."""
ZEROED: Nanos = 3 * SECOND
"""Time for a new zero: the motor may be silent for half of it."""
ARMED = ("enter", "control")
RESTS: Nanos = 200 * MILLISECOND
"""Time for which a motor that has left motor mode is asked for torque and gives none."""
LEAST, LIMP = 0.02, 0.2
"""Share of the largest torque from which on a torque can be seen, and share of the torque asked for below
which it is none."""
State: TypeAlias = tuple[Mode | None, str]
UNKNOWN: State = None, ""
Motion: TypeAlias = tuple[float | None, float | None, float | None, float | None]
"""Position, velocity, torque and current."""


@dataclass(slots=True)
class Motor:
    """What is known of one motor beyond its phase. Plain data."""

    sent_at: Nanos = -(1 << 62)
    driven: bool = False
    """Servo: what we sent last is a set-point, or prepares one."""
    awaited: list[tuple[Nanos, str, bytes]] = field(default_factory=list)
    """MIT: frames that are not answered yet,"""
    goal: msg.Impedance | None = None
    """the last set-point since it was entered,"""
    limp_since: Nanos | None = None
    """and since when it gives no torque where that asks for some."""
    turns: Turns = field(default_factory=Turns)
    shaft: ShaftCheck = field(default_factory=lambda: ShaftCheck(0.05))

    def sent(self, now: Nanos, *frames: CanFrame) -> Sequence[Frame]:
        """Record frames; return them."""
        waits = [each for each in self.awaited if now - each[0] < ANSWER]
        self.awaited = [*waits, *((now, (*cm.names(f), "")[0], f.data) for f in frames)][-64:]
        self.sent_at = now
        return frames

    def drive(self, *, driven: bool) -> None:
        """Record whether we drive it."""
        self.driven = driven

    def follow(self, goal: msg.Impedance | None) -> None:
        """Record a set-point; None: it is entered."""
        self.goal = goal
        self.limp_since = self.limp_since if goal else None

    def rests(self, t: Nanos, values: Values, most: float) -> bool:
        """True if it has long given no torque where its set-point asks for some; `most`: the largest."""
        goal, (position, velocity, torque) = self.goal, (values[name] for name in NUMBERS[:3])
        wanted = 0.0
        if goal is not None and None not in (position, velocity, torque):  # as at the ends of their ranges
            pull = goal.stiffness * (goal.position - position) + goal.damping * (goal.velocity - velocity)
            wanted = min(abs(goal.torque + pull), most)
        limp = wanted > LEAST * most and abs(torque) < LIMP * wanted
        since = t if self.limp_since is None else self.limp_since
        self.limp_since = since if limp else None
        return limp and t - since >= RESTS

    def answered(self, t: Nanos) -> str:
        """Return to which message an answer is, "" if to none of ours."""
        self.awaited = [each for each in self.awaited if t - each[0] < ANSWER]
        name, self.awaited = self.awaited[0][1] if self.awaited else "", self.awaited[1:]
        return name

    def forget(self) -> None:
        """Forget what was sent: it may have restarted."""
        self.driven = False
        self.awaited = []


class CubeMarsAdapter(Adapter[Motor]):
    """What motors are sent, and what they report."""

    name = "cubemars"
    faults, duplicate, latch, blind = cm.ALL_FAULTS, cm.DUPLICATE, True, True
    clearing, clearing_disarms = SECOND, True

    def own(self, device: Device) -> Motor:
        return Motor()

    def timing(self, options: Options) -> Timing:
        offline = options.offline_ms * MILLISECOND
        silent = options.mode == "mit" and not options.sole_host
        return Timing(offline, confirmations=4, only_replies=silent)

    # -- received -------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame, driver: MotorDriver[Motor]) -> Sequence[Report[Motor] | Rx]:
        if not isinstance(frame, CanFrame) or frame.fd or frame.remote:
            return (Rx.IGNORED,)
        if not frame.extended:
            return (self._reply(t, frame, driver.at.get(frame.data[0]) if frame.data else None),)
        host = driver.at.get(frame.id & 0xFF)
        if frame.id & ~0xFF != cm.STATUS or host is None or host.options.mode == "mit":
            return (Rx.IGNORED,)
        values = cm.SERVO.read("status", frame.data)
        return (Rx.MALFORMED if values is None else self._status(t, host, values),)

    def _status(self, t: Nanos, host: Host[Motor], values: Values) -> Report[Motor]:
        own, options, current = host.own, host.options, values["current"]
        driven = own.driven or abs(current) > options.idle_current
        state = (Mode.ARMED, "driven") if driven else (Mode.READY, "released")
        position = values["position"] * cm.DEGREE
        reported = position if abs(position) < options.end - cm.DEGREE else None
        velocity = values["velocity"] * options.erpm if abs(values["velocity"]) < cm.LAST_ERPM else None
        torque = None if options.five else current * options.torque_constant
        motion = reported, velocity, torque, current
        return self._report(t, host, state, values, motion)

    def _reply(self, t: Nanos, frame: CanFrame, host: Host[Motor] | None) -> Report[Motor] | Rx:
        if host is None or host.options.mode != "mit" or frame.id not in host.options.replies(host.address):
            return Rx.IGNORED
        own = host.own
        if any(frame.data == data for _, _, data in own.awaited):
            return Rx.IGNORED  # our own, which the bus returns, where it replies with its address
        values = host.options.table.read("reply", frame.data)
        if values is None:
            return Rx.MALFORMED
        name, state = own.answered(t), UNKNOWN
        if name in ARMED and host.phase is not Phase.RELEASING:
            most = host.options.table.row("reply").field("torque").high
            rests = name == "control" and own.rests(t, values, most)
            state = (Mode.READY, "it gives no torque") if rests else (Mode.ARMED, "motor mode")
        elif name == "exit":
            state = Mode.READY, "rest mode"
        elif not name and host.phase is not Phase.ARMING:
            state = Mode.ARMED, "it answers what was not sent"
        if len(frame.data) < cm.REPLY_LENGTH:
            values["temperature"] = None
        motion = values["position"], values["velocity"], values["torque"], None
        return self._report(t, host, state, values, motion)

    def _report(
        self, t: Nanos, host: Host[Motor], state: State, values: Values, motion: Motion
    ) -> Report[Motor]:
        own, code, (mode, detail) = host.own, values["error"], state
        position, velocity, torque, current = motion
        faults = [code if code in cm.FAULTS else cm.UNKNOWN] if code else []
        if faults:
            mode, detail = Mode.FAULT, cm.FAULTS[faults[0]].name
        two = position is not None and own.shaft.add(t, position, velocity or 0.0)
        if host.options.turns:
            position = own.turns.add(t, position, velocity, host.options.end)
        heat = None if values["temperature"] is None else float(values["temperature"])
        feedback = Feedback(host.name, t, position, velocity, torque, current, temperature=heat)
        cause = "its position jumps there and back" if two else ""
        return Report(host, host.address, mode, detail, faults, feedback, cause)

    # -- sent -----------------------------------------------------------------------------------------

    def ready(self, host: Host[Motor]) -> bool:
        known = host.mode is not None and (host.position is not None or host.options.turns)
        return known or host.options.mode == "mit"

    def arm(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        at, options, own = host.address, host.options, host.own
        if options.mode != "mit":
            own.drive(driven=True)
            return own.sent(now, cm.SERVO.encode("SET_CURRENT", at, value=0.0))
        # The set-point of an earlier host may still be in it.
        zero = options.table.encode("control", at, **dict.fromkeys(NUMBERS, 0.0))
        own.follow(None)
        return own.sent(now, cm.MIT.encode("enter", at), zero)

    def release(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        host.own.drive(driven=False)
        if host.options.mode == "mit":
            return host.own.sent(now, cm.MIT.encode("exit", host.address))
        return host.own.sent(now, cm.SERVO.encode("SET_CURRENT", host.address, value=0.0))

    def command(self, now: Nanos, host: Host[Motor], command: Command) -> Sequence[Frame]:
        options, at = host.options, host.address
        if options.mode == "mit":
            goal = options.gains.impedance(command, host.held)
            host.own.follow(goal)
            return host.own.sent(now, encoded(options.table.encoder("control"), at, goal, cm.SPECIAL_DATA))
        host.own.drive(driven=True)
        if options.five:
            goal = options.gains.impedance(command, host.held)
            return host.own.sent(now, encoded(options.table.encoder(options.set_point), at, goal))
        match command:
            case msg.Velocity(_, velocity):
                frame = cm.SERVO.encode("SET_RPM", at, value=round(velocity / options.erpm))
            case msg.Torque(_, torque):
                # A current of 0 would release it: 1 mA drives nothing either.
                current = round(torque / options.torque_constant, 3) or 1e-3
                frame = cm.SERVO.encode("SET_CURRENT", at, value=current)
            case _:
                goal = getattr(command, "position", host.held if host.held is not None else host.position)
                fastest, ramp = options.max_velocity / options.erpm, options.max_acceleration / options.erpm
                frame = cm.SERVO.encode(
                    "SET_POS_SPD", at, value=(goal or 0.0) / cm.DEGREE, fastest=fastest, ramp=ramp
                )
        return host.own.sent(now, frame)

    def poll(self, now: Nanos, host: Host[Motor]) -> Sequence[Frame]:
        return () if now < self.poll_due(host) else self.release(now, host)

    def poll_due(self, host: Host[Motor]) -> Nanos:
        asked = host.once_commanded or (host.options.mode == "mit" and host.options.sole_host)
        if not asked or host.phase in (Phase.ARMED, Phase.ARMING):
            return super().poll_due(host)
        at: Nanos = host.own.sent_at + host.options.feedback_ms * MILLISECOND
        return at

    # -- requests -------------------------------------------------------------------------------------

    def begin(
        self, now: Nanos, request: Request, host: Host[Motor] | None, driver: MotorDriver[Motor]
    ) -> Pending[Motor] | str:
        if isinstance(request, msg.Zero) and host is not None:
            return Pending(request, host.name, now, now + ZEROED, now, host, period=ZEROED)
        return super().begin(now, request, host, driver)

    def frames(self, now: Nanos, pending: Pending[Motor]) -> Sequence[Frame]:
        host = pending.host
        if host is None:  # nothing is asked of all
            return ()
        if isinstance(pending.request, msg.ClearFault):
            return self.release(now, host)
        servo = host.options.mode != "mit"
        zero = cm.SERVO.encode("SET_ORIGIN_HERE", host.address, value=0)
        return host.own.sent(now, zero if servo else cm.MIT.encode("set zero", host.address))
