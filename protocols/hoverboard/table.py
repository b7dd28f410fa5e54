"""The two messages of a hoverboard's mainboard with the FOC firmware, in its own units: counts to ±1000, rpm.

Rules. Nothing in a message says which board sent it, or which motor it is for: one board is on a line, and a
message is for both of its motors, or from both. `mix` and `unmix` are what the firmware makes of its two
inputs: steer and speed, or (TANK_STEERING) left and right.

Source: EFeru/hoverboard-firmware-hack-FOC@a0751d5 `Arduino/hoverserial/hoverserial.ino`, `Src/util.c`
(`mixerFcn`), `Src/main.c`, `Inc/config.h`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from protocols.toolkit.packets import Packets
from protocols.toolkit.serial import Framing, xor8
from protocols.toolkit.table import Row, const, sint, uint

LEFT, RIGHT = 1, 2
"""The address of each motor of a board: one board is on a line."""
ADDRESSES = range(LEFT, RIGHT + 1)
MOST, LITTLE = 1000, 50
"""Counts: the ends of an input; and what both must be below when the motors are enabled"""
RPM = math.pi / 30.0
"""rad/s"""
UNKNOWN = -(1 << 15)
"""rpm that no motor turns at: of a motor that is not there"""
PERIOD_MS, TIMEOUT_MS = 10, 800
"""Of the feedback; and of silence, after which the motors coast (SERIAL_TIMEOUT)"""
_SYNC = b"\xcd\xab"


def xor16(data: bytes) -> int:
    """XOR of all words."""
    return xor8(data[::2]) | xor8(data[1::2]) << 8


def _is_command(head: bytes) -> int | None:
    """Return 0, the bytes behind steer and speed; None if these are out of range. The checksum of two equal
    numbers is the sync: with the sync behind it, it would begin a message, whose steer is out of range."""
    numbers = (int.from_bytes(head[at : at + 2], "little", signed=True) for at in (2, 4))
    return 0 if all(abs(number) <= MOST for number in numbers) else None


def _packets(row: Row, framing: Framing) -> Packets:
    return Packets((row,), framing, lambda _, __, data: _SYNC + data, lambda message: (0, 0, message[2:]))


COMMANDS = _packets(
    Row("command", (const(0, 16),), (sint("steer"), sint("speed"))), Framing(_SYNC, 6, _is_command, xor16, 2)
)
FEEDBACK = _packets(
    Row(
        "feedback",
        (const(0, 16),),
        (
            *(sint("steer"), sint("speed"), sint("right"), sint("left")),
            *(sint("voltage", 16, 0.01), sint("temperature", 16, 0.1), uint("led", 16)),
        ),
        "from_device",
    ),
    Framing(_SYNC, 2, lambda _: 14, xor16, 2),
)


class Counts(NamedTuple):
    """What the motors are to do, forwards positive."""

    left: int
    right: int

    def of(self, address: int) -> int:
        """Return that of one motor."""
        return self.left if address == LEFT else self.right


def mix(left: int, right: int, *, tank: bool) -> tuple[int, int]:
    """Return steer and speed, of which the firmware makes these counts."""
    return (left, right) if tank else (left - right, -(-(left + right) // 2))


def unmix(steer: int, speed: int, *, tank: bool) -> Counts:
    """Return what the firmware makes of steer and speed."""
    if tank:
        return Counts(steer, speed)
    left, right = ((speed << 4) + sign * (steer << 4 >> 1) >> 4 for sign in (1, -1))
    return Counts(max(-MOST, min(MOST, left)), max(-MOST, min(MOST, right)))
