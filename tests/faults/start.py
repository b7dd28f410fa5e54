"""Robots under way in their worlds, to be copied; and the judge's look at what they write to their buses.

Rules. Set-points are read with decoders of the judge's own; limits are the robot file's, whatever is set.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from brain.bodies.body import Base
from gateway import config
from gateway.buses.virtual.bus import TwinBus, TwinWorld, open_world
from gateway.core.clock import SimulatedClock
from gateway.core.guard import decoder_of
from gateway.core.robot import Robot
from gateway.core.step import Gateway
from gateway.core.tick import Inputs, Outputs
from gateway.runtime.loop import moments, read, write
from gateway.runtime.timing import LoopStats
from protocols import messages as msg
from protocols.conformance.random import Random
from protocols.frames import BusState, Frame, Packet
from protocols.messages import SECOND, Instruction, Mode, Nanos

STANDING, STOPPED, TURNING, TOUR = PHASES = ("standing", "stopped", "turning", "tour")


@dataclass
class WatchedBus:
    """A bus of the world, and the judge's decoder of what the gateway writes to it."""

    bus: TwinBus
    robot: Robot
    gateway: Gateway
    tap: list[Packet] | None = None
    """Where everything received is put, for another host on the bus."""
    sent: list[tuple[Nanos, Frame]] | None = None
    """Where everything sent is put, with its time, for another host that replays it."""
    setpoints: dict[str, msg.Command] = field(default_factory=dict)
    """What the device last obeys of it, by motor,"""
    driven_at: dict[str, Nanos] = field(default_factory=dict)
    """and when it was last to give torque while nothing was stopped."""
    unsafe: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.name = self.bus.name
        self.decoder = decoder_of(self.robot, self.name)

    def read(self, now: Nanos) -> tuple[Sequence[BusState], Sequence[Packet]]:
        """Pass on what the world has."""
        states, packets = self.bus.read(now)
        if self.tap is not None:
            self.tap.extend(packets)
        return states, packets

    def write(self, now: Nanos, frames: Sequence[Frame]) -> None:
        """Judge what the devices would obey, and pass it on."""
        if self.sent is not None:
            self.sent += [(now, frame) for frame in frames]
        for frame in frames:
            for message in self.decoder.decode(now, frame):
                if isinstance(message, msg.Command | msg.Arm):
                    self._judge(now, message)
        self.bus.write(now, frames)

    def close(self) -> None:
        """Close the bus."""
        self.bus.close()

    def _judge(self, now: Nanos, message: msg.Command | msg.Arm) -> None:
        joint, motor = self.gateway.joints[message.motor], self.robot.motors[message.motor]
        halted = bool(self.gateway.why_stopped() or joint.faults)
        if isinstance(message, msg.Arm):
            if halted and joint.mode is not Mode.ARMED and motor.joint.stop_action != "hold":
                self.unsafe.append(f"{message.motor} is armed against a stop")
            return
        self.setpoints[message.motor] = message
        if not halted and not isinstance(message, msg.Idle):
            self.driven_at[message.motor] = now
        limits, gear = motor.joint.limits, motor.joint.gear
        for name, limit in (("velocity", limits.velocity * gear), ("torque", limits.torque / gear)):
            value = getattr(message, name, 0.0)
            known = motor.spec.ranges.get(f"{type(message).__name__}.{name}")
            fuzz = limit * 1e-3 + (known.resolution if known else 0.0)
            if not (math.isfinite(value) and abs(value) <= limit + fuzz):
                self.unsafe.append(f"{message.motor}: {name} {value:g}, limit {limit:g}")
        if not math.isfinite(getattr(message, "position", 0.0)):
            self.unsafe.append(f"{message.motor}: position {message}")

    def wanted(self, motor: str) -> float:
        """Return the velocity at the output shaft that a motor is to have, NaN if it is to have none."""
        setpoint = self.setpoints.get(motor)
        if setpoint is None or isinstance(setpoint, msg.Idle | msg.Torque):
            return math.nan
        joint = self.robot.motors[motor].joint
        return float(getattr(setpoint, "velocity", 0.0)) / (joint.gear * joint.sign)


@dataclass
class UnderWay:
    """A robot under way, in its world: plain state that can be copied."""

    robot: Robot
    clock: SimulatedClock
    world: TwinWorld
    gateway: Gateway
    buses: dict[str, WatchedBus]

    @classmethod
    def switched_on(cls, name: str, seed: int) -> UnderWay:
        """Open a robot with its world, and wait until everything has reported."""
        robot = config.load_robot(name)
        world, gateway = open_world(robot, seed), Gateway(robot)
        buses = {name: WatchedBus(bus, robot, gateway) for name, bus in world.buses.items()}
        made = cls(robot, SimulatedClock(), world, gateway, buses)
        made.run(1.5)
        return made

    def copied(self) -> UnderWay:
        """Return a copy, which shares what is never changed."""
        file = self.world.world.file
        return copy.deepcopy(self, {id(self.robot): self.robot, id(file): file})

    def run(self, seconds: float, *instructions: Instruction) -> None:
        """Go on for some seconds, beginning with the instructions."""
        until = self.clock.now() + round(seconds * SECOND)
        for now in self.moments():
            if now >= until:
                break
            self.step(now, instructions)
            instructions = ()

    def moments(self, stats: LoopStats | None = None) -> Iterator[Nanos]:
        """Yield the moments to step at, from now on."""
        return moments(self.clock, self.robot.period, self.gateway.due, stats or LoopStats())

    def step(self, now: Nanos, instructions: Sequence[Instruction], took: Nanos = 0) -> Outputs:
        """Do one step as the live loop does, which takes some time."""
        states, packets = read(self.buses, now)
        outputs = self.gateway.step(now, Inputs(tuple(states), tuple(packets), tuple(instructions)))
        self.clock.wait(now + took)
        write(self.buses, now + took, outputs.packets)
        return outputs

    def wheels(self) -> tuple[str, ...]:
        """Return the names of a base's wheels; () of none."""
        body = self.robot.brain.body
        return body.joints if isinstance(body, Base) else ()


class Warm:
    """Robots under way, at up to `way` places a second apart: driven there once, and copied for every run."""

    def __init__(self, seed: int, way: int = 10) -> None:
        self.seed, self.way = seed, way
        self._places: dict[str, list[UnderWay]] = {}

    def start(self, name: str, phase: str, random: Random) -> UnderWay:
        """Return a robot in this phase, somewhere on its way."""
        places = self._places.setdefault(name, [])
        if not places:
            places.append(UnderWay.switched_on(name, self.seed))
        if phase in (STANDING, TURNING):
            return places[0].copied()
        index = 1 + random.below(self.way)
        while len(places) <= index:
            further = places[-1].copied()
            further.run(1.0, *(tour(further) if len(places) == 1 else ()))
            places.append(further)
        return places[index].copied()


def tour(start: UnderWay) -> list[Instruction]:
    """Return what sets a robot going: a base's goals, the others' targets."""
    if start.wheels():
        return [msg.Goal(*each) for each in start.world.world.tour]
    return [msg.Velocity(name, 3.0 + index) for index, name in enumerate(start.robot.motors)]
