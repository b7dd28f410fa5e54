"""The bench (`tests.protocols.helpers`) with an ODrive driver and twins of both firmware lines."""

from __future__ import annotations

from collections.abc import Sequence

from protocols.messages import Nanos
from protocols.odrive_can import RANGES
from protocols.odrive_can import twin as made
from protocols.odrive_can.codec import decode_to_device, node_of
from protocols.odrive_can.driver import OdriveDriver
from protocols.odrive_can.messages import Message, RemoteRequest
from protocols.odrive_can.options import Options, Settings
from protocols.odrive_can.twin import OdriveTwin
from protocols.odrive_can.twin05 import Twin05
from protocols.odrive_can.twin06 import Twin06
from protocols.plugin import Device
from tests.protocols.helpers import CanBench, Shaft


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


def free_shaft() -> Shaft:
    """Half of 5 kg on a wheel of 0.05 m behind a gear of 8, and the rotor."""
    return Shaft(inertia=2.5 * 0.05**2 / 64 + 2e-5, friction=1e-4)


class Bench(CanBench[OdriveDriver, OdriveTwin]):
    """An ODrive driver and its twins."""

    def __init__(self, devices: Sequence[Device]) -> None:
        twins = [made(item, seed) for seed, item in enumerate(devices)]
        super().__init__(devices, OdriveDriver(devices, RANGES), twins, [free_shaft() for _ in devices])

    @property
    def twin(self) -> Twin06:
        """The first one, of firmware 0.6.x."""
        (first, *_) = self.twins
        assert isinstance(first, Twin06)
        return first

    @property
    def twin05(self) -> Twin05:
        """The first one, of firmware 0.5.x."""
        (first, *_) = self.twins
        assert isinstance(first, Twin05)
        return first

    def said(self, node: int = 1, since: Nanos = 0, line: str = "0.6") -> list[Message]:
        """What the driver told a node (questions left out), as its firmware line has it."""
        frames = [f for t, f in self.sent if t >= since and node_of(f) == node and not f.remote]
        messages = [decode_to_device(frame, line) for frame in frames]
        return [m for m in messages if m is not None and not isinstance(m, RemoteRequest)]


def ready(*devices: Device) -> Bench:
    """A bench that has heard its devices."""
    bench = Bench(devices or (device(),))
    bench.run(300)
    return bench
