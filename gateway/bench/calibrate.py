"""Calibration of a base: how far its wheels roll, how it turns, where its lidars are, what is late.

Rules. The scans of a lidar give its path without anybody's help (`scan_path`); the wheels, each factor and
the lidar's place unknown, must give the same between any two moments (least squares; Censi et al. 2013,
"Simultaneous calibration of odometry and sensor parameters for mobile robots"). What is found then predicts
the sweep of each scan, and all is done anew until nothing changes: sweeps freed with the speed of the scans
before lag where it rises, which made ways 3 % too long, and still 0.4 % the second time. A gyro is compared
with the turns of the scans. Standard deviations are taken from how the residuals scatter, neighbours together
(Newey and West 1987): wheels that slip count by what they did. What the drive did not show is not told: each
figure has a largest deviation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.bodies.plane import wrap
from brain.perception.mount import Mount
from gateway.bench.driven import Driven, Events
from gateway.bench.scan_path import Predict, ScanPath
from gateway.bench.scatter import covariance
from gateway.bench.wheel_path import Factors, WheelPath, after, seen_from
from gateway.errors import UserError
from protocols.messages import SECOND, Event, Feedback, Imu, LaserScan, Nanos

STEP = 0.3, 0.3, 0.5
"""m, rad, s: after any of these a comparison ends"""
FEWEST = 12
"""Comparisons with motion, below which nothing is estimated"""
NOISE, NOISE_YAW = 0.003, 0.0015
"""m, rad: of a scan's pose, beside what its match says,"""
SLIP, SLIP_YAW = 0.02, 0.03
"""and of what wheels do, as a share of the motion: only the weight of a comparison"""
NEIGHBOURS = 6
"""Comparisons that may be wrong together"""
HEAVY = 3.0
"""Standard deviations from which on a comparison counts less (Huber)"""
PRIOR = np.array([1.0, 1.0, 0.3, 3.0, 0.5, 0.5, 0.2, 1.0])
"""Standard deviations about the stated values, where the drive shows nothing"""
STARTS = 8
"""Directions of the lidar from which the search begins"""
PASSES, SETTLED = 8, 0.1
"""Times that scans are placed anew at most; once no figure changes by more than so many of its standard
deviations, it is enough"""
FASTEST_RATE = 100.0
"""rad/s: no gyro of a base reads more"""


@dataclass(frozen=True, slots=True)
class Figure:
    """One value, its standard deviation, and what the robot file says."""

    name: str
    value: float
    sigma: float
    stated: float
    unit: str
    certain: float
    """Largest standard deviation with which it is told"""

    @property
    def known(self) -> bool:
        """Whether the drive has shown it."""
        return self.sigma < self.certain

    @property
    def differs(self) -> bool:
        """Whether it is certainly not as stated (3 standard deviations)."""
        return self.known and abs(self.value - self.stated) > 3.0 * self.sigma


@dataclass(slots=True)
class Measured:
    """What a drive has shown of joints and gyros. `take` gets its events in order."""

    body: Base
    mounts: Mapping[str, Mount]
    began: Nanos | None = None
    angles: dict[str, list[tuple[Nanos, float]]] = field(default_factory=dict)
    """rad, by joint"""
    rates: dict[str, list[tuple[Nanos, float]]] = field(default_factory=dict)
    """rad/s about the vertical, by sensor"""

    def take(self, event: Event) -> None:
        """Keep what an event says of the motion."""
        if isinstance(event, LaserScan | Feedback | Imu) and self.began is None:
            self.began = event.t
        if isinstance(event, Feedback) and event.motor in self.body.joints:
            if event.position is not None:
                _append(self.angles.setdefault(event.motor, []), event.t, event.position)
        elif isinstance(event, Imu) and event.sensor in self.mounts:
            row = self.mounts[event.sensor].rotation()[2]
            rate = sum(a * b for a, b in zip(row, event.angular_velocity, strict=True))
            if abs(rate) < FASTEST_RATE:
                _append(self.rates.setdefault(event.sensor, []), event.t, rate)

    def path(self) -> WheelPath:
        """Return the path of the wheels. Raises UserError if a joint was not heard."""
        silent = [name for name in self.body.joints if len(self.angles.get(name, ())) < 2]
        if silent:
            raise UserError(f"no angles of {', '.join(silent)}: nothing can be said of how its wheels roll")
        try:
            return WheelPath(self.body, self.angles, self.began or 0)
        except ValueError as error:
            raise UserError(f"{error}: were joints heard one after the other?") from error


