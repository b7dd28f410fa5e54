"""A base that rolls over an uneven floor: true poses, and what wheels, gyro and references measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Floats
from brain.bodies.differential import Differential, wrap
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GyroRate, Input, PoseFix, WheelAngle
from brain.perception.filter_settings import FilterSettings
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

BODY = Differential("left", "right", 0.05, 0.22, 0.24, 0.6, 2.0, 0.8, 4.0)
MS = MILLISECOND
FIX_SIGMAS = (0.02, 0.02, 0.01)
Truth = dict[Nanos, tuple[float, float, float]]


@dataclass(frozen=True)
class Floor:
    """Errors of the sensors and of the floor, as the world files state them."""

    slip: float = 0.01
    slip_length: float = 0.3
    radius_errors: tuple[float, float] = (0.0, 0.0)
    resolution: float = 2.0 * math.pi / 131072.0
    gyro: bool = True
    gyro_noise: float = 0.003
    bias_walk: float = 1e-4
    fixes: Nanos = 0
    """Time between position fixes; 0: none"""
    rest: Nanos = SECOND
    """At the start"""


@dataclass
class Run:
    """Inputs in order of time, true pose by time, and the gyro's last bias."""

    inputs: list[Input] = field(default_factory=list)
    truth: Truth = field(default_factory=dict)
    bias: float = 0.0


def roll(seed: int, until: Nanos, floor: Floor, step: Nanos = 5 * MS) -> Run:
    """Drive at random: gyro at each step, wheels at every second one."""
    rng = np.random.Generator(np.random.PCG64(seed))
    h, run = seconds(step), Run(bias=0.02 * float(rng.normal()))
    slip: Floats = floor.slip * rng.normal(size=2)
    angles, zero = np.zeros(2), rng.uniform(0.0, 6.0, 2)
    x = y = yaw = turned = linear = angular = want_linear = want_angular = 0.0
    noise = rng.normal(size=(until // step + 1, 4))
    for k in range(until // step + 1):
        t = k * step
        run.truth[t] = x, y, yaw
        if k % 2 == 0:
            for motor, angle in zip(("left", "right"), zero + angles, strict=True):
                run.inputs.append(
                    WheelAngle(motor, t, math.floor(angle / floor.resolution) * floor.resolution)
                )
        if floor.fixes and k and t % floor.fixes == 0:
            measured = np.array([x, y, yaw]) + np.array(FIX_SIGMAS) * rng.normal(size=3)
            run.inputs.append(PoseFix("fix", t, measured, np.diag(np.square(FIX_SIGMAS))))
        if t >= floor.rest and t % SECOND == 0:
            want_linear = rng.uniform(-0.1, 0.6)
            want_angular = rng.uniform(-1.2, 1.2) if rng.random() < 0.7 else 0.0
        linear += max(-0.8 * h, min(0.8 * h, want_linear - linear))
        angular += max(-4.0 * h, min(4.0 * h, want_angular - angular))
        rolled = np.array(BODY.inverse(linear, angular)) * h
        kept = np.exp(-np.abs(rolled) * BODY.wheel_radius / floor.slip_length)
        true = rolled * (1.0 + np.array(floor.radius_errors) + slip)
        slip = kept * slip + floor.slip * np.sqrt(1.0 - kept * kept) * noise[k, :2]
        distance, turn = BODY.forward(float(true[0]), float(true[1]))
        if floor.gyro:
            rate = (turned + turn) / 2.0 / h + run.bias + floor.gyro_noise * float(noise[k, 2])
            run.inputs.append(GyroRate("imu", t, rate, floor.gyro_noise))
        x, y = x + distance * math.cos(yaw + turn / 2.0), y + distance * math.sin(yaw + turn / 2.0)
        yaw, turned, angles = yaw + turn, turn, angles + rolled
        run.bias += floor.bias_walk * math.sqrt(h) * float(noise[k, 3])
    return run


def consistency(seed: int, until: Nanos, floor: Floor, settings: FilterSettings) -> tuple[float, Filter]:
    """Return the mean NEES of the pose per number, sampled every half second of motion, and the filter."""
    run, belief = roll(seed, until, floor), Filter(BODY, settings)
    nees, sample = [], floor.rest + SECOND // 2
    for item in run.inputs:
        belief.observe([item])
        t = belief.t
        if t is not None and t >= sample:
            sample += SECOND // 2
            found = belief.at(t)
            assert found is not None
            pose, covariance = found
            x, y, yaw = run.truth[t]
            error = np.array([pose.x - x, pose.y - y, wrap(pose.yaw - yaw)])
            nees.append(float(error @ np.linalg.solve(covariance, error)) / 3.0)
    return float(np.mean(nees)), belief
