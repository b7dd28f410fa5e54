"""The device's end: what a Damiao motor obeys, and its firmware.

Rules. Frames of another mode than CTRL_MODE are ignored; each other frame is answered. What the loops inside
do is ours: the manual gives their gains, not their form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
                return (msg.ClearFault(motor),)
            case "zero":
                return (msg.Zero(motor),)
        if self.ignores(name):
            return ()
        goal = self._goal(name, values)
        obeyed = (goal,) if self.enabled else waiting(self.options.gains.canonical(goal))
        return *self._limits(name, values), *obeyed

    def _goal(self, name: str, values: Values) -> Command:
        """Return what a set-point commands."""
        if name == "MIT":
            return commanded(self.name, values)
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

    def ignores(self, name: str) -> bool:
        """True if a message is of another mode."""
        return dm.MODE_OF.get(name, self.registers["CTRL_MODE"]) != self.registers["CTRL_MODE"]

    def _on_register(self, operation: str, values: Mapping[str, int]) -> Sequence[Obeyed]:
        if operation == "save":
            return (msg.WriteParameter(self.name, dm.SAVE, 1.0),)
        name, value = REGISTERS.value(values["number"], values["value"])
        if operation != "write" or value is None or not REGISTERS.by_name[name].writable:
            return ()
        if name == "CTRL_MODE" and value not in dm.MODES.values():
            return ()
        self.registers[name] = value
        return (msg.WriteParameter(self.name, name, value),)


def motor_of(device: Device) -> Motor:
    """Return a motor as it is when switched on."""
    settings: Settings = device.settings
    registers = dict.fromkeys(REGISTERS.by_name, 0.0) | dm.ranges_of(device.options.model)
    registers |= settings.registers
    registers |= {"ESC_ID": device.address, "MST_ID": device.options.reply(device.address), "VBus": 24.0}
    registers |= {"SN": settings.serial or 0xDA310000 + device.address}
    return Motor(device.name, device.address, device.options, registers)


class DamiaoTwin(ServoFirmware):
    """One motor."""

    faults, lost = dm.FAULTS, dm.LOST

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains(torque_limit=dm.MODELS[device.options.model][2]))
        self.memory = motor_of(device)
        self.table = device.options.table

    def timeout(self) -> Nanos:
        timeout = milliseconds(self.memory.registers["TIMEOUT"] * dm.TIMEOUT_UNIT_MS)
        return timeout if self.mode is Mode.ARMED else 0

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded, motor = self.table.decode(frame, "to_device"), self.memory
        if decoded is None or not decoded.name:
            return
        if decoded.values.get("motor", decoded.address) != motor.address or motor.ignores(decoded.name):
            return
        for obeyed in motor.obey(decoded):
            self.obey(t, obeyed)
        self.fastest, self.strongest = motor.fastest, motor.force * self.servo.gains.torque_limit
        if decoded.name in dm.REPLIES:
            self._answer_register(t, decoded)
            return
        if decoded.name not in dm.OPERATIONS:
            self.feed(t)
        status = {Mode.READY: dm.DISABLED, Mode.ARMED: dm.ENABLED}.get(self.mode, self.fault)
        heat = {"mos": self.settings.temperature, "rotor": self.settings.temperature}
        others = {"status": status, "motor": motor.address, **heat, **self.measured()}
        self.reply(t, self.table.encode("feedback", int(motor.registers["MST_ID"]), **others))

    def _answer_register(self, t: Nanos, decoded: Decoded) -> None:
        number, registers = decoded.values["number"], self.memory.registers
        register = REGISTERS.by_number.get(number)
        if register is None and decoded.name != "save":
            return
        raw = 0
        if register is not None and decoded.name != "save":
            turned = register.name in ("xout", "p_m")
            value = self.encoder.position if turned else registers[register.name]
            raw = REGISTERS.raw(register.name, value)
        answer = {"motor": self.memory.address, "number": number, "value": raw}
        self.reply(t, self.table.encode(f"{decoded.name} reply", int(registers["MST_ID"]), **answer))
