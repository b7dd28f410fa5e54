"""`gateway schema`: every key of a kind of file, for an editor or as tables."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gateway.config import json_schema
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
    text = markdown(schema) if options.keys else text_of(schema)
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


def markdown(schema: Schema, level: int = 2) -> str:
    """Return the keys of a kind of file as tables, each below a heading."""
    lines: list[str] = []
    for heading, rows in json_schema.rows_of(schema).items():
        lines += ["", f"{'#' * level} {heading}", "", "| key | takes | default | |", "|---|---|---|---|"]
        for row in rows:
            cells = (f"`{row.key}`", row.what, f"`{row.default}`" if row.default else "", row.text)
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines[1:]) + "\n"
