"""Repeatable samples: SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014).

Rules. A seed gives the same samples on every machine and with every version of Python, and conformance needs
no numpy for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")
_MASK = 2**64 - 1


@dataclass(slots=True)
class Random:
    """A seeded generator of samples."""

    state: int

    def bits(self, count: int = 64) -> int:
        """Return this many random bits, up to 64."""
        self.state = (self.state + 0x9E3779B97F4A7C15) & _MASK
        mixed = self.state
        mixed = ((mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9) & _MASK
        mixed = ((mixed ^ mixed >> 27) * 0x94D049BB133111EB) & _MASK
        return (mixed ^ mixed >> 31) >> (64 - count)

    def below(self, end: int) -> int:
        """Return one of 0 … end - 1."""
        return self.bits() % end

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number between low and high."""
        return low + (high - low) * self.bits(53) * 2.0**-53

    def choice(self, items: Sequence[T]) -> T:
        """Return one of these."""
        return items[self.below(len(items))]

    def bytes(self, count: int) -> bytes:
        """Return this many random bytes."""
        return bytes(self.bits(8) for _ in range(count))

    def shuffled(self, items: Sequence[T]) -> list[T]:
        """Return these in another order."""
        rest = list(items)
        return [rest.pop(self.below(len(rest))) for _ in items]
