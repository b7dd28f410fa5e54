"""A guide that is done as it is read: its files are written, its commands run, and what they say compared.

Rules of such a text. A block under a line that begins with **`path`** is a file; "further down" on that line
adds to one that is there, and a `diff` changes one. A `console` block is commands, each behind "$ ", and what
they say; a line that is only "…" stands for any lines, or none. All else is for the reader alone.

    python -m tests.guide docs/adding-a-protocol.md

does what the text says in a folder of its own, and puts what was said into it, but where there is a "…".
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
    r"(?:^\*\*`(?P<path>[^`\n]+)`\*\*(?P<note>[^\n]*)\n\n)?"
    r"^(?P<fence>`{3,})(?P<kind>\w+)\n(?P<body>.*?)^(?P=fence)$",
    re.MULTILINE | re.DOTALL,
)
FINDS_PATHS = "import site\nsite.addsitedir({!r})\n"
"""A sitecustomize that makes a folder on the path like site-packages: what pip puts there is found."""


@dataclass(frozen=True, slots=True)
class Block:
    """A block of the text that something is done with."""

    kind: str
    body: str
    path: str
    further: bool
    start: int
    """Where its body begins in the text."""


@dataclass(frozen=True, slots=True)
class Said:
    """A command of the text, and what it said."""

    command: str
    expected: str
    actual: str

    def agrees(self) -> bool:
        """Whether it said what the text says."""
        parts = re.split(r"^…\n", self.expected, flags=re.MULTILINE)
        pattern = r"(?:.*\n)*?".join(re.escape(part) for part in parts)
        return re.fullmatch(pattern, self.actual) is not None


def blocks(text: str) -> Iterator[Block]:
    """The files, changes and commands of a text, in order."""
    for found in BLOCK.finditer(text):
        if found["path"] or found["kind"] == "console":
            further = "further down" in (found["note"] or "")
            yield Block(found["kind"], found["body"], found["path"] or "", further, found.start("body"))


@dataclass(slots=True)
class Reader:
    """Somebody who does what the text says, in a clean folder, with an empty place to install into."""

    root: Path
    here: Path = field(init=False)
    site: Path = field(init=False)

    def __post_init__(self) -> None:
        """Make the folder to work in, and the one to install into."""
        self.here, self.site = self.root / "work", self.root / "site"
        self.here.mkdir()
        self.site.mkdir()
        (self.site / "sitecustomize.py").write_text(FINDS_PATHS.format(str(self.site)))

    def do(self, block: Block) -> list[Said]:
        """Write the file, change it, or run the commands."""
        if block.kind == "console":
            return [self.run(command, expected) for command, expected in commands(block.body)]
        path = self.here / block.path
        if block.kind == "diff":
            path.write_text(changed(path.read_text(), block.body))
        elif block.further:
            path.write_text(path.read_text() + ("\n" if block.body[0] == " " else "\n\n") + block.body)
        else:
            path.write_text(block.body)
        return []

    def run(self, command: str, expected: str) -> Said:
        """Run a command as in a shell; `cd` stays in force."""
        if command.startswith("cd "):
            self.here = (self.here / command.removeprefix("cd ")).resolve()
            return Said(command, expected, "")
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self.here,
            env=self.environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        said = done.stdout.replace(str(self.root / "work"), "~")
        return Said(command, expected, said and said.rstrip("\n") + "\n")

    def environment(self) -> dict[str, str]:
        """What the project needs, and what was installed here; nothing of whoever runs this."""
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
    """The commands of a console block, each with what it is to say."""
    parts = re.split(r"^\$ ", body, flags=re.MULTILINE)
    if parts[0]:
        raise ValueError(f"a console block that does not begin with a command: {body[:60]!r}")
    pairs = [part.partition("\n") for part in parts[1:]]
    return [(command, said.rstrip("\n") + "\n" if said.strip() else "") for command, _, said in pairs]


def changed(text: str, diff: str) -> str:
    """The text with one change made. ValueError if its old lines do not stand there exactly once."""
    lines = diff.splitlines(keepends=True)
    old = "".join(line[1:] for line in lines if line[0] in " -")
    new = "".join(line[1:] for line in lines if line[0] in " +")
    if text.count(old) != 1:
        raise ValueError(f"these lines stand there {text.count(old)} times:\n{old}")
    return text.replace(old, new)


def rewritten(text: str, root: Path) -> str:
    """The text with what its commands say now. What has a "…" and still agrees is left as it is."""
    reader, made, at = Reader(root), [], 0
    for block in blocks(text):
        said = reader.do(block)
        if block.kind == "console":
            shown = [f"$ {s.command}\n{s.expected if s.agrees() else s.actual}" for s in said]
            made += [text[at : block.start], "".join(shown)]
            at = block.start + len(block.body)
    return "".join([*made, text[at:]])


if __name__ == "__main__":
    for name in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as folder:
            Path(name).write_text(rewritten(Path(name).read_text(), Path(folder).resolve()))
