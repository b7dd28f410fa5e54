"""Lidar, IMU, satellite receiver: noise, bias, resolution and drop-outs added to the truth. Seeded, in SI.

Rules. A sensor measures periodically, from the world's time 0, and draws from a random stream of its own, so
that one sensor's noise does not depend on another's presence. `measure` is called at every step, with the
time since the beginning of the sensor's period; it returns what is complete then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from brain.perception.mount import Mount
from gateway.sim.camera import CameraSensor
from gateway.sim.files import STEP, Vector
from gateway.sim.plant_files import InertialUnit, Lidar, PlantFile, Receiver, ShaftEncoder
from gateway.sim.scene import Floats, SimulatedScene, cut
from protocols.messages import SECOND, Fix, Imu, LaserScan, Measurement, Nanos, ShaftReading

EARTH_RADIUS, EARTH_SQUARE = 6_378_137.0, 6.694_379_990_141e-3
"""m, along the equator, and squared eccentricity of the ellipsoid of WGS 84 (NGA.STND.0036, table 3.1)"""


class WorldSensor(Protocol):
    """A sensor of any kind."""

    name: str
    period: Nanos

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> Measurement | None:
        """Return what is complete at time t, `phase` after the beginning of the period."""


def sensors(file: PlantFile, mounts: Mapping[str, Mount], seed: int) -> list[WorldSensor]:
    """Return the sensors on these mounts, each by its table in the plant file."""
    return [_sensor(name, file, mount, seed) for name, mount in mounts.items()]


def _sensor(name: str, file: PlantFile, mount: Mount, seed: int) -> WorldSensor:
    if name in file.lidars:
        return LidarSensor(name, file.lidars[name], mount, seed)
    if name in file.cameras:
        return CameraSensor(name, file.cameras[name], mount, stream(seed, name))
    if name in file.receivers:
        return ReceiverSensor(name, file.receivers[name], mount, seed)
    if name in file.shaft_encoders:
        return ShaftSensor(name, file.shaft_encoders[name])
    return ImuSensor(name, file.imus[name], seed)


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random stream of one sensor in one run."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *name.encode()])))


class LidarSensor:
    """A planar lidar on a mount. The beams of one time step are measured from one pose."""

    def __init__(self, name: str, file: Lidar, mount: Mount, seed: int) -> None:
        self.name, self.file, self.mount = name, file, mount
        self.period: Nanos = round(SECOND / file.rate_hz)
        self._rng = stream(seed, name)
        self._limits = file.range_min, file.range_max
        self._increment = (-1.0 if file.clockwise else 1.0) * 2.0 * math.pi / file.beams
        self._first = math.pi if file.clockwise else -math.pi
        angles = self._first + self._increment * np.arange(file.beams)
        self._directions: Floats = np.stack([np.cos(angles), np.sin(angles), np.zeros(file.beams)], axis=1)
        self._found: Floats = np.zeros(file.beams)

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> LaserScan | None:
        """Measure the beams of this time step; return the scan with the last of them, or these."""
        file, period = self.file, self.period
        beams = file.beams
        if file.sweep:
            first, end = -(-phase * beams // period), -(-(phase + STEP) * beams // period)
        else:
            first, end = 0, beams if phase == 0 else 0
        if first == end:
            return None
        scene.cast(self.mount, self._directions[first:end], file.range_max, self._found[first:end])
        if file.clockwise:
            return self._part(t - phase, first, end)
        if end != beams:
            return None
        duration = (beams - 1) * period // beams if file.sweep else 0
        found = tuple(self._read(self._found).tolist())
        return LaserScan(self.name, t - phase, self._first, self._increment, *self._limits, found, duration)

    def _part(self, start: Nanos, first: int, end: int) -> LaserScan:
        """Return beams of a turn that began at a time, counter-clockwise: the newest one first."""
        times = [start + at * self.period // self.file.beams for at in (first, end - 1)]
        found = self._read(self._found[first:end])[::-1]
        limits, angle = self._limits, self._first + self._increment * (end - 1)
        duration = times[0] - times[1]
        return LaserScan(
            self.name, times[1], angle, -self._increment, *limits, tuple(found.tolist()), duration
        )

    def _read(self, found: Floats) -> Floats:
        """Return ranges as measured. 0.0 is no reading, as of what is nearer than range_min."""
        file = self.file
        true = cut(found, file.range_max)
        ranges = true + file.noise * self._rng.standard_normal(len(true))
        if file.resolution:
            ranges = np.round(ranges / file.resolution) * file.resolution
        ranges = np.where(true >= file.range_max, file.range_max, np.minimum(ranges, file.range_max))
        lost = (ranges < file.range_min) | (self._rng.random(len(true)) < file.dropout)
        ranges[lost] = 0.0
        return ranges


class ImuSensor:
    """An inertial sensor on a mount."""

    def __init__(self, name: str, file: InertialUnit, seed: int) -> None:
        self.name, self.file = name, file
        self.period: Nanos = round(SECOND / file.rate_hz)
        self._rng = stream(seed, name)
        self._gyro_bias = file.gyro_bias
        self._walk = file.gyro_walk / math.sqrt(file.rate_hz)

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> Imu | None:
        """Return angular rates and accelerations at the beginning of a period; it has no orientation."""
        if phase:
            return None
        file, walk = self.file, self._walk
        walked, of_gyro, of_accel = self._rng.standard_normal((3, 3)).tolist()
        gx, gy, gz = self._gyro_bias
        self._gyro_bias = gx + walk * walked[0], gy + walk * walked[1], gz + walk * walked[2]
        gyro, accel = scene.inertial(self.name)
        return Imu(
            self.name,
            t,
            _noisy(gyro, self._gyro_bias, file.gyro_noise, of_gyro),
            _noisy(accel, file.accel_bias, file.accel_noise, of_accel),
        )


def _noisy(true: Sequence[float], bias: Vector, sigma: float, noise: Sequence[float]) -> Vector:
    """Return what is measured along x, y and z; by single numbers, which for three take less than arrays."""
    (x, y, z), (bx, by, bz), (nx, ny, nz) = true, bias, noise
    return x + (bx + sigma * nx), y + (by + sigma * ny), z + (bz + sigma * nz)


class ReceiverSensor:
    """A satellite receiver whose antenna is on a mount."""

    def __init__(self, name: str, file: Receiver, mount: Mount, seed: int) -> None:
        self.name, self.file, self.mount = name, file, mount
        self.period: Nanos = round(SECOND / file.rate_hz)
        self._rng = stream(seed, name)
        latitude, square = math.radians(file.latitude), EARTH_SQUARE
        curved = 1.0 - square * math.sin(latitude) ** 2
        across = EARTH_RADIUS / math.sqrt(curved)
        self._north = math.degrees(1.0 / (across * (1.0 - square) / curved + file.altitude))
        self._east = math.degrees(1.0 / ((across + file.altitude) * math.cos(latitude)))
        """Degrees for each metre: of a place as small as a robot's, the earth is flat."""

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> Fix | None:
        """Return where the antenna is, at the beginning of a period."""
        if phase:
            return None
        file, place = self.file, scene.frame(self.mount)[0]
        east, north = (place[:2] + file.noise * self._rng.standard_normal(2)).tolist()
        latitude, longitude = file.latitude + north * self._north, file.longitude + east * self._east
        height = file.altitude + float(place[2])
        return Fix(self.name, t, latitude, longitude, height, max(file.noise, 1e-3) ** 2)


class ShaftSensor:
    """An encoder on a shaft; its steps are the device's own."""

    def __init__(self, name: str, file: ShaftEncoder) -> None:
        self.name, self._motor = name, file.motor
        self.period: Nanos = round(SECOND / file.rate_hz)

    def measure(self, t: Nanos, phase: Nanos, scene: SimulatedScene) -> ShaftReading | None:
        """Return where the shaft stands, at the beginning of a period."""
        return None if phase else ShaftReading(self.name, t, scene.shaft(self._motor)[0])
