"""Public recordings for the tests that need them: their location, checked against the catalogue.

Rules. A recording is used only if it has the catalogue's size and sha256: a wrong one fails, with a sentence.
Tests of an absent one are skipped by name; where it is required they fail as well. It is required if CI is
true, or MOTOR_GATEWAY_REQUIRE contains "data" (entries are separated by commas or spaces).
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CATALOGUE = ROOT / "fixtures" / "catalogue.toml"
WHERE = "MOTOR_GATEWAY_DATA"
REQUIRE = "MOTOR_GATEWAY_REQUIRE"


class Absent(Exception):
    """The recording is absent, with the reason."""


class Wrong(Exception):
    """A file is here, and it is not the recording."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One entry of the catalogue."""

    file: str
    what: str
    source: str
    licence: str
    bytes: int
    sha256: str
    used_by: list[str]
    attribution: str = ""


def read() -> dict[str, Recording]:
    """The catalogue, by file."""
    table = tomllib.loads(CATALOGUE.read_text(encoding="utf-8"))
    entries = [Recording(**entry) for entry in table["recordings"]]
    return {entry.file: entry for entry in entries}


def find(entry: Recording, environ: Mapping[str, str]) -> Path:
    """Where the recording lies, after a look at its content. Raises Absent or Wrong."""
    if not environ.get(WHERE):
        raise Absent(f"{WHERE} is not set")
    path = ROOT / environ[WHERE] / entry.file  # a path that is not absolute counts from the checkout
    if not path.is_file():
        raise Absent(f"there is no {path}")
    size = path.stat().st_size
    if size != entry.bytes:
        raise Wrong(f"{path} has {size} bytes, and the catalogue's {entry.file} has {entry.bytes}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != entry.sha256:
        raise Wrong(f"{path} has sha256 {digest}, and the catalogue's {entry.file} has {entry.sha256}")
    return path


def required(environ: Mapping[str, str]) -> bool:
    """Whether what is absent is a failure."""
    return environ.get("CI", "").lower() == "true" or "data" in re.split(r"[\s,]+", environ.get(REQUIRE, ""))
