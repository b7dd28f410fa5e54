"""What a calibration means: figures beside what is stated, gross errors by name, the lines to write."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from brain.bodies.plane import wrap
from gateway.bench.calibrate import Calibration, Figure, LidarFit
from gateway.bench.geometry import corrected
from gateway.bench.wheel_path import Factors
from protocols.messages import MILLISECOND

GROSS, SKEWED, LATE = 1.15, math.radians(30.0), 0.04
"""Factor on the wheels' motion, rad of a lidar, and s of stamps, from which on an error is named"""
FLOOR_LATE, FLOOR_SCALE, FLOOR_YAW, FLOOR_PLACE = 0.003, 0.002, math.radians(0.1), 0.002
"""s, share, rad, m,"""
FLOOR_LENGTH, FLOOR_VEER, FLOOR_BIAS = 0.0007, 0.008, 3e-4
"""share, rad/m, rad/s: what no drive shows better, whatever the scatter says: measured on drives whose truth
is known (stamps are whole ticks, scans are matched in steps, slip lasts, a bias walks)"""
CERTAIN = {"m": 0.02, "rad": math.radians(2.0), "ms": 10.0, "%": 2.0, "rad/s": 0.01, "rad/m": 0.1}
"""Largest standard deviation with which a figure is told, by its unit; lengths of wheels as shares of them"""


def figures(made: Calibration) -> list[Figure]:
    """Return what was found: of the wheels, each lidar, each gyro."""
    return [*_wheels(made), *_lidars(made), *_gyros(made)]


def _wheels(made: Calibration) -> list[Figure]:
    fit, body = made.lidars[0], made.driven.body
    factors = fit.factors
    found: list[Figure] = []
    numbers = {} if made.driven.by_odometry else corrected(body, factors)
    step = 1e-4
    more = [
        corrected(body, factors._replace(distance=factors.distance * (1.0 + step))),
        corrected(body, factors._replace(turn=factors.turn * (1.0 + step))),
    ]
    relative = np.diag([1.0 / factors.distance, 1.0 / factors.turn])
    covariance = relative @ fit.covariance[:2, :2] @ relative
    for key, value in numbers.items():
        slopes = np.array([(one.get(key, value) - value) / step for one in more])
        sigma = math.sqrt(max(float(slopes @ covariance @ slopes), 0.0))
        sigma = math.hypot(sigma, FLOOR_LENGTH * value)
        found.append(Figure(key, value, sigma, getattr(body, key), "m", 0.02 * value))
    if not numbers:
        source = "the odometry" if made.driven.by_odometry else "the joints"
        for name, index in (("way", 0), ("turn", 1)):
            value = 100.0 * factors[index]
            found.append(
                Figure(f"{name}, of what {source} says", value, 100.0 * fit.sigma(index), 100.0, "%", 2.0)
            )
    if body.moves_sideways and len(fit.covariance) > 7:
        value, sigma = 100.0 * factors.sideways, 100.0 * fit.sigma(7)
        found.append(Figure("sideways of what the wheels say", value, sigma, 100.0, "%", 2.0))
    found.append(
        Figure("veer", factors.veer, math.hypot(fit.sigma(2), FLOOR_VEER), 0.0, "rad/m", CERTAIN["rad/m"])
    )
    return found


def _lidars(made: Calibration) -> list[Figure]:
    found: list[Figure] = []
    for fit in made.lidars:
        stated = made.driven.mounts[fit.sensor]
        yaw = stated.yaw + wrap(fit.mount.yaw - stated.yaw)
        rows = (
            ("yaw", yaw, math.hypot(fit.sigma(3), FLOOR_YAW), stated.yaw, "rad"),
            ("x", fit.mount.x, math.hypot(fit.sigma(4), FLOOR_PLACE), stated.x, "m"),
            ("y", fit.mount.y, math.hypot(fit.sigma(5), FLOOR_PLACE), stated.y, "m"),
            ("late", 1e3 * fit.late, 1e3 * math.hypot(fit.sigma(6), FLOOR_LATE), 0.0, "ms"),
        )
        for name, value, sigma, said, unit in rows:
            found.append(Figure(f"{fit.sensor} {name}", value, sigma, said, unit, CERTAIN[unit]))
    return found


