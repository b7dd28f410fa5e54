"""The world behind the twins: what shafts do under torques, what sensors see, and the truth for judges.

Rules. Virtual time only: one `step` is one time step of 1 ms. Same file, robot, seed and torques: same
world, bit for bit, on one version of MuJoCo and one processor. Nothing here knows a protocol or a gear:
all is at the joints' output shafts. `truth` and `contacts` are for judges and pictures, never an input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, TypeAlias

from brain.belief import Pose
from brain.perception.mount import Mount
from gateway.config.errors import unknown
from gateway.sim.files import STEP, BenchFile, SceneFile, WorldFile
from gateway.sim.load import WorldError, complaint, known_worlds, load_world, loads_world
from gateway.sim.mjcf import Polygon, outlines
from gateway.sim.rover import Rover
from gateway.sim.sensors import ImuSensor, LidarSensor
from gateway.sim.shafts import Bench
from protocols.messages import Imu, LaserScan, Nanos

if TYPE_CHECKING:
    from gateway.core.robot import Robot

__all__ = [
    "STEP",
    "BenchFile",
    "Plant",
    "SceneFile",
    "World",
    "WorldError",
    "WorldFile",
    "known_worlds",
    "load_world",
    "loads_world",
]

Reading: TypeAlias = Imu | LaserScan


class Plant(Protocol):
    """The physics of a world, by the motors' names; steps of 1 ms."""

    @property
    def touches(self) -> int:
        """How often something solid was newly touched."""
        ...

    def step(self, torques: Mapping[str, float]) -> None:
        """One step under torques [N·m] at the output shafts; no torque where none is named."""
        ...

    def shaft(self, motor: str) -> tuple[float, float]:
        """rad, rad/s at the output shaft"""
        ...

    def pose(self) -> Pose:
        """The true pose of the body in the world's frame."""
        ...


class World:
    """A world file with a robot in it, from a seed. Raises WorldError if the one does not fit the other."""

    def __init__(self, file: WorldFile, robot: Robot, seed: int) -> None:
        _check(file, robot)
        self.file = file
        self.now: Nanos = 0
        """The world's time. It may be set before the first step."""
        self._sensors: list[ImuSensor | LidarSensor] = []
        self._readings: list[Reading] = []
        self._steps = 0
        self._rover: Rover | None = None
        self._carried = Bench(file, ())
        """The joints that a base carries."""
        self._plant: Plant
        if isinstance(file, BenchFile):
            self._plant = Bench(file, robot.motors)
            return
        mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
        self._plant = self._rover = Rover(file, {n: m for n, m in mounts.items() if n in file.imus}, seed)
        wheels = (file.body.left.motor, file.body.right.motor)
        self._carried = Bench(file, [name for name in robot.motors if name not in wheels])
        self._sensors = [_sensor(name, file, mount, seed) for name, mount in mounts.items()]

    def step(self, torques: Mapping[str, float]) -> None:
        """One time step under torques [N·m] at the OUTPUT shafts, by motor; none where none is named.

        Raises ValueError for a torque that is not finite."""
        for motor, torque in torques.items():
            if not math.isfinite(torque):
                raise ValueError(f"the torque of {motor!r} is {torque}; expected a finite number")
        self._plant.step(torques)
        self._carried.step(torques)
        if self._rover is not None:
            self._measure(self._rover)
        self.now += STEP
        self._steps += 1

    def _measure(self, rover: Rover) -> None:
        """Sense what was so at the beginning of the step, which is what MuJoCo has computed last."""
        for sensor in self._sensors:
            if self._steps * STEP % sensor.period == 0:
                self._readings.append(sensor.measure(self.now, rover))

    def shaft(self, motor: str) -> tuple[float, float]:
        """rad, rad/s at the output shaft: what the encoder's disc does, turned through the gear."""
        return (self._carried if motor in self._carried else self._plant).shaft(motor)

    def readings(self) -> Sequence[Reading]:
        """New since the last call, in order of time, with the world's noise."""
        if not self._readings:
            return ()
        found, self._readings = self._readings, []
        return found

    @property
    def counts_per_turn(self) -> int:
        """Of the encoders' discs, which sit on the devices' own shafts."""
        return self.file.encoder.counts_per_turn

    def truth(self) -> Pose:
        """The true pose in the world's frame (at the origin, on a bench)."""
        return self._plant.pose()

    def contacts(self) -> int:
        """How often walls and boxes (on a bench: hard stops) were touched so far."""
        return self._plant.touches

    @property
    def tour(self) -> tuple[tuple[float, float], ...]:
        """m, goals for a demo, relative to where the robot starts."""
        return () if isinstance(self.file, BenchFile) else self.file.tour

    def outlines(self) -> list[Polygon]:
        """Walls and boxes seen from above, as polygons [m] in the world's frame."""
        return [] if isinstance(self.file, BenchFile) else outlines(self.file)


def _sensor(name: str, file: SceneFile, mount: Mount, seed: int) -> ImuSensor | LidarSensor:
    if name in file.lidars:
        return LidarSensor(name, file.lidars[name], mount, seed)
    return ImuSensor(name, file.imus[name], seed)


def _check(file: WorldFile, robot: Robot) -> None:
    """Every sensor of the robot is in the world, and every wheel and named shaft of the world has a motor."""
    sensors: Sequence[str] = ()
    named: Sequence[str] = tuple(file.shafts)
    wheels: Sequence[str] = ()
    driven = robot.brain.differential
    if not isinstance(file, BenchFile):
        wheels = (file.body.left.motor, file.body.right.motor)
        named = (*wheels, *named)
        sensors = (*file.lidars, *file.imus)
    wrong = [
        unknown("motor", name, robot.motors) + " in the robot" for name in named if name not in robot.motors
    ]
    if wheels and driven is not None:
        asked = (driven.left, driven.right)
        wrong += [unknown("wheel", name, wheels) + " to turn" for name in asked if name not in wheels]
    wrong += [unknown("sensor", name, sensors) + " in it" for name in robot.sensors if name not in sensors]
    if wrong:
        raise complaint(f"world {file.name!r} with robot {robot.name!r}", wrong)
