"""Encoders on shafts that no motor of the robot reports: their angle."""

from __future__ import annotations

from protocols.messages import ShaftReading
from protocols.sensors.kind import Quantity, SensorKind

KIND = SensorKind(
    name="shaft_reading",
    message=ShaftReading,
    quantities={"position": Quantity("rad", -1e9, 1e9)},
    sample=lambda sensor, t, count: ShaftReading(sensor, t, 0.37 * (count % 100)),
    code=82,
)
