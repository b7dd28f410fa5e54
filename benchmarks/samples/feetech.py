"""Benchmark samples of feetech, measured beside the vendor's feetech-servo-sdk on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. The package does what it does for each packet,
with a port that keeps what is sent and gives one answer. Bare `struct` knows its packet beforehand and
checks nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.feetech.table import FAMILIES, PACKETS
from protocols.toolkit.servo_packets import READ, WRITE, Packet

RIVAL = ("scservo_sdk", "feetech-servo-sdk", "the vendor's PacketHandler, its port in memory")
STS = FAMILIES["sts"]
GOALS = {n: 2000 + n for n in range(1, 7)}
_GOALS = bytes.fromhex("fffffe16832a0201d10702d20703d30704d40705d50706d60708")
_GOAL = bytes.fromhex("ffff0105032a000cc0")
_STATUS = bytes.fromhex("ffff010a0000089680c80479246d")
_QUESTION = Packet(1, READ, bytes((56, 8)))
_MOTION = struct.Struct("<HHHBB")


class Port:
    """As much of a port as the package needs."""

    is_using = False

    def __init__(self) -> None:
        self.sent = b""
        self.answer = list(_STATUS)
        self.at = 0

    def clearPort(self) -> None:  # noqa: N802 -- the package's names
        """Nothing is left over."""

    def writePort(self, data: list[int]) -> int:  # noqa: N802
        """Keep it."""
        self.sent = bytes(data)
        return len(data)

    def readPort(self, size: int) -> list[int]:  # noqa: N802
        """Return the next bytes of the answer, again and again."""
        part = self.answer[self.at : self.at + size]
        self.at = (self.at + size) % len(self.answer)
        return part

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Return that there is time."""
        return False


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return the package, its handler of packets and a port."""
    return package, package.PacketHandler(0), Port()


def goals() -> bytes:
    """Return a sync write of six goals."""
    return PACKETS.sync_write(42, {number: STS.data("Goal_Position", goal) for number, goal in GOALS.items()})


def motion() -> tuple[int, ...]:
    """Return what an answer measures."""
    (status,), _ = PACKETS.answered({1: (56, 8)}, _QUESTION, _STATUS)
    return tuple(STS.values(56, status[2]).values())


def goal() -> bytes:
    """Return the write of one goal."""
    return PACKETS.packet(1, WRITE, b"\x2a" + STS.data("Goal_Position", 3072))


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    packet: bytes

    def theirs(self, known: Any) -> Callable[[], Any]:  # noqa: ANN401 -- a package without types
        """Return the same operation in the package."""
        sdk, handler, port = known

        def encode() -> bytes:
            group = sdk.GroupSyncWrite(port, handler, 42, 2)
            for number, goal in GOALS.items():
                group.addParam(number, [sdk.SCS_LOBYTE(goal), sdk.SCS_HIBYTE(goal)])
            group.txPacket()
            port.is_using = False
            return bytes(port.sent)

        def decode() -> tuple[int, ...]:
            data, _, _ = handler.readRx(port, 1, 8)
            words = (sdk.SCS_MAKEWORD(data[at], data[at + 1]) for at in (0, 2, 4))
            place, speed, load = words
            return place, sdk.SCS_TOHOST(speed, 15), sdk.SCS_TOHOST(load, 10), data[6], data[7]

        def one() -> bytes:
            handler.write2ByteTxOnly(port, 1, 42, 3072)
            port.is_using = False
            return bytes(port.sent)

        return {_GOALS: encode, _GOAL: one}.get(self.packet, decode)

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a packet, or numbers
        """True if encoding gave the same packet, or decoding the same numbers."""
        if self.packet is not _STATUS:
            return bool(ours == theirs == self.packet and struct in self.packet)
        return bool(ours == theirs and struct[0] == theirs[0])


SAMPLES = (
    Sample("encode a write of a goal", goal, lambda: struct.pack("<BH", 42, 3072), _GOAL),
    Sample(
        "encode a sync write of 6 goals",
        goals,
        lambda: struct.pack("<BHBHBHBHBHBH", *(each for pair in GOALS.items() for each in pair)),
        _GOALS,
    ),
    Sample("decode an answer of 8 bytes", motion, lambda: _MOTION.unpack(_STATUS[5:13]), _STATUS),
)
