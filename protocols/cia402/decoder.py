"""The command decoder: which commands the CiA 402 drives of one bus would obey on receiving a frame.

Rules. Each device has an `Axis`, which keeps its state (modes, mappings, set-points that wait for a SYNC);
this file passes it the frames. The decoder does not know of faults and standstill: it reports also what a
drive in fault would not obey.
"""

from __future__ import annotations

from collections.abc import Sequence

from protocols.cia402.axis import Axis
from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import Device


class Cia402Decoder:
    """The drives of one bus, as receivers of commands."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self.axes = [Axis(device, instant=True) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the commands and requests that the devices would obey; [] if none would do anything."""
        obeyed = [each for axis in self.axes for each in axis.receive(t, frame)]
        for axis in self.axes:
            axis.signals.clear()
            axis.responses.clear()
        return obeyed
