"""The world as a bus: twins of all devices whose bus has the interface "twin", on shafts of one world.

Rules. Time is virtual: reading a bus brings world, twins and wires to `now`, in the world's steps. In each,
first what has arrived is heard; then every device runs, in the order of the robot file, with what its
encoder or sensor shows; then the world moves under the torques. Frames take their time on the wire,
contend by priority, and are stamped when they end. A packet holds nothing but what a twin has put on the
wire, and a twin is shown nothing but its own shaft or readings: the true pose does not come this way.
Faults that a test or a campaign wants (mute, restarted and doubled devices, a lost interface) are
methods of TwinWorld; nothing else makes them happen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gateway.buses import Bus
from gateway.buses.virtual.line import Line, Sent
from gateway.core.robot import TWIN, BusSettings, Motor, Robot, Sensor
from gateway.sim.files import STEP, BenchFile, ShaftFile
from gateway.sim.load import load_world
from gateway.sim.shafts import Shaft
from gateway.sim.world import World
from protocols.frames import BusState, Frame, Packet
from protocols.messages import Event, Feedback, Nanos
from protocols.plugin import Twin

HOST = ""
"""The sender's name of our own end; devices have their names in the robot file."""


def open_world(robot: Robot, seed: int) -> TwinWorld:
    """The robot's world with its twins; bare shafts on a bench where the robot file names no world.

    Raises WorldError with every mistake at once."""
    file = BenchFile() if robot.world is None else load_world(robot.world)
    return TwinWorld(robot, World(file, robot, seed), seed)


@dataclass(slots=True)
class Node:
    """One twin on its bus."""

    name: str
    """Unique on the bus: the device's name, or that of its double."""
    part: Motor | Sensor
    twin: Twin
    seed: int
    spare: Shaft | None = None
    """The shaft of a double, which is not part of the world."""
    mute: bool = False
    """It neither hears nor is heard: its plug is out."""
    received: bool = False
    """Something came in since it last ran."""
    readings: list[Event] = field(default_factory=list)
    """What the world shows, and the twin has not yet taken."""


class TwinBus:
    """One bus of the robot, seen from the host. The world owns the time."""

    def __init__(self, settings: BusSettings, world: TwinWorld) -> None:
        self.name = settings.name
        self.nodes: list[Node] = []
        rate = settings.baudrate if settings.kind == "serial" else settings.bitrate
        self._out = Line(rate, settings.data_bitrate)
        # Both directions of a serial line go at once; a CAN bus is one wire for all.
        self._in = Line(rate) if settings.kind == "serial" else self._out
        self._world = world
        self._states: list[BusState] = []
        self._packets: list[Packet] = []
        self._full = self._gone = False

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """What came in up to `now`: advances the world and all its twins."""
        self._world.advance(now)
        states, self._states = self._states, []
        packets, self._packets = self._packets, []
        return states, packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Queue wires; they go out from `now` on, as the bus falls free."""
        self._world.advance(now)
        if self._gone:
            return
        for frame in frames:
            if not self._out.send(now, HOST, frame) and not self._full:
                self._full = True
                self._states.append(BusState.FULL)

    def close(self) -> None:
        """Give the wire back: what waits is not sent."""
        self._gone = True
        self._out.clear()

    def carry(self, until: Nanos) -> None:
        """Let arrive what has arrived up to a time."""
        if self._out.pending:
            for sent in self._out.run(until):
                self._arrive(sent)
        if self._in.pending and self._in is not self._out:
            for sent in self._in.run(until):
                self._arrive(sent)
        if self._full and not self._out.waiting(HOST):
            self._full = False
            self._states.append(BusState.UP)

    def _arrive(self, sent: Sent) -> None:
        if sent.sender != HOST and not self._gone:
            self._packets.append(Packet(sent.t, self.name, sent.frame))
        if sent.sender != HOST and self._in is not self._out:
            return
        for node in self.nodes:
            if node.name != sent.sender and not node.mute:
                node.twin.receive(sent.t, sent.frame)
                node.received = True

    def say(self, now: Nanos, node: Node, frames: Sequence[Frame]) -> None:
        """A device puts wires on the bus."""
        if not node.mute:
            for frame in frames:
                self._in.send(now, node.name, frame)

    def lose(self) -> None:
        """The host's interface vanishes: nothing goes out or comes in."""
        self._gone = True
        self._out.clear()
        self._packets.clear()
        self._states.append(BusState.GONE)

    def restore(self) -> None:
        """The host's interface is back."""
        self._gone = self._full = False
        self._states.append(BusState.BACK)


