"""The device's end: one output of a chip, and the servo or motor on it.

Rules. A twin is one output; those of a chip receive the same transfers and keep the same registers, and the
one whose register it is, or else the last of them, answers. A chip acknowledges each transfer to it. The
servo gets the pulse that the chip's own clock makes, which may be off; a motor turns as by its share of the
supply, whatever that then does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import Mode, Nanos, Obeyed
from protocols.pca9685 import table as pt
from protocols.pca9685.memory import output_of
from protocols.pca9685.options import Options
from protocols.plugin import Device, FaultInfo, Twin
from protocols.toolkit import i2c
from protocols.toolkit.pulses import HobbyServo
from protocols.toolkit.servo import clamp


class Pca9685Twin(HobbyServo):
    """One output, and what is on it."""

    faults: Mapping[int, FaultInfo] = {}

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.options: Options = device.options
        self.output = output_of(device)
        self.last = True
        """It answers for its chip,"""
        self.beside: frozenset[int] = frozenset()
        """but for these channels."""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the other outputs of the chip among the twins of its bus."""
        chip, channel = pt.chip(self.device.address), pt.channel(self.device.address)
        beside = [each.device.address for each in others if isinstance(each, Pca9685Twin)]
        self.beside = frozenset(pt.channel(one) for one in beside if pt.chip(one) == chip)
        self.last = channel > max(self.beside, default=-1)

    def _is_anothers(self, register: int) -> bool:
        """True if what begins at a register is answered by another twin."""
        return register in {pt.LED0 + 4 * channel for channel in self.beside}

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        found = i2c.parse(frame)
        if found is None or not isinstance(frame, bytes):
            return
        for obeyed in self.output.obey(frame):
            self.obey(t, obeyed)
        if found.address == pt.chip(self.device.address):
            read = self.output.read(found.reads)
            own = found.written[0] == pt.LED0 + 4 * pt.channel(self.device.address)
            if own or (self.last and not self._is_anothers(found.written[0])):
                self.reply(t, i2c.outcome(frame, i2c.DONE, read))

    def turns_to(self, position: float) -> float:
        pulse = self.options.pulse_of(position) / self.settings.clock
        return super().turns_to(self.options.position(pulse))

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        if isinstance(obeyed, msg.Idle):
            self.disarm()
        else:
            super().obey(t, obeyed)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        if not isinstance(self.goal, msg.Velocity) or self.mode is not Mode.ARMED:
            return torque if isinstance(self.goal, msg.Position) else 0.0
        settings = self.settings
        behind = self.goal.velocity * settings.scale - velocity
        return clamp(settings.torque_constant**2 / settings.resistance * behind, settings.torque)

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: asleep, all outputs off."""
        super().restart(t, silent)
        self.output = output_of(self.device)
