"""`gateway schema`: every key of a kind of file, for an editor or as tables."""

from __future__ import annotations

import json
import re
import tomllib
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gateway.config import json_schema, resources
from gateway.config.json_schema import Schema, of_kinds
from gateway.errors import UserError
from gateway.runtime import scenario_file
from gateway.sim.load import PLANTS, WORLDS

FILES: dict[str, Callable[[], Schema]] = {
    "robot": json_schema.robot,
    "world": partial(of_kinds, "A world file of Motor Gateway", WORLDS),
    "plant": partial(of_kinds, "A plant file of Motor Gateway", PLANTS),
    "mission": json_schema.mission,
    "scenario": scenario_file.schema,
}
"""By kind of file"""


def add_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", choices=FILES, help="which kind of file")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the schema to a new file")
    text = "print each key with what it takes, its default and its meaning, as Markdown"
    parser.add_argument("--keys", action="store_true", help=text)


def run(options: Namespace) -> int:
    """Print a JSON schema of draft 7, or its keys."""
    schema = FILES[options.file]()
    text = markdown(schema, options.file) if options.keys else text_of(schema)
    if options.out is None:
        print(text, end="")
        return 0
    try:
        with options.out.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise UserError(f"{options.out} cannot be written: {error.strerror}") from error
    return 0


def text_of(schema: Schema) -> str:
    """Return a schema as the text of a file."""
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


def markdown(schema: Schema, kind: str, level: int = 2) -> str:
    """Return the keys of a kind of file as tables, each below a heading, with examples from the files that
    ship, and the file of the settings: where a key counts."""
    lines: list[str] = []
    example = Examples(kind)
    for heading, rows in json_schema.rows_of(schema).items():
        lines += ["", f"{'#' * level} {heading}", ""]
        if where := rows[0].where:
            lines += [f"Settings of `{where}`.", ""]
        lines += ["| key | takes | default | example | |", "|---|---|---|---|---|"]
        for row in rows:
            shown = [f"`{one}`" if one else "" for one in (row.default, example.of(heading, row.key))]
            cells = (f"`{row.key}`", row.what, *shown, row.text)
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines[1:]) + "\n"


class Examples:
    """Values of keys in the files of a kind that ship."""

    def __init__(self, kind: str) -> None:
        texts = (path.read_text() for path in sorted(resources.shipped(f"{kind}s").glob("*.toml")))
        self._files = [tomllib.loads(text) for text in texts]

    def of(self, heading: str, key: str) -> str:
        """Return a value of a key, by the heading of its table, as it is written; "": no short one."""
        match = HEADING.fullmatch(heading)
        path, name, value = match.groups(default="") if match else ("", "", "")
        parts = path.replace("[", "").replace("]", "").split(".") if path else []
        for file in self._files:
            for tables in _tables(file, parts):
                found = tables[-1].get(key)
                chosen = not name or any(one.get(name) == value for one in tables)
                if chosen and found is not None and not isinstance(found, dict):
                    shown = _written(found)
                    if len(shown) <= LONGEST:
                        return shown
        return ""


HEADING = re.compile(r'(?:\[+(.*?)\]+)?(?: of )?(?:(\w+) = "(.*)")?|before all tables')
LONGEST = 40
"""Characters of an example."""


def _tables(table: dict[str, Any], parts: Sequence[str]) -> Iterator[list[dict[str, Any]]]:
    """Yield the tables at a path, each behind those in which it is; NAME is any name."""
    if not parts:
        yield [table]
        return
    first, *rest = parts
    for name, one in table.items():
        if first in (name, "NAME"):
            for inner in one if isinstance(one, list) else [one]:
                if isinstance(inner, dict):
                    yield from ([table, *each] for each in _tables(inner, rest))


def _written(value: object) -> str:
    """Return a value as TOML has it."""
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_written(one)}" for key, one in value.items()) + "}"
    return json.dumps(value, ensure_ascii=False)
