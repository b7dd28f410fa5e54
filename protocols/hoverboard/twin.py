"""The device's end: what one motor of a board obeys, and its half of the firmware.

Rules. A twin is one motor; both halves of a board get the same messages, and each sends a feedback of its own
with `UNKNOWN` in the place of the other's speed (a board sends one for both). Motors are enabled by a message
with little in it, and stay so. Silence makes them coast; the next message drives them again. In VLT_MODE a
motor is a damper about the speed that its voltage gives it; other loops are ours. A real one shorts its
phases at 0 in VLT_MODE until the timeout: this one lets go at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from protocols import messages as msg
from protocols.frames import Frame
from protocols.hoverboard import table as hb
from protocols.hoverboard.options import Options
from protocols.messages import MILLISECOND, Mode, Nanos, Obeyed
from protocols.plugin import Device, FaultInfo
from protocols.toolkit.packets import PacketFirmware
from protocols.toolkit.servo import Gains, approach, clamp
from protocols.toolkit.table import Decoded

SLOPE = 6000.0
"""Counts a second by which an input follows (DEFAULT_RATE: 30 in 5 ms)"""


@dataclass(slots=True)
class Memory:
    """What a motor keeps of the messages to its board."""

    name: str
    address: int
    options: Options
    enabled: bool = False

    def obey(self, decoded: Decoded) -> Sequence[Obeyed]:
        """Return what the motor does on this message."""
        steer, speed = decoded.values["steer"], decoded.values["speed"]
        self.enabled |= abs(steer) < hb.LITTLE and abs(speed) < hb.LITTLE
        if not self.enabled:
            return ()
        counts, options = hb.unmix(steer, speed, tank=self.options.tank).of(self.address), self.options
        number = counts * options.unit
        if options.control == "torque":
            return (msg.Arm(self.name), msg.Torque(self.name, number)) if counts else (msg.Idle(self.name),)
        if counts:
            return msg.Arm(self.name), msg.Velocity(self.name, number)
        return (msg.Velocity(self.name, 0.0) if options.control == "speed" else msg.Idle(self.name),)


def memory_of(device: Device) -> Memory:
    """Return a motor as it is when switched on."""
    return Memory(device.name, device.address, device.options)


class HoverboardTwin(PacketFirmware):
    """One motor, and its half of the board."""

    faults: Mapping[int, FaultInfo] = {}
    messages = hb.COMMANDS

    def __init__(self, device: Device, seed: int) -> None:
        settings, options = device.settings, device.options
        most = settings.current_most * settings.torque_constant
        super().__init__(device, seed, Gains(torque_limit=most), memory_of(device))
        self.speed_up = self.slow_down = SLOPE * options.unit
        self.echo = (0, 0)
        self.silent = True
        """The timeout has passed."""
        self.applied = 0.0
        """rad/s that the voltage gives a wheel without a load"""

    def timeout(self) -> Nanos:
        return 0 if self.silent else hb.TIMEOUT_MS * MILLISECOND

    def on_timeout(self) -> None:
        self.silent, self.echo = True, (0, 0)
        self.disarm()

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        self.feed(t)
        self.silent, self.echo = False, (decoded.values["steer"], decoded.values["speed"])
        super().on_message(t, message, decoded)

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        if self.memory.options.control != "duty" or self.mode is not Mode.ARMED:
            self.applied = velocity
            return torque
        goal = getattr(self.goal, "velocity", 0.0)
        self.applied = approach(dt, self.applied, goal, self.speed_up, self.slow_down)
        settings = self.settings
        damping = settings.torque_constant**2 / settings.resistance
        return clamp(damping * (self.applied - velocity), self.servo.gains.torque_limit)

    def cyclic(self) -> Mapping[str, Nanos]:
        return {"feedback": hb.PERIOD_MS * MILLISECOND}

    def report(self, name: str) -> Frame:
        address, options, settings = self.memory.address, self.memory.options, self.settings
        rpm = round(options.sign(address) * clamp(self.encoder.velocity / hb.RPM, (1 << 15) - 1))
        left = address == hb.LEFT
        return hb.FEEDBACK.encode(
            name,
            steer=self.echo[0],
            speed=self.echo[1],
            left=rpm if left else hb.UNKNOWN,
            right=hb.UNKNOWN if left else rpm,
            voltage=settings.voltage,
            temperature=settings.temperature,
            led=0,
        )
