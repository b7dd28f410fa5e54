"""The filter's motion model: its state, propagation, Jacobian and process noise.

Rules. Pure functions of a state with these components (SI, frame "odom"): x, y, yaw; v: speed of the wheels'
treads [m/s]; w: yaw rate of the base [rad/s]; bias of the gyro [rad/s]; slip: the share of the treads' travel
that the base does not move. The base moves on an exact arc of length (1 - slip) v dt and turn w dt;
derivatives are analytic. Since v is what the wheels measure, the slip is not observable from wheels alone and
they never change it: only a reference to the outside, such as a matched scan, does. A scale factor estimated
from wheels and gyro alone makes odometry worse.
"""

from __future__ import annotations

import math

import numpy as np

from brain.belief import Floats, Pose
from brain.bodies.differential import arc, sinc
from brain.perception.ekf_settings import EkfSettings

X, Y, YAW, V, W, BIAS, SLIP = range(7)
POSE = slice(X, YAW + 1)
SIZE = 7


def propagate(state: Floats, dt: float) -> Floats:
    """Return the state after dt seconds without a measurement."""
    x, y, yaw, v, w, bias, slip = state.tolist()
    pose = arc(Pose(x, y, yaw), (1.0 - slip) * v * dt, w * dt)
    return np.array([pose.x, pose.y, pose.yaw, v, w, bias, slip])


Triple = tuple[float, float, float]


def arc_jacobian(yaw: float, distance: float, turn: float) -> tuple[Triple, Triple, Triple]:
    """Return d(x, y, yaw) of an arc's end by its initial heading, by its length, and by its turn."""
    half = turn / 2.0
    chord = sinc(half)
    if abs(half) < 1e-4:
        slope = -half / 3.0
    else:
        slope = (half * math.cos(half) - math.sin(half)) / (half * half)
    c, s = math.cos(yaw + half), math.sin(yaw + half)
    of_yaw = (-distance * chord * s, distance * chord * c, 1.0)
    of_distance = (chord * c, chord * s, 0.0)
    of_turn = (0.5 * distance * (slope * c - chord * s), 0.5 * distance * (slope * s + chord * c), 1.0)
    return of_yaw, of_distance, of_turn


def jacobian(state: Floats, dt: float) -> Floats:
    """Return d propagate / d state, 7 × 7."""
    _, _, yaw, v, w, _, slip = state.tolist()
    keep = 1.0 - slip
    of_yaw, along, around = arc_jacobian(yaw, keep * v * dt, w * dt)
    F = np.eye(SIZE)
    F[POSE, YAW:] = [
        [of_yaw[i], along[i] * keep * dt, around[i] * dt, 0.0, along[i] * -v * dt] for i in (X, Y, YAW)
    ]
    return F


def process_noise(state: Floats, dt: float, settings: EkfSettings) -> Floats:
    """Return what dt seconds add to the covariance, 7 × 7: white acceleration (carried through to the
    pose), random walks of bias and slip, and displacements by an uneven floor."""
    _, _, yaw, v, w, _, slip = state.tolist()
    keep = 1.0 - slip
    distance = keep * v * dt
    _, along, around = arc_jacobian(yaw, distance, w * dt)
    across = (-math.sin(yaw), math.cos(yaw), 0.0)
    q_v, q_w = settings.linear_noise**2, settings.angular_noise**2
    on_along = q_v * keep * keep * dt**3 / 3.0 + settings.travel_noise**2 * abs(distance)
    on_around = q_w * dt**3 / 3.0
    on_across = settings.sideways_noise**2 * abs(distance)
    Q = np.zeros((SIZE, SIZE))
    for i in (X, Y, YAW):
        for j in (X, Y, YAW):
            Q[i, j] = (
                on_along * (along[i] * along[j])
                + on_around * (around[i] * around[j])
                + on_across * (across[i] * across[j])
            )
        Q[i, V] = Q[V, i] = along[i] * q_v * keep * dt * dt / 2.0
        Q[i, W] = Q[W, i] = around[i] * q_w * dt * dt / 2.0
    Q[V, V], Q[W, W] = q_v * dt, q_w * dt
    Q[BIAS, BIAS] = settings.bias_noise**2 * dt
    Q[SLIP, SLIP] = settings.slip_noise**2 * dt if abs(distance) > 1e-4 * dt else 0.0
    return Q
