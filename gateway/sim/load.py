"""Reading world files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gateway.config import resources
from gateway.config.errors import Mistakes, shown
from gateway.config.schema import MAX_SIZE, build, read_toml
from gateway.errors import ConfigError, Mistake, UserError
from gateway.sim.files import BenchFile, SceneFile, WorldFile


class WorldError(ConfigError):
    """A wrong world file, or a robot that does not fit into its world: every mistake at once."""

    @classmethod
    def about(cls, subject: str, texts: Sequence[str]) -> WorldError:
        """Return an error whose mistakes have no line in a file."""
        return cls([Mistake(subject, 0, "", text) for text in texts])


def load_world(name_or_path: str | Path) -> WorldFile:
    """Load a world that ships with the package, by its name, or any .toml file, by its path.

    Raises WorldError with every mistake, each with file, line, key and what was expected."""
    try:
        path = resources.find("worlds", str(name_or_path))
        text = resources.read(path, MAX_SIZE)
    except (UserError, OSError, UnicodeDecodeError) as error:
        raise WorldError.about(str(name_or_path), [f"cannot be read: {error}"]) from error
    return parse_world(text, str(path))


def parse_world(text: str, source: str = "world.toml") -> WorldFile:
    """Parse the text of a world file; `source` is its name in mistakes. Raises WorldError with all of
    them."""
    mistakes = Mistakes(source, text)
    try:
        table = read_toml(text, mistakes)
        kinds: dict[str, type[SceneFile | BenchFile]] = {"scene": SceneFile, "bench": BenchFile}
        kind = table.get("kind")
        file = None
        if isinstance(kind, str) and kind in kinds:
            file = build(kinds[kind], table, (), mistakes)
        else:
            found = f"found {shown(kind)}," if "kind" in table else "missing;"
            mistakes.add(("kind",), f"{found} expected 'scene' or 'bench'")
        mistakes.check()
    except ConfigError as error:
        raise WorldError(error.mistakes) from error
    assert file is not None, "mistakes were added"
    return file