def _append(samples: list[tuple[Nanos, float]], t: Nanos, value: float) -> None:
    if not samples or t > samples[-1][0]:
        samples.append((t, value))


@dataclass(frozen=True, slots=True)
class LidarFit:
    """What the scans of one lidar have shown."""

    sensor: str
    factors: Factors
    mount: Mount
    late: float
    """s: by so much scans are stamped later than the wheels"""
    covariance: Floats
    """Of distance, turn, veer, mount yaw, x, y, late (and sideways)"""
    path: ScanPath
    rms: float
    """Of the residuals, in standard deviations"""
    comparisons: int

    def sigma(self, index: int) -> float:
        """Return a standard deviation."""
        return math.sqrt(max(float(self.covariance[index, index]), 0.0))


@dataclass(frozen=True, slots=True)
class GyroFit:
    """What one gyro reads for each rad/s, at rest, and by how much its stamps are later than the wheels'."""

    sensor: str
    scale: float
    bias: float
    """rad/s"""
    late: float
    """s"""
    sigmas: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a drive has shown."""

    driven: Driven
    lidars: tuple[LidarFit, ...]
    """The one that the wheels were calibrated with first"""
    gyros: tuple[GyroFit, ...]
    mirrored: frozenset[str]
    """Lidars whose scans were mirrored here, since they turned to the other side than all else"""
    way: float
    """m, by the wheels as stated,"""
    turned: float
    """rad in both directions,"""
    seconds: float


def calibrate(driven: Driven) -> Calibration:
    """Calibrate a base by a drive. Raises UserError, in words, where it shows nothing."""
    body, mounts, events = driven.body, driven.mounts, driven.events
    measured = Measured(body, mounts)
    lidars: set[str] = set()
    for event in events():
        measured.take(event)
        if isinstance(event, LaserScan) and event.sensor in mounts:
            lidars.add(event.sensor)
    wheels, began = measured.path(), measured.began or 0
    if not lidars:
        raise UserError("no scans of a lidar that the robot file has: what wheels roll is compared with them")
    seen = {name: mounts[name] for name in lidars}
    paths = _paths(seen, began, events, wheels, {})
    mirrored = frozenset(name for name, one in paths.items() if _is_mirrored(one, wheels, measured))
    if mirrored:
        seen |= {name: replace(seen[name], roll=wrap(seen[name].roll + math.pi)) for name in mirrored}
        paths |= _paths({name: seen[name] for name in mirrored}, began, events, wheels, {})
    fits = {name: _fit(name, wheels, path, seen[name], None) for name, path in paths.items()}  # scans alone
    moving = seen
    for _ in range(PASSES):
        before = fits
        paths = _paths(moving, began, events, wheels, fits)
        fits = fits | {name: _fit(name, wheels, path, seen[name], fits[name]) for name, path in paths.items()}
        moving = {name: seen[name] for name in moving if _change(before[name], fits[name]) > SETTLED}
        if not moving:
            break
    order = sorted(fits.values(), key=lambda one: one.sigma(0))
    gyros = [_gyro(name, rates, began, order[0]) for name, rates in measured.rates.items() if len(rates) > 20]
    ways = wheels.travelled(wheels.t[[-1]])[0]
    turned = float(np.abs(wheels.steps[:, 1]).sum())
    span = float(wheels.t[-1] - wheels.t[0])
    known = tuple(one for one in gyros if one)
    return Calibration(driven, tuple(order), known, mirrored, float(ways[3]), turned, span)


def _paths(
    mounts: Mapping[str, Mount],
    began: Nanos,
    events: Events,
    wheels: WheelPath,
    fits: Mapping[str, LidarFit],
) -> dict[str, ScanPath]:
    """Return the path of each lidar."""
    paths = {
        name: ScanPath(mount, began, _predictor(wheels, fits.get(name))) for name, mount in mounts.items()
    }
    for event in events():
        if isinstance(event, LaserScan) and event.sensor in paths:
            paths[event.sensor].take(event)
    return paths


def _is_mirrored(path: ScanPath, wheels: WheelPath, measured: Measured) -> bool:
    """Whether scans turn to the other side than the wheels, and than a gyro if there is one."""
    pairs = _compared(path, wheels)
    shown = pairs.motion[:, 2]
    by_wheels = wheels.travelled(pairs.until)[:, 1] - wheels.travelled(pairs.since)[:, 1]
    against = [float(by_wheels @ shown)]
    for rates in measured.rates.values():
        t, angle = _integrated(rates, measured.began or 0)
        turned = np.interp(pairs.until, t, angle) - np.interp(pairs.since, t, angle)
        against.append(float(turned @ shown))
    return all(one < 0.0 for one in against)


def _integrated(rates: Sequence[tuple[Nanos, float]], began: Nanos) -> tuple[Floats, Floats]:
    """Return times [s] and the integral of a gyro up to them [rad]."""
    series = np.array(rates, dtype=np.float64)
    t = (series[:, 0] - began) / SECOND
    angle = np.cumsum(np.diff(t) * (series[1:, 1] + series[:-1, 1]) / 2.0)
    return t, np.concatenate([[0.0], angle])


# -- wheels and one lidar ---------------------------------------------------------------------------


def _predictor(wheels: WheelPath, fit: LidarFit | None) -> Predict | None:
    """Return where wheels that are calibrated say that a lidar is."""
    if fit is None:
        return None
    path, mount = wheels.cumulative(fit.factors), np.array([fit.mount.x, fit.mount.y, fit.mount.yaw])

    def predict(times: Floats, end: float) -> Floats | None:
        at = np.append(times, end) - fit.late
        if at.min() < wheels.t[0] or at.max() > wheels.t[-1]:
            return None
        robot = np.column_stack([np.interp(at, wheels.t, column) for column in path.T])
        lidar = after(robot, np.broadcast_to(mount, robot.shape))
        return seen_from(lidar[-1], lidar[:-1])

    return predict


@dataclass(frozen=True, slots=True)
class _Comparisons:
    """Pairs of scans, and the motion of the lidar between them."""

    since: Floats
    until: Floats
    motion: Floats
    """n × 3"""
    whitening: Floats
    """n × 3 × 3"""


def _fit(sensor: str, wheels: WheelPath, path: ScanPath, stated: Mount, before: LidarFit | None) -> LidarFit:
    pairs = _compared(path, wheels)
    any_way = bool(np.any(wheels.steps[:, 2]))
    centre = np.array([1.0, 1.0, 0.0, stated.yaw, stated.x, stated.y, 0.0, 1.0])[: 8 if any_way else 7]
    starts = [_vector(before)] if before is not None else _starts(wheels, pairs, centre)
    best: tuple[float, Floats, Floats, Floats] | None = None
    for start in starts:
        found = _solve(wheels, pairs, start[: len(centre)], centre)
        if best is None or found[0] < best[0]:
            best = found
    assert best is not None, "there is a start"
    _, x, spread, residuals = best
    ahead = x[0] > 0.0 if x[1] > 0.0 else abs(wrap(x[3] - stated.yaw)) < math.pi / 2.0
    if not ahead:  # forward is backward: a lidar that looks the other way shows the same
        flipped = np.ones(len(x))
        flipped[[0, 2, 4, 5, *range(7, len(x))]] = -1.0
        x, spread = flipped * x, spread * np.outer(flipped, flipped)
        x[3] += math.pi
    factors = Factors(*(float(value) for value in (*x[:3], *x[7:])))
    mount = replace(stated, yaw=wrap(float(x[3])), x=float(x[4]), y=float(x[5]))
    rms = float(np.sqrt(np.mean(residuals**2)))
    return LidarFit(sensor, factors, mount, float(x[6]), spread, path, rms, len(pairs.since))


def _compared(path: ScanPath, wheels: WheelPath) -> _Comparisons:
    """Return the comparisons of a path: each ends where the last has, and begins anew with a new part."""
    t, poses, noises = np.array(path.t), np.array(path.poses).reshape(-1, 3), path.noises
    since: list[int] = []
    until: list[int] = []
    first = 0
    inside = (t >= wheels.t[0]) & (t <= wheels.t[-1])
    for i in range(1, len(t)):
        if path.parts[i] != path.parts[first] or not inside[first]:
            first = i
            continue
        far = math.dist(poses[i][:2], poses[first][:2]) >= STEP[0]
        if (far or abs(poses[i][2] - poses[first][2]) >= STEP[1] or t[i] - t[first] >= STEP[2]) and inside[i]:
            since.append(first)
            until.append(i)
            first = i
    motion = seen_from(poses[since], poses[until]) if since else np.zeros((0, 3))
    moved = np.hypot(motion[:, 0], motion[:, 1]) + np.abs(motion[:, 2])
    if np.count_nonzero(moved > 0.05) < FEWEST:
        raise UserError(
            f"{path.taken} scans, {len(t)} of them placed, show {np.count_nonzero(moved > 0.05)} motions: "
            f"at least {FEWEST} are needed; drive longer, where the lidar sees walls"
        )
    whitening = np.empty((len(since), 3, 3))
    for k, (i, j) in enumerate(zip(since, until, strict=True)):
        c, s = math.cos(poses[i][2]), math.sin(poses[i][2])
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        way, angle = math.hypot(*motion[k, :2]), abs(motion[k, 2])
        own = np.array([NOISE**2 + (SLIP * way) ** 2] * 2 + [NOISE_YAW**2 + (SLIP_YAW * angle) ** 2])
        noise = turn @ (noises[i] + noises[j]) @ turn.T + np.diag(own)
        whitening[k] = np.linalg.inv(np.linalg.cholesky(noise))
    return _Comparisons(t[since], t[until], motion, whitening)


def _vector(fit: LidarFit) -> Floats:
    factors, mount = fit.factors, fit.mount
    first = [factors.distance, factors.turn, factors.veer, mount.yaw, mount.x, mount.y, fit.late]
    return np.array([*first, factors.sideways])


def _change(before: LidarFit, fit: LidarFit) -> float:
    """Return the largest change of a figure, in its standard deviations."""
    off = np.abs(_less(_vector(fit), _vector(before)))[: len(fit.covariance)]
    sigmas = np.array([max(fit.sigma(index), 1e-9) for index in range(len(off))])
    return float((off / sigmas).max())


def _starts(wheels: WheelPath, pairs: _Comparisons, centre: Floats) -> list[Floats]:
    """Return where to begin: what ways and turns say by themselves, the lidar looking anywhere."""
    shown = wheels.travelled(pairs.until) - wheels.travelled(pairs.since)
    by_way = np.linalg.lstsq(shown[:, :2], pairs.motion[:, 2], rcond=None)[0]
    far = float(np.hypot(pairs.motion[:, 0], pairs.motion[:, 1]).sum()) / max(float(shown[:, 3].sum()), 1e-9)
    starts = []
    for number in range(STARTS):
        start = centre.copy()
        start[:4] = min(far, 10.0), by_way[1], by_way[0], centre[3] + 2.0 * math.pi * number / STARTS
        starts.append(start)
    return starts


def _solve(
    wheels: WheelPath, pairs: _Comparisons, start: Floats, centre: Floats
) -> tuple[float, Floats, Floats, Floats]:
    """Return cost, solution, covariance and residuals (n × 3, whitened)."""
    from scipy.optimize import least_squares

    prior = PRIOR[: len(centre)]

    def residuals(x: Floats) -> Floats:
        factors = Factors(*x[:3], *x[7:])
        ends = wheels.poses(factors, np.concatenate([pairs.since, pairs.until]) - x[6])
        lidar = after(ends, np.broadcast_to(x[3:6][[1, 2, 0]], ends.shape))
        half = len(pairs.since)
        off = seen_from(lidar[:half], lidar[half:]) - pairs.motion
        found: Floats = np.einsum("kij,kj->ki", pairs.whitening, off)
        return found

    x = start
    weight = np.ones(len(pairs.since))
    for _ in range(4):
        root = np.sqrt(weight)[:, None]

        def weighted(x: Floats, root: Floats = root) -> Floats:
            return np.concatenate([(root * residuals(x)).ravel(), _less(x, centre) / prior])

        found = least_squares(weighted, x, x_scale=prior, diff_step=1e-6, max_nfev=60)
        x = found.x
        off = residuals(x)
        size = np.sqrt((off**2).sum(axis=1) / 3.0)
        scale = max(float(np.median(size)), 1e-9)
        weight = np.minimum(1.0, HEAVY * scale / np.maximum(size, 1e-12))
    jacobian = found.jac[: 3 * len(off)].reshape(len(off), 3, -1)
    spread = _scattered(jacobian, np.sqrt(weight)[:, None] * off, prior)
    return float((np.minimum(size, HEAVY * scale) ** 2).sum()), x, spread, off


def _less(x: Floats, centre: Floats) -> Floats:
    off = x - centre
    off[3] = wrap(float(off[3]))
    return off


def _scattered(jacobian: Floats, off: Floats, prior: Floats) -> Floats:
    """Return the covariance of a solution; `jacobian`: n × m × parameters; `off`: n × m, whitened."""
    pull = np.einsum("kmi,km->ki", jacobian, off)
    inverse = np.linalg.inv(np.einsum("kmi,kmj->ij", jacobian, jacobian) + np.diag(1.0 / prior**2))
    found: Floats = covariance(pull, inverse, NEIGHBOURS) * (off.size / max(off.size - len(prior), 1))
    return found


# -- gyro --------------------------------------------------------------------------------------------


def _gyro(name: str, rates: Sequence[tuple[Nanos, float]], began: Nanos, lidar: LidarFit) -> GyroFit | None:
    """Compare a gyro with the turns that scans show; None if they have too little in common."""
    from scipy.optimize import least_squares

    t, angle = _integrated(rates, began)
    path = lidar.path
    at, yaw = np.array(path.t), np.array(path.poses)[:, 2]
    since: list[int] = []
    until: list[int] = []
    first = 0
    for i in range(1, len(at)):
        if path.parts[i] != path.parts[first]:
            first = i
        elif (at[i] - at[first] >= STEP[2] or abs(yaw[i] - yaw[first]) > STEP[1]) and at[first] > t[0] + 0.3:
            if at[i] < t[-1] - 0.3:
                since.append(first)
                until.append(i)
            first = i
        elif at[first] <= t[0] + 0.3:
            first = i
    if len(since) < FEWEST:
        return None
    start, end, turned = at[since], at[until], yaw[until] - yaw[since]
    spread = np.hypot(NOISE_YAW, 0.002 * np.abs(turned))
    prior = np.array([1.0, 0.5, 0.2])

    def residuals(x: Floats) -> Floats:
        read = np.interp(end + x[2], t, angle) - np.interp(start + x[2], t, angle)
        found: Floats = (read - x[0] * turned - x[1] * (end - start)) / spread
        return found

    def weighted(x: Floats) -> Floats:
        return np.concatenate([residuals(x), (x - np.array([1.0, 0.0, 0.0])) / prior])

    slope = float(np.sign(np.dot(np.interp(end, t, angle) - np.interp(start, t, angle), turned)) or 1.0)
    found = least_squares(
        weighted, np.array([slope, 0.0, 0.0]), x_scale=prior, diff_step=1e-6, loss="soft_l1"
    )
    off = residuals(found.x)
    jacobian = found.jac[: len(off)].reshape(len(off), 1, 3)
    spread = _scattered(jacobian, off[:, None] / np.sqrt(1.0 + off[:, None] ** 2), prior)
    scale, bias, late = found.x.tolist()
    sigmas = np.sqrt(np.diag(spread))
    return GyroFit(
        name,
        scale,
        bias,
        late + lidar.late,
        (float(sigmas[0]), float(sigmas[1]), math.hypot(float(sigmas[2]), lidar.sigma(6))),
    )
