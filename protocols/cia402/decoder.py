"""What the CiA 402 drives of one bus would obey: a frame becomes the words that it means.

Rules. Each device has an `Axis`, which remembers what it was told (modes, mappings, set-points that wait for
a SYNC); here frames are dealt out. The ear knows nothing of faults and standstill: what a drive in fault
would not obey, it tells all the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.cia402.axis import Axis
from protocols.frames import Frame
from protocols.messages import Command, Nanos, Request
from protocols.plugin import Device


class Cia402Decoder:
    """The drives of one bus, as listeners."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.axes = [Axis(device, instant=True) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Command | Request]:
        """The words that the devices would obey; [] if none would do anything."""
        words = [word for axis in self.axes for word in axis.handle(t, frame)]
        for axis in self.axes:
            axis.signals.clear()
            axis.answers.clear()
        return words
