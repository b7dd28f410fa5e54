"""The driver of odrive_can as a class, for plugins that differ from it."""

from __future__ import annotations

from collections.abc import Sequence

from protocols.odrive_can import RANGES
from protocols.odrive_can.axis import Axis
from protocols.odrive_can.driver import OdriveAdapter
from protocols.plugin import Device
from protocols.toolkit.motor_driver import MotorDriver


class OdriveDriver(MotorDriver[Axis]):
    """The driver."""

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(OdriveAdapter(devices), devices, {device.name: RANGES for device in devices})

    @property
    def nodes(self) -> list[int]:
        """The node ids of its devices."""
        return [host.address for host in self.hosts.values()]
