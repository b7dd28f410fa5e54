"""Bounds of a number, as an annotation of a dataclass field that a robot or world file fills.

`gateway.config.schema` keeps them; a dataclass made in code is not checked. Every number of these dataclasses
has both; those of brain and protocols check themselves.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Bounds:
    """The least and the most value of a number, in the unit of its field (nanoseconds of a `Nanos` field)."""

    least: float
    most: float

    def admit(self, value: float) -> bool:
        """True if the value is within the bounds."""
        return self.least <= value <= self.most

    def __str__(self) -> str:
        """Return the bounds as they follow "a finite number": "from 1 to 2000"."""
        return f"from {self.least:.10g} to {self.most:.10g}"
