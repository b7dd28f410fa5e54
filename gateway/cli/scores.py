"""How much of a device language its tests hold: the stored result of its mutation testing, as figures.

A result stands in fixtures/mutation/NAME.json, made by `./go prove`: of the many small changes of codec,
driver and ear, how many the contract and the language's tests of vectors notice. What these rest on stands
in docs/contract.md.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any


@dataclass(frozen=True, slots=True)
class Score:
    """Of one language."""

    killed: int
    """Mutants that the contract or a vector noticed."""
    tried: int
    equivalent: int
    """Survivors that do the same as the original, as a person judged."""
    judged: int
    """Survivors that a person has judged: equivalent, or missed by the contract."""
    total: int
    """Mutants that there are."""
    current: bool
    """Whether the sources are still those that were tried."""

    @property
    def sampled(self) -> bool:
        """Whether not all mutants were tried."""
        return self.tried < self.total

    @property
    def share(self) -> float:
        """Killed of all that were tried, equivalent ones included: 0 … 1."""
        return self.killed / self.tried if self.tried else 0.0

    def __str__(self) -> str:
        """As it stands in a table: "92 % of 310 tried (3025 in all)", with what else must be known of it."""
        share = f"{int(100 * self.share)} % of {self.tried} tried"
        if self.sampled:
            share += f" ({self.total} in all)"
        return share if self.current else f"{share}, sources changed since"


def mutation_score(name: str) -> Score | None:
    """The score of one of our languages by its name; None of a third party's, or if none is stored."""
    if not name.isidentifier():
        return None
    path = files("gateway.fixtures") / "mutation" / f"{name}.json"
    if not path.is_file():
        return None
    return score_of(json.loads(path.read_text("utf-8")), files("protocols") / name)


def score_of(result: dict[str, Any], sources: Traversable) -> Score:
    """A stored result as figures, and whether the files in `sources` are those that were mutated."""
    said = [row["judgement"] for row in result["survivors"]]
    current = all(_digest(sources / file) == digest for file, digest in result["sources"].items())
    equivalent = sum(text.startswith("equivalent: ") for text in said)
    judged = equivalent + sum(text.startswith("missed: ") for text in said)
    return Score(result["killed"], result["tried"], equivalent, judged, result["mutants"], current)


def _digest(file: Traversable) -> str:
    """As tests/mutation writes it: a digest of the digests of texts, of which there is one here."""
    if not file.is_file():
        return ""
    inner = hashlib.sha256(file.read_bytes()).digest()
    return hashlib.sha256(inner).hexdigest()[:16]
