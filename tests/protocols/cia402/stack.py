"""Package canopen 2.4.1 without a bus and without a thread: its networks joined by function calls.

Rules. What a network sends is kept in order and passed on at once, so that a master's SDO client has its
response before it begins to wait. `Slave` is a `LocalNode` as a device for the driver. Nothing is measured in
wall time.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import canopen

import protocols.cia402
from protocols.cia402 import plugin
from protocols.frames import CanFrame
from protocols.reference_vectors import vectors_of

EDS = str(Path(protocols.cia402.__file__).parent / "twin.eds")
PACKAGE = "canopen 2.4.1"
VECTORS = vectors_of(plugin)
"""The independent vectors, which it has made."""


@cache
def _parsed(node: int) -> Any:
    return canopen.import_od(EDS, node_id=node)


def dictionary(node: int) -> Any:
    """Return the twin's EDS as the package reads it; a copy that may be changed."""
    return deepcopy(_parsed(node))


class Joined(canopen.Network):
    """A network whose frames go to a list, and to `on_sent`."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[CanFrame] = []
        self.on_sent: Callable[[CanFrame], None] = lambda _: None
        self.cyclic: dict[int, bytes] = {}
        """What it sends by a timer of its own, which does not run here."""

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        frame = CanFrame(can_id, bytes(data), remote=remote)
        self.sent.append(frame)
        self.on_sent(frame)

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        self.cyclic[can_id] = bytes(data)
        return Timer(self, can_id)

    def handle(self, frame: CanFrame) -> None:
        """A frame of the other side."""
        self.notify(frame.id, bytearray(frame.data), 0.0)


class Timer:
    """A periodic message of the package, without its thread."""

    def __init__(self, network: Joined, can_id: int) -> None:
        self.network, self.can_id = network, can_id

    def stop(self) -> None:
        self.network.cyclic.pop(self.can_id, None)

    def update(self, data: Any) -> None:
        self.network.cyclic[self.can_id] = bytes(data)


class Slave:
    """A LocalNode with the twin's dictionary. It has no state machine of CiA 402."""

    def __init__(self, node: int) -> None:
        self.network = Joined()
        self.node: Any = self.network.create_node(node, dictionary(node))
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = "PRE-OPERATIONAL"

    def receive(self, frame: CanFrame) -> None:
        self.network.handle(frame)

    def take_sent(self) -> list[CanFrame]:
        """Return what it has sent since the last call."""
        sent, self.network.sent = self.network.sent, []
        return sent

    def value(self, index: int, sub: int = 0) -> int:
        """Return a value of its dictionary."""
        return int.from_bytes(self.node.get_data(index, sub), "little")


def master(node: int) -> tuple[Joined, Any]:
    """Return (network, node): a RemoteNode whose frames a LocalNode answers at once."""
    network, slave = Joined(), Slave(node)
    slave.take_sent()
    remote = canopen.RemoteNode(node, dictionary(node))
    network.add_node(remote)
    slave.network.on_sent = network.handle
    network.on_sent = slave.network.handle
    return network, remote
