"""The guard: it reads every outgoing frame as the devices will, and passes or blocks it.

Rules. It trusts neither the brain nor a driver: of each frame it takes only what the devices' own command
decoders make of it, and holds that against the limits of the robot file, the feedback, and what has been
asked for. It cannot be switched off. Whatever it does not understand must be read-only, or belong to a device
that was commanded. Idle always passes to a device that is ours. A blocked frame is taken back: it leaves no
trace in what the devices are taken to have received.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gateway.core.joint import Joint
from protocols import messages as msg
from protocols.asked import READS, SET_POINTS, Asked, Objection, Reported, SetPoint
from protocols.frames import CanFrame, Frame, any_matches, malformed
from protocols.messages import MILLISECOND, SECOND, Command, Event, Nanos, Obeyed, Request
from protocols.plugin import CommandDecoder

if TYPE_CHECKING:
    from gateway.core.robot import Motor, Robot

GOES_ON: Nanos = SECOND
"""How long after a set-point, or after coasting, a motor may be commanded to go on from there: a driver that
changes the mode, or that arms at rest, sends other set-points in between."""
STOPS_WITHIN: Nanos = 250 * MILLISECOND
"""Time in which a driver must have passed on that a device is to stand; then its own stop is sent."""
STOPS_AGAIN: Nanos = 50 * MILLISECOND
"""Then they are sent again, each after so long, while it is armed as far as is known: one may be lost."""
LATENCY: Nanos = 50 * MILLISECOND
"""What a device obeys may be this much ahead of what it last obeyed: a joint's set-point moves on while the
device is being armed, and while a set-point waits for its SYNC."""
FRAMES_KEPT = 16
"""Most frames that a decoder is given again when a frame is taken back."""
SPRING_ERROR = 0.05
"""Share of the limit by which the torque of a spring may be wrong: its gains are rounded, too."""


def text_of(frame: Frame) -> str:
    """Return a frame in candump's notation, bytes in hexadecimal."""
    return str(frame) if isinstance(frame, CanFrame) else frame.hex().upper()


@dataclass(frozen=True, slots=True)
class Blocked:
    """A frame that was not sent."""

    frame: Frame
    motors: tuple[str, ...]
    """The motors that it is for; () if that is not known."""
    rule: str
    """What it breaks, in a few words."""
    detail: str
    """The numbers."""

    @property
    def text(self) -> str:
        """The rule, the numbers and the frame."""
        return f"{self.rule}{f' ({self.detail})' if self.detail else ''}: {text_of(self.frame)}"


@dataclass(frozen=True, slots=True)
class Failing:
    """A driver that has raised an exception a short time ago."""

    mute: bool
    """It raised when it was given the commands of this step: nothing of them is sent."""
    unknown: frozenset[str]
    """Its devices of which no motion was received since it began to raise."""


