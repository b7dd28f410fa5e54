"""Example robots and worlds that ship with the package, by name; or any file, by its path."""

from __future__ import annotations

import difflib
from importlib.resources import files
from pathlib import Path
from typing import Literal

from gateway.errors import UserError


def find(kind: Literal["robots", "worlds"], name: str) -> Path:
    """The file of that path, or the shipped one of that name. Raises UserError with what there is."""
    path = Path(name)
    if path.suffix == ".toml" or "/" in name:
        if path.is_file():
            return path
        raise UserError(f"there is no file {name}")
    shipped = {p.stem: p for p in sorted(Path(str(files("gateway.fixtures") / kind)).glob("*.toml"))}
    if name in shipped:
        return shipped[name]
    near = difflib.get_close_matches(name, shipped, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise UserError(
        f"{name!r} is neither a .toml file nor one of the shipped {kind}: {', '.join(shipped)}{hint}"
    )
