"""The device's end: what a Damiao motor obeys, and its firmware.

Rules. Each frame whose id ends in its ESC_ID is answered and feeds its watchdog, whatever is in it; it does
what those of its mode say. What the loops inside do is ours: the manual gives their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from protocols import messages as msg
from protocols.asked import waiting
from protocols.damiao import table as dm
from protocols.damiao.options import Options, Settings
from protocols.damiao.table import REGISTERS
from protocols.frames import Frame
from protocols.messages import Command, Mode, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import commanded
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded, Values


@dataclass(slots=True)
class Motor:
    """What a motor keeps of the frames it received."""

    name: str
    address: int
    options: Options
    registers: dict[str, float]
    enabled: bool = False
    fastest: float = 1.0
    """rad/s on the way to a position"""
    force: float = 1.0
    """Share of its torque on the way to a position"""
    rescaled: bool = False
    """Its ranges were given other ends than the options have."""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message; return what the motor then does."""
        name, values, motor = decoded.name, decoded.values, self.name
        if name in dm.OPERATIONS:
            return self._on_register(name, values) if values["motor"] == self.address else ()
        if decoded.address != self.address:
            return ()
        match name:
            case "enable":
                self.enabled = True
                return msg.Arm(motor), self._at_rest()
            case "disable":
                self.enabled = False
                return (msg.Idle(motor),)
            case "clear":
                self.enabled = False
                return msg.Idle(motor), msg.ClearFault(motor)
            case "zero":
                return (msg.Zero(motor),)
        if dm.MODE_OF.get(name) != self.registers["CTRL_MODE"]:
            return ()
        goal = self._goal(name, values)
        obeyed = (goal,) if self.enabled else waiting(self.options.gains.canonical(goal))
        return *self._limits(name, values), *obeyed

    def _goal(self, name: str, values: Values) -> Command:
        """Return what a set-point commands."""
        if name == "MIT":
            five = commanded(self.name, values)
            if not self.rescaled:
                return five
            p, v, t = self.scales()
            position, velocity, torque = five.position * p, five.velocity * v, five.torque * t
            return replace(five, position=position, velocity=velocity, torque=torque)
        if name == "VEL":
            return msg.Velocity(self.name, values["velocity"])
        if self.enabled:
            self.fastest, self.force = abs(values["fastest"]), values.get("force", 1.0)
        moves = values["fastest"] and values.get("force", 1.0)
        return msg.Position(self.name, values["position"]) if moves else msg.Hold(self.name)

    def _limits(self, name: str, values: Mapping[str, float]) -> Sequence[Obeyed]:
        """Return what limits the way to a position, where that is not as the options have it."""
        stated = {"fastest": self.options.max_velocity, "force": self.options.max_force}
        return [
            msg.Kept(self.name, f"{name} {each}", values[each])
            for each, own in stated.items()
            if each in values and not math.isclose(values[each], own, rel_tol=1e-3)
        ]

    def _at_rest(self) -> Command:
        """Return what the motor does when it is enabled, before a set-point."""
        match self.registers["CTRL_MODE"]:
            case 1:
                return msg.Torque(self.name, 0.0)
            case 3:
                return msg.Velocity(self.name, 0.0)
        return msg.Hold(self.name)

    def scales(self) -> Sequence[float]:
        """Return by how much position, velocity and torque are more than what the table of the options has:
        other ends of the ranges count at once."""
        return [self.registers[name] / end for name, end in self.options.ends.items()]

    def _on_register(self, operation: str, values: Mapping[str, int]) -> Sequence[Obeyed]:
        if operation == "save":
            return (msg.WriteParameter(self.name, dm.SAVE, 1.0),)
        name, value = REGISTERS.value(values["number"], values["value"])
        if operation != "write" or value is None:
            return ()
        if not REGISTERS.by_name[name].writable and name not in dm.IDS:
            return ()
        if (name == "CTRL_MODE" and value not in dm.MODES.values()) or (name in dm.RANGES and value <= 0.0):
            return ()
        self.registers[name] = int(value) & 0x7FF if name in dm.IDS else value
        self.address, self.rescaled = int(self.registers["ESC_ID"]), self.rescaled or name in dm.RANGES
        if name == "ESC_ID":
            return (msg.SetAddress(self.name, self.address),)
        return (msg.WriteParameter(self.name, name, value),)


def motor_of(device: Device) -> Motor:
    """Return a motor as it is when switched on."""
    settings: Settings = device.settings
    registers = dict.fromkeys(REGISTERS.by_name, 0.0) | device.options.ends
    registers |= settings.registers
    registers |= {"ESC_ID": device.address, "MST_ID": device.options.reply(device.address), "VBus": 24.0}
    registers |= {"SN": settings.serial or 0xDA310000 + device.address}
    return Motor(device.name, device.address, device.options, registers)


