"""The device's end of a plain line: the firmware of a small motor controller (`sensor` has the sensors).

Rules. A device obeys whole messages to its address, or to everyone (Scan, SetId), whose numbers lie
within `line.LIMITS`; all else it does not hear. A motor is armed by any command but Idle, and its
watchdog is fed by commands alone. A fault disarms, is told with every State, and goes only by ClearFault
or Reboot. README.md holds the table of behaviours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Command, Event, Mode, Nanos, seconds
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plain.sensor import PlainSensor, messages_of, to_all
from protocols.plain.settings import FAULT_TABLE, WRITABLE, Settings
from protocols.plugin import Device, Twin

BOOT: Nanos = 50 * MILLISECOND
"""From Reboot to ready."""


class PlainMotor:
    """The firmware of a plain motor. The shaft it turns is the world's."""

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
        """A fault that is to trip, whatever the reason."""
        self._command: Command = msg.Idle(device.name)
        self._fed: Nanos = 0
        """When the last command came."""
        self._shaft: msg.Feedback | None = None
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

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey what these bytes complete, at once; answers go out with the next step."""
        self._watch(t)
        for word in self._decoder.decode(t, frame):
            if isinstance(word, Command):
                self._obey(t, word)
            elif isinstance(word, codec.MotorRequest):
                self._answer(t, word)
            else:
                device = to_all(self._device, word, t, self._answers)
                if device is not self._device:
                    self._device = device
                self._decoder.follow(device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Run the loop with the shaft as it is, and say what is due."""
        for word in truth:
            if isinstance(word, msg.Feedback) and word.motor == self._device.name and _measured(word):
                self._shaft = word
        self._watch(now)
        if self._now is None:
            self._now = self._state_at = self._feedback_at = now
        dt = seconds(max(now - self._now, 0))
        self._now = now
        self._torque = self._loop(dt) if self._mode == Mode.ARMED else 0.0
        said = [*self._answers, *self._cyclic(now)]
        self._answers = []
        return [msg.Torque(self._device.name, self._torque)], messages_of(self._device, now, said)

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
        if code not in FAULT_TABLE:
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
        self._enter(t, Mode.READY if isinstance(command, msg.Idle) else Mode.ARMED)

    def _enter(self, t: Nanos, mode: Mode) -> None:
        """Change the mode, and have it told with the next step."""
        if mode != self._mode:
            self._mode, self._state_at, self._integral = mode, t, 0.0

    def _trip(self, t: Nanos, code: int) -> None:
        said = FAULT_TABLE[code]
        self._fault = msg.Fault(self._device.name, t, code, said.name, said.cause, said.remedy)
        self._command = msg.Idle(self._device.name)
        self._enter(t, Mode.FAULT)

    # -- requests --------------------------------------------------------------------------------------

    def _answer(self, t: Nanos, word: codec.MotorRequest) -> None:
        """Do what is asked; say that it is done, or why not."""
        name, request = self._device.name, type(word).__name__
        refused = ""
        if self._mode == Mode.INITIALISING:
            refused = "restarting"
        elif isinstance(word, msg.ReadParameter):
            value = getattr(self._settings, word.parameter, None)
            if isinstance(value, int | float):
                self._answers.append(msg.Parameter(name, t, word.parameter, float(value)))
                return
            refused = f"no parameter {word.parameter!r}"
        elif isinstance(word, msg.WriteParameter):
            refused = self._write(word)
        elif isinstance(word, msg.Zero):
            refused = self._zero()
        elif isinstance(word, msg.ClearFault):
            self._fault = None
            self._enter(t, Mode.READY if self._mode == Mode.FAULT else self._mode)
        elif isinstance(word, msg.Estop):
            self._trip(t, 2)
        elif isinstance(word, msg.Reboot):
            self._fault, self._command, self._ready_at = None, msg.Idle(name), t + BOOT
            self._offset = 0.0
            self._enter(t, Mode.INITIALISING)
        self._answers.append(
            msg.Refused(t, request, name, refused) if refused else msg.Done(t, request, name)
        )

    def _write(self, word: msg.WriteParameter) -> str:
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
            self._integral = _cut(self._integral + s.velocity_integral * error * dt, s.torque_limit)
            torque = command.torque + s.velocity_gain * error + self._integral
        else:
            torque = command.torque if isinstance(command, msg.Torque) else 0.0
        return _cut(torque, s.torque_limit)

    def _cyclic(self, now: Nanos) -> list[Event]:
        """State with the fault that stands, and Feedback, when they are due."""
        said: list[Event] = []
        name, s = self._device.name, self._settings
        if now >= self._state_at:
            said.append(msg.State(name, now, self._mode, self._mode.value))
            said += [self._fault] if self._fault else []
            self._state_at = _next(self._state_at, s.state_ms, now)
        if self._shaft is not None and now >= self._feedback_at:
            current = self._torque / s.torque_constant
            t = min(self._shaft.t, now)
            said.append(
                msg.Feedback(name, t, self._position(), self._shaft.velocity, self._torque, current, s.supply)
            )
            self._feedback_at = _next(self._feedback_at, s.feedback_ms, now)
        return said


def twin(device: Device, _seed: int = 0) -> Twin:
    """The device behind a plain address. Nothing in it is random: noise is the world's."""
    return PlainMotor(device) if device.options.kind == "motor" else PlainSensor(device)


def _measured(shaft: msg.Feedback) -> bool:
    values = (shaft.position, shaft.velocity)
    return all(value is not None and math.isfinite(value) for value in values)


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def _next(due: Nanos, period_ms: float, now: Nanos) -> Nanos:
    """The next multiple of the period after `due` that lies behind now; what was missed is left out."""
    period = max(round(period_ms * MILLISECOND), 1)
    return due + period * ((now - due) // period + 1)
