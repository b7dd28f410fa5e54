"""Mistakes in a robot file: all of them at once, each with file, line, key and what would be right.

Rules. A mistake is a sentence for a person who has the file open. Nothing is raised on the first one:
they are gathered, told in the order of the file, each once, and raised together.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date, datetime, time
from typing import TypeAlias

from gateway.errors import ConfigError

Key: TypeAlias = tuple[str, ...]
"""A key of the robot file, part by part: ("motors", "left", "gear")."""


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake in a robot file."""

    file: str
    line: int
    """Counted from 1; 0 if the mistake is about the file as a whole."""
    key: str
    """Dotted, as it would be written in the file; "" if it is about the file as a whole."""
    text: str
    """What was found, what was expected, and the nearest right name."""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.key}: {self.text}" if self.key else f"{place}: {self.text}"


class Mistakes:
    """What is wrong with one file so far."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self._lines = lines(text)
        self._found: dict[Mistake, None] = {}

    def __len__(self) -> int:
        return len(self._found)

    def add(self, key: Key, text: str, line: int = 0) -> None:
        """Note a mistake at a key, or at a line if it has none.

        A default that many inherit is told once, where it stands.
        """
        if key:
            key, line = self._place(key)
        self._found[Mistake(self.file, line, ".".join(key), text)] = None

    def error(self) -> ConfigError:
        """All of them, in the order of the file."""
        return ConfigError(sorted(self._found, key=lambda mistake: mistake.line))

    def check(self) -> None:
        """Raise ConfigError if there are any."""
        if self._found:
            raise self.error()

    def _place(self, path: Key) -> tuple[Key, int]:
        """The key as it stands in the file (an inherited one stands in `defaults`), and its line."""
        inherited = ("defaults", path[0], *path[2:]) if len(path) > 2 else ()
        for size in range(len(path), 0, -1):
            if path[:size] in self._lines:
                return path, self._lines[path[:size]]
            if size > 2 and inherited[:size] in self._lines:
                return inherited, self._lines[inherited[:size]]
        return path, 0


_PART = r"""(?:[A-Za-z0-9_-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER = re.compile(rf"\s*\[\s*({_KEY})\s*\]")
_PAIR = re.compile(rf"\s*({_KEY})\s*=")


def lines(text: str) -> dict[Key, int]:
    """The line (from 1) at which each table and key of a TOML text begins.

    Keys inside an inline table or array are not listed: they share the line of its key.
    """
    found: dict[Key, int] = {}
    table: Key = ()
    in_string = False
    for number, line in enumerate(text.splitlines(), 1):
        header, pair = _HEADER.match(line), _PAIR.match(line)
        if not in_string and header:
            table = _parts(header[1])
            _note(found, table, number)
        elif not in_string and pair:
            _note(found, table + _parts(pair[1]), number)
        if (line.count('"""') + line.count("'''")) % 2:
            in_string = not in_string
    return found


def _parts(key: str) -> Key:
    return tuple(part.strip("\"'") for part in re.findall(_PART, key))


def _note(found: dict[Key, int], path: Key, number: int) -> None:
    """Note a key, and the tables that it makes by being dotted."""
    for size in range(1, len(path) + 1):
        found.setdefault(path[:size], number)


def shown(value: object) -> str:
    """A value as it stands in the file."""
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
    return repr(value)


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The sentence for a name that is not known: the nearest right one, and what there is."""
    names = list(known)
    near = difflib.get_close_matches(name, names, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    there = f"there is {', '.join(names)}" if names else "there is none"
    return f"no {what} {name!r}: {there}{hint}"
