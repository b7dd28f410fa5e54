"""What the ASCII protocols of adapters share: cutting a stream into lines. Pure."""

from __future__ import annotations

import re

HEX = re.compile(r"[0-9A-Fa-f]*")
ENDS = re.compile(rb"\r\n?|\n")


class LineSplitter:
    """Cuts a stream of bytes into lines of bounded length, which end with CR, LF, or both."""

    def __init__(self, longest: int) -> None:
        """`longest`: bytes of a line."""
        self._longest = longest
        self._rest = b""
        self._skipping = False
        """The line that has begun is too long already."""
        self._returned = False
        """The last byte was CR: a LF belongs to it."""

    def feed(self, data: bytes) -> list[bytes | None]:
        """Return the lines that are now complete, without their ends; None for each that was too long."""
        if data:
            belongs, self._returned = self._returned and data[:1] == b"\n", data.endswith(b"\r")
            data = data[belongs:]
        *complete, rest = ENDS.split(self._rest + data)
        lines = [line if len(line) <= self._longest else None for line in complete]
        if lines and self._skipping:
            lines[0], self._skipping = None, False
        self._skipping = self._skipping or len(rest) > self._longest
        self._rest = b"" if self._skipping else rest
        return lines
