"""How the benchmarks measure: contestants take turns; reported are the median and the 99th percentile.

Rules. Contestants are measured in the same process, in turn, round after round, so that what else the
machine does meets all of them alike. A call that is too short for the clock is repeated within a sample, and
the sample is its mean. The garbage collector is kept as the live loop keeps it. Nothing here judges a time.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from math import ceil
from types import ModuleType
from typing import Any, Literal, TypeAlias
from weakref import finalize

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
    # Who waits for another process finds the caches cold: then samples are longer.
    least = LEAST_SAMPLE * (30 if any(isinstance(each, Remote) for each in contestants.values()) else 1)
    with quiet_collector():
        calls = {
            name: _calls_per_sample(call, took.setdefault(name, []), least)
            for name, call in contestants.items()
        }
        for number in range(rounds):
            for name, call in contestants.items():
                if number >= len(took[name]):
                    took[name].append(sample(call, calls[name]))
    return {name: figures(samples) for name, samples in took.items()}


def sample(call: Call, calls: int = 1) -> float:
    """Nanoseconds per call, over so many calls in a row."""
    if isinstance(call, Remote):
        return call.took(calls)
    repeat = range(calls)
    began = stopwatch()
    for _ in repeat:
        call()
    return (stopwatch() - began) / calls


def _calls_per_sample(call: Call, slow: list[float], least: Nanos) -> int:
    """So many that a sample lasts long enough; it warms up what is measured. What is slow needs no warmth:
    its first call is its first sample."""
    calls = 1
    while (took := sample(call, calls)) * calls < least:
        calls = max(2 * calls, ceil(least / max(took, 1.0)))
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


_SERVE = """
import json, sys, time
for line in sys.stdin:
    what, calls = json.loads(line)
    call = CALLS[what]
    began = time.perf_counter_ns()
    for _ in range(calls):
        result = call()
    took = (time.perf_counter_ns() - began) / calls
    print(json.dumps([took, result], default=list), flush=True)
"""


class Elsewhere:
    """A rival in a process of its own, which its licence asks for. It ends with this object."""

    def __init__(self, script: str) -> None:
        """`script` leaves CALLS: a dictionary of calls whose results are numbers, or sequences of them."""
        self._process = subprocess.Popen(
            [sys.executable, "-c", script + _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        finalize(self, _end, self._process)

    def call(self, what: str) -> Remote:
        """Return one of its calls."""
        return Remote(self, what)

    def ask(self, what: str, calls: int) -> tuple[float, Any]:
        """Return nanoseconds per call, and the last result. Raises NotMeasured if the process has failed."""
        to, back = self._process.stdin, self._process.stdout
        assert to is not None
        assert back is not None
        try:
            to.write(json.dumps([what, calls]) + "\n")
            to.flush()
            took, result = json.loads(back.readline())
        except (BrokenPipeError, ValueError):
            raise NotMeasured(_end(self._process).splitlines()[-1]) from None
        return took, result


@dataclass(frozen=True, slots=True)
class Remote:
    """A call in another process, which measures it itself."""

    where: Elsewhere
    what: str

    def __call__(self) -> object:
        """The result of one call."""
        return self.where.ask(self.what, 1)[1]

    def took(self, calls: int) -> float:
        """Nanoseconds per call, over so many calls in a row."""
        return self.where.ask(self.what, calls)[0]


def _end(process: subprocess.Popen[str]) -> str:
    """End a process; what it said of its failure, if it failed."""
    return process.communicate()[1] or "it ended by itself"


def rival_elsewhere(distribution: str, script: str) -> Rival:
    """Start what may not be installed, in a process of its own."""
    try:
        return Rival(f"{distribution} {version(distribution)}", Elsewhere(script))
    except PackageNotFoundError:
        return Rival(distribution, None, f"{distribution} is not installed")
