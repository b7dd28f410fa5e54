"""Keys of a terminal, and what holding one means. Pure but for `raw` and `read`.

Rules. A terminal does not tell that a key was let go: it sends the key once, after a while again, and from
then on quickly. So a key counts as held for `FIRST` after it was pressed, and moves slowly what it moves;
once it has come again it counts as held for `AGAIN` after each time, and moves it at full speed. A tap is a
short slow move, a held key one motion without a gap, and letting go stops within `AGAIN`. Sources of the
times: X server 660 ms and 25 per second (xset(1)), Linux console 250 ms and 10.9 per second (kbdrate(8)).
"""

from __future__ import annotations

import os
import select
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum

from protocols.messages import MILLISECOND, Nanos

FIRST: Nanos = 700 * MILLISECOND
"""A key that has come once is held for so long: longer than a terminal waits before it repeats a key."""
AGAIN: Nanos = 150 * MILLISECOND
"""A key that is repeated is held for so long: longer than from one repetition to the next."""
CREEP = 0.25
"""Part of the speed while it is not known whether a key is held or was tapped."""
MOST_READ = 4096


class Key(Enum):
    """What a key means."""

    FORWARD = 1
    BACKWARD = -1
    DISARM = " "
    CLEAR = "c"
    LEAVE = "q"


KEYS: dict[bytes, Key] = {
    b"\x1b[C": Key.FORWARD,
    b"\x1b[A": Key.FORWARD,
    b"\x1bOC": Key.FORWARD,
    b"\x1bOA": Key.FORWARD,
    b"+": Key.FORWARD,
    b"=": Key.FORWARD,
    b"\x1b[D": Key.BACKWARD,
    b"\x1b[B": Key.BACKWARD,
    b"\x1bOD": Key.BACKWARD,
    b"\x1bOB": Key.BACKWARD,
    b"-": Key.BACKWARD,
    b"_": Key.BACKWARD,
    b" ": Key.DISARM,
    b"c": Key.CLEAR,
    b"q": Key.LEAVE,
    b"Q": Key.LEAVE,
}
"""Arrows in both of a terminal's modes (ECMA-48 CUU CUD CUF CUB; DEC application mode), and letters."""


def parse(data: bytes) -> tuple[list[Key], bytes]:
    """The keys in what a terminal has sent, and what may be the beginning of another one."""
    keys: list[Key] = []
    while data:
        known = next((name for name in KEYS if data.startswith(name)), None)
        if known is not None:
            keys.append(KEYS[known])
            data = data[len(known) :]
        elif any(name.startswith(data) for name in KEYS):
            break
        else:
            data = data[1:]
    return keys, data


@dataclass(frozen=True, slots=True)
class Held:
    """A key of motion that is held, as far as can be known."""

    sense: int = 0
    """1 forward, -1 backward, 0 none."""
    until: Nanos = 0
    repeated: bool = False


def press(held: Held, t: Nanos, sense: int) -> Held:
    """A key has come."""
    if sense == held.sense and t < held.until:
        return Held(sense, t + AGAIN, repeated=True)
    return Held(sense, t + FIRST)


def share(held: Held, now: Nanos) -> float:
    """The part of the speed to move at now, with its sense."""
    if now >= held.until:
        return 0.0
    return held.sense * (1.0 if held.repeated else CREEP)


# -- the terminal -----------------------------------------------------------------------------------


@contextmanager
def raw(terminal: int) -> Iterator[None]:
    """While inside, keys come at once and are not shown; outside, the terminal is as it was.

    Ctrl-C still interrupts. What would leave a motor turning with nobody at the keys, or stop us at our
    output, is switched off: Ctrl-Z, Ctrl-backslash, Ctrl-S. Keys that nobody has read are thrown away."""
    before = termios.tcgetattr(terminal)
    mode = termios.tcgetattr(terminal)
    mode[0] &= ~termios.IXON
    mode[3] &= ~(termios.ICANON | termios.ECHO)
    nothing = bytes([os.fpathconf(terminal, "PC_VDISABLE")])
    for control, value in ((termios.VMIN, 1), (termios.VTIME, 0)):
        mode[6][control] = value
    for control in (termios.VSUSP, termios.VQUIT):
        mode[6][control] = nothing
    try:
        termios.tcsetattr(terminal, termios.TCSAFLUSH, mode)
        yield
    finally:
        with suppress(termios.error):  # the terminal itself may be gone
            termios.tcsetattr(terminal, termios.TCSAFLUSH, before)


def read(terminal: int) -> bytes | None:
    """What has been typed since; None if there is nobody any more. Never waits."""
    try:
        if not select.select([terminal], [], [], 0)[0]:
            return b""
        return os.read(terminal, MOST_READ) or None
    except OSError:
        return None
