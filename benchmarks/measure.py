"""How the benchmarks measure: contestants take turns; reported are the median and the 99th percentile.

Rules. Contestants are measured in the same process, in turn, round after round, so that what else the
machine does meets all of them alike. A call that is too short for the clock is repeated within a sample, and
the sample is its mean. The garbage collector is kept as the live loop keeps it. Nothing here judges a time.
"""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from math import ceil
from types import ModuleType
from typing import Any, Literal, TypeAlias

from gateway.core.clock import stopwatch
from gateway.runtime.process import quiet_collector
from protocols.messages import Nanos

Call: TypeAlias = Callable[[], object]
LEAST_SAMPLE: Nanos = 10_000
"""Minimum duration of a sample, so that reading the clock (some 50 ns) is no part of it; and not much
longer, so that few samples are cut in two by whatever else the machine does."""

SLOW: Nanos = 20_000_000


class NotMeasured(RuntimeError):
    """What was to be measured did not do its work, so its time is meaningless; the text is what it did."""


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured of one thing."""

    median: float
    p99: float
    """The 99th percentile; the worst if there are fewer than a hundred samples."""
    samples: int
    unit: Literal["ns", "B"] = "ns"


@dataclass(frozen=True, slots=True)
class Effort:
    """How thoroughly to measure."""

    quick: bool = False
    """As little as shows that all of it runs; the figures are rough."""

    def of(self, full: int, quick: int) -> int:
        """Rounds, or seconds: the one or the other number."""
        return quick if self.quick else full


def figures(samples: Sequence[float], unit: Literal["ns", "B"] = "ns") -> Figures:
    """Median and 99th percentile (nearest rank) of at least one sample."""
    ordered = sorted(samples)
    middle = len(ordered) // 2
    median = ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2.0
    return Figures(median, ordered[ceil(0.99 * len(ordered)) - 1], len(ordered), unit)


def in_turn(contestants: Mapping[str, Call], rounds: int) -> dict[str, Figures]:
    """Nanoseconds per call of each contestant, measured in turn for so many rounds."""
    took: dict[str, list[float]] = {}
    with quiet_collector():
        calls = {
            name: _calls_per_sample(call, took.setdefault(name, [])) for name, call in contestants.items()
        }
        for number in range(rounds):
            for name, call in contestants.items():
                if number >= len(took[name]):
                    took[name].append(sample(call, calls[name]))
    return {name: figures(samples) for name, samples in took.items()}


def sample(call: Call, calls: int = 1) -> float:
    """Nanoseconds per call, over so many calls in a row."""
    repeat = range(calls)
    began = stopwatch()
    for _ in repeat:
        call()
    return (stopwatch() - began) / calls


def _calls_per_sample(call: Call, slow: list[float]) -> int:
    """So many that a sample lasts long enough; it warms up what is measured. What is slow needs no warmth:
    its first call is its first sample."""
    calls = 1
    while (took := sample(call, calls)) * calls < LEAST_SAMPLE:
        calls = max(2 * calls, ceil(LEAST_SAMPLE / max(took, 1.0)))
    slow += [took] if took >= SLOW else []
    return calls


def preemptions() -> int:
    """How often this process's processor was given to something else so far: 99th percentiles show that."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw


# -- alternatives ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Rival:
    """A package to be compared with: its module, or why it cannot be."""

    name: str
    """With its version, if it is there."""
    module: Any = None
    """The ModuleType; Any, because what is in it has no types here."""
    why_not: str = ""


def rival(module: str, distribution: str) -> Rival:
    """Import what may not be installed."""
    try:
        found: ModuleType = import_module(module)
    except ImportError:
        return Rival(distribution, None, f"{distribution} is not installed")
    return Rival(f"{distribution} {version(distribution)}", found)
