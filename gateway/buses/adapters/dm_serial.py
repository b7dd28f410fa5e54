"""The packets of Damiao's serial CAN adapter (USB2CAN): both directions, and an emulated adapter.

Rules. Pure: bytes in, frames and replies out; no port, no clock. To the adapter go 30 bytes, from it come 16,
numbers are little-endian; nothing of a packet is checked but what is constant in it, since its last byte but
one is data, and the "crc" is not looked at. What is no packet is skipped byte by byte. Nothing raises, on any
bytes, cut anywhere.

    55 AA 1E | command | times u32 | interval u32 | IDE | id u32 | RTR | length | 0 0 | data 8 | crc
    AA | command | length, IDE << 6, RTR << 7 | id u32 | data 8 | 55

Sources: cmjang/DM_Motor_Control@3d58d84 `damiao.h`, the vendor's example (both packets field by field, all
commands); cmjang/DM_Control_Python@7da9387 `DM_CAN.py` (`send_data_frame`, `recv`); tianrking/motorbridge@
ff81530 `motor_core/src/dm_serial.rs` (29-bit ids, remote frames). What the adapter answers to a handshake
(command 2) and what a report carries beside its command is in none of them; nor is how its bit rate is set.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field

from protocols.frames import CanFrame
from protocols.messages import Nanos

REPORTING, SILENT = 1, 3
"""Commands of a packet to the adapter: send the frame, with and without a report of it."""
RECEIVED, SENT = 0x11, 0x12
"""Commands of a packet from it: a frame received; the report that one was sent."""
NOT_SENT = 0x02
ERRORS = {
    0x01: "could not receive",
    NOT_SENT: "could not send",
    0x03: "could not set the bit rate",
    0xEE: "communication error",
}
"""What else it reports; besides, 0x00 (a heartbeat) and 0x13 (bit rate set)."""

_HEAD, _TIMES, _INTERVAL = b"\x55\xaa\x1e", 1, 10
_START, _END = 0xAA, 0x55
_TO_ADAPTER, _FROM_ADAPTER = struct.Struct("<3sBIIBIBBxx8sx"), struct.Struct("<BBBI8sB")
_IDS = {b"11": rb".[\x00-\x07]\x00\x00", b"29": rb"...[\x00-\x1f]"}
TO_ADAPTER = re.compile(
    rb"\x55\xaa\x1e[\x01\x03]\x01\x00\x00\x00....(?:\x00%(11)b|\x01%(29)b)[\x00\x01][\x00-\x08].{11}" % _IDS,
    re.DOTALL,
)
"""A packet that sends a frame, once."""
FROM_ADAPTER = re.compile(
    rb"\xaa(?:\x11(?:[\x00-\x08\x80-\x88]%(11)b|[\x40-\x48\xc0-\xc8]%(29)b)|[\x00-\x03\x12\x13\xee].{5}).{8}\x55"
    % _IDS,
    re.DOTALL,
)


class PacketSplitter:
    """Cuts a stream of bytes into packets of one length."""

    def __init__(self, packet: re.Pattern[bytes]) -> None:
        self._packet = packet
        self._size = (_TO_ADAPTER if packet is TO_ADAPTER else _FROM_ADAPTER).size
        self._rest = b""
        self.skipped = 0
        """Bytes that belonged to no packet."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the packets that are now complete."""
        data = self._rest + data
        found = list(self._packet.finditer(data))
        start = found[-1].end() if found else 0
        self._rest = data[max(start, len(data) - self._size + 1) :]
        self.skipped += len(data) - len(self._rest) - len(found) * self._size
        return [match[0] for match in found]


def encode_send(frame: CanFrame, command: int = SILENT) -> bytes:
    """Encode the packet that sends a frame of classic CAN, once."""
    kind = frame.extended, frame.id, frame.remote, frame.requested or len(frame.data)
    return _TO_ADAPTER.pack(_HEAD, command, _TIMES, _INTERVAL, *kind, frame.data)


def decode_send(packet: bytes) -> tuple[int, CanFrame]:
    """Return the command and the frame of a packet to the adapter."""
    _, command, _, _, extended, number, remote, length, data = _TO_ADAPTER.unpack(packet)
    return command, _frame(number, data[:length], bool(extended), bool(remote))


def encode_received(frame: CanFrame, command: int = RECEIVED) -> bytes:
    """Encode the packet by which the adapter reports a frame of classic CAN."""
    kind = (frame.requested or len(frame.data)) | frame.extended << 6 | frame.remote << 7
    return _FROM_ADAPTER.pack(_START, command, kind, frame.id, frame.data, _END)


def decode_received(packet: bytes) -> tuple[int, CanFrame]:
    """Return the command and the frame of a packet from the adapter; only RECEIVED and SENT carry one."""
    _, command, kind, number, data, _ = _FROM_ADAPTER.unpack(packet)
    return command, _frame(number, data[: kind & 0x3F], bool(kind & 0x40), bool(kind & 0x80))


def _frame(number: int, data: bytes, extended: bool, remote: bool) -> CanFrame:
    if remote:
        return CanFrame(number, b"", extended, True, requested=len(data))
    return CanFrame(number, data, extended)


@dataclass(slots=True)
class EmulatedAdapter:
    """An emulated adapter on a bus of classic CAN, whose bit rate it has."""

    bitrate: int
    data_bitrate: int = 0
    open: bool = True
    """Whether it is on the bus, as it always is."""
    wrong_rate: bool = False
    overrun: bool = False
    """Frames were lost because the other end did not read. It never reports that."""
    _splitter: PacketSplitter = field(default_factory=lambda: PacketSplitter(TO_ADAPTER))

    def feed(self, data: bytes) -> tuple[list[CanFrame], bytes]:
        """Take bytes from the serial line; return the frames that go onto the bus, and the replies."""
        sent = [decode_send(packet) for packet in self._splitter.feed(data)]
        reports = (encode_received(frame, SENT) for command, frame in sent if command == REPORTING)
        return [frame for _, frame in sent], b"".join(reports)

    def report(self, t: Nanos, frame: CanFrame) -> bytes:  # noqa: ARG002 -- slcan timestamps; this one does not
        """Return the packet for a frame on the bus; nothing for one of CAN FD, which it does not receive."""
        return b"" if frame.fd else encode_received(frame)
