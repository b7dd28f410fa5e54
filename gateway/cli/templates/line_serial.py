"""The messages of the table on a serial line.

FILL IN (clauses "streams", "counts" and "checksums") how a message stands on the line. Of the invented
device: A5, the id of the table in two bytes, the data, CRC-16/XMODEM of all that, low byte first.
"""

from __future__ import annotations

from typing import Literal

from protocols.frames import CanFrame, Frame, IdMask
from protocols.line import Answer, Exchange, Rank
from protocols.messages import Nanos
from protocols.toolkit.motor_driver import Rx
from protocols.toolkit.serial import CRC16_XMODEM, Finds, Framing, Stream
from protocols.toolkit.table import Decoded, Direction

from .table import TABLE

BUS: Literal["can", "canfd", "serial"] = "serial"
FRAMING = Framing(b"\xa5", 3, lambda _head: 8, CRC16_XMODEM, 2)
SIZE = 13
"""Bytes of a message on the line."""
DELAY: Nanos = 500_000
"""The longest that a device waits before it answers."""


def ids(_direction: Direction, _address: int) -> tuple[IdMask, ...]:
    """Return the CAN ids to or from this address: there are none."""
    return ()


def encode(name: str, address: int, **values: float) -> bytes:
    """Return a message to or from an address."""
    message = TABLE.encode(name, address, **values)
    return FRAMING.frame(FRAMING.sync + message.id.to_bytes(2, "big") + message.data)


def question(name: str, address: int, rank: Rank, **values: float) -> Exchange:
    """Return a message to an address, with what answers it: its status."""
    answer = Answer(SIZE, Finds(FRAMING, is_answer), DELAY)
    return Exchange(encode(name, address, **values), answer, rank, f"{address} {name}")


def is_answer(asked: bytes, message: bytes) -> bool:
    """True if a message is the status of the device that was asked."""
    return message[1] == 2 and message[2] == asked[2]


class Line:
    """What is received from one line, however the stream was cut."""

    def __init__(self) -> None:
        self._stream = Stream(FRAMING)

    def read(self, frame: Frame, direction: Direction) -> list[Decoded | Rx]:
        """Return the messages that these bytes complete."""
        if not isinstance(frame, bytes):
            return [Rx.IGNORED]
        found: list[Decoded | Rx] = []
        for each in self._stream.feed(frame):
            if isinstance(each, bytes):
                message = CanFrame(int.from_bytes(each[1:3], "big"), each[3:])
                found.append(TABLE.decode(message, direction) or Rx.IGNORED)
            else:
                found.append(each)
        return found

    def drop(self) -> None:
        """Discard a partial message, since its rest will not come."""
        self._stream.drop()
