"""The gateway: `step(now, inputs) -> outputs` is everything that the robot does.

Rules. No clock, bus, thread, file or randomness in here or below: a step follows from the robot file and the
inputs so far, hence a replay of recorded inputs repeats it to the byte. The way from a measurement to a
command is the order of the lines of `step`. Every joint has exactly one command at every step. Every
outgoing frame passes the guard in `_out`, and only there. A driver that raises is a fault of its motors, and
keeps nothing from the others. Nothing was received, or measured, later than now.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields, replace
from math import isfinite
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from brain.belief import Belief, BrainTask
from brain.brain import brain_of
from brain.other_brain import BrainFailed
from gateway.core.bus_driver import BusDriver
from gateway.core.faults import BRAIN_FAILED, DRIVER_FAILED, FRAME_BLOCKED, OTHER_HOST
from gateway.core.guard import Blocked, Failing, Guard, text_of
from gateway.core.joint import Joint
from gateway.core.notes import Level, Notes
from gateway.core.other_hosts import OtherHosts
from gateway.core.tick import Inputs, Note, Outputs
from gateway.core.turns import APART, BrainTurns
from protocols import messages as msg
from protocols.frames import BusState, Frame, Packet
from protocols.line import Ended, Exchange, Line, Rank, exchange
from protocols.messages import Command, Event, Instruction, Mode, Nanos, Request, Task
from protocols.plugin import RxCounters

if TYPE_CHECKING:
    from gateway.core.robot import Robot

ALL = "all"
"""Instead of a motor's name in a request: every motor."""

MotorRequest: TypeAlias = (
    msg.ClearFault
    | msg.Estop
    | msg.SetAddress
    | msg.Zero
    | msg.Home
    | msg.ReadParameter
    | msg.WriteParameter
    | msg.Reboot
)
"""The requests to one motor, or to all."""


SLACK: Nanos = 300_000
"""What an answer on a line may be late beside the port's latency: the loop's own."""
LEFT_ARMED = "still armed: cut its supply"
"""The note on a motor that still reports being armed when the run has been left."""
Result = TypeVar("Result")
_NOTHING: Sequence[Event] = ()
_NO_FRAMES: Sequence[Frame] = ()


