"""Why nothing moves: a robot's buses and devices looked at for a few seconds, each finding with what to do.

Rules. Only read-only frames are sent: nothing is commanded, armed, cleared, started or stored; of a sensor
that reports only once it is started nothing is said. A finding says what was seen, why it matters, and the
one thing to do next. What has one cause is told once: a bus that is dead in
place of all of its devices.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from gateway.buses import Bus
from gateway.buses.troubles import USB, Trouble, of_usb
from gateway.core.clock import Clock
from gateway.core.robot import TWIN, BusSettings, Motor, Robot
from gateway.core.step import Gateway
from gateway.core.tick import Tick
from gateway.errors import BusError
from gateway.monitor.lines import LineTroubles
from gateway.monitor.silence import Silence, looks
from gateway.runtime import loop
from gateway.runtime.realtime import DEFAULT, unallowed
from protocols import messages as msg
from protocols.frames import BusState, CanFrame, IdSet, Packet, id_number
from protocols.messages import SECOND, Mode, Nanos
from protocols.plugin import FeedbackKind, Spec

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
LEAST_SUPPLY = 6.0
"""V, below which no motor turns: the electronics live on USB, or on a supply that is not switched on"""
MOST_STRANGERS, MOST_OF_EACH, MOST_SHOWN = 64, 25, 8
"""Ids of a bus that are kept, packets of each, and ids that a finding lists"""
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
class Traffic:
    """What went to and came from one device. On a serial line frames are not counted."""

    sent: int = 0
    """Frames that are its own; those to several devices count for each"""
    heard: int = 0
    """Frames"""
    reported: int = 0
    """Feedback or readings"""

    def __str__(self) -> str:
        """Return it in words."""
        frames = f"{self.sent} frames sent, {self.heard} heard, " if self.sent or self.heard else ""
        return f"{frames}{self.reported} reports" if self.reported or self.heard else f"{frames}silent"


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
    strange: dict[str, dict[int, list[Packet]]] = field(default_factory=dict)
    """By CAN bus: ids that are of no device of the robot file, each with the first that came."""
    traffic: dict[str, Traffic] = field(default_factory=dict)
    """By device"""
    voltages: dict[str, float] = field(default_factory=dict)
    """V of the supply, by motor, as last reported"""

    def findings(self) -> list[Finding]:
        """Return what is wrong, buses first."""
        wires = [*self._buses(), *self._devices(), *self._strangers(), *self._unknown_ids()]
        return wires if any(one.grave for one in wires) else [*wires, *self._brain()]

    def _buses(self) -> Iterator[Finding]:
        for name, settings in self.robot.buses.items():
            state = self.states.get(name)
            refused, bad = (int(getattr(self.buses[name], key, 0)) for key in ("refused", "bad"))
            grave = any(one.grave for one in self._troubles(name))
            if state in FAULTY and not (grave and state in (BusState.FULL, BusState.PASSIVE)):
                dead = "what is sent does not arrive, and no device of it is heard"
                refuses = f"; its adapter refused {refused} frames" if refused else ""
                yield Finding(True, name, FAULTY[state] + refuses, dead, f"{WIRING}; {_look_at(settings)}")
            yield from (of_trouble(name, each) for each in self._troubles(name))
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

    def _troubles(self, bus: str) -> Sequence[Trouble]:
        return tuple(getattr(self.buses[bus], "troubles", tuple)())

    def _is_dead(self, bus: str) -> bool:
        """Whether the bus is why its devices are silent."""
        all_silent = all(one.name in self.silent for one in self.robot.devices_on(bus))
        return self.states.get(bus) in FAULTY or (
            all_silent and any(one.grave for one in self._troubles(bus))
        )

    def _devices(self) -> Iterator[Finding]:
        for device in self.robot.devices():
            name, settings = device.name, self.robot.buses[device.bus]
            if name in self.silent:
                if not self._is_dead(device.bus):
                    what = (
                        "it cannot be commanded" if isinstance(device, Motor) else "the brain goes without it"
                    )
                    like = self.silent[name].partition("that looks like ")[2].partition(" ")[0]
                    scan = _scan(settings, like or device.plugin.name)
                    yield Finding(True, name, self.silent[name], what, scan)
                continue
            for text in device.assumed:
                unknown = "speeds and torques are wrong by as much as it is"
                todo = f"state it in the robot file, under {name}: {text.partition(' ')[0]} = …"
                yield Finding(False, name, f"{text} is assumed", unknown, todo)
            if isinstance(device, Motor):
                yield from self._motor(device)

    def _motor(self, motor: Motor) -> Iterator[Finding]:
        name, joint = motor.name, self.gateway.joints[motor.name]
        shared = any(one.duplicate_address and one.address == motor.device.address for one in self.found)
        for fault in joint.faults.values():
            if shared and fault.name.startswith("duplicate address"):
                continue  # it is told with what to do about it
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
        volts = self.voltages.get(name)
        if volts is not None and volts < LEAST_SUPPLY and not joint.faults:
            text = f"its supply reads {volts:.1f} V"
            weak = "its electronics are powered (by USB, by the bus), its power stage is not"
            yield Finding(
                True, name, text, weak, "switch its supply on; check fuse, emergency stop and cable"
            )
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
            elif at not in known and at not in told and self._can_be(one):
                told.add(at)
                text = f"a device at address {one.address} is not in the robot file"
                yield Finding(False, one.protocol, text, "nothing commands it", "add it, or unplug it")

    def _unknown_ids(self) -> Iterator[Finding]:
        """Yield ids that are heard on a bus, of no device of the file, and of none that a scan has named."""
        silent = {one.bus for one in self.robot.devices() if one.name in self.silent}
        for bus, heard in self.strange.items():
            ids = sorted(number for number in heard if not self._is_named(bus, number))
            if not ids or bus in silent:  # what is silent names what is heard in its place
                continue
            packets = sorted((one for number in ids for one in heard[number]), key=lambda one: one.t)
            likely = exhausted(looks(self.robot, bus, packets))
            shown = ", ".join(f"0x{one & 0x1FFF_FFFF:03X}" for one in ids[:MOST_SHOWN])
            text = f"ids that are of no device in the robot file are heard: {shown}"
            text += ", …" * (len(ids) > MOST_SHOWN)
            text += f"; that looks like {', '.join(likely)}" if likely else ""
            alone = "nobody here commands what sends them: another host, or a device with another address"
            scan = _scan(self.robot.buses[bus], likely[0].partition(" ")[0] if likely else "")
            yield Finding(False, bus, text, alone, scan)

    def _is_named(self, bus: str, number: int) -> bool:
        """Whether an id is of a device that a scan has found."""
        specs = (spec for one in self.found for spec in self._specs(one, (bus,)))
        return any(number in IdSet(spec.expects) for spec in specs)

    def _can_be(self, found: msg.Found) -> bool:
        """Whether the file could have what a scan has found: its address is one."""
        return any(True for _ in self._specs(found, self.robot.buses))

    def _specs(self, found: msg.Found, buses: Iterable[str]) -> Iterator[Spec]:
        """Yield the spec of a device that was found, as those of its protocol on these buses have theirs."""
        for bus in buses:
            for plugin, devices in self.robot.by_protocol(bus):
                if plugin.name == found.protocol:
                    with suppress(ValueError):  # no device of the file can have this address
                        yield plugin.spec(replace(devices[0], address=found.address))

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
    counted = _counter(robot)
    scans = {one.bus: msg.Scan(one.bus) for one in robot.devices() if msg.Scan in one.spec.requests}
    began, asks = clock.now(), list(ASKED)
    made = Examination(robot, buses, gateway, silence.told, troubles.told, seconds / SECOND)
    made.traffic |= {one.name: Traffic() for one in robot.devices()}

    def poll() -> Sequence[msg.Instruction]:
        if not asks or clock.now() - began < asks[0] * seconds:
            return ()
        asks.pop(0)
        return tuple(scans.values())

    with closing(loop.live(gateway, buses, clock, poll=poll, until=clock.now() + seconds)) as ticks:
        for tick in ticks:
            silence.take(tick)
            troubles.take(tick)
            counted(made, tick)
            made.states |= {bus: state for bus, state in tick.inputs.states if state is not BusState.UP}
            for event in tick.outputs.events:
                if isinstance(event, msg.Found):
                    made.found.append(event)
                elif isinstance(event, msg.Feedback):
                    if event.position is not None or event.velocity is not None:
                        made.reports[event.motor] = made.reports.get(event.motor, 0) + 1
                    if event.voltage is not None:
                        made.voltages[event.motor] = event.voltage
            for note in tick.outputs.notes:
                if note.source in robot.motors and note.text.startswith("another host commands it"):
                    made.hosts[note.source] = note.text
    return made


def _counter(robot: Robot) -> Callable[[Examination, Tick], None]:
    """Return what counts the traffic of each device, and keeps the ids that are of none."""
    known = {
        bus: IdSet(
            ids for one in robot.devices_on(bus) for ids in (*one.spec.expects, *one.spec.receives_also)
        )
        for bus in robot.buses
    }
    own = {
        bus: [(one.name, IdSet(one.spec.sends), IdSet(one.spec.expects)) for one in robot.devices_on(bus)]
        for bus in robot.buses
    }
    sends = {
        bus: IdSet(ids for one in robot.devices_on(bus) for ids in one.spec.sends) for bus in robot.buses
    }

    def count(made: Examination, tick: Tick) -> None:
        for packet, sent in (
            *((one, False) for one in tick.inputs.packets),
            *((one, True) for one in tick.outputs.packets),
        ):
            if not isinstance(packet.frame, CanFrame):
                continue
            number = id_number(packet.frame)
            for name, to, of in own[packet.bus]:
                one = made.traffic[name]
                one.sent += sent and number in to
                one.heard += not sent and number in of
            if not sent and number not in known[packet.bus] and number not in sends[packet.bus]:
                strange = made.strange.setdefault(packet.bus, {})
                if number in strange or len(strange) < MOST_STRANGERS:
                    kept = strange.setdefault(number, [])
                    kept += [packet] * (len(kept) < MOST_OF_EACH)
        for event in tick.outputs.events:
            if isinstance(event, msg.Feedback | msg.Measurement):
                name = event.motor if isinstance(event, msg.Feedback) else event.sensor
                if name in made.traffic:
                    made.traffic[name].reported += 1

    return count


def of_opening(bus: str, error: BusError) -> Finding:
    """Return why a bus could not be opened, and what to do, as a finding."""
    seen, _, todo = str(error).partition("\n")
    steps = "; ".join(map(str.strip, todo.splitlines())).replace(":; ", ": ")
    return Finding(True, bus, seen, "nothing on it can be heard", steps or "gateway scan")


def of_trouble(about: str, one: Trouble) -> Finding:
    """Return what a bus or this machine says of itself as a finding."""
    return Finding(one.grave, about, one.seen, one.matters, one.todo)


def of_machine(robot: Robot, usb: Path = USB, proc: Path = Path("/proc")) -> list[Finding]:
    """Return what this machine lacks for a robot whose buses are real: drivers of adapters, priority."""
    if all(bus.interface == TWIN for bus in robot.buses.values()):
        return []
    found = [of_trouble("adapter", one) for one in of_usb(usb)]
    if seen := unallowed(proc):
        late = "on a busy machine a step comes late, and commands and measurements are old"
        todo = (
            f"add '@realtime - rtprio {DEFAULT}' to /etc/security/limits.conf for your group, log in again, "
            f"then: gateway run {robot.name} --realtime"
        )
        found.append(Finding(False, "machine", seen, late, todo))
    return found


def exhausted(steps: Generator[None, None, list[str]]) -> list[str]:
    """Return what a search returns at its end."""
    while True:
        try:
            next(steps)
        except StopIteration as done:
            found: list[str] = done.value
            return found


def _scan(settings: BusSettings, protocol: str) -> str:
    """Return the command that looks for devices on a bus: of a protocol, "" of all."""
    rate = f" --baudrate {settings.baudrate}" if settings.baudrate else ""
    return f"gateway scan {settings.interface}{f' --protocol {protocol}' * bool(protocol)}{rate}"


def _look_at(settings: BusSettings) -> str:
    kind, _, channel = settings.interface.partition(":")
    return (
        f"ip -details -statistics link show {channel}"
        if kind == "socketcan"
        else f"gateway watch {settings.interface}"
    )
