"""How two runs part: each signal of both, aligned in time, with where it parts and how far.

Rules. The second run is aligned by the clock of the first, each counted from its first tick; values between
two ticks are interpolated. A signal parts where the two differ by more than a share of its own span for as
long as `FOR`: a single odd sample is no difference of two runs on real wires.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from brain.belief import Floats

SHARE = 0.02
"""Of the span of a signal, both runs together"""
FOR = 0.1
"""s"""
LEAST = 1e-9
"""A span of no difference"""


class Signals(Protocol):
    """The signals of a run, such as a `SignalLog`."""

    @property
    def t(self) -> Floats:
        """Times [s]"""

    @property
    def units(self) -> Mapping[str, str]:
        """Unit by signal"""

    def __getitem__(self, name: str) -> Floats:
        """Return a signal's values."""


class Parting(NamedTuple):
    """One signal of two runs."""

    name: str
    unit: str
    since: float
    """s: where they part for good or for a while first; NaN if they do not"""
    largest: float
    """Largest difference, in the signal's unit"""
    at: float
    """s: when it is that large"""
    span: float
    """From the lowest to the highest value of both"""

    def text(self) -> str:
        """Return it as a line."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.name}: from {self.since:.2f} s on; at most {self.largest:.4g}{unit} at {self.at:.2f} s, "
            f"of a span of {self.span:.4g}{unit}"
        )


def partings(one: Signals, two: Signals) -> list[Parting]:
    """Return the signals that part, the earliest first.

    Args:
        one: of the first run.
        two: of the second.
    """
    first, second = one.t - one.t[:1], two.t - two.t[:1]
    if not len(first) or not len(second):
        return []
    last = min(first[-1], second[-1])
    times = first[first <= last]
    found = []
    for name in (name for name in one.units if name in two.units):
        ours, theirs = one[name][: len(times)], _at(times, second, two[name])
        parting = _parting(name, one.units[name], times, ours, theirs)
        if parting is not None:
            found.append(parting)
    return sorted(found, key=lambda each: (each.since, each.name))


def _at(times: Floats, given: Floats, values: Floats) -> Floats:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(times), np.nan)
    found = np.interp(times, given[known], values[known])
    found[times < given[known][0]] = np.nan
    return found


def _parting(
    name: str,
    unit: str,
    times: Floats,
    ours: Floats,
    theirs: Floats,
) -> Parting | None:
    both = np.isfinite(ours) & np.isfinite(theirs)
    if not both.any():
        return None
    apart = np.where(both, np.abs(ours - theirs), 0.0)
    values = np.concatenate((ours[both], theirs[both]))
    span = float(values.max() - values.min())
    beyond = apart > SHARE * max(span, LEAST)
    ends = np.searchsorted(times, times + FOR)
    count = np.concatenate(([0], np.cumsum(beyond)))
    lasting = np.flatnonzero(beyond & (count[ends] - count[:-1] == ends - np.arange(len(times))))
    lasting = lasting[times[lasting] + FOR <= times[-1] + LEAST]
    if not len(lasting):
        return None
    worst = int(apart.argmax())
    return Parting(name, unit, float(times[lasting[0]]), float(apart[worst]), float(times[worst]), span)
