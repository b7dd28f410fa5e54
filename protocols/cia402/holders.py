"""Who holds a node id: another device than before, or two at once.

Rules. Functions on a `Node`. One answer that came twice is nothing; so many questions in a row that were
answered twice, or heartbeats that contradict each other in turn, are two devices (or two hosts that ask the
same one). It is told once until it is cleared.
"""

from __future__ import annotations

from protocols.cia402 import objects as o
from protocols.cia402.client import DOUBLED, Outcome
from protocols.cia402.codec import PROTOCOL
from protocols.cia402.fault_reports import DUPLICATE_NODE
from protocols.cia402.node import Node
from protocols.messages import Event, Found, Nanos


def on_serial(t: Nanos, node: Node, outcome: Outcome) -> list[Event]:
    """The roll call is answered: with another serial number another device stands there now, of which nothing
    is known."""
    known = node.known.serial if node.known is not None else None
    said = int.from_bytes(outcome.value, "little")
    if outcome.job.key == o.SERIAL_NUMBER and known is not None and said != known:
        node.forget()
        node.received(t)
        return node.report(t, "another device answers")
    return []


def answered_twice(t: Nanos, node: Node) -> list[Event]:
    """An SDO answer came: whether too many in a row came twice. Where one did, the roll is called soon."""
    if node.client.repeated or node.client.doubled:
        node.roll_call = min(node.roll_call, t)
    if node.client.doubled < DOUBLED:
        return []
    return _held_twice(t, node, "every question is answered twice (by two devices, or to two hosts)")


def contradiction(t: Nanos, node: Node) -> list[Event]:
    """A heartbeat came: those that say A B A B come from two devices."""
    said = node.beats
    if len(said) < 4 or said[0] != said[2] or said[1] != said[3] or said[0] == said[1]:
        return []
    return _held_twice(t, node, "its heartbeats contradict each other in turn")


def _held_twice(t: Nanos, node: Node, cause: str) -> list[Event]:
    if node.doubled:
        return []
    node.doubled = True
    serial = node.known.serial if node.known is not None else None
    detail = f"node id {node.address} is held twice: {cause}"
    found = Found(t, PROTOCOL, node.address, serial, detail, duplicate_address=True)
    return [found, *node.complain(t, DUPLICATE_NODE, cause)]