class Gateway:
    """One robot: its drivers, its joints, its brain, and the operator's stop.

    Args:
        robot: what `load_robot` returned. Nothing is opened: the caller reads and writes the buses.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.joints = {name: Joint(name, motor.joint, motor.spec) for name, motor in robot.motors.items()}
        self.brain = brain_of(
            robot.brain,
            list(robot.motors),
            {name: sensor.mount for name, sensor in robot.sensors.items()},
            {name: motor.joint.feedback_timeout for name, motor in robot.motors.items()}
            | {name: sensor.timeout for name, sensor in robot.sensors.items()},
        )
        self.bus_states: dict[str, BusState] = {}
        """The last that each bus has reported; those that are up from the beginning report none."""
        self.stopped = ""
        """Why an operator has stopped the robot; "" if no stop is in force."""
        self._sensor_modes: dict[str, Mode] = {}
        """The last that each sensor has reported, of those that do"""
        self._brain_failed = ""
        """Why the brain is not asked any more."""
        self._leaving = self._at_once = False
        """Whether the run ends, and whether without time to brake."""
        self._drivers: list[BusDriver] = []
        """In the order of the robot file."""
        for bus in robot.buses:
            for plugin, devices in robot.by_protocol(bus):
                motors = frozenset(one.name for one in devices if one.name in self.joints)
                sensors = [robot.sensors[one.name] for one in devices if one.name not in motors]
                started = tuple(one.name for one in sensors if one.spec.set_up)
                self._drivers.append(BusDriver(bus, plugin.name, motors, plugin.driver(devices), started))
        self._on_bus = {bus: [one for one in self._drivers if one.bus == bus] for bus in robot.buses}
        self._other_hosts = OtherHosts(robot)
        self.lines = {
            name: Line(
                bus.baudrate,
                half_duplex=bus.line == "half-duplex",
                slack=bus.latency + SLACK,
                gap=bus.turnaround,
            )
            for name, bus in robot.buses.items()
            if bus.line != "free"
        }
        """What waits for a serial line on which devices speak only when asked, by bus."""
        self._erring = {name: sensor for name, sensor in robot.sensors.items() if sensor.errs}
        """Sensors of which the file states an error."""
        self._turns = BrainTurns(robot.period)
        self._heard: list[Event] = []
        """What was received since the brain was asked."""
        self._ended: list[tuple[Nanos, str, Ended]] = []
        """Exchanges of lines that are over, and not decoded yet: when, and on which."""
        self._long = False
        """Whether the step before took its time before it handed something over: the next is due at once, and
        tells the lines by when that was written."""
        self._postponed = False
        """Whether the step before took an answer when the brain was due: the brain's is due at once."""
        self._commanded: tuple[str, ...] = ()
        """What kept joints from being driven when they were last commanded,"""
        self._offered: list[Exchange] = []
        """and what drivers gave to lines then: see `_overtaken`."""
        self.guard = Guard(robot)
        self._values: list[object] = [
            each for motor in robot.motors.values() for each in (motor.spec, motor.device, motor.joint)
        ]
        """What is never changed, hence not copied."""
        self._now: Nanos = 0
        """Time of the last step."""
        self._wanted: dict[str, Nanos] = {}
        """Since when each motor is commanded something else than Idle. On a line that goes out later."""
        self._requests: list[Request] = []
        """For the drivers, in this step."""
        self._late: list[Event] = []
        """Events that arose while sending: processed first in the next step."""
        self._failures: set[str] = set()
        """Of drivers without motors: each is noted once."""
        self._notes = Notes()

    # -- the step -----------------------------------------------------------------------------

    def step(self, now: Nanos, inputs: Inputs) -> Outputs:
        """Process one tick's inputs.

        Args:
            now: the time of the step [ns]; never less than in the step before.
            inputs: changes of buses, received packets and instructions since the step before.

        Returns:
            Outputs: the packets to send, in order; the events that the brain saw; notes for a person.
        """
        self._now = now
        self._finish(now)
        if not inputs.states and not inputs.instructions and self.between(now, inputs.packets):
            self._postponed = not self.between(now)
            self._heard += self._receive(now, inputs.packets, at_once=False)
            packets = self._hand_over(now)
            self._heard += self._decode() if not packets else ()
            return Outputs(tuple(packets), (), ())
        self._turns.ask(now)
        self._postponed = False
        self._on_bus_states(now, inputs.states)
        events = [*self._heard, *self._receive(now, inputs.packets)]
        self._heard = []
        tasks = self._on_instructions(now, inputs.instructions)
        stopped = self.why_stopped()
        self._commanded, self._offered = self._stopped_by(), []
        presumed = [each for one in self.joints.values() if (each := one.presumed(now)) is not None]
        thought = self._think(now, [*events, *presumed], tasks, stopped)
        wanted = {command.motor: command for command in thought}
        commands = {
            name: joint.command(now, wanted.get(name), bool(stopped), self._at_once, self._leaving)
            for name, joint in self.joints.items()
        }
        packets = self._send(now, commands, leaving=self._leaving)
        return Outputs(tuple(packets), tuple(events), self._take_notes())

    def between(self, now: Nanos, packets: Sequence[Packet] = ()) -> bool:
        """True if a step now is one between two of the brain's: answers are taken, and the lines go on. A
        driver that is due, and that no line keeps waiting, needs the brain's. With `packets` that complete an
        answer, behind which others wait, the brain's is the one behind: a line does not wait for it."""
        if not self.lines or not self._turns.begun:
            return False
        if self._turns.is_early(now) and not self._is_due(now, self._turns.asked_at):
            return True
        return not self._postponed and any(line.waiting for line in self._completed(packets))

    def _finish(self, now: Nanos) -> None:
        """Finish the step before: tell the lines that what it has handed over was written by now, and decode
        the answers behind which it has sent the next questions."""
        self._heard += self._decode()
        for line in self.lines.values() if self._long else ():
            line.written(now)
        self._long = False

    def _is_due(self, now: Nanos, last: Nanos) -> bool:
        """True if a driver has to send that no line keeps waiting; `last`: the step before."""
        free = self._free_due()
        return free is not None and now >= max(free, last + APART)

    def _free_due(self) -> Nanos | None:
        """Return when a driver next has to send by itself that no line keeps waiting."""
        times = (self._call(one, None, one.due) for one in self._drivers if one.bus not in self.lines)
        return min((due for due in times if due is not None), default=None)

    def _think(
        self, now: Nanos, events: Sequence[Event], tasks: Sequence[BrainTask], stopped: str
    ) -> Sequence[Command]:
        """Return the brain's commands. One of another distribution that fails is a fault of every joint. Ours
        that fails ends the run, unless a joint holds a load by its stop action: then it is not asked again,
        and the robot is stopped until the run is ended."""
        if self._brain_failed:
            return ()
        try:
            return self.brain.step(now, events, tasks, stopped)
        except BrainFailed as error:
            remedy = "report it to its maker, with the recording; `clear all` lets it begin anew"
            for name, joint in self.joints.items():
                joint.latch(msg.Fault(name, now, BRAIN_FAILED, error.name, error.cause, remedy))
            return ()
        except Exception as error:
            if not any(one.owned and one.settings.stop_action == "hold" for one in self.joints.values()):
                raise
            self._brain_failed = f"the brain has failed: {type(error).__name__}: {error}"
            self._note(
                "error", "brain", f"{self._brain_failed}; the loads are held: support them, then end the run"
            )
            return ()

    def leave(self, now: Nanos, inputs: Inputs | None = None) -> tuple[Packet, ...]:
        """Return the frames of every commanded motor's stop action, without the brain: after an error.

        What waits for a line comes with later calls, when the line is `due`, or what was asked is answered:
        with `inputs`, these go on where the one before ended, until `releasing` is empty.

        Args:
            now: the time of the last frames [ns].
            inputs: what was received since; its instructions are not carried out.

        Returns:
            tuple[Packet, ...]: to be sent at once, whatever else fails.
        """
        self._now = now
        self._finish(now)
        if inputs is not None:
            self._on_bus_states(now, inputs.states)
            self._receive(now, inputs.packets)
            soon = self.lines and self._turns.is_early_to_leave(now)
            if soon and not inputs.states and not self._is_due(now, self._turns.left_at):
                return tuple(self._hand_over(now))
        self._turns.leave(now)
        commands: dict[str, Command] = {}
        for name, joint in self.joints.items():
            commands[name], failure = _last_command(now, joint)
            if failure:
                self._note("error", name, f"Idle in place of its stop action: {failure}")
        return tuple(self._send(now, commands, leaving=True))

    def rehearse(self, now: Nanos, bus: str, protocol: str) -> tuple[Packet, ...]:
        """Return what `leave` would have one driver send now, for others to send if we cannot: all of it
        happens to copies.

        Args:
            now: the time of the step [ns].
            bus: the driver's bus.
            protocol: the driver's protocol.
        """
        (one,) = (each for each in self._on_bus[bus] if each.protocol == protocol)
        own = {name: joint for name, joint in self.joints.items() if name in one.motors}
        given = one.driver, own, self.guard
        driver, joints, guard = copy.deepcopy(given, {id(each): each for each in self._values})
        last = [_last_command(now, joint)[0] for joint in joints.values()]
        for command in last:
            guard.ask(now, command)
        _, sent = driver.send(now, last)
        frames = [bytes(frame) if isinstance(frame, bytes) else frame for frame in sent]
        passed, _ = guard.check(now, bus, protocol, frames, self.joints | joints, stopped=True)
        passed += guard.stops(now, bus, protocol, self.joints | joints)
        return tuple(Packet(now, bus, frame) for frame in passed)

    def due(self) -> Nanos | None:
        """Return when a driver next has to send by itself; None if none has to."""
        if self._long or self._postponed or self._ended:
            return self._now
        free = self._free_due()
        if free is not None and self.lines:
            free = max(free, self._turns.earliest())
        times = [free, *(line.due() for line in self.lines.values())]
        return min((due for due in times if due is not None), default=None)

    def awaiting(self) -> bool:
        """True while a driver awaits an answer to which it has something to add at once."""
        return any(self._call(one, False, one.driver.awaits) for one in self._drivers)

    def asked(self) -> list[str]:
        """Return the buses on whose lines an answer is under way."""
        return [name for name, line in self.lines.items() if line.out is not None]

    def releasing(self) -> list[str]:
        """Return the buses on whose lines something that disarms waits, or for its answer."""
        return [name for name, line in self.lines.items() if line.releases()]

    def completes(self, packets: Sequence[Packet]) -> bool:
        """True if what has come since the last step completes an answer, so that a step has something to do.
        Changes nothing."""
        return any(True for _ in self._completed(packets))

    def _completed(self, packets: Sequence[Packet]) -> Iterator[Line]:
        """Yield the lines on which what has come completes an answer."""
        for name in self.asked() if packets else ():
            data = b"".join(p.frame for p in packets if p.bus == name and isinstance(p.frame, bytes))
            if data and self.lines[name].completes(data):
                yield self.lines[name]

    def earliest_answer(self, bus: str, packets: Sequence[Packet]) -> Nanos:
        """Return when the answer under way on a line can be complete, by what has come of it since the last
        step; 0: at any time."""
        came = [(p.t, len(p.frame)) for p in packets if p.bus == bus and isinstance(p.frame, bytes)]
        return came[-1][0] + self.lines[bus].time_to_complete(sum(size for _, size in came)) if came else 0

    def belief(self) -> Belief:
        """Return the brain's state estimate."""
        return self.brain.belief()

    def still_armed(self) -> list[str]:
        """Return the motors that we have commanded, that are to be disarmed, and that last reported ARMED, or
        of which nothing is known since their driver began to raise."""
        failing = [one for one in self._drivers if one.is_failing(self._now)]
        unknown = {name for one in failing for name in self._unknown(one)}
        return [
            name
            for name, joint in self.joints.items()
            if joint.owned
            and (joint.armed or name in unknown)
            and not (joint.settings.stop_action == "hold" and joint.settings.unattended == "held")
        ]

    def why_stopped(self) -> str:
        """Return why the whole robot must not move; "" if it may."""
        return self.stopped or self._brain_failed or self.in_fault()

    def in_fault(self) -> str:
        """Return the first fault that stops the whole robot, with its joint; "" if there is none."""
        for name, joint in self.joints.items():
            for fault in joint.faults.values():
                if joint.settings.on_fault == "stop" or fault.code == BRAIN_FAILED:
                    return f"{name}: {fault.name}"
        return ""

    def rx_counters(self) -> list[tuple[str, str, RxCounters]]:
        """Return each driver's counters with its bus and protocol. What one of a bus's drivers ignores may be
        another's."""
        return [(one.bus, one.protocol, one.driver.counters) for one in self._drivers]

    # -- in -----------------------------------------------------------------------------------

    def _on_bus_states(self, now: Nanos, states: Sequence[tuple[str, BusState]]) -> None:
        for bus, state in states:
            self.bus_states[bus] = state
            if bus in self.lines and state in (BusState.OFF, BusState.GONE, BusState.BACK):
                self.lines[bus].drop()
            for one in self._on_bus[bus]:
                self._call(one, None, one.driver.bus, now, state)
            bad = state in (BusState.OFF, BusState.GONE, BusState.FULL)
            self._note("error" if bad else "warning", bus, _BUS_TEXTS[state])

    def _receive(self, now: Nanos, packets: Sequence[Packet], *, at_once: bool = True) -> list[Event]:
        """Take what has come. Not `at_once`: answers are decoded before something else than a question is
        sent, or in the next step."""
        events = self._on_events(now, self._late)
        self._late = []
        for packet, another_host in self._other_hosts.among(packets):
            t = min(packet.t, now)
            if another_host:
                self._overhear(t, packet)
            frame = packet.frame
            if isinstance(frame, bytes) and (line := self.lines.get(packet.bus)) is not None:
                ended, frame = line.receive(t, frame)
                self._ended += [(t, packet.bus, each) for each in ended]
                events += self._decode() if at_once else ()
                if not frame:
                    continue
            for one in self._on_bus[packet.bus]:
                events += self._on_received(one, self._call(one, _NOTHING, one.receive, t, frame))
        for name, line in self.lines.items():
            self._ended += [(now, name, each) for each in line.expire(now)]
        return events + self._decode() if at_once else events

    def _decode(self) -> list[Event]:
        """Return what the exchanges that have ended report."""
        ended, self._ended = self._ended, []
        return [event for each in ended for event in self._on_answer(*each)]

    def _on_answer(self, t: Nanos, bus: str, ended: Ended) -> list[Event]:
        one = self._on_bus[bus][ended.owner]
        return self._on_received(one, self._call(one, _NOTHING, one.answer, t, ended.exchange, ended.data))

    def _on_received(self, one: BusDriver, received: Sequence[Event]) -> list[Event]:
        if not received:
            return []
        self._identify(one, received)
        return self._on_events(self._now, received)

    def _identify(self, one: BusDriver, events: Sequence[Event]) -> None:
        """Tell the joints the serial numbers of their devices: what was found names no bus."""
        for found in events:
            if isinstance(found, msg.Found) and found.serial is not None:
                for name in one.motors:
                    if self.robot.motors[name].device.address == found.address:
                        self.joints[name].identify(found.serial)

    def _demanded(self, now: Nanos, one: BusDriver) -> list[Request]:
        """Return a scan, if one of its motors is there, and its serial number is demanded and not known."""
        unknown = [
            name for name in one.motors if (each := self.joints[name]).unidentified and each.is_heard(now)
        ]
        asks, again = one.asks_identity(now) if unknown else (False, False)
        for name in sorted(unknown) if asks and again else ():
            self._note("warning", name, "does not tell the serial number that is demanded: it is not armed")
        return [msg.Scan(one.bus)] if asks else []

    def _overhear(self, t: Nanos, packet: Packet) -> None:
        """Latch a fault of the motors that are ours and that another host commands; note the others."""
        frame = text_of(packet.frame)
        for one in self.guard.overhear(t, packet.bus, packet.frame):
            joint = self.joints.get(name := getattr(one, "motor", ""))
            if joint is not None and joint.owned:
                cause = f"a second gateway, a tool or a replay sends {frame}"
                remedy = "end the other program, then clear the fault"
                joint.latch(msg.Fault(name, t, OTHER_HOST, "another host commands it", cause, remedy))
            elif joint is not None and self._other_hosts.is_news(name):
                self._note("warning", name, f"another host commands it: {frame}; end it before you command")

    def _hand_over(self, now: Nanos) -> list[Packet]:
        """Return what the lines send now: through the guard, as everything. What only reads goes out
        before the last answer is decoded; all else is judged by that, too."""
        packets: list[Packet] = []
        for name, line in self.lines.items():
            for owner, each in line.take(now):
                one, frame = self._on_bus[name][owner], bytes(each)
                if self._ended and not (each.answer and self.guard.reads(name, one.protocol, frame)):
                    self._heard += self._decode()
                passed = list(self._out(now, one, [frame], each))
                if not passed:
                    line.blocked(each)
                packets += passed
        return packets

    def _on_events(self, now: Nanos, events: Iterable[Event]) -> list[Event]:
        """Pass the events of motors through their joints; return what goes on to the brain."""
        passed: list[Event] = []
        for given in events:
            event = given if given.t <= now else replace(given, t=now)
            if not isinstance(event, (msg.Feedback, msg.State, msg.Fault)):
                if not isinstance(event, msg.Measurement):
                    self._note_answer(event)
                elif event.sensor in self._erring:
                    event = self._erring[event.sensor].corrected(event)
                passed.append(event)
            elif (joint := self.joints.get(event.motor)) is not None:
                before = joint.mode
                moved = joint.on_event(event)
                if moved is None:
                    self._notes.refuse(now, joint.name, "feedback", _not_finite(event))
                    continue
                if isinstance(event, msg.State) and event.mode is not before:
                    level: Level = "warning" if event.mode in _BAD_MODES else "info"
                    self._note(level, joint.name, f"{event.mode}{_in_brackets(event.detail)}")
                if not joint.unidentified:  # to the brain, it is not there
                    passed.append(moved)
            elif event.motor in self.robot.sensors and not isinstance(event, msg.Feedback):
                passed += [event] if self._is_news(event) else []
        return passed

    def _is_news(self, event: msg.State | msg.Fault) -> bool:
        """Note what is wrong with a sensor, by its own account, and that it is over; False: it is well, as
        before."""
        if isinstance(event, msg.Fault):
            self._note("error", event.motor, f"{event.name}; likely cause: {event.cause}; {event.remedy}")
            return True
        before = self._sensor_modes.get(event.motor, Mode.READY)
        self._sensor_modes[event.motor] = event.mode
        if not {event.mode, before} & {*_BAD_MODES}:
            return False
        if event.mode is not before:
            level: Level = "warning" if event.mode in _BAD_MODES else "info"
            self._note(level, event.motor, f"{event.mode}{_in_brackets(event.detail)}")
        return True

    def _note_answer(self, event: Event) -> None:
        """Note the answer to a request; Done to a ClearFault also clears the joint."""
        self.guard.answer(event)
        if isinstance(event, msg.Done | msg.Refused) and event.name in self.joints:
            self.joints[event.name].on_answer(event.t, event.request, done=isinstance(event, msg.Done))
        match event:
            case msg.Done(_, request, name, detail):
                if request == msg.ClearFault.__name__ and name in self.joints:
                    self.joints[name].clear()
                self._note("info", name or "operator", f"{request}: done{_in_brackets(detail)}")
            case msg.Refused(t, request, name, reason):
                self._notes.refuse(t, name or "operator", request, reason)
            case msg.Parameter(motor, _, parameter, value):
                self._note("info", motor, f"{parameter} = {value:g}")
            case msg.Found(_, protocol, address, serial, detail, duplicate):
                number = "" if serial is None else f", serial number {serial:X}"
                text = f"{protocol} at address {address}{number}{_in_brackets(detail)}"
                text += "; more than one device holds this address" if duplicate else ""
                self._note("warning" if duplicate else "info", "scan", text)

    # -- instructions -------------------------------------------------------------------------

    def _on_instructions(self, now: Nanos, instructions: Sequence[Instruction]) -> list[Task | Command]:
        """Carry out what concerns the gateway, queue requests for the drivers, return the brain's part."""
        tasks: list[Task | Command] = []
        for one in instructions:
            if isinstance(one, Task | Command):
                tasks.append(one)
                continue
            if wrong := _not_finite(one):
                name = getattr(one, "motor", getattr(one, "bus", ""))
                self._late.append(msg.Refused(now, type(one).__name__, name, wrong))
                continue
            match one:
                case msg.Stop(reason):
                    self.stopped = reason or "an operator sent stop"
                    self._note("warning", "operator", f"stopped: {self.stopped}")
                    self._requests.append(one)
                case msg.Leave(reason, at_once, last):
                    self.stopped = self.stopped or reason
                    self._leaving, self._at_once = True, at_once
                    self._note("info", "operator", f"leaving{' at once' * at_once}: {reason}")
                    for name in self.still_armed() if last else ():
                        self._note("error", name, LEFT_ARMED)
                case msg.Release() if any(isinstance(other, msg.Stop) for other in instructions):
                    self._note("info", "operator", "not released: a stop was sent in the same step")
                case msg.Release():
                    text = "released" if self.stopped else "nothing to release: no stop is in force"
                    self.stopped, self._leaving, self._at_once = "", False, False
                    self._note("info", "operator", text)
                case msg.Set(key, value):
                    self._set(key, value)
                case msg.Confirm(motor):
                    self._confirm(now, motor)
                case msg.Scan() | msg.SetId():
                    self._requests.append(one)
                case _:
                    self._on_motor_request(now, one)
        return tasks

    def _set(self, key: str, value: float) -> None:
        owner, _, rest = key.partition(".")
        if owner in self.joints:
            objection = self.joints[owner].change(rest.removeprefix("limits."), value)
        elif owner == "brain":
            objection = self.brain.set(rest, value)
        else:
            owners = ", ".join(["brain", *self.joints])
            objection = f"{key!r} begins with none of {owners}"
        if not objection:
            self._note("info", "operator", f"{key} = {value:g}")
        else:
            self._notes.refuse(self._now, "operator", f"set {key}", objection)

    def _confirm(self, now: Nanos, motor: str) -> None:
        """Take the reported position of a motor as the true one, and answer."""
        if joint := self.joints.get(motor):
            joint.confirm()
            place = "nothing yet" if joint.feedback.position is None else f"{joint.feedback.position:.4g} rad"
            self._late.append(msg.Done(now, msg.Confirm.__name__, motor, f"it reads {place}"))
        else:
            text = f"there is no motor {motor!r}; there are {', '.join(self.joints)}"
            self._late.append(msg.Refused(now, msg.Confirm.__name__, motor, text))

    def _on_motor_request(self, now: Nanos, request: MotorRequest) -> None:
        """Queue a request for its driver, or answer it here if the motor's protocol does not have it."""
        kind = type(request).__name__
        for name in self.joints if request.motor == ALL else (request.motor,):
            motor = self.robot.motors.get(name)
            if motor is None:
                text = f"there is no motor {name!r}; there are {', '.join(self.joints)}"
                self._late.append(msg.Refused(now, kind, name, text))
            elif type(request) in motor.spec.requests:
                self._requests.append(replace(request, motor=name))
                self.joints[name].on_request(now, request)
            elif isinstance(request, msg.ClearFault):
                self._late.append(msg.Done(now, kind, name, "in the joint; the device has nothing to clear"))
            else:
                self._late.append(msg.Refused(now, kind, name, "its protocol cannot do this"))

    # -- out ----------------------------------------------------------------------------------

    def _send(self, now: Nanos, commands: dict[str, Command], *, leaving: bool) -> list[Packet]:
        requests, self._requests = self._requests, []
        packets: list[Packet] = []
        for one in self._drivers:
            asked = [request for request in requests if one.takes(request)] + self._demanded(now, one)
            given = [*asked, *(command for name, command in commands.items() if name in one.motors)]
            given += map(msg.Idle, one.started) if leaving else ()
            for each in given:
                self.guard.ask(now, each)
            sent = self._call(one, None, one.send, now, given)
            events, frames = sent if sent is not None else (_NOTHING, _NO_FRAMES)
            self._identify(one, events)
            self._late += events
            if one.bus in self.lines:
                self._put(now, one, frames, mute=sent is None)
            else:
                packets += self._out(now, one, frames)
                stops = self._stops(now, one, mute=sent is None)
                packets += (Packet(now, one.bus, each) for each in stops)
        handed = self._hand_over(now)
        self._long = bool(handed)
        packets += handed
        for name, joint in self.joints.items():
            if isinstance(commands[name], msg.Idle):
                self._wanted.pop(name, None)
            elif not self.guard.drives(name, self._wanted.setdefault(name, now)):
                joint.on_held_back()
        return packets

    def _put(self, now: Nanos, one: BusDriver, frames: Sequence[Frame], *, mute: bool) -> None:
        """Give a line what one of its drivers sends, and the devices' own stops. Of a driver that has failed,
        that is nothing: its set-points are taken back, and what disarms is still sent."""
        given = [exchange(frame) for frame in frames if isinstance(frame, bytes)]
        self._offered += given
        stops = [exchange(frame) for frame in self._stops(now, one, mute=mute) if isinstance(frame, bytes)]
        given += [Exchange(stop, stop.answer, Rank.RELEASE, stop.about) for stop in stops]
        self.lines[one.bus].put(self._on_bus[one.bus].index(one), given)

    def _stops(self, now: Nanos, one: BusDriver, *, mute: bool) -> list[Frame]:
        """Return the devices' own stops that are due. `mute`: the driver has raised, and sends nothing."""
        failing = Failing(mute, self._unknown(one)) if one.is_failing(self._now) else None
        return self.guard.stops(now, one.bus, one.protocol, self.joints, failing)

    def _unknown(self, one: BusDriver) -> frozenset[str]:
        """Return the motors of a failing driver of which nothing is known since it began to raise."""
        since = one.failing_since
        return frozenset(name for name in one.motors if not self.joints[name].is_heard_since(since))

    def _stopped_by(self) -> tuple[str, ...]:
        """Return what keeps joints from being driven, beside frames that were blocked."""
        faults = ((name, joint.faults) for name, joint in self.joints.items())
        found = (name for name, those in faults if those and any(code != FRAME_BLOCKED for code, _ in those))
        return (self.stopped, self._brain_failed, *found)

    def _out(
        self, now: Nanos, one: BusDriver, frames: Sequence[Frame], waited: Exchange | None = None
    ) -> Iterable[Packet]:
        """Pass frames through the guard: the one place through which every outgoing frame goes. `waited`:
        what they are of a line."""
        stopped = bool(self.why_stopped())
        passed, blocked = self.guard.check(now, one.bus, one.protocol, frames, self.joints, stopped)
        for each in blocked:
            if not self._overtaken(waited):
                self._on_blocked(one, each)
        return [Packet(now, one.bus, frame) for frame in passed]

    def _overtaken(self, waited: Exchange | None) -> bool:
        """Return whether a stop or a fault has come since what is blocked was commanded, in this step or
        while it waited for its line: then it is no defect of the driver. What its driver no longer gives,
        while something stops it, is from before that."""
        stopped_by = self._stopped_by()
        old = waited is not None and not any(each is waited for each in self._offered)
        return stopped_by != self._commanded or (old and any(stopped_by))

    def _on_blocked(self, one: BusDriver, blocked: Blocked) -> None:
        self._latch(
            one,
            blocked.motors or one.motors,
            FRAME_BLOCKED,
            f"frame blocked by the guard: {blocked.rule}",
            blocked.text,
        )

    def _call(
        self,
        one: BusDriver,
        otherwise: Result,
        call: Callable[..., Result],
        *given: Any,  # noqa: ANN401 -- what the call takes
    ) -> Result:
        """Call a driver. If it raises, this is a fault of its motors, and `otherwise` is returned."""
        try:
            return call(*given)
        except (Exception, SystemExit) as error:  # noqa: BLE001 -- a plugin's; the others must go on
            one.on_raised(self._now)
            name = f"the driver {one.protocol} on {one.bus} has failed"
            self._latch(one, one.motors, DRIVER_FAILED, name, f"{type(error).__name__}: {error}")
            return otherwise

    def _latch(self, one: BusDriver, motors: Iterable[str], code: int, name: str, cause: str) -> None:
        """Latch a fault of a driver in its motors' joints; if it has none, stop the robot."""
        remedy = "this is a defect of the driver: report it with the recording; restart the gateway"
        for motor in motors:
            self.joints[motor].latch(msg.Fault(motor, self._now, code, name, cause, remedy))
        if not one.motors:
            self.stopped = self.stopped or name
            if name not in self._failures:
                self._failures.add(name)
                self._note("error", one.bus, f"{name}; likely cause: {cause}; {remedy}")

    # -- notes --------------------------------------------------------------------------------

    def _note(self, level: Level, source: str, text: str) -> None:
        self._notes.add(level, source, text)

    def _take_notes(self) -> tuple[Note, ...]:
        """Return the notes of this step: its own, then those of the brain and of the joints."""
        for level, text in self.brain.take_notes():
            self._note(level, "brain", text)
        for name, joint in self.joints.items():
            if refused := joint.take_refused():
                self._note("error", name, f"command refused: {refused}")
            for fault in joint.take_unreported():
                cause = f"; likely cause: {fault.cause}" if fault.cause else ""
                remedy = f"; {fault.remedy}" if fault.remedy else ""
                self._note("error", name, f"fault: {fault.name}{cause}{remedy}")
        return self._notes.take()


