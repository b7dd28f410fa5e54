"""The messages of a serial protocol as a table, rows as on CAN; how a message stands on the line; and what a
device is that obeys such messages: its command decoder, and its firmware.

Rules. A `Row` has no id of its own on a line: in the place of it stand `uint("address")` and
`const(function)`, 8 bits each. A `FrameFormat` finds messages in the stream; `pack` and `unpack` say where
address and function are in one. All else is as in `protocols.toolkit.table`: encoding saturates, and raises
ValueError for a number that is not finite; decoding takes any bytes and never raises.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

from protocols.frames import Frame
from protocols.messages import Nanos, Obeyed
from protocols.plugin import CommandDecoder, Device, Range
from protocols.toolkit.assembly import Memory, copied
from protocols.toolkit.firmware import Firmware, ServoFirmware
from protocols.toolkit.serial import FrameFormat, Stream, messages_in
from protocols.toolkit.servo import Gains
from protocols.toolkit.table import Decoded, Direction, Line, Row, Table

Pack: TypeAlias = Callable[[int, int, bytes], bytes]
"""From address, function and data: the message without its checksum."""
Unpack: TypeAlias = Callable[[bytes], tuple[int, int, bytes] | None]
"""The reverse; None if it is no message."""


def unpack_bytes(message: bytes) -> tuple[int, int, bytes] | None:
    """Return address, function and data, if the first two are a byte each."""
    return (message[0], message[1], message[2:]) if len(message) > 1 else None


class Packets:
    """The messages of a serial protocol."""

    def __init__(
        self,
        rows: Iterable[Row],
        framing: FrameFormat,
        pack: Pack | None = None,
        unpack: Unpack = unpack_bytes,
    ) -> None:
        """Without `pack`, address and function are the first two bytes of a message."""
        self.framing, self._unpack = framing, unpack
        self._table = Table((replace(row, extended=True) for row in rows), Line(framing.frame, pack))
        self.encoder: Callable[[str], Callable[..., bytes]] = self._table.packet_encoders().__getitem__
        """Return `encode` for one message, in two thirds of the time: `encoder(name)(address, **values)`."""

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
        return self.encoder(name)(address, **values)

    def decode(self, message: bytes, direction: Direction) -> Decoded | None:
        """Return what is in a message (as `Stream.feed` gives it); None if it is none of the table's."""
        unpacked = self._unpack(message)
        if unpacked is None:
            return None
        address, function, data = unpacked
        return self._table.decode_bare(address << 8 | function, data, direction)

    def in_frame(self, frame: Frame) -> tuple[list[Decoded | None], bool]:
        """Return the messages to a device in a run of bytes, and whether it holds nothing else."""
        found, whole = messages_in(self.framing, frame)
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


@dataclass(slots=True)
class Receiver:
    """A device, or several, that reads messages off a line. Plain data."""

    messages: Messages
    stream: Stream
    gap: Nanos = 0
    """A pause of this length within a message ends it; 0: none does."""
    at: Nanos = 0

    def read(self, t: Nanos, frame: Frame) -> list[tuple[bytes, Decoded]]:
        """Return the messages to devices that a frame completes: as `Stream.feed` gives them, and decoded."""
        if not isinstance(frame, bytes):
            return []
        if self.gap and t - self.at > self.gap:
            self.stream.drop()
        self.at = t
        found = ((one, self.messages.decode(one, "to_device")) for one in self.stream.messages(frame))
        return [(one, each) for one, each in found if each is not None and each.name]


class PacketDecoder:
    """The command decoder of the devices on one line: their messages, and of each its memory as it is when
    switched on."""

    def __init__(
        self,
        packets: Messages,
        memories: Iterable[Memory],
        stream: Stream | None = None,
        gap: Nanos = 0,
        at: Nanos = 0,
    ) -> None:
        self._receiver = Receiver(packets, stream or Stream(packets.framing), gap, at)
        self._memories = list(memories)

    def __deepcopy__(self, memo: dict[int, Any]) -> PacketDecoder:
        """Copy what the devices keep, as the guard does every few frames."""
        one, memories = self._receiver, [copied(each, memo) for each in self._memories]
        return PacketDecoder(one.messages, memories, replace(one.stream), one.gap, one.at)

    def decode(self, t: Nanos, frame: Frame) -> Sequence[Obeyed]:
        """Return what the devices would obey in the messages that this frame completes."""
        found = self._receiver.read(t, frame)
        return [each for _, decoded in found for memory in self._memories for each in memory.obey(decoded)]


def packet_decoder(
    messages: Callable[[Any], Messages], memory: Callable[[Device], Memory], gap: Nanos = 0
) -> Callable[[Sequence[Device]], CommandDecoder]:
    """Return `Plugin.decoder`; `messages`: from the options of the devices of a line, which have the same;
    `memory` is what a device keeps; `gap` as in `Receiver`."""
    return lambda devices: PacketDecoder(messages(devices[0].options), map(memory, devices), None, gap)


class LineFirmware(Firmware):
    """Firmware that reads messages off a line. A protocol gives what it does with each."""

    messages: Messages
    """To devices on the line"""
    gap: Nanos = 0
    """As in `Receiver`"""

    def __init__(self, device: Device, seed: int, *others: Any) -> None:  # noqa: ANN401 -- of the other base
        super().__init__(device, seed, *others)
        self.receiver = Receiver(self.messages, Stream(self.messages.framing), self.gap)

    def on_frame(self, t: Nanos, frame: Frame) -> None:
        for message, decoded in self.receiver.read(t, frame):
            if self.takes(decoded):
                self.on_message(t, message, decoded)

    def takes(self, decoded: Decoded) -> bool:
        """True if a message is for this device, or all."""
        return True

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        """Obey a message to this device, and answer it."""
        raise NotImplementedError

    def restart(self, t: Nanos, silent: Nanos) -> None:
        """Restart: what was half received is lost."""
        super().restart(t, silent)
        self.receiver.stream.drop()


class PacketFirmware(LineFirmware, ServoFirmware):
    """A motor that obeys messages on a line with the loops of `Servo`."""

    def __init__(self, device: Device, seed: int, gains: Gains, memory: Any) -> None:  # noqa: ANN401 -- the protocol's own
        super().__init__(device, seed, gains)
        self.memory = memory

    def on_message(self, t: Nanos, message: bytes, decoded: Decoded) -> None:
        """Obey a message to this device."""
        for obeyed in self.memory.obey(decoded):
            self.obey(t, obeyed)
