"""The device's end of a plain line: a sensor, and the firmware of a small motor controller.

Rules. A device obeys what `decoder` decodes: whole messages to its address, or to all (Scan, SetId). A sensor
sends what the world shows it at once. A motor is armed by any command but Idle, and its watchdog is fed by
commands alone. A fault disarms, is sent with every State, and is cleared only by ClearFault or Reboot.
README.md holds the table of behaviours.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, Obeyed, seconds
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plugin import Device, FaultInfo, Twin

BOOT: Nanos = 50 * MILLISECOND
"""Time from Reboot to ready."""
WATCHDOG_EXPIRED, EMERGENCY_STOP = 1, 2
FAULTS = {
    WATCHDOG_EXPIRED: FaultInfo(
        "watchdog expired", "no command came within watchdog_ms", "find why the host fell silent, then clear"
    ),
    EMERGENCY_STOP: FaultInfo("emergency stop", "requested by the host", "clear when it is safe"),
}
"""The faults of a motor, by code."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of a plain device. All but `serial` can be read and written while it runs."""

    serial: int = 0
    """Serial number, sent in answer to Scan."""
    watchdog_ms: float = 100.0
    """Time without a command after which an armed motor faults; 0 is never."""
    feedback_ms: float = 5.0
    """Period of Feedback."""
    state_ms: float = 100.0
    """Period of State, which is sent at every change too."""
    position_gain: float = 1.0
    """N·m/rad"""
    position_damping: float = 0.05
    """N·m·s/rad"""
    velocity_gain: float = 0.05
    """N·m·s/rad"""
    velocity_integral: float = 0.5
    """N·m/rad"""
    torque_limit: float = 2.0
    """N·m; every command is limited to it"""
    torque_constant: float = 0.1
    """N·m/A"""
    supply: float = 24.0
    """V"""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{f.name} must be zero or more, not {value}")
        for name in ("feedback_ms", "state_ms", "torque_constant"):
            if getattr(self, name) < 1e-3:
                raise ValueError(f"{name} must be more than zero, not {getattr(self, name)}")


WRITABLE = tuple(f.name for f in fields(Settings) if f.name != "serial")


def twin(device: Device, _seed: int = 0) -> Twin:
    """Return the device at a plain address. Nothing in it is random: noise is the world's."""
    return PlainMotor(device) if device.options.kind == "motor" else PlainSensor(device)


def answer_broadcast(device: Device, request: Obeyed, t: Nanos, answers: list[Event]) -> Device:
    """Append the answer to a request to all devices. Returns the device, with its new address if any."""
    serial = device.settings.serial
    if isinstance(request, msg.SetId) and request.serial == serial and 1 <= request.address <= 0xFF:
        device = replace(device, address=request.address)
    elif not isinstance(request, msg.Scan):
        return device
    answers.append(msg.Found(t, codec.NAME, device.address, serial, device.options.kind))
    return device


def encoded(device: Device, now: Nanos, events: Sequence[Event]) -> list[bytes]:
    """Encode a device's events. What no message can hold (not finite, too long) is not sent."""
    frames = []
    for event in events:
        with contextlib.suppress(ValueError):
            frames.append(codec.encode(device.address, event, now))
    return frames


