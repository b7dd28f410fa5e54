"""The table of public recordings: where each is, under which licence, and how it is known to be the one.

Rules. A file counts only with the size and the sha256 of its entry. Its address is that of its `source`, a
file of a repository at a commit; another may be stated. What is derived from its source has no address.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

from gateway.config.errors import Mistakes
from gateway.config.resources import shipped
from gateway.config.schema import build
from gateway.config.text import read_text, read_toml
from gateway.errors import UserError
from protocols.bounds import Bounds, Invalid
from protocols.suggest import did_you_mean

BLOCK = 1 << 20
"""Bytes that are read at once"""
_OF_A_REPOSITORY = re.compile(r"(?P<whose>[\w.-]+/[\w.-]+):(?P<path>\S+\.\w+) @(?P<commit>[0-9a-f]{12,40})")
_RAW = "https://raw.githubusercontent.com"


class WrongFile(UserError):
    """A file is there, and is not what the catalogue says."""


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One recording, or what belongs to one."""

    file: str
    """Its path below the folder of the recordings"""
    what: str
    source: str
    """REPOSITORY:PATH @COMMIT, of a repository at GitHub; "derived from …" where it is no file of it"""
    licence: str
    """SPDX where there is an identifier"""
    bytes: Annotated[int, Bounds(1, 1 << 40)]
    sha256: str
    used_by: tuple[str, ...] = ()
    """Tests of this project"""
    attribution: str = ""
    """To be shown beside results"""
    url: str = ""
    """Where it is, if that is elsewhere than `source` says"""

    def __post_init__(self) -> None:
        wrong = []
        parts = Path(self.file).parts
        if not parts or Path(self.file).is_absolute() or ".." in parts or "\0" in self.file:
            wrong.append(("file", "expected a path below the folder of the recordings"))
        if not re.fullmatch("[0-9a-f]{64}", self.sha256):
            wrong.append(("sha256", "expected 64 hexadecimal digits"))
        if self.url and urlsplit(self.url).scheme not in ("http", "https"):
            wrong.append(("url", "expected https://… or http://…"))
        if wrong:
            raise Invalid(*wrong)

    @property
    def address(self) -> str:
        """Where it can be fetched; "" if nowhere."""
        if self.url:
            return self.url
        found = _OF_A_REPOSITORY.fullmatch(self.source)
        return f"{_RAW}/{found['whose']}/{found['commit']}/{quote(found['path'])}" if found else ""


def read_catalogue(path: Path | None = None) -> Mapping[str, CatalogueEntry]:
    """Return the entries by their files.

    Args:
        path: a TOML file of tables [[recordings]]; None: the catalogue that ships.

    Raises:
        ConfigError: every mistake in it.
    """
    path = shipped("catalogue.toml") if path is None else path
    text = read_text(path)
    mistakes = Mistakes(str(path), text)
    table = read_toml(text, mistakes)
    rows = table.get("recordings")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows) or len(table) != 1:
        mistakes.add((), "expected tables [[recordings]] and nothing else")
        rows = []
    found: dict[str, CatalogueEntry] = {}
    for number, row in enumerate(rows, 1):
        entry = build(CatalogueEntry, row, (f"recordings {number}",), mistakes)
        if entry is not None and entry.file in found:
            mistakes.add((f"recordings {number}", "file"), f"{entry.file!r} is there twice")
        elif entry is not None:
            found[entry.file] = entry
    mistakes.check()
    return found


def chosen(catalogue: Mapping[str, CatalogueEntry], names: Sequence[str]) -> list[CatalogueEntry]:
    """Return the entries of files and of folders of them, each once. Raises UserError for what is none."""
    found: dict[str, CatalogueEntry] = {}
    for name in names:
        of = {file: one for file, one in catalogue.items() if Path(name) in (Path(file), *Path(file).parents)}
        if not of:
            raise UserError(f"{name!r} is not in the catalogue{did_you_mean(name, catalogue)}")
        found |= of
    return list(found.values())


def check_file(path: Path, entry: CatalogueEntry) -> None:
    """Raise WrongFile unless a file has the size and the sha256 of an entry; OSError if it cannot be read."""
    size = path.stat().st_size
    if size != entry.bytes:
        raise WrongFile(f"{path} has {size} bytes, and the catalogue's {entry.file} has {entry.bytes}")
    digest = sha256_of(path)
    if digest != entry.sha256:
        raise WrongFile(f"{path} has sha256 {digest}, and the catalogue's {entry.file} has {entry.sha256}")


def sha256_of(path: Path) -> str:
    """Return the sha256 of a file, in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()