class _Receivers:
    """Command decoders of the devices on a bus: on CAN one for each, so that a frame is decoded by those only
    that listen to its id; on a serial line, where all hear all, one for each protocol."""

    def __init__(self, robot: Robot, bus: str) -> None:
        listeners = [
            (plugin, some)
            for plugin, group in robot.by_protocol(bus)
            for some in ([group] if robot.buses[bus].carries_bytes else [[one] for one in group])
        ]
        self._decoders = [plugin.decoder(some) for plugin, some in listeners]
        self._before = copy.deepcopy(self._decoders)
        """The decoders as they were some frames ago"""
        self._since: list[list[tuple[Nanos, Frame]]] = [[] for _ in listeners]
        """The frames that each decoder was given since, and that were kept"""
        self._most = [1 + number % FRAMES_KEPT for number in range(len(listeners))]
        """How many these may become: few at first, so that not all are copied in the same step."""
        specs = [[plugin.spec(device) for device in some] for plugin, some in listeners]
        self._read_only = [tuple(dict.fromkeys(spec.read_only for spec in some)) for some in specs]
        """By decoder: what decides whether a frame leaves its devices unchanged."""
        self._protocols = [plugin.name for plugin, _ in listeners]
        self._ids = [[ids for spec in some for ids in (*spec.sends, *spec.obeys_also)] for some in specs]
        self._by_id: dict[tuple[int, bool], list[int]] = {}
        """The decoders by the id of a frame and its format: filled as ids are used."""
        self._asked: tuple[Frame | None, Sequence[int]] = (None, ())
        """The frame that was asked about last, and the decoders that listen to it."""

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Decode what any device on the bus would obey."""
        numbers = self._listening(frame)
        if len(numbers) == 1:
            return self._decoders[numbers[0]].decode(t, frame)
        return [one for number in numbers for one in self._decoders[number].decode(t, frame)]

    def keep(self, t: Nanos, frame: Frame) -> None:
        """Keep the frame that was decoded last."""
        for number in self._listening(frame):
            self._since[number].append((t, frame))
            if len(self._since[number]) >= self._most[number]:
                self._before[number] = copy.deepcopy(self._decoders[number])
                self._since[number].clear()
                self._most[number] = FRAMES_KEPT

    def take_back(self, frame: Frame) -> None:
        """Decode from now on as if the frame that was decoded last had not been there."""
        for number in self._listening(frame):
            self._decoders[number] = copy.deepcopy(self._before[number])
            for t, before in self._since[number]:
                self._decoders[number].decode(t, before)

    def read_only(self, protocol: str, frame: Frame) -> bool:
        """True if a frame that nobody obeys changes nothing: in any device that listens to its id, and one
        does; on a serial line, where others than those of this protocol cannot read it, in any of these."""
        numbers = self._listening(frame)
        if not isinstance(frame, CanFrame):
            numbers = [number for number in numbers if self._protocols[number] == protocol]
        return bool(numbers) and all(tells(frame) for number in numbers for tells in self._read_only[number])

    def _listening(self, frame: Frame) -> Sequence[int]:
        if frame is self._asked[0]:
            return self._asked[1]
        if not isinstance(frame, CanFrame):
            return range(len(self._decoders))
        key = (frame.id, frame.extended)
        numbers = self._by_id.get(key)
        if numbers is None:
            numbers = [n for n, ids in enumerate(self._ids) if any_matches(ids, frame)]
            self._by_id[key] = numbers
        self._asked = frame, numbers
        return numbers


def decoder_of(robot: Robot, bus: str) -> CommandDecoder:
    """Return a decoder of what the devices on a bus would obey."""
    return _Receivers(robot, bus)


class Guard:
    """Reads what is sent to the devices of one robot. Its state is plain data."""

    def __init__(self, robot: Robot) -> None:
        self._motors = {name: _Bounds(motor) for name, motor in robot.motors.items()}
        self._specs = {
            (bus, plugin.name): {one.name: (robot.motors | robot.sensors)[one.name].spec for one in devices}
            for bus in robot.buses
            for plugin, devices in robot.by_protocol(bus)
        }
        """By bus and protocol, then by device."""
        self._kinds = {key: next(iter(specs.values())).bus for key, specs in self._specs.items()}
        """What bus each driver writes for."""
        self._receivers = {bus: _Receivers(robot, bus) for bus in robot.buses}
        """What the devices have received: the frames that were passed."""
        self._last: dict[tuple[str, type[Command] | None], tuple[Nanos, Command]] = {}
        """The last set-point that each motor was sent: of each type, and (None) of any."""
        self._unstopped: dict[str, tuple[Nanos, int]] = {}
        """Devices that are to stand, and were told otherwise: since when, or since their last own stop;
        and how many of these were sent."""
        self._coasting: dict[str, tuple[Nanos, float]] = {}
        """The velocity [rad/s] at which each motor was last seen not armed."""
        self._asked = Asked({one.name: one.spec for one in robot.devices()})
        """What the drivers were given."""

    def ask(self, now: Nanos, message: Command | Request) -> None:
        """Note what a driver is given: its frames are asked for. Stop is asked of every device."""
        self._asked.give(now, message)

    def answer(self, event: Event) -> None:
        """Note what a driver has reported: a request that is answered is not under way any more."""
        self._asked.answer(event)

    def check(
        self,
        now: Nanos,
        bus: str,
        protocol: str,
        frames: Sequence[Frame],
        joints: Mapping[str, Joint],
        stopped: bool,
    ) -> tuple[list[Frame], list[Blocked]]:
        """Return the frames of one driver that may be sent, in order, and those that may not.

        Args:
            now: the time of the step [ns].
            bus: where they go.
            protocol: whose driver made them.
            frames: in the order in which they are to be sent.
            joints: by motor: mode, faults and feedback as of now.
            stopped: whether the whole robot must not move.
        """
        passed: list[Frame] = []
        blocked: list[Blocked] = []
        receivers = self._receivers[bus]
        last: dict[tuple[str, type[Command] | None], tuple[Nanos, Command]] = {}
        for name in self._specs[bus, protocol]:
            joint = joints.get(name)
            if joint is not None and not joint.armed:
                self._coasting[name] = (now, joint.feedback.velocity or 0.0)
        for frame in frames:
            obeyed: Sequence[Obeyed] = ()
            objection: Objection | None
            try:
                objection = self._unfit(bus, protocol, frame)
                if objection is None:
                    obeyed = receivers.decode(now, frame)
                    objection = self._objection(now, bus, protocol, frame, obeyed, joints, stopped)
            except (Exception, SystemExit) as error:  # noqa: BLE001 -- a plugin's: what cannot be read must not go out
                objection = "its decoder failed", f"{type(error).__name__}: {error}"
            if objection is not None:
                receivers.take_back(frame)
                motors = self._motors_of(bus, protocol, frame, obeyed)
                blocked.append(Blocked(frame, motors, *objection))
                continue
            receivers.keep(now, frame)
            for one in obeyed:
                if isinstance(one, msg.COMMANDS):
                    self._asked.passed(one, self._reported(joints.get(one.motor)))
                    last[one.motor, type(one)] = last[one.motor, None] = (now, one)
            passed.append(frame)
        self._last |= last  # only now: frames of one step are compared with those of the steps before
        return passed, blocked

    def reads(self, bus: str, protocol: str, frame: Frame) -> bool:
        """True if a frame of a driver changes nothing in any device, as far as that is seen without decoding
        it."""
        return self._receivers[bus].read_only(protocol, frame)

    def stops(
        self,
        now: Nanos,
        bus: str,
        protocol: str,
        joints: Mapping[str, Joint],
        failing: Failing | None = None,
    ) -> list[Frame]:
        """Return the devices' own stops that are due; they need no check. `failing`: if their driver is."""
        stops = list(self._stops(now, bus, protocol, joints, failing))
        for frame in stops:
            self._receivers[bus].keep(now, frame)
        return stops

    def drives(self, motor: str, since: Nanos) -> bool:
        """True if a motor was sent a set-point, Hold among them, at this time or later."""
        last = self._last.get((motor, None))
        return last is not None and last[0] >= since and not isinstance(last[1], msg.Idle)

    def overhear(self, t: Nanos, bus: str, frame: Frame) -> list[Obeyed]:
        """Return what a frame of another host makes the devices do, but for reading and disarming. It leaves
        no trace: what is sent is judged by what we have sent."""
        receivers = self._receivers[bus]
        try:
            obeyed = receivers.decode(t, frame)
        except (Exception, SystemExit):  # noqa: BLE001 -- a plugin's; a frame that cannot be read commands nothing
            obeyed = ()
        receivers.take_back(frame)
        return [one for one in obeyed if not isinstance(one, (*READS, msg.Idle))]

    def _stops(
        self, now: Nanos, bus: str, protocol: str, joints: Mapping[str, Joint], failing: Failing | None
    ) -> Iterator[Frame]:
        """Yield the devices' own stops of those that their driver does not stop."""
        for name, spec in self._specs[bus, protocol].items():
            joint = joints.get(name)
            since, sent = self._unstopped.get(name, (now, 0))
            if joint is None or not spec.stop or not self._is_left_running(joint, failing, sent):
                self._unstopped.pop(name, None)
            elif now - since < self._patience(name, len(spec.stop), sent, failing):
                self._unstopped[name] = since, sent
            else:
                self._unstopped[name] = now, sent + 1
                stop = spec.stop[sent % len(spec.stop)]
                for one in self._receivers[bus].decode(now, stop):
                    self._asked.passed(one, self._reported(joint))
                yield stop

    def _is_left_running(self, joint: Joint, failing: Failing | None, sent: int) -> bool:
        """True for a device of ours that is armed as far as is known, is to stand, and was sent otherwise
        last, or its own stop already. With a mute driver it need not be to stand: what it was sent last goes
        on. One that holds its place by that, and is to, is left so."""
        if not joint.owned:
            return False
        stands = self._asked.stands(joint.name)
        if failing is None:
            return joint.armed and stands and (sent > 0 or self._asked.moves_on(joint.name))
        may_run = joint.armed or joint.name in failing.unknown
        return may_run and (failing.mute or stands) and not self._asked.holds(joint.name)

    def _patience(self, name: str, stops: int, sent: int, failing: Failing | None) -> Nanos:
        """Return how long after the last stop, or since it is left running, the next is sent. A driver that
        has raised is waited for no longer: but one that is to brake, or hold, may be able to in the next
        step."""
        if failing is None and sent < stops:
            return STOPS_WITHIN
        return STOPS_AGAIN if sent or not self._asked.is_to_be_idle(name) else 0

    def _unfit(self, bus: str, protocol: str, frame: Frame) -> Objection | None:
        """Return why a frame cannot be one of this driver's, whatever is in it."""
        wrong = malformed(frame, self._kinds[bus, protocol])
        return ("not a frame of this bus", wrong) if wrong else None

    # -- whose it is --------------------------------------------------------------------------------

    def _concerned(self, bus: str, protocol: str, frame: Frame) -> list[str]:
        """Return the devices of a driver that a frame may be for; on a serial line all."""
        specs = self._specs[bus, protocol]
        if not isinstance(frame, CanFrame):
            return list(specs)
        return [name for name, spec in specs.items() if any_matches(spec.sends, frame)]

    def _motors_of(self, bus: str, protocol: str, frame: Frame, obeyed: Sequence[Obeyed]) -> tuple[str, ...]:
        named = dict.fromkeys(name for one in obeyed if (name := getattr(one, "motor", "")))
        found = named or self._concerned(bus, protocol, frame)
        return tuple(name for name in found if name in self._motors)

    def _is_ours(self, now: Nanos, joint: Joint) -> bool:
        """True if we have commanded the device, or an operator has asked something of it."""
        return joint.owned or self._asked.is_asked(now, joint.name, ASKED) or self._asked.is_to_stop(now)

    # -- what it would do ---------------------------------------------------------------------------

    def _is_unread(
        self, bus: str, protocol: str, frame: CanFrame, concerned: Sequence[str], joints: Mapping[str, Joint]
    ) -> bool:
        """True if all that a frame is for are commanded, and nobody but they knows what it holds."""
        specs = self._specs[bus, protocol]
        return all(
            name in joints and joints[name].owned and any_matches(specs[name].unread, frame)
            for name in concerned
        )

    def _objection(
        self,
        now: Nanos,
        bus: str,
        protocol: str,
        frame: Frame,
        obeyed: Sequence[Obeyed],
        joints: Mapping[str, Joint],
        stopped: bool,
    ) -> Objection | None:
        ours: list[str] = []
        for one in obeyed:
            name = getattr(one, "motor", "")
            if name in joints and name not in ours and self._is_ours(now, joints[name]):
                ours.append(name)
        for one in obeyed:
            found = self._objection_to(now, one, joints.get(getattr(one, "motor", "")), ours, stopped)
            if found is not None:
                return found
        if obeyed or self._receivers[bus].read_only(protocol, frame):
            return None
        concerned = self._concerned(bus, protocol, frame)
        if not concerned:
            return "not a frame to any device of this driver", ""
        if isinstance(frame, CanFrame) and self._is_unread(bus, protocol, frame, concerned, joints):
            return None
        return "not read-only, and nothing that was asked for or declared", ", ".join(concerned)

    def _objection_to(
        self, now: Nanos, one: Obeyed, joint: Joint | None, ours: Sequence[str], stopped: bool
    ) -> Objection | None:
        if joint is None:
            return self._asked.objection(now, one, Reported())
        if joint.name not in ours and not isinstance(one, READS):
            stranger = isinstance(one, msg.Kept) and self._asked.is_id(now, one.name, one.value)
            if not stranger and not (ours and _is_at_rest(one)):
                return "a command to a device that was not commanded", type(one).__name__
            if isinstance(one, (*msg.COMMANDS, msg.Arm)):
                return None
        if isinstance(one, msg.Arm) and (stopped or joint.faults) and not joint.armed:
            return "arming against a stop or a fault", next(iter(joint.faults), ("", ""))[1]
        if isinstance(one, SET_POINTS) and (found := self._outside(now, one, joint)) is not None:
            return found
        return self._asked.objection(now, one, self._reported(joint), ours)

    def _reported(self, joint: Joint | None) -> Reported:
        """Return what a device reports, at its own shaft."""
        if joint is None:
            return Reported()
        place = joint.feedback.position
        return Reported(joint.armed, None if place is None else place * self._motors[joint.name].ratio)

    def _outside(self, now: Nanos, one: SetPoint, joint: Joint) -> Objection | None:
        """Return which number of a set-point is beyond the limits of the robot file."""
        bounds, measured = self._motors[joint.name], joint.feedback
        limits = bounds.limits
        velocity = slack = 0.0
        if getattr(one, "velocity", 0.0):  # 0 is within every limit, and NaN is not 0
            velocity, slack = bounds.at_joint(one, "velocity")
            if not abs(velocity) <= limits.velocity + slack:
                return "velocity beyond the limit", f"{velocity:g}, limit {limits.velocity:g}"
        if one.torque:
            torque, error = bounds.at_joint(one, "torque")
            if not abs(torque) <= limits.torque + error:
                return "torque beyond the limit", f"{torque:g}, limit {limits.torque:g}"
        if isinstance(one, msg.Velocity):
            measured_velocity = measured.velocity or 0.0
            for before, dt in self._before(now, one, "velocity", measured_velocity):
                slower = abs(velocity) <= abs(before) + slack and velocity * before >= 0.0
                if slower or not abs(velocity - before) > limits.acceleration * dt + slack:
                    return bounds.too_strong(one, measured)
            return "acceleration beyond the limit", f"velocity {velocity:g} after {measured_velocity:g}"
        if isinstance(one, msg.Torque):
            return None
        position, slack = bounds.at_joint(one, "position")
        if not self._leads_in(now, one, position, slack, measured.position):  # NaN and infinities do not
            return "position beyond the limit", f"{position:g}, limits {limits.position}"
        if isinstance(one, msg.Position) and (measured.position is not None or joint.open_loop):
            there = () if measured.position is None else (measured.position, limits.inside(measured.position))
            starts = [*self._before(now, one, "position", *there)]  # none: an open-loop joint that begins
            if starts and not any(
                abs(position - each) <= limits.velocity * dt + slack for each, dt in starts
            ):
                return "a jump of the position", f"{position:g} after {starts[0][0]:g}"
        return bounds.too_strong(one, measured)

    def _leads_in(
        self,
        now: Nanos,
        one: msg.Position | msg.Impedance,
        position: float,
        slack: float,
        measured: float | None,
    ) -> bool:
        """True if a position is within the range, or no farther out than the shaft, or the last set-point."""
        bounds = self._motors[one.motor]
        before = [bounds.limits.inside(position) if measured is None else measured]
        last = self._last.get((one.motor, None))
        if last is not None and now - last[0] <= GOES_ON and hasattr(last[1], "position"):
            before.append(bounds.at_joint(last[1], "position")[0])
        return any(abs(bounds.limits.led_in(position, each) - position) <= slack for each in before)

    def _before(
        self, now: Nanos, one: msg.Velocity | msg.Position, quantity: str, *measured: float
    ) -> Iterator[tuple[float, float]]:
        """Yield from where a set-point may go on, each with the time [s] in which it may have changed."""
        bounds, motor, kind = self._motors[one.motor], one.motor, type(one)
        last = self._last.get((motor, None))
        time = bounds.changing(bounds.timeout if last is None else now - last[0])
        if kind is msg.Position:  # a loop of the device makes of a jump what velocity it likes
            time, goes_on = bounds.changing(0), bounds.timeout
        else:
            goes_on = GOES_ON
        for value in measured:
            yield value, time
        alike, coasting = self._last.get((motor, kind)), self._coasting.get(motor)
        if alike is not None and now - alike[0] <= goes_on:
            yield bounds.at_joint(alike[1], quantity)[0], bounds.changing(now - alike[0])
        if kind is msg.Velocity and coasting is not None and now - coasting[0] <= GOES_ON:
            yield coasting[1], bounds.changing(0)


