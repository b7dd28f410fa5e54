"""The gateway: `step(now, inputs) -> outputs` is everything the robot does.

Rules. No clock, no bus, no thread, no file and no randomness in here or below: what a step does follows
from the robot file and the inputs so far, hence a recording of the inputs repeats it to the byte. The way
of one measurement in and one command out is the order of the lines of `step`. Every joint has exactly one
command at every step. What goes to a wire goes through `_out`, and there only.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, TypeAlias

from brain.belief import Belief
from brain.brain import Brain
from gateway.core.joint import Joint
from gateway.core.tick import Inputs, Note, Outputs
from protocols import messages as msg
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Command, Event, Mode, Nanos, Request
from protocols.plugin import CommandDecoder, Device, Driver, Plugin, RxCounters

if TYPE_CHECKING:
    from gateway.core.robot import Motor, Robot, Sensor

ALL = "all"
"""The name by which a request means every motor."""


OfMotor: TypeAlias = (
    msg.ClearFault | msg.Estop | msg.Zero | msg.Home | msg.ReadParameter | msg.WriteParameter | msg.Reboot
)
"""The requests that are about one motor, or about all."""


class Gateway:
    """One robot: its drivers, its joints, its brain, and what a person has asked for."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.joints = {m.device.name: Joint(m.device.name, m.joint, m.spec) for m in robot.motors.values()}
        self.brain = Brain(
            robot.brain,
            list(robot.motors),
            {name: sensor.mount for name, sensor in robot.sensors.items()},
            {name: motor.joint.feedback_timeout for name, motor in robot.motors.items()}
            | {name: sensor.timeout for name, sensor in robot.sensors.items()},
        )
        self.stopped = ""
        """Why an operator has stopped the robot; "" if nobody has."""
        self._languages: list[str] = []
        self._drivers: list[tuple[str, frozenset[str], Driver]] = []
        """Bus, the names of its motors, driver: in the order of the robot file."""
        for bus in robot.buses:
            for plugin, devices in by_plugin(robot, bus):
                motors = frozenset(d.name for d in devices if d.name in self.joints)
                self._languages.append(plugin.name)
                self._drivers.append((bus, motors, plugin.driver(devices)))
        self._of_bus = {bus: [d for b, _, d in self._drivers if b == bus] for bus in robot.buses}
        self._specs = {name: motor.spec for name, motor in robot.motors.items()}
        self._requests: list[Request] = []
        self._late: list[Event] = []
        self._notes: list[Note] = []

    # -- the step -----------------------------------------------------------------------------

    def step(self, now: Nanos, inputs: Inputs) -> Outputs:
        """Take in what has come, think, and give out what is to be said."""
        for name, state in inputs.states:
            self._bus(now, name, state)
        received = self._handle(self._late)
        self._late = []
        for packet in inputs.packets:
            for driver in self._of_bus[packet.bus]:
                received += self._handle(driver.receive(packet.t, packet.frame))
        tasks = self._ask(now, inputs.instructions)
        stopped = self.why_stopped()
        said = {c.motor: c for c in self.brain.step(now, received, tasks, stopped)}
        self._notes += [Note(level, "brain", text) for level, text in self.brain.take_notes()]
        words = {name: joint.allow(now, said.get(name), bool(stopped)) for name, joint in self.joints.items()}
        self._report_joints()
        packets = self._send(now, words)
        notes, self._notes = tuple(self._notes), []
        return Outputs(tuple(packets), tuple(received), notes)

    def leave(self, now: Nanos) -> tuple[Packet, ...]:
        """The safe word for every motor, without asking the brain: for the way out after an error."""
        words = {name: joint.allow(now, None, stopped=True, last=True) for name, joint in self.joints.items()}
        return tuple(self._send(now, words))

    def due(self) -> Nanos | None:
        """When a driver next has something to say by itself."""
        moments = [due for _, _, driver in self._drivers if (due := driver.due()) is not None]
        return min(moments) if moments else None

    def belief(self) -> Belief:
        """What the brain believes."""
        return self.brain.belief()

    def still_armed(self) -> list[str]:
        """The motors that we commanded, that are to be disarmed, and that do not say that they are."""
        return [
            name
            for name, joint in self.joints.items()
            if joint.owned and joint.mode is Mode.ARMED and joint.settings.stop_action != "hold"
        ]

    def why_stopped(self) -> str:
        """Why the whole robot must not move; "" if it may."""
        return self.stopped or self.in_fault()

    def in_fault(self) -> str:
        """The first fault that stops the whole robot, with its joint; "" if there is none."""
        for name, joint in self.joints.items():
            if joint.faults and joint.settings.on_fault == "stop":
                fault = next(iter(joint.faults.values()))
                return f"{name}: {fault.name}"
        return ""

    def rx_counters(self) -> list[tuple[str, str, RxCounters]]:
        """What each driver has counted, with its bus and language. What is foreign to one of a bus's drivers
        may be another's."""
        return [
            (bus, language, driver.counters)
            for language, (bus, _, driver) in zip(self._languages, self._drivers, strict=True)
        ]

    # -- in -----------------------------------------------------------------------------------

    def _bus(self, now: Nanos, name: str, state: BusState) -> None:
        for driver in self._of_bus[name]:
            driver.bus(now, state)
        bad = state in (BusState.OFF, BusState.GONE, BusState.FULL)
        self._notes.append(Note("error" if bad else "warning", name, _BUS_SENTENCES[state]))

    def _handle(self, events: Iterable[Event]) -> list[Event]:
        received: list[Event] = []
        for event in events:
            if isinstance(event, msg.Feedback | msg.State | msg.Fault):
                joint = self.joints.get(event.motor)
                if joint is None:
                    continue
                mode = joint.mode
                passed = joint.on_event(event)
                if passed is None:
                    self._notes.append(
                        Note("warning", joint.name, f"a value of {event} is not finite: left out")
                    )
                    continue
                if isinstance(event, msg.State) and event.mode is not mode:
                    detail = f" ({event.detail})" if event.detail else ""
                    self._notes.append(Note(_LEVELS[event.mode], joint.name, f"{event.mode}{detail}"))
                received.append(passed)
            else:
                self._report(event)
                received.append(event)
        return received

    def _report(self, event: Event) -> None:
        match event:
            case msg.Done(_, request, name, detail):
                if request == msg.ClearFault.__name__ and name in self.joints:
                    self.joints[name].clear()
                self._notes.append(Note("info", name or "operator", f"{request}: done{_in_brackets(detail)}"))
            case msg.Refused(_, request, name, reason):
                self._notes.append(Note("warning", name or "operator", f"{request}: refused: {reason}"))
            case msg.Parameter(motor, _, parameter, value):
                self._notes.append(Note("info", motor, f"{parameter} = {value:g}"))
            case msg.Found(_, protocol, address, serial, detail, twice):
                number = "" if serial is None else f", serial number {serial:X}"
                text = f"{protocol} at address {address}{number}{_in_brackets(detail)}"
                text += "; more than one device holds this address" if twice else ""
                self._notes.append(Note("warning" if twice else "info", "scan", text))
            case _:
                pass

    # -- what is asked ------------------------------------------------------------------------

    def _ask(self, now: Nanos, asked: Sequence[msg.Instruction]) -> list[msg.Goal | msg.Drive | Command]:
        tasks: list[msg.Goal | msg.Drive | Command] = []
        for word in asked:
            match word:
                case msg.Stop(reason):
                    self.stopped = reason or "an operator said stop"
                    self._notes.append(Note("warning", "operator", f"stopped: {self.stopped}"))
                    self._requests.append(word)
                case msg.Leave(reason):
                    self.stopped = self.stopped or reason
                    self._notes.append(Note("info", "operator", f"leaving: {reason}"))
                case msg.Release():
                    text = "released" if self.stopped else "nothing to release: no stop is in force"
                    self.stopped = ""
                    self._notes.append(Note("info", "operator", text))
                case msg.Set(key, value):
                    self._set(key, value)
                case (
                    msg.Goal()
                    | msg.Drive()
                    | msg.Idle()
                    | msg.Hold()
                    | msg.Position()
                    | msg.Velocity()
                    | msg.Torque()
                    | msg.Impedance()
                ):
                    tasks.append(word)
                case msg.Scan() | msg.SetId():
                    self._requests.append(word)
                case _:
                    self._request(now, word)
        return tasks

    def _set(self, key: str, value: float) -> None:
        room, _, rest = key.partition(".")
        if room in self.joints:
            objection = self.joints[room].change(rest.removeprefix("limits."), value)
        elif room == "brain":
            objection = self.brain.set(rest, value)
        else:
            rooms = ", ".join(["brain", *self.joints])
            objection = f"{key!r} begins with neither of {rooms}"
        text = f"set {key}: refused: {objection}" if objection else f"{key} = {value:g}"
        self._notes.append(Note("warning" if objection else "info", "operator", text))

    def _request(self, now: Nanos, word: OfMotor) -> None:
        kind = type(word).__name__
        for motor in self.joints if word.motor == ALL else (word.motor,):
            if motor not in self.joints:
                known = ", ".join(self.joints)
                self._late.append(
                    msg.Refused(now, kind, motor, f"there is no motor {motor!r}; there are {known}")
                )
            elif type(word) in self._specs[motor].requests:
                self._requests.append(replace(word, motor=motor))
            elif isinstance(word, msg.ClearFault):
                self._late.append(msg.Done(now, kind, motor, "in the joint; the device has nothing to clear"))
            else:
                self._late.append(msg.Refused(now, kind, motor, "its protocol cannot do this"))

    # -- out ----------------------------------------------------------------------------------

    def _report_joints(self) -> None:
        for name, joint in self.joints.items():
            if joint.refused:
                self._notes.append(Note("error", name, f"command refused: {joint.refused}"))
                joint.refused = ""
            for fault in joint.take_unreported():
                cause = f"; likely cause: {fault.cause}" if fault.cause else ""
                remedy = f"; {fault.remedy}" if fault.remedy else ""
                self._notes.append(Note("error", name, f"fault: {fault.name}{cause}{remedy}"))

    def _send(self, now: Nanos, words: dict[str, Command]) -> list[Packet]:
        requests, self._requests = self._requests, []
        packets: list[Packet] = []
        for bus, motors, driver in self._drivers:
            mine: list[Command | Request] = [r for r in requests if _is_for(r, bus, motors)]
            mine += [word for name, word in words.items() if name in motors]
            events, frames = driver.send(now, mine)
            self._late += events
            packets += self._out(now, bus, frames)
        return packets

    def _out(self, now: Nanos, bus: str, frames: Sequence[Frame]) -> Iterable[Packet]:
        """The one place through which everything passes on its way to a wire: a guard stands here."""
        return [Packet(now, bus, frame) for frame in frames]


