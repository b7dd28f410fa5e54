"""The device: its ear, and the firmware behind it. The shaft belongs to the world.

Rules. RUN arms, STOP disarms; only they feed the watchdog. A fault disarms, and only CLEAR ends it. The
status goes out by itself, every `STATUS_PERIOD`.

FILL IN the firmware's habits from its manual, and write down in README.md where each of them is from. The
clauses "watchdog", "faults", "disarm" and "copies" tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from protocols.frames import Frame
from protocols.messages import (
    MILLISECOND,
    ClearFault,
    Event,
    Feedback,
    Idle,
    Nanos,
    Torque,
    Velocity,
    seconds,
)
from protocols.plugin import Device

from . import codec
from .codec import STATUS_PERIOD, DeviceMode, Status
from .ear import MotorDecoder
from .faults import FAULTS
from .framing import STATUS, message


@dataclass(frozen=True, slots=True)
class Settings:
    """What is configured on the device itself."""

    watchdog_ms: float = 100.0
    """Silence of the host after which a running motor trips; 0 is never."""
    velocity_gain: float = 0.02
    """N·m·s/rad"""
    velocity_integral: float = 0.2
    """N·m/rad"""
    torque_limit: float = 2.0
    """N·m"""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not math.isfinite(value) or value < 0:
                raise ValueError(f"{f.name} must be zero or more, not {value}")


class MotorTwin:
    """One device."""

    def __init__(self, device: Device, seed: int) -> None:  # noqa: ARG002 -- nothing in it is random
        self._name, self._address = device.name, device.address
        self._settings: Settings = device.settings
        self._decoder = MotorDecoder([device])
        self._mode = DeviceMode.READY
        self._fault = 0
        self._wanted = 0.0
        """rad/s"""
        self._fed: Nanos = 0
        """When RUN was last heard."""
        self._gathered = 0.0
        """N·m, of the integral"""
        self._position, self._velocity = 0.0, 0.0
        self._now: Nanos | None = None
        self._next: Nanos = 0
        """When the next status goes out."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey, at once."""
        self._watch(t)
        for word in self._decoder.decode(t, frame):
            match word:
                case Velocity() if self._mode != DeviceMode.FAULT:
                    self._mode, self._wanted, self._fed = DeviceMode.RUNNING, word.velocity, t
                case Idle() if self._mode != DeviceMode.FAULT:
                    self._disarm(DeviceMode.READY)
                case ClearFault() if self._mode == DeviceMode.FAULT:
                    self._fault = 0
                    self._disarm(DeviceMode.READY)
                case _:
                    pass

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Run the velocity loop, and tell the status when it is due."""
        for word in truth:
            if isinstance(word, Feedback) and word.motor == self._name:
                self._see(word)
        self._watch(now)
        if self._now is None:
            self._now = self._next = now
        torque = self._loop(seconds(max(now - self._now, 0)))
        self._now = now
        return [Torque(self._name, torque)], self._status(now)

    def due(self) -> Nanos | None:
        """When it next tells its status, or loses its patience."""
        patience = self._patience()
        return min(self._next, self._fed + patience) if patience else self._next

    def provoke(self, code: int) -> None:
        """Trip a fault, as if by itself. ValueError if there is no such fault."""
        if code not in FAULTS:
            raise ValueError(f"no fault {code}; there are {sorted(FAULTS)}")
        self._fault = code
        self._disarm(DeviceMode.FAULT)

    # -- the firmware ----------------------------------------------------------------------------------

    def _patience(self) -> Nanos:
        """How long the host may be silent now; 0: as long as it likes."""
        running = self._mode == DeviceMode.RUNNING
        return round(self._settings.watchdog_ms * MILLISECOND) if running else 0

    def _watch(self, now: Nanos) -> None:
        patience = self._patience()
        if patience and now - self._fed >= patience:
            self.provoke(codec.WATCHDOG)

    def _disarm(self, mode: DeviceMode) -> None:
        self._mode, self._wanted, self._gathered = mode, 0.0, 0.0

    def _see(self, shaft: Feedback) -> None:
        """What the encoder measures; what is not finite it does not measure."""
        if shaft.position is not None and math.isfinite(shaft.position):
            self._position = shaft.position
        if shaft.velocity is not None and math.isfinite(shaft.velocity):
            self._velocity = shaft.velocity

    def _loop(self, dt: float) -> float:
        """The torque of a PI loop, cut to the limit; dt in s."""
        if self._mode != DeviceMode.RUNNING:
            return 0.0
        limit, error = self._settings.torque_limit, self._wanted - self._velocity
        self._gathered = _cut(self._gathered + self._settings.velocity_integral * error * dt, limit)
        return _cut(self._settings.velocity_gain * error + self._gathered, limit)

    def _status(self, now: Nanos) -> list[Frame]:
        if now < self._next:
            return []
        self._next += STATUS_PERIOD * ((now - self._next) // STATUS_PERIOD + 1)
        reported = Status(self._mode, self._fault, self._velocity, self._position)
        return [message(STATUS, self._address, codec.status(reported))]


def _cut(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
