"""Tables of a robot file as text, each key with a comment beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

Table: TypeAlias = dict[str, Any]
COLUMN, WIDTH = 32, 118
"""Where comments begin, and end"""


def rounded(number: float) -> float:
    """Return a number with three digits."""
    return float(f"{number:.3g}")


def shown(value: object) -> str:
    """Return a value as TOML."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {shown(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return str(value).lower() if isinstance(value, bool) else repr(value)


def bus_section(table: Table) -> str:
    """Return the table of a bus."""
    return section(f"buses.{table['name']}", {key: one for key, one in table.items() if key != "name"}, {})


def section(at: str, table: Table, said: Mapping[str, str], title: str = "") -> str:
    """Return a table of the file, each key with what is said of it."""
    lines = [f"[{at}]{f'  # {title}' if title else ''}"] if at else []
    for key, value in table.items():
        line, text = f"{key} = {shown(value)}", said.get(key, "")
        room = WIDTH - max(len(line), COLUMN) - 4
        note = text if len(text) <= room else f"{text[: max(0, room - 2)].rsplit(' ', 1)[0]} …"
        lines.append(f"{line:<{COLUMN}}  # {note}" if text and room > 20 else line)
    return "\n".join([*lines, ""])


def common(tables: Sequence[Table]) -> Table:
    """Return what is the same in all of some tables, if these are several."""
    if len(tables) < 2:
        return {}
    found: Table = {}
    for key, value in tables[0].items():
        if isinstance(value, dict):
            same = common([one[key] for one in tables if isinstance(one.get(key), dict)])
            found |= {key: same} if same and all(key in one for one in tables) else {}
        elif key not in ("address", "sign") and all(one.get(key) == value for one in tables):
            found[key] = value
    return found


def filled(table: Table) -> Table:
    """Return a table without what is empty."""
    return {key: value for key, value in table.items() if value != {}}


def without(table: Table, common: Table) -> Table:
    """Return a table without what is the same in all."""
    own: Table = {}
    for key, value in table.items():
        if isinstance(value, dict):
            rest = without(value, common.get(key, {}))
            own |= {key: rest} if rest else {}
        elif key not in common:
            own[key] = value
    return own
