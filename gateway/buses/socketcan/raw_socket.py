"""A raw CAN socket that python-can has opened and bound: frames in with the kernel's stamps, and frames out.

Rules. Nothing here waits, and nothing here decides: what the kernel says is raised as the OSError that it is.

python-can's own `recv` and `send` are not used (4.6.1, can/interfaces/socketcan/socketcan.py): `recv` allows
for no other ancillary message than the stamp, so that lost frames cannot be counted, and rounds the stamp to
a float; `send` says as text that a queue is full; each asks `select` for every frame.
Sources: linux/can/raw.h, socket(7), Documentation/networking/can.rst.
"""

from __future__ import annotations

import socket
import struct
from typing import Protocol

from gateway.buses.can_errors import CanError
from gateway.buses.socketcan.frame_struct import FD, pack, unpack
from protocols.frames import CanFrame
from protocols.messages import SECOND, Nanos

ROOM = 4 << 20
"""Bytes of the receive buffer where it may be had (CAP_NET_ADMIN): a default of 208 KiB holds 278 frames."""

_SO_RCVBUFFORCE, _SO_TIMESTAMPNS, _SO_RXQ_OVFL, _SO_MEMINFO = 33, 35, 40, 55
_MEMINFO = struct.Struct("=9I")
_QUEUED = 2
"""SK_MEMINFO_WMEM_ALLOC: which number of SO_MEMINFO is what the transmit queue holds of this socket."""
_TIMESPEC = struct.Struct("@ll")
_COUNT = struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)


class Opened(Protocol):
    """What is used of python-can's SocketcanBus."""

    socket: socket.socket

    def shutdown(self) -> None:
        """Close the socket."""
        ...


class RawSocket:
    """The socket, with a large receive buffer, and counts of what was lost in it."""

    def __init__(self, opened: Opened) -> None:
        self.bad = 0
        """What came in and was no frame."""
        self.missed = 0
        """Frames that came faster than they were read: the kernel threw them away."""
        self._opened = opened
        self._receive = opened.socket.recvmsg
        self._send = opened.socket.send
        opened.socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            opened.socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, ROOM)
        except PermissionError:  # as much as anybody is allowed, then
            opened.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, ROOM)

    def receive(self) -> tuple[Nanos, CanFrame | CanError]:
        """What came next, and when, in nanoseconds since 1970. Raises BlockingIOError if there is nothing."""
        while True:
            raw, ancillary, _, _ = self._receive(FD.size, _ANCILLARY, socket.MSG_DONTWAIT)
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
        """Give a frame to the kernel. Raises ValueError for what is no frame, OSError for what it refuses."""
        self._send(pack(frame), socket.MSG_DONTWAIT)

    def queued(self) -> int:
        """Bytes that the kernel has of us and the controller has not taken; 0 where it does not tell."""
        try:
            info = self._opened.socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        except OSError:  # a kernel older than 4.12
            return 0
        return int(_MEMINFO.unpack(info)[_QUEUED])

    def close(self) -> None:
        """Give it back to the kernel."""
        self._opened.shutdown()
