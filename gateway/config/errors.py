"""Collecting the mistakes in a configuration file: each with its line, its key and what would be right.

Rules. A mistake is a sentence for the person who has the file open. The first one does not raise: they are
collected, each once, sorted in the order of the file, and raised together.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date, datetime, time
from functools import cached_property
from typing import TypeAlias

from gateway.errors import ConfigError, Mistake
from protocols.bounds import Invalid
from protocols.suggest import did_you_mean

Key: TypeAlias = tuple[str, ...]
"""A key of the file, part by part: ("motors", "left", "gear")."""


class Mistakes:
    """The mistakes found in one file so far."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self._text = text
        self._found: dict[Mistake, None] = {}

    def add(self, key: Key, text: str, line: int = 0) -> None:
        """Add a mistake at a key, or at a line if it has no key.

        A value that several devices inherit from `defaults` is reported once, at its own line. Of very many
        mistakes the first are kept.
        """
        if self.full:
            return
        if key:
            key, line = self._locate(key)
        self._found[Mistake(self.file, line, _shortened(".".join(key)), _shortened(text))] = None

    def invalid(self, at: Key, error: ValueError) -> None:
        """Add what is wrong with a table there `at`, each at the key that an `Invalid` names."""
        for key, text in error.wrong if isinstance(error, Invalid) else (("", str(error)),):
            self.add((*at, *filter(None, key.split("."))), text)

    @property
    def full(self) -> bool:
        """True if no more are kept."""
        return len(self._found) >= _MAX_MISTAKES

    def error(self) -> ConfigError:
        """Return all of them, in the order of the file."""
        return ConfigError(sorted(self._found, key=lambda mistake: mistake.line))

    def fatal(self, text: str, line: int = 0) -> ConfigError:
        """Add a mistake that makes the rest unreadable, and return all of them."""
        self.add((), text, line)
        return self.error()

    def check(self) -> None:
        """Raise ConfigError if there are any."""
        if self._found:
            raise self.error()

    @cached_property
    def _lines(self) -> dict[Key, int]:
        return lines(self._text)

    def _locate(self, path: Key) -> tuple[Key, int]:
        """Return the key as written in the file (an inherited one is written in `defaults`), and its line."""
        inherited = ("defaults", path[0], *path[2:]) if len(path) > 2 else ()
        for size in range(len(path), 0, -1):
            if path[:size] in self._lines:
                return path, self._lines[path[:size]]
            if size > 2 and inherited[:size] in self._lines:
                return inherited, self._lines[inherited[:size]]
        return path, 0


_MAX_MISTAKES = 100
"""In one file."""
_MAX_TEXT = 1000
"""Characters of a key or of a sentence."""


def _shortened(text: str) -> str:
    """Return a text that fits a screen."""
    return text if len(text) <= _MAX_TEXT else f"{text[: _MAX_TEXT - 1]}…"


_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER = re.compile(rf"\s*\[\s*({_KEY})\s*\]")
_PAIR = re.compile(rf"\s*({_KEY})\s*=")
_MAX_PARTS = 16
"""Parts of a key that are listed; no dataclass of ours is nested as deep."""


def lines(text: str) -> dict[Key, int]:
    """Return the line (from 1) at which each table and key of a TOML text begins.

    Keys inside an inline table or array are not listed: they share the line of its key.
    """
    found: dict[Key, int] = {}
    table: Key = ()
    in_string = False
    for number, line in enumerate(text.splitlines(), 1):
        header, pair = _HEADER.match(line), _PAIR.match(line)
        if not in_string and (header or pair):
            parts = re.findall(_PART, (header or pair or "")[1])
            path = (() if header else table) + tuple(part.strip("\"'") for part in parts)
            for size in range(1, min(len(path), _MAX_PARTS) + 1):  # a dotted key makes tables, too
                found.setdefault(path[:size], number)
            table = path if header else table
        if (line.count('"""') + line.count("'''")) % 2:
            in_string = not in_string
    return found


def shown(value: object) -> str:
    """Return a value as it is written in the file, shortened."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"' if len(value) <= 60 else f'"{value[:57]}…"'
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "an array"
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    if isinstance(value, int) and not is_int64(value):
        return "an integer of more than 64 bits"
    return repr(value)


def is_int64(value: int) -> bool:
    """True for an integer that TOML allows."""
    return -(2**63) <= value < 2**63


RENAMED = {
    "silent": "on_command_timeout",
    "safe": "stop_action",
    "hear": "receive_filter",
    "mixed": "shared_bus",
}
"""Keys of robot files before 0.4, and what they are called now."""


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """Return the sentence for an unknown name: its name now, or what there is and the nearest of it."""
    names = list(known)
    if RENAMED.get(name) in names:
        return f"no {what} {name!r}: it is called {RENAMED[name]!r} now"
    there = f"there is {', '.join(names)}" if names else "there is none"
    return f"no {what} {name!r}: {there}{did_you_mean(name, names)}"
