"""The device's end: what a sensor obeys, and its firmware, which streams what it measures of the world."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from protocols.frames import Frame
from protocols.messages import (
    SECOND,
    Event,
    Imu,
    Kept,
    Nanos,
    Obeyed,
    ReadParameter,
    Torque,
    WriteParameter,
    seconds,
)
from protocols.plugin import Device
from protocols.toolkit.serial import Stream
from protocols.witmotion import table as wit
from protocols.witmotion.options import Settings


@dataclass(slots=True)
class Memory:
    """What a sensor keeps of the commands that it received."""

    registers: dict[int, int]
    opened: Nanos | None = None
    """When its registers were unlocked"""
    stream: Stream = field(default_factory=lambda: Stream(wit.COMMANDS))

    @classmethod
    def of(cls, settings: Settings) -> Memory:
        """Return that of a sensor that is switched on."""
        return cls({wit.CONTENT: settings.content, wit.RATE: settings.rate, wit.BAUD: 2})

    def obey(self, t: Nanos, frame: Frame) -> Iterator[tuple[int, int]]:
        """Obey the commands that these bytes complete; yield register and word of each that has an effect."""
        for message in self.stream.messages(frame) if isinstance(frame, bytes) else ():
            register, word = wit.command_of(message)
            if register == wit.KEY:
                self.opened = t if word == wit.UNLOCK else None
            elif register != wit.READ:
                if self.opened is None or t - self.opened > wit.OPEN:
                    continue
                self.registers[register] = word
            yield register, word


class WitmotionDecoder:
    """What sensors would obey."""

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = [(device.name, Memory.of(device.settings)) for device in devices]

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what each would obey."""
        return [_obeyed(name, *each) for name, memory in self._devices for each in memory.obey(t, frame)]


def _obeyed(name: str, register: int, word: int) -> Obeyed:
    if register == wit.READ:
        return ReadParameter(name, wit.register_name(word & 0xFF))
    if register == wit.KEY:
        return Kept(name, wit.register_name(register), float(word))
    return WriteParameter(name, wit.register_name(register), float(word))


class WitmotionTwin:
    """One sensor."""

    def __init__(self, device: Device, seed: int) -> None:
        self.device = device
        self.memory = Memory.of(device.settings)
        self._seen: Imu | None = None
        """The newest measurement of the world,"""
        self._yaw = 0.0
        """rad, the integral of its angular rate about z"""
        self._next: Nanos | None = None
        self._replies: list[bytes] = []

    def receive(self, t: Nanos, frame: Frame) -> None:
        """Obey it."""
        for register, word in self.memory.obey(t, frame):
            if register == wit.READ:
                held = (self.memory.registers.get(word + at & 0xFF, 0) for at in range(wit.WORDS))
                signed = (each - 0x10000 if each >= 0x8000 else each for each in held)
                self._replies.append(wit.packet(wit.REGISTERS, list(signed)))

    def due(self) -> Nanos | None:
        """Return when the next cycle begins."""
        return self._next

    def provoke(self, code: int) -> None:
        """Raise ValueError: it reports no fault."""
        raise ValueError(f"no fault {code}: it has none")

    def step(self, now: Nanos, truth: Sequence[Event]) -> tuple[Sequence[Torque], Sequence[Frame]]:
        """Measure; send the packets of a cycle when it begins."""
        for event in truth:
            if isinstance(event, Imu) and event.sensor == self.device.name and _is_finite(event):
                before, self._seen = self._seen, event
                if before is not None:
                    self._yaw += event.angular_velocity[2] * seconds(event.t - before.t)
        frames: list[Frame] = [*self._replies]
        self._replies = []
        rate = wit.RATES.get(self.memory.registers[wit.RATE])
        if self._seen is None or rate is None:
            return (), frames
        period = round(SECOND / rate)
        if self._next is None or now >= self._next:
            began = now if self._next is None else self._next
            self._next = began + period * (1 + (now - began) // period)
            frames += self._cycle(self._seen)
        return (), frames

    def _cycle(self, seen: Imu) -> list[bytes]:
        """Return the packets of what it was configured to send."""
        x, y, z = seen.linear_acceleration
        roll, pitch = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
        yaw = math.remainder(self._yaw, math.tau)
        measured = {
            wit.ACCELERATION: [wit.counts(each, wit.G_MOST) for each in seen.linear_acceleration],
            wit.ANGULAR_RATE: [wit.counts(each, wit.RATE_MOST) for each in seen.angular_velocity],
            wit.ANGLE: [wit.counts(each, wit.ANGLE_MOST) for each in (roll, pitch, yaw)],
            wit.QUATERNION: [wit.counts(each, 1.0) for each in _quaternion(roll, pitch, yaw)],
        }
        content = self.memory.registers[wit.CONTENT]
        wanted = [0x50 + bit for bit in range(11) if content >> bit & 1]
        return [wit.packet(kind, (*measured.get(kind, ()), 0, 0, 0, 0)[: wit.WORDS]) for kind in wanted]


def _is_finite(event: Imu) -> bool:
    return all(math.isfinite(each) for each in (*event.angular_velocity, *event.linear_acceleration))


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return w, x, y, z of Rz(yaw) Ry(pitch) Rx(roll)."""
    about_x, about_y, about_z = roll / 2, pitch / 2, yaw / 2
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in (about_x, about_y, about_z))
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )
