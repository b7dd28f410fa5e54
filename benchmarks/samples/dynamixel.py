"""Benchmark samples of dynamixel, measured beside the vendor's dynamixel-sdk on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. The package does what it does for each packet, on
a port that keeps what is written and gives what is to be read. Bare `struct` knows its message beforehand and
computes no checksum: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from protocols.dynamixel.packets import PACKETS, STATUS

RIVAL = ("dynamixel_sdk", "dynamixel-sdk", "the vendor's PacketHandler and GroupSyncWrite")
GOALS = {number: 1000 + 50 * number for number in range(1, 13)}
_NUMBERS = [(-100 + each, -230 * each, 2000 + each) for each in GOALS]
_ANSWERS = b"".join(
    PACKETS.packet(number, STATUS, bytes(1) + struct.pack("<hii", *each))
    for number, each in zip(GOALS, _NUMBERS, strict=True)
)
_WANTED = dict.fromkeys(GOALS, (126, 10))
_QUESTION = PACKETS.question(PACKETS.asks(_WANTED, "", 0))
_GOAL = struct.Struct("<BI")
_MOTION = struct.Struct("<hii")


class OnePort:
    """As much of a port as the package needs."""

    is_using = False

    def __init__(self) -> None:
        self.sent = b""
        self.held = b""

    def clearPort(self) -> None:  # noqa: N802 -- the vendor's name
        """Nothing is held."""

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        """Keep it."""
        self.sent = bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return the next bytes of the answers."""
        self.held = self.held or _ANSWERS
        read, self.held = self.held[:length], self.held[length:]
        return read

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802
        """It comes in time."""

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Never."""
        return False


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return a port, and the package's sync write and sync read of it."""
    port, handler = OnePort(), package.PacketHandler(2.0)
    writes = package.GroupSyncWrite(port, handler, 116, 4)
    for number in GOALS:
        writes.addParam(number, [0, 0, 0, 0])
    reads = package.GroupSyncRead(port, handler, 126, 10)
    for number in GOALS:
        reads.addParam(number)
    return port, writes, reads


def _encode() -> bytes:
    return PACKETS.sync_write(116, {number: goal.to_bytes(4, "little") for number, goal in GOALS.items()})


def _encode_bare() -> bytes:
    return b"".join(_GOAL.pack(number, goal) for number, goal in GOALS.items())


def _decode() -> list[tuple[int, ...]]:
    found, _ = PACKETS.answered(_WANTED, _QUESTION, _ANSWERS)
    return [_MOTION.unpack(data) for _, _, data in found]


def _decode_bare() -> list[tuple[int, ...]]:
    return [_MOTION.unpack_from(_ANSWERS, at) for at in range(9, len(_ANSWERS), 21)]


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    encodes: bool

    def theirs(self, known: Any) -> Callable[[], Any]:  # noqa: ANN401 -- a package without types
        """Return the same operation in the package."""
        port, writes, reads = known

        def encode() -> bytes:
            for number, goal in GOALS.items():
                writes.changeParam(number, [goal & 0xFF, goal >> 8 & 0xFF, goal >> 16 & 0xFF, goal >> 24])
            writes.txPacket()
            port.is_using = False
            sent: bytes = port.sent
            return sent

        def decode() -> list[tuple[int, ...]]:
            reads.rxPacket()
            port.is_using = False
            return [
                tuple(
                    (value ^ sign) - sign
                    for at, size, sign in ((126, 2, 1 << 15), (128, 4, 1 << 31), (132, 4, 1 << 31))
                    for value in (reads.getData(number, at, size),)
                )
                for number in GOALS
            ]

        return encode if self.encodes else decode

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401
        """Whether all came to the same."""
        return bool(ours == theirs) and (struct in ours if self.encodes else struct == ours)


SAMPLES = (
    Sample("encode a sync write of 12 goals", _encode, _encode_bare, encodes=True),
    Sample("decode the answers of 12 to a sync read", _decode, _decode_bare, encodes=False),
)
