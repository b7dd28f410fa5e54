"""The device's end: what a controller obeys, and its firmware.

Rules. A frame of its group feeds its timeout. It keeps no state but the last current. An error lasts half a
second; that, and the length of the timeout, are invented.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.plugin import Device
from protocols.robomaster import table as rm
from protocols.robomaster.options import Options
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.servo import Encoder, Gains
from protocols.toolkit.table import Decoded

ERROR_LASTS: Nanos = 500 * MILLISECOND


@dataclass(slots=True)
class Motor:
    """What a controller makes of a message; it keeps nothing of earlier ones."""

    name: str
    group: str
    slot: str
    torque: float
    """N·m of one count"""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the controller does on this message."""
        if decoded.name != self.group:
            return ()
        current = decoded.values[self.slot]
        if not current:
            return (msg.Idle(self.name),)
        return msg.Arm(self.name), msg.Torque(self.name, current * self.torque)


def motor_of(device: Device) -> Motor:
    """Return a controller as it is when switched on."""
    options: Options = device.options
    return Motor(device.name, *options.of_model.group_of(device.address), options.torque)


class RoboMasterTwin(ServoFirmware):
    """One controller with its motor."""

    faults = rm.FAULTS
    passing = ERROR_LASTS

    def __init__(self, device: Device, seed: int) -> None:
        self.options: Options = device.options
        super().__init__(device, seed, Gains(torque_limit=self.options.torque * self.options.of_model.full))
        self.encoder = Encoder(counts=rm.COUNTS / math.tau, bandwidth=1000.0)
        self.memory = motor_of(device)

    def timeout(self) -> Nanos:
        driven = self.mode is msg.Mode.ARMED
        return milliseconds(self.settings.timeout_ms or self.options.timeout_ms) if driven else 0

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded = rm.TABLE.decode_once(frame)
        if decoded is None or decoded.name != self.memory.group:
            return
        for obeyed in self.memory.obey(decoded):
            self.obey(t, obeyed)
        self.feed(t)

    def cyclic(self) -> Mapping[str, Nanos]:
        return {"feedback": rm.PERIOD_MS * MILLISECOND}

    def report(self, name: str) -> Frame:
        return rm.TABLE.encode(
            name,
            number=self.device.address + self.options.of_model.feedback,
            angle=round(self.encoder.position * rm.COUNTS / math.tau) % rm.COUNTS,
            velocity=round(self.encoder.velocity / rm.RPM),
            current=round(self.torque / self.options.torque),
            temperature=round(self.settings.temperature) if self.options.model != "C610" else 0,
            error=self.fault,
        )
