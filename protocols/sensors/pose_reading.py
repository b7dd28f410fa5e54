"""Poses measured from outside: motion capture, markers."""

from __future__ import annotations

import math

from protocols.messages import Nanos, PoseReading
from protocols.sensors.kind import Content, Quantity, RosView, SensorKind


def _ros(event: PoseReading) -> Content:
    """Variance 0: not known, 1e9: no yaw."""
    yaw, variance = event.yaw or 0.0, event.variance or 0.0
    about_z = 1e9 if event.yaw is None else event.yaw_variance or 0.0
    pose = (event.x, event.y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return (*pose, variance, *(0.0,) * 6, variance, *(0.0,) * 27, about_z), ()


def _text(event: PoseReading) -> str:
    error = "" if event.variance is None else f", ±{math.sqrt(event.variance):.2f} m"
    yaw = "" if event.yaw is None else f", {event.yaw:.3f} rad"
    return f"{event.x:.3f} m, {event.y:.3f} m{yaw}{error}"


def _sample(sensor: str, t: Nanos, count: int) -> PoseReading:
    wave = math.sin(0.37 * count)
    return PoseReading(sensor, t, wave, -wave, 0.5 * wave, 1e-4, 1e-4)


KIND = SensorKind(
    name="pose_reading",
    message=PoseReading,
    quantities={
        "x": Quantity("m", -1e6, 1e6),
        "y": Quantity("m", -1e6, 1e6),
        "yaw": Quantity("rad", -1e3, 1e3),
        "variance": Quantity("m²", 0.0, 1e15),
        "yaw_variance": Quantity("rad²", 0.0, 1e6),
    },
    sample=_sample,
    text=_text,
    ros=RosView("/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", "43d", _ros, frame="map"),
    code=80,
)
