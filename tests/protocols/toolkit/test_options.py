"""Options declare their bounds, and all that are wrong are reported at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from protocols.toolkit.options import bounded, check_bounds


@dataclass(frozen=True, slots=True)
class Options:
    period: int = bounded(10, 1, 100)
    limit: float = bounded(1.0, 0.0, 2.5, nan="no limit")
    gain: float = bounded(0.5, 0.1, 1.0)
    name: str = ""

    def __post_init__(self) -> None:
        check_bounds(self, ["a name is too long"] if len(self.name) > 3 else [])


def test_numbers_within_their_bounds_are_accepted() -> None:
    assert Options() == Options(10, 1.0, 0.5)
    assert math.isnan(Options(100, math.nan, 0.1).limit)


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match="period is 0") as caught:
        Options(0, 3.0, math.nan, "long")
    assert str(caught.value).split("; ") == [
        "period is 0: it must lie between 1 and 100",
        "limit is 3.0: it must lie between 0 and 2.5",
        "gain is nan: it must lie between 0.1 and 1",
        "a name is too long",
    ]
