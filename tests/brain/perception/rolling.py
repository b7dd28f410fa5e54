"""A base that rolls over an uneven floor: true poses, and what joints, gyro and references measure.

Any base: its wheels slip by a share of what they roll, each for itself, and its steering points elsewhere by
as many rad, both Gauss-Markov processes over the distance rolled. So is the slip of the sides of a base that
turns by slipping, and how far it slides sideways then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from brain.belief import Floats
from brain.bodies.body import Base
from brain.bodies.differential import Differential
from brain.bodies.plane import Twist, wrap
from brain.perception.filter import Filter
from brain.perception.filter_inputs import GyroRate, Input, PoseFix, WheelAngle
from brain.perception.filter_settings import FilterSettings
from brain.perception.wheel_odometry import Rolling
from protocols.messages import MILLISECOND, SECOND, Nanos, seconds

BODY = Differential(
    left="left",
    right="right",
    wheel_radius=0.05,
    wheel_separation=0.22,
    radius=0.24,
    max_linear=0.6,
    max_angular=2.0,
    max_linear_acceleration=0.8,
    max_angular_acceleration=4.0,
)
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


def shown(body: Base, before: Sequence[float], after: Sequence[float]) -> tuple[float, ...]:
    """Return what joints that moved show: distance, turn, sideways, and the turn by a slip of 1."""
    travel = body.travel(before, after)
    return *travel[:3], Rolling(body, 0.01).errors(travel, np.subtract(after, before).tolist())[2]


STEERING = 3.0
"""rad/s of a joint that steers"""


def roll(seed: int, until: Nanos, floor: Floor, step: Nanos = 5 * MS, body: Base = BODY) -> Run:
    """Drive at random: gyro at each step, joints at every second one."""
    rng = np.random.Generator(np.random.PCG64(seed))
    h, run, count = seconds(step), Run(bias=0.02 * float(rng.normal())), len(body.joints)
    rolling = np.array(body.rolling)
    slip: Floats = floor.slip * rng.normal(size=count)
    angles, zero = np.zeros(count), np.where(rolling > 0.0, rng.uniform(0.0, 6.0, count), 0.0)
    errors = np.resize(floor.radius_errors, count)
    true = angles.copy()
    x = y = yaw = turned = linear = angular = lateral = 0.0
    want_linear = want_angular = want_lateral = 0.0
    noise = rng.normal(size=(until // step + 1, count + 2))
    slides = np.random.Generator(np.random.PCG64([seed, 1]))
    side = body.turn_slip * slides.normal(size=3)
    for k in range(until // step + 1):
        t = k * step
        run.truth[t] = x, y, yaw
        if k % 2 == 0:
            for motor, angle in zip(body.joints, (zero + angles).tolist(), strict=True):
                run.inputs.append(
                    WheelAngle(motor, t, math.floor(angle / floor.resolution) * floor.resolution)
                )
        if floor.fixes and k and t % floor.fixes == 0:
            measured = np.array([x, y, yaw]) + np.array(FIX_SIGMAS) * rng.normal(size=3)
            run.inputs.append(PoseFix("fix", t, measured, np.diag(np.square(FIX_SIGMAS))))
        if t >= floor.rest and t % SECOND == 0:
            want_linear = rng.uniform(-0.1, 0.6)
            want_angular = rng.uniform(-1.2, 1.2) if rng.random() < 0.7 else 0.0
            if body.moves_sideways:
                want_lateral = rng.uniform(-0.3, 0.3) if rng.random() < 0.7 else 0.0
        linear += max(-0.8 * h, min(0.8 * h, want_linear - linear))
        angular += max(-4.0 * h, min(4.0 * h, want_angular - angular))
        lateral += max(-0.8 * h, min(0.8 * h, want_lateral - lateral))
        sharpest = abs(linear) / body.turning_radius if body.turning_radius else math.inf
        twist = Twist(linear, max(-sharpest, min(sharpest, angular)), lateral)
        before, was = true.copy(), angles.copy()
        for j, wanted in enumerate(body.inverse(twist, tuple(angles.tolist()))):
            if wanted.velocity is not None:
                angles[j] += wanted.velocity * h
            elif wanted.position is not None:
                angles[j] += max(-STEERING * h, min(STEERING * h, wanted.position - angles[j]))
        rolled = angles - was
        ways = np.abs(rolled) * rolling
        ways[rolling == 0.0] = ways[rolling > 0.0].mean()
        kept = np.exp(-ways / floor.slip_length)
        aside = 0.0
        if body.turn_slip:
            left, right = rolled[0], rolled[-1]
            share = abs(right - left) / max(abs(left) + abs(right), 1e-12)
            kept_side = math.exp(-float(ways.mean()) / floor.slip_length)
            fresh = math.sqrt(1.0 - kept_side * kept_side) * slides.normal(size=3)
            side = kept_side * side + body.turn_slip * fresh
            rolled = rolled * (1.0 + share * np.repeat(side[:2], count // 2))
            aside = share * float(side[2]) * float(ways.mean())
        true = np.where(rolling > 0.0, true + rolled * (1.0 + errors + slip), angles + slip)
        slip = kept * slip + floor.slip * np.sqrt(1.0 - kept * kept) * noise[k, :count]
        distance, turn, sideways = body.travel(tuple(before.tolist()), tuple(true.tolist()))[:3]
        sideways += aside
        if floor.gyro:
            rate = (turned + turn) / 2.0 / h + run.bias + floor.gyro_noise * float(noise[k, count])
            run.inputs.append(GyroRate("imu", t, rate, floor.gyro_noise))
        c, s = math.cos(yaw + turn / 2.0), math.sin(yaw + turn / 2.0)
        x, y = x + distance * c - sideways * s, y + distance * s + sideways * c
        yaw, turned = yaw + turn, turn
        run.bias += floor.bias_walk * math.sqrt(h) * float(noise[k, count + 1])
    return run


def consistency(
    seed: int, until: Nanos, floor: Floor, settings: FilterSettings, body: Base = BODY
) -> tuple[float, Filter]:
    """Return the mean NEES of the pose per number, sampled every half second of motion, and the filter."""
    run, belief = roll(seed, until, floor, body=body), Filter(body, settings)
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
