"""Reading world files and plant files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

from brain.belief import Pose
from gateway.config import resources
from gateway.config.errors import Mistakes, shown
from gateway.config.map_file import drawing_of, files_of
from gateway.config.schema import build
from gateway.config.text import read_text, read_toml
from gateway.errors import ConfigError, Mistake, UserError
from gateway.sim.assembly_file import Assembly, AssemblyFile, AssemblyPart, PartFile
from gateway.sim.files import BenchFile, SceneFile, WorldFile
from gateway.sim.from_map import Grid, place_of
from gateway.sim.linked_file import LinkedFile
from gateway.sim.plant_files import PlantFile, WheeledFile
from protocols.bounds import Invalid

T = TypeVar("T")
Parse: TypeAlias = Callable[[str, str], T]

OCCUPIED = 65
"""Percent from which on a cell of a map is taken as occupied"""
WORLDS: dict[str, type[WorldFile]] = {"scene": SceneFile, "bench": BenchFile}
PLANTS: dict[str, type[PlantFile]] = {"wheels": WheeledFile, "linked": LinkedFile, "assembly": AssemblyFile}
"""Kinds of files, by their key `kind`."""


class WorldError(ConfigError):
    """A wrong world or plant file, or a robot that does not fit into its world: every mistake at once."""

    @classmethod
    def about(cls, subject: str, texts: Sequence[str]) -> WorldError:
        """Return an error whose mistakes have no line in a file."""
        return cls([Mistake(subject, 0, "", text) for text in texts])


def load_world(name_or_path: str | Path) -> WorldFile:
    """Load a world that ships with the package, by its name, or any .toml file, by its path; or a map of
    map_server, by the path of its YAML: what is occupied in it stands there, and the robot begins at (0, 0).

    Raises WorldError with every mistake, each with file, line, key and what was expected."""
    if Path(name_or_path).suffix in (".yaml", ".yml"):
        return _of_map(Path(name_or_path))
    return _load("worlds", name_or_path, parse_world)[0]


def _of_map(path: Path) -> SceneFile:
    """Return the place that a map shows. Raises WorldError."""
    try:
        text = read_text(path)
        files = {name: path.parent / name for name in files_of(text)[:1]}
        drawing, _ = drawing_of(text, {n: file.read_bytes() for n, file in files.items() if file.is_file()})
        grid = Grid(drawing.percents >= OCCUPIED, drawing.resolution, drawing.origin)
        return place_of(grid, path.stem, Pose(0.0, 0.0, 0.0))
    except Invalid as error:
        raise WorldError.about(str(path), [sentence for _, sentence in error.wrong]) from error
    except (UserError, OSError) as error:
        raise WorldError.about(str(path), [f"cannot be read: {error}"]) from error


def load_plant(name_or_path: str | Path) -> PlantFile:
    """Load a plant, likewise."""
    file, path = _load("plants", name_or_path, parse_plant)
    return _assembled(file, path) if isinstance(file, AssemblyFile) else file


def _assembled(file: AssemblyFile, path: Path) -> Assembly:
    """Return the robot with its parts read."""
    wheeled: list[WheeledFile] = []
    linked: list[AssemblyPart] = []
    for name, part in file.parts.items():
        plant = load_plant(resources.beside(part.plant, path))
        if isinstance(plant, WheeledFile) and not wheeled and part == PartFile(part.plant):
            wheeled.append(plant)
        elif isinstance(plant, LinkedFile) and plant.base == "fixed":
            linked.append(AssemblyPart(name, plant, part.at, part.prefix))
        else:
            what = "expected links with a fixed base, or one base on wheels, at the origin"
            raise WorldError.about(str(path), [f"parts.{name}: plant {plant.name!r} cannot be this; {what}"])
    base = wheeled[0] if wheeled else None
    figures = {one.name: getattr(file, one.name) for one in fields(PlantFile)}
    if base is not None:
        figures |= {
            kind: getattr(base, kind) | figures[kind]
            for kind in ("lidars", "imus", "cameras", "receivers", "shaft_encoders", "shafts")
        }
    try:
        return Assembly(base=base, parts=tuple(linked), **figures)
    except ValueError as error:
        raise WorldError.about(str(path), [str(error)]) from error


def parse_world(text: str, source: str = "world.toml") -> WorldFile:
    """Parse the text of a world file; `source` is its name in mistakes. Raises WorldError with all of
    them."""
    return _parse(text, source, WORLDS)


def parse_plant(text: str, source: str = "plant.toml") -> PlantFile:
    """Parse the text of a plant file, likewise."""
    return _parse(text, source, PLANTS)


def _load(kind: Literal["worlds", "plants"], name_or_path: str | Path, parse: Parse[T]) -> tuple[T, Path]:
    try:
        path = resources.find(kind, str(name_or_path))
        text = read_text(path)
    except ConfigError as error:
        raise WorldError(error.mistakes) from error
    except UserError as error:
        raise WorldError.about(str(name_or_path), [f"cannot be read: {error}"]) from error
    return _with_files(parse(text, str(path)), path), path


def _with_files(file: T, path: Path) -> T:
    """Return a world or plant whose files are found from wherever it is used."""
    if isinstance(file, SceneFile):
        return replace(file, mission=resources.beside(file.mission, path))
    if isinstance(file, LinkedFile) and (path.parent / file.urdf).is_file():
        return replace(file, urdf=str(path.parent / file.urdf))
    return file


def _parse(text: str, source: str, kinds: dict[str, type[T]]) -> T:
    mistakes = Mistakes(source, text)
    try:
        table = read_toml(text, mistakes)
        kind = table.get("kind")
        file = None
        if isinstance(kind, str) and kind in kinds:
            file = build(kinds[kind], table, (), mistakes)
        else:
            found = f"found {shown(kind)}," if "kind" in table else "missing;"
            mistakes.add(("kind",), f"{found} expected {' or '.join(map(repr, kinds))}")
        mistakes.check()
    except ConfigError as error:
        raise WorldError(error.mistakes) from error
    assert file is not None, "mistakes were added"
    return file
