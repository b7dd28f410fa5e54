"""Options and settings of a protocol: dataclasses whose fields declare their bounds.

A number is declared as `timeout_ms: int = bounded(100, 10, 10_000)`, and `__post_init__` calls
`check_bounds(self)`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import field, fields
from math import inf, isfinite, isnan
from typing import Any, TypeVar

from protocols.plugin import Setting

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


def configuration(
    settings: Any,  # noqa: ANN401 -- any dataclass
    names: Mapping[str, str],
    relied_on: Collection[str] = (),
    protected: Mapping[str, str] | None = None,
) -> dict[str, Setting]:
    """Return `Spec.configuration` of parameters that are settings, in the device's own units.

    Args:
        settings: of the device; what is at its default states nothing, since few robot files list all.
        names: the setting's name by parameter.
        relied_on: settings that the spec depends on: they are stated at their defaults, too.
        protected: by setting, why it is never written.
    """
    declared = {each.name: each for each in fields(settings)}
    found = {}
    for parameter, name in names.items():
        value, each = float(getattr(settings, name)), declared[name]
        stated = isfinite(value) and (name in relied_on or value != each.default)
        low, high = each.metadata.get("low", -inf), each.metadata.get("high", inf)
        low, high = (0.0, 1.0) if isinstance(each.default, bool) else (low, high)
        found[parameter] = Setting(value if stated else None, low, high, (protected or {}).get(name, ""))
    return found
