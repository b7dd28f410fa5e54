"""Text that somebody gives, a file or a message: read within bounds, or refused in one sentence.

Rules. Every text file that a person gives is read by `read_text`, every TOML by `read_toml`, every JSON of a
client by `read_json`; the size, the nesting, the number of values and the length of numbers are bounded, so
that no text takes long, and what is wrong with it is a `ConfigError`: the file, the line, what was expected.
"""

from __future__ import annotations

import json
import re
import tomllib
from math import isfinite
from pathlib import Path
from typing import Any

from gateway.config.errors import Mistakes, is_int64

MAX_SIZE = 256 * 1024
"""Characters of a file: its reading takes less than a second, whatever is in it."""
_MAX_DEPTH = 32
"""Tables and arrays inside each other; valid files need 5."""
_MAX_VALUES = 10_000
"""Keys, tables, and items of arrays."""
_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_PART}){{{_MAX_DEPTH}}}")
"""A dotted key that makes so many tables: the parser's time grows with the square of their number."""
_MARK = "\ufeff"
"""What some editors put before the first character."""


def read_text(path: Path, most: int = MAX_SIZE, encoding: str = "utf-8", *, or_else: str = "") -> str:
    """Return the text of a file, which is UTF-8 and has at most so many characters; `or_else`: in which other
    encoding it may be.

    Raises ConfigError with what is wrong."""
    mistakes, text = Mistakes(str(path), ""), None
    try:
        if path.is_file() or not path.exists():  # a pipe would be waited for
            with path.open(encoding=encoding) as file:
                text = file.read(most + 1)
    except OSError as error:
        raise mistakes.fatal(f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        if or_else:
            return read_text(path, most, or_else)
        line = error.object.count(b"\n", 0, error.start) + 1 if error.start else 0
        wrong = f"is not UTF-8 (byte 0x{error.object[error.start]:02X}): save it as UTF-8"
        raise mistakes.fatal(wrong, line) from error
    except ValueError as error:  # a path with a NUL
        raise mistakes.fatal(f"cannot be read: {error}") from error
    if text is None:
        raise mistakes.fatal("is no file, but a folder, a pipe or a device: expected a text file")
    if len(text) > most:
        raise mistakes.fatal(f"the file is too large: expected at most {most} characters")
    if (at := text.find("\0")) >= 0:
        raise mistakes.fatal("has a NUL: expected a text file", text.count("\n", 0, at) + 1)
    return text.removeprefix(_MARK)


def read_toml(text: str, mistakes: Mistakes, times: int = 1) -> dict[str, Any]:
    """Return the file as a table; `times`: how often the usual bounds a text of a program may be.

    Raises ConfigError if it is not TOML, too large, or nested too deeply."""
    too_deep = "tables or arrays are nested too deeply"
    if len(text) > times * MAX_SIZE:
        raise mistakes.fatal(f"the file is too large: expected at most {times * MAX_SIZE} characters")
    if _DEEP_KEY.search(text):
        raise mistakes.fatal(too_deep)
    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise mistakes.fatal(too_deep) from error
    except ValueError as error:  # TOMLDecodeError, or an integer of thousands of digits
        raise mistakes.fatal(*_not_toml(text, error)) from error
    level: list[object] = [table]
    count = 0
    for _ in range(_MAX_DEPTH):
        level = [one for inner in level for one in _items(inner)]
        count += len(level)
    if level:
        raise mistakes.fatal(too_deep)
    if count > times * _MAX_VALUES:
        most = times * _MAX_VALUES
        raise mistakes.fatal(f"the file has {count} keys and values: expected at most {most}")
    return table


_LONG = re.compile(r"\d{500}")


def _not_toml(text: str, error: ValueError) -> tuple[str, int]:
    """Return what is wrong, and the line of it."""
    place = re.search(r"line (\d+)", str(error))
    if place is None and (long := _LONG.search(text)):
        line = text.count("\n", 0, long.start()) + 1
        return "not TOML: an integer of thousands of digits: expected at most 64 bits", line
    return f"not TOML: {error}", int(place[1]) if place else 0


def _items(value: object) -> list[object]:
    if isinstance(value, dict):
        return list(value.values())
    return value if isinstance(value, list) else []


# -- JSON ------------------------------------------------------------------------------------------


def read_json(text: str | bytes) -> dict[str, Any] | None:
    """Return the object that a message in JSON is; None if it is none, or has a key twice. A number that is
    not finite, or longer than 64 bits, is None in it."""
    try:
        found = json.loads(
            text,
            parse_constant=lambda _: None,
            parse_float=_float,
            parse_int=_int,
            object_pairs_hook=_object,
        )
    except (ValueError, RecursionError):  # no JSON, no UTF-8, or brackets without end
        return None
    return found if isinstance(found, dict) else None


def _float(text: str) -> float | None:
    value = float(text)
    return value if isfinite(value) else None


def _int(text: str) -> int | None:
    value = int(text) if len(text) <= 20 else 1 << 64
    return value if is_int64(value) else None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is there twice")
    return found
