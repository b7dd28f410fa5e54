"""A page and a line that are redrawn in place on a terminal, by ANSI sequences; all other output without any.

Rules. What cannot be drawn at once because the terminal is not reading is left out: nothing here blocks.
Lines are cut to the terminal's width, pages to its height. Control characters in texts are escaped: here, and
by `Escaping` in everything that is printed. At the end the cursor is restored.
"""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from gateway.cli.terminal.output import Unblocked
from gateway.core.message_text import escaped

ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"
"""To the alternate screen with the cursor hidden, and back."""
HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
FALLBACK = os.terminal_size((100, 30))


class Escaping:
    """A text stream in which nothing but the end of a line controls a terminal."""

    def __init__(self, stream: TextIO) -> None:
        self.terminal = stream
        """Where a page or line is drawn."""

    def write(self, text: str) -> int:
        """Write a text, its control characters escaped."""
        self.terminal.write(escaped(text, keep="\n"))
        return len(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 -- all else is the stream's
        return getattr(self.terminal, name)


def cut(text: str, width: int) -> str:
    """Return the part of a text that fits into a width."""
    text = escaped(text)
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"


def page(lines: Sequence[str], size: os.terminal_size) -> str:
    """Return the sequence that draws lines over the page before."""
    fitting = [cut(line, size.columns) for line in lines]
    if len(fitting) > size.lines:
        hidden = len(fitting) - size.lines + 1
        fitting[size.lines - 1 :] = [cut(f"… {hidden} more lines: the window is too low", size.columns)]
    return HOME + "\r\n".join(line + CLEAR_LINE for line in fitting) + CLEAR_BELOW


@contextmanager
def screen(stream: TextIO) -> Iterator[Callable[[Sequence[str]], None]]:
    """Switch a terminal to its alternate screen; yield the function that draws a page over the one before."""

    stream = getattr(stream, "terminal", stream)

    def draw(lines: Sequence[str]) -> None:
        if is_writable(stream):
            stream.write(page(lines, size_of(stream)))
            stream.flush()

    stream.write(ENTER)
    stream.flush()
    try:
        yield draw
    finally:
        with suppress(OSError):  # the terminal itself may be gone
            stream.write(LEAVE)
            stream.flush()


class TerminalLine:
    """One line of a terminal that is redrawn in place; without a terminal, each is a line of its own."""

    def __init__(self, stream: TextIO | Unblocked) -> None:
        self._stream: TextIO | Unblocked = getattr(stream, "terminal", stream)
        self._terminal = stream.isatty()
        self._drawn = False
        self._missed: str | None = None
        """What was not drawn, since the stream had not taken what was before."""

    def draw(self, text: str) -> None:
        """Draw a line over the one before; while the stream takes nothing the newest waits for the next
        call, or for the end."""
        self._missed = text
        if is_writable(self._stream):
            self._draw(text)

    def _draw(self, text: str) -> None:
        self._missed = None
        if self._terminal:
            self._write(f"\r{cut(text, size_of(self._stream).columns - 1)}{CLEAR_LINE}")
        else:
            self._write(f"{escaped(text)}\n")
        self._drawn = self._terminal

    def print_above(self, text: str) -> None:
        """Print a line that stays, above the one that is redrawn."""
        self._write(f"\r{CLEAR_LINE}{escaped(text)}\n" if self._drawn else f"{escaped(text)}\n")
        self._drawn = False

    def clear(self) -> None:
        """Remove the line that is redrawn."""
        self._missed = None
        if self._drawn:
            self._write(f"\r{CLEAR_LINE}")
        self._drawn = False

    def end(self) -> None:
        """Keep the last line, and begin a new one."""
        if self._missed is not None:
            self._draw(self._missed)
        if self._drawn:
            self._write("\n")
        self._drawn = False

    def _write(self, text: str) -> None:
        with suppress(OSError):  # the terminal may be gone; the motor is what matters
            self._stream.write(text)
            self._stream.flush()


def is_writable(stream: TextIO | Unblocked) -> bool:
    """True if what is written would be taken at once, as of a stream that is no file."""
    if isinstance(stream, Unblocked):
        return stream.idle
    try:
        return bool(select.select([], [stream.fileno()], [], 0)[1])
    except (OSError, ValueError):
        return True


def size_of(stream: TextIO | Unblocked) -> os.terminal_size:
    """Return columns and lines."""
    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return FALLBACK
    return size if size.columns > 0 and size.lines > 0 else FALLBACK
