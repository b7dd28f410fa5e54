"""The device's end over CAN: which messages it obeys, what it answers, and its status messages."""

from __future__ import annotations

from collections.abc import Mapping

from protocols.frames import Frame
from protocols.messages import Nanos
from protocols.plugin import Device
from protocols.toolkit.firmware import milliseconds
from protocols.toolkit.table import Decoded
from protocols.vesc import table as vt
from protocols.vesc.motor import Motor, VescFirmware


def motor_of(device: Device) -> Motor:
    """Return a controller as it is when switched on."""
    return Motor(device.name, (device.address, vt.EVERY), device.options, device.settings)


class VescTwin(VescFirmware):
    """One controller with its motor."""

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, motor_of(device))

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, address = vt.TABLE.decode_once(frame), self.device.address
        if decoded is None or not self.memory.takes(decoded):
            return
        match decoded.name:
            case "":
                pass
            case "PING":
                self.reply(t, vt.TABLE.encode("PONG", address, host=decoded.values["host"], hardware=0))
            case "get fault":
                self._answer(t, "fault", decoded, self.code)
            case "get state":
                self._answer(t, "state", decoded, self.state)
            case _:
                self.command(t, decoded)

    def _answer(self, t: Nanos, name: str, asked: Decoded, value: int) -> None:
        mode = vt.REPLIES[asked.values["mode"]]
        if mode is not None:
            host = asked.values["host"]
            self.reply(t, vt.TABLE.encode(name, self.device.address, host=host, mode=mode, value=value))

    def cyclic(self) -> Mapping[str, Nanos]:
        period, on = milliseconds(self.device.options.feedback_ms), self.settings.status_messages
        return {name: period for bit, name in enumerate(vt.STATUS) if on >> bit & 1}

    def report(self, name: str) -> Frame:
        values = dict.fromkeys((f.name for f in vt.STATUS[name][1] if f.name), 0.0)
        values |= {key: value for key, value in self.measured().items() if key in values}
        return vt.TABLE.encode(name, self.device.address, **values)
