"""The world behind the twins: the motion of shafts under torques, sensor readings, and the ground truth.

Rules. Virtual time only: one `step` is one time step of 1 ms. Same files, robot, seed and torques: same
world, bit for bit, on one version of MuJoCo and one processor. Nothing here knows a protocol or a gear ratio:
all is at the joints' output shafts. `truth`, `contacts` and `people` are for evaluation and pictures, never
an input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from brain.belief import Pose
from brain.bodies.limbs import limbs
from brain.perception.mount import Mount
from gateway.config.errors import unknown
from gateway.sim.assembly_file import Assembly
from gateway.sim.camera import CameraSensor
from gateway.sim.files import STEP, BenchFile, SceneFile, WorldFile
from gateway.sim.linked import Linked, Standing
from gateway.sim.linked_file import LinkedFile
from gateway.sim.load import WorldError
from gateway.sim.mjcf import Polygon, outlines
from gateway.sim.plant_files import PlantFile, WheeledFile
from gateway.sim.rover import Rover
from gateway.sim.scene import SimulatedScene
from gateway.sim.sensors import WorldSensor, sensors
from gateway.sim.shafts import Shafts
from gateway.vision.camera import Seen
from protocols.messages import Measurement, Nanos

if TYPE_CHECKING:
    from gateway.core.robot import Robot


class World:
    """A world file with a robot in it, from a seed; `plant` is what the robot truly is, and not looked at on
    a bench, where its motors are clamped. Raises WorldError if they do not fit each other."""

    def __init__(self, file: WorldFile, plant: PlantFile | None, robot: Robot, seed: int) -> None:
        _check(file, plant, robot)
        self.file = file
        self.now: Nanos = 0
        """The world's time. It may be set before the first step."""
        self._sensors: list[WorldSensor] = []
        self._erring = {name: sensor for name, sensor in robot.sensors.items() if sensor.errs}
        """Sensors of which the robot file states an error: they have it."""
        self._held: list[tuple[Nanos, Measurement]] = []
        """Readings that come late, and when."""
        self._readings: list[Measurement] = []
        self._steps = 0
        self.scene: SimulatedScene | None = None
        """What is simulated in MuJoCo; None on a bench."""
        self._carrier: BenchFile | PlantFile = file if isinstance(file, BenchFile) else BenchFile()
        moved: tuple[str, ...] = ()
        if isinstance(file, SceneFile) and plant is not None:
            self._carrier, moved = plant, plant.motors
            mounts = {name: sensor.mount for name, sensor in robot.sensors.items()}
            self.scene = _scene(file, plant, {n: m for n, m in mounts.items() if n in plant.imus}, seed)
            self._sensors = sensors(plant, mounts, seed)
        self._bare = frozenset(name for name in robot.motors if name not in moved)
        """The motors whose shafts are bare: on a bench all, in a scene those that the body carries."""
        self._shafts = Shafts(self._carrier, [name for name in robot.motors if name in self._bare])

    def step(self, torques: Mapping[str, float]) -> None:
        """Advance by one time step under torques [N·m] at the OUTPUT shafts, by motor; 0 where none is given.

        Raises ValueError for a torque that is not finite."""
        for motor, torque in torques.items():
            if not math.isfinite(torque):
                raise ValueError(f"the torque of {motor!r} is {torque}; expected a finite number")
        self._shafts.step(torques)
        if self.scene is not None:
            self.scene.step(torques)
            self._measure(self.scene)
        self.now += STEP
        self._steps += 1

    def _measure(self, scene: SimulatedScene) -> None:
        """Measure the state at the beginning of the step, which is what MuJoCo has computed last."""
        for sensor in self._sensors:
            reading = sensor.measure(self.now, self._steps * STEP % sensor.period, scene)
            if reading is None:
                continue
            if (erring := self._erring.get(sensor.name)) is None:
                self._readings.append(reading)
            else:
                self._held.append((self.now + erring.late, erring.reported(reading)))
        if self._held:
            self._readings += [one for due, one in self._held if due <= self.now]
            self._held = [one for one in self._held if one[0] > self.now]

    def images(self) -> dict[str, Seen]:
        """Return the newest image of each camera."""
        cameras = (sensor for sensor in self._sensors if isinstance(sensor, CameraSensor))
        return {camera.name: camera.seen for camera in cameras if camera.seen is not None}

    def shaft(self, motor: str) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] of a motor's output shaft."""
        if self.scene is None or motor in self._bare:
            return self._shafts.shaft(motor)
        return self.scene.shaft(motor)

    def follow(self, motor: str, position: float, velocity: float) -> None:
        """Give an output shaft its motion from now on: at this angle [rad], turning at this velocity [rad/s],
        whatever torques act on it, until `let_go`."""
        if self.scene is None or motor in self._bare:
            self._shafts.give(motor, (position, velocity))
        else:
            self.scene.follow(motor, position, velocity)

    def hold(self, motor: str) -> None:
        """Hold an output shaft where it is."""
        self.follow(motor, self.shaft(motor)[0], 0.0)

    def let_go(self, motor: str) -> None:
        """Let torques move an output shaft again."""
        if self.scene is None or motor in self._bare:
            self._shafts.give(motor, None)
        else:
            self.scene.let_go(motor)

    def resistance(self, motor: str) -> float:
        """Return the torque [N·m] that the world puts on an output shaft: negative brakes what turns
        forward."""
        if self.scene is None or motor in self._bare:
            return self._shafts.resistance(motor)
        return self.scene.resistance(motor)

    def clearance(self, most: float = 1.0) -> float:
        """Return the distance [m] to the nearest wall, fixed box or person, `most` at most; that on a
        bench."""
        return most if self.scene is None else self.scene.clearance(most)

    def readings(self) -> Sequence[Measurement]:
        """Return the sensor readings since the last call, in the order of completion, with their noise."""
        if not self._readings:
            return ()
        found, self._readings = self._readings, []
        return found

    @property
    def counts_per_turn(self) -> int:
        """Resolution of the encoders, which sit on the devices' own shafts."""
        return self._carrier.encoder.counts_per_turn

    def truth(self) -> Pose:
        """Return the true pose in the world's frame (the origin, on a bench)."""
        return Pose(0.0, 0.0, 0.0) if self.scene is None else self.scene.pose()

    def twist(self) -> tuple[float, float, float]:
        """Return the true speeds forward and to the left [m/s], and of turning [rad/s]."""
        return (0.0, 0.0, 0.0) if self.scene is None else self.scene.twist()

    def cameras(self) -> list[CameraSensor]:
        """Return the cameras, whose images can be looked at."""
        return [one for one in self._sensors if isinstance(one, CameraSensor)]

    def contacts(self) -> int:
        """Return how often walls and boxes (on a bench: hard stops) were touched so far."""
        return self._shafts.touches if self.scene is None else self.scene.touches

    def touches_by_people(self) -> int:
        """Return how often a person was touched so far while the robot moved."""
        return 0 if self.scene is None else self.scene.touches_by_people

    def people(self) -> list[tuple[float, float, float]]:
        """Return x, y and radius [m] of everybody, in the world's frame."""
        return [] if self.scene is None else self.scene.people()

    def movable(self) -> dict[str, tuple[float, float, float]]:
        """Return where the middle of each box is that can be pushed [m], in the world's frame."""
        if self.scene is None or not isinstance(self.file, SceneFile):
            return {}
        return {name: self.scene.box(name) for name, box in self.file.boxes.items() if box.mass is not None}

    @property
    def tour(self) -> tuple[tuple[float, float], ...]:
        """Goals [m] for a demo, relative to where the robot starts."""
        return self.file.tour if isinstance(self.file, SceneFile) else ()

    @property
    def mission(self) -> str:
        """A mission for a demo, by name or path; "" if there is none."""
        return self.file.mission if isinstance(self.file, SceneFile) else ""

    def tags(self) -> list[tuple[int, float, float, float]]:
        """Return number, x, y [m] and the direction of the face [rad] of each tag, in the world's frame."""
        tags = self.file.tags.values() if isinstance(self.file, SceneFile) else ()
        return [(tag.marker, tag.x, tag.y, tag.yaw) for tag in tags]

    def outlines(self) -> list[Polygon]:
        """Return walls and boxes seen from above, as polygons [m] in the world's frame."""
        return outlines(self.file) if isinstance(self.file, SceneFile) else []


