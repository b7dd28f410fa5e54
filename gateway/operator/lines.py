"""Bytes from a person, cut into lines of bounded length."""

from __future__ import annotations

from dataclasses import dataclass, field

from gateway.operator.commands import Mistake

MOST_LINE = 1000
"""Bytes of a line."""

_TOO_LONG = Mistake(f"the line is longer than {MOST_LINE} bytes; it is left out")


@dataclass(slots=True)
class Lines:
    """Bytes cut into lines; a line that is too long is left out and told."""

    rest: bytearray = field(default_factory=bytearray)
    skipping: bool = False

    def feed(self, data: bytes) -> list[str | Mistake]:
        """The lines that these bytes end."""
        self.rest += data
        *whole, self.rest = self.rest.split(b"\n")
        lines: list[str | Mistake] = []
        for line in whole:
            if not self.skipping:
                lines.append(self._checked(line))
            self.skipping = False
        if len(self.rest) > MOST_LINE:
            if not self.skipping:
                lines.append(_TOO_LONG)
            self.skipping = True
            self.rest.clear()
        return lines

    def end(self) -> list[str | Mistake]:
        """What stood behind the last line's end, when nothing more will come."""
        line, self.rest = self.rest, bytearray()
        return [self._checked(line)] if line and not self.skipping else []

    @staticmethod
    def _checked(line: bytearray) -> str | Mistake:
        if len(line) > MOST_LINE:
            return _TOO_LONG
        return line.decode("utf-8", "replace").strip()
