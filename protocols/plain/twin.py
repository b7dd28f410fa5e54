"""The device's end of a plain line: a sensor, and the firmware of a small motor controller.

Rules. A device obeys whole messages to its address, or to everyone (Scan, SetId), whose numbers lie
within `line.LIMITS`; all else it does not hear. A sensor tells what the world shows it at once. A motor
is armed by any command but Idle, and its watchdog is fed by commands alone. A fault disarms, is told
with every State, and goes only by ClearFault or Reboot. README.md holds the table of behaviours.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from protocols.plain import line
from protocols.plain.ear import PlainEar
from protocols.plugin import Complaint, Device, Twin
from protocols.wire import Wire
from protocols.words import (
    MILLISECOND,
    ClearFault,
    Command,
    Done,
    Estop,
    Event,
    Fault,
    Feedback,
    Fix,
    Found,
    Hold,
    Idle,
    Impedance,
    Imu,
    LaserScan,
    Mode,
    Nanos,
    Parameter,
    Position,
    ReadParameter,
    Reboot,
    Refused,
    Request,
    Scan,
    SetId,
    State,
    Torque,
    Velocity,
    WriteParameter,
    Zero,
    seconds,
)

BOOT: Nanos = 50 * MILLISECOND
"""From Reboot to ready."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on a plain device. All but `serial` can be read and written while it runs."""

    serial: int = 0
    """Serial number, told to Scan."""
    watchdog_ms: float = 100.0
    """Silence of the host after which an armed motor faults; 0 is never."""
    feedback_ms: float = 5.0
    """Period of Feedback."""
    state_ms: float = 100.0
    """Period of State, which is told at every change too."""
    position_gain: float = 1.0
    """N·m/rad"""
    position_damping: float = 0.05
    """N·m·s/rad"""
    velocity_gain: float = 0.05
    """N·m·s/rad"""
    velocity_integral: float = 0.5
    """N·m/rad"""
    torque_limit: float = 2.0
    """N·m; whatever is commanded is cut to it"""
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


COMPLAINTS = {
    1: Complaint(
        "watchdog expired", "no command came within watchdog_ms", "find why the host fell silent, then clear"
    ),
    2: Complaint("emergency stop", "asked for by the host", "clear when it is safe"),
}
"""What a motor may complain of, by code."""

WRITABLE = tuple(f.name for f in fields(Settings) if f.name != "serial")


