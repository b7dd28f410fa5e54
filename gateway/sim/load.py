"""A world file from its name, its path or its text.

Rules. A wrong file raises WorldError with every mistake at once: file, line, key, what was expected, and
the nearest right name.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from gateway.config.errors import Mistakes, shown, unknown
from gateway.config.schema import build, read_toml
from gateway.errors import ConfigError, Mistake
from gateway.sim.files import BenchFile, SceneFile, WorldFile


class WorldError(ConfigError):
    """A wrong world file, or a robot that does not fit into its world: every mistake at once."""


def known_worlds() -> tuple[str, ...]:
    """Names of the worlds that come with the package."""
    found = (entry.name for entry in (files("gateway.fixtures") / "worlds").iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in found if name.endswith(".toml")))


def load_world(name_or_path: str | Path) -> WorldFile:
    """A world by its name among those that come with the package, or by the path of a .toml file.

    Raises WorldError with every mistake at once, or with why there is no such world."""
    said = str(name_or_path)
    if isinstance(name_or_path, Path) or said.endswith(".toml"):
        try:
            text = Path(said).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise complaint(said, [f"cannot be read: {error}"]) from error
        return loads_world(text, said)
    if said not in known_worlds():
        sentence = unknown("world", said, known_worlds()) + " (or the path of a .toml file)"
        raise complaint("world", [sentence])
    resource = files("gateway.fixtures") / "worlds" / f"{said}.toml"
    return loads_world(resource.read_text(encoding="utf-8"), f"worlds/{said}.toml")


def loads_world(text: str, source: str = "world.toml") -> WorldFile:
    """A world from the text of its file; `source` names the file in complaints."""
    mistakes = Mistakes(source, text)
    try:
        table = read_toml(text, mistakes)
    except ConfigError as error:
        raise WorldError(error.mistakes) from error
    made: WorldFile | None = None
    if table.get("kind") == "scene":
        made = build(SceneFile, table, (), mistakes)
    elif table.get("kind") == "bench":
        made = build(BenchFile, table, (), mistakes)
    elif "kind" in table:
        mistakes.add(("kind",), f"found {shown(table['kind'])}, expected 'scene' or 'bench'")
    else:
        mistakes.add(("kind",), "missing; expected 'scene' or 'bench'")
    if made is None:
        raise WorldError(mistakes.error().mistakes)
    return made


def complaint(about: str, sentences: Sequence[str]) -> WorldError:
    """A WorldError whose mistakes have no line of their own."""
    return WorldError([Mistake(about, 0, "", sentence) for sentence in sentences])
