"""Why nothing moves: a robot's buses and devices looked at for a few seconds, each finding with what to do.

Rules. Only read-only frames are sent: nothing is commanded, armed, cleared, started or stored; of a sensor
that reports only once it is started nothing is said. A finding says what was seen, why it matters, and the
one thing to do next. What has one cause is told once: a bus that is dead in
place of all of its devices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace

from gateway.buses import Bus
from gateway.core.clock import Clock
from gateway.core.robot import BusSettings, Motor, Robot
from gateway.core.step import Gateway
from gateway.monitor.lines import LineTroubles
from gateway.monitor.silence import Silence
from gateway.runtime import loop
from protocols import messages as msg
from protocols.frames import BusState
from protocols.messages import SECOND, Mode, Nanos
from protocols.plugin import FeedbackKind

EXAMINED: Nanos = 6 * SECOND
"""For how long a robot is looked at: silence is certain after 2 s, and the search for its cause goes on
beside the ticks."""
ASKED = (0.0, 0.5)
"""When devices are asked who is there, as shares of that time: two of one address may answer as one."""
SLOW = 0.5
"""Share of the reports that are expected, below which a motor reports too seldom."""
FAULTY = {
    BusState.OFF: "the controller has taken itself off the bus (bus-off)",
    BusState.PASSIVE: "the controller is error-passive",
    BusState.FULL: "nothing takes what is sent",
    BusState.GONE: "the interface has vanished",
}
WIRING = "check supply and wiring, 60 ohms between CANH and CANL (two terminations), and the bit rate"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it should be."""

    grave: bool
    """Whether the robot, or a part of it, cannot be used."""
    about: str
    """A bus, a motor, a sensor, "brain"."""
    seen: str
    matters: str
    todo: str


@dataclass(slots=True)
class Examination:
    """What was seen of a robot."""

    robot: Robot
    buses: Mapping[str, Bus]
    gateway: Gateway
    silent: dict[str, str]
    """What is said of devices that are not heard."""
    lines: dict[tuple[str, str], str]
    """What is said of serial lines."""
    seconds: float
    found: list[msg.Found] = field(default_factory=list)
    reports: dict[str, int] = field(default_factory=dict)
    """Reports of its motion, by motor."""
    hosts: dict[str, str] = field(default_factory=dict)
    """What is said of motors that another host commands."""
    states: dict[str, BusState] = field(default_factory=dict)
    """The worst of each bus."""

    def findings(self) -> list[Finding]:
        """Return what is wrong, buses first."""
        wires = [*self._buses(), *self._devices(), *self._strangers()]
        return wires if any(one.grave for one in wires) else [*wires, *self._brain()]

    def _buses(self) -> Iterator[Finding]:
        for name, settings in self.robot.buses.items():
            state = self.states.get(name)
            refused, bad = (int(getattr(self.buses[name], key, 0)) for key in ("refused", "bad"))
            if state in FAULTY:
                dead = "what is sent does not arrive, and no device of it is heard"
                refuses = f"; its adapter refused {refused} frames" if refused else ""
                yield Finding(True, name, FAULTY[state] + refuses, dead, f"{WIRING}; {_look_at(settings)}")
            for text in (text for (line, _), text in self.lines.items() if line == name):
                yield Finding(
                    False, name, text, "answers that are lost make feedback old", _look_at(settings)
                )
            if bad and state not in FAULTY:
                text = f"{bad} pieces that are no frames"
                yield Finding(False, name, text, "frames are lost", WIRING)
            if refused and state not in FAULTY:
                text = f"its adapter refused {refused} frames"
                yield Finding(True, name, text, "commands do not reach the motors", WIRING)

    def _devices(self) -> Iterator[Finding]:
        for device in self.robot.devices():
            name, settings = device.name, self.robot.buses[device.bus]
            if name in self.silent:
                if self.states.get(device.bus) not in FAULTY:
                    what = (
                        "it cannot be commanded" if isinstance(device, Motor) else "the brain goes without it"
                    )
                    yield Finding(True, name, self.silent[name], what, _scan(settings, device.plugin.name))
                continue
            for text in device.assumed:
                unknown = "speeds and torques are wrong by as much as it is"
                todo = f"state it in the robot file, under {name}: {text.partition(' ')[0]} = …"
                yield Finding(False, name, f"{text} is assumed", unknown, todo)
            if isinstance(device, Motor):
                yield from self._motor(device)

    def _motor(self, motor: Motor) -> Iterator[Finding]:
        name, joint = motor.name, self.gateway.joints[motor.name]
        for fault in joint.faults.values():
            seen = f"fault {fault.name}" + (f": {fault.cause}" if fault.cause else "")
            clears = f"{fault.remedy}; then: gateway ask {self.robot.name} clear {name}".lstrip("; ")
            yield Finding(True, name, seen, "no command is obeyed until it is cleared", clears)
        if joint.mode is Mode.ARMED:
            text = "it is armed, and this program has not armed it"
            armed = "another host or its own configuration drives it"
            yield Finding(False, name, text, armed, "end the other program before you command it")
        elif joint.mode in (Mode.INITIALISING, Mode.FAULT) and not joint.faults:
            detail = f" ({joint.detail})" if joint.detail else ""
            text = f"it is {joint.mode}{detail}"
            yield Finding(
                True, name, text, "it is not ready to be armed", f"gateway motor diff {self.robot.name}"
            )
        if name in self.hosts:
            two = "two hosts that command one motor make it jump"
            yield Finding(True, name, self.hosts[name], two, "end the other program")
        limits, place = joint.settings.limits, joint.feedback.position
        if place is not None and limits.outside(place) > limits.margin and limits.position is not None:
            text = f"it reads {place:.3g} rad, limits {list(limits.position)}"
            lost = "a turn is lost, or its zero is elsewhere: it will not be moved"
            ways = f"gateway ask {self.robot.name} zero {name} (or home {name}, or confirm {name})"
            yield Finding(True, name, text, lost, f"run it, then: {ways}")
        expected = self.seconds * SECOND / motor.spec.feedback_period
        reports = self.reports.get(name, 0)
        by_itself = motor.spec.feedback in (FeedbackKind.CYCLIC, FeedbackKind.POLLED)
        if by_itself and joint.is_heard_since(0) and reports < SLOW * expected:
            rate, wanted = reports / self.seconds, SECOND / motor.spec.feedback_period
            text = f"it reports {rate:.3g} times a second, {wanted:.3g} are expected"
            old = "feedback that is old is taken for lost"
            yield Finding(False, name, text, old, f"gateway motor diff {self.robot.name}")

    def _strangers(self) -> Iterator[Finding]:
        known = {(one.plugin.name, one.device.address): one.name for one in self.robot.devices()}
        told: set[tuple[str, int]] = set()
        for one in self.found:
            at = one.protocol, one.address
            if one.duplicate_address and at not in told:
                told.add(at)
                two = "both obey what is sent to one, and their answers collide"
                number = "SERIAL" if one.serial is None else f"{one.serial:X}"
                motor = self.robot.motors.get(known.get(at, ""))
                where = motor.bus if motor is not None else "BUS"
                todo = f"unplug one, or: gateway ask {self.robot.name} setid {where} {number} NEW"
                about = known.get(at, one.protocol)
                yield Finding(True, about, f"two devices have address {one.address}", two, todo)
            elif at not in known and at not in told:
                told.add(at)
                text = f"a device at address {one.address} is not in the robot file"
                yield Finding(False, one.protocol, text, "nothing commands it", "add it, or unplug it")

    def _brain(self) -> Iterator[Finding]:
        for system in self.gateway.belief().systems:
            if system.reason:
                text = f"{system.name} is {system.state}: {system.reason}"
                yield Finding(
                    False,
                    "brain",
                    text,
                    "no goal is driven to meanwhile",
                    f"gateway ask {self.robot.name} status",
                )


