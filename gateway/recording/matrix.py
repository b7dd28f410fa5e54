"""What a folder of recordings covers: each language, body and bad day, in pairs.

Rules. The folder's matrix.toml says which there are, and which pairs cannot be, and why. Each recording says
in its facts what it is of. Covered is a pair if a recording has both.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path
from typing import NamedTuple, TypeAlias

from gateway.config.errors import Mistakes
from gateway.config.schema import build
from gateway.config.text import read_text, read_toml
from gateway.errors import RecordingError
from gateway.recording.reader import read_recording

FILE = "matrix.toml"
FACTS = ("fixture language", "fixture body", "fixture bad day")
"""Of a recording: what it is of"""
Pair: TypeAlias = frozenset[tuple[int, str]]
"""Two of language (0), body (1) and bad day (2), by name"""


class Cell(NamedTuple):
    """What a recording is of."""

    language: str
    body: str
    bad_day: str
    """Its letter"""

    @property
    def pairs(self) -> frozenset[Pair]:
        """The pairs that it covers."""
        return frozenset(map(frozenset, combinations(enumerate(self), 2)))


@dataclass(frozen=True, slots=True)
class Impossible:
    """Pairs that cannot be: of these languages, or of all but these."""

    why: str
    languages: tuple[str, ...] = ()
    but: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    bad_days: tuple[str, ...] = ()

    def holds(self, cell: Cell) -> bool:
        """Whether it cannot be."""
        if cell.language in self.but or (self.languages and cell.language not in self.languages):
            return False
        return cell.body in self.bodies or cell.bad_day in self.bad_days


@dataclass(frozen=True, slots=True)
class Levels:
    """What there is to cover, and of which files it is made."""

    languages: dict[str, str]
    bodies: dict[str, str]
    bad_days: dict[str, str]
    """By letter, the cause of the fault"""
    ships: dict[str, dict[str, str]] = field(default_factory=dict)
    """By body and language"""
    cannot: Sequence[Impossible] = ()

    def cells(self) -> Iterator[Cell]:
        """Yield all that can be."""
        for one in product(self.languages, self.bodies, self.bad_days):
            cell = Cell(*one)
            if not any(rule.holds(cell) for rule in self.cannot):
                yield cell

    def pairs(self) -> frozenset[Pair]:
        """Return all pairs that can be."""
        return frozenset().union(*(cell.pairs for cell in self.cells()))


@dataclass(frozen=True, slots=True)
class Matrix:
    """What is to be covered, and what is."""

    levels: Levels
    recordings: Mapping[Cell, Path]
    bytes: int

    @property
    def left(self) -> frozenset[Pair]:
        """The pairs that can be and are not covered."""
        return self.levels.pairs() - frozenset().union(*(cell.pairs for cell in self.recordings))

    @property
    def complete(self) -> bool:
        """Whether every pair that can be is covered."""
        return not self.left

    def lines(self) -> Iterator[str]:
        """Yield the matrix: by language and body the letters of the bad days."""
        levels, width = self.levels, max(map(len, self.levels.languages))
        heads = [f"{body:<{max(7, len(body))}}" for body in levels.bodies]
        yield f"{'':<{width}} {' '.join(heads)}".rstrip()
        possible = {(cell.language, cell.body) for cell in levels.cells()}
        for language in levels.languages:
            row = []
            for body, head in zip(levels.bodies, heads, strict=True):
                days = "".join(cell.bad_day for cell in self.recordings if cell[:2] == (language, body))
                row.append(f"{days or ('?' if (language, body) in possible else '-'):<{len(head)}}")
            yield f"{language:<{width}} {' '.join(row)}".rstrip()
        yield ""
        yield from (f"{letter}: {cause}" for letter, cause in levels.bad_days.items())
        yield "-: cannot be; ?: missing"
        for rule in levels.cannot:
            of = ", ".join(rule.languages) or f"all but {', '.join(rule.but)}"
            yield f"cannot be: {of}; {', '.join([*rule.bodies, *rule.bad_days])}: {rule.why}"
        yield ""
        every, left = levels.pairs(), self.left
        for text, kinds in (
            ("language and body", {0, 1}),
            ("language and bad day", {0, 2}),
            ("body and bad day", {1, 2}),
        ):
            pairs = [pair for pair in every if {kind for kind, _ in pair} == kinds]
            yield f"{text}: {len(pairs) - len(left.intersection(pairs))} of {len(pairs)} pairs"
        yield f"{len(self.recordings)} recordings, {self.bytes / 1e6:.1f} MB"


def read_matrix(folder: Path) -> Matrix:
    """Return what the recordings of a folder cover.

    Raises:
        ConfigError: its matrix.toml is not there, or wrong.
        RecordingError: a file in it is no recording, or one that is none of these.
    """
    levels = read_levels(folder / FILE)
    found: dict[Cell, Path] = {}
    known = (levels.languages, levels.bodies, levels.bad_days)
    for path in sorted(folder.glob("*.mcap")):
        facts = read_recording(path).facts
        cell = Cell(*(facts.get(fact, "") for fact in FACTS))
        if not all(name in names for name, names in zip(cell, known, strict=True)):
            named = ", ".join(f"{fact} {name!r}" for fact, name in zip(FACTS, cell, strict=True))
            raise RecordingError(f"{path}: {named}: not what {folder / FILE} has")
        found[cell] = path
    return Matrix(levels, found, sum(path.stat().st_size for path in found.values()))


def read_levels(file: Path) -> Levels:
    """Read what is to be covered. Raises ConfigError."""
    text = read_text(file)
    mistakes = Mistakes(str(file), text)
    table = read_toml(text, mistakes)
    rows = table.pop("cannot", [])
    levels = build(Levels, table, (), mistakes)
    rules = [
        build(Impossible, row, ("cannot",), mistakes)
        for row in (rows if isinstance(rows, list) else [])
        if isinstance(row, dict)
    ]
    mistakes.check()
    assert levels is not None, "mistakes were added"
    return replace(levels, cannot=[one for one in rules if one is not None])