class DamiaoTwin(ServoFirmware):
    """One motor."""

    faults, lost = dm.FAULTS, dm.LOST

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=device.options.ends["TMAX"]))
        self.memory = motor_of(device)
        self.table = device.options.table
        self.gains = self.servo.gains
        self._tune()

    def timeout(self) -> Nanos:
        if self.mode is not Mode.ARMED:
            return 0
        return milliseconds(self.memory.registers["TIMEOUT"] * dm.TIMEOUT_UNIT_MS)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, motor = self.table.decode_once(frame), self.memory
        if decoded is None or not decoded.name:
            return
        if decoded.name == "discover":
            self._present_itself(t)
            return
        if decoded.values.get("motor", decoded.address) != motor.address:
            return
        for obeyed in motor.obey(decoded):
            self.obey(t, obeyed)
        self._protect()
        self._limit()
        if decoded.name in dm.REPLIES:
            self._tune()
            self._answer_register(t, decoded)
            return
        if decoded.name not in dm.ABOUT:
            self.feed(t)
        status = {Mode.READY: dm.DISABLED, Mode.ARMED: dm.ENABLED}.get(self.mode, self.fault)
        heat = {"mos": self.settings.temperature, "rotor": self.settings.temperature}
        motion = {n: each / by for (n, each), by in zip(self.measured().items(), motor.scales(), strict=True)}
        others = {"status": status, "motor": motor.address & 0xF, **heat, **motion}
        self.reply(t, self.table.encode("feedback", int(motor.registers["MST_ID"]), **others))

    def obey(self, t: Nanos, obeyed: Obeyed) -> None:
        if isinstance(obeyed, msg.Zero):  # taken while it is enabled, too: it then goes on at its new zero
            self.encoder.set_position(0.0)
            goal: Any = self.goal
            self.goal = replace(goal, position=0.0) if hasattr(goal, "position") else goal
            return
        super().obey(t, obeyed)

    def _protect(self) -> None:
        """Trip what is beyond a limit of supply or temperature."""
        registers, supply = self.memory.registers, self.memory.registers["VBus"]
        beyond = {
            0x8: supply > registers["OV_Value"],
            0x9: supply <= registers["UV_Value"],
            0xC: self.settings.temperature > registers["OT_Value"],
        }
        if self.mode is not Mode.FAULT and (found := [code for code, is_so in beyond.items() if is_so]):
            self.trip(found[0])

    def _limit(self) -> None:
        """Take over the limits of the loops."""
        motor, registers = self.memory, self.memory.registers
        mode, most = registers["CTRL_MODE"], self.gains.torque_limit
        self.fastest = registers["MAX_SPD"] if mode == dm.MODES["vel"] else motor.fastest
        self.strongest = most * (motor.force if mode == dm.MODES["force_pos"] else registers["OC_Value"])
        self.speed_up, self.slow_down = abs(registers["ACC"]), abs(registers["DEC"])

    def _tune(self) -> None:
        """Take over the gains of the loops: ours are to those as delivered what its own are."""
        registers, delivered = self.memory.registers, _AS_DELIVERED.registers
        shares = (registers[name] / delivered[name] for name in ("KP_APR", "KP_ASR", "KI_ASR"))
        self.servo.tune(self.gains.scaled(*shares))

    def _present_itself(self, t: Nanos) -> None:
        """Answer a discovery, if it is not enabled."""
        ids = {"found": self.memory.address & 0x7F, "reply": int(self.memory.registers["MST_ID"]) & 0x7F}
        if self.mode is not Mode.ARMED:
            self.reply(t, self.table.encode("found", **ids))

    def _answer_register(self, t: Nanos, decoded: Decoded) -> None:
        number, registers, save = decoded.values["number"], self.memory.registers, decoded.name == "save"
        register = REGISTERS.by_number.get(number)
        if (register is None and not save) or (save and self.mode is Mode.ARMED):
            return
        raw = 0
        if register is not None and not save:
            turned = register.name in ("xout", "p_m")
            value = self.encoder.position if turned else registers[register.name]
            raw = REGISTERS.raw(register.name, value)
        answer = {"motor": self.memory.address & 0xF, "number": 1 if save else number, "value": raw}
        reply = self.table.encode(f"{decoded.name} reply", int(registers["MST_ID"]), **answer)
        self.reply(t, replace(reply, data=reply.data[:4]) if save else reply)


_AS_DELIVERED = Settings()
