"""Options and settings of a protocol: dataclasses whose fields declare their bounds.

A number is declared as `timeout_ms: int = bounded(100, 10, 10_000)`, and `__post_init__` calls
`check_bounds(self)`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import field, fields
from math import isfinite, isnan
from typing import Any, TypeVar

Number = TypeVar("Number", int, float)


def bounded(default: Number, low: float, high: float, *, nan: str = "") -> Number:
    """Declare a number with its lowest and highest value; `nan`: what NaN means, if it is permitted."""
    declared: Any = field(default=default, metadata={"low": low, "high": high, "nan": nan})
    value: Number = declared
    return value


def check_bounds(options: Any, others: Iterable[str] = ()) -> None:  # noqa: ANN401 -- any dataclass
    """Raise ValueError with every number that is out of its bounds, and `others`: other mistakes."""
    wrong = []
    for each in fields(options):
        value = getattr(options, each.name)
        if "low" not in each.metadata or (each.metadata["nan"] and isnan(value)):
            continue
        low, high = each.metadata["low"], each.metadata["high"]
        if not (isfinite(value) and low <= value <= high):
            wrong.append(f"{each.name} is {value}: it must lie between {low:g} and {high:g}")
    wrong += filter(None, others)
    if wrong:
        raise ValueError("; ".join(wrong))
