"""Options declare their bounds, and all that are wrong are reported at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import pytest

from protocols.bounds import Bounds, check


@dataclass(frozen=True, slots=True)
class Options:
    period: Annotated[int, Bounds(1, 100)] = 10
    limit: Annotated[float, Bounds(0.0, 2.5, nan="no limit")] = 1.0
    gain: Annotated[float, Bounds(0.1, 1.0)] = 0.5
    name: str = ""

    def __post_init__(self) -> None:
        check(self, ("name", "a name is too long" if len(self.name) > 3 else ""))


def test_numbers_within_their_bounds_are_accepted() -> None:
    assert Options() == Options(10, 1.0, 0.5)
    assert math.isnan(Options(100, math.nan, 0.1).limit)


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(ValueError, match="period must be") as caught:
        Options(0, 3.0, math.nan, "long")
    assert str(caught.value).split("; ") == [
        "period must be from 1 to 100, not 0",
        "limit must be from 0 to 2.5, not 3",
        "gain must be from 0.1 to 1, not nan",
        "a name is too long",
    ]
