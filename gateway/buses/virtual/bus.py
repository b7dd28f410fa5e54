"""The simulated world as buses: the twins of all devices whose bus has the interface "twin", in one world.

Rules. Time is virtual: reading a bus advances world, twins and media to `now`, in the world's steps. In each,
first what has arrived is delivered; then every device runs, in the order of the robot file, with what its
encoder or sensor measures; then the world moves under the torques. Frames take their time on the medium,
contend by priority, and are timestamped when they end. What the host's transmit queue of a CAN bus has no
room for waits as on a real one, and is handed over at the next read or write. A packet holds nothing but what
a twin has sent, and a twin is given nothing but its own shaft or readings: the true pose does not come this
way. The shafts of motors that are not simulated turn as they are measured. Faults that a test or a campaign
wants (disconnected, power-cycled and duplicate devices, another host, a lost interface) are methods of
TwinWorld and TwinBus, false measurements, torques and transmissions the functions of `tamper`; nothing else
makes them happen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush

import numpy as np

from gateway.buses.queues import FrameQueue, Patience
from gateway.buses.states import StateTracker
from gateway.buses.virtual.follow import Followed
from gateway.buses.virtual.halfduplex import HalfDuplex
from gateway.buses.virtual.medium import BUS_OFF, ERROR_PASSIVE, Medium, Transmission
from gateway.buses.virtual.tamper import Tamper
from gateway.core.robot import TWIN, BusSettings, Motor, Robot, Sensor
from gateway.sim.files import STEP, BenchFile, SceneFile, ShaftFile, WorldFile
from gateway.sim.load import load_plant, load_world
from gateway.sim.shafts import Shaft
from gateway.sim.world import World
from protocols.frames import BusState, CanFrame, Frame, Packet
from protocols.messages import Event, Feedback, Nanos
from protocols.plugin import Twin, join

NEVER: Nanos = 1 << 62
HOST = ""
"""The host's name as a sender; devices have their names in the robot file."""


def open_world(robot: Robot, seed: int, file: WorldFile | None = None) -> TwinWorld:
    """Open the robot's world, or this one, with its twins; bare shafts on a bench where there is none.

    Raises WorldError with every mistake at once."""
    file = file or (BenchFile() if robot.world is None else load_world(robot.world))
    plant = load_plant(robot.plant) if robot.plant and isinstance(file, SceneFile) else None
    return TwinWorld(robot, World(file, plant, robot, seed), seed)


