"""The device's end: what a DDSM motor obeys, and its firmware.

Rules. A motor obeys whole messages to its address, and those to all. A mode keeps driving until another is
set, and begins without a value; there is no watchdog. `set id` counts when it has come five times in a row. A
fault ends the motion, and passes by itself. What the loops inside do is ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.ddsm import table as ds
from protocols.ddsm.options import Options
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.packets import PacketFirmware
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded

STRENGTH = 2.0
"""N·m, if nothing is known"""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of what it receives."""

    name: str
    address: int
    options: Options
    mode: int
    ids: tuple[int, int] = (0, 0)
    """The id that is to be set, and how often that came."""

    def takes(self, decoded: Decoded) -> bool:
        """True if a message is for this motor."""
        return decoded.address == self.address or decoded.name in ("id query", "set id")

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the motor does on this message."""
        if not self.takes(decoded):
            return ()
        count = self.ids[1] if decoded.values.get("id") == self.ids[0] else 0
        self.ids = (0, 0)
        match decoded.name:
            case "set id" if decoded.values["id"] in ds.ADDRESSES:
                self.ids = decoded.values["id"], count + 1
                if count + 1 >= ds.TIMES:
                    self.address = decoded.values["id"]
                return (msg.WriteParameter(self.name, "id", float(decoded.values["id"])),)
            case "drive":
                return self._drives(decoded.values["value"], brake=decoded.values["brake"] == ds.BRAKE)
            case name if name == f"set mode {self.options.model[4:]}":
                return self._sets(decoded.values["mode"])
        return ()

    def _drives(self, value: int, *, brake: bool) -> Sequence[Obeyed]:
        arm, model = msg.Arm(self.name), self.options.of_model
        if self.mode == ds.SPEED:
            return arm, msg.Velocity(self.name, 0.0 if brake else value * model.rpm)
        if self.mode == ds.POSITION:
            return arm, msg.Position(self.name, value * ds.ANGLE)
        if not value:
            return (msg.Idle(self.name),)
        if self.mode == ds.CURRENT:
            return arm, msg.Torque(self.name, value * self.options.torque)
        return arm, msg.Velocity(self.name, value / ds.FULL * model.fastest)  # what it does without a load

    def _sets(self, mode: int) -> Sequence[Obeyed]:
        if mode not in (self.options.of_model.rest, ds.SPEED, ds.POSITION):
            return ()
        kept, changed = msg.Kept(self.name, "mode", float(mode)), mode != self.mode
        self.mode = mode
        if not changed:
            return (kept,)
        if mode == self.options.of_model.rest:
            return kept, msg.Idle(self.name)
        holds = msg.Velocity(self.name, 0.0) if mode == ds.SPEED else msg.Hold(self.name)
        return msg.Arm(self.name), kept, holds


def memory_of(device: Device) -> Memory:
    """Return a motor as it is when switched on."""
    speed = device.settings.start_mode == "speed"
    mode = ds.SPEED if speed else device.options.of_model.rest
    return Memory(device.name, device.address, device.options, mode)


class DdsmTwin(PacketFirmware):
    """One motor; the shaft that it turns is the world's."""

    faults = ds.FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        most = device.options.strongest or STRENGTH
        self.messages = ds.PACKETS[device.options.model]
        super().__init__(device, seed, Gains(torque_limit=most), memory_of(device))
        self.fastest, self.strongest = device.options.of_model.fastest, most
        self.passing = round(device.settings.fault_ms * MILLISECOND)
        self.reply_delay = round(device.settings.answer_us * 1000)
        if self.memory.mode == ds.SPEED:
            self.mode, self.goal = Mode.ARMED, msg.Velocity(device.name, 0.0)

    def takes(self, decoded: Decoded) -> bool:
        return bool(self.memory.takes(decoded))

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        super().on_message(t, message, decoded)
        if decoded.name in ("drive", "query", "id query"):
            self.reply(t, self._answer(ds.QUERY if decoded.name == "query" else ds.DRIVE))

    def _answer(self, function: int) -> bytes:
        """Return what it measures."""
        options, encoder = self.memory.options, self.encoder
        constant = options.torque_constant or options.of_model.torque_constant or 1.0
        turn = math.remainder(encoder.position, math.tau) % math.tau / math.tau
        speed, current = encoder.velocity / options.of_model.rpm, self.torque / constant / ds.AMPERE
        numbers = {
            "mode": self.memory.mode,
            "speed": round(max(-ds.FULL, min(ds.FULL, speed))),
            "current": round(max(-ds.FULL, min(ds.FULL, current))),
            "temperature": round(self.settings.temperature),
            "angle": round(turn * ds.FULL),
            "coarse": round(turn * 255),
            "mileage": math.floor(encoder.position / math.tau),
            "error": self.fault,
        }
        return ds.answer(options.model, function, self.memory.address, **numbers)