class TwinWorld:
    """The twins of every bus whose interface is "twin", and the world they are in.

    `world` None: bare shafts on a bench (WorldError if the robot has sensors)."""

    def __init__(self, robot: Robot, world: World | None, seed: int) -> None:
        self.world = world or World(BenchFile(), robot, seed)
        self._buses = {
            name: TwinBus(settings, self)
            for name, settings in robot.buses.items()
            if settings.interface == TWIN
        }
        self.buses: dict[str, Bus] = dict(self._buses.items())
        self._seed = seed
        self._began = False
        self._count = 2.0 * math.pi / self.world.counts_per_turn
        self._motors: list[tuple[Node, TwinBus, float]] = []
        self._sensors: list[tuple[Node, TwinBus]] = []
        parts: list[Motor | Sensor] = [*robot.motors.values(), *robot.sensors.values()]
        for part in parts:
            if bus := self._buses.get(part.bus):
                self._add(part.name, part, bus)

    def _add(self, name: str, part: Motor | Sensor, bus: TwinBus) -> Node:
        """A device joins its bus, powered up, with a seed of its own."""
        seed = int(np.random.SeedSequence([self._seed, *name.encode()]).generate_state(1)[0])
        node = Node(name, part, part.plugin.twin(part.device, seed), seed)
        if isinstance(part, Motor):
            self._motors.append((node, bus, part.joint.gear * part.joint.sign))
        else:
            self._sensors.append((node, bus))
        bus.nodes.append(node)
        return node

    # -- time ------------------------------------------------------------------------------------------

    def advance(self, now: Nanos) -> None:
        """Bring world, twins and wires to `now`. The first call says when the world begins."""
        if not self._began:
            self._began, self.world.now = True, now
        while self.world.now + STEP <= now:
            self._step(self.world.now)
        for bus in self._buses.values():
            bus.carry(now)

    def _step(self, t: Nanos) -> None:
        """One step of the world, which stands at t."""
        for bus in self._buses.values():
            bus.carry(t)
        torques: dict[str, float] = {}
        for node, bus, ratio in self._motors:
            torque = self._run_motor(t, node, bus, ratio)
            if node.spare is None:
                torques[node.name] = torque
            else:
                node.spare.step(torque)
        for node, bus in self._sensors:
            self._run_sensor(t, node, bus)
        self.world.step(torques)
        for reading in self.world.readings():
            for node, _ in self._sensors:
                if node.part.name == reading.sensor:
                    node.readings.append(reading)

    def _run_motor(self, t: Nanos, node: Node, bus: TwinBus, ratio: float) -> float:
        """Let a motor's firmware run; the torque [N·m] at the joint's output shaft.

        Position and velocity go through the gear to the device's shaft, where the encoder's disc sits: the
        position is a whole number of its counts."""
        shaft = node.spare
        position, velocity = (shaft.position, shaft.velocity) if shaft else self.world.shaft(node.part.name)
        counted = math.floor(position * ratio / self._count) * self._count
        truth = Feedback(node.part.name, t, counted, velocity * ratio)
        torques, frames = node.twin.step(t, (truth,))
        if frames:
            bus.say(t, node, frames)
        return sum(torque.torque for torque in torques if torque.motor == node.part.name) * ratio

    def _run_sensor(self, t: Nanos, node: Node, bus: TwinBus) -> None:
        """Let a sensor's firmware run, if there is anything for it to do."""
        if not (node.readings or node.received):
            due = node.twin.due()
            if due is None or due > t:
                return
        shown, node.readings, node.received = node.readings, [], False
        _, frames = node.twin.step(t, shown)
        bus.say(t, node, frames)

    # -- faults ----------------------------------------------------------------------------------------

    def _nodes(self, name: str) -> list[tuple[Node, TwinBus]]:
        """A device and its doubles. Raises KeyError if no bus of twins has it."""
        found = [(node, bus) for bus in self._buses.values() for node in bus.nodes if node.part.name == name]
        if not found:
            raise KeyError(f"no twin {name!r}")
        return found

    def silence(self, name: str) -> None:
        """Pull the plug of a device (and its doubles): it runs on, and neither hears nor is heard."""
        for node, _ in self._nodes(name):
            node.mute = True

    def unsilence(self, name: str) -> None:
        """Put the plug of a device back in."""
        for node, _ in self._nodes(name):
            node.mute = False

    def reset(self, name: str) -> None:
        """Take a device's power away and give it back: its firmware starts anew, its shaft stays."""
        node, _ = self._nodes(name)[0]
        node.twin = node.part.plugin.twin(node.part.device, node.seed)

    def duplicate(self, name: str) -> None:
        """Put a second device with the same settings and address on the bus; it turns a shaft of its own."""
        nodes = self._nodes(name)
        (first, bus), copies = nodes[0], len(nodes)
        node = self._add(f"{name}#{copies + 1}", first.part, bus)
        node.spare = Shaft(ShaftFile())

    def lose(self, bus: str) -> None:
        """The host's interface to a bus vanishes: the bus tells GONE, devices are on their own."""
        self._buses[bus].lose()

    def restore(self, bus: str) -> None:
        """The host's interface to a bus comes back: the bus tells BACK."""
        self._buses[bus].restore()
