"""FILL IN: which devices, on which firmware.

This plugin is complete and keeps the contract, but its device is invented: it streams on a serial line of its
own, and takes nothing. Replace it by the real device, file by file: `table` first, then `twin`, `driver`, and
the `spec` below. Each place to fill in is marked, with the clause of `gateway protocols check` that checks
it.
"""

from __future__ import annotations

from protocols.frames import Frame
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor

from . import table
from .driver import Options, StreamAdapter
from .twin import Settings, StreamDecoder, StreamTwin

__all__ = ["plugin"]


def messages(_: Frame) -> tuple[str, ...]:
    """Return (): nothing is sent to it. FILL IN (clause "vectors"): the names of what is."""
    return ()


def _range(unit: float) -> Range:
    low, high = table.ENDS
    return Range((low + 2) * unit, (high - 1) * unit, 0.501 * unit)


def spec(device: Device) -> Spec:
    """Return the contract of one device. Raises ValueError for an address that it cannot have."""
    # FILL IN (clause "measurements"): the numbers of its readings, each with the resolution of the packet.
    ranges = {
        "Imu.angular_velocity": _range(table.RATE_UNIT),
        "Imu.linear_acceleration": _range(table.PUSH_UNIT),
    }
    return serial_sensor(device, ranges, table.PERIOD)


plugin = Plugin(
    name=table.NAME,
    title="FILL IN: which devices, by which line",
    trust="FILL IN: which bytes were checked against which package@version or repository@commit",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(StreamAdapter, spec),
    decoder=StreamDecoder,
    twin=StreamTwin,
    messages=messages,
    vectors=(__name__, "vectors.json"),
)
