"""The device's end: a camera that reports what the world shows it. Its pictures are drawn and looked at in
the world (`[cameras.NAME]` of a plant file)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated

from protocols.bounds import Bounds, check
from protocols.camera import table
from protocols.camera.table import Picture
from protocols.frames import Frame
from protocols.messages import SECOND, Event, Marker, Nanos, Obeyed, Torque
from protocols.plugin import Device


@dataclass(frozen=True, slots=True)
class Settings:
    """The camera in simulation."""

    width: Annotated[int, Bounds(16, 4096)] = 640
    """Pixels of the pictures that it tells"""
    height: Annotated[int, Bounds(16, 4096)] = 480
    """Pixels"""

    def __post_init__(self) -> None:
        check(self)


class CameraDecoder:
    """What cameras obey: nothing is sent to them."""

    def __init__(self, devices: Sequence[Device]) -> None:
        pass

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return nothing."""
        return ()


class CameraTwin:
    """One camera."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self._faults = 0
        self._number = self._rate = 0
        self._taken: Nanos | None = None
        """When its newest picture was taken"""

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Ignore it."""

    def due(self) -> Nanos | None:
        """Return None: it reports a picture when the world has one."""
        return None

    def provoke(self, code: int) -> None:
        """Report this fault with every picture from now on. Raises ValueError if there is no such fault."""
        if code not in table.FAULTS:
            raise ValueError(f"no fault {code}")
        self._faults |= code

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Report what was seen."""
        seen = [one for one in truth if isinstance(one, Marker) and one.sensor == self.device.name]
        return (), [frame for one in seen for frame in self._messages(now, one)]

    def _messages(self, now: Nanos, seen: Marker) -> Iterator[bytes]:
        if seen.t != self._taken:
            since = 0 if self._taken is None else seen.t - self._taken
            self._rate = round(100.0 * SECOND / since) if since > 0 else 0
            self._number, self._taken = self._number + 1, seen.t
        settings: Settings = self.device.settings
        grey = 0 if self._faults & table.DARK else 100
        size = settings.width, settings.height
        picture = Picture(self._number, now - seen.t, *size, self._rate, grey, self._faults)
        with suppress(ValueError):  # beyond what a camera measures
            yield table.encode(picture, seen)