ASKED: tuple[type[Request], ...] = (
    msg.ClearFault,
    msg.Estop,
    msg.SetAddress,
    msg.Zero,
    msg.Home,
    msg.WriteParameter,
    msg.Reboot,
)
"""Requests after which a device may receive frames that are not read-only."""


def _is_at_rest(one: Obeyed) -> bool:
    """True if a motor that shares its drive with one that is ours may obey it: it does not turn by that."""
    return not isinstance(one, SET_POINTS) or one == msg.Velocity(one.motor, 0.0)


class _Bounds:
    """The limits of a motor in the robot file, and how its numbers are seen at the joint's output shaft."""

    def __init__(self, motor: Motor) -> None:
        self.limits, self.timeout = motor.joint.limits, motor.joint.command_timeout
        self.ratio = motor.joint.gear * motor.joint.sign
        """Of the device's shaft to the joint's."""
        self._gains = motor.spec.gains
        self._errors: dict[tuple[type[Command], str], tuple[float, float]] = {}
        """Of the encoding of each quantity of each set-point: absolute, and relative."""
        for kind in SET_POINTS:
            for quantity in ("position", "velocity", "torque"):
                known = motor.spec.ranges.get(f"{kind.__name__}.{quantity}")
                self._errors[kind, quantity] = (known.resolution, known.relative) if known else (0.0, 0.0)

    def at_joint(self, one: Command, quantity: str) -> tuple[float, float]:
        """Return "position", "velocity" or "torque", 0 where the set-point has none, and the error of its
        encoding."""
        value: float = getattr(one, quantity, 0.0)
        absolute, relative = self._errors[type(one), quantity]
        error, ratio = absolute + relative * abs(value), self.ratio
        if quantity == "torque":
            return value * ratio, 1e-9 + abs(error * ratio)
        return value / ratio, 1e-9 + abs(error / ratio)

    def changing(self, since: Nanos) -> float:
        """Return in which time [s] a set-point may have changed since then."""
        return ((since if since < self.timeout else self.timeout) + LATENCY) / SECOND

    def too_strong(self, one: SetPoint, measured: msg.Feedback) -> Objection | None:
        """Return that the spring and damper, which a set-point is to the device, pull too hard from where the
        shaft is measured."""
        if isinstance(one, msg.Impedance):
            stiffness, damping = one.stiffness, one.damping
        elif self._gains is not None:
            stiffness, damping = self._gains
        else:
            return None  # a loop of the drive's own, which has limits
        speed = (measured.velocity or 0.0) * self.ratio
        torque = one.torque + damping * (getattr(one, "velocity", 0.0) - speed)
        pulls = [torque]
        if isinstance(one, msg.Position | msg.Impedance):
            here = (measured.position or 0.0) * self.ratio
            soon = here + speed * LATENCY / SECOND  # the joint gives what suits where the shaft will be
            pulls = [torque + stiffness * (one.position - place) for place in (here, soon)]
        least = 0.0 if min(pulls) < 0.0 < max(pulls) else min(pulls, key=abs)
        pull, limit = least * self.ratio, self.limits.torque
        if abs(pull) <= limit * (1.0 + SPRING_ERROR):
            return None
        return "torque of the spring beyond the limit", f"{pull:g}, limit {limit:g}"
