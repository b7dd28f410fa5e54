"""The device's end of a plain line: what it obeys, sensors, and the firmware of a small motor controller.

Rules. A device obeys whole messages to its address, or to all (Scan, SetId), with permitted numbers. A sensor
sends what the world shows it at once. A motor is armed by any command but Idle, and its watchdog is fed by
commands alone. A fault disarms, is sent with every State, and is cleared only by ClearFault or Reboot.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

from protocols import messages as msg
from protocols.bounds import Bounds, check
from protocols.frames import Frame
from protocols.messages import MILLISECOND, SECOND, Command, Event, Mode, Nanos, Obeyed, Request
from protocols.plain import table
from protocols.plugin import Device
from protocols.toolkit.firmware import ServoFirmware, milliseconds
from protocols.toolkit.serial import Stream
from protocols.toolkit.servo import Encoder, Gains, Servo

BOOT: Nanos = 50 * MILLISECOND
"""Time from Reboot to ready, without a message."""
BITS_PER_BYTE = 10
"""On a serial line, with start and stop bit"""


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of a plain device. All but `serial` can be read and written while it runs."""

    serial: Annotated[int, Bounds(0, 2**64 - 1)] = 0
    """Serial number, sent in answer to Scan."""
    watchdog_ms: Annotated[float, Bounds(0.0, 1e6)] = 100.0
    """Time without a command after which an armed motor faults; 0 is never."""
    feedback_ms: Annotated[float, Bounds(1e-3, 1e6)] = 5.0
    """Period of Feedback."""
    state_ms: Annotated[float, Bounds(1e-3, 1e6)] = 100.0
    """Period of State, which is sent at every change too."""
    position_gain: Annotated[float, Bounds(0.0, 1e6)] = 1.0
    """N·m/rad"""
    position_damping: Annotated[float, Bounds(0.0, 1e5)] = 0.05
    """N·m·s/rad"""
    velocity_gain: Annotated[float, Bounds(0.0, 1e5)] = 0.05
    """N·m·s/rad"""
    velocity_integral: Annotated[float, Bounds(0.0, 1e6)] = 0.5
    """N·m/rad"""
    torque_limit: Annotated[float, Bounds(0.0, 1e4)] = 2.0
    """N·m; every command is limited to it"""
    torque_constant: Annotated[float, Bounds(1e-3, 1e3)] = 0.1
    """N·m/A"""
    supply: Annotated[float, Bounds(0.0, 1e4)] = 24.0
    """V"""

    def __post_init__(self) -> None:
        check(self)


WRITABLE = tuple(name for name in Settings.__slots__ if name != "serial")


