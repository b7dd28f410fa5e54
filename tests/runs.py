"""The runs of the loop that a test begins end with it: one that is left to the garbage collector takes its
way out, and logs it, in the middle of another test."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
_runs: list[Generator[object]] = []


def kept(run: Generator[Item]) -> Generator[Item]:
    """Have a run closed where `ended` ends; return it."""
    _runs.append(run)
    return run


@contextmanager
def ended() -> Iterator[None]:
    """Close at the end what was kept since the beginning, the newest first."""
    begun = len(_runs)
    yield
    while len(_runs) > begun:
        _runs.pop().close()
