"""LSS: a node id is given to the device with an identity, whatever id it has.

Rules. A device is in LSS waiting or in LSS configuration; there it takes a node id, which counts from its
next reset of communication, and stores it. One that has none yet is silent: `FastScan` finds it by its
identity, bit by bit, and it begins with the id that it was given once it is to wait again. `Slave` is the
device's end: of a twin, whose identity is known, or of a command decoder, which does not know any, and takes
it that a device was selected. Plain data.

Source: CiA 305 "Layer setting services and protocols", as package canopen 2.4.1 (`lss.py`) sends and reads
it. Not here: bit timing.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from protocols.canopen.services import MAX_NODE
from protocols.frames import CanFrame, Frame

MASTER, SLAVE = 0x7E5, 0x7E4
"""Identifiers of the host's messages and of the devices' answers."""
SWITCH_ALL, NODE_ID, STORE = 0x04, 0x11, 0x17
SELECT = (0x40, 0x41, 0x42, 0x43)
"""Vendor, product code, revision and serial number; the device that has them all answers."""
SELECTED, INQUIRE, INQUIRE_NODE = 0x44, (0x5A, 0x5B, 0x5C, 0x5D), 0x5E
FASTSCAN, IDENTIFIED = 0x51, 0x4F
"""The host's guess of a number of the identity, and the answer of each device without a node id that fits"""
BEGIN, BITS = 0x80, 32
"""Bit check of the first message of a fastscan: is there any device without a node id? And of a number"""
ANY_WITHOUT, WITHOUT = 0x4C, 0x50
"""Whether there is any device without a node id, and its answer"""
ASKS = (*INQUIRE, INQUIRE_NODE, ANY_WITHOUT)
UNADDRESSED = 255
"""The node id of a device that has none"""
SIZE = 8

Identity: TypeAlias = tuple[int, int, int, int]
"""Vendor, product code, revision, serial number: object 1018"""
NAMES = {
    SWITCH_ALL: "LSS switch state global",
    NODE_ID: "LSS configure node id",
    STORE: "LSS store",
    **dict.fromkeys(SELECT, "LSS switch state selective"),
    FASTSCAN: "LSS fastscan",
    **dict.fromkeys(ASKS, "LSS inquire"),
}
"""By command."""


def message(command: int, *values: int) -> CanFrame:
    """Return a message of the host: bytes of values, or one of 32 bits."""
    data = struct.pack("<BI", command, *values) if command in SELECT else bytes((command, *values))
    return CanFrame(MASTER, data.ljust(SIZE, b"\0"))


def guess(number: int, bit: int, place: int, after: int) -> CanFrame:
    """Return a message of a fastscan: a number of the identity down to a bit, its place, the next one's."""
    return CanFrame(MASTER, struct.pack("<BIBBB", FASTSCAN, number, bit, place, after))


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
    addressed: bool = True
    """Whether it has a node id."""
    place: int = 0
    """Which number of its identity a fastscan asks for next."""

    def receive(self, data: bytes, address: int) -> bytes:
        """Handle a message; return the answer, b"" if there is none. `address`: its node id."""
        command, (number,) = data[0], struct.unpack_from("<I", data, 1)
        if command in SELECT:
            return self._select(SELECT.index(command), number)
        self.matched = 0
        if command == FASTSCAN:
            return self._fits(number, *data[5:8])
        if command == ANY_WITHOUT:
            return b"" if self.addressed else bytes((WITHOUT,)).ljust(SIZE, b"\0")
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
        own = address if self.addressed else UNADDRESSED
        return bytes((INQUIRE_NODE, own)).ljust(SIZE, b"\0") if command == INQUIRE_NODE else b""

    @property
    def begins(self) -> bool:
        """Whether it has got its first node id, and waits: it begins with it at once."""
        return not self.addressed and self.node != 0 and not self.configuring

    def _fits(self, number: int, bit: int, place: int, after: int) -> bytes:
        """Answer a fastscan, if it has no node id and the guess fits."""
        if self.addressed or self.configuring or self.identity is None:
            return b""
        if bit == BEGIN:
            self.place = 0
        elif place != self.place or bit >= BITS or (number ^ self.identity[self.place]) >> bit:
            return b""
        elif bit == 0 and after != place:
            self.configuring, self.place = place == len(SELECT) - 1, after % len(SELECT)
        return bytes((IDENTIFIED,)).ljust(SIZE, b"\0")

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
        self.addressed = self.addressed or node != 0
        return node


@dataclass(slots=True)
class FastScan:
    """The host's end: finds a device without a node id, and gives it one. A message at a time: what is not
    answered until the next is due does not fit."""

    node: int
    numbers: list[int] = field(default_factory=lambda: [0] * len(SELECT))
    """Of its identity, as far as they are known"""
    step: int = -1
    answered: bool = False
    failed: str = ""

    def message(self) -> CanFrame | None:
        """Return the next message; None once there is none."""
        if self.step >= 0 and not self.failed:
            self._conclude(self.step)
        if self.failed or self.ended:
            return None
        self.step, self.answered = self.step + 1, False
        return self._message(self.step)

    @property
    def ended(self) -> bool:
        """Whether it was given its node id."""
        return self.step >= _STEPS and not self.failed

    def take(self, data: bytes) -> None:
        """Take an answer of a device."""
        expected = {_FOUND: NODE_ID, _FOUND + 1: STORE}.get(self.step, IDENTIFIED)
        self.answered |= data[0] == expected and (expected == IDENTIFIED or data[1] == 0)

    def _message(self, step: int) -> CanFrame | None:
        place, bit = divmod(step - 2, BITS + 1)
        last = {
            0: (SWITCH_ALL, 0),
            _FOUND: (NODE_ID, self.node),
            _FOUND + 1: (STORE,),
            _STEPS: (SWITCH_ALL, 0),
        }
        if step in last:
            return message(*last[step])
        if step == 1:
            return guess(0, BEGIN, 0, 0)
        after = place if bit < BITS else (place + 1) % len(SELECT)
        return guess(self.numbers[place], max(BITS - 1 - bit, 0), place, after)

    def _conclude(self, step: int) -> None:
        """Draw the conclusion from whether the last message was answered."""
        place, bit = divmod(step - 2, BITS + 1)
        if self.answered or step in (0, _STEPS):
            return
        if step == 1:
            self.failed = "no device without a node id answers"
        elif step == _FOUND:
            self.failed = "the device does not take this node id"
        elif step < _FOUND and bit < BITS:
            self.numbers[place] |= 1 << (BITS - 1 - bit)
        elif step < _FOUND:
            self.failed = "a device without a node id answers, and its identity cannot be read"


_FOUND = 2 + len(SELECT) * (BITS + 1)
"""The step in which the identity is known, and the node id is given; then it is stored,"""
_STEPS = _FOUND + 2
"""and in the last all wait again"""
