"""What the ASCII protocols of adapters share: cutting a stream into lines. Pure."""

from __future__ import annotations

import re

HEX = re.compile(r"[0-9A-Fa-f]*")


class LineSplitter:
    """Cuts a stream of bytes into lines of bounded length."""

    def __init__(self, ends: bytes, longest: int) -> None:
        """`ends`: pattern of a line's end; `longest`: bytes of a line."""
        self._ends = re.compile(ends)
        self._longest = longest
        self._rest = b""
        self._skipping = False
        """The line that has begun is too long already."""

    def feed(self, data: bytes) -> list[bytes | None]:
        """Return the lines that are now complete, without their ends; None for each that was too long."""
        *complete, rest = self._ends.split(self._rest + data)
        lines = [line if len(line) <= self._longest else None for line in complete]
        if lines and self._skipping:
            lines[0], self._skipping = None, False
        self._skipping = self._skipping or len(rest) > self._longest
        self._rest = b"" if self._skipping else rest
        return lines
