"""Inertial sensors: angular rates and accelerations, and an orientation if the sensor estimates one."""

from __future__ import annotations

import math

from protocols.messages import Imu, Nanos
from protocols.sensors.kind import Content, Quantity, RosView, SensorKind

_NO_COVARIANCE = (0.0,) * 9
_NOT_MEASURED = (-1.0, *_NO_COVARIANCE[1:])
"""A covariance that starts with −1 marks what is not measured (sensor_msgs/Imu.msg)."""


def _ros(event: Imu) -> Content:
    known = event.orientation is not None
    return (
        *(event.orientation or (0.0, 0.0, 0.0, 1.0)), *(_NO_COVARIANCE if known else _NOT_MEASURED),
        *event.angular_velocity, *_NO_COVARIANCE, *event.linear_acceleration, *_NO_COVARIANCE,
    ), ()  # fmt: skip


def _text(event: Imu) -> str:
    x, y, z = event.linear_acceleration
    rates = ", ".join(f"{rate:.3f}" for rate in event.angular_velocity)
    return f"angular velocity {rates} rad/s, acceleration {x:.2f}, {y:.2f}, {z:.2f} m/s²"


def _sample(sensor: str, t: Nanos, count: int) -> Imu:
    wave, turned = math.sin(0.37 * count), math.sin(0.11 * count)
    rates, pushed = (0.1 * wave, -0.2 * wave, wave), (0.3 * wave, 0.2, 9.81)
    return Imu(sensor, t, rates, pushed, (0.0, 0.0, turned, math.cos(0.11 * count)))


KIND = SensorKind(
    name="imu",
    message=Imu,
    quantities={
        "angular_velocity": Quantity("rad/s", -1e4, 1e4),
        "linear_acceleration": Quantity("m/s²", -1e5, 1e5),
        "orientation": Quantity("", -1.001, 1.001),
    },
    sample=_sample,
    text=_text,
    ros=RosView("/imu/data", "sensor_msgs/msg/Imu", "37d", _ros),
    code=77,
)
