"""Benchmark samples of roboclaw, measured beside basicmicro on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. The vendor's package has no codec of its own: it
is called as its user calls it, with a port in memory that takes what is written and has the answer ready.
Bare `struct` knows message and checksum beforehand, and checks nothing: it is the lower bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Any

from protocols.roboclaw import table as rt

RIVAL = ("basicmicro", "basicmicro", "the vendor's package, a port in memory")
BOARD, SPEED, COUNT = 0x80, -12_345, 0x0123_4567
_SPEED, _ENCODER = Struct(">BBiH"), Struct(">IBH")
ASKED = rt.PACKETS.encode("GETM1ENC", BOARD)
ANSWER = rt.answer(ASKED, "GETM1ENC", count=COUNT, status=0)
CHECK = int.from_bytes(rt.PACKETS.encode("M1SPEED", BOARD, speed=SPEED)[-2:], "big")


class Port:
    """A serial port in memory."""

    is_open = True

    def __init__(self) -> None:
        self.written = bytearray()
        self.answer = b""

    def write(self, data: bytes) -> int:
        """Take what is written."""
        self.written += data
        return len(data)

    def read(self, size: int) -> bytes:
        """Return the next bytes of the answer."""
        data, self.answer = self.answer[:size], self.answer[size:]
        return data

    def flushInput(self) -> None:  # noqa: N802 -- pyserial's
        """Do nothing."""


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return a board of the package, and its port."""
    board, port = package.Basicmicro("memory", 115_200, retries=1), Port()
    vars(board).update(_port=port, _connected=True)
    return board, port


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    theirs: Callable[[Any], Callable[[], Any]]

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- bytes, or numbers
        """True if the bytes are the same, or the numbers in order (bare `struct` has the checksum, too)."""
        if isinstance(ours, bytes):
            return bool(ours == theirs == struct)
        return bool(tuple(ours.values()) == theirs == struct[:2])


def _made(known: Any) -> Callable[[], bytes]:  # noqa: ANN401 -- a package without types
    board, port = known

    def make() -> bytes:
        port.written.clear()
        port.answer = rt.ACK
        board.SpeedM1(BOARD, SPEED)
        return bytes(port.written)

    return make


def _read(known: Any) -> Callable[[], tuple[int, int]]:  # noqa: ANN401
    board, port = known

    def read() -> tuple[int, int]:
        port.written.clear()
        port.answer = ANSWER
        _, count, status = board.ReadEncM1(BOARD)
        return count, status

    return read


def _found() -> Any:  # noqa: ANN401 -- numbers
    """What the driver does with an answer: find it, and read it by what was asked."""
    found = rt.find_answer(ASKED, ANSWER)
    assert found is not None
    return rt.read_answer(ASKED, ANSWER[found[0] : found[1]])[1]


SAMPLES = (
    Sample(
        "encode M1SPEED",
        lambda: rt.PACKETS.encoder("M1SPEED")(BOARD, speed=SPEED),
        lambda: _SPEED.pack(BOARD, 35, SPEED, CHECK),
        _made,
    ),
    Sample("decode the answer to GETM1ENC", _found, lambda: _ENCODER.unpack(ANSWER), _read),
)
