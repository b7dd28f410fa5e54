"""LSS: a node id is given to the device with an identity, whatever id it has.

Rules. A device is in LSS waiting or in LSS configuration; there it takes a node id, which counts from its
next reset of communication, and stores it. `Slave` is the device's end: of a twin, whose identity is known,
or of a command decoder, which does not know any, and takes it that a device was selected. Plain data.

Source: CiA 305 "Layer setting services and protocols", as package canopen 2.4.1 (`lss.py`) sends and reads
it. Not here: bit timing, fastscan, devices without a node id.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from protocols.canopen.services import MAX_NODE
from protocols.frames import CanFrame, Frame

MASTER, SLAVE = 0x7E5, 0x7E4
"""Identifiers of the host's messages and of the devices' answers."""
SWITCH_ALL, NODE_ID, STORE = 0x04, 0x11, 0x17
SELECT = (0x40, 0x41, 0x42, 0x43)
"""Vendor, product code, revision and serial number; the device that has them all answers."""
SELECTED, INQUIRE, INQUIRE_NODE = 0x44, (0x5A, 0x5B, 0x5C, 0x5D), 0x5E
ASKS = (*INQUIRE, INQUIRE_NODE)
SIZE = 8

Identity: TypeAlias = tuple[int, int, int, int]
"""Vendor, product code, revision, serial number: object 1018"""
NAMES = {
    SWITCH_ALL: "LSS switch state global",
    NODE_ID: "LSS configure node id",
    STORE: "LSS store",
    **dict.fromkeys(SELECT, "LSS switch state selective"),
    **dict.fromkeys(ASKS, "LSS inquire"),
}
"""By command."""


def message(command: int, *values: int) -> CanFrame:
    """Return a message of the host: bytes of values, or one of 32 bits."""
    data = struct.pack("<BI", command, *values) if command in SELECT else bytes((command, *values))
    return CanFrame(MASTER, data.ljust(SIZE, b"\0"))


def is_message(frame: Frame) -> bool:
    """True for a message of a host."""
    return isinstance(frame, CanFrame) and frame == CanFrame(MASTER, frame.data) and len(frame.data) == SIZE


def assignment(identity: Identity, node: int) -> Sequence[CanFrame]:
    """Return what gives the device of an identity a node id, which counts from its next reset."""
    selected = (message(command, number) for command, number in zip(SELECT, identity, strict=True))
    return *selected, message(NODE_ID, node), message(STORE), message(SWITCH_ALL, 0)


@dataclass(slots=True)
class Slave:
    """One device."""

    identity: Identity | None
    """None: not known."""
    configuring: bool = False
    matched: int = 0
    """How many numbers of its identity have come, one after the other."""
    node: int = 0
    """The node id that it is to have from its next reset on; 0: the one it has."""

    def receive(self, data: bytes, address: int) -> bytes:
        """Handle a message; return the answer, b"" if there is none. `address`: its node id."""
        command, (number,) = data[0], struct.unpack_from("<I", data, 1)
        if command in SELECT:
            return self._select(SELECT.index(command), number)
        self.matched = 0
        if command == SWITCH_ALL:
            self.configuring = data[1] == 1
            return b""
        if not self.configuring:
            return b""
        if command == NODE_ID:
            fits = 1 <= data[1] <= MAX_NODE
            self.node = data[1] if fits else self.node
            return bytes((NODE_ID, not fits)).ljust(SIZE, b"\0")
        if command == STORE:
            return bytes((STORE,)).ljust(SIZE, b"\0")
        if command in INQUIRE and self.identity is not None:
            return struct.pack("<BI", command, self.identity[INQUIRE.index(command)]).ljust(SIZE, b"\0")
        return bytes((INQUIRE_NODE, address)).ljust(SIZE, b"\0") if command == INQUIRE_NODE else b""

    def _select(self, at: int, number: int) -> bytes:
        follows = self.identity is None or (at == self.matched and number == self.identity[at])
        self.matched = at + 1 if follows else 0
        if self.matched < len(SELECT):
            return b""
        self.matched, self.configuring = 0, True
        return bytes((SELECTED,)).ljust(SIZE, b"\0")

    def take(self) -> int:
        """Return the node id that counts from a reset on, once; 0: the one it has."""
        node, self.node = self.node, 0
        return node
