"""Satellite receivers that send NMEA 0183 on a serial line (README.md). Exports `plugin`."""

from __future__ import annotations

from protocols.frames import Frame
from protocols.messages import SECOND
from protocols.nmea import table
from protocols.nmea.driver import NmeaAdapter
from protocols.nmea.options import Options, Settings
from protocols.nmea.twin import NmeaDecoder, NmeaTwin
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor

__all__ = ["plugin"]

PERIOD = SECOND
"""As delivered"""


def no_messages(_: Frame) -> tuple[str, ...]:
    """Return (): nothing is sent to a receiver."""
    return ()


def spec(device: Device) -> Spec:
    """Return the contract of a receiver. Raises ValueError for an address that it cannot have."""
    step = 0.51 / 60.0 / 10**device.settings.decimals
    ranges = {
        "Fix.latitude": Range(-90.0, 90.0, step, 1e-15),
        "Fix.longitude": Range(-180.0, 180.0, step, 1e-15),
        "Fix.altitude": Range(-1000.0, 20_000.0, 0.00051),
    }
    return serial_sensor(device, ranges, PERIOD)


plugin = Plugin(
    name=table.NAME,
    title="Satellite receivers by NMEA 0183: fixes of GGA, with their quality",
    trust="sentences: pynmea2 1.19.0, both ways. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(NmeaAdapter, spec),
    decoder=NmeaDecoder,
    twin=NmeaTwin,
    messages=no_messages,
    vectors=("protocols.nmea", "vectors.json"),
)
