"""Example robots, worlds and plants that ship with the package, by name; or any file, by its path."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Literal

from gateway.errors import UserError
from protocols.suggest import did_you_mean


def find(kind: Literal["robots", "worlds", "plants", "missions", "scenarios"], name: str) -> Path:
    """Return the file of that path, or the shipped one of that name. Raises UserError with what there is."""
    if is_path(name):
        path = Path(name)
        try:
            if path.is_file():
                return path
        except OSError as error:  # a name that is too long, a folder that is closed to us
            raise UserError(f"{name}: {error.strerror}") from error
        raise UserError(f"there is no file {name}")
    shipped = {p.stem: p for p in sorted(Path(str(files("gateway.fixtures") / kind)).glob("*.toml"))}
    if name in shipped:
        return shipped[name]
    known = f"one of the shipped {kind}: {', '.join(shipped)}"
    raise UserError(f"{name!r} is neither a .toml file nor {known}{did_you_mean(name, shipped)}")


def beside(name: str, file: Path) -> str:
    """Return what a file names: a path counts from the file's folder, whatever the working folder is."""
    return str(file.parent / name) if is_path(name) else name


def is_path(name: str) -> bool:
    """True if this is the path of a file, not the name of one that ships with the package."""
    return Path(name).suffix in (".toml", ".yaml", ".yml") or "/" in name


def shipped(kind: str) -> Path:
    """Return the folder of the files of a kind that ship with the package."""
    return Path(str(files("gateway.fixtures") / kind))
