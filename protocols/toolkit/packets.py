"""The messages of a serial protocol as a table: rows as on CAN, and how a message stands on the line.

Rules. A `Row` has no id of its own on a line: in the place of it stand `uint("address")` and
`const(function)`, 8 bits each. A `FrameFormat` finds messages in the stream; `pack` and `unpack` say where
address and function are in one. All else is as in `protocols.toolkit.table`: encoding saturates, and raises
ValueError for a number that is not finite; decoding takes any bytes and never raises.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeAlias

from protocols.frames import CanFrame, Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import Range
from protocols.toolkit.assembly import Memory, copied
from protocols.toolkit.serial import FrameFormat, Stream
from protocols.toolkit.table import Decoded, Direction, Row, Table

Pack: TypeAlias = Callable[[int, int, bytes], bytes]
"""From address, function and data: the message without its checksum."""
Unpack: TypeAlias = Callable[[bytes], tuple[int, int, bytes] | None]
"""The reverse; None if it is no message."""


class Packets:
    """The messages of a serial protocol."""

    def __init__(self, rows: Iterable[Row], framing: FrameFormat, pack: Pack, unpack: Unpack) -> None:
        self.framing = framing
        self._table = Table(replace(row, extended=True) for row in rows)
        self._pack, self._unpack = pack, unpack

    def __deepcopy__(self, memo: object) -> Packets:
        """It is a constant: copies of a driver's state share it."""
        return self

    def row(self, name: str) -> Row:
        """Return a row by its name."""
        return self._table.row(name)

    def range(self, message: str, field: str, unit: float = 1.0, inside: int = 0) -> Range:
        """Return the range of a field; see `Field.range`."""
        return self._table.range(message, field, unit, inside)

    def encode(self, name: str, address: int = 0, /, **values: Any) -> bytes:  # noqa: ANN401 -- numbers
        """Return a message to or from the device at an address, as it stands on the line. Raises ValueError
        for a number that is not finite, TypeError for a field that is missing or unknown."""
        frame = self._table.encoder(name)(address, **values)
        number = frame.id
        return self.framing.frame(self._pack(number >> 8, number & 0xFF, frame.data))

    def decode(self, message: bytes, direction: Direction) -> Decoded | None:
        """Return what is in a message (as `Stream.feed` gives it); None if it is none of the table's."""
        unpacked = self._unpack(message)
        if unpacked is None:
            return None
        address, function, data = unpacked
        return self._table.decode(CanFrame(address << 8 | function, data, extended=True), direction)

    def in_frame(self, frame: Frame) -> tuple[list[Decoded | None], bool]:
        """Return the messages to a device in a run of bytes, and whether it holds nothing else."""
        if not isinstance(frame, bytes):
            return [], False
        found = Stream(self.framing).messages(frame)
        whole = sum(len(self.framing.frame(message)) for message in found) == len(frame)
        return [self.decode(message, "to_device") for message in found], whole

    def names(self, frame: Frame) -> tuple[str, ...]:
        """Return the names of the messages to a device in a run of bytes, as `Plugin.messages` does."""
        return tuple(each.name for each in self.in_frame(frame)[0] if each is not None and each.name)

    def read_only(self, frame: Frame) -> bool:
        """True if a run of bytes holds whole messages that change nothing, as `Spec.read_only` does."""
        found, whole = self.in_frame(frame)
        return whole and all(one is not None and one.name and self.row(one.name).read_only for one in found)


class Messages(Protocol):
    """The messages of a serial protocol, from a table or not."""

    @property
    def framing(self) -> FrameFormat:
        """How they stand on the line."""
        ...

    def decode(self, message: bytes, direction: Direction) -> Decoded | None:
        """Return what is in a message."""
        ...


class PacketDecoder:
    """The command decoder of the devices on one line: their messages, and of each its memory as it is when
    switched on."""

    def __init__(self, packets: Messages, memories: Iterable[Memory], stream: Stream | None = None) -> None:
        self._packets, self._memories = packets, list(memories)
        self._stream = stream or Stream(packets.framing)

    def __deepcopy__(self, memo: dict[int, Any]) -> PacketDecoder:
        """Copy what the devices keep, as the guard does every few frames."""
        memories = [copied(each, memo) for each in self._memories]
        return PacketDecoder(self._packets, memories, replace(self._stream))

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the devices would obey in the messages that this frame completes."""
        obeyed: list[Obeyed] = []
        for message in self._stream.messages(frame) if isinstance(frame, bytes) else ():
            decoded = self._packets.decode(message, "to_device")
            if decoded is not None and decoded.name:
                for memory in self._memories:
                    obeyed += memory.obey(decoded)
        return obeyed
