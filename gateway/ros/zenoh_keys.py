"""How rmw_zenoh names what is in the graph: keys of data, liveliness tokens, attachments. No session here.

A token tells of a node or an endpoint for as long as its session lives; a name's slashes are "%" in it. Only
what differs from the default QoS is written out: reliability 2 is best effort, durability 1 transient local.

Source: ros2/rmw_zenoh, docs/design.md (graph, attachments) and its liveliness tokens, as of Kilted.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from protocols.messages import Nanos

ROOT = "@ros2_lv"
PUBLISHES, SUBSCRIBES, SERVES, CALLS = "MP", "MS", "SS", "SC"
_ATTACHMENT = struct.Struct("<qqB16s")


class Endpoint(NamedTuple):
    """A publisher, subscription, service or client."""

    kind: str
    name: str
    """In the graph, with its slash"""
    type: str
    """As DDS has it"""
    hash: str
    reliable: bool = True
    transient: bool = False
    depth: int = 10


class Node(NamedTuple):
    """Whose endpoints these are."""

    domain: int
    session: str
    """The id of its session"""
    namespace: str
    name: str


def data_key(domain: int, one: Endpoint) -> str:
    """Return the key of a topic's samples, or of a service's requests."""
    return f"{domain}/{one.name.strip('/')}/{one.type}/{one.hash}"


def node_token(node: Node) -> str:
    """Return the token of a node."""
    return f"{ROOT}/{node.domain}/{node.session}/0/0/NN/%/{_flat(node.namespace or '/')}/{node.name}"


def token(node: Node, number: int, one: Endpoint) -> str:
    """Return the token of an endpoint; `number`: its own in the session, from 1 on."""
    whose = f"{one.kind}/%/{_flat(node.namespace or '/')}/{node.name}"
    what = f"{_flat(one.name)}/{one.type}/{one.hash}/{_qos(one)}"
    return f"{ROOT}/{node.domain}/{node.session}/0/{number}/{whose}/{what}"


def subscribed(text: str) -> tuple[str, str] | None:
    """Return name and type of the subscription that a token is of; None if it is of something else."""
    parts = text.split("/")
    return (parts[9].replace("%", "/"), parts[10]) if len(parts) == 13 and parts[5] == SUBSCRIBES else None


def _flat(name: str) -> str:
    return name.replace("/", "%")


def _qos(one: Endpoint) -> str:
    reliability, durability = "" if one.reliable else "2", "1" if one.transient else ""
    return f"{reliability}:{durability}:,{one.depth}:,:,:,,"


def gid(text: str) -> bytes:
    """Return the 16 bytes by which an endpoint is known: the hash XXH3 of its token, its lower half first."""
    import xxhash

    both = xxhash.xxh3_128_intdigest(text.encode())
    return struct.pack("<QQ", both & (1 << 64) - 1, both >> 64)


def attachment(number: int, stamp: Nanos, writer: bytes) -> bytes:
    """Return what goes with a sample, request or reply."""
    return _ATTACHMENT.pack(number, stamp, len(writer), writer)


def read_attachment(data: bytes) -> tuple[int, bytes] | None:
    """Return the number, and of whom it is; None if these bytes are no attachment. Newer ones than Kilted's
    have no length before the last 16 bytes."""
    if len(data) == _ATTACHMENT.size - 1:
        data = data[:16] + b"\x10" + data[16:]
    if len(data) != _ATTACHMENT.size:
        return None
    number, _, length, writer = _ATTACHMENT.unpack(data)
    return (number, writer) if length == len(writer) else None