class _Decoders:
    """The ears of all languages of a bus as one."""

    def __init__(self, decoders: Sequence[CommandDecoder]) -> None:
        self._decoders = decoders

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        """What any device on the bus would obey."""
        return [word for decoder in self._decoders for word in decoder.decode(t, frame)]


def decoder_of(robot: Robot, bus: str) -> CommandDecoder:
    """What the devices on a bus would obey."""
    return _Decoders([plugin.decoder(devices) for plugin, devices in by_plugin(robot, bus)])


def _is_for(request: Request, bus: str, motors: frozenset[str]) -> bool:
    if isinstance(request, msg.Stop):
        return bool(motors)
    if isinstance(request, msg.Scan | msg.SetId):
        return request.bus == bus
    return getattr(request, "motor", "") in motors


def _in_brackets(detail: str) -> str:
    return f" ({detail})" if detail else ""


_LEVELS: dict[Mode, Literal["info", "warning"]] = {
    Mode.INITIALISING: "info",
    Mode.READY: "info",
    Mode.ARMED: "info",
    Mode.FAULT: "warning",
    Mode.OFFLINE: "warning",
}


def by_plugin(robot: Robot, bus: str) -> list[tuple[Plugin, list[Device]]]:
    """The devices on a bus, gathered by language, in the order of the robot file."""
    gathered: dict[str, tuple[Plugin, list[Device]]] = {}
    parts: list[Motor | Sensor] = [*robot.motors.values(), *robot.sensors.values()]
    for part in parts:
        if part.bus == bus:
            gathered.setdefault(part.plugin.name, (part.plugin, []))[1].append(part.device)
    return list(gathered.values())


_BUS_SENTENCES = {
    BusState.UP: "is up",
    BusState.PASSIVE: "is error-passive: check the wiring, the termination and the bit rate",
    BusState.OFF: "is bus-off: nothing goes out; check the wiring, the termination and the bit rate",
    BusState.FULL: "its transmit queue is full: older commands were dropped; is anything listening?",
    BusState.GONE: "has vanished: the interface or port is gone",
    BusState.BACK: "is back",
}
