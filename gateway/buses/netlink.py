"""The kernel's state of one network interface: cheaply whether it is up, and in full by rtnetlink.

Rules. `NetDevice.status` asks by ioctl, which takes no lock in the kernel: it may be called in the loop.
`NetDevice.link` asks by rtnetlink, which waits while any interface is being configured: it is called when a
bus is opened, and rarely while a controller is in trouble, since its error state is available nowhere else.
No process is started. Sources: rtnetlink(7), netdevice(7), linux/if_link.h, linux/can/netlink.h. `request`
and `parse` are pure.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from protocols.frames import BusState

_MESSAGE = struct.Struct("=IHHII")  # nlmsghdr: length, type, flags, sequence, port
_INFO = struct.Struct("=BxHiII")  # ifinfomsg: family, type, index, flags, change
_ATTRIBUTE = struct.Struct("=HH")
_U32 = struct.Struct("=I")
_COUNTS = struct.Struct("=HH")
_ZERO = bytes(8)
_IFREQ = struct.Struct("16si20x")
_NEW_LINK, _GET_LINK, _REQUEST = 16, 18, 1
_NAME, _MTU, _QUEUE, _LINK_INFO = 3, 4, 13, 18
_INFO_KIND, _INFO_DATA = 1, 2
_BIT_TIMING, _STATE, _MODES, _RESTART_MS, _COUNTERS, _DATA_BIT_TIMING = 1, 4, 5, 6, 8, 9
_NESTED = 0x3FFF
"""Mask without the two flags that an attribute's type may have."""
_GET_FLAGS, _GET_INDEX = 0x8913, 0x8933
IFF_UP, IFF_RUNNING = 0x1, 0x40
LISTEN_ONLY = 0x02
"""CAN_CTRLMODE_LISTENONLY."""
_STATES = {0: BusState.UP, 1: BusState.UP, 2: BusState.PASSIVE, 3: BusState.OFF}
"""enum can_state: active, warning, passive, bus-off; stopped and sleeping imply nothing about the bus."""


class NetStatus(NamedTuple):
    """The interface index, whether the interface is up, and whether it can carry frames."""

    ifindex: int
    up: bool
    running: bool


@dataclass(frozen=True, slots=True)
class NetLink:
    """One interface as rtnetlink reports it. What it does not report is 0 or None."""

    name: str
    ifindex: int
    up: bool
    mtu: int
    """16: classic CAN only. 72: CAN FD, too."""
    queue: int
    """Frames that the kernel's transmit queue can hold (txqueuelen)."""
    kind: str = ""
    """"can" for a controller, "vcan", …"""
    state: BusState | None = None
    """Of the controller: up, passive or off."""
    bitrate: int = 0
    data_bitrate: int = 0
    restart_ms: int | None = None
    """Delay after which a controller that went bus-off restarts; 0: never by itself."""
    listen_only: bool = False
    counters: tuple[int, int] | None = None
    """The controller's error counters: sending, receiving."""


class NetDevice:
    """An interface of this machine, by its name. Holds one socket for the queries."""

    def __init__(self, name: str) -> None:
        """Raises OSError where no socket can be opened."""
        self.name = name
        self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE)
        self._socket.settimeout(1.0)  # the kernel answers before `send` returns

    def status(self) -> NetStatus | None:
        """Return its index and flags, without a lock; None if there is no interface of this name."""
        try:
            flags, ifindex = self._ioctl(_GET_FLAGS) & 0xFFFF, self._ioctl(_GET_INDEX)
        except OSError:
            return None
        return NetStatus(ifindex, bool(flags & IFF_UP), bool(flags & IFF_RUNNING))

    def link(self) -> NetLink | None:
        """Return all that rtnetlink reports; None if it reports nothing."""
        try:
            self._socket.send(request(self.name))
            return parse(self._socket.recv(65536))
        except OSError:
            return None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _ioctl(self, what: int) -> int:
        reply = fcntl.ioctl(self._socket, what, _IFREQ.pack(self.name.encode(), 0))
        return int(_IFREQ.unpack(reply)[1])


def request(name: str, sequence: int = 1) -> bytes:
    """Encode RTM_GETLINK for the interface of this name."""
    body = _INFO.pack(socket.AF_UNSPEC, 0, 0, 0, 0) + _attribute(_NAME, name.encode() + b"\0")
    return _MESSAGE.pack(_MESSAGE.size + len(body), _GET_LINK, _REQUEST, sequence, 0) + body


def parse(reply: bytes) -> NetLink | None:
    """Decode the reply to a request; None if it is an error, truncated, or something else."""
    try:
        length, kind, *_ = _MESSAGE.unpack_from(reply)
        if kind != _NEW_LINK or length > len(reply):
            return None
        _, _, ifindex, flags, _ = _INFO.unpack_from(reply, _MESSAGE.size)
        found = dict(_attributes(reply[_MESSAGE.size + _INFO.size : length]))
        info = dict(_attributes(found.get(_LINK_INFO, b"")))
        kind_name = _text(info.get(_INFO_KIND, b""))
        data = dict(_attributes(info.get(_INFO_DATA, b""))) if kind_name == "can" else {}
        return NetLink(
            name=_text(found.get(_NAME, b"")),
            ifindex=ifindex,
            up=bool(flags & IFF_UP),
            mtu=_number(found.get(_MTU, _ZERO)),
            queue=_number(found.get(_QUEUE, _ZERO)),
            kind=kind_name,
            state=_STATES.get(_number(data[_STATE])) if _STATE in data else None,
            bitrate=_number(data.get(_BIT_TIMING, _ZERO)),
            data_bitrate=_number(data.get(_DATA_BIT_TIMING, _ZERO)),
            restart_ms=_number(data[_RESTART_MS]) if _RESTART_MS in data else None,
            listen_only=bool(_number(data.get(_MODES, _ZERO), 4) & LISTEN_ONLY),
            counters=_COUNTS.unpack_from(data[_COUNTERS]) if _COUNTERS in data else None,
        )
    except (struct.error, UnicodeDecodeError):
        return None


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Iterate over type and value of each; an invalid length ends the iteration."""
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size or at + length > len(data):
            return
        yield kind & _NESTED, data[at + _ATTRIBUTE.size : at + length]
        at += length + -length % 4


def _attribute(kind: int, value: bytes) -> bytes:
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + bytes(-len(value) % 4)


def _number(value: bytes, at: int = 0) -> int:
    """Decode 32 bits: the bit rate of a bit timing; at 4, the modes that are on."""
    return int(_U32.unpack_from(value, at)[0])


def _text(value: bytes) -> str:
    return value.split(b"\0")[0].decode()