@dataclass(slots=True)
class SimulatedDevice:
    """One twin on its bus."""

    name: str
    """Unique on the bus: the device's name, or that of its duplicate."""
    settings: Motor | Sensor
    bus: TwinBus
    twin: Twin
    seed: int
    own_shaft: Shaft | None = None
    """The shaft of a duplicate, which is not part of the world."""
    disconnected: bool = False
    """Its bus connector is unplugged: it neither receives nor sends."""
    answers: Nanos = NEVER
    """When it answers what it has heard, if that is before the world's next step."""
    received: bool = False
    """Something came in since it last ran."""
    readings: list[Event] = field(default_factory=list)
    """Measurements of the world that the twin has not yet taken."""

    def look(self, t: Nanos) -> None:
        """Look when it answers."""
        due = self.twin.due()
        self.answers = NEVER if due is None else max(due, t)

    def send(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Queue frames on the bus."""
        if not self.disconnected:
            for frame in frames:
                self.bus.from_devices.send(now, self.name, frame)


class TwinBus:
    """One bus of the robot, seen from the host. The world owns the time."""

    def __init__(self, settings: BusSettings, world: TwinWorld) -> None:
        self.name = settings.name
        self.devices: list[SimulatedDevice] = []
        self.is_serial = serial = settings.carries_bytes
        self._from_host = Medium(settings.baudrate if serial else settings.bitrate, settings.data_bitrate)
        # Both directions of a serial line work at once; a CAN bus is one medium for all.
        self.from_devices = Medium(settings.baudrate) if serial else self._from_host
        self.prompt = serial and settings.line != "free"
        """Whether devices answer between the world's steps."""
        self.echoes = False
        """Whether the host receives what it sends, too, as it was on the wire."""
        self._one_wire = serial and settings.line == "half-duplex"
        if self._one_wire:
            self._from_host = self.from_devices = HalfDuplex(settings.baudrate)
        one, other = self._from_host, self.from_devices
        self._wires: Sequence[Medium] = (one,) if one is other else (one, other)
        self._world = world
        self._room = settings.transmit_queue
        self._queue = FrameQueue(settings.devices)
        self._patience = Patience()
        self._stuck = False
        self._states = StateTracker()
        self._packets: list[Packet] = []
        self._late: list[tuple[Nanos, int, Transmission]] = []
        """What `Tamper.transmission` lets arrive, by time; with a number, since frames have no order."""
        self._delayed = 0
        self.full = False
        """Whether frames of the host were dropped at its last write."""
        self._gone = False
        self._from_host.destroyed = self._destroyed

    @property
    def busy(self) -> Nanos:
        """Time during which the wire was not idle; of a serial line, its busier direction."""
        return max(self._from_host.busy, self.from_devices.busy)

    @property
    def overlaps(self) -> int:
        """How often two have sent at once on a line that is one wire."""
        return len(self.from_devices.collisions) if isinstance(self.from_devices, HalfDuplex) else 0

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Advance the world and all its twins to `now`; return what the host received."""
        self._world.advance(now)
        self._flush(now)
        packets, self._packets = self._packets, []
        if (stamp := self._world.tamper.stamp) is not None:
            packets = [replace(packet, t=stamp(packet.t)) for packet in packets]
        return self._states.take(now), packets

    def wakes(self, now: Nanos) -> tuple[Sequence[int], Nanos | None]:
        """Return no file, and when something may next arrive, or a device may begin to send."""
        times = [self._world.world.now + STEP, *(end for wire in self._wires if (end := wire.first_end()))]
        times += [self._late[0][0]] if self._late else []
        return (), max(now + 1, min(times + [device.answers for device in self.devices]))

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Queue frames; they are sent from `now` on, as the bus becomes idle."""
        self._world.advance(now)
        if self._gone:
            return
        if self.is_serial:
            taken = [self._from_host.send(now, HOST, frame) for frame in frames]
            self.full = not all(taken)
            if self.full:
                self._states.full(now)
            return
        self._flush(now)
        dropped = self._queue.dropped
        self._queue.give(frames, lambda frame: self._send(now, frame), wait=self._stuck)
        self.full = self._queue.dropped > dropped

    def close(self) -> None:
        """Release the bus: what waits is not sent."""
        self._gone = True
        self._drop()

    def _flush(self, now: Nanos) -> None:
        """Hand over what waits, unless what was handed over is stuck; on a serial line nothing waits here."""
        if self.is_serial:
            return
        self._stuck = self._patience.is_over(now, holds=self._from_host.waiting(HOST) > 0)
        if not self._stuck:
            self._queue.drain(lambda frame: self._send(now, frame))
        if self._stuck or self._queue:
            self._states.full(now)

    def _send(self, now: Nanos, frame: CanFrame) -> bool:
        """Hand a frame over; False if there is no room for it."""
        if self._from_host.waiting(HOST) >= self._room:
            self._states.full(now)
            return False
        self._from_host.send(now, HOST, frame)
        return True

    def _drop(self) -> None:
        """Drop what has not been sent."""
        self._from_host.drop(HOST)
        self._queue.clear()

    def deliver(self, until: Nanos) -> None:
        """Deliver what arrives up to a time."""
        if self.prompt:
            self._deliver_promptly(until)
            return
        for wire in self._wires:
            if wire.pending and until >= wire.nothing_before:
                for transmission in wire.run(until):
                    self._arrive(transmission)
        while self._late and self._late[0][0] <= until:
            self._deliver(heappop(self._late)[2])
        if self._from_host.errors:
            self._count_errors()

    def start(self, now: Nanos, truth: Mapping[str, Event]) -> None:
        """Switch the devices on, where they may be asked before the world's first step. `truth`: where the
        shafts of motors are."""
        for device in self.devices if self.prompt else ():
            seen = truth.get(device.name)
            device.send(now, device.twin.step(now, () if seen is None else (seen,))[1])

    def _deliver_promptly(self, until: Nanos) -> None:
        """The same where devices answer as soon as they have heard: what ends first, and what is due
        before."""
        wires = self._wires
        while True:
            first, ending = until, None
            for wire in wires:
                end = wire.first_end() if wire.pending else None
                if end is not None and (end < first or (ending is None and end == first)):
                    first, ending = end, wire
            late = bool(self._late) and self._late[0][0] <= first
            if late:
                first = self._late[0][0]
            if self._answer(first):
                continue
            if late:
                self._deliver(heappop(self._late)[2])
            elif ending is not None:
                for transmission in ending.run(first):
                    self._arrive(transmission)
            else:
                return

    def _answer(self, until: Nanos) -> bool:
        """Let the device whose answer is due first begin to send it; False if none is due."""
        at = min([device.answers for device in self.devices], default=NEVER)
        if at > until:
            return False
        device = next(device for device in self.devices if device.answers == at)
        device.answers = NEVER
        _, frames = device.twin.step(at, ())
        device.send(at, frames)
        return True

    def _destroyed(self, one: Transmission) -> int:
        return 0 if (error := self._world.tamper.error) is None else error(self.name, one)

    def _count_errors(self) -> None:
        """Report what the host's controller does: error-passive, bus-off, or up again."""
        count = self._from_host.errors.get(HOST, 0)
        level = (
            BusState.OFF if count >= BUS_OFF else BusState.PASSIVE if count >= ERROR_PASSIVE else BusState.UP
        )
        if not self._gone:
            self._states.set(level)
            if level is BusState.OFF:
                self._gone = True
                self._queue.clear()

    def _arrive(self, transmission: Transmission) -> None:
        tamper = self._world.tamper.transmission
        if tamper is None:
            self._deliver(transmission)
            return
        for instead in tamper(self.name, transmission):
            self._delayed += 1
            heappush(self._late, (instead.t, self._delayed, instead))

    def _deliver(self, transmission: Transmission) -> None:
        if transmission.sender != HOST:
            if not self._gone:
                self._packets.append(Packet(transmission.t, self.name, transmission.frame))
            if self.from_devices is not self._from_host:
                return  # devices on a serial line with two wires do not receive one another
        elif self.echoes and not self._gone:
            self._packets.append(Packet(transmission.t, self.name, transmission.frame))
        for device in self.devices:
            if device.name != transmission.sender and not device.disconnected:
                device.twin.receive(transmission.t, transmission.frame)
                device.received = True
                if self.prompt:
                    device.look(transmission.t)

    def intrude(self, t: Nanos, sender: str, frames: Sequence[Frame]) -> None:
        """Queue frames of another sender: a second host, foreign traffic."""
        for frame in frames:
            self.from_devices.send(t, sender, frame)

    def lose(self, state: BusState = BusState.GONE) -> None:
        """The host's interface vanishes or, with OFF, goes bus-off: nothing is sent or received."""
        self._gone = True
        self._drop()
        self._packets.clear()
        self._states.set(state)

    def restore(self) -> None:
        """The host's interface is back."""
        self._drop()
        self._gone = False
        self._states.set(BusState.BACK)


class TwinWorld:
    """The twins of every bus whose interface is "twin", and the world they are in."""

    def __init__(self, robot: Robot, world: World, seed: int) -> None:
        self.world = world
        self.buses = {
            name: TwinBus(settings, self)
            for name, settings in robot.buses.items()
            if settings.interface == TWIN
        }
        self.tamper = Tamper()
        self._seed = seed
        self._began = False
        self._count = 2.0 * math.pi / self.world.counts_per_turn
        """rad, one count of an encoder"""
        self._motors: list[tuple[SimulatedDevice, float]] = []
        """With the gear ratio, negative where the motor is mounted the other way round."""
        self._sensors: list[SimulatedDevice] = []
        for settings in robot.devices():
            if bus := self.buses.get(settings.bus):
                self._add(settings.name, settings, bus)
        self.followed = {
            name: Followed(motor, world)
            for name, motor in robot.motors.items()
            if motor.bus not in self.buses
        }
        """The real motors, whose shafts in the world turn as they are measured"""

    def _add(self, name: str, settings: Motor | Sensor, bus: TwinBus) -> SimulatedDevice:
        """Add a device to its bus, powered up, with a seed of its own."""
        seed = int(np.random.SeedSequence([self._seed, *name.encode()]).generate_state(1)[0])
        device = SimulatedDevice(name, settings, bus, settings.plugin.twin(settings.device, seed), seed)
        if isinstance(settings, Motor):
            self._motors.append((device, settings.joint.gear * settings.joint.sign))
        else:
            self._sensors.append(device)
        bus.devices.append(device)
        join([each.twin for each in bus.devices])
        return device

    # -- time ------------------------------------------------------------------------------------------

    def advance(self, now: Nanos) -> None:
        """Advance world, twins and media to `now`. The first call sets when the world begins."""
        if not self._began:
            self._began, self.world.now = True, now
            truth = {device.name: self._measured(now, device, ratio) for device, ratio in self._motors}
            for bus in self.buses.values():
                bus.start(now, truth)
        while self.world.now + STEP <= now:
            self._step(self.world.now)
        for bus in self.buses.values():
            bus.deliver(now)

    def _step(self, t: Nanos) -> None:
        """Run one step of the world, which is at time t."""
        for followed in self.followed.values():
            followed.look()
        for bus in self.buses.values():
            bus.deliver(t)
        torques: dict[str, float] = {}
        for device, ratio in self._motors:
            torque = self._run_motor(t, device, ratio)
            if device.own_shaft is None:
                torques[device.name] = torque
            else:
                device.own_shaft.step(torque)
        for device in self._sensors:
            _run_sensor(t, device)
        tamper = self.tamper
        self.world.step(torques if tamper.torques is None else tamper.torques(torques))
        for true in self.world.readings():
            reading = true if tamper.reading is None else tamper.reading(true)
            if reading is None:
                continue
            for device in self._sensors:
                if device.settings.name == reading.sensor:
                    device.readings.append(reading)

    def _measured(self, t: Nanos, device: SimulatedDevice, ratio: float) -> Feedback:
        """Return what a device's encoder sees of its shaft.

        Position and velocity go through the gear to the device's shaft, where the encoder's disc sits: the
        position is a whole number of its counts."""
        motor, shaft = device.settings.name, device.own_shaft
        position, velocity = (shaft.position, shaft.velocity) if shaft else self.world.shaft(motor)
        counted = math.floor(position * ratio / self._count) * self._count
        measured = Feedback(motor, t, counted, velocity * ratio)
        return measured if self.tamper.measured is None else self.tamper.measured(motor, measured)

    def _run_motor(self, t: Nanos, device: SimulatedDevice, ratio: float) -> float:
        """Run a motor's firmware; return the torque [N·m] at the joint's output shaft."""
        motor = device.settings.name
        torques, frames = device.twin.step(t, (self._measured(t, device, ratio),))
        if frames:
            device.send(t, frames)
        if device.answers < NEVER:
            device.look(t)
        return sum([torque.torque for torque in torques if torque.motor == motor]) * ratio

    def follow(self, feedback: Feedback, age: Nanos) -> None:
        """Let the shaft of a real motor turn in the world as it was measured so long ago, at its output
        shaft."""
        self.followed[feedback.motor].measure(feedback, age)

    # -- faults ----------------------------------------------------------------------------------------

    def _devices(self, name: str) -> list[SimulatedDevice]:
        """Return a device and its duplicates. Raises KeyError if no simulated bus has it."""
        found = [
            device for bus in self.buses.values() for device in bus.devices if device.settings.name == name
        ]
        if not found:
            raise KeyError(f"no twin {name!r}")
        return found

    def simulates(self, name: str) -> bool:
        """Return whether a device is simulated here."""
        return any(device.settings.name == name for bus in self.buses.values() for device in bus.devices)

    def twin(self, name: str) -> Twin:
        """Return a device's firmware, of which a fault may be provoked."""
        return self._devices(name)[0].twin

    def disconnect(self, name: str) -> None:
        """Unplug a device (and its duplicates) from the bus: it runs on, and neither receives nor sends."""
        for device in self._devices(name):
            device.disconnected = True

    def reconnect(self, name: str) -> None:
        """Plug a device in again."""
        for device in self._devices(name):
            device.disconnected = False

    def reset(self, name: str) -> None:
        """Power-cycle a device: its firmware starts anew, its shaft stays where it is."""
        device = self._devices(name)[0]
        device.twin = device.settings.plugin.twin(device.settings.device, device.seed)
        join([each.twin for each in device.bus.devices])

    def duplicate(self, name: str) -> None:
        """Add a second device with the same settings and address; it turns a shaft of its own."""
        devices = self._devices(name)
        copy = self._add(f"{name}#{len(devices) + 1}", devices[0].settings, devices[0].bus)
        copy.own_shaft = Shaft(ShaftFile())


def _run_sensor(t: Nanos, device: SimulatedDevice) -> None:
    """Run a sensor's firmware, if there is anything for it to do. It measures on, and reports when the line
    is idle: what it sends has its age then."""
    waits = device.bus.from_devices.pending and device.bus.is_serial
    if not ((device.readings and not waits) or device.received):
        due = device.twin.due()
        if due is None or due > t:
            return
    readings, device.readings = ([], device.readings) if waits else (device.readings, [])
    device.received = False
    _, frames = device.twin.step(t, readings)
    device.send(t, frames)
