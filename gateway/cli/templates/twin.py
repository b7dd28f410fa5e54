"""The device's end: what it obeys, and the firmware of the simulated device.

FILL IN what decides whether the real device obeys (a mode, a sequence), and how its firmware behaves; write
the source of each part down in README.md. The clauses "obeyed", "watchdog", "faults", "disarm" and "copies"
check it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from protocols import messages as msg
from protocols.bounds import Bounds, check
from protocols.frames import Frame
from protocols.messages import Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded

from .line import Line, encode
from .table import FAULTS, PERIOD, WATCHDOG

MODES = {Mode.READY: 0, Mode.ARMED: 1, Mode.FAULT: 2}


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device itself."""

    watchdog_ms: Annotated[float, Bounds(0.0, 10_000.0)] = 100.0
    """Time without a command after which a running motor trips; 0 is never."""

    def __post_init__(self) -> None:
        check(self)


class MotorDecoder:
    """What the devices on one bus would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._names = {device.address: device.name for device in devices}
        self._line = Line()

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what a device would obey in this frame; [] if nothing."""
        obeyed: list[Obeyed] = []
        for decoded in self._line.read(frame, "to_device"):
            if isinstance(decoded, Decoded) and decoded.address in self._names:
                obeyed += _meaning(self._names[decoded.address], decoded)
        return obeyed


def _meaning(motor: str, decoded: Decoded) -> Sequence[Obeyed]:
    match decoded.name:
        case "run":
            return msg.Arm(motor), msg.Velocity(motor, decoded.values["velocity"])
        case "stop":
            return (msg.Idle(motor),)
        case "clear":
            return (msg.ClearFault(motor),)
    return ()


class MotorTwin(ServoFirmware):
    """One device."""

    faults, lost = FAULTS, WATCHDOG

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=2.0))
        self.decoder = MotorDecoder([device])

    def timeout(self) -> Nanos:
        return milliseconds(self.settings.watchdog_ms) if self.mode is Mode.ARMED else 0

    def cyclic(self) -> Mapping[str, Nanos]:
        return {"status": PERIOD}

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for obeyed in self.decoder.decode(t, frame):
            self.feed(t)
            self.obey(t, obeyed)

    def report(self, name: str) -> Frame:
        shaft = {"velocity": self.encoder.velocity, "position": self.encoder.position}
        return encode(name, self.device.address, mode=MODES[self.mode], fault=self.fault, **shaft)
