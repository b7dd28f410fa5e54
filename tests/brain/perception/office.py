"""A small world in the plane for tests: an office of walls, and a rover whose sensors are not perfect.

The rover drives on what its perception believes; the truth stays in here, for the tests to compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.differential import Differential
from brain.bodies.plane import arc, wrap
from brain.perception.filter_settings import FilterSettings
from brain.perception.map import Map
from brain.perception.mount import Mount
from brain.perception.perception import Perception, PerceptionSettings
from protocols.messages import MILLISECOND, Event, Feedback, Imu, LaserScan, Nanos
from tests.brain.bodies.kinematics import speeds

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.24,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=1.0,
    max_angular_acceleration=4.0,
)
MOUNTS = {"imu": Mount(0.02, 0.01, 0.08, yaw=math.pi / 2), "lidar": Mount(0.08, 0.0, 0.15, yaw=0.3)}
STEP = 5 * MILLISECOND


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


OFFICE: Floats = np.array(
    box(-1.5, -1.7, 9.5, 5.3)
    + box(3.95, -1.7, 4.05, 1.2)
    + box(3.95, 2.4, 4.05, 5.3)
    + box(1.2, 2.5, 2.0, 3.1)
    + box(6.1, 0.3, 6.7, 1.1)
    + box(7.4, 3.2, 8.6, 3.9)
    + box(-0.9, 4.0, -0.3, 4.6)
)
"""Walls, n × 4: x0 y0 x1 y1 [m]. Two rooms, a doorway of 1.2 m, boxes."""

TOUR = [(2.6, 0.3), (3.2, 1.8), (5.2, 1.8), (5.2, -0.8), (8.3, -0.6), (8.3, 2.2), (6.0, 2.6), (5.0, 4.2)]
TOUR += [(5.2, 1.8), (3.0, 1.8), (2.8, 4.2), (0.4, 3.6), (0.3, 1.2), (2.6, 0.3), (0.0, 0.0)]


def ranges(walls: Floats, x: float, y: float, angles: Floats, farthest: float) -> Floats:
    """How far rays from a place go until a wall: exact intersections of lines."""
    dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    cross = dx * ey - dy * ex
    safe = np.where(np.abs(cross) < 1e-12, np.inf, cross)
    far = ((walls[:, 0] - x) * ey - (walls[:, 1] - y) * ex) / safe
    along = ((walls[:, 0] - x) * dy - (walls[:, 1] - y) * dx) / safe
    met = (far > 0.0) & (along >= 0.0) & (along <= 1.0) & np.isfinite(safe)
    nearest: Floats = np.minimum(np.where(met, far, farthest).min(axis=1), farthest)
    return nearest


def scan_at(
    walls: Floats,
    pose: Pose,
    mount: Mount,
    t: Nanos,
    noise: Floats | float = 0.0,
    beams: int = 360,
    farthest: float = 10.0,
) -> LaserScan:
    """What a level lidar so mounted reads at the pose."""
    x = pose.x + math.cos(pose.yaw) * mount.x - math.sin(pose.yaw) * mount.y
    y = pose.y + math.sin(pose.yaw) * mount.x + math.cos(pose.yaw) * mount.y
    increment = 2.0 * math.pi / beams
    angles = np.asarray(pose.yaw + mount.yaw - math.pi + increment * np.arange(beams), dtype=np.float64)
    read = ranges(walls, x, y, angles, farthest)
    read = np.where(read < farthest, np.maximum(read + noise, 0.0), farthest)
    return LaserScan("lidar", t, -math.pi, increment, 0.1, farthest, tuple(float(r) for r in read))


@dataclass
class Rover:
    """A base that slips, its sensors, and the truth."""

    seed: int
    walls: Floats = field(default_factory=lambda: OFFICE)
    slip_left: float = 0.035
    """Share of the left wheel's way that is lost"""
    slip_right: float = 0.02
    scrub: float = 0.05
    """Share of the turn that is lost"""
    slip_noise: float = 0.01
    gyro_bias: float = 0.01
    gyro_noise: float = 0.005
    lidar_noise: float = 0.01
    resolution: float = 2.0 * math.pi / 4096.0
    scan_delay: int = 4
    """Steps by which a scan comes late"""

    def __post_init__(self) -> None:
        self.random = np.random.Generator(np.random.PCG64(self.seed))
        self.now: Nanos = 0
        self.truth = Pose(0.0, 0.0, 0.0)
        self.angles = [0.3, -2.0]
        self.length = 0.0
        self.rate = 0.0
        self.delayed: list[tuple[Nanos, LaserScan]] = []

    def step(self, linear: float, angular: float) -> list[Event]:
        """Drive for 5 ms at these tread speeds; return the sensors' events."""
        wheel = speeds(BODY, linear, angular)
        turned = [speed * 0.005 for speed in wheel]
        self.angles = [angle + more for angle, more in zip(self.angles, turned, strict=True)]
        slip = np.array([self.slip_left, self.slip_right]) + self.slip_noise * self.random.normal(size=2)
        kept = 1.0 - slip
        rolled = turned[0] * float(kept[0]), turned[1] * float(kept[1])
        distance, turn = BODY.travel((0.0, 0.0), rolled)[:2]
        turn *= 1.0 - self.scrub
        self.truth = arc(self.truth, distance, turn)
        self.length += abs(distance)
        self.rate = turn / 0.005
        self.now += STEP
        return self.sense()

    def sense(self) -> list[Event]:
        step = self.now // STEP
        events: list[Event] = [self.imu()]
        for index, name in enumerate((BODY.left, BODY.right)):
            if step % 2 == index:
                angle = round(self.angles[index] / self.resolution) * self.resolution
                events.append(Feedback(name, self.now, angle))
        if step % 20 == 0:
            noise = self.lidar_noise * self.random.normal(size=360)
            scan = scan_at(self.walls, self.truth, MOUNTS["lidar"], self.now, noise)
            self.delayed.append((self.now + self.scan_delay * STEP, scan))
        while self.delayed and self.delayed[0][0] <= self.now:
            events.append(self.delayed.pop(0)[1])
        return events

    def imu(self) -> Imu:
        x, y, z = (float(n) for n in self.gyro_noise * self.random.normal(size=3))
        return Imu("imu", self.now, (x, y, self.rate + self.gyro_bias + z), (0.0, 0.0, 9.81))


