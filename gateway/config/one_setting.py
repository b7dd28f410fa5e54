"""A robot file's text with one number in it changed, and nothing else."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from typing import Any

from gateway.errors import UserError

_HEADER = re.compile(r"(?m)^[ \t]*\[(?P<table>[^\[\]\n]+)\][ \t]*(?:#.*)?$")


def with_setting(text: str, key: str, value: float | str | bool) -> str:
    """Return the text with another value of a setting; one that is not there yet is added.

    Args:
        text: of a robot file.
        key: with dots: "brain.pursuit.lookahead_time".
        value: a number, a text, or true or false.

    Raises:
        UserError: the key is none, or is written in a way that cannot be changed in place.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", key):
        raise UserError(f"{key!r} is no setting; expected one such as brain.pursuit.lookahead_time")
    table, _, name = key.rpartition(".")
    shown = ("true" if value else "false") if isinstance(value, bool) else repr(value)
    line = f"{name} = {shown}"
    begin, end = _section(text, table)
    if begin is None:
        made = f"{text.rstrip()}\n\n[{table}]\n{line}\n"
    else:
        body = text[begin:end]
        found = re.search(
            rf"(?m)^(?P<before>[ \t]*{re.escape(name)}[ \t]*=[ \t]*)[^#\n]*?(?=[ \t]*(?:#|$))", body
        )
        changed = f"{body[: found.start()]}{found['before']}{shown}{body[found.end() :]}" if found else ""
        made = f"{text[:begin]}{changed or f'{line}{chr(10)}{body}'}{text[end:]}"
    if _value(made, key) != value:
        raise UserError(f"{key}: cannot be changed where it stands: write a robot file with it")
    return made


def with_settings(text: str, settings: Iterable[tuple[str, float | str | bool]]) -> str:
    """Return the text with other values of several settings. Raises UserError as `with_setting` does."""
    for key, value in settings:
        text = with_setting(text, key, value)
    return text


def _section(text: str, table: str) -> tuple[int | None, int]:
    """Return where the lines of a table begin and end; None if there is no such table."""
    headers = [*_HEADER.finditer(text)]
    if not table:
        return 0, headers[0].start() if headers else len(text)
    for place, found in enumerate(headers):
        if re.sub(r"\s", "", found["table"]) == table:
            end = headers[place + 1].start() if place + 1 < len(headers) else len(text)
            array = text.find("\n[[", found.end(), end)
            return min(found.end() + 1, len(text)), end if array < 0 else array + 1
    return None, 0


def _value(text: str, key: str) -> Any:  # noqa: ANN401 -- of any kind
    """Return the value of a setting; None if it is not there, or the text is no TOML."""
    try:
        found: Any = tomllib.loads(text)
        for part in key.split("."):
            found = found[part]
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        return None
    return found