class PlainSensor:
    """A lidar, an inertial sensor or a satellite receiver."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._ear = PlainEar([device])
        self._answers: list[Event] = []

    def receive(self, t: Nanos, wire: Wire) -> None:
        """Answer Scan and SetId."""
        for word in self._ear.hear(t, wire):
            device = _line(self._device, word, t, self._answers)
            if device is not self._device:
                self._device = device
                self._ear.follow(device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Wire]]:
        """Tell what the world shows to this sensor, each measurement at once."""
        shown = [w for w in truth if isinstance(w, Imu | LaserScan | Fix) and w.sensor == self._device.name]
        said = [*self._answers, *shown]
        self._answers = []
        return [], _messages(self._device, now, said)

    def due(self) -> Nanos | None:
        """A sensor speaks when the world shows it something."""
        return None

    def provoke(self, code: int) -> None:
        """A sensor has no faults."""
        raise ValueError(f"a plain sensor has no fault {code}")


class PlainMotor:
    """The firmware of a plain motor. The shaft it turns is the world's."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._settings: Settings = device.settings
        self._ear = PlainEar([device])
        self._now: Nanos | None = None
        self._mode = Mode.READY
        self._ready_at: Nanos = 0
        """When a restart is over."""
        self._fault: Fault | None = None
        self._provoked: int | None = None
        """A fault that is to trip, whatever the reason."""
        self._command: Command = Idle(device.name)
        self._fed: Nanos = 0
        """When the last command came."""
        self._shaft: Feedback | None = None
        """As the encoder last told it, before the offset."""
        self._offset = 0.0
        self._held: float | None = None
        """rad, where the shaft was when Hold was first said; None: not yet looked at."""
        self._integral = 0.0
        """N·m that the velocity loop has gathered."""
        self._torque = 0.0
        self._feedback_at: Nanos = 0
        self._state_at: Nanos = 0
        self._answers: list[Event] = []

    def receive(self, t: Nanos, wire: Wire) -> None:
        """Obey what these bytes complete, at once; answers go out with the next step."""
        self._watch(t)
        for word in self._ear.hear(t, wire):
            if isinstance(word, Command):
                self._obey(t, word)
            elif isinstance(word, line.MotorRequest):
                self._answer(t, word)
            else:
                device = _line(self._device, word, t, self._answers)
                if device is not self._device:
                    self._device = device
                self._ear.follow(device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Wire]]:
        """Run the loop with the shaft as it is, and say what is due."""
        for word in truth:
            if isinstance(word, Feedback) and word.motor == self._device.name and _measured(word):
                self._shaft = word
        self._watch(now)
        if self._now is None:
            self._now = self._state_at = self._feedback_at = now
        dt = seconds(max(now - self._now, 0))
        self._now = now
        self._torque = self._loop(dt) if self._mode == Mode.ARMED else 0.0
        said = [*self._answers, *self._cyclic(now)]
        self._answers = []
        return [Torque(self._device.name, self._torque)], _messages(self._device, now, said)

    def due(self) -> Nanos | None:
        """When it next tells its state or feedback, trips its watchdog, or is ready again."""
        moments = [self._state_at]
        if self._shaft is not None:
            moments.append(self._feedback_at)
        if self._mode == Mode.ARMED and self._settings.watchdog_ms:
            moments.append(self._fed + round(self._settings.watchdog_ms * MILLISECOND) + 1)
        if self._mode == Mode.INITIALISING:
            moments.append(self._ready_at)
        if self._provoked:
            moments.append(self._now or 0)
        return min(moments)

    def provoke(self, code: int) -> None:
        """Trip a fault at the next moment that the firmware lives through."""
        if code not in COMPLAINTS:
            raise ValueError(f"a plain motor has no fault {code}")
        self._provoked = code

    # -- modes -----------------------------------------------------------------------------------------

    def _watch(self, now: Nanos) -> None:
        """What the time does to the mode: the end of a restart, or of the watchdog's patience."""
        if self._mode == Mode.INITIALISING and now >= self._ready_at:
            self._enter(self._ready_at, Mode.READY)
        patience = round(self._settings.watchdog_ms * MILLISECOND)
        if self._mode == Mode.ARMED and patience and now - self._fed > patience:
            self._trip(now, 1)
        if self._provoked:
            self._trip(now, self._provoked)
            self._provoked = None

    def _obey(self, t: Nanos, command: Command) -> None:
        """A command arms and feeds the watchdog; a motor in fault or restarting does not obey."""
        if self._mode not in (Mode.READY, Mode.ARMED):
            return
        self._fed = t
        if type(command) is not type(self._command):
            self._integral, self._held = 0.0, None
        self._command = command
        self._enter(t, Mode.READY if isinstance(command, Idle) else Mode.ARMED)

    def _enter(self, t: Nanos, mode: Mode) -> None:
        """Change the mode, and have it told with the next step."""
        if mode != self._mode:
            self._mode, self._state_at, self._integral = mode, t, 0.0

    def _trip(self, t: Nanos, code: int) -> None:
        said = COMPLAINTS[code]
        self._fault = Fault(self._device.name, t, code, said.name, said.cause, said.cure)
        self._command = Idle(self._device.name)
        self._enter(t, Mode.FAULT)

    # -- requests --------------------------------------------------------------------------------------

    def _answer(self, t: Nanos, word: line.MotorRequest) -> None:
        """Do what is asked; say that it is done, or why not."""
        name, request = self._device.name, type(word).__name__
        refused = ""
        if self._mode == Mode.INITIALISING:
            refused = "restarting"
        elif isinstance(word, ReadParameter):
            value = getattr(self._settings, word.parameter, None)
            if isinstance(value, int | float):
                self._answers.append(Parameter(name, t, word.parameter, float(value)))
                return
            refused = f"no parameter {word.parameter!r}"
        elif isinstance(word, WriteParameter):
            refused = self._write(word)
        elif isinstance(word, Zero):
            refused = self._zero()
        elif isinstance(word, ClearFault):
            self._fault = None
            self._enter(t, Mode.READY if self._mode == Mode.FAULT else self._mode)
        elif isinstance(word, Estop):
            self._trip(t, 2)
        elif isinstance(word, Reboot):
            self._fault, self._command, self._ready_at = None, Idle(name), t + BOOT
            self._offset = 0.0
            self._enter(t, Mode.INITIALISING)
        self._answers.append(Refused(t, request, name, refused) if refused else Done(t, request, name))

    def _write(self, word: WriteParameter) -> str:
        if word.parameter not in WRITABLE:
            return f"no parameter {word.parameter!r} that can be written"
        change: dict[str, Any] = {word.parameter: word.value}
        try:
            self._settings = replace(self._settings, **change)
        except ValueError as error:
            return str(error)
        return ""

    def _zero(self) -> str:
        if self._mode == Mode.ARMED:
            return "armed: the shaft would jump; say Idle first"
        if self._shaft is None or self._shaft.position is None:
            return "the shaft has not been measured yet"
        self._offset = self._shaft.position
        return ""

    # -- the shaft -------------------------------------------------------------------------------------

    def _position(self) -> float:
        """rad, where the firmware takes the shaft to be."""
        position = self._shaft.position if self._shaft else None
        return (position or 0.0) - self._offset

    def _loop(self, dt: float) -> float:
        """The torque that the command asks for, cut to the limit; dt in s."""
        if self._shaft is None:
            return 0.0
        s, command = self._settings, self._command
        position, velocity = self._position(), self._shaft.velocity or 0.0
        if isinstance(command, Hold):
            self._held = position if self._held is None else self._held
            command = Position(command.motor, self._held)
        if isinstance(command, Position):
            spring = s.position_gain * (command.position - position)
            torque = command.torque + spring + s.position_damping * (command.velocity - velocity)
        elif isinstance(command, Impedance):
            spring = command.stiffness * (command.position - position)
            torque = command.torque + spring + command.damping * (command.velocity - velocity)
        elif isinstance(command, Velocity):
            error = command.velocity - velocity
            self._integral = _cut(self._integral + s.velocity_integral * error * dt, s.torque_limit)
            torque = command.torque + s.velocity_gain * error + self._integral
        else:
            torque = command.torque if isinstance(command, Torque) else 0.0
        return _cut(torque, s.torque_limit)

    def _cyclic(self, now: Nanos) -> list[Event]:
        """State with the fault that stands, and Feedback, when they are due."""
        said: list[Event] = []
        name, s = self._device.name, self._settings
        if now >= self._state_at:
            said.append(State(name, now, self._mode, self._mode.value))
            said += [self._fault] if self._fault else []
            self._state_at = _next(self._state_at, s.state_ms, now)
        if self._shaft is not None and now >= self._feedback_at:
            current = self._torque / s.torque_constant
            t = min(self._shaft.t, now)
            said.append(
                Feedback(name, t, self._position(), self._shaft.velocity, self._torque, current, s.supply)
            )
            self._feedback_at = _next(self._feedback_at, s.feedback_ms, now)
        return said


