"""The gateway: `step(now, inputs) -> outputs` is everything that the robot does.

Rules. No clock, bus, thread, file or randomness in here or below: a step follows from the robot file and the
inputs so far, hence a replay of recorded inputs repeats it to the byte. The way from a measurement to a
command is the order of the lines of `step`. Every joint has exactly one command at every step. Every
outgoing frame passes through `_out`, and only there.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from typing import TYPE_CHECKING, Literal, TypeAlias

from brain.belief import Belief
from brain.brain import Brain
from gateway.core.joint import Joint
from gateway.core.tick import Inputs, Note, Outputs
from protocols import messages as msg
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Command, Event, Instruction, Mode, Nanos, Obeyed, Request, Task
from protocols.plugin import CommandDecoder, Driver, RxCounters

if TYPE_CHECKING:
    from gateway.core.robot import Robot

ALL = "all"
"""Instead of a motor's name in a request: every motor."""

MotorRequest: TypeAlias = (
    msg.ClearFault | msg.Estop | msg.Zero | msg.Home | msg.ReadParameter | msg.WriteParameter | msg.Reboot
)
"""The requests to one motor, or to all."""


@dataclass(frozen=True, slots=True)
class _BusDriver:
    """One driver, of all devices of its protocol on a bus."""

    bus: str
    protocol: str
    motors: frozenset[str]
    driver: Driver


