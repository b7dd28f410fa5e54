"""Benchmark samples of robstride, measured beside the vendor's robstride-dynamics on the same bytes.

Rules. Data and calls only: the robot uses nothing of this. Every contestant starts from plain values, or from
a frame. The package does what it does for each command and status, with a bus that keeps one message; ours
makes the frame. Bare `struct` knows its message beforehand and checks nothing: it is the lower bound.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from typing import Any

from protocols.frames import CanFrame
from protocols.robstride.table import table_of

RIVAL = ("robstride_dynamics", "robstride-dynamics", "the vendor's RobstrideBus")
TABLE = table_of("RS02")
ENCODE = TABLE.encoder("control")
NUMBERS = {"position": 1.0, "velocity": 0.0, "stiffness": 50.0, "damping": 1.5, "torque": 0.0}
_COMMAND = CanFrame(0x017FFF05, bytes.fromhex("8a2e7fff19994ccc"), extended=True)
_STATUS = CanFrame(0x028005FD, bytes.fromhex("85177ba285a5013b"), extended=True)
_EIGHT = struct.Struct(">HHHH")


class OneMessage:
    """As much of a bus as the package needs."""

    def __init__(self) -> None:
        import can

        self.sent: Any = None
        self.status = can.Message(arbitration_id=_STATUS.id, data=_STATUS.data, is_extended_id=True)

    def send(self, message: Any) -> None:  # noqa: ANN401 -- python-can's
        """Keep it."""
        self.sent = message

    def recv(self, timeout: float | None = None) -> Any:  # noqa: ANN401, ARG002 -- python-can's
        """Return the status."""
        return self.status

    def shutdown(self) -> None:
        """Nothing is open."""


def prepared(package: Any) -> Any:  # noqa: ANN401 -- a package without types
    """Return the package's bus, with one motor on it."""

    class Bus(package.RobstrideBus):  # type: ignore[misc]
        def __del__(self) -> None:
            """Nothing is open: no motor is to be disabled."""

    with redirect_stdout(StringIO()):
        bus = Bus("", {"left": package.Motor(5, "rs-02")})
    bus.channel_handler = OneMessage()
    return bus


@dataclass(frozen=True, slots=True)
class Sample:
    """One message in one direction."""

    what: str
    ours: Callable[[], Any]
    struct: Callable[[], Any]
    encodes: bool

    def theirs(self, known: Any) -> Callable[[], Any]:  # noqa: ANN401 -- a package without types
        """Return the same operation in the package."""
        if not self.encodes:
            return lambda: known.receive_status_frame("left")
        p, v, kp, kd, t = NUMBERS.values()

        def encode() -> Any:  # noqa: ANN401
            known.write_operation_frame("left", p, kp, kd, v, t)
            return known.channel_handler.sent

        return encode

    def alike(self, ours: Any, theirs: Any, struct: Any) -> bool:  # noqa: ANN401 -- a frame, or numbers
        """True if encoding gave the same frame, or decoding the same velocity."""
        if self.encodes:
            theirs = CanFrame(int(theirs.arbitration_id), bytes(theirs.data), extended=True)
            return bool(theirs == ours == _COMMAND and struct == ours.data)
        return bool(abs(ours.values["velocity"] - theirs[1]) < 1e-3 and struct == _EIGHT.unpack(_STATUS.data))


SAMPLES = (
    Sample(
        "encode control",
        lambda: ENCODE(5, **NUMBERS),
        lambda: _EIGHT.pack(0x8A2E, 0x7FFF, 0x1999, 0x4CCC),
        True,
    ),
    Sample(
        "decode status",
        lambda: TABLE.decode(_STATUS, "from_device"),
        lambda: _EIGHT.unpack(_STATUS.data),
        False,
    ),
)
