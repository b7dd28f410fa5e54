"""Cameras that find markers: tags, and targets of a known size."""

from __future__ import annotations

import math

from protocols.messages import Marker, Nanos
from protocols.sensors.kind import Quantity, SensorKind


def _text(event: Marker) -> str:
    if event.marker is None or event.position is None:
        return "no marker"
    x, y, z = event.position
    return f"marker {event.marker} at {x:.3f} m, {y:.3f} m, {z:.3f} m"


def _sample(sensor: str, t: Nanos, count: int) -> Marker:
    wave = math.sin(0.37 * count)
    return Marker(sensor, t, count, (2.0, wave, 0.1), (0.0, 0.0, wave, 0.5), (1e-2, 1e-4), 1e-3)


KIND = SensorKind(
    name="marker",
    message=Marker,
    quantities={
        "position": Quantity("m", -1e6, 1e6),
        "orientation": Quantity("", -1.001, 1.001),
        "variance": Quantity("m²", 0.0, 1e15),
        "turn_variance": Quantity("rad²", 0.0, 1e6),
    },
    sample=_sample,
    text=_text,
    code=81,
)
