"""The device's end: what a motor obeys, and its firmware.

Rules. Each frame to it is answered, and feeds its watchdog. What the loops inside do is ours: the manual
gives their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from protocols import messages as msg
from protocols.asked import waiting
from protocols.frames import CanFrame, Frame
from protocols.messages import Command, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.robstride import table as rs
from protocols.robstride.options import STORED, Options, Settings
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import commanded
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded, Table

IN_STATUS = {0: 0x04, 2: 0x01, 4: 0x02, 5: 0x02, 7: 0x20, 14: 0x10, 16: 0x02}
"""Bit of the status by bit of the fault message."""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the frames that it received."""

    name: str
    address: int
    options: Options
    registers: dict[str, float]
    enabled: bool = False

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message; return what the motor then does."""
        name, values, motor = decoded.name, decoded.values, self.name
        if decoded.address != self.address:
            return ()
        match name:
            case "enable" | "disable" | "clear" | "emergency_stop":
                self.enabled = name == "enable"
                if self.enabled:
                    return msg.Arm(motor), self._goal()
                return msg.Idle(motor), *((msg.ClearFault(motor),) if name == "clear" else ())
            case "zero":
                return (msg.Zero(motor),)
            case "save":
                return (msg.WriteParameter(motor, rs.SAVE, 1.0),)
            case "set_id":
                self.address = values["id"]
                return (msg.SetAddress(motor, self.address),)
            case "control" if not self.registers["run_mode"]:
                five = commanded(motor, values)
                return (five,) if self.enabled else waiting(self.options.gains.canonical(five))
            case "write":
                return self._write(*rs.REGISTERS.value(values["number"], values["value"]))
        return ()

    def _write(self, name: str, value: float | None) -> Sequence[Obeyed]:
        if value is None or name not in self.registers or not rs.REGISTERS.by_name[name].writable:
            return ()
        self.registers[name] = value
        moves = self.enabled and name in ("run_mode", rs.SET_POINT.get(int(self.registers["run_mode"])))
        return (msg.WriteParameter(self.name, name, value), *((self._goal(),) if moves else ()))

    def _goal(self) -> Command:
        """Return what the set-point in its registers makes it do."""
        mode, ends = int(self.registers["run_mode"]), rs.MODELS[self.options.model]
        value = self.registers[rs.SET_POINT[mode]] if mode in rs.SET_POINT else 0.0
        match mode:
            case 1 | 5:
                return msg.Position(self.name, value)
            case 2:
                return msg.Velocity(self.name, value)
        return msg.Torque(self.name, value * ends.torque / ends.current)


def memory_of(device: Device) -> Memory:
    """Return that of a motor as it is when switched on."""
    settings: Settings = device.settings
    model, ends = device.options.model, rs.MODELS[device.options.model]
    registers = dict.fromkeys(rs.parameters_of(model), 0.0) | {"VBUS": 48.0}
    stored = {name: float(getattr(settings, name)) for name in STORED if name in registers}
    stored["limit_torque"] = settings.limit_torque or ends.torque
    stored["limit_cur"] = settings.limit_cur or ends.current
    stored |= {ends.timeout: float(round(settings.timeout_ms * rs.PER_MS))} if ends.timeout else {}
    return Memory(device.name, device.address, device.options, registers | stored)


class RobStrideTwin(ServoFirmware):
    """One motor."""

    def __init__(self, device: Device, seed: int) -> None:
        self.model: str = device.options.model
        super().__init__(device, seed, Gains(torque_limit=rs.MODELS[self.model].torque))
        self.gains = self.servo.gains
        self.memory = memory_of(device)
        self._tune()
        self.host = 0
        """Who sent a message last: whom answers are for. A set-point does not say who sent it."""
        self.table: Table = device.options.table
        self.faults = rs.faults_of(self.model)

    def timeout(self) -> Nanos:
        if self.mode is not Mode.ARMED:
            return 0
        return milliseconds(self.memory.registers.get("canTimeout", 0.0) / rs.PER_MS)

    def _frame(self, name: str, **values: Any) -> Frame:  # noqa: ANN401 -- numbers
        return self.table.encode(name, self.memory.address, host=self.host, **values)

    def _status(self) -> Frame:
        mode = 2 if self.mode is Mode.ARMED else 0
        bits = IN_STATUS.get(self.fault - rs.DETAIL, 0) if self.fault >= rs.DETAIL else self.fault
        end = self.table.row("status").field("position").high
        position = math.remainder(self.encoder.position, 2.0 * end)
        measured = self.measured() | {"position": position}
        state = {"mode": mode, "faults": 0x10 if bits == rs.HALL else bits, "temperature": 30.0}
        return self._frame("status", **state, **measured)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, memory = self.table.decode_once(frame), self.memory
        if decoded is None or not decoded.name or decoded.address != memory.address:
            return
        for obeyed in memory.obey(decoded):
            self.obey(t, obeyed)
        if decoded.name == "write":
            self._tune()
        if isinstance(frame, CanFrame) and decoded.name != "control":
            self.host = frame.id >> 8 & 0xFF
        self.feed(t)
        match decoded.name:
            case "get_id" | "set_id":
                serial = 0x5253_0000_0000_0000 | (self.settings.serial or self.device.address)
                self.reply(t, self.table.encode("id", memory.address, serial=serial))
                return
            case "read":
                self.reply(t, self._register(decoded.values["number"]))
                return
        if self.fault >= rs.DETAIL:
            self.reply(t, self._frame("fault", faults=1 << self.fault - rs.DETAIL, warnings=0))
        self.reply(t, self._status())

    def _tune(self) -> None:
        """Take over the limits and gains of the loops: ours are to those as delivered what its own are."""
        registers, ends = self.memory.registers, rs.MODELS[self.model]
        mode, current = int(registers["run_mode"]), registers["limit_cur"] * ends.torque / ends.current
        self.strongest = min(registers["limit_torque"], current if mode else math.inf)
        planned = mode == 1 and "vel_max" in registers
        self.fastest = registers["vel_max" if planned else "limit_spd"] if mode in (1, 5) else math.inf
        pace = {1: "acc_set", 2: "acc_rad"}.get(mode, "")
        self.speed_up = self.slow_down = registers.get(pace, math.inf)
        shares = (registers[name] / getattr(_AS_DELIVERED, name) for name in ("loc_kp", "spd_kp", "spd_ki"))
        self.servo.tune(self.gains.scaled(*shares))

    def _register(self, number: int) -> Frame:
        register, values = rs.REGISTERS.by_number.get(number), self.memory.registers
        position, turns = self.encoder.position, self.encoder.position / math.tau * rs.REDUCTION
        values = values | {"mechPos": position, "mechVel": self.encoder.velocity, "rotation": int(turns)}
        known = register is not None and register.name in self.memory.registers
        raw = rs.REGISTERS.raw(register.name, values[register.name]) if register is not None and known else 0
        return self._frame("register", failed=not known, number=number, value=raw)


_AS_DELIVERED = Settings()