def _gyros(made: Calibration) -> list[Figure]:
    found: list[Figure] = []
    for gyro in made.gyros:
        scale, bias, late = gyro.sigmas
        rows = (
            ("scale", 100.0 * gyro.scale, 100.0 * math.hypot(scale, FLOOR_SCALE), 100.0, "%"),
            (
                "bias",
                gyro.bias,
                math.hypot(bias, FLOOR_BIAS),
                gyro.bias,
                "rad/s",
            ),  # it is learnt anew in each run
            ("late", 1e3 * gyro.late, 1e3 * math.hypot(late, FLOOR_LATE), 0.0, "ms"),
        )
        for name, value, sigma, said, unit in rows:
            found.append(Figure(f"{gyro.sensor} {name}", value, sigma, said, unit, CERTAIN[unit]))
    return found


# -- gross errors --------------------------------------------------------------------------------------


def named(made: Calibration) -> list[str]:
    """Return what is grossly wrong, in words."""
    fit = made.lidars[0]
    found = [f"{name} is mirrored: {MIRRORED}" for name in sorted(made.mirrored)]
    found += _wrong_wheels(made, fit)
    for one in made.lidars:
        stated = made.driven.mounts[one.sensor]
        off = wrap(one.mount.yaw - stated.yaw)
        if abs(off) > SKEWED and one.sigma(3) < SKEWED / 4.0:
            found.append(f"{one.sensor} is turned by {math.degrees(off):+.0f}° against its mount in the file")
        if abs(one.late) - 3.0 * one.sigma(6) > LATE:
            found.append(f"{one.sensor} is stamped {1e3 * one.late:+.0f} ms late, against the wheels")
    for gyro in made.gyros:
        if gyro.scale < 0.0 and gyro.sigmas[0] < 0.1:
            found.append(f"{gyro.sensor} turns to the other side: it is mounted upside down (roll = 3.1416)")
        elif abs(gyro.scale - 1.0) - 3.0 * gyro.sigmas[0] > GROSS - 1.0:
            found.append(f"{gyro.sensor} reads {gyro.scale:.2f} of each rad/s: is its range as set?")
        if abs(gyro.late) - 3.0 * gyro.sigmas[2] > LATE:
            found.append(f"{gyro.sensor} is stamped {1e3 * gyro.late:+.0f} ms late, against the wheels")
    return found


MIRRORED = (
    "its scans turn against wheels and gyro; it is upside down (roll = 3.1416), or counts its "
    "beams the other way"
)


def _wrong_wheels(made: Calibration, fit: LidarFit) -> list[str]:
    """Return what is wrong with the wheels: signs first, then lengths."""
    factors = fit.factors
    known = fit.sigma(0) < 0.05 * abs(factors.distance) and fit.sigma(1) < 0.05 * abs(factors.turn)
    if not known:
        return []
    if factors.turn < 0.0:
        both = factors.distance < 0.0
        what = (
            "both sides roll backward: change the sign of every wheel"
            if both
            else "left and right are swapped"
        )
        return [f"the base turns to the other side than its wheels say: {what}"]
    found = []
    radius = corrected(made.driven.body, Factors(factors.distance, factors.distance))
    wide = factors.distance / factors.turn
    key = next(iter(radius), "what a wheel rolls")
    if ratio(factors.distance) > GROSS:
        said, true = 0.5, 0.5 * factors.distance
        found.append(
            f"the wheels say {said:.2f} m where the scans show {true:.2f}: {key} is about "
            f"{times(1.0 / factors.distance)}"
        )
    if ratio(wide) > GROSS:
        track = next(
            (k for k in corrected(made.driven.body, Factors(1.0, 0.9)) if k != key),
            "the distance of the wheels",
        )
        found.append(
            f"the wheels say {90.0 / factors.turn * factors.distance:.0f}° where the scans show "
            f"{90 * factors.distance:.0f}°: {track} is about {times(1.0 / wide)}"
            if ratio(factors.distance) > GROSS
            else f"the wheels say 90° where the scans show {90.0 * factors.turn:.0f}°: {track} is about "
            f"{times(1.0 / wide)}"
        )
    return found


