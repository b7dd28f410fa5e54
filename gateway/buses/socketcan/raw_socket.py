"""A raw CAN socket that python-can has opened and bound: frames in with the kernel's timestamps, and frames
out.

Rules. Nothing here waits, and nothing here decides: a kernel error is raised as the OSError that it is. A CAN
FD frame is distinguished from a classic one by its size alone, 72 bytes against 16; its data is sent
zero-padded to the next length that has a code.

python-can's own `recv` and `send` are not used (4.6.1, can/interfaces/socketcan/socketcan.py): `recv` accepts
no other ancillary message than the timestamp, so that lost frames cannot be counted, and rounds the timestamp
to a float; `send` reports a full queue only as text; each calls `select` for every frame. Sources:
linux/can.h, linux/can/raw.h, socket(7), Documentation/networking/can.rst.
"""

from __future__ import annotations

import socket
import struct
from typing import Protocol

from gateway.buses.error_frames import CanError
from gateway.buses.frame_time import padded
from protocols.frames import CanFrame
from protocols.messages import SECOND, Nanos

RECEIVE_BUFFER = 4 << 20
"""Bytes, where they may be had (CAP_NET_ADMIN): a default of 208 KiB holds 278 frames."""

_CLASSIC = struct.Struct("=IB3x8s")  # struct can_frame: can_id, len, pad, data
_FD = struct.Struct("=IBB2x64s")  # struct canfd_frame: can_id, len, flags, reserved, data
_HEAD = struct.Struct("=IBB")
_EXTENDED, _REMOTE, _ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Flags in can_id."""
_ID, _BASE_ID = 0x1FFF_FFFF, 0x7FF
_BRS, _FDF = 0x01, 0x04
"""Flags of a CAN FD frame: bit-rate switch; CAN FD at all (newer kernels set it)."""

_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SO_MEMINFO = 33, 35, 40, 55
_MEMINFO = struct.Struct("=9I")
_QUEUED = 2
"""SK_MEMINFO_WMEM_ALLOC: which number of SO_MEMINFO is what the transmit queue holds of this socket."""
_TIMESPEC = struct.Struct("@ll")
_COUNT = struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)


def pack(frame: CanFrame) -> bytes:
    """Encode a frame for a raw CAN socket. Raises ValueError for what no frame of its kind can carry."""
    data, can_id = frame.data, frame.id
    if can_id > (_ID if frame.extended else _BASE_ID) or can_id < 0:
        raise ValueError(f"{frame} has an id that its format cannot carry")
    if len(data) > (64 if frame.fd else 8):
        raise ValueError(f"{frame} carries {len(data)} bytes")
    if frame.extended:
        can_id |= _EXTENDED
    if frame.fd:
        data = padded(frame).data
        return _FD.pack(can_id, len(data), _FDF | (_BRS if frame.brs else 0), data)
    if frame.remote:
        return _CLASSIC.pack(can_id | _REMOTE, frame.requested, b"")
    return _CLASSIC.pack(can_id, len(data), data)


def unpack(raw: bytes) -> CanFrame | CanError | None:
    """Decode a frame or an error frame; None if it is neither."""
    size = len(raw)
    if size not in (_CLASSIC.size, _FD.size):
        return None
    can_id, length, flags = _HEAD.unpack_from(raw)
    fd = size == _FD.size
    if length > (64 if fd else 8):
        return None
    if can_id & _ERROR:
        return CanError(can_id & _ID, raw[8:16])
    extended = can_id & _EXTENDED != 0
    number = can_id & (_ID if extended else _BASE_ID)
    if fd:
        return CanFrame(number, raw[8 : 8 + length], extended, False, True, flags & _BRS != 0)
    if can_id & _REMOTE:
        return CanFrame(number, b"", extended, True, requested=length)
    return CanFrame(number, raw[8 : 8 + length], extended)


class OpenSocket(Protocol):
    """What is used of python-can's SocketcanBus."""

    socket: socket.socket

    def shutdown(self) -> None:
        """Close the socket."""
        ...


class RawSocket:
    """The socket, with a large receive buffer, and counts of what was lost in it."""

    def __init__(self, opened: OpenSocket) -> None:
        self.bad = 0
        """Malformed input: no frame."""
        self.missed = 0
        """Frames that the kernel dropped, since they came faster than they were read."""
        self._opened = opened
        self._receive = opened.socket.recvmsg
        self._send = opened.socket.send
        opened.socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            opened.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except PermissionError:  # as much as an unprivileged process is allowed, then
            opened.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)

    def receive(self) -> tuple[Nanos, CanFrame | CanError]:
        """Return the next frame and its time in nanoseconds since 1970. Raises BlockingIOError if there is
        none."""
        while True:
            raw, ancillary, _, _ = self._receive(_FD.size, _ANCILLARY, socket.MSG_DONTWAIT)
            stamp = 0
            for _, kind, data in ancillary:
                if kind == _SO_TIMESTAMPNS:
                    seconds, nanos = _TIMESPEC.unpack_from(data)
                    stamp = seconds * SECOND + nanos
                elif kind == _SO_RXQ_OVFL:  # all that were ever lost, modulo 2**32
                    self.missed += (_COUNT.unpack_from(data)[0] - self.missed) % (1 << 32)
            frame = unpack(raw)
            if frame is not None:
                return stamp, frame
            self.bad += 1

    def send(self, frame: CanFrame) -> None:
        """Hand a frame to the kernel. Raises ValueError for an invalid one, OSError for what the kernel
        refuses."""
        self._send(pack(frame), socket.MSG_DONTWAIT)

    def queued(self) -> int:
        """Return the bytes of this socket that the controller has not taken; 0 where the kernel cannot
        say."""
        try:
            info = self._opened.socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        except OSError:  # a kernel older than 4.12
            return 0
        return int(_MEMINFO.unpack(info)[_QUEUED])

    def close(self) -> None:
        """Close the socket."""
        self._opened.shutdown()