@dataclass
class Drive:
    """What a drive came to."""

    rover: Rover
    perception: Perception
    believed_length: float = 0.0
    raw_length: float = 0.0
    worst: float = 0.0
    """m: the largest distance between the pose believed and the true one"""

    @property
    def apart(self) -> float:
        """m: between the pose believed and the true one, now"""
        estimate = self.perception.estimate
        assert estimate is not None
        return math.dist((estimate.pose.x, estimate.pose.y), (self.rover.truth.x, self.rover.truth.y))

    @property
    def raw_apart(self) -> float:
        """m: between the pose of dead reckoning and the true one, now"""
        raw, truth = self.perception.raw, self.rover.truth
        return math.dist((raw.x, raw.y), (truth.x, truth.y))


SETTINGS = PerceptionSettings(FilterSettings(resolution=2.0 * math.pi / 4096.0), gyro_sigma=0.006)
"""Settings by the rover's data sheets."""


def drive(
    rover: Rover,
    tour: Sequence[tuple[float, float]],
    settings: PerceptionSettings = SETTINGS,
    mounts: Mapping[str, Mount] = MOUNTS,
) -> Drive:
    """Wait a second, then drive the tour on the pose believed; at most ten minutes."""
    perception = Perception(BODY, mounts, settings)
    result = Drive(rover, perception)
    speeds, left = (0.0, 0.0), list(tour)
    for step in range(120_000):
        before = perception.estimate, perception.raw
        events = rover.step(*speeds)
        perception.observe(rover.now, [event for event in events if _mounted(event, mounts)])
        estimate = perception.estimate
        if before[0] is not None and estimate is not None:
            _measure(result, before[0].pose, before[1])
        if step < 200 or estimate is None:
            continue
        if math.dist((estimate.pose.x, estimate.pose.y), left[0]) < 0.08:
            left.pop(0)
        if not left:
            return result
        speeds = _towards(estimate.pose, left[0], speeds)
    raise AssertionError(f"the tour was not finished; the robot is at {rover.truth}")


def _mounted(event: Event, mounts: Mapping[str, Mount]) -> bool:
    return not isinstance(event, Imu | LaserScan) or event.sensor in mounts


def _towards(pose: Pose, goal: tuple[float, float], speeds: tuple[float, float]) -> tuple[float, float]:
    error = wrap(math.atan2(goal[1] - pose.y, goal[0] - pose.x) - pose.yaw)
    ahead = math.dist((pose.x, pose.y), goal)
    linear = min(0.5, 0.1 + ahead) * max(0.0, math.cos(error)) ** 4
    angular = max(-1.5, min(1.5, 2.5 * error))
    return (
        speeds[0] + max(-0.005, min(0.005, linear - speeds[0])),
        speeds[1] + max(-0.02, min(0.02, angular - speeds[1])),
    )


def _measure(result: Drive, before: Pose, raw: Pose) -> None:
    estimate = result.perception.estimate
    assert estimate is not None
    result.believed_length += math.dist((before.x, before.y), (estimate.pose.x, estimate.pose.y))
    result.raw_length += math.dist((raw.x, raw.y), (result.perception.raw.x, result.perception.raw.y))
    result.worst = max(result.worst, result.apart)


def classes(chart: Map) -> tuple[Floats, Floats]:
    """The values of the cells within the extent, and the middles of the occupied ones [m], n × 2."""
    view = chart.view()
    rows, columns = np.nonzero(view.log_odds > 0.0)
    x = view.origin_x + (columns + 0.5) * view.resolution
    y = view.origin_y + (rows + 0.5) * view.resolution
    return view.log_odds.astype(np.float64), np.column_stack([x, y])


def clearance(chart: Map, x: float, y: float) -> float:
    """From a position to the nearest part of an occupied cell [m]; infinite if there is none."""
    _, middles = classes(chart)
    if not len(middles):
        return math.inf
    away = np.maximum(np.abs(middles - (x, y)) - chart.resolution / 2.0, 0.0)
    return float(np.sqrt(np.min(np.sum(away * away, axis=1))))


def person(x: float, y: float) -> Floats:
    """Return the walls of somebody who stands there."""
    around = np.linspace(0.0, math.tau, 13)
    corners = np.column_stack([x + 0.3 * np.cos(around), y + 0.3 * np.sin(around)])
    return np.hstack([corners[:-1], corners[1:]])