def ratio(factor: float) -> float:
    """Return a factor or its inverse, whichever is larger."""
    return max(abs(factor), 1.0 / max(abs(factor), 1e-9))


def times(factor: float) -> str:
    """Return by how much a stated length is wrong, in words."""
    return f"{ratio(factor):.2g} times too {'large' if factor > 1.0 else 'small'}"


# -- what is printed -----------------------------------------------------------------------------------


def table(found: Sequence[Figure]) -> list[str]:
    """Return the figures as lines: value, one standard deviation, what is stated."""
    width = max((len(one.name) for one in found), default=0)
    return [f"  {one.name:<{width}}  {_figure(one)}" for one in found]


def _figure(one: Figure) -> str:
    if not one.known:
        return f"not shown by this drive (stated {one.stated:.4g} {one.unit})"
    shown = (
        f"{one.value:.4f} ± {one.sigma:.4f}"
        if one.unit not in ("ms", "%")
        else f"{one.value:.2f} ± {one.sigma:.2f}"
    )
    if one.value == one.stated:
        return f"{shown} {one.unit}"
    remark = "differs" if one.differs else "as stated"
    return f"{shown} {one.unit}, stated {one.stated:.4g}: {remark}"


def lines(made: Calibration) -> list[str]:
    """Return what to change in the robot file, as TOML; [] where all is as stated."""
    body = made.driven.body
    written = {one.name: one.value for one in _wheels(made) if one.differs and hasattr(body, one.name)}
    found = []
    if written:
        found += [f"[brain.{body.kind}]", *(f"{key} = {value:.4f}" for key, value in written.items())]
    own = {} if made.driven.by_odometry else _sensor_keys(made)
    for fit in made.lidars:
        stated, mount = made.driven.mounts[fit.sensor], fit.mount
        rows = {
            one.name.removeprefix(f"{fit.sensor} "): one
            for one in _lidars(made)
            if one.name.startswith(f"{fit.sensor} ")
        }
        differs = {key: rows[key].differs for key in ("x", "y", "yaw")}
        if any(differs.values()) or fit.sensor in made.mirrored:
            parts = {
                "x": mount.x if differs["x"] else stated.x,
                "y": mount.y if differs["y"] else stated.y,
                "z": stated.z,
                "yaw": mount.yaw if differs["yaw"] else stated.yaw,
                "pitch": stated.pitch,
                "roll": mount.roll,
            }
            kept = {key: value for key, value in parts.items() if value or key in differs}
            table = ", ".join(f"{key} = {value:.4f}" for key, value in kept.items())
            found += (
                ["[bag.mounts]", f"{fit.sensor} = {{ {table} }}"]
                if made.driven.by_odometry
                else [f"[sensors.{fit.sensor}]", f"mount = {{ {table} }}", *own.pop(fit.sensor, ())]
            )
    for name, keys in own.items():
        found += [f"[sensors.{name}]", *keys]
    return found


def _sensor_keys(made: Calibration) -> dict[str, list[str]]:
    """Return what a sensor's table is to state of its stamps and its gyro, beside what it states already: of
    what the drive has shown to be otherwise, within the bounds of these keys."""
    found: dict[str, list[str]] = {}
    for one in (*_lidars(made), *_gyros(made)):
        name, _, what = one.name.rpartition(" ")
        sensor = made.driven.robot.sensors.get(name)
        if sensor is None or not one.differs:
            continue
        if what == "late":
            late = max(0.0, sensor.late / MILLISECOND + one.value)
            found.setdefault(name, []).append(f"late_ms = {late:.1f}")
        elif what == "scale":
            found.setdefault(name, []).append(f"gyro_scale = {sensor.gyro_scale * one.value / 100.0:.4f}")
    return found
