"""The device's end: what a motor obeys, and its firmware.

Rules. Each frame to it is answered, and feeds its watchdog. What the loops inside do is ours: the manual
gives their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.robstride import table as rs
from protocols.robstride.options import REGISTERS as STORED
from protocols.robstride.options import Settings
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import NUMBERS
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded, Table

IN_STATUS = {0: 0x04, 2: 0x01, 4: 0x02, 5: 0x02, 7: 0x20, 14: 0x10, 16: 0x02}
"""Bit of the status by bit of the fault message."""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the frames that it received."""

    name: str
    address: int
    model: str
    registers: dict[str, float]
    enabled: bool = False

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message; return what the motor then does."""
        name, values, motor = decoded.name, decoded.values, self.name
        if decoded.address != self.address:
            return ()
        match name:
            case "enable":
                self.enabled = True
                return msg.Arm(motor), self._goal() or msg.Torque(motor, 0.0)
            case "disable":
                self.enabled = False
                return (msg.Idle(motor),)
            case "clear":
                self.enabled = False
                return msg.Idle(motor), msg.ClearFault(motor)
            case "zero":
                return (msg.Zero(motor),)
            case "save":
                return (msg.WriteParameter(motor, rs.SAVE, 1.0),)
            case "control" if self.enabled and self.registers["run_mode"] == rs.MIT:
                return (msg.Impedance(motor, *(values[number] for number in NUMBERS)),)
            case "write":
                name, value = rs.REGISTERS.value(values["number"], values["value"])
                return self._write(name, value)
            case _ if name in rs.SET_POINTS:
                return self._write(name, values["value"])
        return ()

    def _write(self, name: str, value: float | None) -> Sequence[Obeyed]:
        if value is None or name not in self.registers or not rs.REGISTERS.by_name[name].writable:
            return ()
        self.registers[name] = value
        goal = self._goal() if self.enabled and (name in rs.SET_POINTS or name == "run_mode") else None
        return (msg.WriteParameter(self.name, name, value), *((goal,) if goal else ()))

    def _goal(self) -> Command | None:
        """Return what the set-points in its registers make it do."""
        registers, motor, ends = self.registers, self.name, rs.MODELS[self.model]
        match registers["run_mode"]:
            case 2:
                return msg.Velocity(motor, registers["spd_ref"])
            case 3:
                return msg.Torque(motor, registers["iq_ref"] * ends.torque / ends.current)
            case 1 | 5:
                return msg.Position(motor, registers["loc_ref"])
        return None

    @property
    def fastest(self) -> float:
        """Velocity on the way to a position [rad/s]."""
        mode = self.registers["run_mode"]
        name = "vel_max" if mode == 1 and "vel_max" in self.registers else "limit_spd"
        return self.registers[name] if mode in (1, 5) else math.inf


def memory_of(device: Device) -> Memory:
    """Return that of a motor as it is when switched on."""
    settings: Settings = device.settings
    model, ends = device.options.model, rs.MODELS[device.options.model]
    registers = dict.fromkeys(rs.registers_of(model), 0.0) | {"VBUS": 48.0, "run_mode": settings.run_mode}
    stored = {name: float(getattr(settings, name)) for name in STORED if name in registers}
    stored["limit_torque"] = settings.limit_torque or ends.torque
    stored["limit_cur"] = settings.limit_cur or ends.current
    stored[rs.timeout_of(model)] = round(settings.timeout_ms / rs.TIMEOUT_UNIT_MS)
    return Memory(device.name, device.address, model, registers | stored)


class RobStrideTwin(ServoFirmware):
    """One motor."""

    def __init__(self, device: Device, seed: int) -> None:
        self.model: str = device.options.model
        super().__init__(device, seed, Gains(torque_limit=rs.MODELS[self.model].torque))
        self.memory = memory_of(device)
        self.table: Table = device.options.table
        self.faults = rs.faults_of(self.model)

    def timeout(self) -> Nanos:
        timeout = milliseconds(self.memory.registers[rs.timeout_of(self.model)] * rs.TIMEOUT_UNIT_MS)
        return timeout if self.mode is Mode.ARMED else 0

    def trip(self, code: int) -> None:
        super().trip(code)
        self._send_fault()

    def _send_fault(self) -> None:
        if self.fault >= rs.DETAIL and self.now is not None:
            frame = rs.ANY.encode(
                "fault", self.memory.address, faults=1 << self.fault - rs.DETAIL, warnings=0
            )
            self.reply(self.now, frame)

    def cyclic(self) -> Mapping[str, Nanos]:
        every = (10 + 5 * (self.memory.registers.get("EPScan_time", 1) - 1)) * MILLISECOND
        return {"report": round(every)} if self.settings.active_report else {}

    def report(self, name: str) -> Frame | None:
        code, mode = self.fault, {Mode.ARMED: 2}.get(self.mode, 0)
        bits = IN_STATUS.get(code - rs.DETAIL, 0) if code >= rs.DETAIL else code
        end = self.table.row("status").field("position").high
        looped = math.remainder(self.encoder.position, 2.0 * end)
        measured = {"velocity": self.encoder.velocity, "torque": self.torque, "position": looped}
        state = {"mode": mode, "faults": 0x10 if bits == rs.HALL else bits}
        return self.table.encode(
            name, self.memory.address, **state, **measured, temperature=self.settings.temperature
        )

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, memory = self.table.decode(frame, "to_device"), self.memory
        if decoded is None or not decoded.name or decoded.address != memory.address:
            return
        for obeyed in memory.obey(decoded):
            self.obey(t, obeyed)
        self.fastest, self.strongest = memory.fastest, memory.registers["limit_torque"]
        self.feed(t)
        match decoded.name:
            case "get_id":
                serial = self.settings.serial or 0x5253_0000_0000_0000 + memory.address
                self.reply(t, self.table.encode("id", memory.address, serial=serial))
                return
            case "read":
                self.reply(t, self._register(decoded.values["number"]))
                return
            case "enable" if self.mode is Mode.FAULT:
                self._send_fault()
        status = self.report("status")
        self.reply(t, *(() if status is None else (status,)))

    def _register(self, number: int) -> Frame:
        register, registers = rs.REGISTERS.by_number.get(number), self.memory.registers
        if register is None or register.name not in registers:
            return rs.ANY.encode("register", self.memory.address, failed=1, number=number, value=0)
        measured = {"mechPos": self.encoder.position, "mechVel": self.encoder.velocity}
        raw = rs.REGISTERS.raw(register.name, measured.get(register.name, registers[register.name]))
        return rs.ANY.encode("register", self.memory.address, failed=0, number=number, value=raw)