def _scene(file: SceneFile, plant: PlantFile, imus: dict[str, Mount], seed: int) -> SimulatedScene:
    """Return the scene with the robot in it, by the plant's kind."""
    if isinstance(plant, Assembly):
        if plant.base is None:
            return Standing(file, plant.parts, imus)
        return Rover(file, plant.base, imus, seed, plant.parts)
    if isinstance(plant, WheeledFile):
        return Rover(file, plant, imus, seed)
    if isinstance(plant, LinkedFile):
        return Linked(file, plant, imus)
    raise AssertionError(f"no scene for {type(plant).__name__}")


def _check(file: WorldFile, plant: PlantFile | None, robot: Robot) -> None:
    """Check that there is a plant for a scene, with every sensor of the robot, and that the robot has a motor
    for every part of it, and a part of it for every motor that it drives with."""
    wrong: list[str] = []
    have: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    shafts = file.shafts if isinstance(file, BenchFile) else plant.shafts if plant else {}
    if isinstance(file, SceneFile):
        if plant is None:
            wrong = [f"the robot file has no key 'plant': what {robot.name!r} truly is in this world"]
        else:
            have = (*plant.lidars, *plant.imus, *plant.cameras, *plant.receivers, *plant.shaft_encoders)
            moved = plant.motors
    if not wrong:
        wrong = [
            unknown("motor", name, robot.motors) + " in the robot"
            for name in (*moved, *shafts)
            if name not in robot.motors
        ]
        if moved:
            bodies = [one.body for one in limbs(robot.brain.body).values() if not one.body.bare]
            parts = [name for body in bodies for name in body.joints if name not in moved]
            wrong += [unknown("motor", name, moved) + " in the plant" for name in parts]
        wrong += [unknown("sensor", name, have) + " in it" for name in robot.sensors if name not in have]
    if wrong:
        of = f" with plant {plant.name!r}" if plant and isinstance(file, SceneFile) else ""
        raise WorldError.about(f"world {file.name!r}{of} with robot {robot.name!r}", wrong)
