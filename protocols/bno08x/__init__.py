"""CEVA's inertial sensors BNO080, BNO085, BNO086 in their mode UART-RVC (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols.bno08x import table
from protocols.bno08x.driver import Bno08xAdapter, Options
from protocols.bno08x.twin import Bno08xDecoder, Bno08xTwin, Settings
from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor

__all__ = ["plugin"]


def no_messages(_: Frame) -> tuple[str, ...]:
    """Return (): nothing is sent to a sensor."""
    return ()


def spec(device: Device) -> Spec:
    """Return the contract of a sensor. Raises ValueError for an address or a line that it cannot have."""
    if device.line_rate not in (0, table.BAUDRATE):
        text = f"{device.name} sends with {table.BAUDRATE} baud, not {device.line_rate}"
        raise Invalid(("bus", text))
    low, high = table.ENDS
    ranges = {"Imu.linear_acceleration": Range((low + 2) * table.MG, (high - 1) * table.MG, 0.501 * table.MG)}
    return serial_sensor(device, ranges, table.PERIOD)


plugin = Plugin(
    name=table.NAME,
    title="BNO080, BNO085, BNO086 by UART-RVC: heading and accelerations, 100 times a second",
    trust="packets: adafruit-circuitpython-bno08x-rvc 1.0.24. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(Bno08xAdapter, spec),
    decoder=Bno08xDecoder,
    twin=Bno08xTwin,
    messages=no_messages,
    vectors=("protocols.bno08x", "vectors.json"),
)
