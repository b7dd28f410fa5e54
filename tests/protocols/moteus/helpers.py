"""The bench (`tests.protocols.helpers`) with a moteus driver and its twins."""

from __future__ import annotations

from collections.abc import Sequence
from math import tau

from protocols import messages as msg
from protocols.conformance.bench import Shaft
from protocols.frames import CanFrame
from protocols.messages import MILLISECOND, Command, Nanos, Obeyed
from protocols.moteus import RANGES
from protocols.moteus.codec import Subframe, parse
from protocols.moteus.controller import ControllerState
from protocols.moteus.driver import MoteusDriver
from protocols.moteus.messages import names, written
from protocols.moteus.options import Options, Settings
from protocols.moteus.twin import MoteusTwin
from protocols.plugin import Device
from tests.protocols.helpers import CanBench


def device(
    name: str = "left", address: int = 1, settings: Settings | None = None, options: Options | None = None
) -> Device:
    """A device of the robot file."""
    return Device(name, address, options or Options(), settings or Settings())


def free_shaft() -> Shaft:
    """A small motor's, with nothing on it."""
    return Shaft(inertia=1.2e-4, friction=1e-3)


class Bench(CanBench[MoteusDriver, MoteusTwin]):
    """A moteus driver and its twins."""

    def __init__(self, devices: Sequence[Device]) -> None:
        twins = [MoteusTwin(item, seed) for seed, item in enumerate(devices)]
        driver = MoteusDriver(devices, RANGES)
        super().__init__(devices, driver, twins, [free_shaft() for _ in devices], 1_000_000 * MILLISECOND)

    @property
    def twin(self) -> MoteusTwin:
        """The first one."""
        return self.twins[0]

    @property
    def node(self) -> ControllerState:
        """What the driver knows of the first one."""
        return next(iter(self.driver.controllers.values()))

    def sent_messages(self, since: Nanos = 0, address: int = 1) -> list[str]:
        """The names of the messages to a device, without queries."""
        frames = [f for t, f in self.sent if t >= since and f.id & 0x7F == address]
        return [name for f in frames for name in names(f) if name != "read"]

    def commanded(self, since: Nanos = 0, address: int = 1) -> list[dict[int, float | None]]:
        """The registers that were written to a device, frame by frame."""
        frames = [f for t, f in self.sent if t >= since and f.id & 0x7F == address]
        return [w for w in (written(parse(f.data)[0]) for f in frames) if w]


def frame(data: str, identifier: int = 0x500) -> CanFrame:
    """A CAN FD frame of these bytes, padded as by the vendor; by default a reply of device 5."""
    plain = bytes.fromhex(data)
    size = min(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= len(plain))
    return CanFrame(identifier, plain.ljust(size, b"\x50"), identifier > 0x7FF, False, True, True)


def subframes(frame: CanFrame) -> list[Subframe]:
    """Of a sound frame."""
    found, sound = parse(frame.data)
    assert sound
    return found


def ready(*devices: Device) -> Bench:
    """A bench whose driver has received replies of its devices."""
    bench = Bench(devices or [device()])
    bench.run(60)
    return bench


def rev(revolutions: float) -> float:
    """In radians."""
    return revolutions * tau


def obeyed(messages: Sequence[Obeyed]) -> list[Obeyed]:
    """Return these with Arm before the command or mode: every mode but stopped arms."""
    modes = [m for m in messages if isinstance(m, Command) or getattr(m, "parameter", "") == "mode"]
    return [*(msg.Arm("m") for m in modes if not isinstance(m, msg.Idle)), *messages]
