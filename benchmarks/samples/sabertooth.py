"""Benchmark samples of sabertooth, measured beside pysabertooth on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. The package has no codec of its own: it is called
as its user calls it, with a port in memory. Nothing comes back from a board. Bare `struct` knows message and
checksum beforehand, and checks nothing: it is the lower bound. The package does little more: it adds up
address, command and value, and makes bytes of the four numbers. Ours also saturates, and refuses what is not
finite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Any

from protocols.sabertooth import table as st

RIVAL = ("pysabertooth", "pysabertooth", "a package that adds up three numbers; a port in memory")
BOARD, PERCENT, VALUE = 128, 50, 63
_MESSAGE = Struct("4B")


class Port:
    """A serial port in memory."""

    written = b""

    def write(self, data: bytes) -> int:
        """Take what is written."""
        self.written = data
        return len(data)

    def flush(self) -> None:
        """Do nothing."""


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return a board of the package with this port. Its own constructor sleeps; its destructor sends."""

    class Board(package.Sabertooth):  # type: ignore[misc]
        def __init__(self) -> None:
            self.saber, self.address = Port(), BOARD

        def __del__(self) -> None:
            """Send nothing."""

    return Board()


@dataclass(frozen=True, slots=True)
class Sample:
    """One message."""

    what: str
    ours: Callable[[], bytes]
    struct: Callable[[], bytes]

    def theirs(self, known: Any) -> Callable[[], bytes]:  # noqa: ANN401 -- a package without types
        """Return the same in the package."""

        def drive() -> bytes:
            known.drive(1, PERCENT)
            return bytes(known.saber.written)

        return drive

    def alike(self, ours: bytes, theirs: bytes, struct: bytes) -> bool:
        """Return whether the bytes are the same."""
        return ours == theirs == struct


SAMPLES = (
    Sample(
        "encode M1FORWARD",
        lambda: st.PACKETS.encoder("M1FORWARD")(BOARD, value=VALUE),
        lambda: _MESSAGE.pack(BOARD, 0, VALUE, (BOARD + VALUE) & 0x7F),
    ),
)