class PlainDecoder:
    """What plain devices would obey. A motor in fault receives a command too; its firmware ignores it."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._stream = Stream(table.FRAMING)
        self._names = {device.address: device.name for device in devices}
        self._motors = [device.name for device in devices if device.options.kind == "motor"]

    def follow(self, name: str, address: int) -> None:
        """Use this device's new address."""
        self._names = {at: other for at, other in self._names.items() if other != name} | {address: name}

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return the commands and requests in the messages that this frame completes."""
        messages = self._stream.messages(frame) if isinstance(frame, bytes) else ()
        return [obeyed for message in messages for obeyed in self._obeyed(t, message)]

    def _obeyed(self, t: Nanos, message: bytes) -> Sequence[Obeyed]:
        address = message[table.ADDRESS]
        name = self._names.get(address, "")
        decoded = table.decode(message, t, name)
        if address == table.BROADCAST:
            return (decoded,) if isinstance(decoded, table.TO_ALL) else ()
        if name not in self._motors or not isinstance(decoded, Command | table.TO_MOTOR):
            return ()
        commands = isinstance(decoded, Command) and not isinstance(decoded, msg.Idle)
        return (msg.Arm(name), decoded) if commands else (decoded,)


class PlainTwin(ServoFirmware):
    """One device; the shaft that a motor turns is the world's."""

    lost = table.WATCHDOG_EXPIRED

    def __init__(self, device: Device, seed: int) -> None:
        super().__init__(device, seed, Gains())
        self.is_motor = device.options.kind == "motor"
        self.faults = table.FAULTS if self.is_motor else {}
        self.address = device.address
        self.decoder = PlainDecoder([device])
        self.encoder = Encoder()
        self.taken: type[Command] = msg.Idle
        """What the last command was."""
        self.sent: Mode | None = None
        """The mode in the last State."""
        self.configure(device.settings)

    def configure(self, settings: Settings) -> None:
        """Use these settings."""
        gains = Gains(0.0, settings.velocity_gain, settings.velocity_integral, settings.torque_limit)
        self.settings, self.servo = settings, Servo(gains)
        periods = {"state": settings.state_ms, "feedback": settings.feedback_ms} if self.is_motor else {}
        self._periods = {name: milliseconds(period) for name, period in periods.items()}

    def timeout(self) -> Nanos:
        return milliseconds(self.settings.watchdog_ms) if self.mode is Mode.ARMED else 0

    def cyclic(self) -> Mapping[str, Nanos]:
        return self._periods

    # -- obeyed ---------------------------------------------------------------------------------------

    def receive(self, t: Nanos, frame: Frame) -> None:
        if self.now is None:  # requests are answered before the shaft was ever measured
            self.on_frame(t, frame)
        super().receive(t, frame)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for obeyed in self.decoder.decode(t, frame):
            if isinstance(obeyed, Request):
                self.reply(t, *self._encoded(t, self._answer(t, obeyed)))
            elif isinstance(obeyed, msg.Idle):
                self.disarm()
            elif isinstance(obeyed, Command) and self.now is not None:
                self._take(t, obeyed)

    def _take(self, t: Nanos, command: Command) -> None:
        """Take a command: Position is a spring, and Hold one at the position of the first Hold."""
        fresh = self.arm(t) or type(command) is not self.taken
        self.taken = type(command)
        self.feed(t)
        if fresh:
            self.servo.reset()
        if isinstance(command, msg.Hold):
            goal, now = self.goal, self.encoder.position
            held = goal.position if isinstance(goal, msg.Impedance) and not fresh else now
            command = msg.Position(command.motor, held, torque=command.torque)
        if isinstance(command, msg.Position):
            numbers = command.position, command.velocity, command.torque
            gains = self.settings.position_gain, self.settings.position_damping
            command = msg.Impedance(command.motor, *numbers, *gains)
        self.goal = command

    def _answer(self, t: Nanos, request: Request) -> Event | None:
        """Carry out a request if that is possible; None: it is another device's."""
        name, settings, reason = self.device.name, self.settings, ""
        match request:
            case msg.Scan():
                return self._found(t)
            case msg.SetId(_, serial, address):
                if serial != settings.serial or address not in table.ADDRESSES:
                    return None
                self.address = address
                self.decoder.follow(name, address)
                return self._found(t)
            case msg.ReadParameter(_, parameter) if parameter in Settings.__slots__:
                return msg.Parameter(name, t, parameter, float(getattr(settings, parameter)))
            case msg.ReadParameter(_, parameter):
                reason = f"no parameter {parameter!r}"
            case msg.WriteParameter(_, parameter, value):
                reason = self._write(parameter, value)
            case msg.Zero() if self.mode is Mode.ARMED:
                reason = "armed: the shaft would jump; send Idle first"
            case msg.Estop():
                self.trip(table.EMERGENCY_STOP)
            case msg.Reboot():
                self.restart(t, BOOT)
                self.encoder, self.sent = Encoder(), None
            case _:
                self.obey(t, request)
        kind = type(request).__name__
        return msg.Refused(t, kind, name, reason) if reason else msg.Done(t, kind, name)

    def _write(self, parameter: str, value: float) -> str:
        """Write a setting. Returns why it is refused, or ""."""
        if parameter not in WRITABLE:
            return f"no parameter {parameter!r} that can be written"
        change: dict[str, Any] = {parameter: value}
        try:
            self.configure(replace(self.settings, **change))
        except ValueError as error:
            return str(error)
        return ""

    # -- sent -----------------------------------------------------------------------------------------

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        torques, frames = super().step(now, truth)
        measured = [each for each in truth if getattr(each, "sensor", "") == self.device.name]
        return torques if self.is_motor else (), [*frames, *self._encoded(now, *measured)]

    def cycle(self, now: Nanos, dt: float, position: float, velocity: float) -> float:
        torque = super().cycle(now, dt, position, velocity)
        if self.is_motor and self.mode is not self.sent:
            self.reply(now, *self._state(now))
        return torque

    def report(self, name: str) -> Frame | None:
        now, torque = self.now or 0, self.torque
        if name == "state":
            self.reply(now, *self._state(now))
            return None
        current = torque / self.settings.torque_constant
        measured = self.encoder.position, self.encoder.velocity, torque, current, self.settings.supply
        return next(iter(self._encoded(now, msg.Feedback(self.device.name, now, *measured))), None)

    def _state(self, now: Nanos) -> list[bytes]:
        """Return State, and the active fault."""
        name, info = self.device.name, table.FAULTS.get(self.fault)
        self.sent = self.mode
        state = msg.State(name, now, self.mode, self.mode.value)
        if info is None:
            return self._encoded(now, state)
        return self._encoded(now, state, msg.Fault(name, now, self.fault, info.name, info.cause, info.remedy))

    def _found(self, t: Nanos) -> msg.Found:
        return msg.Found(t, table.NAME, self.address, self.settings.serial, self.device.options.kind)

    def _encoded(self, now: Nanos, *events: Event | None) -> list[bytes]:
        """Return events as bytes; what no message can hold (not finite, too long) is not sent."""
        encoded = []
        for event in events:
            with contextlib.suppress(ValueError):
                encoded += [self._frame(now, event)] if event else []
        return encoded

    def _frame(self, now: Nanos, event: Event) -> bytes:
        """Return an event as bytes; a measurement's age is the one when the last of them will be sent."""
        frame, rate = table.encode(self.address, event, now), self.device.line_rate
        if rate:
            frame = table.encode(self.address, event, now + BITS_PER_BYTE * len(frame) * SECOND // rate)
        return frame
