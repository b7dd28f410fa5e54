"""Cameras whose pictures are looked at for markers, on the machine itself or in the world (README.md).
Exports `plugin`."""

from __future__ import annotations

from protocols.camera import table
from protocols.camera.driver import CameraAdapter, Options
from protocols.camera.twin import CameraDecoder, CameraTwin, Settings
from protocols.frames import Frame
from protocols.messages import SECOND
from protocols.plugin import Device, Plugin, Range, Spec
from protocols.sensors.marker import KIND
from protocols.toolkit.assembly import driver_of
from protocols.toolkit.sensors import serial_sensor
from protocols.toolkit.table import TINY

__all__ = ["plugin"]


def no_messages(_: Frame) -> tuple[str, ...]:
    """Return (): nothing is sent to a camera."""
    return ()


def spec(device: Device) -> Spec:
    """Return the contract of a camera. Raises ValueError for an address that it cannot have."""
    ranges = {
        f"Marker.{name}": Range(quantity.low, quantity.high, TINY)
        for name, quantity in KIND.quantities.items()
    }
    return serial_sensor(device, ranges, SECOND, bus="camera", faults=table.FAULTS)


plugin = Plugin(
    name=table.NAME,
    title="cameras by V4L2, and video files: tags and coloured balls in their pictures (extra: camera)",
    trust="pictures by OpenCV from a video file. No camera met yet",
    options=Options,
    settings=Settings,
    spec=spec,
    driver=driver_of(CameraAdapter, spec),
    decoder=CameraDecoder,
    twin=CameraTwin,
    messages=no_messages,
)
