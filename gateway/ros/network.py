"""Where the graph is: this machine alone, a network by the name or address of our interface to it, or zenoh,
by the endpoint of its router."""

from __future__ import annotations

import fcntl
import ipaddress
import re
import socket
import struct

from gateway.errors import UserError

LOOPBACK = "127.0.0.1"
ZENOH, ENDPOINT = "zenoh", r"(tcp|udp|tls|quic)/[A-Za-z0-9_.-]+:[0-9]{1,5}"
ROUTER = "tcp/127.0.0.1:7447"
"""Where rmw_zenoh has its router."""
_SIOCGIFADDR = 0x8915


def is_zenoh(network: str) -> bool:
    """Return whether a network is zenoh's."""
    return network.partition(":")[0] == ZENOH


def zenoh_endpoint(network: str) -> tuple[str, bool]:
    """Return the router's endpoint, and whether we may be it: on this machine alone."""
    endpoint = network.partition(":")[2] or ROUTER
    return endpoint, bool(re.match(r"\w+/(localhost|127\.)", endpoint))


def parse_network(text: str) -> str:
    """Return the address of our interface, or `zenoh[:ENDPOINT]`; "": this machine alone. Raises UserError if
    there is none."""
    if not text:
        return LOOPBACK
    if is_zenoh(text):
        if not re.fullmatch(f"{ZENOH}(:{ENDPOINT})?", text):
            raise UserError(f"--ros {text}: expected {ZENOH}, or {ZENOH}:tcp/HOST:PORT of its router")
        return text
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
