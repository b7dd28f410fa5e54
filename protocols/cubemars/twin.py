"""The device's end: what a motor obeys, and its firmware.

Rules. In MIT mode each frame is answered, also before the mode was entered; set-points are obeyed from then
on only. In servo mode any set-point drives it, and it reports by itself. The manual gives neither a timeout
nor the end of a fault: here is none, and a fault passes half a second later. What the loops do is ours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from protocols import messages as msg
from protocols.asked import waiting
from protocols.cubemars import table as cm
from protocols.cubemars.options import Options, Settings
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.mit import commanded
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded

FAULT_STOP: Nanos = 500 * MILLISECOND


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the frames it received."""

    name: str
    address: int
    options: Options
    settings: Settings
    entered: bool = False
    fastest: float = math.inf
    """rad/s on the way to a position"""
    ramp: float = math.inf
    """rad/s² on that way"""

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Apply a message; return what the motor then does."""
        if decoded.address != self.address:
            return ()
        motor, values = self.name, decoded.values
        match decoded.name:
            case "enter":
                self.entered = True
                return msg.Arm(motor), msg.Torque(motor, 0.0)
            case "exit":
                was, self.entered = self.entered, False
                again = () if self.options.sole_host else (msg.Kept(motor, "exit", 1.0),)
                return (msg.Idle(motor),) if was else again
            case "set zero" | "SET_ORIGIN_HERE":
                return (msg.Zero(motor),)
            case "control":
                five = commanded(motor, values)
                return (five,) if self.entered else waiting(self.options.gains.canonical(five))
            case "SET_MIT":
                return msg.Arm(motor), commanded(motor, values)
        unused = () if self._is_sent(decoded) else (msg.Kept(motor, decoded.name, 1.0),)
        self.ramp = abs(values.get("ramp", math.inf)) * self.options.erpm
        return *unused, *self._drive(decoded.name, values["value"], values.get("fastest", math.inf))

    def _is_sent(self, decoded: Decoded) -> bool:
        """True for a message that is sent here; a position with the options' limits."""
        if decoded.name != "SET_POS_SPD":
            return decoded.name in cm.SENT
        options, values = self.options, decoded.values
        limits = {"fastest": options.max_velocity, "ramp": options.max_acceleration}
        return all(abs(values[each] - own / options.erpm) <= 5.001 for each, own in limits.items())

    def _drive(self, name: str, value: float, fastest: float) -> Sequence[Obeyed]:
        """Return what the motor does on a set-point of servo mode."""
        motor, options = self.name, self.options
        self.fastest = abs(fastest) * options.erpm
        match name:
            case "SET_RPM":
                return msg.Arm(motor), msg.Velocity(motor, value * options.erpm)
            case "SET_POS" | "SET_POS_SPD":
                goal = msg.Position(motor, value * cm.DEGREE)
                return msg.Arm(motor), goal if self.fastest else msg.Hold(motor)
            case "SET_DUTY":  # what a motor without load does at that voltage
                unloaded = value * self.settings.supply / options.torque_constant
                return msg.Arm(motor), msg.Velocity(motor, unloaded)
            case _ if not value:
                return (msg.Idle(motor),)
            case "SET_CURRENT":
                return msg.Arm(motor), msg.Torque(motor, value * options.torque_constant)
        return msg.Arm(motor), msg.Velocity(motor, 0.0)  # the brake


def memory_of(device: Device) -> Memory:
    """Return a motor as it is when switched on."""
    return Memory(device.name, device.address, device.options, device.settings)


class CubeMarsTwin(ServoFirmware):
    """One motor."""

    faults = cm.FAULTS
    passing = FAULT_STOP

    def __init__(self, device: Device, seed: int) -> None:
        options: Options = device.options
        most = options.max_current * options.torque_constant
        most = options.table.row(options.set_point).field("torque").high if options.five else most
        super().__init__(device, seed, Gains(torque_limit=most))
        self.options = options
        self.memory = memory_of(device)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        decoded = self.options.table.decode_once(frame)
        if decoded is None or not decoded.name or decoded.address != self.memory.address:
            return
        for obeyed in self.memory.obey(decoded):
            self.obey(t, obeyed)
        self.fastest, self.speed_up, self.slow_down = self.memory.fastest, self.memory.ramp, self.memory.ramp
        if self.options.mode == "mit":
            numbers = {"motor": self.memory.address, **self.measured(), **self._state()}
            reply = self.options.table.encode("reply", **numbers)
            self.reply(t, replace(reply, id=self.options.replies(self.memory.address)[0]))

    def _state(self) -> Mapping[str, int]:
        return {"temperature": self.settings.temperature, "error": self.fault}

    def cyclic(self) -> Mapping[str, Nanos]:
        return {"status": milliseconds(self.options.feedback_ms)} if self.options.mode != "mit" else {}

    def report(self, name: str) -> Frame:
        options = self.options
        return cm.SERVO.encode(
            name,
            self.memory.address,
            position=self.encoder.position / cm.DEGREE,
            velocity=self.encoder.velocity / options.erpm,
            current=self.torque / options.torque_constant,
            **self._state(),
        )
