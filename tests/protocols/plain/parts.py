"""The parts of the plugin `plain`, for plugins that differ from it in one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from protocols.frames import Frame
from protocols.messages import Message, Nanos
from protocols.plain import ranges, table
from protocols.plain.driver import PlainAdapter
from protocols.plugin import Device
from protocols.toolkit.motor_driver import MotorDriver
from protocols.toolkit.serial import Stream


class PlainDriver(MotorDriver[set[int]]):
    """The driver, as a class; `adapted` by another adapter."""

    adapted: ClassVar[type[PlainAdapter]] = PlainAdapter

    def __init__(self, devices: Sequence[Device]) -> None:
        super().__init__(self.adapted(), devices, {each.name: ranges(each.options) for each in devices})

    def read_from(self, stream: Stream) -> None:
        """Use another stream."""
        self.adapter._stream = stream  # type: ignore[attr-defined]  # the adapter's own


def messages_in(frame: Frame) -> list[bytes]:
    """The whole messages in a frame, heads and bodies."""
    return Stream(table.FRAMING).messages(frame) if isinstance(frame, bytes) else []


def decoded(frame: Frame, t: Nanos = 0) -> list[tuple[int, Message | None]]:
    """The addresses and messages in a frame."""
    return [(each[table.ADDRESS], table.decode(each, t, "")) for each in messages_in(frame)]


def readdressed(message: bytes, address: int) -> bytes:
    """A message (head and body) to another address, with its checksum."""
    return table.FRAMING.frame(message[:6] + bytes((address,)) + message[7:])
