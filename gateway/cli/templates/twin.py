"""The device's end: the firmware behind the decoder. The shaft belongs to the world.

Rules. RUN arms, STOP disarms; only they feed the watchdog. A fault disarms, and only CLEAR ends it. The
status is sent cyclically, every `STATUS_PERIOD`.

FILL IN the behaviour of the firmware from its manual, and write down in README.md the source of each part.
The clauses "watchdog", "faults", "disarm" and "copies" check it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

from protocols import messages as msg
from protocols.frames import Frame
from protocols.messages import MILLISECOND, Event, Nanos, seconds
from protocols.plugin import Device

from . import codec
from .codec import STATUS_PERIOD, DeviceMode, Status
from .decoder import MotorDecoder
from .faults import FAULTS
from .framing import STATUS, make_frame


@dataclass(frozen=True, slots=True)
class Settings:
    """Configuration of the device itself."""

    watchdog_ms: float = 100.0
    """Time without a command after which a running motor trips; 0 is never."""
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
        self._commanded = 0.0
        """rad/s"""
        self._fed: Nanos = 0
        """Time of the last RUN."""
        self._integral = 0.0
        """N·m of the velocity loop's integrator"""
        self._position, self._velocity = 0.0, 0.0
        self._now: Nanos | None = None
        self._status_at: Nanos = 0
        """When the next status is due."""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey what this frame completes, at once."""
        self._check_watchdog(t)
        for message in self._decoder.decode(t, frame):
            match message:
                case msg.Velocity() if self._mode != DeviceMode.FAULT:
                    self._mode, self._commanded, self._fed = DeviceMode.RUNNING, message.velocity, t
                case msg.Idle() if self._mode != DeviceMode.FAULT:
                    self._disarm(DeviceMode.READY)
                case msg.ClearFault() if self._mode == DeviceMode.FAULT:
                    self._fault = 0
                    self._disarm(DeviceMode.READY)
                case _:
                    pass

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[msg.Torque], Sequence[Frame]]:
        """Run the velocity loop, and send the status when it is due."""
        for event in truth:
            if isinstance(event, msg.Feedback) and event.motor == self._name:
                self._measure(event)
        self._check_watchdog(now)
        if self._now is None:
            self._now = self._status_at = now
        torque = self._loop(seconds(max(now - self._now, 0)))
        self._now = now
        return [msg.Torque(self._name, torque)], self._status(now)

    def due(self) -> Nanos | None:
        """Return when the next status is due, or the watchdog expires."""
        timeout = self._timeout()
        return min(self._status_at, self._fed + timeout) if timeout else self._status_at

    def provoke(self, code: int) -> None:
        """Trip a fault, as if by itself. Raises ValueError for an unknown code."""
        if code not in FAULTS:
            raise ValueError(f"no fault {code}; there are {sorted(FAULTS)}")
        self._fault = code
        self._disarm(DeviceMode.FAULT)

    # -- the firmware ----------------------------------------------------------------------------------

    def _timeout(self) -> Nanos:
        """Return the watchdog timeout; 0 if the watchdog does not run."""
        running = self._mode == DeviceMode.RUNNING
        return round(self._settings.watchdog_ms * MILLISECOND) if running else 0

    def _check_watchdog(self, now: Nanos) -> None:
        timeout = self._timeout()
        if timeout and now - self._fed >= timeout:
            self.provoke(codec.WATCHDOG)

    def _disarm(self, mode: DeviceMode) -> None:
        self._mode, self._commanded, self._integral = mode, 0.0, 0.0

    def _measure(self, shaft: msg.Feedback) -> None:
        """Take what the encoder measures, if it is finite."""
        if shaft.position is not None and math.isfinite(shaft.position):
            self._position = shaft.position
        if shaft.velocity is not None and math.isfinite(shaft.velocity):
            self._velocity = shaft.velocity

    def _loop(self, dt: float) -> float:
        """Return the torque [N·m] of a PI loop, limited; dt in s."""
        if self._mode != DeviceMode.RUNNING:
            return 0.0
        limit, error = self._settings.torque_limit, self._commanded - self._velocity
        self._integral = _clamp(self._integral + self._settings.velocity_integral * error * dt, limit)
        return _clamp(self._settings.velocity_gain * error + self._integral, limit)

    def _status(self, now: Nanos) -> list[Frame]:
        """Return the status, if it is due."""
        if now < self._status_at:
            return []
        self._status_at += STATUS_PERIOD * ((now - self._status_at) // STATUS_PERIOD + 1)
        status = Status(self._mode, self._fault, self._velocity, self._position)
        return [make_frame(STATUS, self._address, codec.encode_status(status))]


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
