"""A sensor's end of a plain line, and how any plain device is found, is given an address, and speaks.

Rules. A sensor tells what the world shows it at once. A device answers Scan and SetId, and hears nothing else
that is for everyone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

from protocols.frames import Frame
from protocols.messages import Command, Event, Fix, Found, Imu, LaserScan, Nanos, Request, Scan, SetId, Torque
from protocols.plain import codec
from protocols.plain.decoder import PlainDecoder
from protocols.plugin import Device


class PlainSensor:
    """A lidar, an inertial sensor or a satellite receiver."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._decoder = PlainDecoder([device])
        self._answers: list[Event] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Answer Scan and SetId."""
        for word in self._decoder.decode(t, frame):
            device = to_all(self._device, word, t, self._answers)
            if device is not self._device:
                self._device = device
                self._decoder.follow(device)

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Tell what the world shows to this sensor, each measurement at once."""
        shown = [w for w in truth if isinstance(w, Imu | LaserScan | Fix) and w.sensor == self._device.name]
        said = [*self._answers, *shown]
        self._answers = []
        return [], messages_of(self._device, now, said)

    def due(self) -> Nanos | None:
        """A sensor speaks when the world shows it something."""
        return None

    def provoke(self, code: int) -> None:
        """A sensor has no faults."""
        raise ValueError(f"a plain sensor has no fault {code}")


def to_all(device: Device, word: Command | Request, t: Nanos, answers: list[Event]) -> Device:
    """Answer what the whole line was asked; the device as it is afterwards."""
    serial = device.settings.serial
    if isinstance(word, SetId) and word.serial == serial and 1 <= word.address <= 0xFF:
        device = replace(device, address=word.address)
    elif not isinstance(word, Scan):
        return device
    answers.append(Found(t, codec.NAME, device.address, serial, device.options.kind))
    return device


def messages_of(device: Device, now: Nanos, said: Sequence[Event]) -> list[bytes]:
    """The words as messages. What no message can hold (not finite, too long) is not told."""
    messages = []
    for word in said:
        with contextlib.suppress(ValueError):
            messages.append(codec.message(device.address, word, now))
    return messages
