"""The device's end: what a VESC obeys, and its firmware.

Rules. Every message that commands feeds the timeout, a current of 0 too; questions do not. A fault ends the
motion, and passes half a second later by itself. A share of the voltage is put on the phases as it is, and 0,
which is also what a velocity below the least one is, shorts them. What the loops inside do is ours. Other
than the vendor's it has not just been fed when it is switched on, drives with less than its least current,
and reports no average.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.messages import MILLISECOND, Nanos, Obeyed
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.servo import Gains, clamp
from protocols.toolkit.table import Decoded
from protocols.vesc import table as vt
from protocols.vesc.options import MotorOptions, MotorSettings

FAULT_STOP: Nanos = 500 * MILLISECOND
MOST_DUTY = 0.95


@dataclass(slots=True)
class Motor:
    """What a controller makes of a message; it keeps nothing of earlier ones."""

    name: str
    addresses: tuple[int, ...]
    """Whose messages it obeys."""
    options: MotorOptions
    settings: MotorSettings

    def takes(self, decoded: Decoded) -> bool:
        """True if a message is for this controller, and to be carried out."""
        return decoded.address in self.addresses and decoded.values.get("mode", 0) in vt.REPLIES

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the controller does on this message. A velocity below the least one arms nothing."""
        if decoded.name == "REBOOT" and self.takes(decoded):
            return (msg.Reboot(self.name),)
        if "value" not in decoded.values or not self.takes(decoded):
            return ()
        unused = () if decoded.name in vt.SENT else (msg.Kept(self.name, decoded.name, 1.0),)
        return *unused, *self._does(decoded)

    def _does(self, decoded: Decoded) -> Sequence[Obeyed]:
        name, value, options = self.name, decoded.values["value"], self.options
        torque = value * options.torque_constant
        match decoded.name.removeprefix("COMM_"):
            case "SET_RPM":
                velocity = msg.Velocity(name, value * options.erpm)
                return (velocity,) if self.is_slow(value) else (msg.Arm(name), velocity)
            case "SET_POS":
                return msg.Arm(name), msg.Position(name, math.radians(value))
            case "SET_DUTY":  # what a motor without load does at that voltage
                unloaded = value * self.settings.supply / options.torque_constant
                return msg.Arm(name), msg.Velocity(name, unloaded)
            case _ if not value:
                return (msg.Idle(name),)
            case "SET_CURRENT" | "SET_CURRENT delayed":
                return msg.Arm(name), msg.Torque(name, torque)
            case "SET_CURRENT_REL":
                return msg.Arm(name), msg.Torque(name, torque * options.max_current)
            case "SET_CURRENT_BRAKE" | "SET_CURRENT_BRAKE_REL":
                return msg.Arm(name), msg.Velocity(name, 0.0)
        return msg.Arm(name), msg.Hold(name)  # the handbrake

    def is_slow(self, erpm: float) -> bool:
        """True if a velocity is below the least one."""
        return abs(erpm) < (self.settings.min_erpm or self.options.min_erpm)

    def duty(self, decoded: Decoded) -> float | None:
        """Return the share of the supply that a message puts on the phases of a controller that drives; None:
        what its loops make of it."""
        match decoded.name.removeprefix("COMM_"):
            case "SET_DUTY":
                return float(decoded.values["value"])
            case "SET_RPM" if self.is_slow(decoded.values["value"]):
                return 0.0
        return None


class VescFirmware(ServoFirmware):
    """One controller with its motor."""

    faults = vt.FAULTS
    passing = FAULT_STOP

    def __init__(self, device: Device, seed: int, memory: Motor) -> None:
        most = device.options.max_current * device.options.torque_constant
        super().__init__(device, seed, Gains(torque_limit=most))
        self.memory = memory
        self.timed_out = True
        self.duty: float | None = None
        """The share of the supply on the phases, if that is commanded."""

    # -- timeout and faults ---------------------------------------------------------------------------

    def timeout(self) -> Nanos:
        timeout = self.settings.timeout_ms or self.device.options.timeout_ms
        return 0 if self.timed_out else milliseconds(timeout)

    def feed(self, t: Nanos) -> None:
        super().feed(t)
        self.timed_out = False

    def on_timeout(self) -> None:
        self.timed_out = True
        self.disarm()

    # -- messages -------------------------------------------------------------------------------------

    def command(self, t: Nanos, decoded: Decoded) -> None:
        """Carry out a message to it that is no question: all of them feed the timeout."""
        for obeyed in self.memory.obey(decoded):
            self.obey(t, obeyed)
        self.duty = self.memory.duty(decoded) if "value" in decoded.values else self.duty
        self.feed(t)

    @property
    def state(self) -> int:
        """Whether the timeout has passed (1), and the kill switch is on (2)."""
        return self.timed_out | (self.fault == vt.KILL) << 1

    @property
    def code(self) -> int:
        """The vendor's code of the fault."""
        return 0 if self.fault == vt.KILL else self.fault

    def measured(self) -> dict[str, float]:
        """Return what it reports, by the names of the status messages."""
        options, settings, encoder = self.device.options, self.settings, self.encoder
        current = self.torque / options.torque_constant
        needed = encoder.velocity * options.torque_constant + current * settings.resistance
        duty = clamp(needed / settings.supply, MOST_DUTY)
        turning = round(duty, 3) or encoder.velocity  # phases that are shorted take no power
        return {
            "velocity": round(encoder.velocity / options.erpm),
            "current": math.copysign(1.0, turning) * current,
            "duty": duty,
            "position": round(encoder.position / options.step),
            "voltage": settings.supply,
            "fet": settings.temperature,
            "motor": settings.temperature,
        }

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        if self.duty is None or self.mode is not msg.Mode.ARMED:
            return torque
        self.servo.reset()
        constant, settings = self.device.options.torque_constant, self.settings
        current = (clamp(self.duty, MOST_DUTY) * settings.supply - constant * velocity) / settings.resistance
        return clamp(current * constant, self.servo.gains.torque_limit)