def examine(robot: Robot, buses: Mapping[str, Bus], clock: Clock, seconds: Nanos = EXAMINED) -> Examination:
    """Look at a robot whose buses are open; command nothing, and start no sensor."""
    quiet = {name: one for name, one in robot.sensors.items() if not one.spec.set_up}
    robot = replace(robot, sensors=quiet)
    gateway = Gateway(robot)
    silence, troubles = Silence(gateway, buses), LineTroubles(gateway, buses)
    scans = {one.bus: msg.Scan(one.bus) for one in robot.devices() if msg.Scan in one.spec.requests}
    began, asks = clock.now(), list(ASKED)
    made = Examination(robot, buses, gateway, silence.told, troubles.told, seconds / SECOND)

    def poll() -> Sequence[msg.Instruction]:
        if not asks or clock.now() - began < asks[0] * seconds:
            return ()
        asks.pop(0)
        return tuple(scans.values())

    with closing(loop.live(gateway, buses, clock, poll=poll, until=clock.now() + seconds)) as ticks:
        for tick in ticks:
            silence.take(tick)
            troubles.take(tick)
            made.states |= {bus: state for bus, state in tick.inputs.states if state is not BusState.UP}
            for event in tick.outputs.events:
                if isinstance(event, msg.Found):
                    made.found.append(event)
                elif isinstance(event, msg.Feedback) and (
                    event.position is not None or event.velocity is not None
                ):
                    made.reports[event.motor] = made.reports.get(event.motor, 0) + 1
            for note in tick.outputs.notes:
                if note.source in robot.motors and note.text.startswith("another host commands it"):
                    made.hosts[note.source] = note.text
    return made


def _scan(settings: BusSettings, protocol: str) -> str:
    """Return the command that looks for a protocol's devices on a bus."""
    rate = f" --baudrate {settings.baudrate}" if settings.baudrate else ""
    return f"gateway scan {settings.interface} --protocol {protocol}{rate}"


def _look_at(settings: BusSettings) -> str:
    kind, _, channel = settings.interface.partition(":")
    return (
        f"ip -details -statistics link show {channel}"
        if kind == "socketcan"
        else f"gateway watch {settings.interface}"
    )
