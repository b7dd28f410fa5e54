"""What a serial port's kernel driver holds of ours, and how it is purged.

Rules. A line or an adapter that stops taking bytes leaves old commands in the kernel, by default some
kilobytes: when it goes on they would all go out, before the newest one. A message that was cut by a purge is
finished by no other: its receiver finds the next one by its framing, or the end of its line is sent.
"""

from __future__ import annotations

import fcntl
import struct
import termios
from contextlib import suppress

_COUNT = struct.Struct("@i")


def held(fileno: int) -> int:
    """Return the bytes that have been written and not sent; 0 where the driver cannot say (a pty's)."""
    try:
        return int(_COUNT.unpack(fcntl.ioctl(fileno, termios.TIOCOUTQ, bytes(_COUNT.size)))[0])
    except (OSError, ValueError):
        return 0


def purge(fileno: int) -> None:
    """Drop what has been written and not sent. Never raises; a port that has gone holds nothing."""
    with suppress(OSError, ValueError, termios.error):
        termios.tcflush(fileno, termios.TCOFLUSH)