class Gateway:
    """One robot: its drivers, its joints, its brain, and the operator's stop.

    Args:
        robot: what `load_robot` returned. Nothing is opened: the caller reads and writes the buses.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.joints = {name: Joint(name, motor.joint, motor.spec) for name, motor in robot.motors.items()}
        self.brain = Brain(
            robot.brain,
            list(robot.motors),
            {name: sensor.mount for name, sensor in robot.sensors.items()},
            {name: motor.joint.feedback_timeout for name, motor in robot.motors.items()}
            | {name: sensor.timeout for name, sensor in robot.sensors.items()},
        )
        self.stopped = ""
        """Why an operator has stopped the robot; "" if no stop is in force."""
        self._drivers: list[_BusDriver] = []
        """In the order of the robot file."""
        for bus in robot.buses:
            for plugin, devices in robot.by_protocol(bus):
                motors = frozenset(one.name for one in devices if one.name in self.joints)
                self._drivers.append(_BusDriver(bus, plugin.name, motors, plugin.driver(devices)))
        self._on_bus = {bus: [one.driver for one in self._drivers if one.bus == bus] for bus in robot.buses}
        self._requests: list[Request] = []
        """For the drivers, in this step."""
        self._late: list[Event] = []
        """Events that arose while sending: processed first in the next step."""
        self._notes: list[Note] = []

    # -- the step -----------------------------------------------------------------------------

    def step(self, now: Nanos, inputs: Inputs) -> Outputs:
        """Process one tick's inputs.

        Args:
            now: the time of the step [ns]; never less than in the step before.
            inputs: changes of buses, received packets and instructions since the step before.

        Returns:
            Outputs: the packets to send, in order; the events that the brain saw; notes for a person.
        """
        self._on_bus_states(now, inputs.states)
        events = self._receive(inputs.packets)
        tasks = self._on_instructions(now, inputs.instructions)
        stopped = self.why_stopped()
        wanted = {command.motor: command for command in self.brain.step(now, events, tasks, stopped)}
        commands = {
            name: joint.command(now, wanted.get(name), bool(stopped)) for name, joint in self.joints.items()
        }
        packets = self._send(now, commands)
        return Outputs(tuple(packets), tuple(events), self._take_notes())

    def leave(self, now: Nanos) -> tuple[Packet, ...]:
        """Return the frames of every commanded motor's stop action, without the brain: after an error.

        Args:
            now: the time of the last frames [ns].

        Returns:
            tuple[Packet, ...]: to be sent at once, whatever else fails.
        """
        commands = {
            name: joint.command(now, None, stopped=True, last=True) for name, joint in self.joints.items()
        }
        return tuple(self._send(now, commands))

    def due(self) -> Nanos | None:
        """Return when a driver next has to send by itself; None if none has to."""
        times = [due for one in self._drivers if (due := one.driver.due()) is not None]
        return min(times, default=None)

    def belief(self) -> Belief:
        """Return the brain's state estimate."""
        return self.brain.belief()

    def still_armed(self) -> list[str]:
        """Return the motors that we have commanded, that are to be disarmed, and that report being armed."""
        return [
            name
            for name, joint in self.joints.items()
            if joint.owned and joint.mode is Mode.ARMED and joint.settings.stop_action != "hold"
        ]

    def why_stopped(self) -> str:
        """Return why the whole robot must not move; "" if it may."""
        return self.stopped or self.in_fault()

    def in_fault(self) -> str:
        """Return the first fault that stops the whole robot, with its joint; "" if there is none."""
        for name, joint in self.joints.items():
            if joint.faults and joint.settings.on_fault == "stop":
                fault = next(iter(joint.faults.values()))
                return f"{name}: {fault.name}"
        return ""

    def rx_counters(self) -> list[tuple[str, str, RxCounters]]:
        """Return each driver's counters with its bus and protocol. What one of a bus's drivers ignores may be
        another's."""
        return [(one.bus, one.protocol, one.driver.counters) for one in self._drivers]

    # -- in -----------------------------------------------------------------------------------

    def _on_bus_states(self, now: Nanos, states: Sequence[tuple[str, BusState]]) -> None:
        for bus, state in states:
            for driver in self._on_bus[bus]:
                driver.bus(now, state)
            bad = state in (BusState.OFF, BusState.GONE, BusState.FULL)
            self._note("error" if bad else "warning", bus, _BUS_TEXTS[state])

    def _receive(self, packets: Sequence[Packet]) -> list[Event]:
        events = self._on_events(self._late)
        self._late = []
        for packet in packets:
            for driver in self._on_bus[packet.bus]:
                events += self._on_events(driver.receive(packet.t, packet.frame))
        return events

    def _on_events(self, events: Iterable[Event]) -> list[Event]:
        """Pass the events of motors through their joints; return what goes on to the brain."""
        passed: list[Event] = []
        for event in events:
            if not isinstance(event, (msg.Feedback, msg.State, msg.Fault)):
                self._note_answer(event)
                passed.append(event)
            elif (joint := self.joints.get(event.motor)) is not None:
                before = joint.mode
                moved = joint.on_event(event)
                if moved is None:
                    self._note("warning", joint.name, f"a value of {event} is not finite: left out")
                    continue
                if isinstance(event, msg.State) and event.mode is not before:
                    level: Literal["info", "warning"] = "warning" if event.mode in _BAD_MODES else "info"
                    self._note(level, joint.name, f"{event.mode}{_in_brackets(event.detail)}")
                passed.append(moved)
        return passed

    def _note_answer(self, event: Event) -> None:
        """Note the answer to a request; Done to a ClearFault also clears the joint."""
        match event:
            case msg.Done(_, request, name, detail):
                if request == msg.ClearFault.__name__ and name in self.joints:
                    self.joints[name].clear()
                self._note("info", name or "operator", f"{request}: done{_in_brackets(detail)}")
            case msg.Refused(_, request, name, reason):
                self._note("warning", name or "operator", f"{request}: refused: {reason}")
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
                case msg.Leave(reason):
                    self.stopped = self.stopped or reason
                    self._note("info", "operator", f"leaving: {reason}")
                case msg.Release():
                    text = "released" if self.stopped else "nothing to release: no stop is in force"
                    self.stopped = ""
                    self._note("info", "operator", text)
                case msg.Set(key, value):
                    self._set(key, value)
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
        text = f"set {key}: refused: {objection}" if objection else f"{key} = {value:g}"
        self._note("warning" if objection else "info", "operator", text)

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
            elif isinstance(request, msg.ClearFault):
                self._late.append(msg.Done(now, kind, name, "in the joint; the device has nothing to clear"))
            else:
                self._late.append(msg.Refused(now, kind, name, "its protocol cannot do this"))

    # -- out ----------------------------------------------------------------------------------

    def _send(self, now: Nanos, commands: dict[str, Command]) -> list[Packet]:
        requests, self._requests = self._requests, []
        packets: list[Packet] = []
        for one in self._drivers:
            messages: list[Command | Request] = [r for r in requests if _is_for(r, one)]
            messages += [command for name, command in commands.items() if name in one.motors]
            events, frames = one.driver.send(now, messages)
            self._late += events
            packets += self._out(now, one.bus, frames)
        return packets

    def _out(self, now: Nanos, bus: str, frames: Sequence[Frame]) -> Iterable[Packet]:
        """The one place through which every outgoing frame passes: the place of a guard."""
        return [Packet(now, bus, frame) for frame in frames]

    # -- notes --------------------------------------------------------------------------------

    def _note(self, level: Literal["info", "warning", "error"], source: str, text: str) -> None:
        self._notes.append(Note(level, source, text))

    def _take_notes(self) -> tuple[Note, ...]:
        """Return the notes of this step: its own, then those of the brain and of the joints."""
        for level, text in self.brain.take_notes():
            self._note(level, "brain", text)
        for name, joint in self.joints.items():
            if joint.refused:
                self._note("error", name, f"command refused: {joint.refused}")
                joint.refused = ""
            for fault in joint.take_unreported():
                cause = f"; likely cause: {fault.cause}" if fault.cause else ""
                remedy = f"; {fault.remedy}" if fault.remedy else ""
                self._note("error", name, f"fault: {fault.name}{cause}{remedy}")
        notes, self._notes = tuple(self._notes), []
        return notes


class _BusDecoder:
    """The command decoders of all protocols of a bus as one."""

    def __init__(self, decoders: Sequence[CommandDecoder]) -> None:
        self._decoders = decoders

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Decode what any device on the bus would obey."""
        return [message for decoder in self._decoders for message in decoder.decode(t, frame)]


def decoder_of(robot: Robot, bus: str) -> CommandDecoder:
    """Return a decoder of what the devices on a bus would obey."""
    return _BusDecoder([plugin.decoder(devices) for plugin, devices in robot.by_protocol(bus)])


def _is_for(request: Request, driver: _BusDriver) -> bool:
    if isinstance(request, msg.Stop):
        return bool(driver.motors)
    if isinstance(request, msg.Scan | msg.SetId):
        return request.bus == driver.bus
    return getattr(request, "motor", "") in driver.motors


def _not_finite(request: Request) -> str:
    """Return which number of a request is not finite, as a sentence; "" if all are."""
    named = [(field.name, getattr(request, field.name)) for field in fields(request)]
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
