"""Sensor mounting (extrinsics).

Rules. A mount is the pose of the sensor's frame in the robot's frame (x forward, y left, z up, origin midway
between the wheels, on the ground). The rotation is R = Rz(yaw) Ry(pitch) Rx(roll), applied to vectors of the
sensor. The world is flat: of a lidar's points the robot's x and y are kept, so a lidar mounted upside down
(roll = pi) is right and a tilted one is foreshortened.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np

from brain.belief import Floats
from protocols.bounds import Bounds, check
from protocols.messages import LaserScan

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mount:
    """Pose of a sensor in the robot's frame: m, rad."""

    x: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    y: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    z: Annotated[float, Bounds(-10.0, 10.0, "m")] = 0.0
    yaw: Annotated[float, Bounds(-2.0 * math.pi, 2.0 * math.pi, "rad")] = 0.0
    pitch: Annotated[float, Bounds(-2.0 * math.pi, 2.0 * math.pi, "rad")] = 0.0
    roll: Annotated[float, Bounds(-2.0 * math.pi, 2.0 * math.pi, "rad")] = 0.0

    def __post_init__(self) -> None:
        check(self)

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

    def beams(self, scan: LaserScan) -> Floats:
        """Return the directions of a scan's beams in the robot's frame, seen from above: 2 × n, read-only."""
        return _beams(self, scan.angle_min, scan.angle_increment, len(scan.ranges))

    def place(self, point: Vector) -> Vector:
        """Return a point of the sensor's frame in the robot's."""
        x, y, z = self.rotate(point)
        return x + self.x, y + self.y, z + self.z

    def rotate(self, vector: Vector) -> Vector:
        """Return a free vector (angular velocity, acceleration) of the sensor in the robot's frame."""
        x, y, z = (sum(a * b for a, b in zip(row, vector, strict=True)) for row in self.rotation())
        return x, y, z


@lru_cache(maxsize=8)
def _beams(mount: Mount, first: float, increment: float, count: int) -> Floats:
    angles = first + increment * np.arange(count)
    (xx, xy, _), (yx, yy, _), _ = mount.rotation()
    along, across = np.cos(angles), np.sin(angles)
    beams = np.array([xx * along + xy * across, yx * along + yy * across])
    beams.setflags(write=False)
    return beams
