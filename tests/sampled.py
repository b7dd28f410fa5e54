"""Parameters of which a share is tried by `./go test`, and the rest by `./go prove`."""

from __future__ import annotations

from collections.abc import Iterable

import pytest


def sampled(values: Iterable[object], every: int) -> list[object]:
    """Return these as parameters of a test: the first and every so many after it, the others if asked for.

    A tuple is several parameters."""
    return [
        pytest.param(
            *(one if isinstance(one, tuple) else (one,)), marks=[pytest.mark.prove] if number % every else []
        )
        for number, one in enumerate(values)
    ]
