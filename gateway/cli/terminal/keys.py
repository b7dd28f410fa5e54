"""Keys of a terminal, and how long one is held. Pure except `raw_mode`, `read_keys` and `ask`.

Rules. A terminal does not report that a key is released: it sends the key once, again after a delay, and
then at a high rate. So a key counts as held for `FIRST_HOLD` after it was pressed, and moves at `CREEP_SHARE`
of the speed; once it has repeated it counts as held for `REPEAT_HOLD` after each time, and moves at full
speed. A tap is a short slow move, a held key one motion without a gap, and releasing it stops within
`REPEAT_HOLD`. Sources of the times: X server 660 ms and 25 per second (xset(1)), Linux console 250 ms and
10.9 per second (kbdrate(8)).

Nor does it report when a key was pressed, and a link may bring it late. But it answers when it is asked for
its state, in the order of its keys: what comes after an answer was typed after the question.
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

FIRST_HOLD: Nanos = 700 * MILLISECOND
"""How long a first key press counts: longer than a terminal waits before it repeats a key."""
REPEAT_HOLD: Nanos = 150 * MILLISECOND
"""How long a repeated key counts: longer than the time between two repetitions."""
CREEP_SHARE = 0.25
"""Share of the speed while it is not known whether a key is held or was tapped."""
MAX_READ = 4096
QUESTION = b"\x1b[5n"
"""DSR of ECMA-48: every terminal answers, its person's own, at the far end of whatever link."""


class Key(Enum):
    """The meaning of a key; of the two for motion, its direction."""

    FORWARD = 1
    BACKWARD = -1
    DISARM = " "
    CLEAR = "c"
    LEAVE = "q"
    ANSWER = "\x1b[0n"
    """No key: the terminal's answer to `QUESTION`."""


KEYS: dict[bytes, Key] = {
    **dict.fromkeys((b"\x1b[C", b"\x1b[A", b"\x1bOC", b"\x1bOA", b"+", b"="), Key.FORWARD),
    **dict.fromkeys((b"\x1b[D", b"\x1b[B", b"\x1bOD", b"\x1bOB", b"-", b"_"), Key.BACKWARD),
    b" ": Key.DISARM,
    b"c": Key.CLEAR,
    **dict.fromkeys((b"q", b"Q"), Key.LEAVE),
    b"\x1b[0n": Key.ANSWER,
}
"""Arrows in both modes of a terminal (ECMA-48 CUU CUD CUF CUB; DEC application mode), and characters."""


def parse(data: bytes) -> tuple[list[Key], bytes]:
    """Return the keys in what a terminal sent, and the rest, which may be the beginning of another."""
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
class HeldKey:
    """The motion key that is held, as far as can be known."""

    direction: int = 0
    """1 forward, -1 backward, 0 none."""
    until: Nanos = 0
    repeated: bool = False


def press(held: HeldKey, t: Nanos, direction: int) -> HeldKey:
    """Return the held key after a motion key was received."""
    if direction == held.direction and t < held.until:
        return HeldKey(direction, t + REPEAT_HOLD, repeated=True)
    return HeldKey(direction, t + FIRST_HOLD)


def speed_share(held: HeldKey, now: Nanos) -> float:
    """Return the share of the speed to move at, with its sign."""
    if now >= held.until:
        return 0.0
    return held.direction * (1.0 if held.repeated else CREEP_SHARE)


# -- the terminal -----------------------------------------------------------------------------------


@contextmanager
def raw_mode(terminal: int) -> Iterator[None]:
    """While inside, keys are received at once and not echoed; the terminal is restored at the end.

    Ctrl-C still interrupts. Keys that would leave a motor turning unattended, or block our output, are
    switched off: Ctrl-Z, Ctrl-backslash, Ctrl-S. Keys that were not read are discarded."""
    before = termios.tcgetattr(terminal)
    mode = termios.tcgetattr(terminal)
    mode[0] &= ~termios.IXON
    mode[3] &= ~(termios.ICANON | termios.ECHO)
    disabled = bytes([os.fpathconf(terminal, "PC_VDISABLE")])
    for control, value in ((termios.VMIN, 1), (termios.VTIME, 0)):
        mode[6][control] = value
    for control in (termios.VSUSP, termios.VQUIT):
        mode[6][control] = disabled
    try:
        termios.tcsetattr(terminal, termios.TCSAFLUSH, mode)
        yield
    finally:
        with suppress(termios.error):  # the terminal itself may be gone
            termios.tcflush(terminal, termios.TCIFLUSH)
            termios.tcsetattr(terminal, termios.TCSANOW, before)  # TCSAFLUSH waits for one that is stopped


def read_keys(terminal: int) -> bytes | None:
    """Return what was typed since the last call; None if the terminal is closed. Never waits."""
    try:
        if not select.select([terminal], [], [], 0)[0]:
            return b""
        return os.read(terminal, MAX_READ) or None
    except OSError:
        return None


def ask(terminal: int) -> bool:
    """Ask the terminal for an answer, if it takes the question at once; return whether it does."""
    try:
        return bool(select.select([], [terminal], [], 0)[1]) and os.write(terminal, QUESTION) == len(QUESTION)
    except OSError:
        return False
