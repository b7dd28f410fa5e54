"""Runs a guide: executes its commands in a clean folder, and compares outputs and quotations with the text.

Rules of such a text. A `console` block holds commands, each behind "$ ", and their output. A block under
a line that begins with **`path`** quotes a file as the commands have left it; under one that begins with
**New `path`** it is a file that the reader writes. A line that is only "…" (in
code "# …") stands for any lines, or none. All else is for the reader alone. `motor-gateway` in that folder
is this checkout.

    python -m tests.guide docs/adding-a-protocol.md

executes the text in a folder of its own, and writes the outputs into it, except where there is a "…".
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"(?:^\*\*(?P<new>New )?`(?P<path>[^`\n]+)`\*\*[^\n]*\n\n)?"
    r"^(?P<fence>`{3,})(?P<kind>\w+)\n(?P<body>.*?)^(?P=fence)$",
    re.MULTILINE | re.DOTALL,
)
SLOW = re.compile(r"^.+: (?:[0-9.e+]+ so far|\d+% of [0-9.e+]+), .*\d+ s.*\n", re.MULTILINE)
"""How far something is, told every ten seconds: where a machine is busy, and not where it is not."""
SIZE = re.compile(r"\(\d+\.\d MB\)")
"""Of a recording: how well it is packed depends on how fast it was written."""
SITECUSTOMIZE = "import site\nsite.addsitedir({!r})\n"
"""Makes a folder on the path work like site-packages, so that what pip installs there is found."""


@dataclass(frozen=True, slots=True)
class Block:
    """A block of the text that is executed or compared."""

    body: str
    path: str
    """Of the file that it quotes; "" for commands."""
    start: int
    """Where its body begins in the text."""
    new: bool = False
    """Whether the reader writes this file."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """A command or a quoted file, with what the text shows of it, and what it is."""

    subject: str
    expected: str
    actual: str

    def matches(self) -> bool:
        """True if it is as shown, where "…" stands for any lines."""
        expected, actual = (SIZE.sub("(MB)", text) for text in (self.expected, self.actual))
        parts = re.split(r"^ *(?:# )?…\n", expected, flags=re.MULTILINE)
        pattern = r"(?:.*\n)*?".join(re.escape(part) for part in parts)
        return re.fullmatch(pattern, actual) is not None


def blocks(text: str) -> Iterator[Block]:
    """Yield the commands and quotations of a text, in order."""
    for match in BLOCK.finditer(text):
        if match["path"] or match["kind"] == "console":
            yield Block(match["body"], match["path"] or "", match.start("body"), bool(match["new"]))


@dataclass(slots=True)
class GuideRunner:
    """Executes blocks in a clean folder, with an empty folder to install packages into."""

    root: Path
    folder: Path = field(init=False)
    """The current folder."""
    site: Path = field(init=False)

    def __post_init__(self) -> None:
        """Make both folders."""
        self.folder, self.site = self.root / "work", self.root / "site"
        self.folder.mkdir()
        self.site.mkdir()
        (self.folder / "motor-gateway").symlink_to(ROOT)
        (self.site / "sitecustomize.py").write_text(SITECUSTOMIZE.format(str(self.site)))

    def execute(self, block: Block) -> list[Comparison]:
        """Run the commands, or write or read the file."""
        if block.new:
            (self.folder / block.path).write_text(block.body)
            return []
        if block.path:
            return [Comparison(block.path, block.body, (self.folder / block.path).read_text())]
        return [self.run(command, expected) for command, expected in commands(block.body)]

    def run(self, command: str, expected: str) -> Comparison:
        """Run a command as in a shell; `cd` remains in effect."""
        if command.startswith("cd "):
            self.folder = (self.folder / command.removeprefix("cd ")).resolve()
            return Comparison(f"$ {command}", expected, "")
        completed = subprocess.run(
            ["bash", "-c", command],
            cwd=self.folder,
            env=self.environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        output = SLOW.sub("", completed.stdout).replace(str(self.root / "work"), "~")
        return Comparison(f"$ {command}", expected, output and output.rstrip("\n") + "\n")

    def environment(self) -> dict[str, str]:
        """Return what the project needs and what was installed here; nothing of the caller's environment."""
        programs = Path(sys.executable).parent
        return {
            "PATH": f"{programs}:/usr/bin:/bin",
            "HOME": str(self.root),
            "PYTHONPATH": f"{self.site}{os.pathsep}{ROOT}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "PIP_TARGET": str(self.site),
            "PIP_NO_INDEX": "1",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
            "PIP_ROOT_USER_ACTION": "ignore",
            "MYPYPATH": str(ROOT),
            "OPENBLAS_NUM_THREADS": "1",
            "MPLCONFIGDIR": str(self.root),
        }


def commands(body: str) -> list[tuple[str, str]]:
    """Return the commands of a console block, each with its expected output."""
    parts = re.split(r"^\$ ", body, flags=re.MULTILINE)
    if parts[0]:
        raise ValueError(f"a console block that does not begin with a command: {body[:60]!r}")
    pairs = [part.partition("\n") for part in parts[1:]]
    return [(command, output.rstrip("\n") + "\n" if output.strip() else "") for command, _, output in pairs]


def update_outputs(text: str, root: Path) -> str:
    """Return the text with the present outputs of its commands; one with a "…" that matches stays."""
    runner, pieces, at = GuideRunner(root), list[str](), 0
    for block in blocks(text):
        results = runner.execute(block)
        if not block.path:
            shown = [f"{r.subject}\n{r.expected if r.matches() else r.actual}" for r in results]
            pieces += [text[at : block.start], "".join(shown)]
            at = block.start + len(block.body)
    return "".join([*pieces, text[at:]])


if __name__ == "__main__":
    for name in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            Path(name).write_text(update_outputs(Path(name).read_text(), Path(folder).resolve()))
