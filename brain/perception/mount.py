"""Sensor mounting (extrinsics), and readings transformed to the robot's frame.

Rules. A mount is the pose of the sensor's frame in the robot's frame (x forward, y left, z up, origin midway
between the wheels, on the ground). The rotation is R = Rz(yaw) Ry(pitch) Rx(roll), applied to vectors of the
sensor. The world is flat: of a lidar's points the robot's x and y are kept, so a lidar mounted upside down
(roll = pi) is right and a tilted one is foreshortened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from brain.belief import Floats, Pose
from brain.checks import within
from protocols.messages import LaserScan

Vector = tuple[float, float, float]
Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Mount:
    """Pose of a sensor in the robot's frame: m, rad."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        metres, turn = (-10.0, 10.0, "m"), (-2.0 * math.pi, 2.0 * math.pi, "rad")
        within(self, x=metres, y=metres, z=metres, yaw=turn, pitch=turn, roll=turn)

    def rotation(self) -> tuple[Vector, Vector, Vector]:
        """Return the rows of R, which rotates a vector of the sensor into the robot's frame."""
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        cp, sp = math.cos(self.pitch), math.sin(self.pitch)
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        return (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )

    def rotate(self, vector: Vector) -> Vector:
        """Return a free vector (angular velocity, acceleration) of the sensor in the robot's frame."""
        x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in self.rotation())
        return x, y, z


@dataclass(frozen=True, slots=True)
class BodyScan:
    """A scan in the robot's frame: where each beam starts and ends, and whether it hit something."""

    origin: tuple[float, float]
    """m, position of the lidar"""
    axes: Floats
    """2 × 2: its columns are the lidar's x and y axes in the robot's x-y plane"""
    angle_min: float
    angle_increment: float
    ranges: Floats
    """m, n; 0 where the beam gave no reading, cut at the largest range that is used"""
    hit: Bools
    """n; False also where the beam reached the largest range without a hit"""
    ends: Floats
    """n × 2, m; equal to the origin where the beam gave no reading"""


def to_body(scan: LaserScan, mount: Mount, farthest: float = math.inf) -> BodyScan:
    """Return the scan in the robot's frame. Beams without a hit up to `farthest` [m] end there.

    A range below range_min, or not finite, is no reading: nothing is known along that beam."""
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    end = min(scan.range_max, farthest)
    read = np.isfinite(ranges) & (ranges >= max(scan.range_min, 1e-9))
    hit = read & (ranges < end)
    lengths = np.where(read, np.minimum(ranges, end), 0.0)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    rows = mount.rotation()
    axes = np.array([rows[0][:2], rows[1][:2]])
    ends = np.empty((len(ranges), 2))
    along, across = lengths * np.cos(angles), lengths * np.sin(angles)
    ends[:, 0] = mount.x + axes[0, 0] * along + axes[0, 1] * across
    ends[:, 1] = mount.y + axes[1, 0] * along + axes[1, 1] * across
    return BodyScan((mount.x, mount.y), axes, scan.angle_min, scan.angle_increment, lengths, hit, ends)


def to_world(points: Floats, pose: Pose) -> Floats:
    """Return points (n × 2) of the robot's frame in the world, for the robot at this pose."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    world = np.empty_like(points)
    world[:, 0] = pose.x + c * points[:, 0] - s * points[:, 1]
    world[:, 1] = pose.y + s * points[:, 0] + c * points[:, 1]
    return world
