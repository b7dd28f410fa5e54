"""Bounds of a number, as an annotation of a dataclass field that a robot or world file fills.

`gateway.config.schema` keeps them; a dataclass made in code is not checked.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Annotated, TypeAlias

from protocols.messages import Nanos


@dataclass(frozen=True, slots=True)
class Bounds:
    """The bounds of a number, in the unit of its field (nanoseconds of a `Nanos` field)."""

    above: float = -inf
    least: float = -inf
    below: float = inf
    most: float = inf

    def admit(self, value: float) -> bool:
        """True if the value is within the bounds."""
        return self.above < value < self.below and self.least <= value <= self.most

    def __str__(self) -> str:
        """Return the bounds as they follow "a finite number": "greater than 0 and of at most 2000"."""
        texts = (
            ("greater than", self.above),
            ("of at least", self.least),
            ("less than", self.below),
            ("of at most", self.most),
        )
        return " and ".join(f"{text} {limit:g}" for text, limit in texts if abs(limit) != inf)


Positive: TypeAlias = Annotated[float, Bounds(above=0.0)]
NotNegative: TypeAlias = Annotated[float, Bounds(least=0.0)]
PositiveInt: TypeAlias = Annotated[int, Bounds(above=0)]
PositiveNanos: TypeAlias = Annotated[Nanos, Bounds(above=0)]
