"""LDROBOT's lidars LD06, LD19, STL-19P and STL-27L, which stream on a serial line (README.md). Exports
`plugin`."""

from __future__ import annotations

from protocols.bounds import Invalid
from protocols.frames import Frame
from protocols.ld06 import table
from protocols.ld06.driver import FAULTS, Ld06Adapter
from protocols.ld06.options import MODELS, Options, Settings
from protocols.ld06.twin import Ld06Decoder, Ld06Twin
from protocols.messages import MILLISECOND
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor

__all__ = ["plugin"]

PERIOD = 200 * MILLISECOND
"""Of the slowest turn"""


def no_messages(_: Frame) -> tuple[str, ...]:
    """Return (): no message is to a lidar."""
    return ()


def spec(device: Device) -> Spec:
    """Return the contract of a lidar. Raises ValueError for an address or a line that it cannot have."""
    options: Options = device.options
    model = MODELS[options.model]
    if device.line_rate not in (0, model.baudrate):
        text = f"{device.name}: {options.model} sends with {model.baudrate} baud, not {device.line_rate}"
        raise Invalid(("bus", text))
    ranges = {"LaserScan.ranges": Range(0.0, options.farthest, 0.0005)}
    return serial_sensor(device, ranges, PERIOD, faults=FAULTS, scales={"model": ""})


plugin = Plugin(
    name=table.NAME,
    title="LDROBOT lidars LD06, LD19, STL-19P, STL-27L by UART: a scan of each turn",
    trust="packets: LDROBOT's manuals; ldrobotSensorTeam/ldlidar_stl_sdk@09d1003, compiled. No hardware yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(Ld06Adapter, spec),
    decoder=Ld06Decoder,
    twin=Ld06Twin,
    messages=no_messages,
    vectors=("protocols.ld06", "vectors.json"),
)
