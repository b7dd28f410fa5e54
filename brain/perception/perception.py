"""What the body tells, made into what the brain believes: estimate and map.

Rules of this file. Every event is heard once, in the order in which it came; each measurement counts
at its own time. Wheels and gyro move the filter. A scan waits until the filter has reached the
scan's time; it is matched against the map from the filter's pose then, the match corrects the filter,
and the scan is drawn into the map at the corrected pose. A scan whose match the gate refuses, or that
contradicts the map, is not drawn: a wrong pose would spoil the map. Nothing here knows the time of day,
the goal, or the truth; what is refused is counted in `ledger`, by name and reason, and harms nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from brain.belief import Estimate, Floats, Pose
from brain.bodies.differential import Differential, arc
from brain.perception.ekf import Nis
from brain.perception.ekf import Ekf
from brain.perception.ekf_settings import EkfSettings
from brain.perception.grid import Grid, GridSettings
from brain.perception.measurement import Measurement, Verdict, gyro, located, resting, wheels
from brain.perception.motion_model import BIAS, POSE, SLIP, YAW, V, W, X, Y
from brain.perception.mount import Mount, Sweep, sweep
from brain.perception.odometry import Odometry, OdometrySettings, Travel
from brain.perception.scan_match import MatchSettings, match, misfits
from protocols.messages import MILLISECOND, Event, Feedback, Imu, LaserScan, Nanos, seconds


@dataclass(frozen=True, slots=True)
class WheelSettings:
    """How far the wheels' word is trusted."""

    jitter: float = 1e-4
    """s: how unevenly reports are stamped"""
    turn_slip: float = 0.03
    """Share of each wheel's way that it may slip by itself, and so turn the base"""
    slip_lasts: float = 1.0
    """s: slip goes on for about this long, so its errors do not average out from report to report"""
    still_for: Nanos = 300 * MILLISECOND
    """Wheels at rest for this long, and a gyro that agrees, are a base at rest."""
    still_sigma: float = 1e-3
    """m/s and rad/s: how still a base at rest is"""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{item.name} must not be negative, but is {value!r}")
        if self.still_sigma <= 0.0:
            raise ValueError(f"still_sigma must be above 0, not {self.still_sigma!r}")


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """All settings of this room."""

    ekf: EkfSettings = field(default_factory=EkfSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    wheels: WheelSettings = field(default_factory=WheelSettings)
    gyro_sigma: float = 0.01
    """rad/s: noise of one reading"""
    grid: GridSettings = field(default_factory=GridSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    matching: bool = True
    """Whether scans are matched against the map; if not, they are only drawn into it."""
    scan_wait: Nanos = 500 * MILLISECOND
    """How long a scan waits for the wheels and the gyro."""
    redraw: Nanos = 2000 * MILLISECOND
    """Scans that have contradicted the map for so long are drawn: the place has changed."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gyro_sigma) and self.gyro_sigma > 0.0):
            raise ValueError(f"gyro_sigma must be above 0, not {self.gyro_sigma!r}")
        if self.scan_wait < 0 or self.redraw < 0:
            raise ValueError(f"scan_wait and redraw must not be negative: {self.scan_wait}, {self.redraw}")


class Perception:
    """The state of belief. Plain data: a deep copy goes on exactly as the original."""

    def __init__(self, body: Differential, mounts: Mapping[str, Mount], settings: PerceptionSettings) -> None:
        self.body = body
        self.settings = settings
        self.map = Grid(settings.grid)
        self.raw = Pose(settings.ekf.start_x, settings.ekf.start_y, settings.ekf.start_yaw)
        """Dead reckoning by the wheels alone, for comparison."""
        self.rejected: dict[str, int] = dict.fromkeys((body.left, body.right, *mounts), 0)
        """Measurements that the chi-square gate refused, by motor or sensor."""
        self.ledger: dict[str, dict[str, int]] = {name: {} for name in self.rejected}
        """What was refused or done against the rule, by motor or sensor, then by reason."""
        self._mounts = dict(mounts)
        self._upright = {name: mount.rotation()[2] for name, mount in mounts.items()}
        self._ekf = Ekf(settings.ekf)
        self._odometry = Odometry(body, settings.odometry)
        self._last: dict[str, Nanos] = {}
        self._scans: deque[LaserScan] = deque()
        self._moved_at: Nanos | None = None
        self._misfit_since: dict[str, Nanos] = {}
        self._gyro: str | None = None
        self._rate = 0.0

    @property
    def estimate(self) -> Estimate | None:
        """The filter's state at its newest measurement; None before both wheels have reported."""
        ekf = self._ekf
        if ekf.t is None or self._moved_at is None:
            return None
        x = ekf.state
        linear = float((1.0 - x[SLIP]) * x[V])
        return Estimate(ekf.t, _pose(x), linear, float(x[W]), ekf.covariance[POSE, POSE].copy())

    @property
    def gyro_bias(self) -> float:
        """rad/s, as believed"""
        return float(self._ekf.state[BIAS])

    @property
    def slip(self) -> float:
        """The share of the wheels' way that the base is believed not to go."""
        return float(self._ekf.state[SLIP])

    @property
    def nis(self) -> Mapping[str, Nis]:
        """How well the covariances fit what came: by sensor, and of both wheels by the left one's name."""
        return self._ekf.nis

    def last(self, name: str) -> Nanos | None:
        """Time of the newest measurement of a motor (of its motion) or a sensor; None before the first."""
        return self._last.get(name)

    def observe(self, now: Nanos, events: Sequence[Event]) -> None:
        """Take in what came since the last call: every event once, in order."""
        measurements: list[Measurement] = []
        for event in events:
            if isinstance(event, Feedback):
                measurements += self._on_wheel(event)
            elif isinstance(event, Imu):
                measurements += self._on_imu(event)
            elif isinstance(event, LaserScan):
                self._on_scan(event)
        for measurement in sorted(measurements, key=lambda m: (m.t, m.source)):
            self._take(measurement)
        self._take_scans(now)

    # -- wheels --------------------------------------------------------------------------------

    def _on_wheel(self, feedback: Feedback) -> list[Measurement]:
        if feedback.position is not None or feedback.velocity is not None:
            self._last[feedback.motor] = max(feedback.t, self._last.get(feedback.motor, feedback.t))
        if feedback.motor not in (self.body.left, self.body.right):
            return []
        travels, trouble = self._odometry.observe(feedback)
        if trouble:
            self._note(feedback.motor, trouble)
        return [self._travelled(travel) for travel in travels]

    def _travelled(self, travel: Travel) -> Measurement:
        distance, turn = self.body.forward(travel.left, travel.right)
        self.raw = arc(self.raw, distance, turn)
        dt = seconds(travel.t - travel.since)
        resolution = self.settings.odometry.resolution
        if self._moved_at is None or max(abs(travel.left), abs(travel.right)) > 2.0 * resolution:
            self._moved_at = travel.t
        if self._still(travel.t):
            noise = np.eye(2) * self.settings.wheels.still_sigma**2
            return wheels(self.body.left, travel.t, 0.0, 0.0, noise)
        noise = wheel_noise(self.body, travel, resolution, self.settings.wheels)
        return wheels(self.body.left, travel.t, distance / dt, turn / dt, noise)

    def _still(self, t: Nanos) -> bool:
        """Whether the base rests: the wheels have for a while, and the gyro tells nothing but its bias
        (if it does, somebody turns the base on its resting wheels)."""
        if self._moved_at is None or t - self._moved_at < self.settings.wheels.still_for:
            return False
        doubt = self.settings.gyro_sigma**2 + float(self._ekf.covariance[BIAS, BIAS])
        return self._gyro is None or abs(self._rate - self.gyro_bias) < 4.0 * math.sqrt(doubt)

    # -- gyro ----------------------------------------------------------------------------------

    def _on_imu(self, imu: Imu) -> list[Measurement]:
        upright = self._upright.get(imu.sensor)
        if upright is None:
            return []
        self._gyro = self._gyro or imu.sensor
        if imu.sensor != self._gyro:
            self._note(imu.sensor, "not used beside another gyro")
            return []
        self._last[imu.sensor] = max(imu.t, self._last.get(imu.sensor, imu.t))
        rate = sum(a * b for a, b in zip(upright, imu.angular_velocity, strict=True))
        if math.isfinite(rate):
            self._rate = rate
        kind = resting if self._still(imu.t) else gyro
        return [kind(imu.sensor, imu.t, rate, self.settings.gyro_sigma)]

    def _take(self, measurement: Measurement) -> Verdict:
        verdict = self._ekf.observe(measurement)
        if verdict is not Verdict.ACCEPTED:
            both = (self.body.left, self.body.right)
            for name in both if measurement.source == self.body.left else (measurement.source,):
                self._note(name, verdict)
                if verdict is Verdict.REFUSED:
                    self.rejected[name] += 1
        return verdict

    # -- lidar ---------------------------------------------------------------------------------

    def _on_scan(self, scan: LaserScan) -> None:
        if scan.sensor not in self._mounts:
            return
        if not _sound(scan):
            self._note(scan.sensor, "not a scan")
        elif scan.t <= self._last.get(scan.sensor, scan.t - 1):
            self._note(scan.sensor, "out of order")
        else:
            self._last[scan.sensor] = scan.t
            self._scans.append(scan)

    def _take_scans(self, now: Nanos) -> None:
        while self._scans:
            scan = self._scans[0]
            reached = self._ekf.t is not None and self._moved_at is not None and self._ekf.t >= scan.t
            if not reached and now - scan.t < self.settings.scan_wait:
                return
            self._scans.popleft()
            if reached:
                self._take_scan(scan)
            else:
                self._note(scan.sensor, "no estimate for its time")

    def _take_scan(self, scan: LaserScan) -> None:
        known = self._ekf.at(scan.t)
        if known is None:
            self._note(scan.sensor, Verdict.LATE)
            return
        seen = sweep(scan, self._mounts[scan.sensor], self.settings.grid.farthest)
        if self.settings.matching and not self._matched(scan, seen, *known):
            return
        self.map.add(_pose((self._ekf.at(scan.t) or known)[0]), seen)

    def _matched(self, scan: LaserScan, seen: Sweep, state: Floats, covariance: Floats) -> bool:
        """Match a scan against the map and correct the filter; whether the scan may be drawn."""
        settings, name = self.settings.match, scan.sensor
        # While matches are refused, the wheels may spin on the spot: look as far as they went.
        spun = abs(float(state[V])) * self._ekf.refused_for(name, scan.t) / 2.0
        sigma = max(math.sqrt(max(covariance[X, X], covariance[Y, Y])), spun)
        found = match(self.map, seen, _pose(state), settings, sigma)
        if found is not None:
            self._misfit_since.pop(name, None)
            return self._take(located(name, scan.t, found.pose, found.noise)) is not Verdict.REFUSED
        if not misfits(self.map, seen, _pose(state), settings):
            self._misfit_since.pop(name, None)
            return True
        self._note(name, "does not fit the map")
        since = self._misfit_since.setdefault(name, scan.t)
        return scan.t - since >= self.settings.redraw

    def _note(self, name: str, reason: str) -> None:
        reasons = self.ledger[name]
        reasons[str(reason)] = reasons.get(str(reason), 0) + 1


def wheel_noise(body: Differential, travel: Travel, resolution: float, settings: WheelSettings) -> Floats:
    """Covariance (2 × 2) of the treads' speed and the base's rate of turn over one travel.

    Each end of each wheel's way is rounded to a count (variance resolution² / 12) and stamped with
    jitter; each wheel may slip by itself in proportion to its way, for longer than one travel lasts,
    hence the factor 2 τ / dt of an error with correlation time τ. That part is given to the turn
    alone: what both wheels slip in common is the filter's slip state."""
    dt = seconds(travel.t - travel.since)
    rounding = 2.0 * resolution**2 / 12.0
    uneven = 2.0 * (settings.jitter / dt) ** 2
    radius = body.wheel_radius
    left, right = (radius**2 * (rounding + uneven * way**2) for way in (travel.left, travel.right))
    slips = (settings.turn_slip * radius) ** 2 * (travel.left**2 + travel.right**2)
    slips *= max(1.0, 2.0 * settings.slip_lasts / dt)
    linear = (left + right) / 4.0
    cross = (right - left) / (2.0 * body.wheel_separation)
    angular = (left + right + slips) / body.wheel_separation**2
    return np.array([[linear, cross], [cross, angular]]) / dt**2


def _pose(state: Floats) -> Pose:
    return Pose(float(state[X]), float(state[Y]), float(state[YAW]))


def _sound(scan: LaserScan) -> bool:
    numbers = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    if not all(math.isfinite(number) for number in numbers) or not scan.ranges:
        return False
    turn = scan.angle_increment * (len(scan.ranges) - 1)
    return scan.range_max > 0.0 and scan.angle_increment > 0.0 and turn < 2.0 * math.pi + 1e-6
