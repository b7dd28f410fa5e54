"""What is drawn on a terminal: a page that is refreshed in place, a line that is; nothing but ANSI sequences.

Rules. What cannot be drawn at once because the terminal is not reading is left out: nobody here waits for a
screen. Lines are cut to the terminal's width, pages to its height, and a character that would do something to
the terminal is replaced. Leaving gives the cursor back and leaves the last page standing.
"""

from __future__ import annotations

import os
import select
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import TextIO

ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""To the alternate screen with the cursor hidden, and back."""
HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
FALLBACK = os.terminal_size((100, 30))


def clean(text: str) -> str:
    """A text without characters that would do something to a terminal."""
    return "".join(c if c.isprintable() else "·" for c in text)


def cut(text: str, width: int) -> str:
    """What fits into a width."""
    text = clean(text)
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"


def page(lines: Sequence[str], size: os.terminal_size) -> str:
    """Lines as they are drawn over the page before."""
    fitting = [cut(line, size.columns) for line in lines]
    if len(fitting) > size.lines:
        hidden = len(fitting) - size.lines + 1
        fitting = [
            *fitting[: size.lines - 1],
            cut(f"… {hidden} lines more: the window is too low", size.columns),
        ]
    return HOME + "\r\n".join(line + CLEAR_LINE for line in fitting) + CLEAR_BELOW


class Screen:
    """The alternate screen of a terminal, as a context manager."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __enter__(self) -> Screen:
        self._stream.write(ENTER)
        self._stream.flush()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # the terminal itself may be gone
            self._stream.write(LEAVE)
            self._stream.flush()

    def draw(self, lines: Sequence[str]) -> None:
        """A page instead of the one before."""
        if takes(self._stream):
            self._stream.write(page(lines, size_of(self._stream)))
            self._stream.flush()


class Line:
    """One line of a terminal, drawn over itself. Where there is no terminal, every line is a line."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._terminal = stream.isatty()
        self._begun = False

    def draw(self, text: str) -> None:
        """A line instead of the one before."""
        if not takes(self._stream):
            return
        if self._terminal:
            self._write(f"\r{cut(text, size_of(self._stream).columns - 1)}{CLEAR_LINE}")
        else:
            self._write(f"{clean(text)}\n")
        self._begun = self._terminal

    def above(self, text: str) -> None:
        """A line that stays, above the one that is drawn over."""
        self._write(f"\r{CLEAR_LINE}{clean(text)}\n" if self._begun else f"{clean(text)}\n")
        self._begun = False

    def end(self) -> None:
        """Leave the last line standing."""
        if self._begun:
            self._write("\n")
        self._begun = False

    def _write(self, text: str) -> None:
        with suppress(OSError):  # the terminal may be gone; the motor is what matters
            self._stream.write(text)
            self._stream.flush()


def takes(stream: TextIO) -> bool:
    """Whether a write would not wait. What is no file is written to at once."""
    try:
        return bool(select.select([], [stream.fileno()], [], 0)[1])
    except (OSError, ValueError):
        return True


def size_of(stream: TextIO) -> os.terminal_size:
    """Columns and lines."""
    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return FALLBACK
    return size if size.columns > 0 and size.lines > 0 else FALLBACK