class PlainSensor:
    """A lidar, an inertial sensor or a satellite receiver."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._decoder = PlainDecoder([device])
        self._answers: list[Event] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Answer Scan and SetId."""
        for request in self._decoder.decode(t, frame):
            self._device = answer_broadcast(self._device, request, t, self._answers)
            self._decoder.follow(self._device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Send what the world shows to this sensor, each measurement at once."""
        own = [
            event
            for event in truth
            if isinstance(event, msg.Imu | msg.LaserScan | msg.Fix) and event.sensor == self._device.name
        ]
        frames = encoded(self._device, now, [*self._answers, *own])
        self._answers = []
        return [], frames

    def due(self) -> Nanos | None:
        """Return None: a sensor sends when the world shows it something."""
        return None

    def provoke(self, code: int) -> None:
        """Raise ValueError: a sensor has no faults."""
        raise ValueError(f"a plain sensor has no fault {code}")


class PlainMotor:
    """The firmware of a plain motor. The shaft that it turns is the world's."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._settings: Settings = device.settings
        self._decoder = PlainDecoder([device])
        self._now: Nanos | None = None
        self._mode = Mode.READY
        self._ready_at: Nanos = 0
        """When a restart is over."""
        self._fault: msg.Fault | None = None
        self._provoked: int | None = None
        """Code of a fault that is to trip at the next chance."""
        self._command: Command = msg.Idle(device.name)
        self._fed: Nanos = 0
        """Time of the last command."""
        self._shaft: msg.Feedback | None = None
        """The last measurement of the encoder, before the offset."""
        self._offset = 0.0
        self._held: float | None = None
        """rad, position of the shaft at the first Hold; None: not yet measured."""
        self._integral = 0.0
        """N·m of the velocity loop's integrator"""
        self._torque = 0.0
        self._feedback_at: Nanos = 0
        self._state_at: Nanos = 0
        self._answers: list[Event] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey what these bytes complete, at once; answers are sent with the next step."""
        self._watch(t)
        for message in self._decoder.decode(t, frame):
            if isinstance(message, Command):
                self._obey(t, message)
            elif isinstance(message, codec.MotorRequest):
                self._answers.append(self._answer(t, message))
            elif isinstance(message, codec.BroadcastRequest):
                self._device = answer_broadcast(self._device, message, t, self._answers)
                self._decoder.follow(self._device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Run the control loop on the measured shaft, and send what is due."""
        for event in truth:
            if isinstance(event, msg.Feedback) and event.motor == self._device.name and _is_measured(event):
                self._shaft = event
        self._watch(now)
        if self._now is None:
            self._now = self._state_at = self._feedback_at = now
        dt = seconds(max(now - self._now, 0))
        self._now = now
        self._torque = self._loop(dt) if self._mode == Mode.ARMED else 0.0
        frames = encoded(self._device, now, [*self._answers, *self._cyclic(now)])
        self._answers = []
        return [msg.Torque(self._device.name, self._torque)], frames

    def due(self) -> Nanos | None:
        """Return when it next sends its state or feedback, trips its watchdog, or is ready again."""
        times = [self._state_at]
        if self._shaft is not None:
            times.append(self._feedback_at)
        if self._mode == Mode.ARMED and self._settings.watchdog_ms:
            times.append(self._fed + round(self._settings.watchdog_ms * MILLISECOND) + 1)
        if self._mode == Mode.INITIALISING:
            times.append(self._ready_at)
        if self._provoked:
            times.append(self._now or 0)
        return min(times)

    def provoke(self, code: int) -> None:
        """Trip a fault the next time that the firmware runs. Raises ValueError for an unknown code."""
        if code not in FAULTS:
            raise ValueError(f"a plain motor has no fault {code}")
        self._provoked = code

    # -- modes -----------------------------------------------------------------------------------------

    def _watch(self, now: Nanos) -> None:
        """Change the mode where time demands it: end of a restart, watchdog expired, fault provoked."""
        if self._mode == Mode.INITIALISING and now >= self._ready_at:
            self._enter(self._ready_at, Mode.READY)
        timeout = round(self._settings.watchdog_ms * MILLISECOND)
        if self._mode == Mode.ARMED and timeout and now - self._fed > timeout:
            self._trip(now, WATCHDOG_EXPIRED)
        if self._provoked:
            self._trip(now, self._provoked)
            self._provoked = None

    def _obey(self, t: Nanos, command: Command) -> None:
        """Take a command: it arms and feeds the watchdog, except in fault or during a restart."""
        if self._mode not in (Mode.READY, Mode.ARMED):
            return
        self._fed = t
        if type(command) is not type(self._command):
            self._integral, self._held = 0.0, None
        self._command = command
        self._enter(t, Mode.READY if isinstance(command, msg.Idle) else Mode.ARMED)

    def _enter(self, t: Nanos, mode: Mode) -> None:
        """Change the mode, and send State with the next step."""
        if mode != self._mode:
            self._mode, self._state_at, self._integral = mode, t, 0.0

    def _trip(self, t: Nanos, code: int) -> None:
        info = FAULTS[code]
        self._fault = msg.Fault(self._device.name, t, code, info.name, info.cause, info.remedy)
        self._command = msg.Idle(self._device.name)
        self._enter(t, Mode.FAULT)

    # -- requests --------------------------------------------------------------------------------------

    def _answer(self, t: Nanos, request: codec.MotorRequest) -> msg.Done | msg.Refused | msg.Parameter:
        """Carry out a request if that is possible."""
        name, reason = self._device.name, ""
        if self._mode == Mode.INITIALISING:
            reason = "restarting"
        elif isinstance(request, msg.ReadParameter):
            value = getattr(self._settings, request.parameter, None)
            if isinstance(value, int | float):
                return msg.Parameter(name, t, request.parameter, float(value))
            reason = f"no parameter {request.parameter!r}"
        elif isinstance(request, msg.WriteParameter):
            reason = self._write(request)
        elif isinstance(request, msg.Zero):
            reason = self._zero()
        elif isinstance(request, msg.ClearFault):
            self._fault = None
            self._enter(t, Mode.READY if self._mode == Mode.FAULT else self._mode)
        elif isinstance(request, msg.Estop):
            self._trip(t, EMERGENCY_STOP)
        else:
            self._fault, self._command, self._ready_at = None, msg.Idle(name), t + BOOT
            self._offset = 0.0
            self._enter(t, Mode.INITIALISING)
        kind = type(request).__name__
        return msg.Refused(t, kind, name, reason) if reason else msg.Done(t, kind, name)

    def _write(self, request: msg.WriteParameter) -> str:
        """Write a setting. Returns why it is refused, or ""."""
        if request.parameter not in WRITABLE:
            return f"no parameter {request.parameter!r} that can be written"
        change: dict[str, Any] = {request.parameter: request.value}
        try:
            self._settings = replace(self._settings, **change)
        except ValueError as error:
            return str(error)
        return ""

    def _zero(self) -> str:
        """Make the present position zero. Returns why it is refused, or ""."""
        if self._mode == Mode.ARMED:
            return "armed: the shaft would jump; send Idle first"
        if self._shaft is None or self._shaft.position is None:
            return "the shaft has not been measured yet"
        self._offset = self._shaft.position
        return ""

    # -- the shaft -------------------------------------------------------------------------------------

    def _position(self) -> float:
        """Return the measured position less the offset of Zero [rad]."""
        position = self._shaft.position if self._shaft else None
        return (position or 0.0) - self._offset

    def _loop(self, dt: float) -> float:
        """Return the torque [N·m] of the command, limited; dt in s."""
        if self._shaft is None:
            return 0.0
        s, command = self._settings, self._command
        position, velocity = self._position(), self._shaft.velocity or 0.0
        if isinstance(command, msg.Hold):
            self._held = position if self._held is None else self._held
            command = msg.Position(command.motor, self._held)
        if isinstance(command, msg.Position):
            spring = s.position_gain * (command.position - position)
            torque = command.torque + spring + s.position_damping * (command.velocity - velocity)
        elif isinstance(command, msg.Impedance):
            spring = command.stiffness * (command.position - position)
            torque = command.torque + spring + command.damping * (command.velocity - velocity)
        elif isinstance(command, msg.Velocity):
            error = command.velocity - velocity
            self._integral = _clamp(self._integral + s.velocity_integral * error * dt, s.torque_limit)
            torque = command.torque + s.velocity_gain * error + self._integral
        else:
            torque = command.torque if isinstance(command, msg.Torque) else 0.0
        return _clamp(torque, s.torque_limit)

    def _cyclic(self, now: Nanos) -> list[Event]:
        """Return State with an active fault, and Feedback, where they are due."""
        events: list[Event] = []
        name, s = self._device.name, self._settings
        if now >= self._state_at:
            events.append(msg.State(name, now, self._mode, self._mode.value))
            events += [self._fault] if self._fault else []
            self._state_at = _next(self._state_at, s.state_ms, now)
        if self._shaft is not None and now >= self._feedback_at:
            t, current = min(self._shaft.t, now), self._torque / s.torque_constant
            position, velocity = self._position(), self._shaft.velocity
            events.append(msg.Feedback(name, t, position, velocity, self._torque, current, s.supply))
            self._feedback_at = _next(self._feedback_at, s.feedback_ms, now)
        return events


def _is_measured(shaft: msg.Feedback) -> bool:
    values = (shaft.position, shaft.velocity)
    return all(value is not None and math.isfinite(value) for value in values)


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _next(due: Nanos, period_ms: float, now: Nanos) -> Nanos:
    """Return the first multiple of the period after `due` that lies after `now`; missed ones are skipped."""
    period = max(round(period_ms * MILLISECOND), 1)
    return due + period * ((now - due) // period + 1)
