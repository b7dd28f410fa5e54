"""Perception: from the body's events to estimate and map.

Rules. Every event is processed once, in order of arrival; each measurement applies at its own time. Wheels
and gyro drive the filter. A scan waits until the filter has reached its time; it is matched against the map
from the filter's pose then, the match corrects the filter, and the scan is added to the map at the corrected
pose. A scan whose match the gate rejects, or that contradicts the map, is not added: a wrong pose would
corrupt the map. Nothing here knows the time of day, the goal, or the true pose. What is not used is counted
in `anomalies`, by name and reason.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Estimate, Floats, Pose
from brain.bodies.differential import Differential, arc
from brain.checks import within
from brain.perception.ekf import Ekf, Nis
from brain.perception.ekf_settings import EkfSettings
from brain.perception.grid import Grid, GridSettings
from brain.perception.measurement import GateResult, Measurement, gyro, gyro_at_rest, pose_fix, wheels
from brain.perception.motion_check import Contradiction, MotionCheck
from brain.perception.motion_model import BIAS, POSE, SLIP, YAW, V, W, X, Y
from brain.perception.mount import BodyScan, Mount, to_body
from brain.perception.odometry import JUMPED, Odometry, OdometrySettings, Travel
from brain.perception.scan_match import MatchSettings, contradicts_map, match
from protocols.messages import MILLISECOND, SECOND, Event, Feedback, Imu, LaserScan, Nanos, seconds


@dataclass(frozen=True, slots=True)
class WheelSettings:
    """Error model of wheel odometry, and detection of rest."""

    jitter: float = 1e-4
    """s: jitter of the time stamps"""
    turn_slip: float = 0.03
    """Share of each wheel's travel that it may slip by itself, and so turn the base"""
    slip_lasts: float = 1.0
    """s: correlation time of slip: its errors do not average out from sample to sample"""
    still_for: Nanos = 300 * MILLISECOND
    """The base is at rest if the wheels have been for this time, and the gyro agrees."""
    still_sigma: float = 1e-3
    """m/s and rad/s: standard deviation of the twist at rest"""

    def __post_init__(self) -> None:
        within(
            self,
            jitter=(0.0, 0.1, "s"),
            turn_slip=(0.0, 1.0),
            slip_lasts=(0.0, 600.0, "s"),
            still_for=(0.0, 10_000.0),
            still_sigma=(1e-6, 1.0),
        )


