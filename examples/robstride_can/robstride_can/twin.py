"""The device's end: what a RobStride motor obeys, and its firmware. It sends answers only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import NUMBERS
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded

from . import table as rs


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the motor: none that matters here."""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the frames that it received."""

    name: str
    address: int
    registers: dict[str, float] = field(default_factory=lambda: dict.fromkeys(rs.REGISTERS.by_name, 0.0))
    enabled: bool = False

    @classmethod
    def of(cls, device: Device) -> Memory:
        """Return that of a motor as it is when switched on."""
        return cls(device.name, device.address)

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message; return what the motor then does."""
        values, motor = decoded.values, self.name
        if decoded.address != self.address:
            return ()
        match decoded.name:
            case "enable":
                self.enabled = True
                return msg.Arm(motor), msg.Torque(motor, 0.0)
            case "disable":
                self.enabled = False
                return (msg.Idle(motor),)
            case "clear":
                self.enabled = False
                return msg.Idle(motor), msg.ClearFault(motor)
            case "zero":
                return (msg.Zero(motor),)
            case "control" if self.enabled and self.registers["run_mode"] == rs.IMPEDANCE:
                return (msg.Impedance(motor, *(values[name] for name in NUMBERS)),)
            case "write":
                name, value = rs.REGISTERS.value(values["number"], values["value"])
                if value is not None and rs.REGISTERS.by_name[name].writable:
                    self.registers[name] = value
                    return (msg.WriteParameter(motor, name, value),)
        return ()


class RobStrideTwin(ServoFirmware):
    """One motor."""

    faults = rs.FAULTS

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=17.0))
        self.memory = Memory.of(device)

    def timeout(self) -> Nanos:
        timeout = milliseconds(self.memory.registers["canTimeout"] * rs.TIMEOUT_UNIT_MS)
        return timeout if self.mode is Mode.ARMED else 0

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, memory = rs.TABLE.decode(frame, "to_device"), self.memory
        if decoded is None or not decoded.name or decoded.address != memory.address:
            return
        for obeyed in memory.obey(decoded):
            self.obey(t, obeyed)
        if decoded.name == "read":
            number = decoded.values["number"]
            name, _ = rs.REGISTERS.value(number, 0)
            value = self.encoder.position if name == "mechPos" else memory.registers.get(name, 0.0)
            raw = rs.REGISTERS.raw(name, value) if name else 0
            self.reply(t, rs.TABLE.encode("register", memory.address, number=number, value=raw))
            return
        if decoded.name != "write":
            self.feed(t)
        state = {"mode": 2 * (self.mode is Mode.ARMED), "faults": self.fault, "temperature": 30.0}
        measured = zip(NUMBERS, (self.encoder.position, self.encoder.velocity, self.torque), strict=False)
        self.reply(t, rs.TABLE.encode("status", memory.address, **state, **dict(measured)))
