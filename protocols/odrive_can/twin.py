"""The device's end over CAN: the firmware of `firmware.py`, as it is."""

from __future__ import annotations

from protocols.odrive_can.firmware import OdriveTwin, Twin05, Twin06
from protocols.odrive_can.options import line_of
from protocols.plugin import Device


def twin(device: Device, seed: int) -> OdriveTwin:
    """Return the twin of one device, of the firmware line that it is configured to have."""
    return Twin05(device, seed) if line_of(device) == "0.5" else Twin06(device, seed)