@dataclass(frozen=True, slots=True)
class PerceptionSettings:
    """All settings of perception."""

    ekf: EkfSettings = field(default_factory=EkfSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    wheels: WheelSettings = field(default_factory=WheelSettings)
    gyro_sigma: float = 0.01
    """rad/s: standard deviation of one reading"""
    grid: GridSettings = field(default_factory=GridSettings)
    match: MatchSettings = field(default_factory=MatchSettings)
    matching: bool = True
    """Match scans against the map; if not, they are only added to it."""
    scan_wait: Nanos = 500 * MILLISECOND
    """Time that a scan waits for the wheels and the gyro."""
    least_returns: float = 0.15
    """A scan with returns from less than this share of its rays counts as none. 0: in open ground, where no
    return is to be expected; such a scan is no proof of free space, either, and is not added to the map."""
    redraw: Nanos = 2000 * MILLISECOND
    """Scans that have contradicted the map for this time are added: the place has changed."""

    def __post_init__(self) -> None:
        within(
            self,
            gyro_sigma=(1e-6, 1.0, "rad/s"),
            scan_wait=(0.0, 1000.0),
            redraw=(0.0, 60_000.0),
            least_returns=(0.0, 1.0),
        )
        grid, match = self.grid, self.match
        window = 2 * math.ceil(match.widest / grid.resolution) + 1
        if match.beams * window**2 > MAX_MATCH_CELLS:
            text = f"{match.beams} beams, each with {window} × {window} cells about it"
            raise ValueError(f"match: {text}; expected at most {MAX_MATCH_CELLS} cells in all")
        if window * grid.resolution > min(grid.width, grid.height):
            raise ValueError(f"match: widest must be less than half the map, not {match.widest:g}")


CONSTANT = "every value is as before: it does not measure"
CONSTANT_COUNT, CONSTANT_FOR = 20, 200 * MILLISECOND
"""An IMU measures nothing if so many readings over that time equal each other in all six numbers: noise alone
changes the last digit of one of them. A scan does if it equals the one before."""
MISFIT_FOR: Nanos = 300 * MILLISECOND
"""Scans that contradict the map for this time are a contradiction."""
MAX_MATCH_CELLS = 200_000
"""Cells of the map that one step of matching a scan examines."""


class Perception:
    """Estimate and map. Plain data: a deep copy continues exactly as the original."""

    def __init__(self, body: Differential, mounts: Mapping[str, Mount], settings: PerceptionSettings) -> None:
        self.body = body
        self.settings = settings
        self.map = Grid(settings.grid)
        self.raw = Pose(settings.ekf.start_x, settings.ekf.start_y, settings.ekf.start_yaw)
        """Dead reckoning by the wheels alone, for comparison."""
        self.rejected: dict[str, int] = dict.fromkeys((body.left, body.right, *mounts), 0)
        """Number of measurements rejected by the chi-square gate, by motor or sensor."""
        self.anomalies: dict[str, dict[str, int]] = {name: {} for name in self.rejected}
        """Number of measurements not used, or used against the gate, by motor or sensor, then by reason."""
        self._mounts = dict(mounts)
        self._vertical = {name: mount.rotation()[2] for name, mount in mounts.items()}
        self._ekf = Ekf(settings.ekf)
        self._odometry = Odometry(body, settings.odometry)
        self.absent: dict[str, str] = {}
        """Why the newest reading of a sensor shows nothing, by sensor; it counts as none."""
        self._last_scan: dict[str, tuple[Nanos, Floats]] = {}
        """Time and ranges of the newest scan."""
        self._last_imu: dict[str, tuple[Imu, int]] = {}
        """First reading of a row of equal ones, and how many they are."""
        self._scans: deque[LaserScan] = deque()
        self._moved_at: Nanos | None = None
        self._misfit_since: dict[str, Nanos] = {}
        self._check = MotionCheck(body, settings.wheels.turn_slip)
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
        """Estimated gyro bias [rad/s]."""
        return float(self._ekf.state[BIAS])

    @property
    def slip(self) -> float:
        """Estimated slip: the share of the wheels' travel that the base does not move."""
        return float(self._ekf.state[SLIP])

    @property
    def nis(self) -> Mapping[str, Nis]:
        """Normalised innovations squared: by sensor, and of both wheels by the left one's name."""
        return self._ekf.nis

    def contradictions(self) -> list[Contradiction]:
        """Return what the sources show that cannot all be true."""
        return self._check.contradictions() + [
            Contradiction(f"{name}: its scans do not fit the map")
            for name, since in self._misfit_since.items()
            if self._last_scan[name][0] - since >= MISFIT_FOR
        ]

    def observe(self, now: Nanos, events: Sequence[Event]) -> None:
        """Process the events since the last call, in order of arrival."""
        measurements: list[Measurement] = []
        for event in events:
            if isinstance(event, Feedback):
                measurements += self._on_wheel(event)
            elif isinstance(event, Imu):
                measurements += self._on_imu(event)
            elif isinstance(event, LaserScan):
                self._on_scan(event)
        for measurement in sorted(measurements, key=lambda m: (m.t, m.source)):
            self._update(measurement)
        self._process_scans(now)

    # -- wheels --------------------------------------------------------------------------------

    def _on_wheel(self, feedback: Feedback) -> list[Measurement]:
        if feedback.motor not in (self.body.left, self.body.right):
            return []
        travels, defect = self._odometry.observe(feedback)
        if defect:
            self._count(feedback.motor, defect)
        if defect == JUMPED:
            moved_at = -SECOND if self._moved_at is None else self._moved_at
            self._check.on_jump(feedback.motor, feedback.t - moved_at < self.settings.wheels.still_for)
        return [self._wheel_measurement(travel) for travel in travels]

    def _wheel_measurement(self, travel: Travel) -> Measurement:
        distance, turn = self.body.forward(travel.left, travel.right)
        self._check.on_wheels(travel.since, travel.t, travel.left, travel.right)
        self.raw = arc(self.raw, distance, turn)
        dt = seconds(travel.t - travel.since)
        resolution = self.settings.odometry.resolution
        if self._moved_at is None or max(abs(travel.left), abs(travel.right)) > 2.0 * resolution:
            self._moved_at = travel.t
        if self._at_rest(travel.t):
            noise = np.eye(2) * self.settings.wheels.still_sigma**2
            return wheels(self.body.left, travel.t, 0.0, 0.0, noise)
        noise = wheel_noise(self.body, travel, resolution, self.settings.wheels)
        return wheels(self.body.left, travel.t, distance / dt, turn / dt, noise)

    def _at_rest(self, t: Nanos) -> bool:
        """True if the base rests: the wheels have for a while, and the gyro reads only its bias (else the
        base is being turned on its resting wheels)."""
        if self._moved_at is None or t - self._moved_at < self.settings.wheels.still_for:
            return False
        sigma = math.hypot(self.settings.gyro_sigma, self._bias_sigma())
        return self._gyro is None or abs(self._rate - self.gyro_bias) < 4.0 * sigma

    def _bias_sigma(self) -> float:
        return math.sqrt(float(self._ekf.covariance[BIAS, BIAS]))

    # -- gyro ----------------------------------------------------------------------------------

    def _on_imu(self, imu: Imu) -> list[Measurement]:
        vertical = self._vertical.get(imu.sensor)
        if vertical is None:
            return []
        self._gyro = self._gyro or imu.sensor
        if self._is_constant(imu):
            return []
        if imu.sensor != self._gyro:
            self._count(imu.sensor, "not used beside another gyro")
            return []
        rate = sum(a * b for a, b in zip(vertical, imu.angular_velocity, strict=True))
        if math.isfinite(rate):
            self._rate = rate
            self._check.on_gyro(imu.sensor, imu.t, rate - self.gyro_bias, self._bias_sigma())
        measurement = gyro_at_rest if self._at_rest(imu.t) else gyro
        return [measurement(imu.sensor, imu.t, rate, self.settings.gyro_sigma)]

    def _is_constant(self, imu: Imu) -> bool:
        first, count = self._last_imu.get(imu.sensor, (imu, 0))
        if (imu.angular_velocity, imu.linear_acceleration) != (
            first.angular_velocity,
            first.linear_acceleration,
        ):
            first, count = imu, 0
        self._last_imu[imu.sensor] = first, count + 1
        constant = count + 1 >= CONSTANT_COUNT and imu.t - first.t >= CONSTANT_FOR
        self._set_absent(imu.sensor, CONSTANT if constant else "")
        return constant

    def _update(self, measurement: Measurement) -> GateResult:
        result = self._ekf.observe(measurement)
        if result is not GateResult.ACCEPTED:
            both = (self.body.left, self.body.right)
            for name in both if measurement.source == self.body.left else (measurement.source,):
                self._count(name, result)
                if result is GateResult.REJECTED:
                    self.rejected[name] += 1
        return result

    # -- lidar ---------------------------------------------------------------------------------

    def _on_scan(self, scan: LaserScan) -> None:
        if scan.sensor not in self._mounts:
            return
        last = self._last_scan.get(scan.sensor)
        if not _is_valid(scan):
            self._count(scan.sensor, "not a scan")
        elif last is not None and scan.t <= last[0]:
            self._count(scan.sensor, "out of order")
        else:
            ranges = np.asarray(scan.ranges, dtype=np.float64)
            self._last_scan[scan.sensor] = scan.t, ranges
            returns = int(np.count_nonzero((scan.range_min <= ranges) & (ranges < scan.range_max)))
            few = returns < self.settings.least_returns * len(ranges)
            reason = f"{returns} of {len(ranges)} rays have returns" if few else ""
            if returns and last is not None and np.array_equal(ranges, last[1], equal_nan=True):
                reason = CONSTANT
            self._set_absent(scan.sensor, reason)
            if returns and not reason:
                self._scans.append(scan)
            if len(self._scans) > SCANS_WAITING:
                self._count(self._scans.popleft().sensor, "too many are waiting")

    def _set_absent(self, name: str, reason: str) -> None:
        if reason:
            self.absent[name] = reason
            self._count(name, "too few returns" if reason != CONSTANT else CONSTANT)
        else:
            self.absent.pop(name, None)

    def _process_scans(self, now: Nanos) -> None:
        for _ in range(min(len(self._scans), SCANS_PER_STEP)):
            scan = self._scans[0]
            reached = self._ekf.t is not None and self._moved_at is not None and self._ekf.t >= scan.t
            if not reached and now - scan.t < self.settings.scan_wait:
                return
            self._scans.popleft()
            if reached:
                self._process_scan(scan)
            else:
                self._count(scan.sensor, "no estimate for its time")

    def _process_scan(self, scan: LaserScan) -> None:
        predicted = self._ekf.at(scan.t)
        if predicted is None:
            self._count(scan.sensor, GateResult.LATE)
            return
        body_scan = to_body(scan, self._mounts[scan.sensor], self.settings.grid.farthest)
        self._check.on_scan(scan.sensor, scan.t, body_scan)
        if self.settings.matching and not self._matched(scan, body_scan, *predicted):
            return
        self.map.add(_pose((self._ekf.at(scan.t) or predicted)[0]), body_scan)

    def _matched(self, scan: LaserScan, body_scan: BodyScan, state: Floats, covariance: Floats) -> bool:
        """Match a scan against the map and correct the filter; return True if it may be added to the map."""
        settings, name = self.settings.match, scan.sensor
        # While matches are rejected, the wheels may spin on the spot: search as far as they went.
        spun = abs(float(state[V])) * self._ekf.rejected_for(name, scan.t) / 2.0
        sigma = max(math.sqrt(max(covariance[X, X], covariance[Y, Y])), spun)
        found = match(self.map, body_scan, _pose(state), settings, sigma)
        if found is not None:
            self._misfit_since.pop(name, None)
            return self._update(pose_fix(name, scan.t, found.pose, found.noise)) is not GateResult.REJECTED
        if not contradicts_map(self.map, body_scan, _pose(state), settings):
            self._misfit_since.pop(name, None)
            return True
        self._count(name, "does not fit the map")
        since = self._misfit_since.setdefault(name, scan.t)
        return scan.t - since >= self.settings.redraw

    def _count(self, name: str, reason: str) -> None:
        reasons = self.anomalies[name]
        reasons[str(reason)] = reasons.get(str(reason), 0) + 1


def wheel_noise(body: Differential, travel: Travel, resolution: float, settings: WheelSettings) -> Floats:
    """Return the covariance (2 × 2) of the tread speed and the base's yaw rate over one travel.

    Each end of each wheel's travel is rounded to a count (variance resolution² / 12) and stamped with
    jitter; each wheel may slip by itself in proportion to its travel, for longer than one travel lasts,
    hence the factor 2 τ / dt of an error with correlation time τ. That part is given to the turn
    alone: common slip of both wheels is the filter's slip state."""
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


MAX_BEAMS = 10_000
"""Of a scan."""
SCANS_PER_STEP, SCANS_WAITING = 4, 32
"""Most scans that a step processes, and that wait for the next ones."""


def _is_valid(scan: LaserScan) -> bool:
    """True if a scan is what a planar lidar can send: everything else in it would be work, or overflow."""
    count, turn = len(scan.ranges), scan.angle_increment * (len(scan.ranges) - 1)
    return (
        0 < count <= MAX_BEAMS
        and 1e-5 <= scan.angle_increment <= 2.0 * math.pi
        and turn < 2.0 * math.pi + 1e-6
        and abs(scan.angle_min) <= 4.0 * math.pi
        and abs(scan.range_min) <= 1e3
        and 0.0 < scan.range_max <= 1e4
    )
