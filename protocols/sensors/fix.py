"""Satellite receivers: positions on the earth."""

from __future__ import annotations

import math

from protocols.messages import Fix, Nanos
from protocols.sensors.kind import Content, Quantity, RosView, SensorKind


def _ros(event: Fix) -> Content:
    """An altitude not measured is NaN, as that message defines; the status is that of a fix by GPS."""
    variance, known = event.variance or 0.0, event.variance is not None
    altitude = math.nan if event.altitude is None else event.altitude
    covariance = (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 0.0)
    return (0, 1, event.latitude, event.longitude, altitude, *covariance, int(known)), ()


def _text(event: Fix) -> str:
    error = "" if event.variance is None else f", ±{math.sqrt(event.variance):.2f} m"
    return f"{event.latitude:.7f}°, {event.longitude:.7f}°{error}"


def _sample(sensor: str, t: Nanos, count: int) -> Fix:
    wave = math.sin(0.37 * count)
    return Fix(sensor, t, 48.0 + 1e-6 * wave, 11.0, 500.0 + wave, 4.0)


KIND = SensorKind(
    name="fix",
    message=Fix,
    quantities={
        "latitude": Quantity("°", -90.0, 90.0),
        "longitude": Quantity("°", -180.0, 180.0),
        "altitude": Quantity("m", -1e7, 1e7),
        "variance": Quantity("m²", 0.0, 1e15),
    },
    sample=_sample,
    text=_text,
    ros=RosView("/fix", "sensor_msgs/msg/NavSatFix", "bH12dB", _ros),
    code=79,
)