def twin(device: Device, _seed: int = 0) -> Twin:
    """The device behind a plain address. Nothing in it is random: noise is the world's."""
    return PlainMotor(device) if device.options.kind == "motor" else PlainSensor(device)


def _line(device: Device, word: Command | Request, t: Nanos, answers: list[Event]) -> Device:
    """Answer what the whole line was asked; the device as it is afterwards."""
    serial = device.settings.serial
    if isinstance(word, SetId) and word.serial == serial and 1 <= word.address <= 0xFF:
        device = replace(device, address=word.address)
    elif not isinstance(word, Scan):
        return device
    answers.append(Found(t, line.NAME, device.address, serial, device.options.kind))
    return device


def _messages(device: Device, now: Nanos, said: Sequence[Event]) -> list[bytes]:
    """The words as messages. What no message can hold (not finite, too long) is not told."""
    messages = []
    for word in said:
        with contextlib.suppress(ValueError):
            messages.append(line.message(device.address, word, now))
    return messages


def _measured(shaft: Feedback) -> bool:
    values = (shaft.position, shaft.velocity)
    return all(value is not None and math.isfinite(value) for value in values)


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _next(due: Nanos, period_ms: float, now: Nanos) -> Nanos:
    """The next multiple of the period after `due` that lies behind now; what was missed is left out."""
    period = max(round(period_ms * MILLISECOND), 1)
    return due + period * ((now - due) // period + 1)
