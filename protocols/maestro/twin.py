"""The device's end: what a channel obeys, the board's ramp, and the servo on the channel.

Rules. A twin is one channel with its servo; those of a board receive the same messages, and the first of them
answers for the board. A first target is gone to at once, the others by the ramp. The serial timeout ends all
pulses: "off" is home, as delivered. Of the other errors a wrong CRC is simulated, and only noted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.maestro import table as mt
from protocols.maestro.options import Options
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device, FaultInfo, Twin
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.pulses import HobbyServo
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Trapezoid
from protocols.toolkit.table import Decoded

UNLIMITED = 1e9


@dataclass(slots=True)
class Channel:
    """What a channel makes of a message."""

    name: str
    address: int
    options: Options

    def takes(self, decoded: Decoded) -> bool:
        """True if a message is for this channel, or for its board."""
        if decoded.name in ("GETERRORS", "GOHOME"):
            return mt.board(decoded.address) == mt.board(self.address)
        return decoded.address == self.address

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what it does on a message."""
        if not self.takes(decoded) or decoded.name == "GETPOSITION":
            return ()
        if decoded.name != "SETTARGET":
            return (msg.Kept(self.name, decoded.name, float(decoded.values.get("value", 1.0))),)
        if not decoded.values["value"]:
            return (msg.Idle(self.name),)
        position = self.options.position(decoded.values["value"] * mt.QUARTER)
        return msg.Arm(self.name), msg.Position(self.name, position)


def channel_of(device: Device) -> Channel:
    """Return a channel as it is when its board is switched on."""
    return Channel(device.name, device.address, device.options)


class MaestroTwin(HobbyServo):
    """One channel, and the servo on it."""

    faults: Mapping[int, FaultInfo] = {}

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed)
        self.options: Options = device.options
        self.channel = channel_of(device)
        self.packets = mt.PACKETS[self.options.crc]
        self.stream = Stream(self.packets.framing)
        self.target = 0
        """Quarters of a microsecond, as the pulse on its way there"""
        self.pulse = Trapezoid()
        self.ramp = {"SETSPEED": 0, "SETACCELERATION": 0}
        self.errors = 0
        """Of its board: each channel keeps the same."""
        self.first = True
        """It answers for its board."""

    def join(self, others: Sequence[Twin]) -> None:
        """Find the other channels of the board among the twins of its line."""
        at = self.device.address
        beside = [each.device.address for each in others if isinstance(each, MaestroTwin)]
        self.first = not any(mt.board(one) == mt.board(at) and one < at for one in beside)

    def timeout(self) -> Nanos:
        return self.options.timeout_ms * MILLISECOND if self.mode is Mode.ARMED else 0

    def on_timeout(self) -> None:
        self.errors |= mt.TIMEOUT_ERROR
        self._off()

    def _off(self) -> None:
        self.target = 0
        self.disarm()

    # -- messages -------------------------------------------------------------------------------------

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for one in self.stream.feed(frame) if isinstance(frame, bytes) else ():
            if one is Rx.MALFORMED:
                self.errors |= mt.CRC_ERROR
            elif isinstance(one, bytes) and (decoded := self.packets.decode(one, "to_device")) is not None:
                self._on_message(t, decoded)

    def _on_message(self, t: Nanos, decoded: Decoded) -> None:
        if mt.board(decoded.address) == mt.board(self.device.address):
            self.feed(t)
        if not self.channel.takes(decoded):
            return
        match decoded.name:
            case "SETTARGET":
                self._go(t, decoded.values["value"])
            case "GETPOSITION":
                self.reply(t, round(self.pulse.position if self.target else 0).to_bytes(2, "little"))
            case "GETERRORS":
                if self.first:
                    self.reply(t, self.errors.to_bytes(2, "little"))
                self.errors = 0
            case "GOHOME":
                self._off()
            case name:
                self.ramp[name] = decoded.values["value"]

    def _go(self, t: Nanos, target: int) -> None:
        if not target:
            self._off()
            return
        if not self.target:
            self.pulse = Trapezoid(float(target))
        self.target = target
        self.obey(t, msg.Arm(self.device.name))
        self._turn(t)

    def _turn(self, t: Nanos) -> None:
        """Give the servo the pulse as it is now."""
        position = self.options.position(self.pulse.position * mt.QUARTER)
        self.obey(t, msg.Position(self.device.name, position))

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        if self.target and (self.pulse.position != self.target or self.pulse.velocity):
            speed, acceleration = (float(self.ramp[name]) for name in ("SETSPEED", "SETACCELERATION"))
            if not speed and not acceleration:
                self.pulse = Trapezoid(float(self.target))
            elif dt:
                most = speed * mt.SPEED_UNIT / mt.QUARTER or UNLIMITED
                change = acceleration * mt.ACCELERATION_UNIT / mt.QUARTER or UNLIMITED
                self.pulse.advance(dt, self.target, most, change, change)
            self._turn(now)
        return super().cycle(now, dt, position, velocity)

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: no pulses, no ramp."""
        super().restart(t, silent)
        self.target, self.errors, self.ramp = 0, 0, dict.fromkeys(self.ramp, 0)
        self.stream.drop()
