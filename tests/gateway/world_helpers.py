"""Robots and small worlds for the tests of the world and its twins: plain motors and sensors, no CAN."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

from gateway.config import parse_robot
from gateway.core.robot import Robot
from gateway.sim import PlantFile, SceneFile, World, WorldFile, parse_plant, parse_world
from protocols.messages import Imu, LaserScan, Measurement

RADIUS, SEPARATION = 0.05, 0.22

BASE = """
name = "tester"
rate_hz = 200
seed = 1
{world}
[buses.motors]
kind = "serial"
baudrate = 1_000_000
interface = "twin"

[buses.sensors]
kind = "serial"
baudrate = 3_000_000
interface = "twin"

[defaults.motors]
protocol = "plain"
bus = "motors"
gear = 8.0
stop_action = "idle"
limits = {{ velocity = 20.0, acceleration = 60.0, torque = 2.0 }}
options = {{ kind = "motor" }}
settings = {{ torque_limit = 0.2, torque_constant = 0.1 }}

[motors.left]
address = 1

[motors.right]
address = 2
sign = -1

[brain]
body = "differential"
[brain.differential]
left = "left"
right = "right"
wheel_radius = 0.05
wheel_separation = 0.22
radius = 0.25
max_linear = 0.6
max_angular = 2.0
max_linear_acceleration = 0.8
max_angular_acceleration = 4.0
"""

SENSORS = """
[sensors.lidar]
protocol = "plain"
bus = "sensors"
address = 1
mount = {{ {lidar} }}
timeout_ms = 500

[sensors.imu]
protocol = "plain"
bus = "sensors"
address = 2
mount = {{ {imu} }}
timeout_ms = 500
"""

ROOM = """
kind = "scene"
name = "room"
"""
PLANT = """
kind = "wheels"
name = "rover"
[body.wheels]
left = { motor = "left", y = 0.11 }
right = { motor = "right", y = -0.11 }
[body.casters]
front = { x = 0.16 }
rear = { x = -0.16 }
[lidars.lidar]
[imus.imu]
"""
"""No walls, no noise, no slip."""

WALLS = """
[walls.east]
start = [2.05, -3.0]
end = [2.05, 3.0]
[walls.north]
start = [-3.0, 1.55]
end = [3.0, 1.55]
[boxes.west]
x = -1.2
y = 0.0
size = [0.4, 1.0, 0.5]
"""
"""Faces at x = 2, y = 1.5 and x = -1; nothing to the south."""


@cache
def robot(world: str = "", lidar: str = "x = 0.0", imu: str = "x = 0.0", sensors: bool = True) -> Robot:
    """Two plain motors (gear 8, the right one mounted the other way round), with lidar and IMU."""
    text = BASE.format(world=f'world = "{world}"\nplant = "diffbot"' if world else "")
    return parse_robot(text + SENSORS.format(lidar=lidar, imu=imu) if sensors else text)


def scene(text: str = ROOM) -> SceneFile:
    """A scene from its text."""
    file = parse_world(text)
    assert isinstance(file, SceneFile)
    return file


def plant(text: str = PLANT) -> PlantFile:
    """A plant from its text."""
    return parse_plant(text)


def world(
    file: WorldFile | None = None,
    seed: int = 1,
    lidar: str = "x = 0.0",
    imu: str = "x = 0.0",
    made: PlantFile | None = None,
) -> World:
    """A world with the robot in it."""
    return World(file or scene(), made or plant(), robot(lidar=lidar, imu=imu), seed)


@dataclass
class Driver:
    """Turns the wheels of a world at wanted speeds with a loop at the shafts, and keeps what it saw."""

    world: World
    gathered: dict[str, float] = field(default_factory=lambda: {"left": 0.0, "right": 0.0})
    readings: list[Measurement] = field(default_factory=list)
    encoders: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, 0.0)])
    """rad, left and right, every 10 ms"""
    truths: list[tuple[float, float, float]] = field(default_factory=list)
    """x, y, yaw at the same moments"""

    def __post_init__(self) -> None:
        pose = self.world.truth()
        self.truths.append((pose.x, pose.y, pose.yaw))

    def run(self, steps: int, left: float, right: float, limit: float = 2.0, ramp: int = 300) -> Driver:
        """Take steps of 1 ms; the wheels speed up to these rad/s over `ramp` steps."""
        start = {name: self.world.shaft(name)[1] for name in ("left", "right")}
        for step in range(steps):
            part = min(1.0, (step + 1) / ramp)
            torques = {}
            for name, wanted in (("left", left), ("right", right)):
                error = start[name] + part * (wanted - start[name]) - self.world.shaft(name)[1]
                self.gathered[name] += 3.0 * error * 0.001
                self.gathered[name] = max(-limit, min(limit, self.gathered[name]))
                torques[name] = max(-limit, min(limit, 0.3 * error + self.gathered[name]))
            self.world.step(torques)
            self.readings += self.world.readings()
            if step % 10 == 9:
                self.encoders.append((self.world.shaft("left")[0], self.world.shaft("right")[0]))
                pose = self.world.truth()
                self.truths.append((pose.x, pose.y, pose.yaw))
        return self

    def scans(self) -> list[LaserScan]:
        """The scans so far."""
        return [reading for reading in self.readings if isinstance(reading, LaserScan)]

    def imus(self) -> list[Imu]:
        """The inertial readings so far."""
        return [reading for reading in self.readings if isinstance(reading, Imu)]

    def path(self) -> float:
        """m, the way of the true pose."""
        pairs = zip(self.truths, self.truths[1:], strict=False)
        return sum(math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairs)

    def odometry(self, turn: Callable[[int, float], float] | None = None) -> list[tuple[float, float, float]]:
        """x, y, yaw by the encoders at each moment; `turn` may give another turn for the step than theirs."""
        x, y, yaw = self.truths[0]
        poses = [(x, y, yaw)]
        for index, (before, after) in enumerate(zip(self.encoders, self.encoders[1:], strict=False)):
            left, right = (RADIUS * (b - a) for a, b in zip(before, after, strict=True))
            turned = (right - left) / SEPARATION
            turned = turn(index, turned) if turn else turned
            way = (left + right) / 2.0
            x += way * math.cos(yaw + turned / 2.0)
            y += way * math.sin(yaw + turned / 2.0)
            yaw += turned
            poses.append((x, y, yaw))
        return poses

    def off(self, poses: Sequence[tuple[float, float, float]]) -> float:
        """m, the farthest that poses are from the true ones."""
        return max(math.hypot(a[0] - b[0], a[1] - b[1]) for a, b in zip(poses, self.truths, strict=True))


def turned(driver: Driver) -> float:
    """rad, the true turn so far, unwrapped."""
    total = 0.0
    for before, after in zip(driver.truths, driver.truths[1:], strict=False):
        total += math.remainder(after[2] - before[2], 2.0 * math.pi)
    return total
