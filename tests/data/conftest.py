"""The recordings of others, for the tests of this folder: `recording("husky/husky.bag")` is its path."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from gateway.recording.catalogue import WrongFile
from tests.data.recordings import Absent, find, read, required


@cache
def _path(name: str) -> Path:
    return find(read()[name], os.environ)


@pytest.fixture(scope="session")
def recording() -> Callable[[str], Path]:
    """The path of a recording that is whole. What is absent skips the test by name, or fails it where it
    is required; what is wrong fails."""

    def path(name: str) -> Path:
        try:
            return _path(name)
        except Absent as why:
            if required(os.environ):
                pytest.fail(f"required, and absent: {name}: {why}", pytrace=False)
            pytest.skip(f"NOT RUN: {name}: {why}")
        except WrongFile as why:
            pytest.fail(str(why), pytrace=False)

    return path
