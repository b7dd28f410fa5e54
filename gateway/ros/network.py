"""Where the graph is: this machine alone, or a network by the name or address of our interface to it."""

from __future__ import annotations

import fcntl
import ipaddress
import socket
import struct

from gateway.errors import UserError

LOOPBACK = "127.0.0.1"
_SIOCGIFADDR = 0x8915


def parse_network(text: str) -> str:
    """Return the address of our interface; "": this machine alone. Raises UserError if there is none."""
    if not text:
        return LOOPBACK
    try:
        return str(ipaddress.IPv4Address(text))
    except ValueError:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        try:
            found = fcntl.ioctl(one.fileno(), _SIOCGIFADDR, struct.pack("256s", text.encode()[:15]))
        except OSError as error:
            names = ", ".join(name for _, name in socket.if_nameindex())
            raise UserError(
                f"--ros {text}: expected an address of this machine, or an interface that has one ({names})"
            ) from error
    return socket.inet_ntoa(found[20:24])
