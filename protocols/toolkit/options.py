"""Parameters of a device that are settings of its twin, as its spec states them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields
from math import inf, isfinite
from typing import Any

from protocols.bounds import bounds_of, hints
from protocols.plugin import Setting


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
        bounds = bounds_of(hints(type(settings))[name])
        low, high = (bounds.least, bounds.most) if bounds else (-inf, inf)
        low, high = (0.0, 1.0) if isinstance(each.default, bool) else (low, high)
        found[parameter] = Setting(value if stated else None, low, high, (protected or {}).get(name, ""))
    return found
