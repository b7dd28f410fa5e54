"""All plugins that are broken on purpose: every list named BROKEN… of the files beside this named broken….py.

Rules. The name of such a plugin is that of the class in which the defect stands, and is there once.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from protocols.plugin import Plugin

Finders = tuple[str, ...]


def _lists() -> Iterator[tuple[tuple[Plugin, Finders], ...]]:
    for path in sorted(Path(__file__).parent.glob("broken*.py")):
        if path.stem != Path(__file__).stem:
            module = import_module(f"tests.protocols.{path.stem}")
            yield from (getattr(module, name) for name in sorted(vars(module)) if name.startswith("BROKEN"))


BROKEN: tuple[tuple[Plugin, Finders], ...] = tuple(pair for each in _lists() for pair in each)
"""Each with all the clauses that find it."""