def _last_command(now: Nanos, joint: Joint) -> tuple[Command, str]:
    """Return a joint's stop command when nothing will follow; Idle if it fails, with the reason."""
    try:
        return joint.command(now, None, stopped=True, last=True), ""
    except Exception as error:  # noqa: BLE001 -- whatever has failed, the others get theirs
        return msg.Idle(joint.name), f"{type(error).__name__}: {error}"


def _not_finite(message: Request | Event) -> str:
    """Return which number of a message is not finite, as a sentence; "" if all are."""
    named = [(field.name, getattr(message, field.name)) for field in fields(message)]
    wrong = [(name, value) for name, value in named if isinstance(value, float) and not isfinite(value)]
    return f"its {wrong[0][0]} is {wrong[0][1]}, and must be finite" if wrong else ""


def _in_brackets(detail: str) -> str:
    return f" ({detail})" if detail else ""


_BAD_MODES = (Mode.FAULT, Mode.OFFLINE)
_BUS_TEXTS = {
    BusState.UP: "is up",
    BusState.PASSIVE: "is error-passive: check the wiring, the termination and the bit rate",
    BusState.OFF: "is bus-off: nothing is sent; check the wiring, the termination and the bit rate",
    BusState.FULL: "its transmit queue is full: older commands were dropped; is any device listening?",
    BusState.GONE: "has vanished: the interface or port is gone",
    BusState.BACK: "is back",
}
