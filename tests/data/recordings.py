"""Public recordings for the tests that need them: their location, checked against the catalogue.

Rules. A recording is used only if it has the catalogue's size and sha256: a wrong one fails, with a sentence.
Tests of an absent one are skipped by name; where it is required they fail as well. It is required if CI is
true, or MOTOR_GATEWAY_REQUIRE contains "data" (entries are separated by commas or spaces).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from gateway.recording.catalogue import CatalogueEntry, check_file, read_catalogue

ROOT = Path(__file__).resolve().parents[2]
CATALOGUE = ROOT / "fixtures" / "catalogue.toml"
WHERE = "MOTOR_GATEWAY_DATA"
REQUIRE = "MOTOR_GATEWAY_REQUIRE"


class Absent(Exception):
    """The recording is absent, with the reason."""


Recording = CatalogueEntry


def read() -> Mapping[str, Recording]:
    """The catalogue, by file."""
    return read_catalogue(CATALOGUE)


def find(entry: Recording, environ: Mapping[str, str]) -> Path:
    """Where the recording lies, after a look at its content. Raises Absent, or WrongFile."""
    if not environ.get(WHERE):
        raise Absent(f"{WHERE} is not set")
    path = ROOT / environ[WHERE] / entry.file  # a path that is not absolute counts from the checkout
    if not path.is_file():
        raise Absent(f"there is no {path}")
    check_file(path, entry)
    return path


def required(environ: Mapping[str, str]) -> bool:
    """Whether what is absent is a failure."""
    return environ.get("CI", "").lower() == "true" or "data" in re.split(r"[\s,]+", environ.get(REQUIRE, ""))
