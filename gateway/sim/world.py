"""The world behind the twins: the motion of shafts under torques, sensor readings, and the ground truth.

Rules. Virtual time only: one `step` is one time step of 1 ms. Same file, robot, seed and torques: same world,
bit for bit, on one version of MuJoCo and one processor. Nothing here knows a protocol or a gear ratio: all is
at the joints' output shafts. `truth` and `contacts` are for evaluation and pictures, never an input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

from brain.belief import Pose
from brain.perception.mount import Mount
from gateway.config.errors import unknown
from gateway.sim.files import STEP, SceneFile, WorldFile
from gateway.sim.load import WorldError
from gateway.sim.mjcf import Polygon, outlines
from gateway.sim.rover import Rover
from gateway.sim.sensors import ImuSensor, LidarSensor
from gateway.sim.shafts import Shafts
from protocols.messages import Imu, LaserScan, Nanos

if TYPE_CHECKING:
    from gateway.core.robot import Robot

Reading: TypeAlias = Imu | LaserScan


class World:
    """A world file with a robot in it, from a seed. Raises WorldError if they do not fit each other."""

    def __init__(self, file: WorldFile, robot: Robot, seed: int) -> None:
        _check(file, robot)
        self.file = file
        self.now: Nanos = 0
        """The world's time. It may be set before the first step."""
        self._sensors: list[ImuSensor | LidarSensor] = []
        self._readings: list[Reading] = []
        self._steps = 0
        self._rover: Rover | None = None
        wheels: tuple[str, ...] = ()
        if isinstance(file, SceneFile):
            wheels = (file.body.left.motor, file.body.right.motor)
            mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
            self._rover = Rover(file, {n: m for n, m in mounts.items() if n in file.imus}, seed)
            self._sensors = [_sensor(name, file, mount, seed) for name, mount in mounts.items()]
        self._shafts = Shafts(file, [name for name in robot.motors if name not in wheels])
        """On a bench all, in a scene those that the base carries."""

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at the OUTPUT shafts, by motor; 0 where none is given.

        Raises ValueError for a torque that is not finite."""
        for motor, torque in torques.items():
            if not math.isfinite(torque):
                raise ValueError(f"the torque of {motor!r} is {torque}; expected a finite number")
        self._shafts.step(torques)
        if self._rover is not None:
            self._rover.step(torques)
            self._measure(self._rover)
        self.now += STEP
        self._steps += 1

    def _measure(self, rover: Rover) -> None:
        """Measure the state at the beginning of the step, which is what MuJoCo has computed last."""
        for sensor in self._sensors:
            reading = sensor.measure(self.now, self._steps * STEP % sensor.period, rover)
            if reading is not None:
                self._readings.append(reading)

    def shaft(self, motor: str) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] of a motor's output shaft."""
        if self._rover is None or motor in self._shafts:
            return self._shafts.shaft(motor)
        return self._rover.shaft(motor)

    def readings(self) -> Sequence[Reading]:
        """Return the sensor readings since the last call, in the order of completion, with their noise."""
        if not self._readings:
            return ()
        found, self._readings = self._readings, []
        return found

    @property
    def counts_per_turn(self) -> int:
        """Resolution of the encoders, which sit on the devices' own shafts."""
        return self.file.encoder.counts_per_turn

    def truth(self) -> Pose:
        """Return the true pose in the world's frame (the origin, on a bench)."""
        return Pose(0.0, 0.0, 0.0) if self._rover is None else self._rover.pose()

    def contacts(self) -> int:
        """Return how often walls and boxes (on a bench: hard stops) were touched so far."""
        return self._shafts.touches if self._rover is None else self._rover.touches

    @property
    def tour(self) -> tuple[tuple[float, float], ...]:
        """Goals [m] for a demo, relative to where the robot starts."""
        return self.file.tour if isinstance(self.file, SceneFile) else ()

    def outlines(self) -> list[Polygon]:
        """Return walls and boxes seen from above, as polygons [m] in the world's frame."""
        return outlines(self.file) if isinstance(self.file, SceneFile) else []


def _sensor(name: str, file: SceneFile, mount: Mount, seed: int) -> ImuSensor | LidarSensor:
    if name in file.lidars:
        return LidarSensor(name, file.lidars[name], mount, seed)
    return ImuSensor(name, file.imus[name], seed)


def _check(file: WorldFile, robot: Robot) -> None:
    """Check that the world has every sensor of the robot, and the robot a motor for every wheel and shaft."""
    sensors: tuple[str, ...] = ()
    wheels: tuple[str, ...] = ()
    if isinstance(file, SceneFile):
        wheels = (file.body.left.motor, file.body.right.motor)
        sensors = (*file.lidars, *file.imus)
    wrong = [
        unknown("motor", name, robot.motors) + " in the robot"
        for name in (*wheels, *file.shafts)
        if name not in robot.motors
    ]
    driven = robot.brain.differential
    if wheels and driven is not None:
        required = (driven.left, driven.right)
        wrong += [unknown("wheel", name, wheels) + " to turn" for name in required if name not in wheels]
    wrong += [unknown("sensor", name, sensors) + " in it" for name in robot.sensors if name not in sensors]
    if wrong:
        raise WorldError.about(f"world {file.name!r} with robot {robot.name!r}", wrong)
